"""The least-squares problem of a level: which parameters there are, residuals, Jacobian, normal equations.

Every picture of the level is one :class:`View`. One formulation serves posed targets, roughly posed ones and
hand-held boards: a pose known exactly is a constant, one known roughly is a parameter with a prior, an unknown one
a parameter without. Lens parameters of the iteration are (log f_px, k1_hw, k2_hw, sx, sy): of like size for every
focal length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calibration.camera import camera_rotation, target_rotation
from calibration.lens import Lens
from calibration.types import CameraPose, Detection, FloatArray, IntArray, Target

LENS_COUNT = 5
_PER_MM = np.array([[0.0], [0.0], [-0.001]])
# d(points in camera axes, m) / d(nodal offset, mm): the pupil moves forward along the optical axis.
PRIOR_K1_HW = 0.5
PRIOR_K2_HW = 0.3
PRIOR_SHIFT_OF_WIDTH = 0.1
PRIOR_NODAL_MM = 500.0
_HELD = 1e-9
# Wider than any lens that makes pictures (a 50 % bend at the edge, a pupil half a metre off the pivot); they only keep
# a quantity finite that the pictures do not show, and such a quantity is then reported as not told.


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A target found in one picture, and what is known beforehand of where the camera was.

    ``camera_pose`` None, or ``target.pose`` None: the pose of camera to target is free for this picture.
    """

    name: str
    target_name: str
    target: Target
    detection: Detection
    camera_pose: CameraPose | None = None

    @property
    def free(self) -> bool:
        return self.camera_pose is None or self.target.pose is None


def skew(v: FloatArray) -> FloatArray:
    """[v]x (N, 3, 3) of v (N, 3), so that [v]x w = v x w."""
    zero = np.zeros(v.shape[:-1])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack(
        [np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)],
        axis=-2,
    )


