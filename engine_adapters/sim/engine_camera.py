"""The simulated engine's own camera: what its export values mean, in every convention that an engine may have.

Written from the words of the studio profile alone, independent of the code that converts for an engine and of the code
that learns one, so that a mistake there cannot hide here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, Self

from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.optics import Optics

MIN_FOV_DEG, MAX_FOV_DEG = 0.01, 175.0


class RadiusUnit(StrEnum):
    """What radius 1 of k1 and k2 is."""

    FOCAL_LENGTH = "focal_length"
    HALF_WIDTH = "half_width"
    HALF_HEIGHT = "half_height"
    HALF_DIAGONAL = "half_diagonal"
    SENSOR_MM = "sensor_mm"


class Polynomial(StrEnum):
    """Which way the polynomial goes."""

    FORWARD = "undistorted_to_distorted"
    REVERSE = "reverse"


class ShiftOrigin(StrEnum):
    """What the centre shift counts from."""

    OFFSET = "offset"
    ABSOLUTE_PIXEL = "absolute_pixel"


class PixelCentres(StrEnum):
    """Where the middle of the first pixel is: at 0 or at 0.5."""

    WHOLE = "whole"
    HALF = "half"


class FovAxis(StrEnum):
    """Across or up and down."""

    X = "x"
    Y = "y"


class FovUnit(StrEnum):
    """Degrees or radians."""

    DEG = "deg"
    RAD = "rad"


class NodalUnit(StrEnum):
    """Millimetres or metres."""

    MM = "mm"
    M = "m"


@dataclass(frozen=True, slots=True)
class EngineCamera:
    """How the engine reads its exports. ``overscan``: it draws a field this many times as wide (in the tangent) as it
    is told. ``*_sign``: 1 or -1. ``pixel_aspect`` of its render: vertical over horizontal focal length in pixels."""

    radius_unit: RadiusUnit = RadiusUnit.FOCAL_LENGTH
    direction: Polynomial = Polynomial.FORWARD
    distortion_sign: int = 1
    center_shift: ShiftOrigin = ShiftOrigin.OFFSET
    pixel_centres: PixelCentres = PixelCentres.WHOLE
    center_shift_sign_x: int = 1
    center_shift_sign_y: int = 1
    fov_axis: FovAxis = FovAxis.X
    fov_unit: FovUnit = FovUnit.DEG
    overscan: float = 1.0
    nodal_unit: NodalUnit = NodalUnit.MM
    nodal_sign: int = 1
    pixel_aspect: float = 1.0

    def __post_init__(self) -> None:
        for name in ("distortion_sign", "center_shift_sign_x", "center_shift_sign_y", "nodal_sign"):
            if getattr(self, name) not in (1, -1):
                raise SimulatorError(f"engine {name}={getattr(self, name)}: give 1 or -1")
        for name in ("overscan", "pixel_aspect"):
            if not (math.isfinite(getattr(self, name)) and 0.25 <= getattr(self, name) <= 4.0):
                raise SimulatorError(f"engine {name}={getattr(self, name):g}: give 0.25 to 4")

    @classmethod
    def parse(cls, specs: tuple[str, ...]) -> Self:
        """From ``NAME=VALUE`` texts, such as ``radius_unit=half_width``. Raises :class:`SimulatorError`."""
        default = cls()
        kinds: dict[str, Callable[[str], Any]] = {f.name: type(getattr(default, f.name)) for f in fields(cls)}
        given: dict[str, Any] = {}
        for spec in specs:
            name, _, value = spec.partition("=")
            if name not in kinds:
                raise SimulatorError(f"engine {spec!r}: there is no {name!r}; there are: {', '.join(kinds)}")
            try:
                given[name] = kinds[name](value)
            except ValueError:
                kind = type(getattr(default, name))
                allowed = ", ".join(kind) if issubclass(kind, StrEnum) else "a number"
                raise SimulatorError(f"engine {spec!r}: give {allowed}") from None
        return cls(**given)

    def fov_x_deg(self, value: float, image_size: tuple[int, int]) -> float:
        """The horizontal field of view (deg) that is meant by the export's value, without overscan."""
        if (self.fov_axis, self.fov_unit) == (FovAxis.X, FovUnit.DEG):
            return value
        angle = value if self.fov_unit is FovUnit.RAD else math.radians(value)
        if self.fov_axis is FovAxis.Y and 0.0 < angle < math.pi:
            width, height = image_size
            angle = 2.0 * math.atan(math.tan(angle / 2.0) * width * self.pixel_aspect / height)
        return math.degrees(angle)

    def fov_value(self, fov_x_deg: float, image_size: tuple[int, int]) -> float:
        """The export's value for a horizontal field of view in degrees."""
        angle = math.radians(fov_x_deg)
        if self.fov_axis is FovAxis.Y:
            width, height = image_size
            angle = 2.0 * math.atan(math.tan(angle / 2.0) * height / (width * self.pixel_aspect))
        return angle if self.fov_unit is FovUnit.RAD else math.degrees(angle)

    def shift_origin(self, image_size: tuple[int, int]) -> tuple[float, float]:
        """The export values of a centre shift of zero."""
        if self.center_shift is ShiftOrigin.OFFSET:
            return 0.0, 0.0
        first = 0.5 if self.pixel_centres is PixelCentres.HALF else 0.0
        return (image_size[0] - 1) / 2.0 + first, (image_size[1] - 1) / 2.0 + first

    def optics(
        self, values: Mapping[str, float], image_size: tuple[int, int], sensor_mm: tuple[float, float]
    ) -> tuple[Optics, float]:
        """The lens that is drawn, and the nodal offset in mm, for export values by their meaning."""
        width, height = image_size
        fov_x = math.radians(self.fov_x_deg(values["fov_x"], image_size))
        f_px = width / (2.0 * math.tan(fov_x / 2.0)) / self.overscan
        half_height = height / (2.0 * self.pixel_aspect)
        unit_px = {
            RadiusUnit.FOCAL_LENGTH: f_px,
            RadiusUnit.HALF_WIDTH: width / 2.0,
            RadiusUnit.HALF_HEIGHT: half_height,
            RadiusUnit.HALF_DIAGONAL: math.hypot(width / 2.0, half_height),
            RadiusUnit.SENSOR_MM: width / sensor_mm[0],
        }[self.radius_unit]
        per_unit = f_px / unit_px
        x0, y0 = self.shift_origin(image_size)
        shift = (
            self.center_shift_sign_x * (values["center_shift_x"] - x0),
            self.center_shift_sign_y * (values["center_shift_y"] - y0),
        )
        optics = Optics(
            image_size,
            f_px,
            self.distortion_sign * values["k1"] * per_unit**2,
            self.distortion_sign * values["k2"] * per_unit**4,
            shift,
            self.pixel_aspect,
            reverse=self.direction is Polynomial.REVERSE,
        )
        in_mm = 1000.0 if self.nodal_unit is NodalUnit.M else 1.0
        return optics, self.nodal_sign * values["nodal_offset"] * in_mm
