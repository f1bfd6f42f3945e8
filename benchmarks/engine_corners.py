"""A simulated engine at the level of corners: what a detector would find in its render of a lens that is asked for.

The profile in between is the default one, which hands a lens on in the product's own words. What the engine makes of
them is drawn by :mod:`engine_adapters.sim`, which shares no code with what learns and searches here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.camera import target_points_world
from calibration.compare import grid_pixels
from calibration.lens import Lens
from calibration.solve.iteration import LevelFit
from calibration.solve.level import solve_level
from calibration.solve.problem import View
from calibration.solve.search import LevelTask, aim_at
from calibration.synthetic import observe
from calibration.types import CameraPose, Detection, DetectionResult, Quality, Refusal, Target, TargetKind, TargetPose
from engine_adapters.sim.engine_camera import MAX_FOV_DEG, MIN_FOV_DEG, EngineCamera
from engine_adapters.sim.optics import Optics
from engine_adapters.sim.optics import View as SimulatedView

SIZE = (1920, 1080)
SENSOR_MM = (9.59, 5.39)
PIVOT_M = (0.0, 0.0, 1.6)
DISTANCE_M = 5.0
SMALLEST_PX = 80.0
"""A target that is drawn smaller than this is not found."""

Array = NDArray[np.float64]
Warp = Callable[[Array], Array]
PLACES = ((0.0, 0.0), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """A lens to be matched: the room, the camera's pictures and their fit."""

    task: LevelTask
    fit: LevelFit
    views: list[View]


class CornerEngine:
    """The engine. ``beyond``: how far outside the picture corners are still found, as a share of its size: what a
    search without a model is granted, whose first trials would else show nothing. ``warp``: what else bends its
    picture, pixels (N, 2) to pixels; ``renders``: how many were taken."""

    def __init__(
        self,
        camera: EngineCamera,
        rng: np.random.Generator,
        *,
        sigma_px: float = 0.005,
        beyond: float = 0.0,
        warp: Warp | None = None,
    ) -> None:
        self._camera = camera
        self._rng = rng
        self._sigma_px = sigma_px
        self._beyond_px = beyond * np.asarray(SIZE, dtype=np.float64)
        self._warp = warp
        self.renders = 0

    def optics(self, asked: Lens) -> tuple[Optics, float] | None:
        """The lens drawn and its nodal offset (mm); None for values that the engine refuses."""
        values = {
            "fov_x": asked.fov_x_deg,
            "k1": asked.k1,
            "k2": asked.k2,
            "center_shift_x": asked.center_shift_px[0],
            "center_shift_y": asked.center_shift_px[1],
            "nodal_offset": asked.nodal_offset_mm,
        }
        if not all(map(math.isfinite, values.values())):
            return None
        if not MIN_FOV_DEG <= self._camera.fov_x_deg(values["fov_x"], SIZE) <= MAX_FOV_DEG:
            return None
        return self._camera.optics(values, SIZE, SENSOR_MM)

    def render(self, asked: Lens, pose: CameraPose, target: Target) -> DetectionResult:
        """The target's corners as found in a render; refused unless all of it is in the picture."""
        self.renders += 1
        drawn = self.optics(asked)
        if drawn is None or target.pose is None:
            return Refusal("the engine refuses the values")
        optics, nodal_mm = drawn
        view = SimulatedView(optics, pose.pivot_m, pose.pan_deg, pose.tilt_deg, pose.roll_deg, nodal_mm)
        points = view.to_camera(target_points_world(target.pose, target.points_m()))
        if np.any(points[:, 2] <= 0):
            return Refusal("the object is behind the camera")
        pixels = drawn_px(optics, points[:, :2] / points[:, 2:])
        if self._warp is not None:
            pixels = self._warp(pixels)
        inside = np.all(pixels >= -self._beyond_px) and np.all(pixels <= np.asarray(SIZE) - 1 + self._beyond_px)
        if not inside or float(np.ptp(pixels[:, 0])) < SMALLEST_PX:  # NaN is not inside
            return Refusal("the object is not in the picture, or too small")
        count = len(pixels)
        return Detection(
            kind=target.kind,
            points_px=pixels + self._rng.normal(0.0, self._sigma_px, pixels.shape),
            point_ids=np.arange(count),
            covariance_px2=np.tile(np.eye(2) * self._sigma_px**2, (count, 1, 1)),
            centre_px=pixels.mean(axis=0),
            blur_px=0.5,
            quality=Quality(1.0),
        )

    def off_px(self, asked: Lens, lens: Lens) -> Array:
        """Drawn minus wanted (M, 2) px over the frame: for judging only. Infinite where nothing is drawn."""
        pixels = grid_pixels(SIZE).reshape(-1, 2)
        rays = lens.unproject(pixels)
        seen = np.isfinite(rays[:, 0])
        drawn = self.optics(asked)
        if drawn is None:
            return np.full((int(seen.sum()), 2), np.inf)
        at = drawn_px(drawn[0], rays[seen])
        if self._warp is not None:
            at = self._warp(at)
        return np.nan_to_num(at - pixels[seen], nan=np.inf)


def drawn_px(optics: Optics, rays: Array) -> Array:
    """Undistorted rays (N, 2) to pixels (N, 2); NaN beyond the polynomial's fold."""
    q = np.sum(rays * rays, axis=-1)
    fold = optics.fold_radius
    if optics.reverse and math.isfinite(fold):
        fold *= 1.0 + optics.k1 * fold**2 + optics.k2 * fold**4
    with np.errstate(all="ignore"):
        scale = np.where(q < fold**2, optics.bent(q)[0], np.nan)
    f_px = np.array([optics.f_px, optics.f_px * optics.pixel_aspect])
    return np.asarray(rays * scale[:, None] * f_px + np.asarray(optics.center_px))


def random_lens(rng: np.random.Generator) -> Lens:
    """A lens between wide and long, bent so that it does not fold in the picture."""
    while True:
        fov = math.exp(rng.uniform(math.log(10.0), math.log(75.0)))
        shift = (float(rng.uniform(-15, 15)), float(rng.uniform(-15, 15)))
        straight = Lens.from_fov(SIZE, fov, center_shift_px=shift)
        lens = straight.with_hw(straight.f_px, float(rng.uniform(-0.12, 0.08)), float(rng.uniform(-0.02, 0.03)))
        if not replace(lens, center_shift_px=(60.0, 60.0)).folds_inside():
            return lens


def level_of(lens: Lens, rng: np.random.Generator, sigma_px: float = 0.02) -> Level:
    """A board that takes 0.4 of the picture's height, seen in its middle and three corners, and the fit of it."""
    square_m = 0.4 * DISTANCE_M * SIZE[1] / lens.f_px / 7
    pose = TargetPose((-0.3, DISTANCE_M, PIVOT_M[2]))
    target = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=square_m, pose=pose)
    task = LevelTask(0.0, 0.0, SIZE, {"board": target}, PIVOT_M)
    views = []
    for place in PLACES:
        for share in np.linspace(0.75, 0.3, 19):
            pixel = [(side - 1) / 2 * (1 + share * way) for side, way in zip(SIZE, place, strict=True)]
            pan, tilt = aim_at(lens, task, target, (pixel[0], pixel[1]))
            found = observe(lens, task.pose(pan, tilt), target, rng, sigma_px)
            if isinstance(found, Detection):
                views.append(View(f"picture {place}", "board", target, found, task.pose(pan, tilt)))
                break
    return Level(task, solve_level(views, SIZE), views)
