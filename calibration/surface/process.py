"""Smooth surfaces through noisy values over (zoom, focus): Gaussian processes whose smoothness the data choose.

Each quantity is a trend (polynomial) plus a stationary process with covariance

    k = s^2 M(|dz| / l) (1 + b M(|dt| / m)) / (1 + b),   M(r) = (1 + sqrt5 r + 5 r^2 / 3) exp(-sqrt5 r),

Matern 5/2 over zoom and over focus: ``l`` says how fast it changes over zoom, ``b`` how much of that differs with
focus. The restricted likelihood of the data (trend integrated out, s^2 profiled; Rasmussen and Williams, Gaussian
Processes for Machine Learning, 2006, section 2.7) weighs a fixed set of (l, b, m), and the process used is the one
whose covariance is their weighted sum: with few levels no single choice is certain, and the sum keeps both the
smooth and the rough reading. Several quantities of a level are solved together (:class:`Joint`), so that the
correlation of their errors counts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.errors import NotConverged
from calibration.types import FloatArray

LENGTHS = tuple(np.geomspace(0.08, 3.0, 12).tolist())
"""Over the zoom range 0..1; a lens that changes faster than 0.08 is no smooth lens between the levels of any table."""

_LENGTH_PRIOR = (math.log(0.5), 0.7)
# Median and spread (of the logarithm) of how fast zoom lenses change: half the zoom range, a factor of 2 either way.
_FOCUS_SHARES = (0.003, 0.05, 1.0)
_FOCUS_LENGTHS = (1.0,)
_NUGGET = 1e-8
# Of the process's variance: what keeps its matrix invertible.
_LEAST_WEIGHT = 1e-3
_MOST_LEVELS_TO_CHOOSE = 60
# More levels than these tell the smoothness no better, and their matrices cost more.


def matern(distance: FloatArray) -> FloatArray:
    """Matern 5/2 covariance of a distance over its length."""
    r = math.sqrt(5.0) * distance
    return np.asarray((1.0 + r + r * r / 3.0) * np.exp(-r))


@dataclass(frozen=True, slots=True)
class Shape:
    """One covariance's shape: lengths over zoom and focus, and the share of focus (0: none)."""

    length: float
    share: float
    focus_length: float

    def between(self, zoom_distance: FloatArray, focus_distance: FloatArray) -> FloatArray:
        """Correlation at these distances."""
        along = matern(zoom_distance / self.length)
        if self.share == 0.0:
            return along
        across = matern(focus_distance / self.focus_length)
        return np.asarray(along * (1.0 + self.share * across) / (1.0 + self.share))


