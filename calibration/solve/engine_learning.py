"""Learning how an engine draws, from a few of its renders at known values.

The engine is asked for lenses chosen so that each of its habits shows (:class:`EngineLearning`, an ask/tell object);
:mod:`calibration.solve.engine_fit` then fits its camera to the target's corners in its renders, at known poses.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.camera import rays_of, world_to_camera
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.solve.engine_fit import LearnedEngine, Render, learn_engine, world_points
from calibration.solve.engine_model import EngineModel
from calibration.solve.search import Capture, LevelTask, Observation, Source, aim_at
from calibration.types import FloatArray, Refusal, Role, Target, TargetKind

_FILL = 0.42
# Height of the target in the first render, as a share of the picture's.
_PLACE = (0.62, 0.36)
# Where in the picture it stands: off the middle, so that the distortion shows.
_CORNER_MARGINS = (0.04, 0.14)
# And at last in the opposite corner, where an engine that bends in more ways than the model knows gives itself away:
# distance kept from the picture's border, as a share of its width; the second where the target was not found.
_CORNER_F = 0.7
_OUTLINE = 1.4
# A target's outline is larger than the points in it by about this.
_LARGER, _WIDER = 2.5, 1.8
# Other focal lengths to begin with; another axis of the field of view changes it by 16/9.
_LARGEST_F_OF_HALF_WIDTH = 2.2
_LEAST_RENDERS = 6
_FIRST_K1_HW = 0.004
_BEND_PX = 24.0
# How far k1 and k2 may move a corner: far beyond the corners' noise, far from folding the picture.
_MOST_BEND_HW = 0.15
_SHIFT_PX = (14.0, 9.0)
_NODAL_MM = 120.0
_STALE_PX = 1e-6
_NODAL_SEEN = 1e-3
# 120 mm make a target at less than 100 m larger or smaller by more than this.


class EngineLearning:
    """Asks for about eight renders, one after the other, and tells how the engine draws.

    ``target``: name of the task's target to look at. Usage as of :class:`calibration.solve.search.LevelMethod`.
    """

    def __init__(self, task: LevelTask, target: str | None = None) -> None:
        self._task = task
        self._name = target or _largest(task)
        self._target = task.targets[self._name]
        self._first = self._base = _first_lens(task, self._target)
        width, height = task.image_size
        place = (_PLACE[0] * (width - 1), _PLACE[1] * (height - 1))
        self._pan, self._tilt = aim_at(self._base, task, self._target, place)
        middle = ((width - 1) / 2, (height - 1) / 2)
        # An engine that counts the shift from another origin than the profile says draws the target out of the picture,
        # one with another field of view too small or too large to be found.
        origins = [(0.0, 0.0), middle, (-middle[0], -middle[1])]
        focals = _other_focals(self._base, task, self._target)
        self._starts = [(f_gain, origin) for f_gain in focals for origin in origins]
        self._origin = (0.0, 0.0)
        self._renders: list[Render] = []
        self._refused: list[str] = []
        self._step = 0
        self._pending: dict[int, tuple[Capture, Lens]] = {}
        self._margins = list(_CORNER_MARGINS)
        self._plan: list[str] = ["base"]

    @property
    def done(self) -> bool:
        """Whether :meth:`result` can be read."""
        return not self._plan and not self._pending

    def ask(self) -> Capture | None:
        """The next render wanted, None while the one before must be told first."""
        if self._pending or not self._plan:
            return None
        what = self._plan.pop(0)
        lens = self._lens_for(what)
        pan, tilt = self._aim(what, lens)
        capture = Capture(self._step, Source.VIRTUAL, self._name, pan, tilt, Role.FREE, lens=lens)
        self._pending[self._step] = (capture, lens)
        self._step += 1
        return capture

    def tell(self, observation: Observation) -> None:
        """What was seen in a render."""
        capture, lens = self._pending.pop(observation.step)
        if isinstance(observation.result, Refusal):
            self._refused.append(observation.result.reason)
            if lens.nodal_offset_mm == _NODAL_MM:
                # An engine that counts in metres where the profile says millimetres is out of the room.
                self._plan.append("nodal small")
            if not self._renders:
                if self._starts:
                    self._plan = ["base"]
                return
            if capture.pan_deg != self._pan and self._margins:
                self._plan.insert(0, "corner")
        else:
            self._renders.append(Render(lens, observation.camera_pose, self._target, observation.result))
            if lens.nodal_offset_mm == _NODAL_MM and self._nodal_unseen():
                self._plan.append("nodal large")
            if len(self._renders) == 1:
                self._plan = ["shift", "k1 small", "k1", "k2", "near", "far", "nodal", "corner"]

    def result(self) -> LearnedEngine:
        """How the engine draws. Never raises: an engine that is not understood is said to be so."""
        if not self._renders:
            reasons = "; ".join(dict.fromkeys(self._refused))
            return _not_understood(
                f"the target was not found in any of the engine's {self._step} renders ({reasons}): check the export "
                "names, engine.fov_unit, engine.center_shift and the target's survey"
            )
        stale = _stale(self._renders)
        if stale:
            return _not_understood(stale, len(self._renders))
        if len(self._renders) < _LEAST_RENDERS:
            why = f"the target was found in {len(self._renders)} of {self._step} renders only ({self._refused[-1]})"
            return _not_understood(why, len(self._renders))
        return learn_engine(self._renders)

    def _lens_for(self, what: str) -> Lens:
        if what == "base":
            f_gain, self._origin = self._starts.pop(0)
            self._base = replace(self._first, f_px=f_gain * self._first.f_px)
        base = self._base
        bend1, bend2 = self._bends()
        x, y = _SHIFT_PX
        f_px, k1_hw, k2_hw, shift, nodal_mm = {
            "base": (1.0, 0.0, 0.0, (0.0, 0.0), 0.0),
            "shift": (1.0, 0.0, 0.0, (x, y), 0.0),
            "k1 small": (1.0, _FIRST_K1_HW, 0.0, (0.0, 0.0), 0.0),
            "k1": (1.0, bend1, 0.0, (0.0, 0.0), 0.0),
            "k2": (1.0, 0.0, bend2, (0.0, 0.0), 0.0),
            "near": (1.3, -0.8 * bend1, 0.0, (-x, y), 0.0),
            "far": (0.6, bend1, bend2, (0.5 * x, -y), 0.0),
            "corner": (_CORNER_F, self._corner_bend(bend1), 0.0, (0.0, 0.0), 0.0),
            "nodal": (1.0, 0.0, 0.0, (-x, -y), _NODAL_MM),
            "nodal small": (1.0, 0.0, 0.0, (-x, -y), _NODAL_MM / 1000),
            "nodal large": (1.0, 0.0, 0.0, (-x, -y), _NODAL_MM * 1000),
        }[what]
        place = (self._origin[0] + shift[0], self._origin[1] + shift[1])
        return replace(base, center_shift_px=place, nodal_offset_mm=nodal_mm).with_hw(f_px * base.f_px, k1_hw, k2_hw)

    def _aim(self, what: str, lens: Lens) -> tuple[float, float]:
        """Head angles (deg) for a render: the same for all but that in the corner."""
        if what != "corner":
            return self._pan, self._tilt
        size_px, gain = self._seen()
        size = np.asarray(self._task.image_size, dtype=np.float64)
        away = _OUTLINE * _CORNER_F * size_px / 2 + self._margins.pop(0) * size[0]
        drawn = Lens(lens.image_size, gain * lens.f_px, pixel_aspect=lens.pixel_aspect)
        return aim_at(drawn, self._task, self._target, (float(away[0]), float(size[1] - 1 - away[1])))

    def _seen(self) -> tuple[FloatArray, float]:
        """The target's size (2,) px in the first render, and that over the size that was asked for."""
        first = self._renders[0]
        size_px = np.ptp(first.detection.points_px, axis=0)
        asked = replace(first.asked, center_shift_px=(0.0, 0.0))
        rays = rays_of(world_to_camera(first.camera_pose, 0.0, world_points(first)))
        expected_px = np.ptp(asked.project(rays), axis=0)
        return size_px, float(np.linalg.norm(size_px) / max(float(np.linalg.norm(expected_px)), 1e-9))

    def _corner_bend(self, bend: float) -> float:
        """k1_hw that moves corners out there about as far as ``bend`` moves those of the first render."""
        width, height = self._task.image_size
        reach = _radius_hw(self._renders[0], width) if self._renders else 1.0
        return bend * (reach * width / math.hypot(width, height)) ** 3

    def _nodal_unseen(self) -> bool:
        """Whether the last render shows the target as large as the first, though the pupil should have moved."""
        sizes = [
            float(np.linalg.norm(np.ptp(r.detection.points_px, axis=0))) for r in (self._renders[0], self._renders[-1])
        ]
        same = len(self._renders[0].detection.points_px) == len(self._renders[-1].detection.points_px)
        return same and abs(sizes[1] / sizes[0] - 1) < _NODAL_SEEN

    def _bends(self) -> tuple[float, float]:
        """k1_hw and k2_hw that move the corners by about ``_BEND_PX``, as the first small k1 shows."""
        small = next((r for r in self._renders if r.asked.k1_hw > 0), None)
        if small is None:
            return _FIRST_K1_HW, _FIRST_K1_HW
        first = self._renders[0]
        _, a, b = np.intersect1d(first.detection.point_ids, small.detection.point_ids, return_indices=True)
        moved = np.linalg.norm(small.detection.points_px[b] - first.detection.points_px[a], axis=1)
        farthest = float(np.max(moved)) if len(moved) else 0.0
        scale = _BEND_PX / max(farthest, 1e-3)
        k1_hw = float(np.clip(_FIRST_K1_HW * scale, 1e-6, _MOST_BEND_HW))
        # k2 counts in the square of the radius' unit.
        width = self._task.image_size[0]
        expected = _FIRST_K1_HW * _radius_hw(first, width) ** 3 * width / 2
        unit = farthest / max(expected, 1e-9)
        k2_hw = float(np.clip(_MOST_BEND_HW / max(unit, 1e-3) ** 2, 1e-9, _MOST_BEND_HW))
        return k1_hw, k2_hw


