"""Fitting the camera of an engine to its renders: every kind of model by least squares, the residuals compared.

The model that explains the target's corners is taken if it does so to their exactness, and clearly better than any
other; else the engine is said not to be understood.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.errors import InvalidInput, NotConverged
from calibration.lens import Lens
from calibration.solve.engine_model import Direction, EngineModel
from calibration.types import CameraPose, Detection, FloatArray, Target

FLOOR_PX = 0.02
"""Corners of a render are believed to this at best: engines draw with few samples a pixel."""
TRUSTED_SIGMAS = 3.0
CLEARLY_BETTER = 2.0
"""The next best explanation must leave this many times the residual."""
SNAP_SIGMAS = 5.0
SNAP_LOOSE = 0.01
"""A gain this near to a whole number, and within five sigma of it, is that number."""

_UNSEEN_PX = 1e-3
# What a parameter moves in all corners together, below which the renders do not show it.
_SNAP_PX, _SNAP_NODAL = 0.2, 0.05
_NODAL_GAINS = (1.0, -1.0, 1000.0, -1000.0, 0.001, -0.001)
_REVERSE_STEPS = 25
_FARTHEST = 1e5


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
              "shift_offset_y_px", "nodal_gain", "aspect_gain")  # fmt: skip
_SCALES = np.array([1e-2, 0.1, 0.1, 0.1, 0.1, 10.0, 10.0, 0.5, 1e-2])
_KINDS = tuple((direction, power) for direction in Direction for power in (0, 1, -1))


def learn_engine(renders: Sequence[Render]) -> LearnedEngine:
    """The model that explains the renders best: each kind fitted by least squares, the residuals compared."""
    noise_px = _noise_px(renders)
    corners = _Corners(renders)
    fits = [_fitted(corners, renders, direction, power, noise_px) for direction, power in _KINDS]
    fits.sort(key=lambda fit: fit.rms_px)
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
    drawn = model.drawn(render.asked)
    rays = rays_of(world_to_camera(render.camera_pose, drawn.lens.nodal_offset_mm, world_points(render)))
    return np.asarray(drawn.project(rays) - render.detection.points_px)


class _Corners:
    """All corners of all renders in one row each, for fast trials of models: the same drawing as
    :meth:`calibration.solve.engine_model.EngineModel.drawn`, in half widths."""

    def __init__(self, renders: Sequence[Render]) -> None:
        first = renders[0].asked
        self.half_width_px = first.image_size[0] / 2
        self.centre = (np.asarray(first.image_size, dtype=np.float64) - 1) / 2
        self.aspect = first.pixel_aspect
        parts = [
            world_to_camera(r.camera_pose, 0.0, world_points(r))[:, :3] for r in renders
        ]  # before the pupil moves along the axis
        self.points_m = np.concatenate(parts)
        self.seen_px = np.concatenate([r.detection.points_px for r in renders])
        counts = [len(part) for part in parts]

        def each(value: Callable[[Lens], float]) -> FloatArray:
            return np.repeat([value(r.asked) for r in renders], counts)

        self.f_hw = each(lambda lens: lens.f_px) / self.half_width_px
        self.k1_hw, self.k2_hw = each(lambda lens: lens.k1_hw), each(lambda lens: lens.k2_hw)
        self.shift = np.column_stack(
            [each(lambda lens: lens.center_shift_px[0]), each(lambda lens: lens.center_shift_px[1])]
        )
        self.nodal_mm = each(lambda lens: lens.nodal_offset_mm)

    def misses(self, model: EngineModel) -> FloatArray:
        """Model minus seen (M, 2) px; the picture's width where the model draws nothing."""
        depth = self.points_m[:, 2] - model.nodal_gain * self.nodal_mm / 1000
        f_hw = self.f_hw * model.focal_gain
        flat = self.points_m[:, :2] / np.where(depth > 0, depth, np.nan)[:, None] * f_hw[:, None]
        q = self.f_hw ** (2 * model.unit_power)
        k1, k2 = model.k1_gain * self.k1_hw * q, model.k2_gain * self.k2_hw * q * q
        radius = np.sqrt(np.sum(flat * flat, axis=1))
        scale = _bent(radius, k1, k2, model.direction)
        aspect = np.array([1.0, self.aspect * model.aspect_gain])
        shift = np.asarray(model.shift_gain) * self.shift + np.asarray(model.shift_offset_px)
        off = flat * scale[:, None] * aspect * self.half_width_px + self.centre + shift - self.seen_px
        far = 2 * self.half_width_px
        return np.clip(np.where(np.isfinite(off), off, far), -10 * far, 10 * far)


def _bent(radius: FloatArray, k1: FloatArray, k2: FloatArray, direction: Direction) -> FloatArray:
    """Distorted over undistorted radius (M,), half widths; NaN beyond the fold."""
    if direction is Direction.FORWARD:
        r2 = radius * radius
        return np.where(1 + r2 * (3 * k1 + 5 * k2 * r2) > 0, 1 + r2 * (k1 + k2 * r2), np.nan)
    r_d = radius.copy()
    with np.errstate(all="ignore"):
        for _ in range(_REVERSE_STEPS):
            r2 = r_d * r_d
            r_d = r_d - (r_d * (1 + r2 * (k1 + k2 * r2)) - radius) / (1 + r2 * (3 * k1 + 5 * k2 * r2))
        r2 = r_d * r_d
        solved = np.abs(r_d * (1 + r2 * (k1 + k2 * r2)) - radius) < 1e-9 * (1 + radius)
        solved &= (r_d >= 0) & (1 + r2 * (3 * k1 + 5 * k2 * r2) > 0)
        return np.where(solved, np.divide(r_d, radius, out=np.ones_like(radius), where=radius > 0), np.nan)


