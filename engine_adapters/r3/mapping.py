"""Between the product's lens and tracking conventions and the engine's, as the studio profile tells them. Pure.

The product counts k1 and k2 with the focal length as radius 1, undistorted to distorted (Brown-Conrady). An engine
whose radius 1 is s pixels has k1' = k1 (s / f_px)^2 and k2' = k2 (s / f_px)^4.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from engine_adapters.errors import ProtocolError, UnsafeText
from engine_adapters.ports import LensValues, Shown, TrackedCamera
from engine_adapters.profile import EngineSettings, PictureSettings, R3Settings, StudioProfile
from engine_adapters.r3.commands import number_text

_KEPT, _LOST = 1e-6, 1e-4
# Relative differences of a value read back: of one that was kept, and the most that an engine's few decimals excuse.

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True, slots=True)
class EngineMapping:
    """Both directions of the conversion, for one profile."""

    r3: R3Settings
    engine: EngineSettings
    picture: PictureSettings

    @classmethod
    def from_profile(cls, profile: StudioProfile) -> Self:
        """The mapping that a profile tells."""
        return cls(r3=profile.r3, engine=profile.engine, picture=profile.picture)

    @property
    def lens_exports(self) -> tuple[str, ...]:
        """Names of the exports that hold the lens."""
        names = self.r3.exports
        return (names.center_shift_x, names.center_shift_y, names.fov_x, names.k1, names.k2, names.nodal_offset)

    @property
    def state_exports(self) -> tuple[str, ...]:
        """Names of all exports that a calibration changes."""
        return (*self.lens_exports, self.r3.exports.background, self.r3.exports.object)

    def lens_to_engine(self, values: LensValues) -> tuple[tuple[str, str], ...]:
        """(export name, value text) pairs that set a lens.

        k1 and k2 are those of the engine's own polynomial, whichever way it goes: only their unit is converted.
        Raises ``UnsafeText`` for a lens that cannot be sent (field of view outside 0..180 degrees, NaN).
        """
        if not 0.0 < values.fov_x_deg < 180.0:
            raise UnsafeText(f"fov_x_deg = {values.fov_x_deg}: must be between 0 and 180 degrees")
        f_px = self._f_px(math.radians(values.fov_x_deg))
        unit = self._radius_unit_px(f_px) / f_px
        origin_x, origin_y = self._shift_origin()
        fov = self._fov_to_engine(math.radians(values.fov_x_deg))
        numbers = (
            origin_x + self.engine.center_shift_sign_x * values.center_shift_px[0],
            origin_y + self.engine.center_shift_sign_y * values.center_shift_px[1],
            # Straight through where nothing is converted, so that no digit is lost.
            values.fov_x_deg if (self.engine.fov_axis, self.engine.fov_unit) == ("x", "deg") else fov,
            values.k1 * unit**2,
            values.k2 * unit**4,
            self.engine.nodal_sign * values.nodal_offset_mm * self._nodal_scale(),
        )
        return tuple((name, number_text(name, number)) for name, number in zip(self.lens_exports, numbers, strict=True))

    def lens_from_engine(self, exports: Mapping[str, str]) -> LensValues:
        """The lens that the engine's values tell. Raises ``ProtocolError`` for a value that is no lens."""
        names = self.r3.exports
        fov_x = self._fov_from_engine(_read_number(exports, names.fov_x), names.fov_x)
        f_px = self._f_px(fov_x)
        unit = self._radius_unit_px(f_px) / f_px
        origin_x, origin_y = self._shift_origin()
        straight = (self.engine.fov_axis, self.engine.fov_unit) == ("x", "deg")
        return LensValues(
            fov_x_deg=_read_number(exports, names.fov_x) if straight else math.degrees(fov_x),
            k1=_read_number(exports, names.k1) / unit**2,
            k2=_read_number(exports, names.k2) / unit**4,
            center_shift_px=(
                self.engine.center_shift_sign_x * (_read_number(exports, names.center_shift_x) - origin_x),
                self.engine.center_shift_sign_y * (_read_number(exports, names.center_shift_y) - origin_y),
            ),
            nodal_offset_mm=self.engine.nodal_sign * _read_number(exports, names.nodal_offset) / self._nodal_scale(),
        )

    def shown_to_engine(self, shown: Shown) -> tuple[tuple[str, str], ...]:
        """(export name, value text) pairs that switch background and object."""
        on, off = self.r3.visible_on, self.r3.visible_off
        return (
            (self.r3.exports.background, on if shown in (Shown.REAL, Shown.BOTH) else off),
            (self.r3.exports.object, on if shown in (Shown.VIRTUAL, Shown.BOTH) else off),
        )

    def tracked_camera(self, packet: Mapping[str, float]) -> TrackedCamera:
        """A tracking packet (numbers by upper-case name) in product units. Raises ``ProtocolError``."""
        engine = self.engine
        metres = _METRES[engine.tracking_position_unit]
        axes = (engine.tracking_right, engine.tracking_forward, engine.tracking_up)
        right, forward, up = (_read_axis(packet, axis) * metres for axis in axes)
        return TrackedCamera(
            name=self.r3.tracking_camera,
            pivot_m=(right, forward, up),
            pan_deg=_read_axis(packet, engine.tracking_pan),
            tilt_deg=_read_axis(packet, engine.tracking_tilt),
            roll_deg=_read_axis(packet, engine.tracking_roll),
            fov_x_deg=packet.get("FOVX"),
            fov_y_deg=packet.get("FOVY"),
        )

    def _f_px(self, fov_x: float) -> float:
        """Horizontal focal length, pixels, of a horizontal field of view in radians."""
        return self.picture.image_size[0] / 2.0 / math.tan(fov_x / 2.0)

    def _radius_unit_px(self, f_px: float) -> float:
        """The engine's radius 1 in horizontal pixels. A vertical pixel is 1 / pixel_aspect horizontal ones."""
        half_width = self.picture.image_size[0] / 2.0
        half_height = self.picture.image_size[1] / 2.0 / self.picture.pixel_aspect
        match self.engine.radius_unit:
            case "focal_length":
                return f_px
            case "half_width":
                return half_width
            case "half_height":
                return half_height
            case "half_diagonal":
                return math.hypot(half_width, half_height)
            case "sensor_mm":
                return self.picture.image_size[0] / self.picture.sensor_mm[0]

    def _shift_origin(self) -> tuple[float, float]:
        """Where the engine sees a centre shift of zero, pixels."""
        if self.engine.center_shift == "offset":
            return 0.0, 0.0
        width, height = self.picture.image_size
        first = 0.5 if self.engine.pixel_centres == "half" else 0.0
        return (width - 1) / 2.0 + first, (height - 1) / 2.0 + first

    def _fov_to_engine(self, fov_x: float) -> float:
        angle = fov_x
        if self.engine.fov_axis == "y":
            angle = 2.0 * math.atan(math.tan(fov_x / 2.0) * self._height_ratio())
        return math.degrees(angle) if self.engine.fov_unit == "deg" else angle

    def _fov_from_engine(self, value: float, name: str) -> float:
        """Horizontal field of view, radians."""
        angle = math.radians(value) if self.engine.fov_unit == "deg" else value
        if not 0.0 < angle < math.pi:
            raise ProtocolError(
                f"the engine gives {name} = {value:g} {self.engine.fov_unit}, which is no field of view; "
                "check engine.fov_unit and r3.exports of the studio profile"
            )
        return 2.0 * math.atan(math.tan(angle / 2.0) / self._height_ratio()) if self.engine.fov_axis == "y" else angle

    def _height_ratio(self) -> float:
        """tan(fov_y / 2) over tan(fov_x / 2): H / (pixel_aspect W)."""
        width, height = self.picture.image_size
        return height / (self.picture.pixel_aspect * width)

    def _nodal_scale(self) -> float:
        return 0.001 if self.engine.nodal_unit == "m" else 1.0


