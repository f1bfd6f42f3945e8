"""The simulated studio's state: head, lens, engine values, frames. Pure: no sockets, no files, no clock of its own.

The output is a row of frames, one each ``picture_time_s``. Frame n shows everything that was set up to the end of
frame n - ``delay_frames``: the camera's own picture passes the engine too, so the head is delayed like a value.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from engine_adapters.sim.engine_camera import MAX_FOV_DEG, MIN_FOV_DEG, EngineCamera
from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.lens_truth import ZoomLens
from engine_adapters.sim.optics import Optics, View
from engine_adapters.sim.room import Room

MAX_PAN_DEG = 170.0
MIN_TILT_DEG, MAX_TILT_DEG = -60.0, 90.0
MAX_ROLL_DEG = 180.0
_HISTORY_S = 5.0
_FOV_AT_START_DEG = 50.0


class StudioError(SimulatorError):
    """A command that the studio refuses: unknown scene or export, a value out of range."""


@dataclass(frozen=True, slots=True)
class SceneNames:
    """What the engine's calibration scene calls its exports."""

    scene: str = "Lensmatch/Calibration"
    center_shift_x: str = "lens.center_shift_x"
    center_shift_y: str = "lens.center_shift_y"
    fov_x: str = "lens.fov_x"
    k1: str = "lens.k1"
    k2: str = "lens.k2"
    nodal_offset: str = "lens.nodal_offset"
    background_visible: str = "background.visible"
    object_visible: str = "object.visible"
    tracking_camera: str = "Cam0"


@dataclass(frozen=True, slots=True)
class HeadPose:
    """Where head and lens stand: degrees, and encoders 0..1."""

    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    zoom: float = 0.0
    focus: float = 0.0


@dataclass(frozen=True, slots=True)
class OutputState:
    """All that one output frame depends on (noise apart). ``virtual`` None: no object shown."""

    real: tuple[View, float, float] | None
    """The camera's view, its blur in px, its noise (0..255 scale)."""
    virtual: View | None


@dataclass(slots=True)
class Statistics:
    """What a client has asked for so far."""

    pictures: int = 0
    value_sets: int = 0
    movements: int = 0
    movement_s: float = 0.0
    render_ms_total: float = 0.0
    renders: int = 0


@dataclass(frozen=True, slots=True)
class _Move:
    start: HeadPose
    end: HeadPose
    begins_s: float
    ends_s: float

    def at(self, when_s: float) -> HeadPose:
        if when_s >= self.ends_s:
            return self.end
        if when_s <= self.begins_s:
            return self.start
        share = (when_s - self.begins_s) / (self.ends_s - self.begins_s)
        return HeadPose(
            *(
                getattr(self.start, name) + share * (getattr(self.end, name) - getattr(self.start, name))
                for name in HeadPose.__slots__
            )
        )


@dataclass(frozen=True, slots=True)
class StudioSetup:
    """How the studio behaves. Times in seconds, ``head_speed_deg_s`` for each axis, ``lens_travel_s`` end to end."""

    delay_frames: int = 2
    picture_time_s: float = 0.015
    head_speed_deg_s: float = 120.0
    head_settle_s: float = 0.05
    lens_travel_s: float = 0.5
    names: SceneNames = field(default_factory=SceneNames)
    camera: EngineCamera = field(default_factory=EngineCamera)

    def __post_init__(self) -> None:
        if not 0 <= self.delay_frames <= 100:
            raise SimulatorError(f"delay of {self.delay_frames} frames: give 0 to 100")
        if not (math.isfinite(self.picture_time_s) and 0.0001 <= self.picture_time_s <= 10.0):
            raise SimulatorError(f"picture time of {self.picture_time_s * 1e3:g} ms: give 0.1 to 10000")
        if not (math.isfinite(self.head_speed_deg_s) and self.head_speed_deg_s > 0.0):
            raise SimulatorError(f"head speed of {self.head_speed_deg_s:g} deg/s: give a positive number")


