"""Where every point of every picture of a level lies in its camera's axes, and how that moves with the unknowns.

Posed pictures: X_c = E^T R(pan', tilt', roll')^T (place + R_wt q - pivot) - pupil, with the encoders' mistakes
pan' = (1 + pan_scale) pan + pan_offset, and so on, E the picture's own small turn, and q the target's point. Free
pictures: X_c = R q + t. A board that is not flat lifts its points out of their plane by a few smooth shapes of x, y in
-1..1 over its corners (:data:`SHAPES`); the first two are mrcal's calobject_warp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.camera import target_rotation
from calibration.solve.mistakes import HAND_HELD_BOW, Priors
from calibration.solve.rotation import cross
from calibration.types import CameraPose, FloatArray, IntArray, Target, TargetKind

if TYPE_CHECKING:
    from calibration.solve.problem import FreePoses, State, View

SHAPES: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
    "bow along columns": lambda x, y: 1 - x * x,
    "bow along rows": lambda x, y: 1 - y * y,
    "twist": lambda x, y: x * y,
    "shape x^3": lambda x, y: x**3 - x,
    "shape y^3": lambda x, y: y**3 - y,
    "shape x^2 y": lambda x, y: x * x * y - y,
    "shape x y^2": lambda x, y: x * y * y - x,
    "shape x^4": lambda x, y: x**4 - x * x,
    "shape y^4": lambda x, y: y**4 - y * y,
    "shape x^2 y^2": lambda x, y: x * x * y * y,
}
"""How a board may stand out of its plane, by name; the offsets and slopes that a pose would take up are left out."""
_BOWS = 2
_HIGHER_SHARE = 0.3
# Prior of the higher shapes, as a share of the bow's.
_HIGHER_FROM_PICTURES = 5
_PAN, _TILT, _ROLL = 0, 1, 2
_BOW_POINTS = 12
# A target with fewer points (a square has four) does not show its own bow.


def target_points(views: Sequence[View]) -> FloatArray:
    """Where the points of all pictures lie in their targets' planes, (N, 2) metres."""
    planes = {id(view.target): view.target for view in views}  # pictures of a level share their targets
    points = {key: target.points_m() for key, target in planes.items()}
    return np.concatenate([points[id(view.target)][view.detection.point_ids] for view in views])


def shape_m(target: Target, name: str, size_mm: float) -> FloatArray:
    """How far (m) a shape of ``size_mm`` lifts each of a target's points, (N,)."""
    points = target.points_m()
    x, y = (points / np.maximum(np.abs(points).max(axis=0), 1e-12)).T
    return np.asarray(0.001 * size_mm * SHAPES[name](x, y))


@dataclass(frozen=True, slots=True, eq=False)
class Extras:
    """The mistakes that are unknowns: ``names``, the ``subjects`` (targets) they belong to, ``units``, ``sigmas``."""

    names: tuple[str, ...]
    subjects: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PosedPoints:
    """Points in camera axes (N, 3) and what their derivatives need, each (N, ...) or (V, ...)."""

    points_m: FloatArray
    turned: FloatArray  # (N, 3) before the pupil's offset (posed), before the translation (free)
    from_pivot_m: FloatArray  # (N, 3) world, posed only
    R_cw: FloatArray  # (V, 3, 3) world to camera, identity for free views
    R_ct: FloatArray  # (V, 3, 3) target to camera
    axes: FloatArray  # (V, 3, 3): world axes about which pan (to the left), tilt and roll turn


