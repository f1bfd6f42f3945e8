"""Learning how an engine draws, from a few of its renders at known values.

The engine is asked for lenses chosen so that each of its habits shows (:class:`EngineLearning`, an ask/tell object);
the target's corners in its renders, at a known pose, are then fitted with every member of
:class:`calibration.solve.engine_model.EngineModel`. The one that explains them is taken if it does so to the exactness
of the corners, and clearly better than any other; else the engine is said not to be understood, and nothing is trusted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.errors import CalibrationError, InvalidInput
from calibration.lens import Lens
from calibration.solve.engine_model import Direction, EngineModel
from calibration.solve.search import Capture, LevelTask, Observation, Source, aim_at
from calibration.types import CameraPose, Detection, FloatArray, Refusal, Role, Target, TargetKind

FLOOR_PX = 0.02
"""Corners of a render are believed to this at best: engines draw with few samples a pixel."""
TRUSTED_SIGMAS = 3.0
CLEARLY_BETTER = 2.0
"""The next best explanation must leave this many times the residual."""
SNAP_SIGMAS = 5.0
SNAP_LOOSE = 2e-3
"""A gain this near to a whole number, and within five sigma of it, is that number."""

_FILL = 0.42
# Height of the target in the first render, as a share of the picture's.
_PLACE = (0.62, 0.36)
# Where in the picture it stands: off the middle, so that the distortion shows.
_LARGEST_F_OF_HALF_WIDTH = 2.2
_LEAST_RENDERS = 6
_FIRST_K1_HW = 0.004
_BEND_PX = 9.0
# How far k1 and k2 may move a corner: far beyond the corners' noise, far from folding the picture.
_MOST_BEND_HW = 0.06
_SHIFT_PX = (14.0, 9.0)
_NODAL_MM = 120.0
_STALE_PX = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Render:
    """A render of the engine: the lens asked for, the pose, and where the target's corners (N, 2) px were seen."""

    asked: Lens
    camera_pose: CameraPose
    target: Target
    detection: Detection


@dataclass(frozen=True, slots=True)
class LearnedEngine:
    """What the renders tell of the engine.

    ``rms_px``: what is left between the model and the corners, per coordinate; ``next_rms_px``: the same for the best
    model of another kind; ``noise_px``: how exactly the corners were found; ``renders``: how many could be used.
    ``trusted``: the model explains the renders and no other does; else ``reason`` says why not. ``sigma``: standard
    deviations of the model's numbers, in the order of :data:`PARAMETERS`.
    """

    model: EngineModel
    trusted: bool
    rms_px: float
    next_rms_px: float
    noise_px: float
    renders: int
    reason: str = ""
    sigma: tuple[float, ...] = ()


PARAMETERS = ("focal_gain", "k1_gain", "k2_gain", "shift_gain_x", "shift_gain_y", "shift_offset_x_px",
              "shift_offset_y_px", "nodal_gain")  # fmt: skip
_KINDS = tuple((direction, power) for direction in Direction for power in (0, 1, -1))


