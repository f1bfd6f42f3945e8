"""The pictures of the study's alternating method: where the target is put, and how a render is compared with it.

Each generator yields a :class:`~calibration.solve.search.Capture` and is sent the
:class:`~calibration.solve.search.Observation` that came of it; :mod:`calibration.solve.alternating` wraps them as an
ask/tell method.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from calibration.camera import inside_picture, project_points, rays_of, target_points_world, world_to_camera
from calibration.errors import CalibrationError, GeometryError, InvalidInput, NotEnoughData
from calibration.lens import Lens
from calibration.solve.center_shift import center_shift_from_points
from calibration.solve.search import Capture, LevelTask, Observation, Source, aim_at
from calibration.tables import LeftOut
from calibration.types import CameraPose, Detection, FloatArray, Refusal, Role, Target, TargetPose

T = TypeVar("T")
Steps = Generator[Capture, Observation, T]
"""A stage: yields pictures wanted, is sent what came of them, returns a T."""

_FIRST_GUESS_FOV_DEG = 40.0
# Aims the head at a target in the middle, which does not depend on it.
_AIM_ATTEMPTS = 6
_RETREAT = 0.03
# A lens that bends the target out of the picture by more than the margin is met by aiming further inside, this share
# of the width each time: five steps are more than what k1_hw = 0.25 moves the picture's edge.
_PLACE_SIGMA = 0.01
# How far off a place aimed at without distortion may be, as a share of the width.
_RENDER_SIGMA_PX = 3.0
_SAME_REACH_PX = 5.0
# Places this close to the furthest one are as good: the first of them is used, so that a level repeats itself.


@dataclass(frozen=True, slots=True)
class AlternatingSettings:
    """How the study's method is tuned.

    ``threshold_px``: an alignment holds when no corner deviates further; it is raised to ``noise_factor`` times the
    corner noise that the detector tells, below which the furthest corner is chance. ``settled_px``: a search ends when
    its next step would move the corners by less (RMS per coordinate); ``standstill_px``: a round in which the corners
    moved by less in all is the last one. ``usable_px``: a level whose corners stay apart by more than the threshold
    and at most this is degraded, beyond it failed. ``max_trials``: renders that a level may take.
    ``max_forced_steps``: forced steps of k1 (scenario 3).

    ``largest_span``: of several targets the largest that spans no more of the picture's height and width is used; one
    that spans more mixes the radii at which the coefficients are told apart. ``side_offset`` and ``edge_offset``:
    where the target's centre is put for the field of view and for k1, in half widths from the picture's centre, if
    ``margin`` (a share of the width, kept free at the border) leaves the room. The closer the three places, the more
    rounds: at 0.25 and 0.7 a round leaves 0.5 to 0.9 of the misfit, at 0.5 and the very edge 0.9 to 0.96.
    """

    threshold_px: float = 0.1
    noise_factor: float = 5.0
    settled_px: float = 0.003
    standstill_px: float = 0.03
    usable_px: float = 1.0
    max_trials: int = 600
    max_forced_steps: int = 4
    largest_span: float = 0.35
    side_offset: float = 0.25
    edge_offset: float = 0.7
    margin: float = 0.02

    def __post_init__(self) -> None:
        for name in ("threshold_px", "noise_factor", "settled_px", "standstill_px", "usable_px", "largest_span"):
            _positive(name, getattr(self, name))
        for name in ("side_offset", "edge_offset", "margin"):
            if not 0 < getattr(self, name) < 1:
                raise InvalidInput(name, getattr(self, name), "must lie between 0 and 1")
        if self.max_trials < 1 or self.max_forced_steps < 0:
            raise InvalidInput("max_trials, max_forced_steps", (self.max_trials, self.max_forced_steps), "too small")


def _positive(what: str, value: float) -> None:
    if not math.isfinite(value) or value <= 0:
        raise InvalidInput(what, value, "must be a positive number")


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A render compared with the real picture: ``errors_px`` (N, 2) = virtual minus real corners.

    NaN where the render's corner was not found; ``sigma_px`` is the noise of a difference, per coordinate.
    """

    lens: Lens
    errors_px: FloatArray
    sigma_px: float

    @property
    def worst_px(self) -> float:
        """Distance of the corner that deviates most."""
        return float(np.sqrt(np.nanmax(np.sum(self.errors_px**2, axis=1))))

    @property
    def rms_px(self) -> float:
        """RMS per coordinate."""
        return float(np.sqrt(np.nanmean(self.errors_px**2)))


@dataclass(slots=True, eq=False)
class View:
    """One of the level's real pictures, and the engine's last render of the same view.

    ``slopes``: the last seen d(errors_px)/d(coefficient), (N, 2), by coefficient.
    """

    role: Role
    pan_deg: float
    tilt_deg: float
    real: Detection
    last: Trial | None = None
    slopes: dict[str, FloatArray] = field(default_factory=dict)


class Stopped(CalibrationError):
    """The search cannot go on (renders spent, target lost, no effect seen); the lens so far may still be usable."""


