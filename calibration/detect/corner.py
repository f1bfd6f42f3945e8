"""Fine measurement: the maximum-likelihood fit of a blurred corner to the pixels, all corners of a board at once.

Two edges cross at (x, y). With signed distances d1, d2 to the edges, blurred by a Gaussian of sigma s,

    I = o + g F,   F = E(d1) E(d2) + (2 / pi) (rho + rho^2 a1 a2 / 2) exp(-(a1^2 + a2^2) / 2),

with a = d / s, E(d) = erf(a / sqrt 2), and rho the cosine between the two edges' normals: the expansion in rho, to
second order, of the orthant probability of the bivariate normal, exact for edges that cross at a right angle. The box
of a pixel is part of s (it adds 1/12 px^2 to the variance along any direction). An edge may be bent, as a straight line
seen through a lens is: d is then d_line - curvature / 2 * (way along the edge)^2, the curvature known from the grid.

Free for each corner: x, y, two angles, ln s, o, g. Gauss-Newton with Levenberg's damping, weights from the noise at
the model's light, so the inverse normal matrix is the Cramer-Rao bound and is returned as the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.types import FloatArray, IntArray, Picture

Pixels = NDArray[np.float32]
Flags = NDArray[np.bool_]

PIXEL_VARIANCE_PX2 = 1 / 12
WINDOW_SHARE = 0.45
"""A pixel belongs to a corner's window within this share of a square along both of the board's directions."""
SHARPEST_SIGMA_PX = 0.25
PARAMETERS = 7
_FIRST_DAMPING = 1e-3
_LEAST_PIXELS = 21
_FLAT_STRIDE_PX = 4
_SMALL_STEPS = (0.02, 0.02, 0.05, 0.02, 0.02)  # angles (rad), ln s, and offset and gain (of the board's contrast)
_BLOCK_PIXELS = 8000
_GUESSED_SIGMAS_PX = (0.6, 1.2, 2.4, 4.8, 9.6, 19.2)


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """A board's light as one number a pixel: I = sum of ``tables[c][picture[..., c]]``, dark squares 0, bright ones 1.

    ``tables`` (3, 256) float32. The noise variance of I is linear in I, ``variance_dark`` at 0 and ``variance_bright``
    at 1: so it is for photon noise, and nearly so for equal noise on coded values.
    """

    picture: Picture
    tables: Pixels
    variance_dark: float
    variance_bright: float


@dataclass(frozen=True, slots=True, eq=False)
class CornerState:
    """The parameters of N corners: ``points_px`` (N, 2), ``angles`` (N, 2) radians; the others (N,)."""

    points_px: FloatArray
    angles: FloatArray
    sigma_px: FloatArray
    offset: FloatArray
    gain: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CornerFit:
    """The fitted ``state``; ``covariance_px2`` (N, 2, 2) at the assumed noise; ``chi2`` (N,) mean squared residual over
    the noise variance; ``pixels`` (N,) used. Covariance and chi2 are NaN for a corner that could not be fitted.
    """

    state: CornerState
    covariance_px2: FloatArray
    chi2: FloatArray
    pixels: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The pixels around N corners, at most P for each: ``values`` light, ``used`` 1 or 0, ``du``, ``dv`` offsets from
    the ``centres`` (N, 2), whole pixels. All others (N, P).
    """

    values: Pixels
    used: Pixels
    centres: FloatArray
    du: Pixels
    dv: Pixels

    def of(self, which: IntArray) -> Windows:
        """The windows of some of the corners."""
        if len(which) == len(self.centres):
            return self
        return Windows(self.values[which], self.used[which], self.centres[which], self.du[which], self.dv[which])


