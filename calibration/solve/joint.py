"""The joint method: a few real pictures where they tell most, one least-squares fit, a check on the engine's render.

Pictures are planned one by one: the target in the middle tells the focal length, then it goes to the corners, until
the overlay error expected from the covariance is below the goal. The engine is asked for a render only at the end,
at the values as they will be published.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from calibration.camera import project_points, target_points_world
from calibration.compare import predicted_overlay
from calibration.errors import CalibrationError, FoldedLens, InvalidInput, NotConverged, NotEnoughData
from calibration.lens import Lens
from calibration.solve.engine_check import EngineAgreement, EngineCheck
from calibration.solve.iteration import LevelFit
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.nodal import DEPTH_RATIO, distance_of, two_distances
from calibration.solve.outcome import level_result
from calibration.solve.problem import View
from calibration.solve.search import Capture, LevelTask, Observation, Source, aim_at, expected_points
from calibration.tables import LeftOut, LevelResult
from calibration.types import Detection, FloatArray, Refusal, Role, Target, TargetKind

Place = tuple[float, float, Role]
"""Where a target is to stand, as a share of the way from the picture's middle to its border, and what for."""

_PLACES: tuple[Place, ...] = (
    (1.0, 1.0, Role.K2),
    (-1.0, -1.0, Role.K2),
    (1.0, -1.0, Role.K2),
    (-1.0, 1.0, Role.K2),
    (-1.0, 0.0, Role.K1),
    (1.0, 0.0, Role.K1),
    (0.0, -1.0, Role.FREE),
    (0.0, 1.0, Role.FREE),
)
_NODAL_PLACES: tuple[Place, ...] = (
    (1.0, 0.5, Role.NODAL),
    (-1.0, -0.5, Role.NODAL),
    (1.0, -0.5, Role.NODAL),
    (-1.0, 0.5, Role.NODAL),
)
# Far out on both sides: there the size of a target and the swing of the pupil tell most.
_SMALLEST_SHARE = 0.08
# A target lower than this share of the picture's height tells too little of its size.
# Opposite corners first: they tell the bend and the centre apart with the fewest pictures.
_FIRST_PLACE = (0.75, 0.75, Role.FOV)
# Before the distortion is known, a target sent to the very corner may be bent out of the picture.
_BEND_KNOWN_PX = 20.0
# Expected overlay error below which a fit is good enough to aim with: about half the margin kept at the border.
_PROBE_OFF_OF_WIDTH = 0.15
# A target aimed at stands in the middle but for the centre shift and the survey's error; farther off it is another.
_FIRST_GUESS_FOV_DEG = 40.0
# Only aims the head at a target in the middle, which hardly depends on it.


@dataclass(frozen=True, slots=True)
class JointOptions:
    """``goal_px``: stop taking pictures when the largest expected overlay error is below it. ``min_views`` and
    ``max_views`` bound the real pictures of a level, ``verify_views`` the engine's renders. ``nodal_goal_mm``: where a
    second target stands at another distance, it is looked at until the nodal offset is this certain. ``margin``:
    distance kept from the picture's border, as a share of its width. ``fill``: largest share of the picture's height
    that a target chosen for a level may take.
    """

    goal_px: float = 0.03
    min_views: int = 4
    max_views: int = 12
    verify_views: int = 1
    nodal_goal_mm: float = 0.1
    margin: float = 0.02
    fill: float = 0.55


class _Stage(Enum):
    PROBE = auto()
    COLLECT = auto()
    VERIFY = auto()
    DONE = auto()


