"""The centre of a round spot of light of any profile, by maximum likelihood.

In linear light and for each colour channel k, about the centre c,

    L_k(p) = f_k(|p - c|) + g_k . (p - c),

with f_k any smooth profile (a spline in the radius: core, blur, halo and the level of the room in one) and g_k the
gradient of what lies behind. Pixels near saturation are censored: they only say "at least this much", which a free
profile meets at no cost, so they are left out, chosen by the model and not by their own noise. Profile and gradient are
eliminated (variable projection); c is found by Gauss-Newton. A profile is even about c and a shift is odd, so
that leaving the profile free costs the centre nothing: the Cramer-Rao bound is that of a known profile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.image import Transfer, light_table
from calibration.types import FloatArray

_KNOT_PX, _FINE_PX = 0.7, 4.0
"""Knots of the profile about the spot's edge; from ``_FINE_PX`` off the edge their distance grows in proportion."""
_MOST_PIXELS = 4000
_SATURATED = 254.5
_NEAR_SATURATED_SIGMAS = 2.5
_STEPS = 8
_QUANTISATION = 1 / math.sqrt(12)
_ROBUST_SIGMAS = 5.0
_LEAST_FREE_PIXELS = 12


@dataclass(frozen=True, slots=True, eq=False)
class SpotCentre:
    """``place`` (2,) px, its ``covariance`` (2, 2) px^2; ``excess`` (>= 1): variance seen over that of white noise."""

    place: FloatArray
    covariance: FloatArray
    excess: float


class _Projection:
    """Weighted least squares on a basis (N, K) that is used for several right-hand sides."""

    def __init__(self, basis: FloatArray, weight: FloatArray) -> None:
        self._basis = basis
        self._weighted = basis * weight[:, None]
        normal = self._weighted.T @ basis
        normal[np.diag_indices_from(normal)] += 1e-9 * np.trace(normal) / len(normal) + 1e-12
        self._inverse = np.linalg.inv(normal)

    def coefficients(self, values: FloatArray) -> FloatArray:
        return np.asarray(self._inverse @ (self._weighted.T @ values), dtype=np.float64)

    def without(self, values: FloatArray) -> FloatArray:
        """What the basis leaves of the values (N, M)."""
        return np.asarray(values - self._basis @ self.coefficients(values), dtype=np.float64)


