"""A lens refitted in the other direction: from the distorted radius to the undistorted one.

Several formats hold the map distorted to undistorted ("D-U", "remove distortion"):

    r_u = r_d (1 + n1 s + n2 s^2 + ...) / (1 + m1 s + m2 s^2 + ...),   s = r_d^2

while :class:`calibration.lens.Lens` holds undistorted to distorted. Neither is the other's inverse in closed form, and
a series is useless for a strong barrel, so each is fitted to the other by least squares: over radii from the axis to
the picture's farthest corner, each with the area of its ring as weight and its error as it shows in the (distorted)
picture, px. That is the disc around the frame rather than the frame, so that the corners, few pixels as they are, hold
as well as the middle. Focal length and centre stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial

from calibration.compare import Overlay, grid_pixels
from calibration.errors import CalibrationError, InvalidInput, NotConverged
from calibration.lens import Lens, invert_radius
from calibration.types import FloatArray

_RADII = 256
# Samples from axis to corner: the fits have up to six terms, and more samples change the fifth digit of the residual.

_RATIO_STEPS = 12
# Sanathanan-Koerner steps: each divides by the denominator of the step before. Three or four settle it.


@dataclass(frozen=True, slots=True)
class InverseRadial:
    """r_u = r_d N(s)/M(s), s = r_d^2, radius in focal lengths; ``numerator`` = (n1, n2, ...), ``denominator`` alike.

    N and M begin with 1. Raises :class:`InvalidInput` for coefficients that are no numbers.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for value in (*self.numerator, *self.denominator):
            if not math.isfinite(value):
                raise InvalidInput("inverse distortion coefficient", value, "must be a finite number")

    @classmethod
    def from_unit(cls, numerator: Iterable[float], denominator: Iterable[float], unit: float) -> InverseRadial:
        """From coefficients whose radius is counted in lengths of ``unit`` focal lengths: c_n / unit^(2n)."""
        return cls(_scaled(numerator, 1 / unit), _scaled(denominator, 1 / unit))

    def in_unit(self, unit: float) -> InverseRadial:
        """The same map with its radius counted in lengths of ``unit`` focal lengths (1/F in mm: millimetres)."""
        return InverseRadial(_scaled(self.numerator, unit), _scaled(self.denominator, unit))

    def undistort_radius(self, r_d: FloatArray) -> FloatArray:
        """Undistorted radii (focal lengths) of distorted ones, elementwise; meaningless where not :meth:`sound_to`."""
        s = r_d * r_d
        return np.asarray(r_d * _polynomial(self.numerator)(s) / _polynomial(self.denominator)(s))

    def sound_to(self, radius: float) -> bool:
        """Whether the map has no pole and rises all the way from the axis to this distorted radius (focal lengths).

        By the roots of the denominator M and of the slope's numerator (N + 2 s N') M - 2 s N M' within [0, radius^2].
        """
        with np.errstate(all="ignore"):  # coefficients without measure become infinite, and are unsound
            n, m = (_polynomial(_scaled(terms, radius)) for terms in (self.numerator, self.denominator))
            twice_s = Polynomial([0.0, 2.0])
            slope = (n + twice_s * n.deriv()) * m - twice_s * n * m.deriv()
            return not (_has_root_to_1(m) or _has_root_to_1(slope))


def fit_inverse(lens: Lens, numerator_terms: int, denominator_terms: int = 0) -> InverseRadial:
    """The D-U map of so many terms that is nearest to ``lens`` over its picture.

    Raises :class:`FoldedLens` for a lens that folds inside the picture, :class:`NotConverged` where so many terms give
    no map that is sound to the farthest corner.
    """
    lens.require_unfolded()
    corner = lens.corner_radius()
    r_d = np.linspace(0, corner, _RADII + 1)[1:]
    r_u = invert_radius(r_d, lens.k1, lens.k2)
    weight = _slope(lens, r_u) * np.sqrt(r_d)
    s = (r_d / corner) ** 2
    above = [r_d * s**n for n in range(1, numerator_terms + 1)]
    below = [-r_u * s**n for n in range(1, denominator_terms + 1)]
    rows = np.stack(above + below, axis=-1)
    divisor: FloatArray = np.ones_like(r_d)
    found: FloatArray = np.zeros(numerator_terms + denominator_terms)
    steps = _RATIO_STEPS if denominator_terms else 1
    last_step = math.inf
    for _ in range(steps):
        scale = weight / divisor
        found = np.asarray(np.linalg.lstsq(rows * scale[:, None], (r_u - r_d) * scale, rcond=None)[0], np.float64)
        previous, divisor = divisor, np.asarray(_polynomial(found[numerator_terms:])(s), np.float64)
        last_step = float(np.max(np.abs(divisor - previous)))
        if np.min(divisor) <= 0:
            break
    inverse = InverseRadial.from_unit(found[:numerator_terms], found[numerator_terms:], corner)
    if not inverse.sound_to(corner):
        raise NotConverged("inverse distortion without a pole or fold in the picture", steps, last_step)
    return inverse


