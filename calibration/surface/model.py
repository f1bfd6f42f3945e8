"""The smooth model through the levels of a lens: mean and covariance of its quantities anywhere.

The focal length is smooth over zoom in a scale that depends on how the zoom's encoder is built: in log f for most, in
f or 1/f for some. So it is fitted as (f / f_0)^p / p, log(f / f_0) for p = 0, with f_0 the geometric mean, and the
restricted likelihood chooses p (Box and Cox 1964; with f_0 so chosen likelihoods compare). Distortion, shift and nodal
offset follow the focal length rather than the encoder where the likelihood says so: then they are fitted over log f.

With a prior (the surface of another lens of the same type) the differences to it are fitted instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.surface.process import Joint, Smoothness, choose_smoothness
from calibration.surface.quantities import LevelData, frame_rays, lens_of, overlay_of, picture_jacobian
from calibration.types import FloatArray

Places = tuple[FloatArray, FloatArray]
"""Zoom and focus, (N,) each."""

PriorMean = Callable[[FloatArray, FloatArray], FloatArray]
"""Quantities (N, 5) of another lens at zoom and focus (N,)."""

_POWERS = (0.0, -1.0, -0.5, 0.5, 1.0)
_EXPECTED = (0.1, 0.02, 0.01, 2.0, 2.0)
# How far log f, k1_hw, k2_hw (dimensionless) and the shift (px) of a zoom may be from a plain trend, beforehand.
_EXPECTED_FROM_PRIOR = (0.01, 0.003, 0.003, 2.0, 2.0)
# The same from another lens of the same type: its scatter in manufacture.
_EXPECTED_NODAL_MM = 20.0
_ZOOMS = 1.2
# A lens whose longest focal length is less than this times its shortest does not zoom.
_BETTER = 2.0
# Log likelihood by which another scale or coordinate must win before it is taken instead of the plain one.
_LOCAL_ZOOM, _LOCAL_FOCUS = 0.15, 0.5
_LOCAL_PRIOR = 2.0
# How far, in zoom and focus, the misfit at a level says something of places beside it, and how many levels' worth of
# "as everywhere" is held against it.


_ORIGIN = (np.zeros(1), np.zeros(1))


@dataclass(frozen=True, slots=True, eq=False)
class LevelMisfit:
    """A level against the surface through all others: residual (5,) of the quantities, its covariance (5, 5), and both
    in px: ``error_px`` the largest overlay error, ``expected_px`` its standard deviation."""

    residual: FloatArray
    covariance: FloatArray
    error_px: float
    expected_px: float


@dataclass(frozen=True, slots=True, eq=False)
class LensModel:
    """A fitted model. Use :meth:`fit`."""

    data: LevelData
    prior: PriorMean | None
    power: float
    log_f0: float
    focus_mid: float
    follows_f: tuple[bool, bool]
    focal: Joint
    optics: Joint
    shift: Joint
    nodal: Joint | None
    misfits: tuple[LevelMisfit, ...]

    @classmethod
    def fit(cls, data: LevelData, prior: PriorMean | None = None, like: LensModel | None = None) -> LensModel:
        """The model of a lens's levels. ``like``: of nearly the same levels, whose scale and coordinates are kept.

        Raises :class:`calibration.errors.NotConverged`.
        """
        places = (data.zoom, data.focus)
        values = data.values if prior is None else data.values - prior(*places)
        expected = _EXPECTED if prior is None else _EXPECTED_FROM_PRIOR
        log_f0 = float(np.mean(values[:, 0])) if prior is None else 0.0
        noise = data.covariance
        zooms = float(np.ptp(data.values[:, 0])) > math.log(_ZOOMS)
        power, focal = 0.0, _smooth(places, values[:, 0] - log_f0, noise[:, 0, 0], expected[0])
        if like is not None and like.power != 0.0:
            power = like.power
            scaled, slope = _to_power(values[:, 0] - log_f0, power)
            focal = _smooth(places, scaled, noise[:, 0, 0] * slope**2, expected[0])
        elif like is None and prior is None and zooms:
            for candidate in _POWERS[1:]:
                scaled, slope = _to_power(values[:, 0] - log_f0, candidate)
                found = _smooth(places, scaled, noise[:, 0, 0] * slope**2, expected[0])
                if found.log_likelihood > focal.log_likelihood + (_BETTER if power == 0.0 else 0.0):
                    power, focal = candidate, found
        scaled, slope = _to_power(values[:, 0] - log_f0, power)
        focus_mid = float(np.median(data.focus))
        alone = Joint.solve([places], [focal], scaled[:, None], (noise[:, 0, 0] * slope**2)[:, None, None])
        by_f = (
            _along_f(alone, data.zoom, power, focus_mid, data.zoom) if prior is None and zooms else data.zoom,
            data.focus,
        )

        def chosen(columns: Sequence[int], kept: bool | None) -> tuple[bool, list[Smoothness]]:
            if kept is not None:
                at = by_f if kept else places
                return kept, [_smooth(at, values[:, i], noise[:, i, i], expected[i]) for i in columns]
            plain = [_smooth(places, values[:, i], noise[:, i, i], expected[i]) for i in columns]
            if prior is not None or not zooms:
                return False, plain
            other = [_smooth(by_f, values[:, i], noise[:, i, i], expected[i]) for i in columns]
            gain = sum(b.log_likelihood - a.log_likelihood for a, b in zip(plain, other, strict=True))
            return (True, other) if gain > _BETTER else (False, plain)

        optics_by_f, distortion = chosen((1, 2), None if like is None else like.follows_f[0])
        shift_by_f, shifts = chosen((3, 4), None if like is None else like.follows_f[1])
        optics_at = by_f if optics_by_f else places
        to_scale = np.ones((len(data), 3))
        to_scale[:, 0] = slope
        optics = Joint.solve(
            [places, optics_at, optics_at],
            [focal, *distortion],
            np.column_stack([scaled, values[:, 1:3]]),
            noise[:, :3, :3] * to_scale[:, :, None] * to_scale[:, None, :],
        )
        shift_at = by_f if shift_by_f else places
        shift = Joint.solve([shift_at, shift_at], shifts, values[:, 3:], noise[:, 3:, 3:])
        model = cls(
            data,
            prior,
            power,
            log_f0,
            focus_mid,
            (optics_by_f, shift_by_f),
            alone,
            optics,
            shift,
            _nodal(data),
            (),
        )
        if model.spare < 2:
            return model  # without a level its trend could not be drawn, so none can be compared with the others
        return replace(model, misfits=tuple(model._misfit(i) for i in range(len(data))))

    @property
    def spare(self) -> int:
        """How many levels there are beyond those that the trends take: what the smoothness is learned from."""
        smooth = (*self.optics.smooth, *self.shift.smooth)
        return len(self.data) - max(len(s.trend.at(*_ORIGIN)[0]) for s in smooth)

    def mean(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        """The quantities (N, 5) at places (N,)."""
        optics_at, shift_at = self._coordinates(zoom, focus)
        columns = [
            _from_power(self.optics.mean(0, zoom, focus), self.power)[0] + self.log_f0,
            *(self.optics.mean(i, *optics_at) for i in (1, 2)),
            *(self.shift.mean(i, *shift_at) for i in (0, 1)),
        ]
        found = np.stack(columns, axis=-1)
        return found if self.prior is None else found + self.prior(zoom, focus)

    def covariance(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        """Covariance (N, 5, 5) of the quantities at places (N,): larger where levels near by fitted worse than
        expected."""
        optics_at, shift_at = self._coordinates(zoom, focus)
        slope = _from_power(self.optics.mean(0, zoom, focus), self.power)[1]
        found = np.zeros((len(zoom), 5, 5))
        optics = self.optics.covariance([(zoom, focus), optics_at, optics_at])
        optics[:, 0, :] *= slope[:, None]
        optics[:, :, 0] *= slope[:, None]
        found[:, :3, :3] = optics
        found[:, 3:, 3:] = self.shift.covariance([shift_at, shift_at])
        return np.asarray(found * self._local_scale(zoom, focus)[:, None, None])

    def nodal_mean(self, zoom: FloatArray, focus: FloatArray) -> FloatArray | None:
        """The nodal offset (N,) mm, None where no level has one."""
        return None if self.nodal is None else self.nodal.mean(0, zoom, focus)

    def nodal_sigma(self, zoom: FloatArray, focus: FloatArray) -> FloatArray | None:
        """Its standard deviation (N,) mm."""
        if self.nodal is None:
            return None
        return np.sqrt(np.maximum(self.nodal.covariance([(zoom, focus)])[:, 0, 0], 0.0))

    def predicted_px(self, zoom: FloatArray, focus: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(rms, max) over the frame of one sigma of the overlay error at places (N,), px."""
        return overlay_of(self.covariance(zoom, focus), self.jacobian(zoom, focus))

    def jacobian(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        """d(u, v)/d(quantities) over the frame at places (N,): (N, M, 2, 5)."""
        mean = self.mean(zoom, focus)
        rays = frame_rays(lens_of([*np.median(mean, axis=0)[:3], 0.0, 0.0], self.data.image_size, 1.0))
        return picture_jacobian(mean[:, 1], mean[:, 2], rays, self.data.image_size)

    def _coordinates(self, zoom: FloatArray, focus: FloatArray) -> tuple[Places, Places]:
        along = zoom
        if any(self.follows_f):
            along = _along_f(self.focal, zoom, self.power, self.focus_mid, self.data.zoom)
        optics, shift = (along if follows else zoom for follows in self.follows_f)
        return (optics, focus), (shift, focus)

    def _local_scale(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        if not self.misfits:
            return np.ones(len(zoom))
        ratio = np.array([(m.error_px / max(m.expected_px, 1e-12)) ** 2 for m in self.misfits])
        near = np.exp(
            -0.5 * ((zoom[:, None] - self.data.zoom) / _LOCAL_ZOOM) ** 2
            - 0.5 * ((focus[:, None] - self.data.focus) / _LOCAL_FOCUS) ** 2
        )
        return np.asarray((_LOCAL_PRIOR + near @ ratio) / (_LOCAL_PRIOR + near.sum(axis=1)))

    def _misfit(self, level: int) -> LevelMisfit:
        optics, optics_covariance = self.optics.left_out(level)
        shift, shift_covariance = self.shift.left_out(level)
        slope = _from_power(self.optics.values[level : level + 1, 0], self.power)[1][0]
        scale = np.array([slope, 1.0, 1.0])
        covariance = np.zeros((5, 5))
        covariance[:3, :3] = optics_covariance * np.outer(scale, scale)
        covariance[3:, 3:] = shift_covariance
        residual = np.concatenate([optics * scale, shift])
        return misfit(residual, covariance, self.data.values[level], self.data.image_size)


def misfit(
    residual: FloatArray, covariance: FloatArray, values: FloatArray, image_size: tuple[int, int]
) -> LevelMisfit:
    """A residual (5,) with its covariance (5, 5) of a level with these ``values`` (5,), also in px."""
    rays = frame_rays(lens_of(values.tolist(), image_size, 1.0))
    jacobian = picture_jacobian(values[1:2], values[2:3], rays, image_size)[0]
    error = float(np.max(np.linalg.norm(jacobian @ residual, axis=-1)))
    expected = float(overlay_of(covariance[None], jacobian[None])[1][0])
    return LevelMisfit(residual, covariance, error, expected)


def _smooth(places: Places, values: FloatArray, noise: FloatArray, expected: float) -> Smoothness:
    return choose_smoothness(*places, values, noise, expected)


def _nodal(data: LevelData) -> Joint | None:
    told = np.flatnonzero(np.isfinite(data.nodal_mm))
    if told.size == 0:
        return None
    places = (data.zoom[told], data.focus[told])
    values, noise = data.nodal_mm[told], data.nodal_variance[told]
    smooth = choose_smoothness(*places, values, noise, _EXPECTED_NODAL_MM)
    return Joint.solve([places], [smooth], values[:, None], noise[:, None, None])


def _to_power(log_ratio: FloatArray, power: float) -> tuple[FloatArray, FloatArray]:
    """(r^p - 1) / p of r = exp(log_ratio), and its derivative by log_ratio."""
    if power == 0.0:
        return log_ratio, np.ones(log_ratio.shape)
    scaled = np.exp(power * log_ratio)
    return (scaled - 1.0) / power, scaled


_LEAST_BASE = 1e-3
# A power of f that a surface puts below this is no focal length; the curve is held there.


def _from_power(scaled: FloatArray, power: float) -> tuple[FloatArray, FloatArray]:
    """log r of (r^p - 1) / p, and its derivative."""
    if power == 0.0:
        return scaled, np.ones(scaled.shape)
    base = np.maximum(1.0 + power * scaled, _LEAST_BASE)
    return np.log(base) / power, 1.0 / base


def _along_f(focal: Joint, zoom: FloatArray, power: float, focus_mid: float, levels: FloatArray) -> FloatArray:
    """log f at the middle focus as a coordinate: 0 at the widest level, 1 at the longest."""
    ends = np.array([levels.min(), levels.max()])
    everywhere = np.concatenate([ends, zoom])
    log_f = _from_power(focal.mean(0, everywhere, np.full(len(everywhere), focus_mid)), power)[0]
    return np.asarray((log_f[2:] - log_f[0]) / (log_f[1] - log_f[0]))