def fit_centre(
    coded: NDArray[np.uint8], start: tuple[float, float], *, radius_px: float, reach_px: float, transfer: Transfer
) -> SpotCentre | None:
    """Fit a spot in a part of a picture (H, W, 3), from a rough centre (u, v) and the radius of its edge.

    Pixels up to ``reach_px`` from the start take part. None where too few pixels below saturation are left or the
    fit does not settle within ``radius_px`` of its start.
    """
    height, width = coded.shape[:2]
    v, u = np.mgrid[:height, :width]
    near = np.hypot(u - start[0], v - start[1]) <= reach_px
    stride = math.ceil(math.sqrt(max(1.0, np.count_nonzero(near) / _MOST_PIXELS)))
    # Large spots: all that tells the place is at the edge, the rest only carries the profile.
    edge = np.abs(np.hypot(u - start[0], v - start[1]) - radius_px) < 1.5 * _FINE_PX
    near &= edge | ((u % stride == 0) & (v % stride == 0))
    u, v = u[near].astype(np.float64), v[near].astype(np.float64)
    values = coded[near].astype(np.float64)
    table = light_table(transfer).astype(np.float64)
    gain = np.gradient(table)
    light = table[coded[near]]
    centre = np.array(start, dtype=np.float64)
    model, noise = light.copy(), np.full(3, 2.0)
    trust = np.ones_like(light)
    hessian, scores = np.eye(2), np.zeros((len(u), 2))
    for step in range(_STEPS):
        du, dv = u - centre[0], v - centre[1]
        radius = np.maximum(np.hypot(du, dv), 1e-6)
        spline, slope = _profile_basis(radius, radius_px, reach_px)
        basis = np.column_stack([spline, du / reach_px, dv / reach_px])
        direction = np.stack([du / radius, dv / radius], axis=1)
        hessian, pull = np.zeros((2, 2)), np.zeros(2)
        scores = np.zeros((len(u), 2))
        freed = 0
        for k in range(3):
            level = np.interp(model[:, k], table, np.arange(256.0))
            clear = level < _SATURATED - _NEAR_SATURATED_SIGMAS * noise[k]
            if step == 0:
                clear = values[:, k] < 250
            if np.count_nonzero(clear) < _LEAST_FREE_PIXELS:
                continue
            freed += 1
            scale = np.interp(model[:, k], table, gain) * noise[k]
            weight = clear * trust[:, k] / scale**2
            projection = _Projection(basis, weight)
            coefficients = projection.coefficients(light[:, k])
            fitted = basis @ coefficients
            rest = light[:, k] - fitted
            fall = slope @ coefficients[: slope.shape[1]]
            moves = projection.without(-fall[:, None] * direction)
            hessian += moves.T @ (moves * weight[:, None])
            score = moves * (weight * rest)[:, None]
            pull += score.sum(axis=0)
            scores += score
            count = np.count_nonzero(clear)
            off = rest / np.interp(fitted, table, gain)
            spread = 1.4826 * float(np.median(np.abs(off[clear]))) * math.sqrt(count / max(count - basis.shape[1], 1))
            noise[k] = max(spread, _QUANTISATION)
            if step >= 2:
                trust[:, k] = 1 / (1 + (off / (_ROBUST_SIGMAS * noise[k])) ** 4)
            # Where every pixel is saturated the profile is free: it stays at what saturates.
            inner = radius < (float(radius[clear].min()) if clear.any() else 0.0)
            model[:, k] = np.where(inner, table[-1], np.clip(fitted, 0.0, table[-1]))
        if not freed or not np.isfinite(hessian).all() or np.linalg.cond(hessian) > 1e8:
            return None
        moved = np.linalg.solve(hessian, pull)
        centre = centre + moved * min(1.0, 1.0 / max(float(np.hypot(*moved)), 1e-12))
        if math.dist(centre, start) > max(1.0, radius_px):
            return None
        if step >= 3 and float(np.hypot(*moved)) < 1e-3:
            break
    inverse = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    excess = _excess(scores, inverse, u, v, max(3.0, radius_px / 2))
    return SpotCentre(centre, inverse * excess, excess)


def _excess(score: FloatArray, inverse: FloatArray, u: FloatArray, v: FloatArray, cell_px: float) -> float:
    """Variance of the scores summed over cells of the picture, over that of white noise: above 1 where they agree.

    A real spot is not round to the last: what the model leaves then has one sign over many pixels.
    """
    column, row = ((place - place.min()) // cell_px for place in (u, v))
    cell = (row * (column.max() + 1) + column).astype(int)
    sums = np.stack([np.bincount(cell, weights=score[:, axis]) for axis in (0, 1)], axis=1)
    return max(1.0, float(np.trace(inverse @ (sums.T @ sums))) / 2)


def _profile_basis(radius: FloatArray, edge_px: float, reach_px: float) -> tuple[FloatArray, FloatArray]:
    """Cubic B-splines (N, K) over the radius and their derivatives by it, fine about the edge and coarse elsewhere."""
    place, rate = _stretched(radius, edge_px)
    ends, _ = _stretched(np.array([0.0, reach_px + 2.0]), edge_px)
    knots = np.arange(math.floor(ends[0]) - 1, math.ceil(ends[1]) + 2)
    x = place[:, None] - knots
    away = np.abs(x)
    inner, outer = away < 1, (away >= 1) & (away < 2)
    tail = 2 - away
    value = np.where(inner, 2 / 3 - away**2 + away**3 / 2, np.where(outer, tail**3 / 6, 0.0))
    slope = np.where(inner, -2 * away + 1.5 * away**2, np.where(outer, -(tail**2) / 2, 0.0)) * np.sign(x)
    used = value.any(axis=0)
    return value[:, used], slope[:, used] * rate[:, None]


def _stretched(radius: FloatArray, edge_px: float) -> tuple[FloatArray, FloatArray]:
    """Radius in knots: (r - edge) / h near the edge, logarithmic beyond; and its derivative."""
    off = radius - edge_px
    far = np.maximum(np.abs(off), _FINE_PX)
    place = np.where(np.abs(off) < _FINE_PX, off, np.sign(off) * _FINE_PX * (1 + np.log(far / _FINE_PX)))
    return np.asarray(place / _KNOT_PX), np.asarray(_FINE_PX / far / _KNOT_PX)
