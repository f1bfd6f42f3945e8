"""The lens at any zoom and focus, fast: the smooth model sampled once, then read by interpolation.

The model's mean is sampled on a grid over zoom and focus. Over zoom it is read as a cubic Hermite, whose slopes are
limited for log f (Fritsch and Carlson 1980), so that the field of view never turns between nodes that fall; over focus
linearly, which keeps that. The grid is so fine that this differs from the model by less than 0.01 px. Outside the
levels' range the nearest place holds, and the answer says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.surface.model import LensModel
from calibration.surface.quantities import QUANTITIES, lens_of
from calibration.tables import PixelError, Sigma
from calibration.types import FloatArray

_NODES = (257, 65)
_SIGMA_NODES = (65, 17)
# Over zoom and focus. Uncertainty is read linearly and to a few percent, so its grid is coarser.
_CHUNK = 4096
# Places evaluated at once, so that what is gathered for them stays in the processor's cache.
_SHRINK = 0.5
_SHRINKS = 12


@dataclass(frozen=True, slots=True)
class LensAt:
    """The lens at one place. ``zoom``, ``focus``: where it was read; ``clamped``: that is not where it was asked for,
    which lies outside the levels; ``sigma``: one standard deviation of each quantity; ``predicted_px``: overlay error
    to expect, one sigma; ``nodal_told`` False: no level has a nodal offset, and the lens's 0 means nothing."""

    lens: Lens
    zoom: float
    focus: float
    clamped: bool
    sigma: Sigma
    predicted_px: PixelError
    nodal_told: bool


@dataclass(frozen=True, slots=True, eq=False)
class LensBatch:
    """The lens at many places, (N,) each: ``fov_x_deg``, ``f_px``, ``k1``, ``k2`` (focal-length units), ``k1_hw``,
    ``k2_hw``, ``center_shift_px`` (N, 2), ``nodal_offset_mm`` (NaN where untold), ``predicted_max_px``, ``clamped``."""

    fov_x_deg: FloatArray
    f_px: FloatArray
    k1: FloatArray
    k2: FloatArray
    k1_hw: FloatArray
    k2_hw: FloatArray
    center_shift_px: FloatArray
    nodal_offset_mm: FloatArray
    predicted_max_px: FloatArray
    clamped: np.ndarray[tuple[int], np.dtype[np.bool_]]


class _Axis:
    """An even grid from ``low`` to ``high``; of one node where they are equal."""

    def __init__(self, low: float, high: float, nodes: int) -> None:
        self.low, self.high = low, high
        self.nodes = np.linspace(low, high, nodes) if high > low else np.array([low, low + 1.0])
        self.step = float(self.nodes[1] - self.nodes[0])
        self.last = len(self.nodes) - 2

    def cell(self, value: float) -> tuple[int, float]:
        """(cell, place in it 0..1) of a value inside."""
        place = (value - self.low) / self.step
        index = min(max(int(place), 0), self.last)
        return index, place - index

    def cells(self, values: FloatArray) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], FloatArray]:
        place = (values - self.low) / self.step
        index = np.clip(place.astype(np.intp), 0, self.last)
        return index, place - index


