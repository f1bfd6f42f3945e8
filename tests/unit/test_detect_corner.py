"""The corner fit against corners drawn here: error near the Cramer-Rao bound, and a covariance that tells the truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from benchmarks.blur import Blur, Disk, Gaussian
from benchmarks.pictures import draw_board, random_view
from calibration.detect.corner import CornerFit, explained, fit_corners
from calibration.detect.kernel import kernel_for
from calibration.detect.target import find_target
from calibration.detect.windows import PIXEL_VARIANCE_PX2, CornerState, Signal, strip_windows
from calibration.types import Detection, FloatArray, Picture, Target, TargetKind

STEP_PX = 40
CODES = (40.0, 200.0)


def draw_corners(
    count: int,
    blur_px: float,
    noise: float,
    rng: np.random.Generator,
    bend_per_px: float = 0.0,
    cross_deg: float = 90.0,
) -> tuple[Picture, FloatArray, FloatArray]:
    """A row of separate corners, each pixel the mean of the blurred light over its area (3 x 3 Gauss-Legendre points).

    Returns the picture, the corners (N, 2) and the directions (N, 2) of their edges.
    """
    half = STEP_PX
    truth = np.column_stack([half + 2 * half * np.arange(count), np.full(count, half)]) + rng.uniform(
        -0.5, 0.5, (count, 2)
    )
    first = rng.uniform(-0.4, 0.4, count)
    angles = np.column_stack([first, first + np.deg2rad(cross_deg)])
    nodes, weights = np.polynomial.legendre.leggauss(3)
    light = np.zeros((2 * half + 1, 2 * half * count + 1))
    v, u = np.mgrid[0 : light.shape[0], 0 : light.shape[1]].astype(np.float64)
    which = np.minimum(u.astype(np.int64) // (2 * half), count - 1)
    for du, wu in zip(nodes / 2, weights / 2, strict=True):
        for dv, wv in zip(nodes / 2, weights / 2, strict=True):
            x, y = u + du - truth[which, 0], v + dv - truth[which, 1]
            part = np.ones_like(x)
            for edge in (0, 1):
                cos, sin = np.cos(angles[which, edge]), np.sin(angles[which, edge])
                along, across = cos * x + sin * y, cos * y - sin * x
                part *= erf((across - bend_per_px / 2 * along**2) / (np.sqrt(2) * blur_px))
            light += wu * wv * part
    coded = (CODES[0] + CODES[1]) / 2 + (CODES[1] - CODES[0]) / 2 * light
    coded = np.clip(np.rint(coded + rng.normal(0, noise, coded.shape)), 0, 255)
    return np.repeat(coded.astype(np.uint8)[:, :, None], 3, axis=2), truth, angles


def linear_signal(picture: Picture, noise: float) -> Signal:
    """Coded values taken as light, the first channel only, with the noise that was drawn (and its rounding)."""
    tables = np.zeros((3, 256), dtype=np.float32)
    tables[0] = (np.arange(256) - CODES[0]) / (CODES[1] - CODES[0])
    variance = (noise**2 + 1 / 12) / (CODES[1] - CODES[0]) ** 2
    return Signal(picture, tables, variance, variance)


def fit(
    picture: Picture, truth: FloatArray, angles: FloatArray, noise: float, rng: np.random.Generator, bend: float = 0.0
) -> CornerFit:
    count = len(truth)
    signal = linear_signal(picture, noise)
    steps = STEP_PX * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    start = CornerState(
        points_px=truth + rng.uniform(-1.0, 1.0, truth.shape),
        angles=angles + rng.uniform(-0.05, 0.05, angles.shape),
        sigma_px=np.ones(count),
        offset=np.full(count, 0.5),
        gain=np.full(count, 0.5),
    )
    shares = {}
    for sigma in (0.7, 1.4, 2.8, 5.6):
        start = CornerState(start.points_px, start.angles, np.full(count, sigma), start.offset, start.gain)
        windows = strip_windows(signal, start, steps, 16, 8.0)
        shares[float(np.median(explained(windows, start)[0]))] = sigma
    sigma = shares[max(shares)]
    start = CornerState(start.points_px, start.angles, np.full(count, sigma), start.offset, start.gain)
    windows = strip_windows(signal, start, steps, 16, 3 * sigma + 2)
    return fit_corners(windows, start, np.full((count, 2), bend), iterations=15)


@pytest.mark.parametrize(("blur", "noise"), [(0.7, 2.0), (1.0, 2.0), (3.0, 2.0), (5.0, 2.0), (1.0, 8.0)])
def test_error_is_what_the_covariance_says(blur: float, noise: float) -> None:
    rng = np.random.default_rng(20261122)
    picture, truth, angles = draw_corners(80, blur, noise, rng)
    result = fit(picture, truth, angles, noise, rng)
    error = result.state.points_px - truth
    predicted = np.sqrt(np.einsum("nii->n", result.covariance_px2).mean() / 2)
    assert np.sqrt((error**2).mean()) < 1.3 * predicted
    nees = np.mean([e @ np.linalg.solve(c, e) / 2 for e, c in zip(error, result.covariance_px2, strict=True)])
    assert 0.7 < nees < 1.4
    assert np.median(result.chi2) == pytest.approx(1.0, abs=0.12)
    blur_found = np.sqrt(np.median(result.state.sigma_px) ** 2 - PIXEL_VARIANCE_PX2)
    assert blur_found == pytest.approx(blur, rel=0.03)


def test_one_pixel_of_blur_reaches_the_marked_accuracy() -> None:
    rng = np.random.default_rng(7)
    picture, truth, angles = draw_corners(60, 1.0, 2.0, rng)
    error = fit(picture, truth, angles, 2.0, rng).state.points_px - truth
    assert np.sqrt((error**2).mean()) < 0.009


def test_bent_edges_move_the_corner_unless_the_bend_is_known() -> None:
    bend = 2e-3
    rng = np.random.default_rng(3)
    picture, truth, angles = draw_corners(30, 1.0, 0.5, rng, bend_per_px=bend)
    known = np.abs((fit(picture, truth, angles, 0.5, rng, bend).state.points_px - truth).mean(axis=0)).max()
    ignored = np.abs((fit(picture, truth, angles, 0.5, rng).state.points_px - truth).mean(axis=0)).max()
    assert known < 0.004
    assert ignored > 0.02


def test_skewed_crossing_is_not_biased() -> None:
    rng = np.random.default_rng(5)
    picture, truth, angles = draw_corners(40, 2.0, 1.0, rng, cross_deg=60.0)
    error = fit(picture, truth, angles, 1.0, rng).state.points_px - truth
    assert np.abs(error.mean(axis=0)).max() < 0.004


def test_pixels_far_from_the_edges_are_not_needed() -> None:
    rng = np.random.default_rng(11)
    picture, truth, angles = draw_corners(20, 1.0, 2.0, rng)
    signal = linear_signal(picture, 2.0)
    ones = np.ones(len(truth))
    start = CornerState(truth, angles, 1.05 * ones, 0.5 * ones, 0.5 * ones)
    steps = STEP_PX * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    every = strip_windows(signal, start, steps, 20, 20)
    band = strip_windows(signal, start, steps, 20, 3.2)
    assert band.used.sum() < 0.6 * every.used.sum()
    full = fit_corners(every, start, None, iterations=5)
    thin = fit_corners(band, start, None, iterations=5)
    ratio = thin.covariance_px2[:, 0, 0] / full.covariance_px2[:, 0, 0]
    assert ratio.max() < 1.05


def test_a_flat_window_is_reported_not_invented() -> None:
    picture = np.full((81, 81, 3), 120, dtype=np.uint8)
    signal = linear_signal(picture, 2.0)
    one = np.ones(1)
    start = CornerState(np.array([[40.0, 40.0]]), np.array([[0.0, np.pi / 2]]), one, 0.5 * one, 0.5 * one)
    steps = np.array([[[40.0, 0.0], [0.0, 40.0]]])
    windows = strip_windows(signal, start, steps, 12, 4.0)
    result = fit_corners(windows, start, None, iterations=10)
    sure = np.isfinite(result.covariance_px2).all() and np.sqrt(result.covariance_px2[0, 0, 0]) < 0.5
    assert not sure or abs(result.state.gain[0]) < 0.02


@pytest.mark.parametrize("blur", [Disk(4.0), Disk(9.0), Gaussian(4.0)])
def test_a_defocus_disk_is_told_from_a_gaussian_by_its_pixels(blur: Blur) -> None:
    rng = np.random.default_rng(17)
    drawn = draw_board((8, 8), random_view((8, 8), rng, size=(960, 720)), blur, 2.0, rng)
    target = Target(TargetKind.CHESSBOARD, squares=(8, 8), square_m=0.05, colours=("red", "white"))
    result = find_target(drawn.picture, target)
    assert isinstance(result, Detection), result
    error = result.points_px - drawn.corners
    nees = np.mean([e @ np.linalg.solve(c, e) / 2 for e, c in zip(error, result.covariance_px2, strict=True)])
    assert nees < 1.5
    # With the wrong kind of blur it is 5 and more.
    assert 0.8 < result.quality.fit_chi2 < 1.4
    assert np.sqrt((error**2).mean()) < 0.012


@pytest.mark.parametrize("cosine", [0.0, 0.27])
@pytest.mark.parametrize("share", [1.0, 0.02])
def test_tables_are_the_blurs_in_closed_form(share: float, cosine: float) -> None:
    kernel = kernel_for(share, np.array([[0.0, np.arccos(cosine)]]))
    a1, a2 = np.random.default_rng(3).uniform(-3, 3, (2, 1, 400))
    value = kernel.at(a1.astype(np.float32), a2.astype(np.float32))[0]
    found = value[:, 0] + (cosine - kernel.cosine) * value[:, 3]
    blur = Gaussian(np.sqrt(1 - PIXEL_VARIANCE_PX2)) if share == 1 else Disk(2.0)
    exact = blur.profile(a1) * blur.profile(a2) + blur.crossing(a1, a2, np.array(cosine))
    # What the disk's edge has of a Gaussian here rounds its profile's ends.
    assert np.abs(found - exact[0]).max() < (1e-3 if share == 1 else 0.03)
