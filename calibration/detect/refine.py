"""From the coarse grid to corners at the noise limit: rough on the reduced picture, the blur on a few, then all once.

A Gauss-Newton step from a start that is off by a small part of the blur is as good as the minimum itself (one-step
estimator; van der Vaart, Asymptotic Statistics, 5.7). So all pixels are looked at about once: the start comes from a
fit on the picture of the coarse search, which has few pixels, and the blur from a full fit of some of the corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from calibration.detect.aliasing import LEAST_SHARE, crossing_covariance, edge_variance, unsmoothed_share
from calibration.detect.corner import CornerFit, edge_softness, explained, fit_corners, shifted
from calibration.detect.grid import steps_of
from calibration.detect.quality import median_sides
from calibration.detect.search import Board
from calibration.detect.signal import BoardLight, measure_signal
from calibration.detect.windows import (
    PIXEL_VARIANCE_PX2,
    WINDOW_SHARE,
    CornerState,
    Plane,
    Signal,
    Windows,
    from_plane,
    strip_windows,
    to_plane,
)
from calibration.image import Transfer
from calibration.types import FloatArray, Picture

_GUESSED_SIGMAS = (0.5, 1.0, 2.0, 4.0)
_FEW = 9
_ROUGH_HALF = 5
_ROUGH_ITERATIONS = 8
_FEW_ITERATIONS = 8
_LAST_ITERATIONS = 6
_HALF_PX = 16
_HALF_SIGMAS = 8
_FEW_HALF_PX = 12
_BAND_SIGMAS = 3.0
_STEP_SHARE = 0.06
"""A step of this share of the blur leaves an error of about its square: 0.4 % of the blur."""
_REDUCED_FROM_SIGMA_PX = ((10.0, 8), (4.5, 4), (2.2, 2))
"""Blur from which on the picture is reduced: the larger pixel's box widens the blur by less than 3 %."""
_KINDS = (1.0, 0.6, 0.3, 0.12, 0.0)
_KIND_FROM_SIGMA_PX = 1.2
_SMALLEST_SIDE = 8.0
_SLOPE_SPAN = 5


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """All corners' ``fit`` in the picture's pixels, ``start_px`` (N, 2) where the coarse search saw them, ``side_px``
    (N,) the shorter of a corner's two steps, ``aliasing_px2`` (N, 2, 2) what pixels that were never smoothed add to the
    fit's covariance, and the board's ``signal``.
    """

    fit: CornerFit
    start_px: FloatArray
    side_px: NDArray[np.float64]
    aliasing_px2: FloatArray
    signal: Signal


def refine(picture: Picture, board: Board, transfer: Transfer) -> Measured | None:
    """Fit all corners of a board; None where its two colours cannot be told apart."""
    shape = (board.points_px.shape[0], board.points_px.shape[1])
    points = board.points_px.reshape(-1, 2)
    steps = steps_of(board.points_px).reshape(-1, 2, 2)
    # The quadrant between the two steps lies right of one edge and left of the other: F is negative there.
    sign = -board.polarity * ((-1.0) ** np.add.outer(np.arange(shape[0]), np.arange(shape[1]))).ravel()
    rough = _rough(board, points, steps, sign)
    side_px = np.linalg.norm(steps, axis=2).min(axis=1)
    good = (np.linalg.norm(rough.points_px - points, axis=1) < 0.3 * side_px) & (rough.gain * sign > 0)
    sigma = float(np.median(rough.sigma_px[good])) if good.any() else float(np.median(rough.sigma_px))
    grid = np.where(good[:, None], rough.points_px, points).reshape(*shape, 2)
    light = measure_signal(picture, grid, board.polarity, transfer)
    if light is None:
        return None
    steps = steps_of(grid).reshape(-1, 2, 2)
    start = CornerState(
        points_px=grid.reshape(-1, 2),
        angles=np.arctan2(steps[..., 1], steps[..., 0]),
        sigma_px=np.full(len(points), sigma),
        offset=light.offset,
        gain=sign * light.gain,
    )
    curvature = grid_curvature(grid)
    side = float(median_sides(steps).min())
    sigma = _blur_of_a_few(light, start, steps, curvature, good, sigma)
    factor = next((one for least, one in _REDUCED_FROM_SIGMA_PX if sigma > least and side / one > _SMALLEST_SIDE), 1)
    start = CornerState(start.points_px, start.angles, np.full(len(points), sigma), start.offset, start.gain)
    half_px = max(_HALF_PX, round(_HALF_SIGMAS * sigma))
    plane: Plane = light.signal
    if factor > 1:
        reach = half_px + factor
        plane = light.signal.reduced(factor, points.min(axis=0) - reach, points.max(axis=0) + reach)
    kind = _kind_of_blur(plane, light, start, steps, curvature, half_px, good)
    fit, windows = _fit(plane, light, start, steps, curvature, half_px, kind, _LAST_ITERATIONS)
    # The bend was taken from the rough grid: what the fine one says more moves each edge by as much.
    found = np.where(np.isfinite(fit.chi2)[:, None], fit.state.points_px, start.points_px)
    change = grid_curvature(found.reshape(*shape, 2)) - curvature
    fit.state.points_px[:] += shifted(fit.state.angles, -change * fit.bend_px2)
    aliasing = np.zeros((len(points), 2, 2))
    if factor == 1:
        aliasing = _aliasing(windows, fit.state, steps, shape, half_px)
    return Measured(fit, points, side_px, aliasing, light.signal)


