"""Methods with the engine in the loop, as ask/tell objects: they decide, they never call.

The caller (``app.jobs``) does the I/O between::

    while not method.done:
        capture = method.ask()
        if capture is None:          # nothing to ask before pending captures are told
            method.tell(await next_finished())
            continue
        start(capture)               # move the head, set the lens, fetch a fresh picture, find the target
    result = method.result()

``ask`` may be called again before earlier captures were told, so that moving, fetching and finding overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np

from calibration.camera import project_points, project_target, target_points_world
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.solve.engine_model import IDENTITY, EngineModel
from calibration.solve.mistakes import Priors
from calibration.tables import LevelResult
from calibration.types import CameraPose, DetectionResult, FloatArray, Role, Target


class Source(StrEnum):
    """Which picture is wanted."""

    REAL = "real"
    """The camera's picture (background on, object off)."""
    VIRTUAL = "virtual"
    """The engine's own render of the target (background off, object on)."""


@dataclass(frozen=True, slots=True)
class Capture:
    """One picture wanted. ``step`` numbers the captures of a level from 0.

    ``lens`` is the lens to be set in the engine for a virtual picture (None: leave it). ``expected_px`` are the
    target's points where they are expected (None: no idea), ``expected_sigma_px`` how far off they may be.
    """

    step: int
    source: Source
    target: str
    pan_deg: float
    tilt_deg: float
    role: Role = Role.FREE
    lens: Lens | None = None
    expected_px: FloatArray | None = None
    expected_sigma_px: float = 0.0


@dataclass(frozen=True, slots=True)
class Observation:
    """What came of a capture: the target found or the reason why not, and the pose that the encoders told."""

    step: int
    result: DetectionResult
    camera_pose: CameraPose
    picture: str = ""


@dataclass(frozen=True, slots=True)
class LevelTask:
    """What a method must know before it starts: one zoom and focus, the surveyed room, the picture.

    ``targets`` are posed, by name; ``pivot_m`` where the camera turns (``pivot_sigma_m``: its survey);
    ``angle_sigma_deg`` the head's encoders, ``roll_sigma_deg`` its roll; ``priors``: how large other mistakes may be;
    ``nodal_offset_mm`` stands unless the pictures contradict it or tell it better, with a ``nodal_sigma_mm`` it is a
    prior; ``guess`` the lens of a level that differs little (another focus), or None; ``neighbour`` that of the level
    measured before, which only says what to look at first. ``pan_range_deg`` and ``tilt_range_deg`` bound the head.
    ``engine``: how the engine draws, as learned.
    """

    zoom: float
    focus: float
    image_size: tuple[int, int]
    targets: Mapping[str, Target]
    pivot_m: tuple[float, float, float]
    pixel_aspect: float = 1.0
    pivot_sigma_m: float = 0.0
    angle_sigma_deg: float = 0.0
    roll_sigma_deg: float | None = None
    priors: Priors = field(default_factory=Priors)
    nodal_offset_mm: float = 0.0
    nodal_sigma_mm: float = 0.0
    guess: Lens | None = None
    neighbour: Lens | None = None
    pan_range_deg: tuple[float, float] = (-90.0, 90.0)
    tilt_range_deg: tuple[float, float] = (-45.0, 45.0)
    engine: EngineModel = IDENTITY

    def __post_init__(self) -> None:
        if not self.targets:
            raise InvalidInput("targets", {}, "a level needs at least one surveyed target")
        for name, target in self.targets.items():
            if target.pose is None:
                raise InvalidInput("target", name, "a target in front of an engine needs its surveyed pose")

    def pose(self, pan_deg: float, tilt_deg: float) -> CameraPose:
        """The camera's pose at these head angles, with the task's sigmas."""
        return CameraPose(
            self.pivot_m, pan_deg, tilt_deg, 0.0, self.pivot_sigma_m, self.angle_sigma_deg, self.roll_sigma_deg
        )


class LevelMethod(Protocol):
    """One level's method. Raises :class:`calibration.errors.CalibrationError` from ``result`` when it failed."""

    @property
    def done(self) -> bool:
        """Whether :meth:`result` can be read and nothing more is asked."""
        ...

    @property
    def progress(self) -> float:
        """0..1, an estimate of how far the level is."""
        ...

    def ask(self) -> Capture | None:
        """The next picture wanted, or None while captures asked before must be told first."""
        ...

    def tell(self, observation: Observation) -> None:
        """What came of a capture, in any order."""
        ...

    def result(self) -> LevelResult:
        """The level's numbers (``frames`` and ``seconds`` are the caller's to fill in)."""
        ...


def aim_at(
    lens: Lens, task: LevelTask, target: Target, pixel: tuple[float, float], steps: int = 30
) -> tuple[float, float]:
    """Head angles (pan, tilt) in degrees that put the target's centre on ``pixel``.

    Newton with numeric derivatives on the projected centre; the lens need only be roughly right. Angles are kept
    inside the task's ranges, so a pixel out of reach gives the nearest angles, not an error.
    """
    if target.pose is None:
        raise InvalidInput("target", target.kind.value, "only a posed target can be aimed at")
    centre = target_points_world(target.pose, np.zeros((1, 2)))
    to_centre = centre[0] - np.asarray(task.pivot_m)
    angles = np.array(
        [
            np.degrees(np.arctan2(to_centre[0], to_centre[1])),
            np.degrees(np.arctan2(to_centre[2], np.hypot(to_centre[0], to_centre[1]))),
        ]
    )
    straight = Lens(lens.image_size, lens.f_px, center_shift_px=lens.center_shift_px, pixel_aspect=lens.pixel_aspect)
    wanted = np.asarray(pixel, dtype=np.float64)
    for model in (straight, lens):

        def seen(at: FloatArray, model: Lens = model) -> FloatArray:
            return np.asarray(project_points(model, task.pose(float(at[0]), float(at[1])), centre)[0])

        for _ in range(steps):
            here = seen(angles)
            slope = np.column_stack([(seen(angles + d) - here) / 1e-4 for d in np.eye(2) * 1e-4])
            if not np.all(np.isfinite(slope)) or abs(np.linalg.det(slope)) < 1e-9:
                break
            step = np.linalg.solve(slope, wanted - here)
            angles = angles + np.clip(step, -10.0, 10.0)
            if float(np.max(np.abs(step))) < 1e-7:
                break
    low = np.array([task.pan_range_deg[0], task.tilt_range_deg[0]])
    high = np.array([task.pan_range_deg[1], task.tilt_range_deg[1]])
    pan, tilt = np.clip(angles, low, high)
    return float(pan), float(tilt)


def expected_points(lens: Lens, task: LevelTask, target: Target, pan_deg: float, tilt_deg: float) -> FloatArray:
    """Where the target's points are expected (N, 2) px at these head angles, through ``lens``."""
    return project_target(lens, task.pose(pan_deg, tilt_deg), target)
