"""Fine measurement: the maximum-likelihood fit of a blurred corner to the pixels, all corners of a board at once.

Two edges cross at (x, y). With signed distances d1, d2 to the edges, and a blur of the standard deviation s,

    I = o + g F(d1 / s, d2 / s; rho),

F the blurred product of the edges' signs (see :mod:`calibration.detect.kernel`), rho the cosine between their normals.
The box of a pixel is part of s (it adds 1/12 px^2 to the variance along any direction). An edge may be bent, as a
straight line seen through a lens is: d is then d_line - curvature / 2 * ((way along the edge)^2 + s^2), the curvature
known from the grid: blurred, a bent edge moves towards its centre of curvature.

Free for each corner: x, y, two angles, ln s, o, g. Gauss-Newton with Levenberg's damping, weights from the noise at
the model's light, so the inverse normal matrix is the Cramer-Rao bound and is returned as the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.detect.kernel import Kernel, kernel_for
from calibration.detect.windows import SHARPEST_SIGMA_PX, CornerState, Pixels, Windows
from calibration.types import FloatArray, IntArray

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

PARAMETERS = 7
_FIRST_DAMPING = 1e-3
_LEAST_PIXELS = 21
_SMALL_STEPS = (0.05, 0.04, 0.04)  # ln s, and offset and gain as shares of the gain
_BLOCK_PIXELS = 16000


@dataclass(frozen=True, slots=True, eq=False)
class CornerFit:
    """The fitted ``state``; ``covariance_px2`` (N, 2, 2) at the assumed noise; ``chi2`` (N,) mean squared residual over
    the noise variance; ``pixels`` (N,) used; ``bend_px2`` (N, 2): for a curvature that is more by 1/px than was
    assumed, each edge stands so far back along its normal (-sin, cos). Covariance and chi2 are NaN for a corner that
    could not be fitted.
    """

    state: CornerState
    covariance_px2: FloatArray
    chi2: FloatArray
    pixels: IntArray
    bend_px2: FloatArray


@dataclass(slots=True, eq=False)
class Shape:
    """The model's F over the windows and what its derivatives need."""

    value: Pixels
    slope1: Pixels  # dF/dd1 without the factor of the gain
    slope2: Pixels
    d1: Pixels
    d2: Pixels
    t1: Pixels
    t2: Pixels


def corner_shape(windows: Windows, state: CornerState, curvature: Pixels | None, kernel: Kernel) -> Shape:
    """F of ``state`` (in the windows' pixels) over the windows; ``curvature`` (N, 2) or None for straight edges."""
    cos, sin = np.cos(state.angles), np.sin(state.angles)
    local = state.points_px - windows.centres
    way = (cos * local[:, :1] + sin * local[:, 1:]).astype(np.float32)
    off = (cos * local[:, 1:] - sin * local[:, :1]).astype(np.float32)
    cosine, sine = cos.astype(np.float32), sin.astype(np.float32)
    spread = (state.sigma_px**2).astype(np.float32)[:, None]
    ways: list[Pixels] = []
    distances: list[Pixels] = []
    for edge in (0, 1):
        one = slice(edge, edge + 1)
        t = cosine[:, one] * windows.du
        t += sine[:, one] * windows.dv
        t -= way[:, one]
        d = cosine[:, one] * windows.dv
        d -= sine[:, one] * windows.du
        d -= off[:, one]
        if curvature is not None:
            # Blurred, a curved edge lies nearer to its centre of curvature: the mean of (t + a)^2 is t^2 + sigma^2.
            half = 0.5 * curvature[:, one]
            bend = t * half
            bend *= t
            bend += half * spread
            d -= bend
        ways.append(t)
        distances.append(d)
    d1, d2 = distances
    scale = (1 / state.sigma_px).astype(np.float32)[:, None]
    value, slope1, slope2, turned = cv2.split(kernel.at(d1 * scale, d2 * scale))
    turned *= (np.cos(state.angles[:, :1] - state.angles[:, 1:]) - kernel.cosine).astype(np.float32)
    value += turned
    slope1 *= scale
    slope2 *= scale
    return Shape(value, slope1, slope2, d1, d2, ways[0], ways[1])


