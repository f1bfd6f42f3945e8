"""Exact pictures of red squares and of light spots for the benchmarks, nothing resampled.

A square is a board of one field (see :mod:`benchmarks.pictures`): its blurred edges are evaluated at each pixel's own
ray. What stands beside or before it is added in linear light with edges of its own, and the noise last. A spot is a
function of the distance from its centre alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from benchmarks.blur import Array, Blur
from benchmarks.pictures import draw_board, project, random_view

SIZE = (1920, 1080)
_EDGE_PX = 0.6


def coded(light: Array, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Light (H, W, 3) 0..1 as BT.709 values 0..255 with Gaussian ``noise`` (of a coded value)."""
    light = np.clip(light, 0, 1)
    values = 255 * np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    values += noise * rng.standard_normal(values.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(values), 0, 255), dtype=np.uint8)


def draw_square(
    blur: Blur,
    noise: float,
    rng: np.random.Generator,
    *,
    level: float = 1.0,
    uneven: bool = False,
    hidden: bool = False,
    decoys: bool = False,
) -> tuple[NDArray[np.uint8], Array]:
    """A red square in a white margin, about 330 px wide, and its corners (4, 2) row by row.

    ``level`` scales the light, ``uneven`` lets it fall over the picture, ``hidden`` puts a black ball on a corner and
    ``decoys`` other red things into the frame's corners.
    """
    view = random_view((1, 1), rng, size=SIZE, share=0.35)
    corners = project(view, np.array([(0, 0), (1, 0), (0, 1), (1, 1)], dtype=np.float64))
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float64), np.arange(SIZE[1], dtype=np.float64))
    shade = np.full(u.shape, 1.0)
    if uneven:
        shade = 0.3 + 0.5 * u / SIZE[0] + 0.2 * v / SIZE[1]
    if hidden:
        centre = corners[int(rng.integers(4))] + rng.uniform(-10, 10, 2)
        shade = shade * (1 - ndtr((60 - np.hypot(u - centre[0], v - centre[1])) / _EDGE_PX))
    colours = [tuple(level * one for one in colour) for colour in ((0.8, 0.8, 0.8), (0.05, 0.05, 0.6))]
    bright, dark = ((one[0], one[1], one[2]) for one in colours)
    drawn = draw_board(
        (1, 1), view, blur, 0.0 if decoys else noise, rng, bright=bright, dark=dark, surround=0.2 * level, shade=shade
    )
    if not decoys:
        return drawn.picture, corners
    value = drawn.picture / 255.0
    light = np.where(value < 0.081, value / 4.5, ((value + 0.099) / 1.099) ** (1 / 0.45))
    for share, colour in _decoys(u, v):
        light += share[..., None] * (np.array(colour) * level - light)
    return coded(light, noise, rng), corners


def _decoys(u: Array, v: Array) -> list[tuple[Array, tuple[float, float, float]]]:
    """A ball, a bar, a larger dull square and a frame, all reddish, at the picture's left and right."""
    return [
        (ndtr((90 - np.hypot(u - 150, v - 160)) / _EDGE_PX), (0.03, 0.03, 0.65)),
        (_box(u, v, (160, 800), (260, 70), 0.1), (0.04, 0.04, 0.9)),
        (_box(u, v, (1740, 800), (300, 290), 0.2), (0.03, 0.03, 0.2)),
        (
            _box(u, v, (1740, 180), (250, 240), 0.0) - _box(u, v, (1740, 180), (190, 180), 0.0),
            (0.05, 0.05, 0.7),
        ),
    ]


def _box(u: Array, v: Array, centre: tuple[float, float], size: tuple[float, float], turn: float) -> Array:
    x, y = u - centre[0], v - centre[1]
    across, down = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    return np.asarray(ndtr((size[0] / 2 - np.abs(across)) / _EDGE_PX) * ndtr((size[1] / 2 - np.abs(down)) / _EDGE_PX))


def draw_light(
    rng: np.random.Generator,
    *,
    radius_px: float = 6.0,
    sigma_px: float = 0.6,
    power: float = 0.8,
    glow: float = 0.0,
    slope: float = 0.0,
    noise: float = 2.0,
    others: int = 0,
) -> tuple[NDArray[np.uint8], Array]:
    """A round light near the middle of a dark room, and its centre (1, 2).

    A disk of ``radius_px`` and ``power`` (1: where the picture saturates) with an edge blurred by ``sigma_px``;
    ``glow`` is the light of a wide halo about it, ``slope`` how much the background brightens across the picture,
    ``others`` a number of weaker lights.
    """
    width, height = 960, 540
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    centre = np.array([width / 2, height / 2]) + rng.uniform(-60, 60, 2)
    distance = np.hypot(u - centre[0], v - centre[1])
    light = 0.03 + slope * u / width
    light = (
        light + power * ndtr((radius_px - distance) / sigma_px) + glow / (1 + (distance / (2 * radius_px)) ** 2) ** 2
    )
    for _ in range(others):
        place = np.array([rng.uniform(50, 300), rng.uniform(50, height - 50)])
        light = light + 0.3 * power * ndtr((0.7 * radius_px - np.hypot(u - place[0], v - place[1])) / sigma_px)
    return coded(np.repeat(light[..., None], 3, axis=2), noise, rng), centre[None, :]