class EngineLearning:
    """Asks for about eight renders, one after the other, and tells how the engine draws.

    ``target``: name of the task's target to look at. Usage as of :class:`calibration.solve.search.LevelMethod`.
    """

    def __init__(self, task: LevelTask, target: str | None = None) -> None:
        self._task = task
        self._name = target or _largest(task)
        self._target = task.targets[self._name]
        self._base = _first_lens(task, self._target)
        width, height = task.image_size
        place = (_PLACE[0] * (width - 1), _PLACE[1] * (height - 1))
        self._pan, self._tilt = aim_at(self._base, task, self._target, place)
        middle = ((width - 1) / 2, (height - 1) / 2)
        # An engine that counts the shift from another origin than the profile says draws the target out of the picture.
        self._origins = [(0.0, 0.0), middle, (-middle[0], -middle[1])]
        self._origin = (0.0, 0.0)
        self._renders: list[Render] = []
        self._refused: list[str] = []
        self._step = 0
        self._pending: dict[int, Lens] = {}
        self._plan: list[str] = ["base"]

    @property
    def done(self) -> bool:
        """Whether :meth:`result` can be read."""
        return not self._plan and not self._pending

    def ask(self) -> Capture | None:
        """The next render wanted, None while the one before must be told first."""
        if self._pending or not self._plan:
            return None
        lens = self._lens_for(self._plan.pop(0))
        capture = Capture(self._step, Source.VIRTUAL, self._name, self._pan, self._tilt, Role.FREE, lens=lens)
        self._pending[self._step] = lens
        self._step += 1
        return capture

    def tell(self, observation: Observation) -> None:
        """What was seen in a render."""
        lens = self._pending.pop(observation.step)
        if isinstance(observation.result, Refusal):
            self._refused.append(observation.result.reason)
            if not self._renders:
                if self._origins:
                    self._plan = ["base"]
                return
        else:
            self._renders.append(Render(lens, observation.camera_pose, self._target, observation.result))
            if len(self._renders) == 1:
                self._plan = ["shift", "k1 small", "k1", "k2", "near", "far", "nodal"]

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
        base = self._base
        if what == "base":
            self._origin = self._origins.pop(0)
        bend1, bend2 = self._bends()
        x, y = _SHIFT_PX
        f_px, k1_hw, k2_hw, shift, nodal_mm = {
            "base": (1.0, 0.0, 0.0, (0.0, 0.0), 0.0),
            "shift": (1.0, 0.0, 0.0, (x, y), 0.0),
            "k1 small": (1.0, _FIRST_K1_HW, 0.0, (0.0, 0.0), 0.0),
            "k1": (1.0, bend1, 0.0, (0.0, 0.0), 0.0),
            "k2": (1.0, 0.0, bend2, (0.0, 0.0), 0.0),
            "near": (1.25, -0.8 * bend1, 0.0, (-x, y), 0.0),
            "far": (0.75, bend1, bend2, (0.5 * x, -y), 0.0),
            "nodal": (1.0, -0.5 * bend1, 0.5 * bend2, (-x, -y), _NODAL_MM),
        }[what]
        place = (self._origin[0] + shift[0], self._origin[1] + shift[1])
        return replace(base, center_shift_px=place, nodal_offset_mm=nodal_mm).with_hw(f_px * base.f_px, k1_hw, k2_hw)

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


def learn_engine(renders: Sequence[Render]) -> LearnedEngine:
    """The model that explains the renders best: each kind fitted by least squares, the residuals compared."""
    noise_px = _noise_px(renders)
    fits = sorted((_fitted(renders, direction, power, noise_px) for direction, power in _KINDS), key=lambda f: f.rms_px)
    best = fits[0]
    others = [fit.rms_px for fit in fits[1:] if not _same_drawing(best.model, fit.model, renders)]
    next_px = min(others, default=math.inf)
    snapped = _snapped(best, renders)
    trusted, reason = True, ""
    if snapped.rms_px > TRUSTED_SIGMAS * noise_px:
        trusted = False
        reason = (
            f"no model of an engine's camera explains its renders: {snapped.rms_px:.2f} px are left, the corners are "
            f"good to {noise_px:.3f} px"
        )
    elif next_px < CLEARLY_BETTER * max(snapped.rms_px, noise_px / TRUSTED_SIGMAS):
        trusted = False
        reason = f"two models explain the engine's renders alike ({snapped.rms_px:.3f} and {next_px:.3f} px are left)"
    return replace(
        snapped, trusted=trusted, reason=reason, next_rms_px=next_px, noise_px=noise_px, renders=len(renders)
    )


def residuals_px(model: EngineModel, render: Render) -> FloatArray:
    """Model minus seen corners (N, 2) px of one render; NaN where the model draws nothing."""
    pose = render.target.pose
    if pose is None:
        raise InvalidInput("target", render.target.kind.value, "learning an engine needs a posed target")
    world = target_points_world(pose, render.target.points_m()[render.detection.point_ids])
    drawn = model.drawn(render.asked)
    rays = rays_of(world_to_camera(render.camera_pose, drawn.lens.nodal_offset_mm, world))
    return np.asarray(drawn.project(rays) - render.detection.points_px)


