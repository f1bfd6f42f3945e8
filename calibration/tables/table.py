"""The lens table as a whole."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from calibration.errors import InvalidInput
from calibration.tables.checks import positive, printable_name
from calibration.tables.level import LevelResult
from calibration.tables.parts import Interpolation, Provenance

MAX_PICTURE_SIDE_PX = 100_000

_FOV_Y_TOLERANCE = 0.02
_F_TOLERANCE = 0.02
_HW_TOLERANCE = (0.05, 0.005)
# Relative (and for the distortion also absolute, radius 1 at half width) differences between a quantity and its twin
# in other units. A person's rounding stays below them; another radius unit, picture width or axis does not.

_SENSOR_TOLERANCE = 0.005
_ASPECT_TOLERANCE = 1e-6
# Relative. Data sheets round sensors to hundredths of a millimetre; two kinds of sensor differ by more. The pixel
# aspect is known exactly.


@dataclass(frozen=True, slots=True)
class LensTable:
    """A calibrated lens: its levels, and what holds for all of them.

    ``version`` counts the tables of one lens on one camera from 1. ``created``: an aware time, kept in UTC.
    ``image_size`` (W, H) px; ``sensor_mm`` (W, H) or None where unknown; ``pixel_aspect``: vertical over horizontal
    focal length in px. ``method``: how the levels were solved (``joint``, ``alternating``, ...). ``provenance``:
    where the table comes from, None where that was not kept.

    Raises :class:`InvalidInput` for an empty table, two results for one level, a naive time, or a level whose
    derived quantities contradict its lens.
    """

    lens: str
    camera: str
    version: int
    created: datetime
    image_size: tuple[int, int]
    method: str
    levels: tuple[LevelResult, ...]
    sensor_mm: tuple[float, float] | None = None
    pixel_aspect: float = 1.0
    interpolation: Interpolation | None = None
    provenance: Provenance | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(self.levels))
        for what in ("lens", "camera", "method"):
            printable_name(what, getattr(self, what))
        if self.version < 1:
            raise InvalidInput("version", self.version, "versions count from 1")
        if self.created.tzinfo is None:
            raise InvalidInput("created", self.created.isoformat(), "must say its time zone, for example Z for UTC")
        object.__setattr__(self, "created", self.created.astimezone(UTC))
        for side in self.image_size:
            if not 2 <= side <= MAX_PICTURE_SIDE_PX:
                raise InvalidInput("image_size", self.image_size, f"each side must be 2 to {MAX_PICTURE_SIDE_PX} px")
        for millimetres in self.sensor_mm or ():
            positive("sensor_mm", millimetres)
        positive("pixel_aspect", self.pixel_aspect)
        if not self.levels:
            raise InvalidInput("levels", self.levels, "a lens table needs at least one level")
        seen: set[tuple[float, float]] = set()
        for level in self.levels:
            key = (level.zoom, level.focus)
            if key in seen:
                raise InvalidInput("levels", key, "this (zoom, focus) stands in the table twice")
            seen.add(key)
            self._check_derived(level)

    def _check_derived(self, level: LevelResult) -> None:
        if level.fov_x_deg is None:
            return
        lens = level.lens(self.image_size, self.pixel_aspect)
        hw_relative, hw_absolute = _HW_TOLERANCE
        for name, relative, absolute in (
            ("f_px", _F_TOLERANCE, 0.0),
            ("fov_y_deg", _FOV_Y_TOLERANCE, 0.0),
            ("k1_hw", hw_relative, hw_absolute),
            ("k2_hw", hw_relative, hw_absolute),
        ):
            value, expected = getattr(level, name), getattr(lens, name)
            if value is not None and not math.isclose(value, expected, rel_tol=relative, abs_tol=absolute):
                raise InvalidInput(
                    f"{name} of level zoom {level.zoom:g}, focus {level.focus:g}",
                    value,
                    f"contradicts fov_x_deg, k1, k2 and the picture's size, which give {expected:.6g}",
                )

    def level_at(self, zoom: float, focus: float) -> LevelResult | None:
        """The level with exactly these encoder values, None where there is none."""
        return next((level for level in self.levels if (level.zoom, level.focus) == (zoom, focus)), None)


def other_picture(first: LensTable, second: LensTable) -> str | None:
    """What of their pictures keeps two tables from describing one camera, in words; None where nothing does.

    Their sizes in px and pixel aspects must be the same, and their sensors where both say them.
    """
    if first.image_size != second.image_size:
        there, here = (f"{size[0]} x {size[1]} px" for size in (first.image_size, second.image_size))
        return f"pictures of {there} there, of {here} here"
    if not math.isclose(first.pixel_aspect, second.pixel_aspect, rel_tol=_ASPECT_TOLERANCE):
        return f"pixel aspect {first.pixel_aspect:.9g} there, {second.pixel_aspect:.9g} here"
    if first.sensor_mm is not None and second.sensor_mm is not None:
        sides = zip(first.sensor_mm, second.sensor_mm, strict=True)
        if not all(math.isclose(one, other, rel_tol=_SENSOR_TOLERANCE) for one, other in sides):
            there, here = (f"{size[0]:g} x {size[1]:g} mm" for size in (first.sensor_mm, second.sensor_mm))
            return f"a sensor of {there} there, of {here} here"
    return None