class Pictures:
    """Takes one level's pictures. ``trials`` counts the renders, ``left_out`` the real pictures of no use."""

    def __init__(self, task: LevelTask, settings: AlternatingSettings) -> None:
        self._task = task
        self._settings = settings
        self._steps = 0
        self.target_name = ""
        self.trials = 0
        self.max_trials = settings.max_trials
        self.left_out: list[LeftOut] = []

    @property
    def steps(self) -> int:
        """Pictures asked for so far."""
        return self._steps

    # --- the target in the middle --------------------------------------------------------------------------------

    def centre(self) -> Steps[Lens]:
        """The target in the picture's middle: the centre shift, a rough focal length, and which target to use.

        Returns the lens so far, without distortion. Raises :class:`NotEnoughData` when no target is found there.
        """
        names = [name for name, target in self._task.targets.items() if len(target.points_m()) >= 4]
        if not names:
            raise NotEnoughData("the alternating method needs a surveyed square or chessboard, and the task has none")
        queue = sorted(names, key=lambda name: self._span(name, 1.0))
        if self._task.guess is not None:
            queue.remove(likely := self._largest_fitting(names, self._task.guess.f_px))
            queue.insert(0, likely)
        seen: tuple[str, Lens] | None = None
        while queue:
            name = queue.pop(0)
            lens = yield from self._probe(name)
            if lens is None:
                continue
            seen = name, lens
            better = self._largest_fitting(names, lens.f_px)
            if better not in queue:
                break
            queue = [better]
        if seen is None:
            reasons = "; ".join(picture.reason for picture in self.left_out)
            raise NotEnoughData(f"no target was found in the picture's middle ({reasons})")
        self.target_name, lens = seen
        return lens

    def _probe(self, name: str) -> Steps[Lens | None]:
        task = self._task
        self.target_name = name
        width, height = task.image_size
        aimed = Lens.from_fov(task.image_size, _FIRST_GUESS_FOV_DEG, nodal_offset_mm=task.nodal_offset_mm)
        pan, tilt = aim_at(aimed, task, self._target, ((width - 1) / 2, (height - 1) / 2))
        observation = yield self._capture(Source.REAL, pan, tilt, Role.CENTER_SHIFT)
        found = observation.result
        if isinstance(found, Refusal):
            self._leave_out(observation, f"{name}: {found.reason}")
            return None
        rays = self._rays(observation.camera_pose)[found.point_ids]
        f_px, shift = center_shift_from_points(found, rays, task.image_size, task.pixel_aspect)
        return Lens(
            task.image_size,
            f_px,
            center_shift_px=shift.shift_px,
            pixel_aspect=task.pixel_aspect,
            nodal_offset_mm=task.nodal_offset_mm,
        )

    def _span(self, name: str, f_px: float) -> float:
        """How much of the picture a target spans when it stands in the middle, 1 = all of its height or width."""
        target = self._task.targets[name]
        width_m, height_m = target.outline_m()
        away_m = math.dist(_pose_of(target).centre_m, self._task.pivot_m)
        width_px, height_px = self._task.image_size
        return f_px / away_m * max(width_m / width_px, self._task.pixel_aspect * height_m / height_px)

    def _largest_fitting(self, names: list[str], f_px: float) -> str:
        spans = {name: self._span(name, f_px) for name in names}
        fitting = [name for name in names if spans[name] <= self._settings.largest_span]
        return max(fitting, key=spans.__getitem__) if fitting else min(names, key=spans.__getitem__)

    # --- the target at the side, the edge, the corner ------------------------------------------------------------

    def view(self, role: Role, lens: Lens) -> Steps[View]:
        """A real picture with the target at its place, and the engine's render of it with this lens.

        ``lens`` only aims the head. A picture that shows no whole target, or whose render shows none, is taken again
        further inside. Raises :class:`NotEnoughData` when that does not help, :class:`GeometryError` when the head
        cannot bring the target there.
        """
        width = self._task.image_size[0]
        problem = ""
        for attempt in range(_AIM_ATTEMPTS):
            pan, tilt = self._aim(role, lens, (self._settings.margin + attempt * _RETREAT) * width)
            observation = yield self._capture(
                Source.REAL,
                pan,
                tilt,
                role,
                expected_px=_all_finite(lens.project(self._rays(self._task.pose(pan, tilt)))),
                expected_sigma_px=_PLACE_SIGMA * width,
            )
            if isinstance(observation.result, Refusal):
                problem = observation.result.reason
                self._leave_out(observation, problem)
                continue
            view = View(role, pan, tilt, observation.result)
            if (yield from self.trial(view, lens)) is not None:
                return view
            problem = "the engine's render of this view shows no whole target"
            self._leave_out(observation, problem)
        raise NotEnoughData(
            f"no usable picture with {self.target_name} at the place for {role.value} in {_AIM_ATTEMPTS} attempts; "
            f"the last: {problem}"
        )

    def _aim(self, role: Role, lens: Lens, margin_px: float) -> tuple[float, float]:
        """Head angles that bring the target to its place, to the first of the picture's sides that the head reaches."""
        width, height = self._task.image_size
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        reached: list[tuple[float, tuple[float, float]]] = []
        for sign in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
            angles = self._aim_towards(role, lens, np.array(sign), margin_px)
            outline = self._outline_px(lens, *angles)
            if inside_picture(outline, self._task.image_size):
                reached.append((float(np.linalg.norm(outline.mean(axis=0) - middle)), angles))
        if not reached:
            raise GeometryError(
                f"the target {self.target_name} cannot be brought to the place for {role.value} inside the picture: "
                "check the head's ranges, the target's pose and its size"
            )
        furthest = max(distance for distance, _ in reached)
        return next(angles for distance, angles in reached if distance > furthest - _SAME_REACH_PX)

    def _aim_towards(self, role: Role, lens: Lens, sign: FloatArray, margin_px: float) -> tuple[float, float]:
        width, height = self._task.image_size
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        share = self._settings.side_offset if role is Role.FOV else self._settings.edge_offset
        offset = np.array([share * width / 2, 0.3 * height if role is Role.K2 else 0.0])
        angles = (0.0, 0.0)
        for _ in range(4):  # perspective and distortion change the target's outline with its place
            u, v = middle + sign * offset
            angles = aim_at(lens, self._task, self._target, (float(u), float(v)))
            outline = self._outline_px(lens, *angles)
            if not np.all(np.isfinite(outline)):
                break
            room = middle - margin_px - np.max((outline - middle) * sign, axis=0)
            if role is Role.K2:
                offset += room
            else:
                offset[0] = min(offset[0] + room[0], share * width / 2)
        return angles

    def _outline_px(self, lens: Lens, pan_deg: float, tilt_deg: float) -> FloatArray:
        """Where eight points of the target's border are expected, (8, 2)."""
        ring = np.array([[x, y] for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5) if x or y])
        world = target_points_world(_pose_of(self._target), ring * self._target.outline_m())
        return project_points(lens, self._task.pose(pan_deg, tilt_deg), world)

    # --- renders -------------------------------------------------------------------------------------------------

    def trial(self, view: View, lens: Lens) -> Steps[Trial | None]:
        """The engine's render of a view with this lens against the real picture; None when the target is not in it.

        The view's last render is used again when the lens is the same. Raises :class:`Stopped`.
        """
        if view.last is not None and view.last.lens == lens:
            return view.last
        if self.trials >= self.max_trials:
            raise Stopped(f"the corners did not come together in {self.trials} renders")
        self.trials += 1
        whole = len(view.real.points_px) == len(self._target.points_m())
        off_px = 2 * view.last.rms_px if view.last is not None else _PLACE_SIGMA * self._task.image_size[0]
        observation = yield self._capture(
            Source.VIRTUAL,
            view.pan_deg,
            view.tilt_deg,
            view.role,
            lens=lens,
            expected_px=view.real.points_px if whole else None,
            expected_sigma_px=max(off_px, _RENDER_SIGMA_PX),
        )
        found = observation.result
        if isinstance(found, Refusal):
            return None
        _, of_real, of_render = np.intersect1d(view.real.point_ids, found.point_ids, return_indices=True)
        if len(of_real) < max(4, len(view.real.points_px) / 2):
            return None
        errors = np.full_like(view.real.points_px, np.nan)
        errors[of_real] = found.points_px[of_render] - view.real.points_px[of_real]
        variance = view.real.covariance_px2[of_real] + found.covariance_px2[of_render]
        sigma = math.sqrt(float(np.mean(np.trace(variance, axis1=1, axis2=2))) / 2)
        view.last = Trial(lens, errors, sigma)
        return view.last

    # --- helpers -------------------------------------------------------------------------------------------------

    @property
    def _target(self) -> Target:
        return self._task.targets[self.target_name]

    def _rays(self, pose: CameraPose) -> FloatArray:
        world = target_points_world(_pose_of(self._target), self._target.points_m())
        return rays_of(world_to_camera(pose, self._task.nodal_offset_mm, world))

    def _capture(
        self,
        source: Source,
        pan_deg: float,
        tilt_deg: float,
        role: Role,
        lens: Lens | None = None,
        expected_px: FloatArray | None = None,
        expected_sigma_px: float = 0.0,
    ) -> Capture:
        self._steps += 1
        step = self._steps - 1
        return Capture(step, source, self.target_name, pan_deg, tilt_deg, role, lens, expected_px, expected_sigma_px)

    def _leave_out(self, observation: Observation, reason: str) -> None:
        self.left_out.append(LeftOut(observation.picture or f"picture {observation.step}", reason))


def _pose_of(target: Target) -> TargetPose:
    if target.pose is None:
        raise InvalidInput("target pose", None, "the alternating method needs surveyed targets")
    return target.pose


def _all_finite(points_px: FloatArray) -> FloatArray | None:
    return points_px if bool(np.all(np.isfinite(points_px))) else None
