"""Does an engine's render show what a lens predicts? A few renders of a surveyed target, as an ask/tell object.

Unlike :mod:`calibration.solve.engine_check` it needs no picture of the camera: the lens itself says where the target's
points are to be. It decides and changes nothing; what the engine is asked for is the caller's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.camera import inside_picture, project_target
from calibration.errors import GeometryError, NotEnoughData
from calibration.lens import Lens
from calibration.solve.engine_check import sigma_px
from calibration.solve.outcome import ENGINE_AGREES_PX, pixel_error
from calibration.solve.search import Capture, LevelTask, Observation, Source, aim_at, expected_points
from calibration.tables import PixelError
from calibration.types import FloatArray, Refusal, Target, TargetKind

_PLACES = ((0.0, 0.0), (1.0, 1.0), (-1.0, -1.0))
# The middle tells the centre, opposite corners the focal length and the bend.
_RETRY = 0.6
# A target not found in a corner is looked at once more this share of the way out.
_MARGIN = 0.02
# Kept between target and border, as a share of the picture's width.
_OUTLINE = 1.4
# A target's outline is larger than the points in it by about this.
_SMALLEST, _LARGEST = 0.04, 0.8
# Height of a target that is looked at, as a share of the picture's.
_SAME_VIEW = 0.05
# Places nearer to the middle than this share of the width are the middle.
_SHRINK, _SHRINKS = 0.85, 12
_EXPECTED_SIGMA_PX = 5.0
# How far off a render is searched near the prediction first; beyond it the whole picture is.
_SIGMAS = 5.0


@dataclass(frozen=True, slots=True)
class RenderAgreement:
    """How far a render's points are from those predicted: ``off_px`` (RMS per coordinate, and the largest distance),
    the largest that is taken, and how many renders were measured. ``trouble``: why it does not agree, empty where it
    does."""

    off_px: PixelError | None
    limit_px: float
    renders: int
    trouble: str


class RenderCheck:
    """Asks for renders of a target in the middle and in opposite corners, and compares them with ``lens``.

    ``lens``: what the engine is to draw; ``asked``: what it is told for that. ``limit_px``: largest distance taken,
    None: :data:`calibration.solve.outcome.ENGINE_AGREES_PX`, what the corners' own uncertainty explains, or
    ``known_px``, how far off the engine's best picture of this lens is known to be. Usage as of
    :class:`calibration.solve.search.LevelMethod`. Raises :class:`NotEnoughData` where no target suits the lens.
    """

    def __init__(
        self, lens: Lens, asked: Lens, task: LevelTask, *, limit_px: float | None = None, known_px: float = 0.0
    ) -> None:
        self._lens = lens
        self._asked = asked
        self._task = task
        self._limit_px = limit_px
        self._known_px = known_px
        self._name = _suited(lens, task)
        self._target = task.targets[self._name]
        self._left = [(u, v, True) for u, v in _PLACES]
        self._pending: tuple[float, float, bool] | None = None
        self._expected: FloatArray | None = None
        self._step = 0
        self._residuals: list[FloatArray] = []
        self._sigma_px = 0.0
        self._trouble = ""

    @property
    def done(self) -> bool:
        """Whether :meth:`result` can be read."""
        return self._pending is None and (not self._left or bool(self._trouble))

    def ask(self) -> Capture | None:
        """The next render wanted; None while the one before must be told, or when done."""
        while self._pending is None and self._left and not self._trouble:
            u, v, again = self._left.pop(0)
            view = self._view(u, v)
            if view is None:
                continue
            (pan_deg, tilt_deg), self._expected = view
            self._pending = (u, v, again)
            capture = Capture(
                self._step,
                Source.VIRTUAL,
                self._name,
                pan_deg,
                tilt_deg,
                lens=self._asked,
                expected_px=self._expected,
                expected_sigma_px=_EXPECTED_SIGMA_PX,
            )
            self._step += 1
            return capture
        return None

    def tell(self, observation: Observation) -> None:
        """What was seen in the render asked for."""
        if self._pending is None:
            raise NotEnoughData("a render was told that was not asked for")
        u, v, again = self._pending
        self._pending = None
        if isinstance(observation.result, Refusal):
            if again and (u, v) != (0.0, 0.0):
                self._left.insert(0, (_RETRY * u, _RETRY * v, False))
            else:
                self._trouble = f"the target {self._name} was not found in the engine's render: " + (
                    observation.result.reason
                )
            return
        found, pose = observation.result, observation.camera_pose
        here = project_target(self._lens, pose, self._target)
        off = found.points_px - here[found.point_ids]
        if not np.isfinite(off).all():
            self._trouble = "the lens puts points of the target nowhere: it folds inside the picture"
            return
        self._residuals.append(off)
        self._sigma_px = max(self._sigma_px, sigma_px(found))

    def result(self) -> RenderAgreement:
        """How it ended."""
        limit_px = self._limit_px or max(ENGINE_AGREES_PX, self._known_px, _SIGMAS * self._sigma_px)
        off_px = pixel_error(self._residuals)
        trouble = self._trouble
        if not trouble and off_px is None:
            trouble = "no render could be asked for that shows a target"
        if not trouble and off_px is not None and off_px.max > limit_px:
            trouble = (
                f"the engine's render is up to {off_px.max:.2f} px off the lens's prediction (RMS {off_px.rms:.2f} px; "
                f"{limit_px:.2f} px are taken): its lens model is not the profile's (radius unit of k1 and k2, centre "
                "shift, FoV axis), or the target is not where the survey says"
            )
        return RenderAgreement(off_px, limit_px, len(self._residuals), trouble)

    def _view(self, u: float, v: float) -> tuple[tuple[float, float], FloatArray] | None:
        """Head angles and expected points with the target this share of the way to a corner, all of it in view; None
        where that is the middle over again."""
        width, height = self._task.image_size
        half = np.array([(width - 1) / 2, (height - 1) / 2])
        free = np.maximum(half - _OUTLINE * _size_px(self._lens, self._task, self._target) / 2 - _MARGIN * width, 0.0)
        way = np.array([u, v])
        for _ in range(_SHRINKS):
            pixel = half + way * free
            if np.any(way) and float(np.linalg.norm(pixel - half)) < _SAME_VIEW * width:
                return None
            angles = aim_at(self._lens, self._task, self._target, (float(pixel[0]), float(pixel[1])))
            try:
                expected = expected_points(self._lens, self._task, self._target, *angles)
            except GeometryError:
                expected = np.full((1, 2), math.nan)
            if inside_picture(expected, self._task.image_size, _MARGIN * width):
                return angles, expected
            way = way * _SHRINK
        if np.any(np.array([u, v])):
            return None
        self._trouble = (
            f"the target {self._name} cannot be brought into the middle of the picture: is it in the head's reach, and "
            "is the survey right?"
        )
        return None


def _suited(lens: Lens, task: LevelTask) -> str:
    """The target that fills most of the picture and still fits; boards and squares before lights."""
    sizes = {name: float(_size_px(lens, task, target)[1]) for name, target in task.targets.items()}
    solid = [name for name in sizes if task.targets[name].kind is not TargetKind.LIGHT] or list(sizes)
    height = task.image_size[1]
    fitting = [
        name
        for name in solid
        if sizes[name] <= _LARGEST * height
        and (task.targets[name].kind is TargetKind.LIGHT or sizes[name] >= _SMALLEST * height)
    ]
    if not fitting:
        told = ", ".join(f"{name} {sizes[name] / height:.0%}" for name in solid)
        raise NotEnoughData(
            f"no target suits a field of view of {lens.fov_x_deg:.1f} deg (height in the picture: {told}; "
            f"{_SMALLEST:.0%} to {_LARGEST:.0%} are measured): survey a larger or a smaller one"
        )
    return max(fitting, key=lambda name: sizes[name])


def _size_px(lens: Lens, task: LevelTask, target: Target) -> FloatArray:
    """Width and height (2,) px of the target seen straight on, without distortion."""
    if target.pose is None:
        return np.zeros(2)
    distance_m = float(np.linalg.norm(np.asarray(target.pose.centre_m) - np.asarray(task.pivot_m)))
    distance_m = max(distance_m - lens.nodal_offset_mm / 1000, 1e-3)
    return np.asarray(target.outline_m()) * lens.f_px / distance_m