class LensSurface:
    """The lens over zoom and focus. Make it with :func:`calibration.surface.fit_surface`."""

    def __init__(self, model: LensModel) -> None:
        data = model.data
        self.model = model
        self.image_size = data.image_size
        self.pixel_aspect = data.pixel_aspect
        self.zoom_range = (float(data.zoom.min()), float(data.zoom.max()))
        self.focus_range = (float(data.focus.min()), float(data.focus.max()))
        self._zoom = _Axis(*self.zoom_range, _NODES[0])
        self._focus = _Axis(*self.focus_range, _NODES[1])
        self._sigma_zoom = _Axis(*self.zoom_range, _SIGMA_NODES[0])
        self._sigma_focus = _Axis(*self.focus_range, _SIGMA_NODES[1])
        self.nodal_told = model.nodal is not None
        self._nodes = self._sample()
        self._sigmas = self._sample_sigma()

    @classmethod
    def compile(cls, model: LensModel) -> LensSurface:
        """Sample a model. Raises :class:`InvalidInput` for a focal length that falls from wide to tele."""
        return cls(model)

    def at(self, zoom: float, focus: float) -> LensAt:
        """The lens at one place (encoder values). Raises :class:`InvalidInput` for a value that is no number."""
        if not (math.isfinite(zoom) and math.isfinite(focus)):
            raise InvalidInput("zoom, focus", (zoom, focus), "must be numbers")
        low, high = self.zoom_range
        inside = min(max(zoom, low), high)
        near, far = self.focus_range
        focused = min(max(focus, near), far)
        i, s = self._zoom.cell(inside)
        j, t = self._focus.cell(focused)
        weights = _hermite(s, self._zoom.step)
        block = self._nodes[i, j : j + 2]
        mixed = (1 - t) * block[0] + t * block[1]
        log_f, k1_hw, k2_hw, shift_x, shift_y, nodal = (weights @ mixed).tolist()
        a, p = self._sigma_zoom.cell(inside)
        b, q = self._sigma_focus.cell(focused)
        corners = self._sigmas[a : a + 2, b : b + 2]
        spread = ((1 - q) * corners[:, 0] + q * corners[:, 1]).T @ np.array([1 - p, p])
        fov, k1, k2, sx, sy, nodal_sigma, rms, largest = spread.tolist()
        lens = lens_of((log_f, k1_hw, k2_hw, shift_x, shift_y), self.image_size, self.pixel_aspect, nodal)
        sigma = Sigma(fov, k1, k2, (sx, sy), nodal_sigma if self.nodal_told else None)
        clamped = inside != zoom or focused != focus
        return LensAt(lens, inside, focused, clamped, sigma, PixelError(rms, largest), self.nodal_told)

    def at_many(self, zoom: FloatArray, focus: FloatArray) -> LensBatch:
        """The lens at places (N,). Raises :class:`InvalidInput` for values that are no numbers."""
        zoom, focus = np.broadcast_arrays(np.asarray(zoom, np.float64).ravel(), np.asarray(focus, np.float64).ravel())
        if not (np.isfinite(zoom).all() and np.isfinite(focus).all()):
            raise InvalidInput("zoom, focus", "array", "must be numbers")
        inside, focused = np.clip(zoom, *self.zoom_range), np.clip(focus, *self.focus_range)
        values = self._read(inside, focused)
        f_px = np.exp(values[:, 0])
        half = self.image_size[0] / (2 * f_px)
        nodal = values[:, 5] if self.nodal_told else np.full(len(zoom), np.nan)
        return LensBatch(
            np.degrees(2 * np.arctan(half)),
            f_px,
            values[:, 1] / half**2,
            values[:, 2] / half**4,
            values[:, 1],
            values[:, 2],
            values[:, 3:5],
            nodal,
            self._read_predicted(inside, focused),
            (inside != zoom) | (focused != focus),
        )

    def quantities(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        """The quantities (N, 5) at places (N,), held outside the levels' range."""
        return self._read(np.clip(zoom, *self.zoom_range), np.clip(focus, *self.focus_range))[:, : len(QUANTITIES)]

    def _read(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        found = np.empty((len(zoom), self._nodes.shape[-1]))
        for start in range(0, len(zoom), _CHUNK):
            part = slice(start, start + _CHUNK)
            i, s = self._zoom.cells(zoom[part])
            j, t = self._focus.cells(focus[part])
            weights = np.stack(_hermite_parts(s, self._zoom.step), axis=-1)
            rows = np.einsum("nk,nkq->nq", weights, self._nodes[i, j])
            if len(self._focus.nodes) > 2 or self.focus_range[1] > self.focus_range[0]:
                other = np.einsum("nk,nkq->nq", weights, self._nodes[i, j + 1])
                rows += t[:, None] * (other - rows)
            found[part] = rows
        return found

    def _read_predicted(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        largest = self._sigmas[..., -1]
        i, s = self._sigma_zoom.cells(zoom)
        j, t = self._sigma_focus.cells(focus)
        near = (1 - s) * largest[i, j] + s * largest[i + 1, j]
        far = (1 - s) * largest[i, j + 1] + s * largest[i + 1, j + 1]
        return np.asarray((1 - t) * near + t * far)

    def _sample(self) -> FloatArray:
        """(zoom cells, focus nodes, 4, 6): for each cell the Hermite values and slopes at its two ends."""
        zoom, focus = np.meshgrid(self._zoom.nodes, self._focus.nodes, indexing="ij")
        flat = (zoom.ravel(), focus.ravel())
        held = (np.clip(flat[0], *self.zoom_range), np.clip(flat[1], *self.focus_range))
        mean = self.model.mean(*held).reshape(*zoom.shape, len(QUANTITIES))
        nodal = self.model.nodal_mean(*held)
        values = np.concatenate([mean, np.zeros((*zoom.shape, 1))], axis=-1)
        if nodal is not None:
            values[..., -1] = nodal.reshape(zoom.shape)
        values[..., 0] = self._falling_fov(values[..., 0])
        self._unfold(values)
        slopes = CubicSpline(self._zoom.nodes, values, axis=0).derivative()(self._zoom.nodes)
        slopes[..., 0] = PchipInterpolator(self._zoom.nodes, values[..., 0], axis=0).derivative()(self._zoom.nodes)
        return np.ascontiguousarray(np.stack([values[:-1], slopes[:-1], values[1:], slopes[1:]], axis=2))

    def _falling_fov(self, log_f: FloatArray) -> FloatArray:
        """log f (zoom, focus) made to grow with zoom where noise of flat stretches has turned it."""
        growing = np.maximum.accumulate(log_f, axis=0)
        turned = float(np.max(growing - log_f))
        if turned > math.log(1.05):
            raise InvalidInput(
                "levels",
                f"zoom {self.zoom_range[0]:g} to {self.zoom_range[1]:g}",
                f"the focal length turns back by {math.expm1(turned):.0%} between levels; measure more of them there",
            )
        # A step too small to see, so that a field of view never stands still either.
        return np.asarray(growing + 1e-12 * np.arange(len(growing))[:, None])

    def _unfold(self, values: FloatArray) -> None:
        """Where the distortion between levels would fold inside the picture, draw it towards none until it does not:
        the lenses that do not fold are a convex set that holds the undistorted one."""
        for index in np.ndindex(values.shape[:2]):
            row = values[index]
            if row[1] >= 0 and row[2] >= 0:
                continue
            for _ in range(_SHRINKS):
                if not lens_of(row[:5].tolist(), self.image_size, self.pixel_aspect).folds_inside():
                    break
                row[1:3] *= _SHRINK

    def _sample_sigma(self) -> FloatArray:
        """(zoom, focus, 8): sigma of fov_x_deg, k1, k2, shift x, shift y, nodal; predicted rms and max px."""
        zoom, focus = np.meshgrid(self._sigma_zoom.nodes, self._sigma_focus.nodes, indexing="ij")
        held = (np.clip(zoom.ravel(), *self.zoom_range), np.clip(focus.ravel(), *self.focus_range))
        covariance = self.model.covariance(*held)
        mean = self.quantities(*held)
        half2 = (self.image_size[0] / (2 * np.exp(mean[:, 0]))) ** 2
        fov = 2 * np.arctan(np.sqrt(half2))
        # Back to the table's units: d(fov) = -sin(fov) d(log f); k1 = k1_hw / h^2 with h^2 falling as f^2 grows.
        to_level = np.zeros((len(mean), 5, 5))
        to_level[:, 0, 0] = -np.degrees(np.sin(fov))
        to_level[:, 1, 0], to_level[:, 1, 1] = 2 * mean[:, 1] / half2, 1 / half2
        to_level[:, 2, 0], to_level[:, 2, 2] = 4 * mean[:, 2] / half2**2, 1 / half2**2
        to_level[:, 3, 3] = to_level[:, 4, 4] = 1.0
        variance = np.einsum("nij,njk,nik->ni", to_level, covariance, to_level)
        rms, largest = self.model.predicted_px(*held)
        nodal = self.model.nodal_sigma(*held)
        nodal = np.zeros(len(mean)) if nodal is None else nodal
        spread = np.sqrt(np.maximum(variance, 0.0))
        return np.column_stack([spread, nodal, rms, largest]).reshape(*zoom.shape, 8)


def _hermite(s: float, step: float) -> FloatArray:
    """Weights of value and slope at both ends of a cell for the place ``s`` in it."""
    s2, s3 = s * s, s * s * s
    return np.array([2 * s3 - 3 * s2 + 1, (s3 - 2 * s2 + s) * step, 3 * s2 - 2 * s3, (s3 - s2) * step])


def _hermite_parts(s: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    s2 = s * s
    s3 = s2 * s
    return 2 * s3 - 3 * s2 + 1, (s3 - 2 * s2 + s) * step, 3 * s2 - 2 * s3, (s3 - s2) * step
