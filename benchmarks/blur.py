"""What a blur makes of straight edges and of two edges that cross: exact for a Gaussian and for a defocus disk.

Of a side function sgn(d - n.r) (d the signed distance of a line, n its normal) a blur whose offsets r are spread with
the density p leaves the mean over r. For one line that is its profile E(d). For two lines the mean of the product is
E(d1) E(d2) + c(d1, d2, n1.n2), where c is 0 unless both lines are within the blur's reach, and for a disk also where
the lines are perpendicular not 0: its two coordinates are not independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]

PIXEL_VARIANCE_PX2 = 1 / 12
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


@runtime_checkable
class Blur(Protocol):
    """A blur of the picture: nothing beyond ``reach_px``; its functions are to be averaged over ``offsets`` in a pixel,
    (du, dv, weight) each.
    """

    @property
    def reach_px(self) -> float: ...

    @property
    def offsets(self) -> list[tuple[float, float, float]]: ...

    def profile(self, d: Array) -> Array:
        """E(d), -1 to 1, of a line at the signed distance ``d`` px."""
        ...

    def crossing(self, d1: Array, d2: Array, cosine: Array) -> Array:
        """What the mean of two lines' product has more than the product of their profiles; ``cosine`` = n1.n2."""
        ...


@dataclass(frozen=True)
class Gaussian:
    """A Gaussian of ``sigma_px``, to which the box of a pixel adds its 1/12 px^2 of variance."""

    sigma_px: float

    @property
    def total_px(self) -> float:
        return float(np.sqrt(self.sigma_px**2 + PIXEL_VARIANCE_PX2))

    @property
    def reach_px(self) -> float:
        return 6 * self.total_px

    @property
    def offsets(self) -> list[tuple[float, float, float]]:
        return [(0.0, 0.0, 1.0)]

    def profile(self, d: Array) -> Array:
        return np.asarray(erf(d / (np.sqrt(2) * self.total_px)), dtype=np.float64)

    def crossing(self, d1: Array, d2: Array, cosine: Array) -> Array:
        """4 (Phi2 - Phi Phi): Plackett's integral of the bivariate density over the correlation from 0 to n1.n2."""
        h, k = d1 / self.total_px, d2 / self.total_px
        total = np.zeros(np.shape(h))
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            t = cosine * (node + 1) / 2
            rest = 1 - t * t
            total += weight / 2 * np.exp(-(h * h - 2 * t * h * k + k * k) / (2 * rest)) / np.sqrt(rest)
        return np.asarray(4 * cosine * total / (2 * np.pi), dtype=np.float64)


@dataclass(frozen=True)
class Disk:
    """A disk of ``radius_px``, as an aperture wide open draws a point out of focus; averaged over a pixel's box."""

    radius_px: float

    @property
    def reach_px(self) -> float:
        return self.radius_px + 1

    @property
    def offsets(self) -> list[tuple[float, float, float]]:
        half = 0.5 / np.sqrt(3)  # Gauss-Legendre, exact for cubics
        return [(du, dv, 0.25) for du in (-half, half) for dv in (-half, half)]

    def profile(self, d: Array) -> Array:
        u = np.clip(d / self.radius_px, -1, 1)
        return np.asarray((np.arcsin(u) + u * np.sqrt(1 - u * u)) * 2 / np.pi, dtype=np.float64)

    def crossing(self, d1: Array, d2: Array, cosine: Array) -> Array:
        """From the areas of the disk's two caps beyond the lines and of what they share.

        mean = 1 - 2 (C1 + C2) + 4 C12 in shares of the disk. Where the lines cross inside the disk the shared part is
        bounded by the two chords and an arc (Green's theorem); else the caps hold one another, or share nothing, or
        everything but the two rests.
        """
        a, b, cosine = np.broadcast_arrays(
            np.clip(d1 / self.radius_px, -1, 1), np.clip(d2 / self.radius_px, -1, 1), np.asarray(cosine, np.float64)
        )
        sine = np.sqrt(1 - cosine * cosine)
        first, second = (1 - self.profile(d1)) / 2, (1 - self.profile(d2)) / 2
        # n1 = (1, 0), n2 = (cosine, sine): the lines meet at (a, y).
        y = (b - cosine * a) / sine
        inside = a * a + y * y < 1
        # The ends of the chords that bound the part beyond both lines: on line 1 above y, on line 2 right of a.
        top = np.sqrt(1 - a * a)
        half = np.sqrt(1 - b * b)
        end_u, end_v = b * cosine + half * sine, b * sine - half * cosine
        arc = np.remainder(np.arctan2(top, a) - np.arctan2(end_v, end_u), 2 * np.pi)
        area = (a * end_v - y * end_u + arc + a * y - top * a) / 2
        beyond_2 = cosine * a > b  # the middle of chord 1 lies beyond line 2
        beyond_1 = cosine * b > a
        outside = np.where(
            beyond_2 & beyond_1,
            first + second - 1,
            np.where(beyond_2, first, np.where(beyond_1, second, 0.0)),
        )
        shared = np.where(inside, area / np.pi, outside)
        mean = 1 - 2 * (first + second) + 4 * shared
        return np.asarray(mean - self.profile(d1) * self.profile(d2), dtype=np.float64)