def same_value(asked: str, got: str) -> bool:
    """Whether an engine that was told ``asked`` and gives ``got`` back holds the value.

    Equal to a millionth, which an engine with single precision keeps; or to half of the last decimal that the engine
    writes, as long as that loses no more than a ten-thousandth of the value.
    """
    try:
        wanted, held = float(asked), float(got)
    except ValueError:
        return False
    mantissa, _, exponent = got.strip().lower().partition("e")
    decimals = len(mantissa.partition(".")[2]) - int(exponent or 0)
    written = min(0.5 * 10.0 ** -max(decimals, 0), _LOST * abs(wanted))
    return abs(held - wanted) <= max(_KEPT * abs(wanted), written * (1 + 1e-9))


def _read_number(exports: Mapping[str, str], name: str) -> float:
    text = exports.get(name)
    if text is None:
        raise ProtocolError(f"the engine gave no value for {name}")
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ProtocolError(
            f"the engine gives {name} = {text[:60]!r}, which is no number; check r3.exports of the studio profile"
        )
    return number


def _read_axis(packet: Mapping[str, float], axis: str) -> float:
    name = axis.removeprefix("-")
    value = packet.get(name.upper())
    if value is None:
        raise ProtocolError(f"the tracking packet has no {name}; check engine.tracking_* of the studio profile")
    return -value if axis.startswith("-") else value