def _some(count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, _FEW)).astype(np.int64))


def _rough(board: Board, points: FloatArray, steps: FloatArray, sign: FloatArray) -> CornerState:
    """All corners fitted on the picture in which the board was found, in coded values."""
    plane = board.plane
    pixel = plane.pixel_px
    count = len(points)
    angles = np.arctan2(steps[..., 1], steps[..., 0])
    side = float(median_sides(steps).min()) / pixel
    one = np.ones(count)
    start = to_plane(plane, CornerState(points, angles, pixel * one, 0 * one, sign))
    some = _some(count)
    few = start.of(some)
    best, best_share = _GUESSED_SIGMAS[0], -np.inf
    error = board.error_px / pixel
    for sigma in _GUESSED_SIGMAS:
        if sigma > max(0.5 * side, _GUESSED_SIGMAS[0]):
            break
        few = CornerState(few.points_px, few.angles, np.full(len(some), sigma), few.offset, few.gain)
        windows = strip_windows(plane, few, steps[some] / pixel, 0.5 * side, 0.2 * side)
        share = float(np.median(explained(windows, few)[0]))
        if share > best_share:
            best, best_share = sigma, share
    start = CornerState(start.points_px, angles, np.full(count, best), start.offset, start.gain)
    half, band = max(_ROUGH_HALF, 2.5 * best), 2 * best + 0.5 + error
    windows = strip_windows(plane, start, steps / pixel, half, band)
    _, offset, gain = explained(windows, start)
    start = CornerState(start.points_px, angles, start.sigma_px, offset, gain)
    fit = fit_corners(windows, start, None, iterations=_ROUGH_ITERATIONS, tolerance_px=0.15, loose=4.0)
    return from_plane(plane, fit.state)


def _blur_of_a_few(
    light: BoardLight,
    start: CornerState,
    steps: FloatArray,
    curvature: FloatArray,
    good: NDArray[np.bool_],
    sigma: float,
) -> float:
    """The blur (px) of some of the corners in the picture itself: a reduced picture hardly shows a small one."""
    if sigma > _REDUCED_FROM_SIGMA_PX[-1][0] * 1.2 or not good.any():
        return sigma
    known = np.nonzero(good)[0]
    some = known[_some(len(known))]
    few = start.of(some)
    few = CornerState(few.points_px, few.angles, np.clip(few.sigma_px, 0.7, 1.5), few.offset, few.gain)
    windows = strip_windows(
        light.signal, few, steps[some], _FEW_HALF_PX, _BAND_SIGMAS * max(float(few.sigma_px[0]), sigma)
    )
    fit = fit_corners(windows, few, curvature[some], iterations=_FEW_ITERATIONS, tolerance_px=0.05)
    fine = np.isfinite(fit.chi2)
    return float(np.median(fit.state.sigma_px[fine])) if fine.any() else sigma


def _kind_of_blur(
    plane: Plane,
    light: BoardLight,
    start: CornerState,
    steps: FloatArray,
    curvature: FloatArray,
    half_px: float,
    good: NDArray[np.bool_],
) -> float:
    """The Gaussian's share of the optics' variance that makes some corners' pixels likeliest: 1 a Gaussian, 0 a disk.

    A blur below a pixel or so shows no kind.
    """
    if start.sigma_px[0] < _KIND_FROM_SIGMA_PX or not good.any():
        return 1.0
    known = np.nonzero(good)[0]
    some = known[_some(len(known))]
    part = BoardLight(light.signal, light.offset[some], light.gain[some], light.per_step[some])
    inner, windows = _looked_at(plane, part, start.of(some), steps[some], half_px)
    best, best_cost = 1.0, np.inf
    for kind in _KINDS:
        fit = fit_corners(
            windows,
            inner,
            curvature[some] * plane.pixel_px,
            iterations=_FEW_ITERATIONS,
            gaussian_share=_gaussian_share(kind, inner),
            tolerance_px=_STEP_SHARE * float(inner.sigma_px[0]),
        )
        # The median: one corner that is hidden decides nothing.
        cost = float(np.nanmedian(fit.chi2)) if np.isfinite(fit.chi2).any() else np.inf
        if not cost < best_cost:
            break
        best, best_cost, inner = kind, cost, fit.state
    return best