def rotation_exp(w: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (3,), radians (Rodrigues)."""
    angle = float(np.linalg.norm(w))
    k = skew(w)
    if angle < 1e-9:
        return np.asarray(np.eye(3) + k + k @ k / 2)
    return np.asarray(np.eye(3) + math.sin(angle) / angle * k + (1 - math.cos(angle)) / angle**2 * (k @ k))


def rotation_log(R: FloatArray) -> FloatArray:
    """Rotation vector (3,) of a rotation matrix, radians; for angles well below pi."""
    v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = float(np.linalg.norm(v))
    angle = math.atan2(sine, (float(np.trace(R)) - 1) / 2)
    return np.asarray(v if sine < 1e-12 else v * angle / sine)


@dataclass(slots=True, eq=False)
class _Pivot:
    start: int
    prior_m: FloatArray
    sigma_m: float
    value_m: FloatArray


@dataclass(slots=True, eq=False)
class _Turn:
    """A rotation with a prior. The increment is local: R <- R exp(w)."""

    start: int
    prior: FloatArray
    sigma_rad: float
    value: FloatArray


@dataclass(slots=True, eq=False)
class _Free:
    """Camera from target, X_c = R q + t, without a prior. Increment R <- exp(w) R, t <- t + dt."""

    start: int
    R_ct: FloatArray
    t_ct_m: FloatArray


@dataclass(slots=True, eq=False)
class State:
    """All values of one iteration; copied before a trial step so that a bad step is simply dropped."""

    lens: Lens
    pivots: dict[tuple[float, ...], _Pivot] = field(default_factory=dict)
    cameras: dict[int, _Turn] = field(default_factory=dict)
    target_places: dict[str, _Pivot] = field(default_factory=dict)
    target_turns: dict[str, _Turn] = field(default_factory=dict)
    free: dict[int, _Free] = field(default_factory=dict)

    def copy(self) -> State:
        return State(
            self.lens,
            {k: _Pivot(p.start, p.prior_m, p.sigma_m, p.value_m) for k, p in self.pivots.items()},
            {k: _Turn(p.start, p.prior, p.sigma_rad, p.value) for k, p in self.cameras.items()},
            {k: _Pivot(p.start, p.prior_m, p.sigma_m, p.value_m) for k, p in self.target_places.items()},
            {k: _Turn(p.start, p.prior, p.sigma_rad, p.value) for k, p in self.target_turns.items()},
            {k: _Free(p.start, p.R_ct, p.t_ct_m) for k, p in self.free.items()},
        )


@dataclass(slots=True, eq=False)
class Evaluation:
    """Residuals (N, 2) in px (model minus picture) and the Jacobian (N, 2, P); rows with NaN cannot be projected."""

    residual_px: FloatArray
    jacobian: FloatArray
    prior_residual: FloatArray
    prior_jacobian: FloatArray


class Problem:
    """A level's views with their unknowns.

    ``lens_free`` False keeps the lens as it is (only poses move); ``held`` names lens quantities (``k1``, ``k2``,
    ``center_shift_px``) to be kept at 0, or ``nodal_offset_mm`` to be kept as it is. The nodal offset, with the prior
    ``nodal_sigma_mm``, is an unknown wherever posed pictures could tell it: taken as known, its error would hide in
    the field of view.
    """

    def __init__(
        self,
        views: Sequence[View],
        lens: Lens,
        free_poses: dict[int, tuple[FloatArray, FloatArray]],
        *,
        lens_free: bool = True,
        held: tuple[str, ...] = (),
        nodal_sigma_mm: float = PRIOR_NODAL_MM,
    ) -> None:
        self.views = tuple(views)
        self._nodal_sigma_mm = nodal_sigma_mm
        shift_px = _HELD if "center_shift_px" in held else PRIOR_SHIFT_OF_WIDTH * lens.image_size[0]
        self._prior_sigmas = (
            _HELD if "k1" in held else PRIOR_K1_HW,
            _HELD if "k2" in held else PRIOR_K2_HW,
            shift_px,
            shift_px,
        )
        self.lens_free = lens_free
        self.state = State(lens)
        self.count = LENS_COUNT if lens_free else 0
        self.nodal_prior_mm = lens.nodal_offset_mm
        posed = sum(not view.free for view in self.views)
        self.nodal_free = lens_free and posed >= 2 and "nodal_offset_mm" not in held
        self.nodal_column = self._take(1) if self.nodal_free else -1
        for index, view in enumerate(self.views):
            self._add_unknowns(index, view, free_poses)
        self.points_m: list[FloatArray] = []
        self.observed_px = np.concatenate([v.detection.points_px for v in self.views])
        self.view_of: IntArray = np.concatenate(
            [np.full(len(v.detection.points_px), i, dtype=np.int64) for i, v in enumerate(self.views)]
        )
        for view in self.views:
            plane = view.target.points_m()[view.detection.point_ids]
            self.points_m.append(np.column_stack([plane, np.zeros(len(plane))]))

    def _take(self, size: int) -> int:
        start = self.count
        self.count += size
        return start

    def _add_unknowns(self, index: int, view: View, free_poses: dict[int, tuple[FloatArray, FloatArray]]) -> None:
        camera, pose = view.camera_pose, view.target.pose
        if camera is None or pose is None:
            R_ct, t_ct_m = free_poses[index]
            self.state.free[index] = _Free(self._take(6), R_ct, t_ct_m)
            return
        if camera.sigma_m > 0 and (*camera.pivot_m, camera.sigma_m) not in self.state.pivots:
            prior = np.asarray(camera.pivot_m)
            key = (*camera.pivot_m, camera.sigma_m)
            self.state.pivots[key] = _Pivot(self._take(3), prior, camera.sigma_m, prior)
        if camera.sigma_deg > 0:
            R_wc = camera_rotation(camera.pan_deg, camera.tilt_deg, camera.roll_deg)
            self.state.cameras[index] = _Turn(self._take(3), R_wc, math.radians(camera.sigma_deg), R_wc)
        if pose.sigma_m > 0 and view.target_name not in self.state.target_places:
            prior = np.asarray(pose.centre_m)
            self.state.target_places[view.target_name] = _Pivot(self._take(3), prior, pose.sigma_m, prior)
        if pose.sigma_deg > 0 and view.target_name not in self.state.target_turns:
            R_wt = target_rotation(pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
            self.state.target_turns[view.target_name] = _Turn(self._take(3), R_wt, math.radians(pose.sigma_deg), R_wt)

    def camera_points(self, state: State, index: int) -> tuple[FloatArray, list[tuple[int, FloatArray]]]:
        """One view's points in camera axes (n, 3), and d(points)/d(unknowns): (first column, (n, 3, columns)) each."""
        view, q = self.views[index], self.points_m[index]
        if index in state.free:
            pose = state.free[index]
            turned = q @ pose.R_ct.T
            identity = np.broadcast_to(np.eye(3), (len(q), 3, 3))
            return turned + pose.t_ct_m, [(pose.start, -skew(turned)), (pose.start + 3, identity)]
        camera, target = view.camera_pose, view.target.pose
        if camera is None or target is None:
            raise RuntimeError("a view without a free pose has both poses")  # set up so in _add_unknowns
        blocks: list[tuple[int, FloatArray]] = []
        if self.nodal_free:
            blocks.append((self.nodal_column, np.broadcast_to(_PER_MM, (len(q), 3, 1))))
        turn = state.cameras.get(index)
        R_wc = turn.value if turn else camera_rotation(camera.pan_deg, camera.tilt_deg, camera.roll_deg)
        pivot = state.pivots.get((*camera.pivot_m, camera.sigma_m))
        place = state.target_places.get(view.target_name)
        target_turn = state.target_turns.get(view.target_name)
        R_wt = target_turn.value if target_turn else target_rotation(target.yaw_deg, target.pitch_deg, target.roll_deg)
        centre = place.value_m if place else np.asarray(target.centre_m)
        stand = pivot.value_m if pivot else np.asarray(camera.pivot_m)
        world = centre + q @ R_wt.T
        turned = (world - stand) @ R_wc
        if turn:
            blocks.append((turn.start, skew(turned)))
        if pivot:
            blocks.append((pivot.start, np.broadcast_to(-R_wc.T, (len(q), 3, 3))))
        if place:
            blocks.append((place.start, np.broadcast_to(R_wc.T, (len(q), 3, 3))))
        if target_turn:
            blocks.append((target_turn.start, -np.asarray(R_wc.T @ R_wt @ skew(q))))
        return turned - np.array([0.0, 0.0, state.lens.nodal_offset_mm / 1000.0]), blocks

    def evaluate(self, state: State, *, jacobian: bool = True) -> Evaluation:
        """Residuals and, if asked, derivatives at ``state``."""
        lens = state.lens
        total = len(self.observed_px)
        J = np.zeros((total, 2, self.count if jacobian else 0))
        rays = np.empty((total, 2))
        first = 0
        pose_parts: list[tuple[slice, int, FloatArray]] = []
        depth: list[FloatArray] = []
        for index in range(len(self.views)):
            points, blocks = self.camera_points(state, index)
            rows = slice(first, first + len(points))
            first += len(points)
            z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
            rays[rows] = points[:, :2] / z[:, None]
            if jacobian:
                depth.append(z)
                pose_parts += [(rows, start, block) for start, block in blocks]
        residual = lens.project(rays) - self.observed_px
        if jacobian:
            self._fill(J, lens, rays, np.concatenate(depth), pose_parts)
        prior_residual, prior_jacobian = self._priors(state)
        return Evaluation(residual, J, prior_residual, prior_jacobian)

    def _fill(
        self,
        J: FloatArray,
        lens: Lens,
        rays: FloatArray,
        z: FloatArray,
        pose_parts: list[tuple[slice, int, FloatArray]],
    ) -> None:
        if self.lens_free:
            per_lens = lens.jacobian_parameters(rays)
            h = lens.half_width
            J[..., 0] = lens.f_px * per_lens[..., 0] + 2 * lens.k1 * per_lens[..., 1] + 4 * lens.k2 * per_lens[..., 2]
            J[..., 1] = per_lens[..., 1] / h**2
            J[..., 2] = per_lens[..., 2] / h**4
            J[..., 3:5] = per_lens[..., 3:5]
        if not pose_parts:
            return
        d_ray = np.zeros((len(rays), 2, 3))
        d_ray[:, 0, 0] = d_ray[:, 1, 1] = 1 / z
        d_ray[:, :, 2] = -rays / z[:, None]
        per_point = lens.jacobian_rays(rays) @ d_ray
        for rows, start, block in pose_parts:
            J[rows, :, start : start + block.shape[-1]] += per_point[rows] @ block

    def _priors(self, state: State) -> tuple[FloatArray, FloatArray]:
        residual: list[float] = []
        columns: list[tuple[int, float]] = []
        if self.lens_free:
            values = (state.lens.k1_hw, state.lens.k2_hw, *state.lens.center_shift_px)
            for column, (value, sigma) in enumerate(zip(values, self._prior_sigmas, strict=True), start=1):
                residual.append(value / sigma)
                columns.append((column, 1 / sigma))
        if self.nodal_free:
            residual.append((state.lens.nodal_offset_mm - self.nodal_prior_mm) / self._nodal_sigma_mm)
            columns.append((self.nodal_column, 1 / self._nodal_sigma_mm))
        for place in (*state.pivots.values(), *state.target_places.values()):
            residual += list((place.value_m - place.prior_m) / place.sigma_m)
            columns += [(place.start + i, 1 / place.sigma_m) for i in range(3)]
        turns = (*state.cameras.values(), *state.target_turns.values())
        jacobian = np.zeros((len(residual) + 3 * len(turns), self.count))
        for row, (column, value) in enumerate(columns):
            jacobian[row, column] = value
        for turn in turns:
            off = rotation_log(turn.prior.T @ turn.value)
            rows = slice(len(residual), len(residual) + 3)
            residual += list(off / turn.sigma_rad)
            # d log(R exp(w)) / dw, the inverse right Jacobian to second order (the angles are small).
            k = skew(off)
            jacobian[rows, turn.start : turn.start + 3] = (np.eye(3) + k / 2 + k @ k / 12) / turn.sigma_rad
        return np.asarray(residual), jacobian

    @property
    def weak_priors(self) -> int:
        """How many priors say nothing a picture would not overrule: those of the lens itself."""
        return (4 if self.lens_free else 0) + (1 if self.nodal_free else 0)

    def stepped(self, state: State, step: FloatArray) -> State:
        """``state`` moved by ``step`` (P,)."""
        new = state.copy()
        if self.lens_free:
            lens = state.lens
            f_px = lens.f_px * math.exp(float(np.clip(step[0], -0.7, 0.7)))
            shift = (lens.center_shift_px[0] + float(step[3]), lens.center_shift_px[1] + float(step[4]))
            nodal_mm = lens.nodal_offset_mm + (float(step[self.nodal_column]) if self.nodal_free else 0.0)
            base = Lens(lens.image_size, f_px, 0.0, 0.0, shift, lens.pixel_aspect, nodal_mm)
            new.lens = base.with_hw(f_px, lens.k1_hw + float(step[1]), lens.k2_hw + float(step[2]))
        for place in (*new.pivots.values(), *new.target_places.values()):
            place.value_m = place.value_m + step[place.start : place.start + 3]
        for turn in (*new.cameras.values(), *new.target_turns.values()):
            turn.value = turn.value @ rotation_exp(step[turn.start : turn.start + 3])
        for pose in new.free.values():
            pose.R_ct = rotation_exp(step[pose.start : pose.start + 3]) @ pose.R_ct
            pose.t_ct_m = pose.t_ct_m + step[pose.start + 3 : pose.start + 6]
        return new