def _fitted(renders: Sequence[Render], direction: Direction, power: int, noise_px: float) -> LearnedEngine:
    far = float(renders[0].asked.image_size[0])
    scales = np.array([1e-2, 0.1, 0.1, 0.1, 0.1, 10.0, 10.0, 0.5])
    origin = renders[0].asked.center_shift_px
    q = (2 * renders[0].asked.f_px / far) ** (2 * power)

    def model_of(x: FloatArray) -> EngineModel:
        return EngineModel(
            direction, power, math.exp(x[0]), x[1] / q, x[2] / q**2, (x[3], x[4]), (x[5], x[6]), x[7]
        )  # fmt: skip

    def misses(x: FloatArray) -> FloatArray:
        model = model_of(x)
        off = np.concatenate([residuals_px(model, render) for render in renders])
        return np.where(np.isfinite(off), off, far).ravel()

    best: tuple[float, FloatArray, FloatArray] | None = None
    for sign in (1.0, -1.0):
        # A mirrored shift with an origin far from the middle: the offset starts where the first render is right.
        start = np.array([0.0, 0.0, 0.0, sign, sign, -sign * origin[0], -sign * origin[1], 1.0])
        try:
            found = least_squares(misses, start, x_scale=scales, method="trf", loss="linear", max_nfev=80)
        except (ValueError, CalibrationError):
            continue
        if best is None or found.cost < best[0]:
            best = float(found.cost), np.asarray(found.x), np.asarray(found.jac)
    if best is None:
        return _not_understood("no fit", len(renders))
    cost, x, jacobian = best
    count = sum(2 * len(render.detection.points_px) for render in renders)
    rms_px = math.sqrt(2 * cost / count)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(rms_px, noise_px) ** 2
    model = model_of(x)
    natural = np.array([model.focal_gain, 1 / q, 1 / q**2, 1.0, 1.0, 1.0, 1.0, 1.0])
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * natural
    return LearnedEngine(model, False, rms_px, math.inf, noise_px, len(renders), sigma=tuple(sigma.tolist()))


def _snapped(fit: LearnedEngine, renders: Sequence[Render]) -> LearnedEngine:
    """``fit`` with its numbers at whole values (gains at plus or minus 1, offsets at 0 or half a pixel) where that
    explains the renders as well."""
    m, sigma = fit.model, fit.sigma

    def near(value: float, spread: float, candidates: tuple[float, ...], loose: float) -> float:
        for candidate in candidates:
            if abs(value - candidate) < max(min(SNAP_SIGMAS * spread, loose), 1e-9):
                return candidate
        return value

    one = (1.0, -1.0)
    gains = [
        near(v, s, one, SNAP_LOOSE * 5)
        for v, s in zip((m.focal_gain, m.k1_gain, m.k2_gain, *m.shift_gain), sigma, strict=False)
    ]
    width, height = renders[0].asked.image_size
    offsets = []
    for axis, size in enumerate((width, height)):
        whole = [sign * (size - 1) / 2 + half for sign in (0.0, 1.0, -1.0) for half in (0.0, 0.5, -0.5)]
        offsets.append(near(m.shift_offset_px[axis], sigma[5 + axis], tuple(whole), 0.1))
    snapped = EngineModel(
        m.direction, m.unit_power, gains[0], gains[1], gains[2], (gains[3], gains[4]), (offsets[0], offsets[1]),
        near(m.nodal_gain, sigma[7], one, 0.05),
    )  # fmt: skip
    off = np.concatenate([residuals_px(snapped, render) for render in renders])
    rms_px = float(np.sqrt(np.mean(off**2))) if np.isfinite(off).all() else math.inf
    if rms_px > max(1.2 * fit.rms_px, fit.rms_px + fit.noise_px / 4):
        return fit
    return replace(fit, model=snapped, rms_px=rms_px)


def _same_drawing(a: EngineModel, b: EngineModel, renders: Sequence[Render]) -> bool:
    """Whether two models draw the learned renders' whole pictures alike: then it does not matter which is right."""
    pixels = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.3, 0.3, 5)), axis=-1)
    for render in renders:
        for f_gain in (0.25, 1.0, 4.0):
            asked = render.asked.with_hw(f_gain * render.asked.f_px, render.asked.k1_hw, render.asked.k2_hw)
            rays = pixels * asked.image_size[0] / asked.f_px
            apart = a.drawn(asked).project(rays) - b.drawn(asked).project(rays)
            if not float(np.nanmax(np.abs(apart), initial=0.0)) < FLOOR_PX:
                return False
    return True


def _noise_px(renders: Sequence[Render]) -> float:
    variance = np.mean([np.trace(c) / 2 for render in renders for c in render.detection.covariance_px2])
    return max(FLOOR_PX, math.sqrt(float(variance)))


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


def _radius_hw(render: Render, width: int) -> float:
    """Farthest corner from the picture's middle, half widths."""
    middle = (np.asarray(render.asked.image_size) - 1) / 2
    return float(np.max(np.linalg.norm(render.detection.points_px - middle, axis=1))) / (width / 2)
