"""How an engine draws: from the lens that it is asked for to the picture that comes out.

Between the lens that is asked for, in the product's conventions, and the engine's picture stand the studio profile
and the engine's own camera. Both together are described by one small family, in which a profile that is right is the
identity:

    f_drawn = focal_gain f                                                     (overscan, another FoV axis)
    k1_hw,drawn = k1_gain k1_hw q,  k2_hw,drawn = k2_gain k2_hw q^2,  q = (f / (W/2))^(2 unit_power)
    shift_drawn = shift_gain shift + shift_offset_px,   nodal_drawn = nodal_gain nodal
    aspect_drawn = aspect_gain aspect                                          (of the pixels; no value changes it)

with the distortion's radius 1 at half the picture's width. ``unit_power`` is 0 where profile and engine count the
radius in units that stay in proportion when the lens zooms, +1 where the profile says focal lengths and the engine
counts in pixels, -1 the other way round. The polynomial takes undistorted to distorted radii (as the product's does),
or the reverse: r_u = r_d (1 + k1 r_d^2 + k2 r_d^4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.optimize import least_squares

from calibration.compare import grid_pixels
from calibration.errors import InvalidInput, NotConverged
from calibration.lens import Lens, invert_radius
from calibration.types import FloatArray

_LEAST_GAIN = 1e-3
"""A gain below this says that the engine does not follow the value at all."""
_DEAF = "the engine's picture does not follow {}: is the right export named in the studio profile?"


class Direction(StrEnum):
    """Which way an engine's polynomial goes."""

    FORWARD = "undistorted_to_distorted"
    REVERSE = "reverse"


@dataclass(frozen=True, slots=True)
class DrawnLens:
    """A lens as an engine draws it: as :class:`calibration.lens.Lens`, its polynomial in either direction."""

    lens: Lens
    direction: Direction

    def project(self, rays: FloatArray) -> FloatArray:
        """Undistorted rays (..., 2) = (X/Z, Y/Z) to pixels (..., 2); NaN where the engine draws nothing.

        Reverse: r_d solves r_d (1 + k1 r_d^2 + k2 r_d^4) = r_u on the branch through 0 (Newton, to 1e-14).
        """
        if self.direction is Direction.FORWARD:
            return self.lens.project(rays)
        r_u = np.sqrt(np.sum(rays * rays, axis=-1))
        r_d = invert_radius(r_u, self.lens.k1, self.lens.k2)
        scale = np.divide(r_d, r_u, out=np.ones_like(r_u), where=r_u > 0)
        straight = replace(self.lens, k1=0.0, k2=0.0)
        return straight.project(rays * scale[..., None])


@dataclass(frozen=True, slots=True)
class EngineModel:
    """See the module. All gains are ratios; ``shift_offset_px`` is in px, right and down."""

    direction: Direction = Direction.FORWARD
    unit_power: int = 0
    focal_gain: float = 1.0
    k1_gain: float = 1.0
    k2_gain: float = 1.0
    shift_gain: tuple[float, float] = (1.0, 1.0)
    shift_offset_px: tuple[float, float] = (0.0, 0.0)
    nodal_gain: float = 1.0
    aspect_gain: float = 1.0

    def drawn(self, asked: Lens) -> DrawnLens:
        """What the engine draws when ``asked`` is set."""
        q = (2 * asked.f_px / asked.image_size[0]) ** (2 * self.unit_power)
        shift = tuple(
            gain * value + offset
            for gain, value, offset in zip(self.shift_gain, asked.center_shift_px, self.shift_offset_px, strict=True)
        )
        lens = replace(
            asked, center_shift_px=(shift[0], shift[1]), nodal_offset_mm=self.nodal_gain * asked.nodal_offset_mm
        ).with_hw(asked.f_px * self.focal_gain, self.k1_gain * asked.k1_hw * q, self.k2_gain * asked.k2_hw * q * q)
        return DrawnLens(lens, self.direction)

    def asking_for(self, wanted: Lens) -> Lens:
        """What to ask for so that the engine draws ``wanted`` as nearly as it can.

        Exact where the polynomial goes the product's way. The reverse polynomial is fitted with focal length and shift
        to the wanted picture, least squares over the grid of :mod:`calibration.compare`; what is left,
        :func:`shortfall_px` says. Raises :class:`InvalidInput` where the engine does not follow a value that is
        needed, :class:`NotConverged` where no polynomial comes near.
        """
        told = wanted if self.direction is Direction.FORWARD else _reversed(wanted)
        f_px = told.f_px / self.focal_gain
        q = (2 * f_px / wanted.image_size[0]) ** (2 * self.unit_power)
        shift = [
            _divided(told.center_shift_px[i] - self.shift_offset_px[i], self.shift_gain[i], "the centre shift")
            for i in range(2)
        ]
        asked = replace(
            told,
            center_shift_px=(shift[0], shift[1]),
            nodal_offset_mm=_divided(told.nodal_offset_mm, self.nodal_gain, "the nodal offset"),
        )
        return asked.with_hw(
            f_px, _divided(told.k1_hw, self.k1_gain * q, "k1"), _divided(told.k2_hw, self.k2_gain * q * q, "k2")
        )

    def shortfall_px(self, wanted: Lens) -> float:
        """Largest overlay error (px) that is left between ``wanted`` and what the engine draws for it."""
        return float(np.nanmax(np.linalg.norm(_misses(self.drawn(self.asking_for(wanted)), wanted), axis=-1)))


IDENTITY = EngineModel()
"""An engine that draws what it is asked for."""


def _divided(value: float, gain: float, what: str) -> float:
    if value == 0.0:
        return 0.0
    if not math.isfinite(gain) or abs(gain) < _LEAST_GAIN:
        raise InvalidInput(f"gain of {what}", gain, _DEAF.format(what))
    return value / gain


def _misses(drawn: DrawnLens, wanted: Lens) -> FloatArray:
    """Drawn minus wanted (M, 2) px over the comparison grid; rays that the wanted lens does not see are left out."""
    pixels = grid_pixels(wanted.image_size).reshape(-1, 2)
    rays = wanted.unproject(pixels)
    seen = np.isfinite(rays).all(axis=-1)
    return np.asarray(drawn.project(rays[seen]) - pixels[seen])


def _reversed(wanted: Lens) -> Lens:
    """The lens whose reverse polynomial draws nearest to ``wanted``: f, k1, k2 and shift, least squares in px."""

    def lens_of(values: FloatArray) -> Lens:
        f_px = wanted.f_px * math.exp(values[0])
        shift = (wanted.center_shift_px[0] + values[3], wanted.center_shift_px[1] + values[4])
        return replace(wanted, center_shift_px=shift).with_hw(f_px, values[1], values[2])

    def misses(values: FloatArray) -> FloatArray:
        off = _misses(DrawnLens(lens_of(values), Direction.REVERSE), wanted)
        return np.where(np.isfinite(off), off, wanted.image_size[0]).ravel()

    # To first order r_d = r (1 + k1 r^2) is r = r_d (1 - k1 r_d^2); the second order gives k2' = 3 k1^2 - k2.
    start = np.array([0.0, -wanted.k1_hw, 3 * wanted.k1_hw**2 - wanted.k2_hw, 0.0, 0.0])
    found = least_squares(misses, start, x_scale=np.array([1e-3, 1e-2, 1e-2, 1.0, 1.0]), method="trf", max_nfev=60)
    if not found.success:
        raise NotConverged("the reverse polynomial", int(found.nfev), math.sqrt(2 * float(found.cost)))
    return lens_of(found.x)
