"""What a blur makes of two edges that cross, as tables: a Gaussian, a defocus disk, and a disk with a Gaussian on top.

A lens out of focus draws a point as a disk (its aperture), diffraction, a soft lens and a camera's processing as about
a Gaussian, and the box of a pixel adds to either. With offsets r spread with the density p(|r|), of variance 1 along
any direction, and the distances a = d / sigma of a place from two edges with the normals n1, n2, the light is

    F(a1, a2) = mean of sgn(a1 - n1.r) sgn(a2 - n2.r) = 4 P(u < a1, w < a2) - 2 P(u < a1) - 2 P(w < a2) + 1

for u = n1.r, w = n2.r, whose joint density is p / sqrt(1 - rho^2) at |r|^2 = (u^2 + w^2 - 2 rho u w) / (1 - rho^2), rho
= n1.n2. For a Gaussian and perpendicular edges F is the product of two error functions; for a disk it is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr

from calibration.types import FloatArray

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

Pixels = NDArray[np.float32]

REACH = 4.5
"""Standard deviations beyond which an edge is not blurred: 1e-5 of a Gaussian's step is left."""
_CELLS = 256
_COSINE_STEP = 0.1
_LARGEST_COSINE = 0.8
_LEAST_SHARE = 0.012
"""Of a Gaussian in the variance: a sharper edge of the disk would fall between the table's nodes."""
_SHARE_RATIO = 1.25
"""Shares are told apart in steps of this: so a series of pictures shares its tables."""


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """``table`` (N, N, 4) over a1 (columns) and a2 (rows), from -REACH to REACH: F, dF/da1, dF/da2 and dF/drho, at rho
    = ``cosine``.
    """

    table: Pixels
    cosine: float

    def at(self, a1: Pixels, a2: Pixels) -> Pixels:
        """The four at places ``a1``, ``a2`` (N, P), which are spoiled, linear between nodes: (N, P, 4)."""
        for a in (a1, a2):
            a *= np.float32(_CELLS / (2 * REACH))
            a += np.float32(_CELLS / 2)
        return np.asarray(cv2.remap(self.table, a1, a2, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def kernel_for(gaussian_share: float, angles: FloatArray) -> Kernel:
    """The tables for edges at ``angles`` (N, 2): their usual crossing angle to a step, the rest is linear in rho.

    ``gaussian_share``: of the blur's variance, 0 (a disk) to 1 (a Gaussian).
    """
    cosine = float(np.median(np.cos(angles[:, 0] - angles[:, 1]))) if len(angles) else 0.0
    step = round(float(np.clip(cosine, -_LARGEST_COSINE, _LARGEST_COSINE)) / _COSINE_STEP)
    level = round(np.log(np.clip(gaussian_share, _LEAST_SHARE, 1.0)) / np.log(_SHARE_RATIO))
    return _tables(level, step)


@lru_cache(maxsize=48)
def _tables(level: int, cosine_steps: int) -> Kernel:
    gaussian_share = _SHARE_RATIO**level
    cosine = cosine_steps * _COSINE_STEP
    value = _mean(gaussian_share, cosine)
    cell = 2 * REACH / _CELLS
    turned = (_mean(gaussian_share, cosine + _COSINE_STEP) - _mean(gaussian_share, cosine - _COSINE_STEP)) / (
        2 * _COSINE_STEP
    )
    by_second, by_first = np.gradient(value, cell)
    table = np.stack([value, by_first, by_second, turned], axis=-1)
    return Kernel(np.ascontiguousarray(table, dtype=np.float32), cosine)


def _mean(gaussian_share: float, cosine: float) -> FloatArray:
    """F at the table's nodes, from the density at the middles of its cells, summed."""
    middle = (np.arange(_CELLS) + 0.5) * 2 * REACH / _CELLS - REACH
    u, w = middle[None, :], middle[:, None]
    square = (u * u + w * w - 2 * cosine * u * w) / (1 - cosine * cosine)
    density = _density(square, gaussian_share)
    shared = np.zeros((_CELLS + 1, _CELLS + 1))
    shared[1:, 1:] = density.cumsum(axis=0).cumsum(axis=1)
    shared /= shared[-1, -1]
    return np.asarray(4 * shared - 2 * shared[-1:, :] - 2 * shared[:, -1:] + 1)


def _density(square: FloatArray, gaussian_share: float) -> FloatArray:
    """p at |r|^2, but for a factor: a disk of the variance that the Gaussian leaves, convolved with it.

    The share of a Gaussian about r that falls into the disk: the noncentral chi-squared distribution with 2 degrees of
    freedom.
    """
    if gaussian_share >= 1:
        return np.asarray(np.exp(-square / 2))
    radius_square = 4 * (1 - gaussian_share)
    # Far outside the disk nothing is left; between the nodes the density is smooth.
    nodes = np.linspace(0, (np.sqrt(radius_square) + 6 * np.sqrt(gaussian_share)) ** 2, 600)
    known = chndtr(radius_square / gaussian_share, 2, nodes / gaussian_share)
    return np.asarray(np.interp(square, nodes, known, right=0.0))
