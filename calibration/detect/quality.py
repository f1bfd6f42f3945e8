"""How well a measured grid hangs together: its distance from a smooth grid, its centre, its score."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.types import FloatArray, IntArray

_SMOOTH_DEGREE = 5
_SCORE_CONTRAST = 20.0
"""Contrast over noise from which on more contrast no longer raises the score."""


def fit_homography(source: FloatArray, image: FloatArray) -> FloatArray:
    """The 3 x 3 homography that maps ``source`` (N, 2) to ``image`` (N, 2), N >= 4: normalised direct linear transform.

    Hartley and Zisserman, Multiple View Geometry, algorithm 4.2.
    """
    source_n, source_t = _normalised(source)
    image_n, image_t = _normalised(image)
    x, y = source_n.T
    u, v = image_n.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    system = np.concatenate([
        np.column_stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u]),
        np.column_stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v]),
    ])  # fmt: skip
    inner = np.linalg.svd(system)[2][-1].reshape(3, 3)
    return np.asarray(np.linalg.inv(image_t) @ inner @ source_t, dtype=np.float64)


def apply_homography(homography: FloatArray, points: FloatArray) -> FloatArray:
    """``points`` (N, 2) mapped, (N, 2)."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:], dtype=np.float64)


def _normalised(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    mean = points.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.sqrt(((points - mean) ** 2).sum(axis=1)).mean()), 1e-12)
    transform = np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1.0]])
    return (points - mean) * scale, transform


def smooth_residual(places: IntArray, points_px: FloatArray) -> FloatArray:
    """(N, 2) px: ``points_px`` minus a smooth grid through them (homography, then a polynomial in column and row).

    ``places`` (N, 2) are (column, row). Zero where there are too few points to tell; scaled up for the freedom used.
    """
    kinds = [len(np.unique(places[:, axis])) for axis in (0, 1)]
    count = len(points_px)
    for degree in range(_SMOOTH_DEGREE, 0, -1):
        powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i < kinds[0] and j < kinds[1]]
        if count >= 1.5 * len(powers) + 4:
            break
    else:
        return np.zeros_like(points_px)
    grid = places.astype(np.float64)
    grid = (grid - grid.mean(axis=0)) / np.maximum(np.ptp(grid, axis=0) / 2, 1)
    rest = points_px - apply_homography(fit_homography(grid, points_px), grid)
    basis = np.column_stack([grid[:, 0] ** i * grid[:, 1] ** j for i, j in powers])
    residual = rest - basis @ np.linalg.lstsq(basis, rest, rcond=None)[0]
    return np.asarray(residual * np.sqrt(count / (count - len(powers))), dtype=np.float64)


def grid_scatter(places: IntArray, points_px: FloatArray) -> tuple[float, int]:
    """(sigma px per coordinate, number of differences) of the points about smooth lines, from the points alone.

    Fourth differences along rows and columns, after a homography is taken off, pass no cubic, and multiply a variance
    by 70 (third ones, on short lines: by 20). The scatter includes what no fit residual shows: errors that are alike
    over a corner's window. NaN and 0 where no line is long enough.
    """
    size = places.max(axis=0) + 1
    if len(points_px) < 8 or max(size) < 4 or min(np.ptp(places, axis=0)) < 1:
        return float("nan"), 0
    flat = places.astype(np.float64)
    grid = np.full((size[1], size[0], 2), np.nan)
    grid[places[:, 1], places[:, 0]] = points_px - apply_homography(fit_homography(flat, points_px), flat)
    squares: list[FloatArray] = []
    for axis in (0, 1):
        order = min(4, grid.shape[axis] - 1)
        if order >= 3:
            difference = np.diff(grid, order, axis=axis).ravel()
            squares.append(difference[np.isfinite(difference)] ** 2 / (70.0 if order == 4 else 20.0))
    found = np.concatenate(squares) if squares else np.zeros(0)
    if not len(found):
        return float("nan"), 0
    limit = 9 * float(np.median(found)) / 0.455  # the median of a chi-squared variable with one degree of freedom
    return float(np.sqrt(np.minimum(found, limit).mean())), len(found)


def board_centre(places: IntArray, points_px: FloatArray, grid: tuple[int, int]) -> FloatArray:
    """Where the board's centre is seen, (2,) px: the homography of the points nearest to it, so that a lens' bend
    over the whole board does not move it. ``grid`` = (columns, rows) of inner corners.
    """
    middle = (np.array(grid, dtype=np.float64) - 1) / 2
    offset = places - middle
    exact = np.nonzero((np.abs(offset) < 1e-9).all(axis=1))[0]
    if len(exact):
        return np.asarray(points_px[exact[0]], dtype=np.float64)
    reach = 1.6
    while True:
        near = (np.abs(offset) <= reach).all(axis=1)
        kinds = [len(np.unique(places[near, axis])) for axis in (0, 1)]
        if (near.sum() >= 6 and min(kinds) >= 2) or near.all():
            break
        reach += 1.0
    homography = fit_homography(offset[near], points_px[near])
    return apply_homography(homography, np.zeros((1, 2))).ravel()


def score(present: float, contrast: float, chi2: float, blur_share: float) -> float:
    """0..1 from the share of corners ``present``, contrast over noise, fit chi2 and blur over the side of a square."""
    contrast_part = min(contrast / _SCORE_CONTRAST, 1.0)
    fit_part = 1 / (1 + 0.1 * np.log(max(chi2, 1.0)))
    blur_part = 1 / (1 + (blur_share / 0.25) ** 2)
    return float(np.clip(present * contrast_part * fit_part * blur_part, 0.0, 1.0))


def median_sides(steps_px: FloatArray) -> NDArray[np.float64]:
    """(2,) median length of a grid's steps along columns and along rows, px."""
    lengths = np.linalg.norm(steps_px.reshape(-1, 2, 2), axis=2)
    known = np.isfinite(lengths)
    return np.array([np.median(lengths[known[:, axis], axis]) if known[:, axis].any() else np.nan for axis in (0, 1)])