@dataclass(frozen=True, slots=True)
class Trend:
    """A polynomial: orders of zoom, and with several focuses one of focus and one of both."""

    zoom_order: int
    focus: bool = False
    both: bool = False

    @classmethod
    def for_places(cls, zoom: FloatArray, focus: FloatArray) -> Trend:
        """What so many places can tell while two or more are left over to show how far it is from the truth."""
        zooms, focuses = len(set(zoom.tolist())), len(set(focus.tolist()))
        order = max(0, min(2, zooms - 3)) if zooms > 2 else max(zooms - 1, 0)
        spare = len(zoom) - (order + 1) - 2
        has_focus = focuses > 1 and spare >= 1
        return cls(order, has_focus, has_focus and zooms > 1 and spare >= 2)

    def at(self, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        """Its terms (N, P)."""
        terms = [zoom**i for i in range(self.zoom_order + 1)]
        if self.focus:
            terms.append(focus)
        if self.both:
            terms.append(focus * zoom)
        return np.stack(terms, axis=-1)


@dataclass(frozen=True, slots=True)
class Smoothness:
    """The covariance of one quantity: a sum of shapes, each with its variance."""

    trend: Trend
    parts: tuple[tuple[float, Shape], ...]
    log_likelihood: float

    @property
    def variance(self) -> float:
        """At one place."""
        return sum(variance for variance, _ in self.parts)

    def between(self, a: tuple[FloatArray, FloatArray], b: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Covariance (N, M) of the process at places ``a`` (N) with ``b`` (M), each (zoom, focus)."""
        zoom_distance = np.abs(a[0][:, None] - b[0][None, :])
        focus_distance = np.abs(a[1][:, None] - b[1][None, :])
        total = np.zeros(zoom_distance.shape)
        for variance, shape in self.parts:
            total += variance * shape.between(zoom_distance, focus_distance)
        return total


def choose_smoothness(
    zoom: FloatArray, focus: FloatArray, values: FloatArray, noise: FloatArray, expected: float
) -> Smoothness:
    """The smoothness of one quantity from its ``values`` (n,) with ``noise`` variances (n,).

    ``expected``: standard deviation from the trend that is expected beforehand; it counts as one further value, so
    that a few values that happen to lie on the trend do not make it certain.
    """
    trend = Trend.for_places(zoom, focus)
    if len(values) > _MOST_LEVELS_TO_CHOOSE:
        some = np.unique(np.linspace(0, len(values) - 1, _MOST_LEVELS_TO_CHOOSE).astype(int))
        zoom, focus, values, noise = zoom[some], focus[some], values[some], noise[some]
    zoom_distance = np.abs(zoom[:, None] - zoom[None, :])
    focus_distance = np.abs(focus[:, None] - focus[None, :])
    terms = trend.at(zoom, focus)
    shapes = _shapes(len(set(focus.tolist())) > 1)
    correlations = np.stack([shape.between(zoom_distance, focus_distance) for shape in shapes])
    variances, likelihoods = _profile(correlations, terms, values, noise, expected)
    priors = [-0.5 * ((math.log(shape.length) - _LENGTH_PRIOR[0]) / _LENGTH_PRIOR[1]) ** 2 for shape in shapes]
    found = [*zip((likelihoods + np.array(priors)).tolist(), variances.tolist(), shapes, strict=True)]
    best = max(likelihood for likelihood, _, _ in found)
    weights = np.array([math.exp(likelihood - best) for likelihood, _, _ in found])
    total = float(weights.sum())
    kept = [i for i in range(len(found)) if weights[i] / total > _LEAST_WEIGHT]
    share = float(weights[kept].sum())
    parts = tuple((float(weights[i]) / share * found[i][1], found[i][2]) for i in kept)
    return Smoothness(trend, parts, best + math.log(total / len(found)))


def _shapes(several_focuses: bool) -> list[Shape]:
    if not several_focuses:
        return [Shape(length, 0.0, 1.0) for length in LENGTHS]
    return [Shape(*parts) for parts in itertools.product(LENGTHS, _FOCUS_SHARES, _FOCUS_LENGTHS)]


def _profile(
    correlations: FloatArray, terms: FloatArray, values: FloatArray, noise: FloatArray, expected: float
) -> tuple[FloatArray, FloatArray]:
    """(s^2, restricted log likelihood) (S,) for correlations (S, n, n); the noise's share of s^2 comes out as well."""
    count = len(values)
    degrees = count - terms.shape[1] + 1
    variance = np.full(len(correlations), expected**2)
    likelihood = np.zeros(len(correlations))
    diagonal = np.arange(count)
    for _ in range(2):
        matrix = correlations.copy()
        matrix[:, diagonal, diagonal] += noise / variance[:, None] + _NUGGET
        inverse = np.linalg.inv(matrix)
        whitened = inverse @ terms
        gram = terms.T @ whitened
        beta = np.linalg.solve(gram, (values @ whitened)[..., None])[..., 0]
        rest = values - beta @ terms.T
        squares = np.maximum(np.einsum("sn,snm,sm->s", rest, inverse, rest), 0.0) + expected**2
        variance = np.maximum(squares / degrees, (1e-6 * expected) ** 2)
        determinant = np.linalg.slogdet(matrix)[1] + np.linalg.slogdet(gram)[1]
        likelihood = -0.5 * (degrees * np.log(variance) + determinant)
    return variance, likelihood


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Several quantities solved together over the same places.

    ``inputs``: for each quantity its (zoom-like, focus) coordinates (n,) of the levels; ``smooth``: its covariance.
    ``precision`` (Qn, Qn): inverse covariance of the values with the trends projected out, ordered quantity by
    quantity; ``weights`` (Qn,) what the covariances multiply for the mean; ``beta`` the trends' coefficients.
    """

    inputs: tuple[tuple[FloatArray, FloatArray], ...]
    smooth: tuple[Smoothness, ...]
    values: FloatArray
    inverse: FloatArray
    precision: FloatArray
    weights: FloatArray
    beta: FloatArray
    beta_covariance: FloatArray
    terms: FloatArray

    @classmethod
    def solve(
        cls,
        inputs: Sequence[tuple[FloatArray, FloatArray]],
        smooth: Sequence[Smoothness],
        values: FloatArray,
        noise: FloatArray,
    ) -> Joint:
        """From ``values`` (n, Q) and their ``noise`` covariances (n, Q, Q). Raises :class:`NotConverged`."""
        count, quantities = values.shape
        size = count * quantities
        matrix = np.zeros((size, size))
        columns = [s.trend.at(*place) for s, place in zip(smooth, inputs, strict=True)]
        terms = np.zeros((size, sum(block.shape[1] for block in columns)))
        column = 0
        for q, (covariance, place) in enumerate(zip(smooth, inputs, strict=True)):
            block = slice(q * count, (q + 1) * count)
            matrix[block, block] = covariance.between(place, place) + np.eye(count) * covariance.variance * _NUGGET
            terms[block, column : column + columns[q].shape[1]] = columns[q]
            column += columns[q].shape[1]
            for other in range(quantities):
                diagonal = np.arange(count)
                matrix[q * count + diagonal, other * count + diagonal] += noise[:, q, other]
        try:
            # Scaled to a diagonal of ones: the quantities differ by orders of magnitude.
            scale = 1 / np.sqrt(np.diag(matrix))
            factor = cho_factor(matrix * np.outer(scale, scale), lower=True)
        except np.linalg.LinAlgError as error:
            raise NotConverged("the fit over all levels", 1, math.nan) from error
        inverse = cho_solve(factor, np.eye(size)) * np.outer(scale, scale)
        stacked = values.T.ravel()
        whitened = inverse @ terms
        beta_covariance = np.linalg.inv(terms.T @ whitened)
        beta = beta_covariance @ (whitened.T @ stacked)
        precision = inverse - whitened @ beta_covariance @ whitened.T
        return cls(
            tuple(inputs),
            tuple(smooth),
            values,
            inverse,
            precision,
            inverse @ (stacked - terms @ beta),
            beta,
            np.asarray(beta_covariance, dtype=np.float64),
            terms,
        )

    @property
    def count(self) -> int:
        """How many levels."""
        return len(self.values)

    def mean(self, quantity: int, zoom: FloatArray, focus: FloatArray) -> FloatArray:
        """The surface of one quantity at places (N,)."""
        count = self.count
        covariance = self.smooth[quantity].between((zoom, focus), self.inputs[quantity])
        first = sum(s.trend.at(np.zeros(1), np.zeros(1)).shape[1] for s in self.smooth[:quantity])
        terms = self.smooth[quantity].trend.at(zoom, focus)
        along = self.beta[first : first + terms.shape[1]]
        return np.asarray(terms @ along + covariance @ self.weights[quantity * count : (quantity + 1) * count])

    def covariance(self, places: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
        """Covariance (N, Q, Q) of the quantities' surfaces at N places, given for each quantity in its coordinates."""
        count, quantities = self.values.shape
        number = len(places[0][0])
        cross = np.zeros((quantities, number, count * quantities))
        trends = np.zeros((quantities, number, self.terms.shape[1]))
        column = 0
        for q, (smooth, place) in enumerate(zip(self.smooth, places, strict=True)):
            cross[q, :, q * count : (q + 1) * count] = smooth.between(place, self.inputs[q])
            terms = smooth.trend.at(*place)
            trends[q, :, column : column + terms.shape[1]] = terms
            column += terms.shape[1]
        explained = cross @ self.inverse
        rest = trends - explained @ self.terms
        result = np.einsum("anp,pr,bnr->nab", rest, self.beta_covariance, rest, optimize=True)
        result -= np.einsum("anm,bnm->nab", explained, cross, optimize=True)
        for q, smooth in enumerate(self.smooth):
            result[:, q, q] += smooth.variance
        return np.asarray(result)

    def left_out(self, level: int) -> tuple[FloatArray, FloatArray]:
        """(residual (Q,), covariance (Q, Q)) of a level's values against the surface through all others, the level's
        own noise included: with P the precision, P_ii^-1 (P y)_i and P_ii^-1 (Rasmussen and Williams, 5.4.2)."""
        count, quantities = self.values.shape
        rows = np.arange(quantities) * count + level
        block = self.precision[np.ix_(rows, rows)]
        covariance = np.asarray(np.linalg.inv(block), dtype=np.float64)
        return covariance @ (self.precision[rows] @ self.values.T.ravel()), covariance