def explained(windows: Windows, state: CornerState) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(share of the windows' variance that F explains, offset, gain), (N,) each, with offset and gain solved for."""
    count = np.maximum(windows.used.sum(axis=1, dtype=np.float64), 1.0)
    value = corner_shape(windows, state, None, kernel_for(1.0, state.angles)).value
    mean = np.einsum("np,np->n", windows.used, windows.values) / count
    middle = np.einsum("np,np->n", windows.used, value) / count
    flat = value - middle[:, None].astype(np.float32)
    flat *= windows.used
    centred = windows.values - mean[:, None].astype(np.float32)
    power = np.maximum(np.einsum("np,np->n", flat, flat), 1e-9)
    cross = np.einsum("np,np->n", flat, centred)
    total = np.einsum("np,np,np->n", centred, centred, windows.used)
    gain = (cross / power).astype(np.float64)
    share = cross * gain / np.maximum(total, 1e-9)
    return np.asarray(share, dtype=np.float64), np.asarray(mean - gain * middle, dtype=np.float64), gain


def edge_softness(windows: Windows, state: CornerState) -> float:
    """Mean over the pixels within half a pixel of one edge alone of 1 - |2 v - 1|, v the light between the colours.

    0 where every pixel is of one colour or the other, 0.5 where pixels are means over their area, more with a blur.
    """
    shape = corner_shape(windows, state, None, kernel_for(1.0, state.angles))
    near1, near2 = np.abs(shape.d1), np.abs(shape.d2)
    chosen = (windows.used > 0) & (np.minimum(near1, near2) < 0.5) & (np.maximum(near1, near2) > 2.0)
    offset, gain = state.offset.astype(np.float32)[:, None], state.gain.astype(np.float32)[:, None]
    signed = np.abs((windows.values - offset) / np.where(gain == 0, np.float32(1), gain))[chosen]
    return float(1 - np.minimum(signed, 1.0).mean()) if len(signed) else 1.0


def fit_corners(
    windows: Windows,
    start: CornerState,
    curvature_per_px: FloatArray | None,
    *,
    iterations: int,
    gaussian_share: float = 1.0,
    tolerance_px: float = 1e-3,
    loose: float = 1.0,
) -> CornerFit:
    """Fit all corners from ``start``; ``curvature_per_px`` (N, 2) of the two edges; at most ``iterations`` steps each.

    Everything in the windows' own pixels; ``gaussian_share`` is the blur's kind, as in :func:`kernel_for`. Angle k is
    that of edge k: edge 0 runs along the columns' direction, edge 1 along the rows'. A corner is done when a step moves
    it by less than ``tolerance_px``: a Gauss-Newton step leaves about its own square over the blur, so the step is
    taken without looking again. ``loose`` widens what blur, offset and gain may still change by then: they matter where
    covariance and residuals are asked for.
    """
    count = len(start.points_px)
    curvature = None if curvature_per_px is None else curvature_per_px.astype(np.float32)
    kernel = kernel_for(gaussian_share, start.angles)
    best = start.copy()
    damping = np.full(count, _FIRST_DAMPING)
    product = _products(windows, best, curvature, kernel)
    cost = product[:, 7, 7].copy()
    active = np.isfinite(cost)
    todo = np.nonzero(active)[0]
    left = cost.copy()
    for _ in range(iterations):
        if not len(todo):
            break
        step = _solve(product[todo], damping[todo])
        trial = _moved(best.of(todo), step)
        done = (np.abs(trial.points_px - best.points_px[todo]).max(axis=1) < tolerance_px) & (
            damping[todo] <= _FIRST_DAMPING
        )
        unit = np.ones((len(todo), 3))
        unit[:, 1:] = np.abs(best.gain[todo])[:, None]
        done &= (np.abs(step[:, 4:]) < loose * np.array(_SMALL_STEPS) * unit).all(axis=1)
        # A turn moves an edge's far pixels: by this much in the mean over its window.
        power = np.maximum(np.einsum("nii->ni", product[todo])[:, :4], 1e-30)
        done &= (np.abs(step[:, 2:4]) * np.sqrt(power[:, 2:] / power[:, :2]) < tolerance_px).all(axis=1)
        if done.any():
            ready = np.nonzero(done)[0]
            best.put(todo[ready], trial.of(ready))
            # What the step is expected to take off the cost: the gradient is linear so near to the minimum.
            left[todo[ready]] = cost[todo[ready]] - np.einsum("nk,nk->n", step[ready], product[todo[ready], :7, 7])
            rest = np.nonzero(~done)[0]
            todo, trial = todo[rest], trial.of(rest)
            if not len(todo):
                break
        found = _products(windows.of(todo), trial, None if curvature is None else curvature[todo], kernel)
        new_cost = found[:, 7, 7]
        better = np.nonzero(np.isfinite(new_cost) & (new_cost <= cost[todo] * (1 + 1e-3)))[0]
        good = todo[better]
        best.put(good, trial.of(better))
        product[good] = found[better]
        cost[good] = left[good] = new_cost[better]
        change = np.full(len(todo), 10.0)
        change[better] = 0.1
        damping[todo] *= change
    return _fitted(windows, best, product, left, active)


def _fitted(
    windows: Windows, state: CornerState, product: FloatArray, cost: FloatArray, active: NDArray[np.bool_]
) -> CornerFit:
    count = len(cost)
    pixels = windows.used.sum(axis=1).astype(np.int64)
    normal = product[:, :7, :7]
    usable = active & (pixels >= _LEAST_PIXELS)
    covariance = np.full((count, 2, 2), np.nan)
    diagonal = np.maximum(np.einsum("nii->ni", normal), 1e-30)
    scale = np.sqrt(diagonal)
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    usable &= np.isfinite(scaled).all(axis=(1, 2))
    which = np.nonzero(usable)[0]
    scaled = scaled[which]
    scaled[:, np.arange(PARAMETERS), np.arange(PARAMETERS)] = 1 + 1e-9
    inverse = np.linalg.inv(scaled) if len(which) else scaled
    # The inverse's diagonal is how much a parameter's variance grows because the others are free: huge when singular.
    sure = (np.einsum("nii->ni", inverse) < 1e7).all(axis=1) & (np.einsum("nii->ni", inverse) > 0).all(axis=1)
    usable[which[~sure]] = False
    which, inverse = which[sure], inverse[sure]
    normals = inverse[:, :2, :2] / (scale[which, :2, None] * scale[which, None, :2])
    across = _crossing(state.angles[which])
    covariance[which] = across @ normals @ across.transpose(0, 2, 1)
    chi2 = np.full(count, np.nan)
    chi2[which] = np.maximum(cost[which], 0.0) / np.maximum(pixels[which] - PARAMETERS, 1)
    bend = 0.5 * diagonal[:, 2:4] / diagonal[:, :2]
    return CornerFit(state, covariance, chi2, pixels, bend)


def _crossing(angles: FloatArray) -> FloatArray:
    """(N, 2, 2): how a corner moves, (x, y), for shifts of its edges along their normals (-sin, cos)."""
    cos, sin = np.cos(angles), np.sin(angles)
    turn = cos[:, 0] * sin[:, 1] - sin[:, 0] * cos[:, 1]
    turn = np.where(np.abs(turn) < 1e-3, 1e-3, turn)
    matrix = np.empty((len(angles), 2, 2))
    matrix[:, 0, 0], matrix[:, 0, 1] = cos[:, 1], -cos[:, 0]
    matrix[:, 1, 0], matrix[:, 1, 1] = sin[:, 1], -sin[:, 0]
    return np.asarray(matrix / turn[:, None, None])


def shifted(angles: FloatArray, shifts_px: FloatArray) -> FloatArray:
    """(N, 2): how corners move when edge k of each moves by ``shifts_px`` (N, 2) along its normal (-sin, cos)."""
    return np.asarray(np.einsum("nij,nj->ni", _crossing(angles), shifts_px))


def _products(windows: Windows, state: CornerState, curvature: Pixels | None, kernel: Kernel) -> FloatArray:
    """(N, 8, 8): the weighted products of the seven derivatives and, last, the residual.

    The first two derivatives are along the edges' normals: with respect to x and y they are sums of these two.
    """
    count = len(windows.centres)
    product = np.empty((count, PARAMETERS + 1, PARAMETERS + 1))
    # Some corners at a time: their pixels and derivatives then stay in the processor's cache.
    block = max(1, _BLOCK_PIXELS // windows.values.shape[1])
    for start in range(0, count, block):
        some = slice(start, min(start + block, count))
        part = CornerState(
            state.points_px[some], state.angles[some], state.sigma_px[some], state.offset[some], state.gain[some]
        )
        product[some] = _block_products(
            windows.block(some.start, some.stop), part, None if curvature is None else curvature[some], kernel
        )
    return product


def _block_products(windows: Windows, state: CornerState, curvature: Pixels | None, kernel: Kernel) -> Pixels:
    shape = corner_shape(windows, state, curvature, kernel)
    gain, offset = state.gain.astype(np.float32)[:, None], state.offset.astype(np.float32)[:, None]
    model = gain * shape.value
    model += offset
    spread = np.float32(windows.variance_bright - windows.variance_dark)
    variance = np.clip(model, 0.0, 1.0)
    variance *= spread
    variance += np.float32(windows.variance_dark)
    np.divide(windows.used, variance, out=variance)
    root = np.sqrt(variance, out=variance)
    jacobian = np.empty((len(root), PARAMETERS + 1, root.shape[1]), dtype=np.float32)
    rise1 = np.multiply(shape.slope1, root, out=jacobian[:, 0])
    rise1 *= gain
    rise2 = np.multiply(shape.slope2, root, out=jacobian[:, 1])
    rise2 *= gain
    np.multiply(shape.t1, rise1, out=jacobian[:, 2])
    np.multiply(shape.t2, rise2, out=jacobian[:, 3])
    wide = np.multiply(shape.d1, rise1, out=jacobian[:, 4])
    shape.d2 *= rise2
    wide += shape.d2
    jacobian[:, 5] = root
    np.multiply(shape.value, root, out=jacobian[:, 6])
    np.subtract(windows.values, model, out=model)
    np.multiply(model, root, out=jacobian[:, 7])
    return np.asarray(np.matmul(jacobian, jacobian.transpose(0, 2, 1)))


def _solve(product: FloatArray, damping: FloatArray) -> FloatArray:
    """Steps (N, 7) in the derivatives' own terms."""
    normal = product[:, :7, :7]
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-30))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    scaled[:, np.arange(PARAMETERS), np.arange(PARAMETERS)] = 1 + np.maximum(damping, 1e-7)[:, None]
    return np.asarray(np.linalg.solve(scaled, (product[:, :7, 7] / scale)[..., None])[..., 0] / scale)


def _moved(state: CornerState, step: FloatArray) -> CornerState:
    reach = np.maximum(2.0, state.sigma_px)[:, None]
    # The derivatives are with respect to an edge's distance from a pixel: an edge that moves lessens it.
    move = shifted(state.angles, -step[:, :2])
    return CornerState(
        points_px=state.points_px + np.clip(move, -reach, reach),
        angles=state.angles - np.clip(step[:, 2:4], -0.3, 0.3),
        sigma_px=np.clip(state.sigma_px * np.exp(np.clip(-step[:, 4], -0.7, 0.7)), SHARPEST_SIGMA_PX, 100.0),
        offset=state.offset + step[:, 5],
        gain=state.gain + step[:, 6],
    )
