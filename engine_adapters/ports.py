"""The ports: small Protocols between the product and the studio, in the product's own units.

Every port has a real adapter and a simulated twin; one contract suite runs on both
(``tests/contract``). Errors are those of :mod:`engine_adapters.errors`; every wait is bounded by the
adapter's own settings. A cancellation in the middle of an exchange closes the connection it was made on and
leaves the goal state unknown: state the goal again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol


class Shown(StrEnum):
    """What the engine's output shows."""

    REAL = "real"
    """Background on, object off: the camera's picture."""
    VIRTUAL = "virtual"
    """Background off, object on: the engine's own render."""
    BOTH = "both"
    NOTHING = "nothing"


@dataclass(frozen=True, slots=True)
class LensValues:
    """The lens as set in the engine, in the product's conventions (k1, k2 in focal-length units)."""

    fov_x_deg: float
    k1: float = 0.0
    k2: float = 0.0
    center_shift_px: tuple[float, float] = (0.0, 0.0)
    nodal_offset_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class EngineState:
    """All that a calibration changes in the engine, so that it can be left as it was found.

    ``exports`` holds (name, value) pairs exactly as the engine gave them, so that putting them back loses nothing.
    """

    exports: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class ReadBack:
    """One value of the lens in the engine: the export's ``name``, the text it was to hold and the text it ``got``, in
    the engine's own units. ``same``: whether they are one value, within the digits that the engine writes."""

    name: str
    asked: str
    got: str
    same: bool


@dataclass(frozen=True, slots=True)
class TrackedCamera:
    """A tracking packet, product units: pivot in metres, angles in degrees, FoV in degrees (None: not given)."""

    name: str
    pivot_m: tuple[float, float, float]
    pan_deg: float
    tilt_deg: float
    roll_deg: float
    fov_x_deg: float | None = None
    fov_y_deg: float | None = None


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """One picture as it came, not yet decoded (decoding is CPU work and belongs in an executor).

    ``data`` is a PNG, JPEG or BMP file; ``requested_at_s`` and ``received_at_s`` are readings of
    ``time.monotonic`` around the fetch; ``source`` says where it came from.
    """

    data: bytes
    requested_at_s: float
    received_at_s: float
    source: str


@dataclass(frozen=True, slots=True)
class HeadState:
    """Where head and lens stand, as their encoders tell: degrees; zoom and focus 0..1."""

    pan_deg: float
    tilt_deg: float
    roll_deg: float
    zoom: float
    focus: float


class RenderEngine(Protocol):
    """An engine whose lens and calibration scene can be set. All setters state a goal and may be repeated."""

    async def read_state(self) -> EngineState:
        """The values of everything that the setters below change, as found."""
        ...

    async def restore(self, state: EngineState) -> None:
        """Put back what :meth:`read_state` gave."""
        ...

    async def apply(self, values: LensValues) -> None:
        """Set the lens. Returns when the engine has acknowledged every value (not when it is visible)."""
        ...

    async def read_lens(self) -> LensValues:
        """The lens values as the engine now gives them back."""
        ...

    async def read_back(self, values: LensValues) -> tuple[ReadBack, ...]:
        """What the engine now holds where :meth:`apply` of these values has set it, value by value."""
        ...

    async def show(self, shown: Shown) -> None:
        """Switch background and object."""
        ...

    async def tracking(self) -> TrackedCamera:
        """The engine's current tracking packet of the profile's camera."""
        ...

    async def close(self) -> None:
        """Release the connection. Safe to call twice."""
        ...


class FrameSource(Protocol):
    """Where pictures come from."""

    async def fetch(self) -> EncodedFrame:
        """The picture that the output shows now. Freshness is the caller's to prove (see ``app.jobs``)."""
        ...

    async def close(self) -> None:
        """Release the connection. Safe to call twice."""
        ...


class CameraHead(Protocol):
    """What turns the camera and drives its lens."""

    async def move_to(self, *, pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> HeadState:
        """Turn the head; returns when it stands still, with the angles its encoders tell."""
        ...

    async def set_lens(self, *, zoom: float, focus: float) -> HeadState:
        """Drive zoom and focus (0..1); returns when the lens stands still."""
        ...

    async def read(self) -> HeadState:
        """Where head and lens stand now."""
        ...

    async def close(self) -> None:
        """Release the connection. Safe to call twice."""
        ...


class PictureFolder(Protocol):
    """A folder of pictures, by name."""

    def names(self) -> Sequence[str]:
        """Every picture file in it, sorted."""
        ...

    async def read(self, name: str) -> EncodedFrame:
        """One picture, by its name relative to the folder; nothing outside the folder is ever read."""
        ...
