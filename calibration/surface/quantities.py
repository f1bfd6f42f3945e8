"""What of a lens is interpolated, and what an error of it does to the picture.

A level becomes (log f_px, k1_hw, k2_hw, sx, sy): logarithm of the horizontal focal length in px, distortion with
radius 1 at half the picture's width, centre shift in px. These change little and smoothly where FoV and k1, k2 in
focal-length units change by orders of magnitude. With rho = r f / (W/2) the undistorted radius of a ray r in the same
unit, a picture radius is (W/2) rho (1 + k1_hw rho^2 + k2_hw rho^4), so that

    du/d(log f) = (W/2) (1 + 3 k1_hw rho^2 + 5 k2_hw rho^4) x,
    du/d(k1_hw) = (W/2) rho^2 x,  du/d(k2_hw) = (W/2) rho^4 x,  du/d(sx) = 1

with x the ray's undistorted place over half the width; the same for v.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.compare import NEGLIGIBLE_PX
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult
from calibration.types import FloatArray

QUANTITIES = ("log_f", "k1_hw", "k2_hw", "center_shift_x_px", "center_shift_y_px")
"""Order of the columns."""

UNTOLD_LEVEL_PX = 0.01
"""RMS error taken of a level that gives no sigma at all, as an imported table: it is to be followed."""

_FRAME = (9, 7)
# Columns x rows of the pixels at which an error's effect is taken; corners and edges are among them.


def frame_rays(lens: Lens) -> FloatArray:
    """Undistorted places (N, 2) over half the picture's width that cover the frame, corners included."""
    width, height = lens.image_size
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, _FRAME[0]), np.linspace(-0.5, height - 0.5, _FRAME[1]))
    rays = lens.unproject(np.stack([u.ravel(), v.ravel()], axis=-1))
    return np.asarray(rays[np.isfinite(rays[:, 0])] / lens.half_width)


def picture_jacobian(k1_hw: FloatArray, k2_hw: FloatArray, rays: FloatArray, image_size: tuple[int, int]) -> FloatArray:
    """d(u, v)/d(quantities), px: (M, N, 2, 5) for M lenses ``k1_hw``, ``k2_hw`` (M,) at ``rays`` (N, 2), places over
    half the picture's width (square pixels; v is in horizontal px)."""
    half = image_size[0] / 2
    rho2 = np.sum(rays * rays, axis=-1)
    gain = 1 + 3 * k1_hw[:, None] * rho2 + 5 * k2_hw[:, None] * rho2**2
    jacobian = np.zeros((len(k1_hw), len(rays), 2, len(QUANTITIES)))
    jacobian[..., 0] = half * gain[..., None] * rays
    jacobian[..., 1] = half * (rho2[:, None] * rays)
    jacobian[..., 2] = half * (rho2[:, None] ** 2 * rays)
    jacobian[..., 0, 3] = 1.0
    jacobian[..., 1, 4] = 1.0
    return jacobian