class JointMethod:
    """See the module; implements :class:`calibration.solve.search.LevelMethod`."""

    def __init__(self, task: LevelTask, options: JointOptions | None = None) -> None:
        self._task = task
        self._options = options or JointOptions()
        self._names = [name for name, target in task.targets.items() if target.kind is not TargetKind.LIGHT]
        if not self._names:
            raise InvalidInput(
                "targets", sorted(task.targets), "a level needs a board or a square; a light tells no lens"
            )
        self._stage = _Stage.PROBE
        self._steps = 0
        self._pending: dict[int, Capture] = {}
        self._views: list[View] = []
        self._left_out: list[LeftOut] = []
        self._fit: LevelFit | None = None
        self._straight = False
        self._problem = ""
        self._probes = self._probe_order()
        self._target = ""
        self._places: list[Place] = []
        self._second = ""
        self._nodal_planned = False
        self._again: dict[int, Place] = {}
        self._check: EngineCheck | None = None

    @property
    def done(self) -> bool:
        return self._stage is _Stage.DONE and not self._pending

    @property
    def progress(self) -> float:
        total = 1 + self._options.min_views + self._options.verify_views
        told = len(self._views) + (self._check.renders if self._check is not None else 0)
        return 1.0 if self.done else min(told / total, 0.99)

    @property
    def fit(self) -> LevelFit | None:
        """The newest fit, for reports."""
        return self._fit

    @property
    def views(self) -> tuple[View, ...]:
        """The real pictures' detections so far, for reports."""
        return tuple(self._views)

    def ask(self) -> Capture | None:
        if self._stage is _Stage.PROBE:
            return None if self._pending else self._ask_probe()
        if self._stage is _Stage.COLLECT:
            # One capture may run ahead of the fit once the distortion is known.
            if len(self._pending) > (1 if len(self._views) >= 3 else 0):
                return None
            return self._ask_place()
        if self._stage is _Stage.VERIFY:
            return self._ask_check()
        return None

    def tell(self, observation: Observation) -> None:
        capture = self._pending.pop(observation.step)
        if self._stage is _Stage.PROBE:
            self._tell_probe(capture, observation)
        elif capture.source is Source.VIRTUAL:
            self._tell_check(observation)
        else:
            self._tell_view(capture, observation)

    def result(self) -> LevelResult:
        if self._fit is None or self._problem:
            raise NotEnoughData(self._problem or "the level was not finished")
        agreement, engine_problem = self._agreement()
        return level_result(
            self._fit,
            self._task.zoom,
            self._task.focus,
            held_out=held_out_residuals(self._fit, self._views),
            engine=agreement,
            engine_shortfall_px=self._shortfall_px(),
            engine_problem=engine_problem,
            left_out=self._left_out,
        )

    # --- probing: which target, and roughly which focal length ---

    def _probe_order(self) -> list[str]:
        """The target that should fill the picture best first, then smaller ones (the view may be narrower), then the
        rest; without any idea of the view, as they were surveyed."""
        names = self._names
        near = self._task.guess or self._task.neighbour
        if near is None:
            return list(names)
        best = self._best_target(near)
        share = {name: self._share(near, self._task.targets[name]) for name in names}
        smaller = sorted((n for n in names if share[n] < share[best]), key=share.__getitem__, reverse=True)
        larger = sorted((n for n in names if n != best and share[n] >= share[best]), key=share.__getitem__)
        return [best, *smaller, *larger]

    def _ask_probe(self) -> Capture | None:
        if not self._probes:
            reasons = "; ".join(f"{out.picture}: {out.reason}" for out in self._left_out)
            self._end(f"no target was found ({reasons}); is it lit, in view and where the survey says?")
            return None
        name = self._probes.pop(0)
        lens = self._task.guess or Lens.from_fov(
            self._task.image_size, _FIRST_GUESS_FOV_DEG, pixel_aspect=self._task.pixel_aspect
        )
        pan, tilt = aim_at(lens, self._task, self._task.targets[name], lens.principal_point_px)
        return self._capture(Source.REAL, name, pan, tilt, Role.CENTER_SHIFT)

    def _tell_probe(self, capture: Capture, observation: Observation) -> None:
        if isinstance(observation.result, Refusal):
            self._left_out.append(LeftOut(_name(capture, observation), observation.result.reason))
            return
        middle = (np.asarray(self._task.image_size) - 1) / 2
        off_px = float(np.linalg.norm(observation.result.centre_px - middle))
        if off_px > _PROBE_OFF_OF_WIDTH * self._task.image_size[0]:
            reason = (
                f"what was found stands {off_px:.0f} px from where the target should: another one, or a wrong survey"
            )
            self._left_out.append(LeftOut(_name(capture, observation), reason))
            return
        self._add_view(capture, observation, observation.result)
        try:
            self._solve()
        except CalibrationError as error:
            self._left_out.append(LeftOut(_name(capture, observation), str(error)))
            self._views.clear()
            return
        lens = self._lens()
        self._target = self._best_target(lens)
        self._places = [*_PLACES] if self._task.guess is not None else [_FIRST_PLACE, *_PLACES[1:], _PLACES[0]]
        if self._target != capture.target:
            self._places.insert(0, (0.0, 0.0, Role.CENTER_SHIFT))
        self._stage = _Stage.COLLECT

    def _best_target(self, lens: Lens) -> str:
        """The target that fills most of the picture without taking more than ``fill`` of its height."""
        sizes = {name: self._share(lens, self._task.targets[name]) for name in self._names}
        fitting = {name: share for name, share in sizes.items() if share <= self._options.fill}
        return max(fitting, key=fitting.__getitem__) if fitting else min(sizes, key=sizes.__getitem__)

    def _share(self, lens: Lens, target: Target) -> float:
        if target.pose is None:
            return 0.0
        distance_m = float(np.linalg.norm(np.asarray(target.pose.centre_m) - np.asarray(self._task.pivot_m)))
        width_m, height_m = target.outline_m()
        aspect = lens.image_size[0] / lens.image_size[1]
        return max(height_m, width_m / aspect) * lens.f_px / max(distance_m, 1e-3) / lens.image_size[1]

    # --- collecting: the target where it tells most ---

    def _ask_place(self) -> Capture | None:
        if self._nodal_known():
            self._places = [place for place in self._places if place[2] is not Role.NODAL]
        if not self._places or self._enough():
            if self._pending:
                return None
            if not self._plan_nodal():
                self._begin_checks()
            return self.ask()
        if len(self._views) >= self._options.min_views:
            # More pictures at one distance would not tell what a second one tells at once.
            self._plan_nodal()
        place = self._places.pop(0)
        name = self._target_at(place)
        pan, tilt = self._angles_for(place)
        capture = self._capture(Source.REAL, name, pan, tilt, place[2])
        self._again[capture.step] = place
        return capture

    def _target_at(self, place: Place) -> str:
        return self._second if place[2] is Role.NODAL else self._target

    def _enough(self) -> bool:
        """Pending pictures count as taken, so that one running ahead is not one too many."""
        if any(place[2] is Role.NODAL for place in self._places):
            return False
        nodal = sum(view.target_name == self._second for view in self._views)
        count = len(self._views) + len(self._pending)
        if count - nodal >= self._options.max_views:
            return True
        if count < self._options.min_views or self._fit is None or self._straight:
            return False
        return predicted_overlay(self._fit.lens, self._fit.covariance).max_px <= self._options.goal_px

    def _nodal_known(self) -> bool:
        seen = None if self._fit is None else self._fit.nodal_seen_mm
        return seen is not None and two_distances(self._views) and seen[1] <= self._options.nodal_goal_mm

    def _plan_nodal(self) -> bool:
        """Whether pictures of a second target, at another distance, are to be taken for the nodal offset; plans them.

        The target is that of which most is to be expected: large in the picture, far from the first in 1 / distance.
        """
        if self._nodal_planned or self._fit is None or self._straight or len(self._views) < 2:
            return False
        self._nodal_planned = True
        lens, first = self._lens(), distance_of(self._task.targets[self._target], self._task.pivot_m)
        worth: dict[str, float] = {}
        for name in self._names:
            target = self._task.targets[name]
            distance = distance_of(target, self._task.pivot_m)
            share = self._share(lens, target)
            far_apart = max(distance, first) >= DEPTH_RATIO * min(distance, first)
            if far_apart and _SMALLEST_SHARE <= share <= self._options.fill:
                worth[name] = share * abs(1 / distance - 1 / first)
        if not worth:
            return False
        self._second = max(worth, key=worth.__getitem__)
        self._places = [*_NODAL_PLACES, *self._places]
        return True

    def _angles_for(self, place: Place) -> tuple[float, float]:
        """Head angles that put the target as far towards ``place`` as its outline stays inside the picture."""
        lens, target = self._planning_lens(), self._task.targets[self._target_at(place)]
        width, height = lens.image_size
        margin = self._options.margin * width
        reach = np.array([(width - 1) / 2 - margin, (height - 1) / 2 - margin])
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        direction = np.array(place[:2])
        pixel = centre + direction * reach * 0.5
        pan, tilt = aim_at(lens, self._task, target, (float(pixel[0]), float(pixel[1])))
        for _ in range(6):
            outline = self._outline(lens, target, pan, tilt)
            if not np.isfinite(outline).all():
                pixel = (pixel + centre) / 2
            else:
                over = np.maximum(outline.max(axis=0) - centre, centre - outline.min(axis=0))
                pixel = pixel + np.sign(direction) * (reach * np.abs(direction) - over)
            pixel = np.clip(pixel, centre - reach, centre + reach)
            pan, tilt = aim_at(lens, self._task, target, (float(pixel[0]), float(pixel[1])))
        return pan, tilt

    def _planning_lens(self) -> Lens:
        """The fitted lens; while one picture in the middle tells its bend badly, that of the guess, or none at all."""
        lens = self._lens()
        fit = self._fit
        if fit is not None and not self._straight and predicted_overlay(lens, fit.covariance).max_px <= _BEND_KNOWN_PX:
            return lens
        guess = self._task.guess
        straight = Lens(
            lens.image_size, lens.f_px, pixel_aspect=lens.pixel_aspect, nodal_offset_mm=lens.nodal_offset_mm
        )
        return straight if guess is None else straight.with_hw(lens.f_px, guess.k1_hw, guess.k2_hw)

    def _outline(self, lens: Lens, target: Target, pan: float, tilt: float) -> FloatArray:
        width_m, height_m = target.outline_m()
        edge = np.array([[x, y] for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)]) * [width_m, height_m]
        if target.pose is None:
            return np.full((len(edge), 2), np.nan)
        return project_points(lens, self._task.pose(pan, tilt), target_points_world(target.pose, edge))

    def _tell_view(self, capture: Capture, observation: Observation) -> None:
        if isinstance(observation.result, Refusal):
            name = _name(capture, observation)
            self._left_out.append(LeftOut(name, observation.result.reason))
            place = self._again.pop(capture.step, None)
            if place is not None:
                x, y, role = place
                if max(abs(x), abs(y)) > 0.7:  # once more, further in; then this place is given up
                    self._places.insert(0, (x * 0.7, y * 0.7, role))
            return
        self._add_view(capture, observation, observation.result)
        try:
            self._solve()
        except CalibrationError as error:
            if self._fit is None:
                self._end(str(error))
                return
            self._views.pop()
            self._left_out.append(LeftOut(_name(capture, observation), str(error)))

    # --- verifying: the engine's own render at the values as published ---

    def _begin_checks(self) -> None:
        if self._fit is None or len(self._views) < 2:
            self._end("too few pictures show the target: " + "; ".join(out.reason for out in self._left_out[-3:]))
            return
        if self._straight:
            # Held at 0 the bend was good for aiming only: it must not be published as if it had been measured.
            self._end(f"{len(self._views)} pictures do not tell the lens's bend: its fit folds or does not converge")
            return
        usable = [v for v in self._views if v.name not in {name for name, _ in self._fit.dropped}]
        self._stage = _Stage.VERIFY
        if self._options.verify_views == 0:
            self._stage = _Stage.DONE
            return
        # The last picture's pose first: the head stands there already. Targets of the nodal offset come last.
        usable.sort(key=lambda view: view.target_name != self._second)
        self._check = EngineCheck(self._lens(), usable[::-1], self._task.engine, first_views=self._options.verify_views)

    def _ask_check(self) -> Capture | None:
        wanted = self._check.ask() if self._check is not None else None
        if wanted is None:
            self._stage = _Stage.DONE
            return None
        pose = wanted.view.camera_pose
        if self._pending or pose is None:
            return None
        target = wanted.view.target_name
        return self._capture(Source.VIRTUAL, target, pose.pan_deg, pose.tilt_deg, Role.FREE, lens=wanted.asked)

    def _tell_check(self, observation: Observation) -> None:
        if self._check is None:
            return
        self._check.tell(observation.result)
        if self._check.done:
            self._stage = _Stage.DONE

    def _agreement(self) -> tuple[EngineAgreement | None, str]:
        """How the engine's render agrees; else the reason why that is not known, empty where it was not asked."""
        if self._check is None:
            return None, ""
        try:
            return self._check.result(), ""
        except NotEnoughData as error:
            return None, str(error)

    def _shortfall_px(self) -> float:
        """How far the engine's best picture of this lens is off by its very camera, as far as that was learned."""
        try:
            return self._task.engine.shortfall_px(self._lens())
        except CalibrationError:
            return math.inf

    # --- shared ---

    def _capture(
        self, source: Source, target: str, pan: float, tilt: float, role: Role, lens: Lens | None = None
    ) -> Capture:
        expected, sigma = None, 0.0
        if self._fit is not None and len(self._views) >= 3:
            expected = expected_points(self._lens(), self._task, self._task.targets[target], pan, tilt)
            sigma = 3.0
            if not np.isfinite(expected).all():
                expected = None
        capture = Capture(self._steps, source, target, pan, tilt, role, lens, expected, sigma)
        self._steps += 1
        self._pending[capture.step] = capture
        return capture

    def _add_view(self, capture: Capture, observation: Observation, detection: Detection) -> None:
        target = self._task.targets[capture.target]
        name = _name(capture, observation)
        self._views.append(View(name, capture.target, target, detection, observation.camera_pose))

    def _solve(self) -> None:
        """Fit the pictures so far. The first ones hardly tell the bend: where it then comes out as a fold, it is held
        at 0 until more pictures have come."""
        try:
            self._fit, self._straight = self._solved(straight=False), False
        except (FoldedLens, NotConverged):
            if len(self._views) >= self._options.min_views:
                raise
            self._fit, self._straight = self._solved(straight=True), True

    def _solved(self, *, straight: bool) -> LevelFit:
        return solve_level(
            self._views,
            self._task.image_size,
            pixel_aspect=self._task.pixel_aspect,
            nodal_offset_mm=self._task.nodal_offset_mm,
            nodal_sigma_mm=self._task.nodal_sigma_mm,
            straight=straight,
            priors=self._task.priors,
        )

    def _lens(self) -> Lens:
        if self._fit is None:
            raise NotEnoughData("no picture of this level shows its target yet")
        return self._fit.lens

    def _end(self, problem: str) -> None:
        self._problem = problem
        self._stage = _Stage.DONE


def _name(capture: Capture, observation: Observation) -> str:
    return observation.picture or f"step {capture.step}"
