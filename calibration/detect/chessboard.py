"""Finding a chessboard to sub-pixel: coarse search for its grid, then a fit of every corner to the pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.detect.prediction import Prediction
from calibration.detect.quality import board_centre, grid_scatter, score, smooth_residual
from calibration.detect.refine import Measured, refine
from calibration.detect.search import Board, cut_too_far, find_board
from calibration.detect.windows import PIXEL_VARIANCE_PX2
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
"""At least this share of the corners that the frame does not cut off must be measured."""
LARGEST_BLUR_SHARE = 0.27
"""A board whose blur (sigma) exceeds this share of a square's side is refused."""


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
    measured = refine(picture, found, transfer)
    if measured is None:
        return Refusal("the board's two colours cannot be told apart")
    return _judged(measured, found, target)


def _judged(measured: Measured, board: Board, target: Target) -> DetectionResult:
    """The detection with the corners that can be trusted, or why there are too few of them."""
    columns, rows = target.grid
    fit, signal = measured.fit, measured.signal
    state = fit.state
    total = columns * rows
    places = np.column_stack([np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)])
    parity = (-1) ** places.sum(axis=1)
    gain = state.gain * -board.polarity * parity
    seen = board.seen.ravel()
    usable = seen & np.isfinite(fit.chi2) & np.isfinite(fit.covariance_px2).all(axis=(1, 2)) & (gain > 0)
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
    if usable.sum() < LEAST_MEASURED * seen.sum():
        return Refusal(
            f"only {int(usable.sum())} of {int(seen.sum())} inner corners could be measured (hidden or too blurred)"
        )
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