def _gaussian_share(kind: float, inner: CornerState) -> float:
    """Of the whole blur's variance, the box of a pixel counted as a Gaussian; ``kind`` is that of the optics."""
    box = min(PIXEL_VARIANCE_PX2 / float(np.median(inner.sigma_px)) ** 2, 1.0)
    return box + kind * (1 - box)


def _looked_at(
    plane: Plane, light: BoardLight, start: CornerState, steps: FloatArray, half_px: float
) -> tuple[CornerState, Windows]:
    """``start`` and its strips in the plane's pixels, the fall of the light taken off."""
    pixel = plane.pixel_px
    inner = to_plane(plane, start)
    shading = light.shading(steps)
    # A change of a thousandth over the window is not worth the time.
    flat = np.abs(shading.gain_per_px).max() * half_px < 2e-3
    band = _BAND_SIGMAS * float(inner.sigma_px[0]) + (0.0 if pixel == 1 else 0.5)
    return inner, strip_windows(plane, inner, steps / pixel, half_px / pixel, band, None if flat else shading)


def _fit(
    plane: Plane,
    light: BoardLight,
    start: CornerState,
    steps: FloatArray,
    curvature: FloatArray,
    half_px: float,
    kind: float,
    iterations: int,
) -> tuple[CornerFit, Windows]:
    pixel = plane.pixel_px
    inner, windows = _looked_at(plane, light, start, steps, half_px)
    fit = fit_corners(
        windows,
        inner,
        curvature * pixel,
        iterations=iterations,
        gaussian_share=_gaussian_share(kind, inner),
        tolerance_px=_STEP_SHARE * float(inner.sigma_px[0]),
    )
    return (
        CornerFit(
            from_plane(plane, fit.state), fit.covariance_px2 * pixel**2, fit.chi2, fit.pixels, fit.bend_px2 * pixel**2
        ),
        windows,
    )


def _aliasing(
    windows: Windows, state: CornerState, steps_px: FloatArray, shape: tuple[int, int], half_px: float
) -> FloatArray:
    """(N, 2, 2) px^2 by which edges sharper than the pixels may be off alike over a whole window.

    The residuals do not tell: where all pixels of an edge are cut at the same place, the fit is perfect. The slopes
    are the grid's, over a few squares: a corner's own angles follow the pixel's step that is in its window.
    ``shape``: the grid's rows and columns.
    """
    blur_variance = float(np.median(state.sigma_px)) ** 2 - PIXEL_VARIANCE_PX2
    count = len(state.points_px)
    if unsmoothed_share(0.0, blur_variance) < LEAST_SHARE:
        return np.zeros((count, 2, 2))
    some = _some(count)
    share = unsmoothed_share(edge_softness(windows.of(some), state.of(some)), blur_variance)
    if share < LEAST_SHARE:
        return np.zeros((count, 2, 2))
    lengths = np.minimum(2 * WINDOW_SHARE * np.linalg.norm(steps_px, axis=2), 2 * half_px)
    smooth = uniform_filter(steps_px.reshape(*shape, 4), (_SLOPE_SPAN, _SLOPE_SPAN, 0), mode="nearest")
    steps = smooth.reshape(-1, 2, 2)
    angles = np.arctan2(steps[..., 1], steps[..., 0])
    return share * crossing_covariance(angles, edge_variance(angles, lengths))


def grid_curvature(grid_px: FloatArray) -> FloatArray:
    """(N, 2) 1/px: how the grid's lines bend at each point, along columns and along rows, from second differences.

    A line's ends take the value of the point beside them; positive bends towards the edge's normal (-sin, cos).
    """
    bends = np.zeros(grid_px.shape)
    for which, axis in ((0, 1), (1, 0)):
        line = np.moveaxis(grid_px, axis, 0)
        if len(line) < 3:
            continue
        second = line[2:] - 2 * line[1:-1] + line[:-2]
        along = (line[2:] - line[:-2]) / 2
        length = np.linalg.norm(along, axis=-1)
        bend = (along[..., 0] * second[..., 1] - along[..., 1] * second[..., 0]) / length**3
        bend = np.concatenate([bend[:1], bend, bend[-1:]])
        bends[..., which] = np.moveaxis(bend, 0, axis)
    return bends.reshape(-1, 2)