def _stale(renders: Sequence[Render]) -> str:
    """The reason where a render shows the same corners as the one before though another lens was asked for."""
    for before, after in itertools.pairwise(renders):
        a, b = before.detection.points_px, after.detection.points_px
        if a.shape == b.shape and float(np.max(np.abs(a - b))) < _STALE_PX:
            return (
                "the engine's render did not change with the lens asked for: the output is later than measured, or "
                "the export names of the studio profile are not those of the scene"
            )
    return ""


def _not_understood(reason: str, renders: int = 0) -> LearnedEngine:
    return LearnedEngine(EngineModel(), False, math.inf, math.inf, math.nan, renders, reason)


def _largest(task: LevelTask) -> str:
    """The target seen largest from the camera: more of its corners' movement is seen."""
    names = [name for name, target in task.targets.items() if target.kind is not TargetKind.LIGHT]
    if not names:
        raise InvalidInput("targets", sorted(task.targets), "learning an engine needs a board or a square")
    return max(names, key=lambda name: _angular_size(task, task.targets[name]))


def _angular_size(task: LevelTask, target: Target) -> float:
    if target.pose is None:
        return 0.0
    distance_m = float(np.linalg.norm(np.asarray(target.pose.centre_m) - np.asarray(task.pivot_m)))
    return max(target.outline_m()) / max(distance_m, 1e-3)


def _first_lens(task: LevelTask, target: Target) -> Lens:
    width, height = task.image_size
    f_px = min(_FILL * height / max(_angular_size(task, target), 1e-6), _LARGEST_F_OF_HALF_WIDTH * width / 2)
    return Lens(task.image_size, f_px, pixel_aspect=task.pixel_aspect)


def _other_focals(first: Lens, task: LevelTask, target: Target) -> list[float]:
    """By what to multiply the first focal length where the target is not found: larger where it was drawn small,
    and then smaller."""
    filling = _FILL * task.image_size[1] / max(_angular_size(task, target), 1e-6) / first.f_px
    return [1.0, *([min(_LARGER, filling)] if filling > 1 else []), 1 / _WIDER]


def _radius_hw(render: Render, width: int) -> float:
    """Farthest corner from the picture's middle, half widths."""
    middle = (np.asarray(render.asked.image_size) - 1) / 2
    return float(np.max(np.linalg.norm(render.detection.points_px - middle, axis=1))) / (width / 2)