class Geometry:
    """The constant part: points, nominal poses, priors, which unknown belongs to which picture."""

    def __init__(
        self,
        views: Sequence[View],
        priors: Priors,
        *,
        shared_free: bool,
        lifted: Mapping[str, FloatArray] | None = None,
    ) -> None:
        """``lifted``: by target, how far (m) each of its points stands out of its plane, where that is known."""
        self._views = views
        counts = [len(v.detection.points_px) for v in views]
        self.view_of: IntArray = np.repeat(np.arange(len(views), dtype=np.int64), counts)
        plane = target_points(views)
        known = lifted or {}
        lift = [known[v.target_name][v.detection.point_ids] if v.target_name in known else np.zeros(n)
                for v, n in zip(views, counts, strict=True)]  # fmt: skip
        self._q = np.column_stack([plane, np.concatenate(lift)])
        free = np.array([v.free for v in views])
        self.posed = ~free[self.view_of]
        self._free_view = free
        self._no_turn = np.tile(np.eye(3), (len(views), 1, 1))
        poses = [v.camera_pose or CameraPose() for v in views]
        self._angles_deg = np.array([[p.pan_deg, p.tilt_deg, p.roll_deg] for p in poses])
        sigmas = np.array([[p.sigma_deg, p.sigma_deg, p.roll_sigma] for p in poses])
        turned = ~free & (sigmas.max(axis=1) > 0)
        self.own_count: IntArray = np.where(free, 6, np.where(turned, 3, 0)).astype(np.int64)
        self.inverse_turn_sigmas = self._turn_sigmas(sigmas, turned)
        self._group_pivots(poses, free, shared_free)
        self._group_targets(free, shared_free)
        self._any_posed, self._all_posed = bool((~free).any()), bool((~free).all())
        self.extras = self._extras(priors, free) if shared_free else Extras((), (), (), np.zeros(0))
        self._lift_of, self._lift_m_per_mm = self._board_shapes()

    def _turn_sigmas(self, sigmas_deg: FloatArray, turned: FloatArray) -> FloatArray:
        """(V, 3, 3): rotation vector in camera axes over its sigmas. Tilt turns about the camera's x, pan about its y
        (nearly: the head's pan axis leans by the tilt), roll about its z."""
        inverse = np.zeros((len(turned), 3, 3))
        for index in np.flatnonzero(turned):
            pan, tilt, roll = np.radians(np.maximum(sigmas_deg[index], 1e-7))
            inverse[index] = np.diag([1 / tilt, 1 / pan, 1 / roll])
        return inverse

    def _group_pivots(self, poses: Sequence[CameraPose], free: FloatArray, shared_free: bool) -> None:
        groups: dict[tuple[float, ...], int] = {}
        self._pivot_of = np.full(len(poses), -1)
        self._stand = np.array([p.pivot_m for p in poses], dtype=np.float64)
        for index, pose in enumerate(poses):
            if not free[index] and pose.sigma_m > 0 and shared_free:
                key = (*pose.pivot_m, pose.sigma_m)
                self._pivot_of[index] = groups.setdefault(key, len(groups))
        self.pivots_m = np.array([key[:3] for key in groups]).reshape(-1, 3)
        self.pivot_sigmas_m = np.array([key[3] for key in groups])

    def _group_targets(self, free: FloatArray, shared_free: bool) -> None:
        places: dict[str, int] = {}
        turns: dict[str, int] = {}
        place_list: list[tuple[tuple[float, float, float], float]] = []
        turn_list: list[tuple[FloatArray, float]] = []
        self._place_of, self._turn_of = np.full(len(free), -1), np.full(len(free), -1)
        self._centre = np.zeros((len(free), 3))
        self._R_wt = np.tile(np.eye(3), (len(free), 1, 1))
        for index, view in enumerate(self._views):
            pose = view.target.pose
            if free[index] or pose is None:
                continue
            self._centre[index] = pose.centre_m
            self._R_wt[index] = target_rotation(pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
            name = view.target_name
            if pose.sigma_m > 0 and shared_free:
                if name not in places:
                    places[name] = len(places)
                    place_list.append((pose.centre_m, pose.sigma_m))
                self._place_of[index] = places[name]
            if pose.sigma_deg > 0 and shared_free:
                if name not in turns:
                    turns[name] = len(turns)
                    turn_list.append((self._R_wt[index], math.radians(pose.sigma_deg)))
                self._turn_of[index] = turns[name]
        self.place_names, self.turn_names = tuple(places), tuple(turns)
        self.places_m = np.array([centre for centre, _ in place_list]).reshape(-1, 3)
        self.place_sigmas_m = np.array([sigma for _, sigma in place_list])
        self.turns = np.array([R for R, _ in turn_list]).reshape(-1, 3, 3)
        self.turn_sigmas_rad = np.array([sigma for _, sigma in turn_list])

    def _extras(self, priors: Priors, free: FloatArray) -> Extras:
        found: list[tuple[str, str, str, float]] = []
        targets = {v.target_name: (v.target, bool(f)) for v, f in zip(self._views, free, strict=True)}
        for name, (target, hand_held) in targets.items():
            pictures = sum(v.target_name == name for v in self._views)
            if target.kind is not TargetKind.CHESSBOARD or len(target.points_m()) < _BOW_POINTS or pictures < 3:
                continue
            sigma = priors.bow_m
            if sigma is None:
                sigma = HAND_HELD_BOW * max(target.outline_m()) if hand_held else 0.0
            if sigma > 0:
                found += [(shape, name, "mm", 1000 * sigma) for shape in [*SHAPES][:_BOWS]]
                if hand_held and pictures >= _HIGHER_FROM_PICTURES:
                    higher = _HIGHER_SHARE * 1000 * sigma
                    found += [(shape, name, "mm", higher) for shape in [*SHAPES][_BOWS:]]
        if not free.all():
            for axis, scale, offset in (("pan", priors.pan_scale, priors.pan_offset_deg),
                                        ("tilt", priors.tilt_scale, priors.tilt_offset_deg)):  # fmt: skip
                found += [(f"{axis} scale", "", "", scale)] * (scale > 0)
                found += [(f"{axis} offset", "", "deg", offset)] * (offset > 0)
            found += [("roll offset", "", "deg", priors.roll_offset_deg)] * (priors.roll_offset_deg > 0)
            if priors.off_axis_mm > 0:
                found += [(f"pupil off axis, {way}", "", "mm", priors.off_axis_mm) for way in ("right", "down")]
        names, subjects, units, sigmas = zip(*found, strict=True) if found else ((), (), (), ())
        return Extras(tuple(names), tuple(subjects), tuple(units), np.array(sigmas, dtype=np.float64))

    def _board_shapes(self) -> tuple[list[int], FloatArray]:
        """The mistakes that are shapes of boards, and how far (m for each mm) each lifts every point, (shapes, N)."""
        which = [index for index, name in enumerate(self.extras.names) if name in SHAPES]
        lift = np.zeros((len(which), len(self._q)))
        rows: dict[str, tuple[Target, IntArray, IntArray]] = {}
        for name in {self.extras.subjects[index] for index in which}:
            seen = [number for number, view in enumerate(self._views) if view.target_name == name]
            ids = np.concatenate([self._views[number].detection.point_ids for number in seen])
            rows[name] = self._views[seen[0]].target, np.flatnonzero(np.isin(self.view_of, seen)), ids
        for row, index in zip(lift, which, strict=True):
            target, places, ids = rows[self.extras.subjects[index]]
            row[places] = shape_m(target, self.extras.names[index], 1.0)[ids]
        return which, lift

    def lifted(self, state: State) -> dict[str, FloatArray]:
        """By target, how far (m) each of its points stands out of its plane, as the state has it."""
        found: dict[str, FloatArray] = {}
        targets = {view.target_name: view.target for view in self._views}
        for index in self._lift_of:
            name, subject = self.extras.names[index], self.extras.subjects[index]
            shape = shape_m(targets[subject], name, float(state.extras[index]))
            found[subject] = found.get(subject, np.zeros(len(shape))) + shape
        return found

    def first_own(self, free_poses: FreePoses) -> tuple[FloatArray, FloatArray]:
        """Where each picture's own pose starts."""
        R, t = np.tile(np.eye(3), (len(self._views), 1, 1)), np.zeros((len(self._views), 3))
        for index in np.flatnonzero(self._free_view):
            R[index], t[index] = free_poses[int(index)]
        return R, t

    def camera_points(self, state: State) -> FloatArray:
        """Every point in its camera's axes (N, 3), metres."""
        return self.posed_points(state).points_m

    def posed_points(self, state: State) -> PosedPoints:
        """See the module."""
        of = self.view_of
        q = self._q.T  # (3, N): each coordinate's numbers stand side by side, which numpy's loops want
        if self._lift_of:
            q = np.stack([q[0], q[1], q[2] + state.extras[self._lift_of] @ self._lift_m_per_mm])
        R_wt = self._R_wt
        if len(state.turns):
            R_wt = np.where((self._turn_of >= 0)[:, None, None], state.turns[self._turn_of], R_wt)
        centre, stand = self._centre, self._stand
        if len(state.places):
            centre = np.where((self._place_of >= 0)[:, None], state.places[self._place_of], centre)
        if len(state.pivots):
            stand = np.where((self._pivot_of >= 0)[:, None], state.pivots[self._pivot_of], stand)
        if not self._any_posed:
            turned = _turned(state.R, of, q)
            return PosedPoints((turned + state.t.T[:, of]).T, turned.T, turned.T, self._no_turn, state.R, self._no_turn)
        R_nominal, axes = self._nominal(state)
        R_cw, R_ct, t = np.swapaxes(R_nominal @ state.R, 1, 2), state.R, state.t
        pupil = np.array([0.0, 0.0, state.lens.nodal_offset_mm / 1000.0])
        for way, column in (("right", 0), ("down", 1)):
            index = self._index(f"pupil off axis, {way}")
            if index >= 0:
                pupil[column] = state.extras[index] / 1000.0
        # R_ct q + R_cw (centre - stand) is the same for posed pictures, and needs no second turn of all points.
        off = np.einsum("vij,vj->vi", R_cw, centre - stand)
        if self._all_posed:
            R_ct, t = R_cw @ R_wt, np.broadcast_to(-pupil, state.t.shape)
        else:
            free = self._free_view
            R_cw = np.where(free[:, None, None], np.eye(3), R_cw)
            R_ct = np.where(free[:, None, None], state.R, R_cw @ R_wt)
            off[free] = 0.0
            t = np.where(free[:, None], state.t, -pupil)
        turned = _turned(R_ct, of, q) + off.T[:, of]
        from_pivot = _turned(np.swapaxes(R_cw, 1, 2), of, turned) if self.extras.names else turned
        return PosedPoints((turned + t.T[:, of]).T, turned.T, from_pivot.T, R_cw, R_ct, axes)

    def _index(self, name: str) -> int:
        return self.extras.names.index(name) if name in self.extras.names else -1

    def _extra(self, state: State, name: str) -> float:
        index = self._index(name)
        return float(state.extras[index]) if index >= 0 else 0.0

    def _nominal(self, state: State) -> tuple[FloatArray, FloatArray]:
        """R_wc (V, 3, 3) of the angles as corrected, and the axes of their turns as rows (V, 3, 3)."""
        pan = self._angles_deg[:, 0] * (1 + self._extra(state, "pan scale")) + self._extra(state, "pan offset")
        tilt = self._angles_deg[:, 1] * (1 + self._extra(state, "tilt scale")) + self._extra(state, "tilt offset")
        roll = self._angles_deg[:, 2] + self._extra(state, "roll offset")
        c, s = np.cos(np.radians(pan)), np.sin(np.radians(pan))
        ct, st = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
        cr, sr = np.cos(np.radians(roll)), np.sin(np.radians(roll))
        axes = np.zeros((len(pan), 3, 3))
        axes[:, _PAN, 2] = -1.0
        axes[:, _TILT, 0], axes[:, _TILT, 1] = c, -s
        axes[:, _ROLL, 0], axes[:, _ROLL, 1], axes[:, _ROLL, 2] = s * ct, c * ct, st
        # Forward is the axis of roll; right and down are the tilt's axis and its normal, turned about it.
        right, forward = axes[:, _TILT], axes[:, _ROLL]
        up = cross(right, forward)
        R = np.stack([cr[:, None] * right - sr[:, None] * up, -sr[:, None] * right - cr[:, None] * up, forward], axis=2)
        return R, axes

    def fill_shared(
        self,
        shared: FloatArray,
        per_point: FloatArray,
        state: State,
        posed: PosedPoints,
        first: tuple[int, int, int, int],
    ) -> None:
        """Write the derivatives by pivots, places, target turns and mistakes; ``per_point`` (N, 2, 3) px per metre."""
        pivot, place, turn, extra = first
        of = self.view_of
        to_world = per_point @ posed.R_cw[of] if len(state.pivots) or len(state.places) else None
        for groups, start, sign in ((self._pivot_of, pivot, -1.0), (self._place_of, place, 1.0)):
            for number in range(int(groups.max(initial=-1)) + 1):
                rows = groups[of] == number
                if to_world is not None:
                    shared[rows, :, start + 3 * number : start + 3 * number + 3] = sign * to_world[rows]
        if len(state.turns):
            in_target = per_point @ posed.R_ct[of]
            for number in range(len(state.turns)):
                rows = self._turn_of[of] == number
                column = turn + 3 * number
                q = self._q[rows]
                shared[rows, :, column : column + 3] = cross(q[:, None, :], in_target[rows])
        if self._lift_of:
            out_of_plane = _along(per_point, posed.R_ct[:, :, 2].T[:, of])
            for row, index in zip(self._lift_m_per_mm, self._lift_of, strict=True):
                np.multiply(out_of_plane, row[:, None], out=shared[:, :, extra + index])
        for index, name in enumerate(self.extras.names):
            if name not in SHAPES:
                shared[:, :, extra + index] = _along(per_point, self._moved_by(name, posed).T)

    def _moved_by(self, name: str, posed: PosedPoints) -> FloatArray:
        """d(points in camera axes, m) / d(one mistake of head or camera), (N, 3)."""
        of = self.view_of
        if name.startswith("pupil"):
            moved = np.zeros_like(posed.points_m)
            moved[self.posed, 0 if name.endswith("right") else 1] = -0.001
            return moved
        which = {"pan": _PAN, "tilt": _TILT, "roll": _ROLL}[name.split(" ")[0]]
        # A turn of the camera by d about an axis moves the points by -d (axis x point).
        by_angle = -cross(posed.axes[of, which], posed.from_pivot_m)
        per_unit = math.radians(1.0) * (self._angles_deg[of, which] if name.endswith("scale") else 1.0)
        moved = np.einsum("nij,nj->ni", posed.R_cw[of], by_angle * np.reshape(per_unit, (-1, 1)))
        return np.where(self.posed[:, None], moved, 0.0)

    def own_jacobian(self, per_point: FloatArray, posed: PosedPoints) -> FloatArray:
        """Derivatives (N, 2, 6) by each picture's own unknowns, zero where it has none."""
        own = np.zeros((6, 2, len(per_point))).transpose(2, 1, 0)
        if not self.own_count.any():
            return own
        count = self.own_count[self.view_of][:, None]
        # A free pose turns its points, a camera's turn moves them the other way; a pose known exactly does neither.
        sign = np.where(count == 6, 1.0, np.where(count == 3, -1.0, 0.0))
        x, y, z = (sign * posed.turned[:, i : i + 1] for i in range(3))
        px, py, pz = (per_point[..., i] for i in range(3))
        own[..., 0], own[..., 1], own[..., 2] = y * pz - z * py, z * px - x * pz, x * py - y * px
        own[..., 3:] = per_point if not self._any_posed else per_point * (count == 6)[..., None]
        return own


def _turned(R: FloatArray, of: IntArray, points: FloatArray) -> FloatArray:
    """R[of] p for points (3, N)."""
    rows = R.reshape(len(R), 9).T[:, of]
    x, y, z = points
    return np.stack([rows[i] * x + rows[i + 1] * y + rows[i + 2] * z for i in (0, 3, 6)])


def _along(per_point: FloatArray, moved: FloatArray) -> FloatArray:
    """Derivatives (N, 2) px of points that move by ``moved`` (3, N)."""
    x, y, z = (moved[i][:, None] for i in range(3))
    return np.asarray(per_point[..., 0] * x + per_point[..., 1] * y + per_point[..., 2] * z)