class Studio:
    """Head, lens and engine, and what each output frame shows. ``clock`` gives monotonic seconds."""

    def __init__(self, lens: ZoomLens, room: Room, setup: StudioSetup, *, clock: Callable[[], float]) -> None:
        self.lens = lens
        self.room = room
        self.setup = setup
        self.statistics = Statistics()
        self._clock = clock
        self._started_s = clock()
        names = setup.names
        self._meaning = {
            names.center_shift_x: "center_shift_x",
            names.center_shift_y: "center_shift_y",
            names.fov_x: "fov_x",
            names.k1: "k1",
            names.k2: "k2",
            names.nodal_offset: "nodal_offset",
            names.background_visible: "background_visible",
            names.object_visible: "object_visible",
        }
        values = dict.fromkeys(self._meaning.values(), "0")
        x0, y0 = setup.camera.shift_origin(lens.image_size)
        values |= {
            "fov_x": f"{setup.camera.fov_value(_FOV_AT_START_DEG, lens.image_size):.12g}",
            "center_shift_x": f"{x0:g}",
            "center_shift_y": f"{y0:g}",
            "background_visible": "1",
            "object_visible": "1",
        }
        self._times_s = [-math.inf]
        self._values: list[Mapping[str, str]] = [values]
        first = lens.levels[0]
        stand = HeadPose(zoom=first.zoom, focus=first.focus)
        self._moves = [_Move(stand, stand, -math.inf, -math.inf)]

    # Engine values

    def get_value(self, scene: str, export: str) -> str:
        """The value of an export as it was set. Raises :class:`StudioError`."""
        return self._values[-1][self._find(scene, export)]

    def set_value(self, scene: str, export: str, value: str) -> None:
        """Set an export; it shows after the delay. Raises :class:`StudioError` for a value the engine cannot take."""
        meaning = self._find(scene, export)
        if meaning.endswith("_visible"):
            _switch(value)
        else:
            number = _number(value)
            fov_x_deg = self.setup.camera.fov_x_deg(number, self.lens.image_size)
            if meaning == "fov_x" and not MIN_FOV_DEG <= fov_x_deg <= MAX_FOV_DEG:
                raise StudioError("FIELD OF VIEW OUT OF RANGE")
        self.statistics.value_sets += 1
        now = self._clock()
        self._times_s.append(now)
        self._values.append({**self._values[-1], meaning: value})
        self._forget(now)

    def rename(self, scene: str, export: str, new_name: str) -> None:
        """Give an export another name. Raises :class:`StudioError` if it is taken or unknown."""
        meaning = self._find(scene, export)
        if not new_name or new_name in self._meaning:
            raise StudioError("NAME IN USE")
        del self._meaning[export]
        self._meaning[new_name] = meaning

    def _find(self, scene: str, export: str) -> str:
        if scene != self.setup.names.scene:
            raise StudioError("SCENE NOT FOUND")
        if export not in self._meaning:
            raise StudioError("EXPORT NOT FOUND")
        return self._meaning[export]

    # Head and lens

    def head(self) -> HeadPose:
        """Where head and lens stand now."""
        return self._head_at(self._clock())

    def move(
        self,
        *,
        pan_deg: float | None = None,
        tilt_deg: float | None = None,
        roll_deg: float | None = None,
        zoom: float | None = None,
        focus: float | None = None,
    ) -> float:
        """Start for a place (None: stay); returns the seconds until all stands still. Raises :class:`StudioError`."""
        limits = {
            "pan_deg": (pan_deg, -MAX_PAN_DEG, MAX_PAN_DEG),
            "tilt_deg": (tilt_deg, MIN_TILT_DEG, MAX_TILT_DEG),
            "roll_deg": (roll_deg, -MAX_ROLL_DEG, MAX_ROLL_DEG),
            "zoom": (zoom, 0.0, 1.0),
            "focus": (focus, 0.0, 1.0),
        }
        wanted: dict[str, float] = {}
        for name, (value, low, high) in limits.items():
            if value is None:
                continue
            if not math.isfinite(value) or not low <= value <= high:
                raise StudioError(f"{name} = {value:g} is out of range ({low:g} to {high:g})")
            wanted[name] = value
        now = self._clock()
        start = self._head_at(now)
        end = replace(start, **wanted)
        turn = max(abs(getattr(end, name) - getattr(start, name)) for name in ("pan_deg", "tilt_deg", "roll_deg"))
        drive = max(abs(end.zoom - start.zoom), abs(end.focus - start.focus))
        takes = max(turn / self.setup.head_speed_deg_s, drive * self.setup.lens_travel_s)
        stands_in = takes + self.setup.head_settle_s if takes > 0.0 else 0.0
        self._moves.append(_Move(start, end, now, now + takes))
        self._forget(now)
        if takes > 0.0:
            self.statistics.movements += 1
            self.statistics.movement_s += stands_in
        return stands_in

    def _head_at(self, when_s: float) -> HeadPose:
        index = bisect_right(self._moves, when_s, key=lambda move: move.begins_s) - 1
        return self._moves[max(index, 0)].at(when_s)

    # Frames

    def frame_at(self, when_s: float) -> int:
        """Number of the output frame that is current at a time."""
        return math.floor((when_s - self._started_s) / self.setup.picture_time_s)

    def output(self, frame: int) -> OutputState:
        """What frame ``frame`` shows, as far as the past tells (changes still to come may be in it)."""
        until_s = self._started_s + (frame - self.setup.delay_frames + 1) * self.setup.picture_time_s
        values = self._values[bisect_left(self._times_s, until_s) - 1]
        return self._state(self._head_at(until_s), values)

    def standing(self) -> OutputState:
        """What the output will show once the delay and every movement have passed."""
        return self._state(self._moves[-1].end, self._values[-1])

    def _state(self, pose: HeadPose, values: Mapping[str, str]) -> OutputState:
        real = virtual = None
        if _switch(values["background_visible"]):
            state = self.lens.at(pose.zoom, pose.focus)
            real = self._view(pose, state.optics, state.nodal_offset_mm), state.blur_px, round(state.noise_sigma, 2)
        if _switch(values["object_visible"]):
            optics, nodal_offset_mm = self._engine_lens(values)
            virtual = self._view(pose, optics, nodal_offset_mm)
        return OutputState(real, virtual)

    def _engine_lens(self, values: Mapping[str, str]) -> tuple[Optics, float]:
        numbers = {name: float(value) for name, value in values.items() if not name.endswith("_visible")}
        return self.setup.camera.optics(numbers, self.lens.image_size, self.lens.sensor_mm)

    def _view(self, pose: HeadPose, optics: Optics, nodal_offset_mm: float) -> View:
        return View(optics, self.room.pivot_m, pose.pan_deg, pose.tilt_deg, pose.roll_deg, nodal_offset_mm)

    def _forget(self, now: float) -> None:
        """Drop what no frame of the last seconds can still show."""
        before = now - _HISTORY_S - self.setup.delay_frames * self.setup.picture_time_s
        first = bisect_left(self._times_s, before) - 1
        if first > 256:
            del self._times_s[:first], self._values[:first]
        while len(self._moves) > 1 and self._moves[1].begins_s < before:
            del self._moves[0]

    # Reports

    def tracking(self, camera: str) -> dict[str, Any]:
        """The tracking packet: metres, degrees (RotZ pan, RotX tilt, RotY roll). Raises :class:`StudioError`."""
        if camera != self.setup.names.tracking_camera:
            raise StudioError("CAMERA NOT FOUND")
        pose, values = self.head(), self._values[-1]
        width, height = self.lens.image_size
        optics, _ = self._engine_lens(values)
        axes = View(
            Optics(self.lens.image_size, 1.0), self.room.pivot_m, pose.pan_deg, pose.tilt_deg, pose.roll_deg
        ).axes
        x, y, z = self.room.pivot_m
        rotation = [[float(part) for part in row] for row in axes]
        rows = [[*row, -(row[0] * x + row[1] * y + row[2] * z)] for row in rotation]
        return {
            "FovX": self.setup.camera.fov_x_deg(float(values["fov_x"]), self.lens.image_size),
            "FovY": math.degrees(2.0 * math.atan(height / 2.0 / (optics.f_px * optics.pixel_aspect))),
            "AspectRatio": width / height,
            "PosX": x,
            "PosY": y,
            "PosZ": z,
            "RotX": pose.tilt_deg,
            "RotY": pose.roll_deg,
            "RotZ": pose.pan_deg,
            "ViewMatrix": [part for row in [*rows, [0.0, 0.0, 0.0, 1.0]] for part in row],
            "CenterX": float(values["center_shift_x"]),
            "CenterY": float(values["center_shift_y"]),
            "SensorWidth": self.lens.sensor_mm[0],
            "SensorHeight": self.lens.sensor_mm[1],
        }

    def stats(self) -> dict[str, float | int]:
        """Counts since the start, for benchmarks."""
        counted = self.statistics
        return {
            "pictures": counted.pictures,
            "changes": counted.value_sets,
            "movements": counted.movements,
            "movements_s": counted.movement_s,
            "uptime_s": self._clock() - self._started_s,
            "renders": counted.renders,
            "render_ms_mean": counted.render_ms_total / counted.renders if counted.renders else 0.0,
        }


def _switch(value: str) -> bool:
    lowered = value.strip().lower()
    if lowered in ("1", "true"):
        return True
    if lowered in ("0", "false"):
        return False
    raise StudioError("INVALID VALUE")


def _number(value: str) -> float:
    try:
        number = float(value)
    except ValueError as error:
        raise StudioError("INVALID VALUE") from error
    if not math.isfinite(number):
        raise StudioError("INVALID VALUE")
    return number