def world_points(render: Render) -> FloatArray:
    """The points seen in a render, world (N, 3) in metres."""
    pose = render.target.pose
    if pose is None:
        raise InvalidInput("target", render.target.kind.value, "learning an engine needs a posed target")
    return target_points_world(pose, render.target.points_m()[render.detection.point_ids])


def _fitted(
    corners: _Corners, renders: Sequence[Render], direction: Direction, power: int, noise_px: float
) -> LearnedEngine:
    """One kind of model fitted to the corners, its gains of k1 and k2 counted at the first render's focal length."""
    origin = renders[0].asked.center_shift_px
    q = float(corners.f_hw[0]) ** (2 * power)

    def model_of(x: FloatArray) -> EngineModel:
        values = [float(value) for value in x]
        return EngineModel(
            direction,
            power,
            focal_gain=math.exp(values[0]),
            k1_gain=values[1] / q,
            k2_gain=values[2] / q**2,
            shift_gain=(values[3], values[4]),
            shift_offset_px=(values[5], values[6]),
            nodal_gain=values[7],
            aspect_gain=math.exp(values[8]),
        )

    def misses(x: FloatArray) -> FloatArray:
        return corners.misses(model_of(np.clip(x, -_FARTHEST, _FARTHEST))).ravel()

    best: OptimizeResult | None = None
    for sign in (1.0, -1.0):
        # A mirrored shift with an origin far from the middle: the offset starts where the first render is right.
        start = np.array([0.0, 0.0, 0.0, sign, sign, -sign * origin[0], -sign * origin[1], 1.0, 0.0])
        found = least_squares(misses, start, x_scale=_SCALES, method="trf", max_nfev=60)
        if best is None or found.cost < best.cost:
            best = found
        if math.sqrt(2 * best.cost / best.fun.size) < TRUSTED_SIGMAS * noise_px:
            break
    if best is None:
        raise NotConverged("the engine's model", 0, math.inf)  # two starts were made
    rms_px = math.sqrt(2 * float(best.cost) / best.fun.size)
    jacobian = np.asarray(best.jac)
    strength = np.sqrt(np.sum(jacobian**2, axis=0))
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(rms_px, noise_px) ** 2
    model = model_of(np.asarray(best.x))
    natural = np.array([model.focal_gain, 1 / q, 1 / q**2, 1.0, 1.0, 1.0, 1.0, 1.0, model.aspect_gain])
    sigma = np.where(strength * _SCALES > _UNSEEN_PX, np.sqrt(np.maximum(np.diag(covariance), 0.0)) * natural, np.inf)
    if not math.isfinite(sigma[7]):
        model = replace(model, nodal_gain=1.0)
    return LearnedEngine(model, False, rms_px, math.inf, noise_px, len(renders), sigma=tuple(sigma.tolist()))


def _snapped(fit: LearnedEngine, renders: Sequence[Render]) -> LearnedEngine:
    """``fit`` with its numbers at whole values (gains at plus or minus 1, k2's at the square of k1's, offsets at 0, the
    picture's middle or half a pixel) where that explains the renders as well."""
    m = fit.model
    sigma = dict(zip(PARAMETERS, fit.sigma, strict=True))

    def near(name: str, value: float, candidates: Sequence[float], loose: float) -> float:
        reach = min(SNAP_SIGMAS * sigma[name], loose)
        return next((c for c in candidates if abs(value - c) <= max(reach, 1e-12)), value)

    def gain(name: str, value: float) -> float:
        return near(name, value, (1.0, -1.0), SNAP_LOOSE)

    k1 = gain("k1_gain", m.k1_gain)
    squares = (1.0, -1.0, k1 * k1, -k1 * k1)
    middle = [(size - 1) / 2 for size in renders[0].asked.image_size]
    offsets = [
        near(
            f"shift_offset_{axis}_px",
            m.shift_offset_px[i],
            [sign * middle[i] + half for sign in (0.0, 1.0, -1.0) for half in (0.0, 0.5, -0.5)],
            _SNAP_PX,
        )
        for i, axis in enumerate("xy")
    ]
    snapped = replace(
        m,
        focal_gain=gain("focal_gain", m.focal_gain),
        k1_gain=k1,
        k2_gain=near("k2_gain", m.k2_gain, squares, SNAP_LOOSE * max(1.0, k1 * k1)),
        shift_gain=(gain("shift_gain_x", m.shift_gain[0]), gain("shift_gain_y", m.shift_gain[1])),
        shift_offset_px=(offsets[0], offsets[1]),
        nodal_gain=near("nodal_gain", m.nodal_gain, _NODAL_GAINS, _SNAP_NODAL * abs(m.nodal_gain)),
        aspect_gain=near("aspect_gain", m.aspect_gain, (1.0,), SNAP_LOOSE),
    )
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
