"""Sides of a quadrilateral as curves of low order, and the corners where they cross."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.detect.aliasing import cut_variance
from calibration.types import FloatArray

SYSTEMATIC_PX, SYSTEMATIC_OF_BLUR = 0.006, 0.002
"""Standard deviation of what the Gaussian model leaves of a real side: of the pixel response, and, as a share of the
blur's sigma, of a blur of another shape (a defocus disk) and of what lies behind within its reach."""


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """One side of a quadrilateral as fitted.

    ``along_rows``: it is v = c(u), else u = c(v). With t = (x - middle) / half, c = sum of coefficients[i] t^i (px);
    ``covariance`` of the coefficients (px^2), without the systematic part. ``used``: share of the lines of pixels that
    fit; ``chi2``: their median squared residual over the noise; ``contrast``: median difference over the noise of
    one pixel; ``sigma_px``: blur normal to the side, pixel included. ``aliased``: share (0..1) of the error of edges
    cut to whole pixels; ``line_variance_px2``: what one line of pixels tells; ``density``: lines used for each pixel;
    ``systematic_px``: how far a misfit common to its lines may have moved it.
    """

    along_rows: bool
    middle: float
    half: float
    coefficients: FloatArray
    covariance: FloatArray
    sigma_px: float
    used: float
    lines: int
    chi2: float
    contrast: float
    aliased: float
    line_variance_px2: float
    density: float
    systematic_px: float = 0.0

    def at(self, x: float) -> tuple[float, float, float]:
        """Value c(x), slope dc/dx and variance of c at a coordinate along the side (px, 1, px^2)."""
        t = (x - self.middle) / self.half
        powers = t ** np.arange(len(self.coefficients))
        slope = sum(i * c * t ** (i - 1) for i, c in enumerate(self.coefficients) if i) / self.half
        return float(powers @ self.coefficients), float(slope), float(powers @ self.covariance @ powers)

    def aliasing(self, slope: float, spread_px2: float) -> float:
        """Variance (px^2) at a place where the curve's is ``spread_px2``, by errors that neighbouring lines share.

        As many lines count there as it takes for that variance: at the end of a curve of order k, 1 in (k + 1)^2.
        """
        if not self.aliased:
            return 0.0
        pixels = max(self.line_variance_px2 / (spread_px2 * self.density), 1.0)
        steep = min(abs(slope), 1.0)
        return self.aliased * float(cut_variance(np.array(steep), np.array(pixels)))


@dataclass(slots=True, eq=False)
class Curve:
    """A side while it is being fitted: as :class:`Side`, reaching from ``low`` to ``high`` along its axis (px)."""

    along_rows: bool
    low: float
    high: float
    coefficients: FloatArray

    @property
    def middle(self) -> float:
        return (self.low + self.high) / 2

    @property
    def half(self) -> float:
        return (self.high - self.low) / 2

    def basis(self, x: FloatArray) -> FloatArray:
        t = (x - self.middle) / self.half
        return np.asarray(np.vander(t, len(self.coefficients), increasing=True))

    def slope(self, x: FloatArray) -> FloatArray:
        t = (x - self.middle) / self.half
        derivative = self.coefficients[1:] * np.arange(1, len(self.coefficients))
        return np.asarray(np.vander(t, len(derivative), increasing=True) @ derivative / self.half)


def corner_of(first: Side, second: Side, near: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Crossing (2,) of two sides near a place, and its covariance (2, 2).

    Newton on both curves; the covariance carries the variance of each side at the corner, plus the systematic part,
    through the inverse of the same Jacobian. None if the sides do not cross near there.
    """
    place = np.array(near, dtype=np.float64)
    jacobian = np.eye(2)
    variance = np.zeros(2)
    for _ in range(20):
        rows, values = [], []
        for index, side in enumerate((first, second)):
            x, y = (place[0], place[1]) if side.along_rows else (place[1], place[0])
            value, slope, spread = side.at(float(x))
            rows.append([-slope, 1.0] if side.along_rows else [1.0, -slope])
            values.append(value - y)
            variance[index] = (
                spread
                + side.aliasing(slope, spread)
                + (SYSTEMATIC_PX + SYSTEMATIC_OF_BLUR * side.sigma_px) ** 2
                + side.systematic_px**2
            )
        jacobian = np.array(rows)
        if abs(np.linalg.det(jacobian)) < 0.1:
            return None
        step = np.linalg.solve(jacobian, np.array(values))
        place = place + step
        if np.linalg.norm(place - near) > 0.5 * min(first.half, second.half) + 10:
            return None
        if np.linalg.norm(step) < 1e-9:
            inverse = np.linalg.inv(jacobian)
            return place, inverse @ np.diag(variance) @ inverse.T
    return None


def start_curves(corners: FloatArray) -> list[Curve]:
    """Straight sides (top, right, bottom, left) between rough corners (4, 2), clockwise from the top left."""
    curves = []
    for first, second in zip(corners, corners[[1, 2, 3, 0]], strict=True):
        run = np.abs(second - first)
        along_rows = bool(run[0] >= run[1])
        axis = 0 if along_rows else 1
        a, b = (first, second) if first[axis] < second[axis] else (second, first)
        middle, slope_half = (a[1 - axis] + b[1 - axis]) / 2, (b[1 - axis] - a[1 - axis]) / 2
        curves.append(Curve(along_rows, float(a[axis]), float(b[axis]), np.array([middle, slope_half])))
    return curves


def meeting(curves: list[Curve]) -> list[Curve]:
    """The same sides, each reaching from its crossing with one neighbour to that with the other."""
    ends: list[list[float]] = [[], [], [], []]
    for index in range(4):
        one, two = curves[index], curves[(index + 1) % 4]
        place = np.array([one.high if one.along_rows else one.middle, one.middle if one.along_rows else one.high])
        for _ in range(15):
            rows, values = [], []
            for curve in (one, two):
                x, y = (place[0], place[1]) if curve.along_rows else (place[1], place[0])
                at = np.array([x])
                slope = float(curve.slope(at)[0])
                rows.append([-slope, 1.0] if curve.along_rows else [1.0, -slope])
                values.append(float((curve.basis(at) @ curve.coefficients)[0]) - y)
            matrix = np.array(rows)
            if abs(np.linalg.det(matrix)) < 0.1:
                break
            step = np.linalg.solve(matrix, np.array(values))
            place = place + step
            if abs(step[0]) + abs(step[1]) < 1e-3:
                break
        ends[index].append(place[0] if one.along_rows else place[1])
        ends[(index + 1) % 4].append(place[0] if two.along_rows else place[1])
    met = []
    for curve, reached in zip(curves, ends, strict=True):
        low, high = min(reached), max(reached)
        half = curve.half
        if not (0.5 * half < (high - low) / 2 < 2 * half):
            met.append(curve)
            continue
        x = np.linspace(low, high, 9)
        moved = Curve(curve.along_rows, low, high, curve.coefficients)
        values_there = curve.basis(x) @ curve.coefficients
        moved.coefficients = np.asarray(np.linalg.lstsq(moved.basis(x), values_there, rcond=None)[0], dtype=np.float64)
        met.append(moved)
    return met
