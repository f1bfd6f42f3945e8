"""Finding a chessboard to sub-pixel: coarse search for its grid, then a fit of every corner to the pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from calibration.detect.aliasing import LEAST_SHARE, crossing_covariance, edge_variance, unsmoothed_share
from calibration.detect.corner import (
    PIXEL_VARIANCE_PX2,
    WINDOW_SHARE,
    CornerFit,
    CornerState,
    Signal,
    Windows,
    cut_windows,
    edge_softness,
    fit_corners,
    guess_sigma,
)
from calibration.detect.grid import steps_of
from calibration.detect.prediction import Prediction
from calibration.detect.quality import board_centre, grid_scatter, median_sides, score, smooth_residual
from calibration.detect.search import Board, cut_too_far, find_board
from calibration.detect.signal import measure_signal
from calibration.image import Transfer
from calibration.types import (
    Detection,
    DetectionResult,
    FloatArray,
    Picture,
    Quality,
    Refusal,
    Target,
    TargetKind,
)

LEAST_MEASURED = 0.8
"""At least this share of the corners must be measured."""
LARGEST_BLUR_SHARE = 0.27
"""A board whose blur (sigma) exceeds this share of a square's side is refused."""
_FIRST_HALF_PX = 6
_SECOND_HALF_PX = 28
_BAND_SIGMAS = 3.0
_BAND_PX = 1.5
_SLOPE_SPAN = 5
_SOFTNESS_CORNERS = 16
_GUESS_CORNERS = 12
_FIRST_ITERATIONS = 8
_SECOND_ITERATIONS = 6


def find_chessboard(
    picture: Picture, target: Target, *, transfer: Transfer, near: Prediction | None = None
) -> DetectionResult:
    """The inner corners of ``target`` in ``picture``, or a refusal with its reason.

    Corners that are hidden or cannot be measured are left out (``point_ids`` says which are there) while at least
    ``LEAST_MEASURED`` of them remain.
    """
    columns, rows = target.grid
    found = find_board(picture, (columns, rows), target.colours, near)
    if isinstance(found, str):
        return Refusal(found)
    if near is None and cut_too_far(found, picture):
        return Refusal("the board is cut by the frame at a corner: its size cannot be told; turn it into view")
    signal = measure_signal(picture, found.points_px, found.polarity, transfer)
    if signal is None:
        return Refusal("the board's two colours cannot be told apart")
    measured = _measure(signal, found)
    return _judged(measured, signal, found, target)


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    fit: CornerFit
    start_px: FloatArray
    side_px: NDArray[np.float64]  # (N,) the shorter of a corner's two steps
    aliasing_px2: FloatArray  # (N, 2, 2) what pixels that were never smoothed add to the fit's covariance


