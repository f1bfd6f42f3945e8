"""The parts of an OpenTrackIO sample that a lens table needs, as its schema (1.0.1) has them; the rest is ignored.

Only a sample itself may have other keys than the standard's; in the parts below it they are refused.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

from storage.schemas import Number, Side, Text

UD, DU = "Brown-Conrady U-D", "Brown-Conrady D-U"

Millimetres = Annotated[float, Field(strict=True, gt=0, le=1e5)]
_Unit = Annotated[float, Field(strict=True, ge=0, le=1)]
_Whole = Annotated[int, Field(strict=True, ge=1)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, alias_generator=to_camel)


class _Loose(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, alias_generator=to_camel)


class SizeMm(_Part):
    """A size on the sensor."""

    width: Millimetres
    height: Millimetres


class SizePx(_Part):
    """A size of the picture."""

    width: Side
    height: Side


class Point(_Part):
    """A place on the sensor, mm from its centre, x right, y down."""

    x: Number
    y: Number


class Distortion(_Part):
    """One of the distortions that a lens may state; ``radial`` in 1/mm^2, 1/mm^4, ..."""

    model: Text = DU
    radial: Annotated[tuple[Number, ...], Field(min_length=1, max_length=6)]
    tangential: tuple[Number, ...] = ()
    overscan: object = None


class Encoders(_Part):
    """Encoder values 0..1: focus 0 = infinity, zoom 0 = wide."""

    focus: _Unit
    zoom: _Unit
    iris: object = None


class SampleLens(_Part):
    """All the fields that a sample's lens may have; those of no use here are taken as they are."""

    pinhole_focal_length: Millimetres
    encoders: Encoders
    projection_offset: Point | None = None
    distortion_offset: Point | None = None
    distortion: Annotated[tuple[Distortion, ...], Field(min_length=1)] | None = None
    entrance_pupil_offset: object = None
    exposure_falloff: object = None
    custom: object = None
    f_stop: object = None
    t_stop: object = None
    focus_distance: object = None
    raw_encoders: object = None


class Ratio(_Part):
    """A fraction."""

    num: _Whole
    denom: _Whole


class StaticCamera(_Loose):
    """The camera of a sample's static block."""

    active_sensor_physical_dimensions: SizeMm
    active_sensor_resolution: SizePx
    anamorphic_squeeze: Ratio = Ratio(num=1, denom=1)
    label: Text | None = None
    make: Text | None = None
    model: Text | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """W, H in px."""
        return self.active_sensor_resolution.width, self.active_sensor_resolution.height

    @property
    def sensor_mm(self) -> tuple[float, float]:
        """Width and height in mm."""
        return self.active_sensor_physical_dimensions.width, self.active_sensor_physical_dimensions.height


class StaticLens(_Loose):
    """The lens of a sample's static block."""

    make: Text | None = None
    model: Text | None = None


class Static(_Loose):
    """What a source sends every few seconds; here it holds for the samples after it."""

    camera: StaticCamera
    lens: StaticLens = StaticLens()


class Note(_Loose):
    """What this program adds to its samples."""

    table: dict[str, Any]
    level: dict[str, Any]


class Sample(_Loose):
    """One sample."""

    static: Static | None = None
    lens: SampleLens
    lensmatch: Note | None = None