def cut_windows(
    signal: Signal,
    state: CornerState,
    steps_px: FloatArray,
    half_px: int,
    *,
    stride_px: int = 1,
    band_px: float | None = None,
) -> Windows:
    """Windows reaching ``half_px`` about the corners; used are the pixels within ``WINDOW_SHARE`` of a square.

    ``steps_px`` (N, 2, 2): vectors to the next corner along columns and along rows. Every ``stride_px``-th pixel is
    taken. With ``band_px`` only pixels so near to one of the state's two edges, and every ``_FLAT_STRIDE_PX``-th pixel
    elsewhere (for offset and gain): away from the edges a pixel tells nothing about the place of the corner.
    """
    centres = np.rint(state.points_px)
    reach = half_px // stride_px
    offsets = np.arange(-reach, reach + 1) * stride_px
    local = (state.points_px - centres).astype(np.float32)
    # (N, 1, K) and (N, K, 1): every linear function of the place is a sum of one of each.
    x = (offsets.astype(np.float32) - local[:, :1])[:, None, :]
    y = (offsets.astype(np.float32) - local[:, 1:])[:, :, None]
    determinant = steps_px[:, 0, 0] * steps_px[:, 1, 1] - steps_px[:, 0, 1] * steps_px[:, 1, 0]
    adjugate = np.stack([steps_px[:, 1, 1], -steps_px[:, 1, 0], -steps_px[:, 0, 1], steps_px[:, 0, 0]])
    inverse = (adjugate / determinant).astype(np.float32)[:, :, None, None]
    used = np.abs(inverse[0] * x + inverse[1] * y) <= WINDOW_SHARE
    used &= np.abs(inverse[2] * x + inverse[3] * y) <= WINDOW_SHARE
    height, width = signal.picture.shape[:2]
    used &= ((centres[:, :1] + offsets >= 0) & (centres[:, :1] + offsets < width))[:, None, :]
    used &= ((centres[:, 1:] + offsets >= 0) & (centres[:, 1:] + offsets < height))[:, :, None]
    if band_px is not None:
        cos = np.cos(state.angles).astype(np.float32)[:, :, None, None]
        sin = np.sin(state.angles).astype(np.float32)[:, :, None, None]
        near = np.abs(cos[:, 0] * y - sin[:, 0] * x) < band_px
        near |= np.abs(cos[:, 1] * y - sin[:, 1] * x) < band_px
        flat = offsets % _FLAT_STRIDE_PX == 0
        used &= near | (flat[:, None] & flat[None, :])
    corner, row, column = np.nonzero(used)
    pixels = used.sum(axis=(1, 2))
    place = np.arange(len(corner)) - np.repeat(np.cumsum(pixels) - pixels, pixels)
    shape = (len(centres), max(int(pixels.max(initial=0)), 1))
    values, kept = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    du, dv = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    whole = centres.astype(np.int64)
    coded = signal.picture[whole[corner, 1] + offsets[row], whole[corner, 0] + offsets[column]]
    values[corner, place] = sum(signal.tables[channel][coded[:, channel]] for channel in range(3))
    kept[corner, place] = 1.0
    du[corner, place], dv[corner, place] = offsets[column], offsets[row]
    return Windows(values, kept, centres, du, dv)


def _erf(a: Pixels, gauss: Pixels) -> Pixels:
    """erf(a) given ``gauss`` = exp(-a^2), to 1.5e-7: Abramowitz and Stegun 7.1.26."""
    t = 1 / (1 + np.float32(0.3275911) * np.abs(a))
    series = np.full_like(t, 1.061405429)
    for coefficient in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        series *= t
        series += np.float32(coefficient)
    series *= t
    series *= gauss
    return np.copysign(1 - series, a)


@dataclass(slots=True, eq=False)
class _Shape:
    """The model's F over the windows and what its derivatives need."""

    value: Pixels
    slope1: Pixels  # dF/dd1 without the factor of the gain
    slope2: Pixels
    d1: Pixels
    d2: Pixels
    t1: Pixels
    t2: Pixels
    cos: Pixels  # (N, 2)
    sin: Pixels


def _shape(windows: Windows, state: CornerState, curvature: Pixels) -> _Shape:
    cos, sin = np.cos(state.angles).astype(np.float32), np.sin(state.angles).astype(np.float32)
    local = (state.points_px - windows.centres).astype(np.float32)
    x, y = windows.du - local[:, :1], windows.dv - local[:, 1:]
    t1, t2 = cos[:, :1] * x + sin[:, :1] * y, cos[:, 1:] * x + sin[:, 1:] * y
    d1 = cos[:, :1] * y - sin[:, :1] * x
    d2 = cos[:, 1:] * y - sin[:, 1:] * x
    d1 -= (0.5 * curvature[:, :1]) * t1 * t1
    d2 -= (0.5 * curvature[:, 1:]) * t2 * t2
    scale = (np.sqrt(0.5) / state.sigma_px).astype(np.float32)[:, None]
    a1, a2 = d1 * scale, d2 * scale
    gauss1, gauss2 = np.exp(-a1 * a1), np.exp(-a2 * a2)
    erf1, erf2 = _erf(a1, gauss1), _erf(a2, gauss2)
    steep = scale * np.float32(2 / np.sqrt(np.pi))
    slope1, slope2 = steep * gauss1 * erf2, steep * gauss2 * erf1
    rho = np.cos(state.angles[:, :1] - state.angles[:, 1:]).astype(np.float32)
    gauss1 *= gauss2
    a1 *= a2
    value = erf1 * erf2 + (np.float32(2 / np.pi) * rho) * gauss1 * (1 + rho * a1)
    return _Shape(value, slope1, slope2, d1, d2, t1, t2, cos, sin)