def _measure(signal: Signal, board: Board) -> _Measured:
    """Fit all corners twice: roughly from the coarse grid, then in windows that suit the blur and edges bent as the
    grid is.
    """
    shape = (board.points_px.shape[0], board.points_px.shape[1])
    points = board.points_px.reshape(-1, 2)
    steps = steps_of(board.points_px).reshape(-1, 2, 2)
    parity = ((-1) ** np.add.outer(np.arange(shape[0]), np.arange(shape[1]))).ravel()
    count = len(points)
    start = CornerState(
        points_px=points,
        angles=np.arctan2(steps[..., 1], steps[..., 0]),
        sigma_px=np.ones(count),
        offset=np.full(count, 0.5),
        # The quadrant between the two steps lies right of one edge and left of the other: F is negative there.
        gain=-0.5 * board.polarity * parity,
    )
    straight = np.zeros((count, 2))
    side = float(median_sides(steps).min())
    some = np.unique(np.linspace(0, count - 1, min(count, _GUESS_CORNERS)).astype(np.int64))
    half = _half(steps, 24)
    few = CornerState(*(values[some] for values in _parts(start)))
    sigma = guess_sigma(cut_windows(signal, few, steps[some], half, stride_px=1 + half // 9), few, 0.5 * side)
    start = CornerState(points, start.angles, np.full(count, sigma), start.offset, start.gain)
    half = _half(steps, max(_FIRST_HALF_PX, round(2.5 * sigma), round(3 * board.error_px)))
    windows = cut_windows(signal, start, steps, half)
    first = fit_corners(signal, windows, start, straight, iterations=_FIRST_ITERATIONS, tolerance_px=0.05).state

    moved = np.linalg.norm(first.points_px - points, axis=1)
    side_px = np.linalg.norm(steps, axis=2).min(axis=1)
    good = moved < 0.3 * side_px
    sigma = float(np.median(first.sigma_px[good])) if good.any() else sigma
    again = np.where(good[:, None], first.points_px, points)
    second_start = CornerState(
        points_px=again,
        angles=np.where(good[:, None], first.angles, start.angles),
        sigma_px=np.where(good, first.sigma_px, sigma),
        offset=np.where(good, first.offset, start.offset),
        gain=np.where(good, first.gain, start.gain),
    )
    grid = again.reshape(*shape, 2)
    steps = steps_of(grid).reshape(-1, 2, 2)
    half = _half(steps, max(_SECOND_HALF_PX, round(3.5 * sigma)))
    windows = cut_windows(signal, second_start, steps, half, band_px=_BAND_SIGMAS * sigma + _BAND_PX)
    fit = fit_corners(signal, windows, second_start, _curvature(grid), iterations=_SECOND_ITERATIONS)
    return _Measured(fit, points, side_px, _aliasing(windows, fit.state, steps, shape, half))


def _aliasing(
    windows: Windows, state: CornerState, steps_px: FloatArray, shape: tuple[int, int], half_px: int
) -> FloatArray:
    """(N, 2, 2) px^2 by which edges sharper than the pixels may be off alike over a whole window.

    The residuals do not tell: where all pixels of an edge are cut at the same place, the fit is perfect. The slopes
    are the grid's, over a few squares: a corner's own angles follow the pixel's step that is in its window.
    ``shape``: the grid's rows and columns.
    """
    blur_variance = float(np.median(state.sigma_px)) ** 2 - PIXEL_VARIANCE_PX2
    count = len(state.points_px)
    some = np.unique(np.linspace(0, count - 1, min(count, _SOFTNESS_CORNERS)).astype(np.int64))
    few = CornerState(*(values[some] for values in _parts(state)))
    share = unsmoothed_share(edge_softness(windows.of(some), few), blur_variance)
    if share < LEAST_SHARE:
        return np.zeros((count, 2, 2))
    lengths = np.minimum(2 * WINDOW_SHARE * np.linalg.norm(steps_px, axis=2), 2 * half_px)
    smooth = uniform_filter(steps_px.reshape(*shape, 4), (_SLOPE_SPAN, _SLOPE_SPAN, 0), mode="nearest")
    steps = smooth.reshape(-1, 2, 2)
    angles = np.arctan2(steps[..., 1], steps[..., 0])
    return share * crossing_covariance(angles, edge_variance(angles, lengths))


def _parts(state: CornerState) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    return state.points_px, state.angles, state.sigma_px, state.offset, state.gain


def _half(steps_px: FloatArray, largest_px: int) -> int:
    """Half the side of a square of pixels that holds every corner's window, at most ``largest_px``."""
    reach = WINDOW_SHARE * np.abs(steps_px).sum(axis=1).max()
    return int(max(min(np.ceil(reach), largest_px), 3))


def _curvature(grid_px: FloatArray) -> FloatArray:
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


def _judged(measured: _Measured, signal: Signal, board: Board, target: Target) -> DetectionResult:
    """The detection with the corners that can be trusted, or why there are too few of them."""
    columns, rows = target.grid
    fit = measured.fit
    state = fit.state
    total = columns * rows
    places = np.column_stack([np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)])
    parity = (-1) ** places.sum(axis=1)
    gain = state.gain * -board.polarity * parity
    usable = np.isfinite(fit.chi2) & np.isfinite(fit.covariance_px2).all(axis=(1, 2)) & (gain > 0)
    if not usable.any():
        return Refusal("no corner of the board could be fitted to the pixels (too dark, too blurred or too noisy)")
    blur_all = float(np.median(state.sigma_px[usable]))
    side = float(np.median(measured.side_px))
    if blur_all > LARGEST_BLUR_SHARE * side:
        return Refusal(f"too blurred: the blur of {blur_all:.1f} px is too much for squares of {side:.0f} px")
    typical = float(np.median(gain[usable]))
    chi2_typical = float(np.median(fit.chi2[usable]))
    spread = np.sqrt(np.linalg.eigvalsh(np.where(usable[:, None, None], fit.covariance_px2, np.eye(2)))[:, 1])
    moved = np.linalg.norm(state.points_px - measured.start_px, axis=1)
    usable &= (
        (gain > 0.25 * typical)
        & (gain < 3 * typical)
        & (fit.chi2 < 8 * max(chi2_typical, 1.0))
        & (moved < 0.35 * measured.side_px)
        & (spread * np.sqrt(np.maximum(fit.chi2, 1)) < 0.1 * measured.side_px)
        & (state.sigma_px < max(2.5 * blur_all, blur_all + 1))
    )
    usable = _without_strays(usable, places, state.points_px)
    if usable.sum() < LEAST_MEASURED * total:
        return Refusal(f"only {int(usable.sum())} of {total} inner corners could be measured (hidden or too blurred)")
    ids = np.nonzero(usable)[0]
    points = state.points_px[ids]
    covariance = fit.covariance_px2[ids] * np.maximum(fit.chi2[ids], 1.0)[:, None, None] + measured.aliasing_px2[ids]
    blur = float(np.median(np.sqrt(np.maximum(state.sigma_px[ids] ** 2 - PIXEL_VARIANCE_PX2, 0.0))))
    contrast = 2 * typical / float(np.sqrt((signal.variance_dark + signal.variance_bright) / 2))
    scatter, differences = grid_scatter(places[ids], points)
    covariance = covariance + _unexplained(scatter, differences, covariance) * np.eye(2)
    chi2 = float(np.median(fit.chi2[ids]))
    quality = Quality(
        score=score(len(ids) / total, contrast, chi2, blur / side),
        contrast=contrast,
        fit_chi2=chi2,
        grid_rms_px=scatter,
    )
    return Detection(
        kind=TargetKind.CHESSBOARD,
        points_px=points,
        point_ids=ids.astype(np.int64),
        covariance_px2=covariance,
        centre_px=board_centre(places[ids], points, (columns, rows)),
        blur_px=blur,
        quality=quality,
    )


def _unexplained(scatter_px: float, differences: int, covariance_px2: FloatArray) -> float:
    """Variance (px^2 a coordinate) by which the points scatter more than their covariances say, 0 where not sure."""
    if differences == 0:
        return 0.0
    said = float(np.einsum("nii->n", covariance_px2).mean() / 2)
    # Neighbouring differences share points: about a quarter of them count as independent.
    surely = 1 + 2 * np.sqrt(2 / max(differences / 4, 1))
    return scatter_px**2 - said if scatter_px**2 > surely * said else 0.0


def _without_strays(usable: NDArray[np.bool_], places: NDArray[np.int64], points_px: FloatArray) -> NDArray[np.bool_]:
    """``usable`` without the corners far from a smooth grid through the others: their fit took another edge."""
    usable = usable.copy()
    for _ in range(3):
        residual = np.linalg.norm(smooth_residual(places[usable], points_px[usable]), axis=1)
        if not len(residual):
            break
        limit = max(8 * float(np.median(residual)), 0.3)
        stray = residual > limit
        if not stray.any():
            break
        worst = np.nonzero(usable)[0][residual >= max(limit, 0.7 * float(residual.max()))]
        usable[worst] = False
    return usable
