"""The benchmarks' exact pictures of boards against plain counts of the light that reaches a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.blur import Array, Blur, Disk, Gaussian
from benchmarks.pictures import View, draw_board, random_view

SQUARES = (5, 4)
SIZE = (320, 240)
# Whole codes of BT.709: rounding to 8 bits then has no part in the flat places.
BRIGHT, DARK, SURROUND = (float(((code / 255 + 0.099) / 1.099) ** (1 / 0.45)) for code in (230, 80, 140))


def seen(view: View, pixels: Array) -> Array:
    """Light where sharp rays through ``pixels`` (N, 2) end."""
    ray = (pixels - (np.array(view.size) - 1) / 2) / view.focal_px
    ray = ray * (1 + view.inverse_k * (ray**2).sum(axis=1, keepdims=True))
    plane = np.column_stack([ray, np.ones(len(ray))]) @ np.linalg.inv(view.homography).T
    x, y = plane[:, 0] / plane[:, 2], plane[:, 1] / plane[:, 2]
    board = (x > 0) & (x < SQUARES[0]) & (y > 0) & (y < SQUARES[1])
    sheet = (x > -1) & (x < SQUARES[0] + 1) & (y > -1) & (y < SQUARES[1] + 1)
    ink = board & ((np.floor(x) + np.floor(y)) % 2 == 0)
    return np.where(ink, DARK, np.where(sheet, BRIGHT, SURROUND))


@pytest.mark.parametrize("blur", [Gaussian(1.0), Gaussian(5.0), Disk(4.0), Disk(9.0)])
def test_every_pixel_is_the_mean_of_the_rays_that_reach_it(blur: Blur) -> None:
    rng = np.random.default_rng(5)
    view = random_view(SQUARES, rng, size=SIZE)
    grey = [(level,) * 3 for level in (BRIGHT, DARK)]
    drawn = draw_board(SQUARES, view, blur, 0.0, rng, bright=grey[0], dark=grey[1], surround=SURROUND)
    count = 4000
    share, turn = (np.arange(count) + 0.5) / count, np.arange(count) * np.pi * (3 - np.sqrt(5))
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    if isinstance(blur, Disk):
        offsets = blur.radius_px * np.sqrt(share)[:, None] * circle
    else:
        assert isinstance(blur, Gaussian)
        offsets = blur.sigma_px * np.sqrt(-2 * np.log(1 - share))[:, None] * circle
    offsets = offsets + rng.uniform(-0.5, 0.5, offsets.shape)
    pixels = np.column_stack([rng.integers(10, SIZE[0] - 10, 500), rng.integers(10, SIZE[1] - 10, 500)])
    counted = np.array([seen(view, pixel + offsets).mean() for pixel in pixels])
    coded = drawn.picture[pixels[:, 1], pixels[:, 0], 0] / 255
    light = np.where(coded < 0.081, coded / 4.5, ((coded + 0.099) / 1.099) ** (1 / 0.45))
    assert np.sqrt(((light - counted) ** 2).mean()) < 0.003
    assert abs((light - counted).mean()) < 0.0005


@pytest.mark.parametrize("cosine", [-0.5, 0.0, 0.3])
def test_two_edges_across_a_disk(cosine: float) -> None:
    """The closed form against a count over the disk; for perpendicular edges too it is not the profiles' product."""
    blur, count = Disk(5.0), 200_000
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    r = 5 * np.sqrt((np.arange(count) + 0.5) / count)
    x, y = r * np.cos(turn), r * np.sin(turn)
    second = cosine * x + np.sqrt(1 - cosine**2) * y
    most = 0.0
    for d1, d2 in np.random.default_rng(2).uniform(-5, 5, (60, 2)):
        counted = float((np.sign(d1 - x) * np.sign(d2 - second)).mean())
        one, two = np.array(d1), np.array(d2)
        product = blur.profile(one) * blur.profile(two)
        assert float(product + blur.crossing(one, two, np.array(cosine))) == pytest.approx(counted, abs=1e-3)
        most = max(most, abs(counted - float(product)))
    assert most > 0.02