def guess_sigma(windows: Windows, state: CornerState, largest_px: float) -> float:
    """The blur, of a few steps of a factor 2, that fits the windows best, offset and gain solved for each corner."""
    best, best_cost = _GUESSED_SIGMAS_PX[0], np.inf
    straight = np.zeros((len(state.points_px), 2), dtype=np.float32)
    count = np.maximum(windows.used.sum(axis=1), 1.0)
    mean = (windows.used * windows.values).sum(axis=1) / count
    centred = windows.used * (windows.values - mean[:, None])
    total = (centred * centred).sum(axis=1)
    for sigma in _GUESSED_SIGMAS_PX:
        if sigma > max(largest_px, _GUESSED_SIGMAS_PX[0]):
            break
        value = _shape(windows, replace(state, sigma_px=np.full(len(mean), sigma)), straight).value
        flat = windows.used * (value - ((windows.used * value).sum(axis=1) / count)[:, None])
        explained = (flat * centred).sum(axis=1) ** 2 / np.maximum((flat * flat).sum(axis=1), 1e-9)
        cost = float(np.median(1 - explained / np.maximum(total, 1e-9)))
        if cost < best_cost:
            best, best_cost = sigma, cost
    return best


def edge_softness(windows: Windows, state: CornerState) -> float:
    """Mean over the pixels within half a pixel of one edge alone of 1 - |2 v - 1|, v the light between the colours.

    0 where every pixel is of one colour or the other, 0.5 where pixels are means over their area, more with a blur.
    """
    shape = _shape(windows, state, np.zeros((len(windows.centres), 2), dtype=np.float32))
    near1, near2 = np.abs(shape.d1), np.abs(shape.d2)
    chosen = (windows.used > 0) & (np.minimum(near1, near2) < 0.5) & (np.maximum(near1, near2) > 2.0)
    offset, gain = state.offset.astype(np.float32)[:, None], state.gain.astype(np.float32)[:, None]
    signed = np.abs((windows.values - offset) / np.where(gain == 0, np.float32(1), gain))[chosen]
    return float(1 - np.minimum(signed, 1.0).mean()) if len(signed) else 1.0


def fit_corners(
    signal: Signal,
    windows: Windows,
    start: CornerState,
    curvature_per_px: FloatArray,
    *,
    iterations: int,
    tolerance_px: float = 1e-3,
) -> CornerFit:
    """Fit all corners from ``start``; ``curvature_per_px`` (N, 2) of the two edges; at most ``iterations`` steps each.

    Angle k is that of edge k: edge 0 runs along the columns' direction, edge 1 along the rows'. A corner is done when
    a step moves it by less than ``tolerance_px``, or by less than 3 % of what the noise does.
    """
    count = len(start.points_px)
    curvature = curvature_per_px.astype(np.float32)
    best = start
    damping = np.full(count, _FIRST_DAMPING)
    normal, slope, cost = _normal_equations(signal, windows, best, curvature)
    active = np.isfinite(cost)
    todo = np.nonzero(active)[0]
    for _ in range(iterations):
        if not len(todo):
            break
        step = _solve(normal[todo], slope[todo], damping[todo])
        close = np.maximum(tolerance_px, 0.03 / np.sqrt(np.maximum(normal[todo, 0, 0], normal[todo, 1, 1])))
        # So small a step is taken without looking again: what it leaves is smaller still.
        done = (np.abs(step[:, :2]).max(axis=1) < close) & (damping[todo] <= _FIRST_DAMPING)
        done &= (np.abs(step[:, 2:]) < _SMALL_STEPS).all(axis=1)
        best = _placed(best, todo[done], _moved(_taken(best, todo[done]), step[done]))
        todo, step = todo[~done], step[~done]
        if not len(todo):
            break
        trial = _moved(_taken(best, todo), step)
        new_normal, new_slope, new_cost = _normal_equations(signal, windows.of(todo), trial, curvature[todo])
        better = np.isfinite(new_cost) & (new_cost <= cost[todo] * (1 + 1e-3))
        good = todo[better]
        best = _placed(best, good, _taken(trial, np.nonzero(better)[0]))
        normal[good], slope[good], cost[good] = new_normal[better], new_slope[better], new_cost[better]
        damping[todo] = np.where(better, damping[todo] * 0.1, damping[todo] * 10)
    pixels = windows.used.sum(axis=1).astype(np.int64)
    usable = active & (pixels >= _LEAST_PIXELS)
    covariance = np.full((count, 2, 2), np.nan)
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-30))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    usable &= np.linalg.eigvalsh(scaled)[:, 0] > 1e-7
    inverse = np.linalg.inv(scaled[usable]) / (scale[usable, :, None] * scale[usable, None, :])
    covariance[usable] = inverse[:, :2, :2]
    chi2 = np.where(usable, cost / np.maximum(pixels - PARAMETERS, 1), np.nan)
    return CornerFit(best, covariance, chi2, pixels)


