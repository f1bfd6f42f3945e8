"""A side with a thin dark strip beside it, as the shadow that a target casts on what stands close behind it.

Fitted with two levels only, such a side is drawn to the strip's far end. A shadow takes the same share of the light
of every channel, so that a line of pixels across the side is, with y the depth inside the side (see ``edge``),

    L_k = O_k ((1 - F) + q (F - S)) + I_k S,    S = Phi(y / s') G,    F = Phi((y + w) / r') G,

with O and I the light outside and inside, free for each line and channel and eliminated, q in [0, 1) the share of the
light that the shadow leaves, w(t) = w0 + w1 t its width and r >= s the blur of its far end (its penumbra). All of them,
the curve and s are those of one side: damped Gauss-Newton (Levenberg, Marquardt) on the weighted squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from calibration.types import FloatArray

_SQRT_2PI = math.sqrt(2 * math.pi)
_STARTS = ((0.8, 0.5), (2.0, 1.2), (4.0, 2.5))
"""Widths from which the fit begins, and how far within the plain side's place, px."""
_LOCAL = 5  # place, log s, w, q, log (r / s)
_LEAST_SIGMA_PX = 0.25
_LEAST_WIDTH_PX, _MOST_LEFT = 0.15, 0.9
_START_LINES = 30
_LEAST_GAIN = 60.0
"""By how much the squares must fall, over those left for each residual. Noise alone gains about 4 (a likelihood ratio
of four parameters), a blur of another shape some more."""


@dataclass(frozen=True, slots=True, eq=False)
class StripLines:
    """n lines of m pixels across one side: ``light`` (m, 3, n), ``weight`` (m, 3, n) inverse variances, ``neighbours``
    (m, 1, n), ``first``, ``stretch`` and ``t`` (n,), ``basis`` (n, terms), ``sign`` 1 where the inside lies at larger
    coordinates, else -1; ``bend`` (terms,): prior information on the coefficients; ``alike`` (n,) 0..1: how much
    a line's inside has the target's colour.
    """

    light: FloatArray
    weight: FloatArray
    neighbours: FloatArray
    first: FloatArray
    stretch: FloatArray
    t: FloatArray
    basis: FloatArray
    sign: float
    bend: FloatArray
    alike: FloatArray

    def thinned(self, most: int) -> StripLines:
        step = max(1, math.ceil(len(self.first) / most))
        part = slice(None, None, step)
        return replace(
            self,
            light=self.light[..., part],
            weight=self.weight[..., part],
            neighbours=self.neighbours[..., part],
            first=self.first[part],
            stretch=self.stretch[part],
            t=self.t[part],
            basis=self.basis[part],
            alike=self.alike[part],
        )


@dataclass(frozen=True, slots=True, eq=False)
class StripFit:
    """``coefficients`` of the side and their ``covariance`` (px^2), blur ``sigma_px``, its ``width_px`` (0: no strip)
    and the share of light ``left`` in it; of each line ``trust`` (0..1), ``chi2`` and ``information`` on its place.
    """

    coefficients: FloatArray
    covariance: FloatArray
    sigma_px: float
    width_px: float
    left: float
    trust: FloatArray
    chi2: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """``left`` 1: no strip, and only the curve and its blur move. The blur has a prior, with information ``known``."""

    coefficients: FloatArray
    log_sigma: float
    width: FloatArray  # (2,): w0, w1
    left: float
    log_far: float
    expected: float
    known: float

    @property
    def plain(self) -> bool:
        return self.left >= 1.0

    def moved(self, step: NDArray[np.float64]) -> _State:
        terms = len(self.coefficients)
        moved = replace(
            self,
            coefficients=self.coefficients + step[:terms],
            log_sigma=float(np.clip(self.log_sigma + step[terms], math.log(_LEAST_SIGMA_PX), 4.0)),
        )
        if self.plain:
            return moved
        width = self.width + step[terms + 1 : terms + 3]
        if width[0] - abs(width[1]) < 0.05:
            width = np.array([max(float(width[0]), 0.1), 0.0])
        left = float(np.clip(self.left + step[terms + 3], 0.0, _MOST_LEFT))
        return replace(moved, width=width, left=left, log_far=float(np.clip(self.log_far + step[terms + 4], 0.0, 2.0)))