def inverse_overlay(lens: Lens, inverse: InverseRadial) -> Overlay:
    """Overlay error between a lens and a D-U map around the same centre, with the same focal length.

    On the grid of the map's (distorted) picture: where the lens puts the ray that the map gives a pixel. A ray beyond
    the lens's fold counts as infinitely wrong.
    """
    pixels = grid_pixels(lens.image_size)
    focal = np.array([lens.f_px, lens.pixel_aspect * lens.f_px])
    distorted = (pixels - np.array(lens.principal_point_px)) / focal
    r_d = np.linalg.norm(distorted, axis=-1)
    gain = np.divide(inverse.undistort_radius(r_d), r_d, out=np.ones_like(r_d), where=r_d > 0)
    distance = np.linalg.norm(lens.project(distorted * gain[..., None]) - pixels, axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    return Overlay(float(np.sqrt(np.mean(distance**2))), float(np.max(distance)), distance)


def best_inverse(lens: Lens, terms: Iterable[tuple[int, int]], goal_px: float) -> tuple[InverseRadial, Overlay]:
    """The first D-U map among ``terms`` (numerator, denominator) whose largest overlay error is at most ``goal_px``,
    else the one with the smallest; with its overlay error.

    Raises :class:`FoldedLens`, or :class:`NotConverged` where none of them is sound over the picture.
    """
    lens.require_unfolded()
    best: tuple[InverseRadial, Overlay] | None = None
    unsound: CalibrationError | None = None
    for numerator_terms, denominator_terms in terms:
        try:
            inverse = fit_inverse(lens, numerator_terms, denominator_terms)
        except NotConverged as error:
            unsound = error
            continue
        error_px = inverse_overlay(lens, inverse)
        if best is None or error_px.max_px < best[1].max_px:
            best = inverse, error_px
        if error_px.max_px <= goal_px:
            break
    if best is None:
        raise unsound or InvalidInput("terms", (), "names no number of terms")
    return best


def refit_lens(frame: Lens, inverse: InverseRadial) -> tuple[Lens, Overlay]:
    """The lens whose k1, k2 are nearest to a D-U map over the picture of ``frame``, all else as in ``frame``; with the
    overlay error that is left.

    r_d - r_u = k1 r_u^3 + k2 r_u^5 is linear in both. Raises :class:`InvalidInput` where the map has a pole or folds in
    the picture, :class:`FoldedLens` where the lens found does.
    """
    corner = frame.corner_radius()
    if not inverse.sound_to(corner):
        raise InvalidInput("distorted-to-undistorted map", inverse.numerator, "has a pole or folds inside the picture")
    r_d = np.linspace(0, corner, _RADII + 1)[1:]
    r_u = inverse.undistort_radius(r_d)
    reach = float(r_u[-1])
    t = r_u / reach
    rows = np.stack([t**3, t**5], axis=-1) * np.sqrt(r_d)[:, None]
    found = np.linalg.lstsq(rows, (r_d - r_u) * np.sqrt(r_d), rcond=None)[0]
    lens = replace(frame, k1=float(found[0]) / reach**3, k2=float(found[1]) / reach**5)
    lens.require_unfolded()
    return lens, inverse_overlay(lens, inverse)


def _slope(lens: Lens, r_u: FloatArray) -> FloatArray:
    """d r_d / d r_u: turns an error of the undistorted radius into one of the picture."""
    r2 = r_u * r_u
    return np.asarray(1 + r2 * (3 * lens.k1 + 5 * lens.k2 * r2))


def _polynomial(terms: Iterable[float]) -> Polynomial:
    return Polynomial([1.0, *(float(term) for term in terms)])


def _scaled(terms: Iterable[float], unit: float) -> tuple[float, ...]:
    """Each term times unit^(2n); infinite, not an error, where that is beyond numbers."""
    with np.errstate(over="ignore"):
        return tuple(
            float(term * np.float64(unit) ** (2 * n)) if term else 0.0 for n, term in enumerate(terms, start=1)
        )


def _has_root_to_1(polynomial: Polynomial) -> bool:
    """Whether a real root lies in [0, 1]; yes where the coefficients are too large to tell."""
    if not np.all(np.isfinite(polynomial.coef)):
        return True
    try:
        roots = polynomial.trim().roots()
    except np.linalg.LinAlgError:
        return True
    real = roots[np.abs(roots.imag) <= 1e-9 * (1 + np.abs(roots))].real
    return bool(np.any((real >= 0) & (real <= 1)))
