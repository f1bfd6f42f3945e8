"""Judging a lens: pixels of overlay error between two lenses (``docs/explanations/conventions.md``)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.errors import InvalidInput
from calibration.lens import LENS_PARAMETERS, Lens
from calibration.types import FloatArray

GRID = (64, 36)
"""Columns x rows of the pixels at which lenses are compared."""

NEGLIGIBLE_PX = 1.0
"""A coefficient whose effect at the picture's edge stays below this is not judged by its relative error."""


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """Distance in px between where two lenses put the same ray. ``rms_px`` is of the distance (not per coordinate).

    ``map_px`` (36, 64) holds the distance at each grid pixel.
    """

    rms_px: float
    max_px: float
    map_px: FloatArray


def grid_pixels(image_size: tuple[int, int]) -> FloatArray:
    """The comparison grid, (36, 64, 2) pixels (u, v), from corner pixel to corner pixel."""
    width, height = image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID[0]), np.linspace(0, height - 1, GRID[1]))
    return np.stack([u, v], axis=-1)


def overlay(real: Lens, other: Lens) -> Overlay:
    """Overlay error of ``other`` against ``real``, on the grid of ``real``'s (distorted) picture.

    A grid pixel whose ray ``other`` cannot project (beyond its fold) counts as infinitely wrong; pixels that no ray
    reaches through ``real`` do not count. Raises :class:`InvalidInput` when the picture sizes differ.
    """
    if real.image_size != other.image_size:
        raise InvalidInput("image size", other.image_size, f"the other lens has {real.image_size}")
    pixels = grid_pixels(real.image_size)
    rays = real.unproject(pixels)
    seen = np.isfinite(rays[..., 0])
    distance = np.linalg.norm(other.project(rays) - pixels, axis=-1)
    distance = np.where(seen & ~np.isfinite(distance), np.inf, distance)
    counted = distance[seen]
    if counted.size == 0:
        raise InvalidInput("lens", real, "no pixel of its picture is reached by a ray")
    return Overlay(float(np.sqrt(np.mean(counted**2))), float(np.max(counted)), distance)


def predicted_overlay(lens: Lens, covariance: FloatArray) -> Overlay:
    """Expected overlay error from the covariance (5, 5) of (f_px, k1, k2, sx, sy): one sigma of the distance.

    First order: at each grid pixel C_uv = J C J^T, distance sigma = sqrt(trace C_uv).
    """
    if covariance.shape != (len(LENS_PARAMETERS), len(LENS_PARAMETERS)):
        raise InvalidInput("covariance shape", covariance.shape, "must be 5 x 5")
    rays = lens.unproject(grid_pixels(lens.image_size))
    jacobian = lens.jacobian_parameters(rays)
    variance = np.einsum("...ij,jk,...ik->...", jacobian, covariance, jacobian)
    sigma = np.sqrt(np.maximum(variance, 0))
    counted = sigma[np.isfinite(sigma)]
    return Overlay(float(np.sqrt(np.mean(counted**2))), float(np.max(counted)), sigma)


def edge_effect_px(lens: Lens) -> tuple[float, float]:
    """How far k1 and k2 each move a ray at the picture's corner, px: f |k1| r^3 and f |k2| r^5."""
    width, height = lens.image_size
    radius = math.hypot(width / 2, height / (2 * lens.pixel_aspect)) / lens.f_px
    return lens.f_px * abs(lens.k1) * radius**3, lens.f_px * abs(lens.k2) * radius**5


def relative_errors(truth: Lens, found: Lens) -> dict[str, float | None]:
    """Relative errors of fov_x_deg, k1, k2 (fractions); None where the true effect is below ``NEGLIGIBLE_PX``."""
    effect_k1, effect_k2 = edge_effect_px(truth)
    return {
        "fov_x_deg": abs(found.fov_x_deg - truth.fov_x_deg) / truth.fov_x_deg,
        "k1": abs(found.k1 - truth.k1) / abs(truth.k1) if effect_k1 > NEGLIGIBLE_PX else None,
        "k2": abs(found.k2 - truth.k2) / abs(truth.k2) if effect_k2 > NEGLIGIBLE_PX else None,
    }