def fit_strip(lines: StripLines, coefficients: FloatArray, sigma_px: float, sigma_known: float) -> StripFit:
    """Fit a side with a strip and without, from a plain side's ``coefficients``, and take the strip if it is clearly
    the likelier. ``sigma_px``: blur to begin with, known to the share ``sigma_known`` (a prior).
    """
    few = lines.thinned(_START_LINES)
    known = 1 / sigma_known**2
    log_sigma = math.log(sigma_px)
    plain = _State(coefficients, log_sigma, np.array([1.0, 0.0]), 1.0, 0.0, log_sigma, known)
    _, plain = _descend(lines, plain, 8)
    best: tuple[float, _State] | None = None
    for width, within in _STARTS:
        start = np.array(coefficients)
        start[0] += lines.sign * within
        state = _State(start, log_sigma, np.array([width, 0.0]), 0.2, 0.0, log_sigma, known)
        cost, state = _descend(few, state, 6)
        if best is None or cost < best[0]:
            best = cost, state
    state = plain
    if best is not None and _is_likelier(few, best[1], plain, len(lines.first) / len(few.first)):
        state = _descend(lines, best[1], 8)[1]
        if state.width[0] < _LEAST_WIDTH_PX or not _is_likelier(lines, state, plain, 1.0):
            state = plain
    solved = _solve(lines, state, None)
    freedom = _freedom(solved, len(coefficients))
    terms = len(coefficients)
    covariance = np.linalg.inv(solved.hessian)[:terms, :terms] * max(
        1.0, float(solved.trust @ solved.squares) / freedom
    )
    return StripFit(
        state.coefficients,
        np.asarray(covariance, dtype=np.float64),
        math.exp(state.log_sigma),
        0.0 if state.plain else float(state.width[0]),
        state.left,
        solved.trust,
        solved.squares / np.maximum(3 * (solved.pixels - 2) - 1, 1),
        solved.information,
    )


def _is_likelier(lines: StripLines, state: _State, plain: _State, more: float) -> bool:
    """Whether a strip explains the pixels clearly better; ``more``: how many times as many lines there are in all."""
    solved = _solve(lines, state, None)
    # Each line counts as much as it is trusted, in both fits alike.
    left = _priced(solved, solved.trust, state, lines)
    without = _solve(lines, plain, solved.trust)
    gained = _priced(without, solved.trust, plain, lines) - left
    return more * gained > _LEAST_GAIN * max(left / _freedom(solved, len(state.coefficients)), 1.0)