def _normal_equations(
    signal: Signal, windows: Windows, state: CornerState, curvature: Pixels
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """J^T W J (N, 7, 7), J^T W r (N, 7) and r^T W r (N,) with r = measured - model."""
    count = len(windows.centres)
    product = np.empty((count, PARAMETERS + 1, PARAMETERS + 1))
    # A few corners at a time: their pixels and derivatives then stay in the processor's cache.
    block = max(1, _BLOCK_PIXELS // windows.values.shape[1])
    for start in range(0, count, block):
        some = np.arange(start, min(start + block, count))
        product[some] = _products(signal, windows.of(some), _taken(state, some), curvature[some])
    return product[:, :7, :7].copy(), product[:, :7, 7].copy(), product[:, 7, 7].copy()


def _products(signal: Signal, windows: Windows, state: CornerState, curvature: Pixels) -> FloatArray:
    """(N, 8, 8): the weighted products of the seven derivatives and, last, the residual."""
    shape = _shape(windows, state, curvature)
    gain, offset = state.gain.astype(np.float32)[:, None], state.offset.astype(np.float32)[:, None]
    model = offset + gain * shape.value
    spread = np.float32(signal.variance_bright - signal.variance_dark)
    variance = np.float32(signal.variance_dark) + spread * np.clip(model, 0.0, 1.0)
    root = np.sqrt(windows.used / variance)
    cos, sin = shape.cos, shape.sin
    jacobian = np.empty((len(root), PARAMETERS + 1, root.shape[1]), dtype=np.float32)
    rise1, rise2 = gain * shape.slope1 * root, gain * shape.slope2 * root
    jacobian[:, 0] = sin[:, :1] * rise1 + sin[:, 1:] * rise2
    jacobian[:, 1] = -cos[:, :1] * rise1 - cos[:, 1:] * rise2
    jacobian[:, 2] = -shape.t1 * rise1
    jacobian[:, 3] = -shape.t2 * rise2
    jacobian[:, 4] = -shape.d1 * rise1 - shape.d2 * rise2
    jacobian[:, 5] = root
    jacobian[:, 6] = shape.value * root
    jacobian[:, 7] = (windows.values - model) * root
    return np.asarray(np.matmul(jacobian, jacobian.transpose(0, 2, 1)), dtype=np.float64)


def _solve(normal: FloatArray, slope: FloatArray, damping: FloatArray) -> FloatArray:
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-30))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    scaled[:, np.arange(PARAMETERS), np.arange(PARAMETERS)] = 1 + np.maximum(damping, 1e-7)[:, None]
    return np.asarray(np.linalg.solve(scaled, (slope / scale)[..., None])[..., 0] / scale, dtype=np.float64)


def _moved(state: CornerState, step: FloatArray) -> CornerState:
    reach = np.maximum(2.0, state.sigma_px)[:, None]
    return CornerState(
        points_px=state.points_px + np.clip(step[:, :2], -reach, reach),
        angles=state.angles + np.clip(step[:, 2:4], -0.3, 0.3),
        sigma_px=np.clip(state.sigma_px * np.exp(np.clip(step[:, 4], -0.7, 0.7)), SHARPEST_SIGMA_PX, 100.0),
        offset=state.offset + step[:, 5],
        gain=state.gain + step[:, 6],
    )


def _taken(state: CornerState, which: IntArray) -> CornerState:
    return CornerState(
        state.points_px[which], state.angles[which], state.sigma_px[which], state.offset[which], state.gain[which]
    )


def _placed(state: CornerState, which: IntArray, new: CornerState) -> CornerState:
    points, angles, sigma = state.points_px.copy(), state.angles.copy(), state.sigma_px.copy()
    offset, gain = state.offset.copy(), state.gain.copy()
    points[which], angles[which], sigma[which] = new.points_px, new.angles, new.sigma_px
    offset[which], gain[which] = new.offset, new.gain
    return CornerState(points, angles, sigma, offset, gain)