def overlay_of(covariance: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(rms, max) over the frame of one sigma of the overlay error, px, (M,) each, for ``covariance`` (M, 5, 5)."""
    variance = np.einsum("mnij,mjk,mnik->mn", jacobian, covariance, jacobian, optimize=True)
    variance = np.maximum(variance, 0.0)
    return np.sqrt(np.mean(variance, axis=1)), np.sqrt(np.max(variance, axis=1))


def lens_of(values: Sequence[float], image_size: tuple[int, int], pixel_aspect: float, nodal_mm: float = 0.0) -> Lens:
    """The lens of one row of quantities."""
    log_f, k1_hw, k2_hw, shift_x, shift_y = values
    f_px = math.exp(log_f)
    h2 = (image_size[0] / (2 * f_px)) ** 2
    return Lens(image_size, f_px, k1_hw / h2, k2_hw / h2**2, (shift_x, shift_y), pixel_aspect, nodal_mm)


def values_of(lens: Lens) -> FloatArray:
    """The quantities (5,) of a lens."""
    return np.array([math.log(lens.f_px), lens.k1_hw, lens.k2_hw, *lens.center_shift_px])


@dataclass(frozen=True, slots=True, eq=False)
class LevelData:
    """The levels of a table that have a lens, as numbers. ``index`` (n,): their places in ``table.levels``; ``zoom``,
    ``focus`` (n,); ``values`` (n, 5) and ``covariance`` (n, 5, 5) of the quantities; ``nodal_mm`` and its variance
    (n,), NaN where it is not told."""

    image_size: tuple[int, int]
    pixel_aspect: float
    index: tuple[int, ...]
    zoom: FloatArray
    focus: FloatArray
    values: FloatArray
    covariance: FloatArray
    nodal_mm: FloatArray
    nodal_variance: FloatArray

    @classmethod
    def of(cls, table: LensTable) -> LevelData:
        """The numbers of a table. Raises :class:`InvalidInput` when no level has a lens."""
        return cls.of_levels(table.levels, table.image_size, table.pixel_aspect)

    @classmethod
    def of_levels(
        cls, results: Sequence[LevelResult], image_size: tuple[int, int], pixel_aspect: float = 1.0
    ) -> LevelData:
        """The same of levels that are no table yet."""
        told = [i for i, level in enumerate(results) if level.fov_x_deg is not None]
        if not told:
            raise InvalidInput("levels", len(results), "none of them has a field of view; measure them again")
        levels = [results[i] for i in told]
        lenses = [level.lens(image_size, pixel_aspect) for level in levels]
        nodal = np.array([np.nan if v.nodal_offset_mm is None else v.nodal_offset_mm for v in levels])
        sigma = np.array([np.nan if v.sigma.nodal_offset_mm is None else v.sigma.nodal_offset_mm for v in levels])
        return cls(
            image_size,
            pixel_aspect,
            tuple(told),
            np.array([level.zoom for level in levels]),
            np.array([level.focus for level in levels]),
            np.array([values_of(lens) for lens in lenses]),
            np.array([_covariance(level, lens) for level, lens in zip(levels, lenses, strict=True)]),
            nodal,
            np.where(np.isfinite(nodal), np.nan_to_num(sigma, nan=0.01) ** 2, np.nan),
        )

    def __len__(self) -> int:
        return len(self.index)

    def without(self, places: Sequence[int]) -> LevelData:
        """The same without the levels at these places (of these arrays)."""
        keep = np.setdiff1d(np.arange(len(self)), np.asarray(places, dtype=int))
        return self.only(keep.tolist())

    def only(self, places: Sequence[int]) -> LevelData:
        """These levels alone."""
        keep = np.asarray(places, dtype=int)
        return LevelData(
            self.image_size,
            self.pixel_aspect,
            tuple(self.index[i] for i in keep),
            self.zoom[keep],
            self.focus[keep],
            self.values[keep],
            self.covariance[keep],
            self.nodal_mm[keep],
            self.nodal_variance[keep],
        )


def _covariance(level: LevelResult, lens: Lens) -> FloatArray:
    """Covariance (5, 5) of a level's quantities.

    From its sigmas and their correlation; where the correlation was not kept, with that of an even spread of points
    over the frame, and where there is no sigma either, of such points at :data:`UNTOLD_LEVEL_PX`. A distortion that
    the pictures did not show, and that was taken as 0, may still be one that moves the corner by
    :data:`calibration.compare.NEGLIGIBLE_PX`.
    """
    rays = frame_rays(lens)
    jacobian = picture_jacobian(np.array([lens.k1_hw]), np.array([lens.k2_hw]), rays, lens.image_size)[0]
    even = np.linalg.inv(np.einsum("nij,nik->jk", jacobian, jacobian)) * len(rays)
    sigma = level.sigma
    if sigma.fov_x_deg is None or sigma.k1 is None or sigma.k2 is None or sigma.center_shift_px is None:
        rms = level.predicted_overlay_px.rms if level.predicted_overlay_px is not None else UNTOLD_LEVEL_PX
        covariance = even * (rms**2 / _mean_variance(even, jacobian))
    else:
        # d(log f)/d(fov): f = W / (2 tan(fov / 2)), so d(log f) = -d(fov) / sin(fov).
        to_log_f = -math.radians(1.0) / math.sin(math.radians(lens.fov_x_deg))
        h2 = lens.half_width**2
        from_level = np.diag([to_log_f, h2, h2**2, 1.0, 1.0])
        from_level[1, 0], from_level[2, 0] = -2 * lens.k1_hw * to_log_f, -4 * lens.k2_hw * to_log_f
        spread = np.array([sigma.fov_x_deg, sigma.k1, sigma.k2, *sigma.center_shift_px])
        if sigma.correlation is not None:
            covariance = from_level @ (np.array(sigma.correlation) * np.outer(spread, spread)) @ from_level.T
        else:
            in_level = np.linalg.inv(from_level)
            shape = in_level @ even @ in_level.T
            scale = spread / np.sqrt(np.diag(shape))
            covariance = from_level @ (shape * np.outer(scale, scale)) @ from_level.T
    corner = float(np.max(np.sum(rays**2, axis=-1)))
    half = lens.image_size[0] / 2
    if level.k1 is None:
        covariance[1, 1] += (NEGLIGIBLE_PX / (half * corner**1.5)) ** 2
    if level.k2 is None:
        covariance[2, 2] += (NEGLIGIBLE_PX / (half * corner**2.5)) ** 2
    return covariance


def _mean_variance(covariance: FloatArray, jacobian: FloatArray) -> float:
    return float(np.mean(np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian)))