def _freedom(solved: _Solved, terms: int) -> float:
    return max(float(solved.trust @ (3.0 * (solved.pixels - 2))) - terms - 5, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    cost: float
    hessian: FloatArray
    gradient: FloatArray
    squares: FloatArray
    trust: FloatArray
    information: FloatArray
    pixels: FloatArray


def _descend(lines: StripLines, state: _State, steps: int) -> tuple[float, _State]:
    damping = 1e-2
    trust: FloatArray | None = None
    now = _solve(lines, state, trust)
    for _ in range(steps):
        trust = now.trust
        current = _priced(now, trust, state, lines)
        scaled = now.hessian + damping * np.diag(np.diag(now.hessian))
        step = np.asarray(np.linalg.solve(scaled, now.gradient), dtype=np.float64)
        tried = state.moved(step)
        after = _solve(lines, tried, trust)
        if _priced(after, trust, tried, lines) < current:
            state, damping = tried, damping / 5
            now = _solve(lines, state, None)
            if float(np.max(np.abs(step))) < 1e-3:
                break
        else:
            damping *= 8
    return _priced(now, now.trust, state, lines) / max(float(now.trust.sum()), 1.0), state


def _priced(solved: _Solved, trust: FloatArray, state: _State, lines: StripLines) -> float:
    prior = float(lines.bend @ state.coefficients**2) + state.known * (state.log_sigma - state.expected) ** 2
    return float(trust @ solved.squares) + prior


def _solve(lines: StripLines, state: _State, trust: FloatArray | None) -> _Solved:
    """Squares, gradient and curvature at a state, the two levels of each line and channel eliminated."""
    sigma = math.exp(state.log_sigma)
    far = sigma * math.exp(state.log_far)
    terms = len(state.coefficients)
    x = np.arange(lines.light.shape[0])[:, None] - (lines.basis @ state.coefficients - lines.first)
    depth = (x * lines.sign / lines.stretch)[:, None, :]
    near_z = depth / sigma
    far_z = (depth + state.width[0] + state.width[1] * lines.t) / far
    share = lines.neighbours
    s, f = ndtr(near_z) * share, ndtr(far_z) * share
    near_d = np.exp(-0.5 * near_z**2) * (share / _SQRT_2PI)
    far_d = np.exp(-0.5 * far_z**2) * (share / _SQRT_2PI)
    q = state.left
    outside = (1 - f) + q * (f - s)
    weight = lines.weight
    a, b = np.broadcast_to(outside, weight.shape), np.broadcast_to(s, weight.shape)
    wa, wb = weight * a, weight * b
    aa, ab, bb = (wa * a).sum(axis=0), (wa * b).sum(axis=0), (wb * b).sum(axis=0)
    det = aa * bb - ab * ab
    inverse = np.where(det > 1e-9 * (aa + bb) ** 2, 1 / np.where(det > 0, det, 1.0), 0.0)

    def rest(values: NDArray[np.float64]) -> tuple[FloatArray, FloatArray, FloatArray]:
        pa, pb = (wa * values).sum(axis=0), (wb * values).sum(axis=0)
        ca, cb = (bb * pa - ab * pb) * inverse, (aa * pb - ab * pa) * inverse
        return values - ca * a - cb * b, ca, cb

    residual, o, i = rest(lines.light)
    slope = -lines.sign / lines.stretch
    ds = (slope * near_d / sigma, -near_z * near_d, 0.0, 0.0, 0.0)
    df = (slope * far_d / far, -far_z * far_d, far_d / far, 0.0, -far_z * far_d)
    local = np.zeros((_LOCAL, *weight.shape))
    for index in range(2 if state.plain else _LOCAL):
        a_moves = (q - 1) * df[index] - q * ds[index]
        if index == 3:
            a_moves = f - s
        local[index] = rest(np.asarray(o * a_moves + i * ds[index]))[0]
    root = np.sqrt(weight)
    flat = (local * root).reshape(_LOCAL, -1, len(lines.first)).transpose(2, 0, 1)
    seen = (residual * root).reshape(-1, len(lines.first)).T
    curvature = flat @ flat.transpose(0, 2, 1)
    pull = (flat @ seen[:, :, None])[:, :, 0]
    squares = (seen**2).sum(axis=1)
    pixels = (weight[:, 0] > 0).sum(axis=0).astype(np.float64)
    if trust is None:
        trust = lines.alike * _trust(squares, pixels, pull[:, 0], curvature[:, 0, 0])
    chain = np.zeros((len(lines.first), _LOCAL, terms + 5))
    chain[:, 0, :terms] = lines.basis
    chain[:, 1, terms] = 1.0
    chain[:, 2, terms + 1], chain[:, 2, terms + 2] = 1.0, lines.t
    chain[:, 3, terms + 3] = chain[:, 4, terms + 4] = 1.0
    hessian = np.einsum("n,nia,nij,njb->ab", trust, chain, curvature, chain, optimize=True)
    gradient = np.einsum("n,nia,ni->a", trust, chain, pull, optimize=True)
    # Damped where the pixels say nothing: penumbra to a factor of e, width along the side to 1 px.
    hessian = hessian + np.diag(np.concatenate([lines.bend, [state.known, 0.01, 1.0, 1.0, 1.0]]) + 1e-9)
    gradient[:terms] -= lines.bend * state.coefficients
    gradient[terms] -= state.known * (state.log_sigma - state.expected)
    return _Solved(
        float(trust @ squares), hessian, gradient, squares, trust, np.asarray(curvature[:, 0, 0], np.float64), pixels
    )


def _trust(squares: FloatArray, pixels: FloatArray, pull: FloatArray, information: FloatArray) -> FloatArray:
    """Weight (0..1) of each line: small where it lies off the side, or fits far worse than the others."""
    off = pull / np.sqrt(np.maximum(information, 1e-12))
    spread = max(1.4826 * float(np.median(np.abs(off))), 0.5)
    chi2 = squares / np.maximum(3 * (pixels - 2), 1)
    worse = chi2 / max(float(np.median(chi2)), 0.3)
    return np.asarray(1 / (1 + (off / (3 * spread)) ** 4) / (1 + (worse / 6) ** 2))
