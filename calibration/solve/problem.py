"""The least-squares problem of a level: which unknowns there are, residuals, Jacobian, priors.

Every picture of the level is one :class:`View`. One formulation serves posed targets, roughly posed ones and
hand-held boards: a pose known exactly is a constant, one known roughly is an unknown with a prior, an unknown one
an unknown without. Unknowns are of two kinds: SHARED by the pictures (the lens, the nodal offset, where pivot and
targets stand, the mistakes of :mod:`calibration.solve.mistakes`) and each picture's OWN (how the camera was turned, or
where a hand-held board was), so that the normal equations stay small (Schur complement, :mod:`.iteration`). Lens
unknowns of the iteration are (log f_px, k1_hw, k2_hw, sx, sy): of like size for every focal length.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.lens import Lens
from calibration.solve.geometry import Extras, Geometry
from calibration.solve.mistakes import Priors
from calibration.solve.rotation import rotation_exp, rotation_log, skew
from calibration.types import CameraPose, Detection, FloatArray, Target

LENS_COUNT = 5
OWN = 6
PRIOR_K1_HW = 0.5
PRIOR_K2_HW = 0.3
PRIOR_SHIFT_OF_WIDTH = 0.1
PRIOR_NODAL_MM = 500.0
_HELD = 1e-9
# Wider than any lens that makes pictures (a 50 % bend at the edge, a pupil half a metre off the pivot); they only keep
# a quantity finite that the pictures do not show, and such a quantity is then reported as not told.
FreePoses = dict[int, tuple[FloatArray, FloatArray]]
"""Camera from target (R, t in metres) by the number of the view."""


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


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """All values of one iteration. ``R``, ``t`` (V, 3, 3), (V, 3): camera from target of free pictures; the turn of
    the camera beyond its nominal angles of the others (t unused). ``pivots``, ``places`` (·, 3) metres; ``turns``
    (·, 3, 3) target to world; ``extras`` the mistakes."""

    lens: Lens
    R: FloatArray
    t: FloatArray
    pivots: FloatArray
    places: FloatArray
    turns: FloatArray
    extras: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A change of all unknowns: ``shared`` (S,), ``own`` (V, 6)."""

    shared: FloatArray
    own: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Residuals (N, 2) px (model minus picture), their Jacobians ``shared`` (N, 2, S) and ``own`` (N, 2, 6), and the
    priors' residuals over their sigmas with Jacobians; rows with NaN cannot be projected."""

    residual_px: FloatArray
    shared: FloatArray
    own: FloatArray
    prior_residual: FloatArray
    prior_shared: FloatArray
    own_prior_residual: FloatArray  # (V, 3)
    own_prior: FloatArray  # (V, 3, 3)


class Problem:
    """A level's views with their unknowns.

    ``lens_free`` False keeps the lens as it is (only poses move); ``held`` names lens quantities (``k1``, ``k2``,
    ``center_shift_px``) to be kept at 0, or ``nodal_offset_mm`` to be kept as it is. The nodal offset, with the prior
    ``nodal_sigma_mm``, is an unknown wherever posed pictures could tell it: taken as known, its error would hide in
    the field of view. ``lifted`` as :meth:`calibration.solve.geometry.Geometry.lifted`.
    """

    def __init__(
        self,
        views: Sequence[View],
        lens: Lens,
        free_poses: FreePoses,
        *,
        lens_free: bool = True,
        held: tuple[str, ...] = (),
        nodal_sigma_mm: float = PRIOR_NODAL_MM,
        priors: Priors | None = None,
        lifted: Mapping[str, FloatArray] | None = None,
    ) -> None:
        self.views = tuple(views)
        self.lens_free = lens_free
        self.nodal_prior_mm = lens.nodal_offset_mm
        self._nodal_sigma_mm = nodal_sigma_mm
        self.geometry = Geometry(self.views, priors or Priors(), shared_free=lens_free, lifted=lifted)
        shift_px = _HELD if "center_shift_px" in held else PRIOR_SHIFT_OF_WIDTH * lens.image_size[0]
        self._lens_sigmas = (
            _HELD if "k1" in held else PRIOR_K1_HW,
            _HELD if "k2" in held else PRIOR_K2_HW,
            shift_px,
            shift_px,
        )
        posed = sum(not view.free for view in self.views)
        self.nodal_free = lens_free and posed >= 2 and "nodal_offset_mm" not in held
        geometry = self.geometry
        self.lens_count = LENS_COUNT if lens_free else 0
        self.nodal_column = self.lens_count if self.nodal_free else -1
        self.first_pivot = self.lens_count + int(self.nodal_free)
        self.first_place = self.first_pivot + 3 * len(geometry.pivots_m)
        self.first_turn = self.first_place + 3 * len(geometry.places_m)
        self.first_extra = self.first_turn + 3 * len(geometry.turns)
        self.shared_count = self.first_extra + len(geometry.extras.names)
        self.own_count = geometry.own_count
        self.count = self.shared_count + int(self.own_count.sum())
        self.view_of = geometry.view_of
        self.observed_px = np.concatenate([v.detection.points_px for v in self.views])
        R, t = geometry.first_own(free_poses)
        self.state = State(
            lens, R, t, geometry.pivots_m, geometry.places_m, geometry.turns, np.zeros(len(geometry.extras.names))
        )

    @property
    def extras(self) -> Extras:
        """The mistakes that are unknowns here."""
        return self.geometry.extras

    def residuals(self, state: State) -> FloatArray:
        """Model minus picture (N, 2) px; NaN where a point cannot be drawn."""
        points = self.geometry.camera_points(state)
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        return np.asarray(state.lens.project(points[:, :2] / z[:, None]) - self.observed_px)

    def evaluate(self, state: State) -> Evaluation:
        """Residuals and derivatives at ``state``."""
        lens = state.lens
        posed = self.geometry.posed_points(state)
        points = posed.points_m
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        rays = points[:, :2] / z[:, None]
        # Column by column in memory: each derivative of all points is written, whitened and summed in one go.
        shared = np.zeros((self.shared_count, 2, len(points))).transpose(2, 1, 0)
        if self.lens_free:
            per_lens = lens.jacobian_parameters(rays)
            h = lens.half_width
            shared[..., 0] = (
                lens.f_px * per_lens[..., 0] + 2 * lens.k1 * per_lens[..., 1] + 4 * lens.k2 * per_lens[..., 2]
            )
            shared[..., 1] = per_lens[..., 1] / h**2
            shared[..., 2] = per_lens[..., 2] / h**4
            shared[..., 3:5] = per_lens[..., 3:5]
        by_ray = lens.jacobian_rays(rays)
        per_point = np.empty((3, 2, len(points))).transpose(2, 1, 0)  # px per metre
        per_point[..., :2] = by_ray / z[:, None, None]
        per_point[..., 2] = -(per_point[..., 0] * rays[:, :1] + per_point[..., 1] * rays[:, 1:])
        if self.nodal_free:
            shared[..., self.nodal_column] = np.where(self.geometry.posed[:, None], -0.001 * per_point[..., 2], 0.0)
        self.geometry.fill_shared(
            shared, per_point, state, posed, (self.first_pivot, self.first_place, self.first_turn, self.first_extra)
        )
        own = self.geometry.own_jacobian(per_point, posed)
        residual, jacobian = self._shared_priors(state)
        own_residual, own_prior = self._own_priors(state)
        return Evaluation(
            lens.project(rays) - self.observed_px, shared, own, residual, jacobian, own_residual, own_prior
        )

    def _shared_priors(self, state: State) -> tuple[FloatArray, FloatArray]:
        geometry, lens = self.geometry, state.lens
        residual: list[FloatArray] = []
        columns: list[tuple[int, FloatArray]] = []
        if self.lens_free:
            sigmas = np.asarray(self._lens_sigmas)
            residual.append(np.array([lens.k1_hw, lens.k2_hw, *lens.center_shift_px]) / sigmas)
            columns.append((1, 1 / sigmas))
        if self.nodal_free:
            residual.append(np.array([(lens.nodal_offset_mm - self.nodal_prior_mm) / self._nodal_sigma_mm]))
            columns.append((self.nodal_column, np.array([1 / self._nodal_sigma_mm])))
        for first, values, priors, sigmas in (
            (self.first_pivot, state.pivots, geometry.pivots_m, geometry.pivot_sigmas_m),
            (self.first_place, state.places, geometry.places_m, geometry.place_sigmas_m),
        ):
            residual.append(((values - priors) / sigmas[:, None]).ravel())
            columns.append((first, np.repeat(1 / sigmas, 3)))
        extras = geometry.extras
        residual.append(state.extras / extras.sigmas)
        columns.append((self.first_extra, 1 / extras.sigmas))
        straight = np.concatenate(residual)
        jacobian = np.zeros((len(straight) + 3 * len(state.turns), self.shared_count))
        row = 0
        for first, factors in columns:
            jacobian[np.arange(row, row + len(factors)), np.arange(first, first + len(factors))] = factors
            row += len(factors)
        turned = []
        for index, (turn, prior, sigma) in enumerate(
            zip(state.turns, geometry.turns, geometry.turn_sigmas_rad, strict=True)
        ):
            off = rotation_log(prior.T @ turn)
            column = self.first_turn + 3 * index
            jacobian[row : row + 3, column : column + 3] = _log_slope(off) / sigma
            turned.append(off / sigma)
            row += 3
        return np.concatenate([straight, *turned]), jacobian

    def _own_priors(self, state: State) -> tuple[FloatArray, FloatArray]:
        residual, jacobian = np.zeros((len(self.views), 3)), np.zeros((len(self.views), 3, 3))
        turned = self.own_count == 3
        if turned.any():
            off = rotation_log(state.R[turned])
            inverse = self.geometry.inverse_turn_sigmas[turned]
            residual[turned] = (inverse @ off[..., None])[..., 0]
            jacobian[turned] = inverse @ _log_slope(off)
        return residual, jacobian

    @property
    def prior_count(self) -> int:
        """How many priors there are but those that say nothing a picture would not overrule: the lens's own."""
        weak = (4 if self.lens_free else 0) + (1 if self.nodal_free else 0)
        shared = self.shared_count - self.lens_count - int(self.nodal_free) + weak
        return shared - weak + int(np.sum(self.own_count == 3)) * 3

    def stepped(self, state: State, step: Step) -> State:
        """``state`` moved by ``step``."""
        lens, shared, own = state.lens, step.shared, step.own
        if self.lens_free:
            f_px = lens.f_px * math.exp(float(np.clip(shared[0], -0.7, 0.7)))
            shift = (lens.center_shift_px[0] + float(shared[3]), lens.center_shift_px[1] + float(shared[4]))
            nodal_mm = lens.nodal_offset_mm + (float(shared[self.nodal_column]) if self.nodal_free else 0.0)
            base = Lens(lens.image_size, f_px, 0.0, 0.0, shift, lens.pixel_aspect, nodal_mm)
            lens = base.with_hw(f_px, state.lens.k1_hw + float(shared[1]), state.lens.k2_hw + float(shared[2]))
        R, t = state.R.copy(), state.t.copy()
        moved = rotation_exp(own[:, :3])
        free, turned = self.own_count == 6, self.own_count == 3
        # Free poses turn in the camera's frame, the camera itself in its own: the increments stay local.
        R[free] = moved[free] @ R[free]
        R[turned] = R[turned] @ moved[turned]
        t[free] += own[free, 3:]
        turns = state.turns
        if len(turns):
            turns = turns @ rotation_exp(shared[self.first_turn : self.first_extra].reshape(-1, 3))
        return State(
            lens,
            R,
            t,
            state.pivots + shared[self.first_pivot : self.first_place].reshape(-1, 3),
            state.places + shared[self.first_place : self.first_turn].reshape(-1, 3),
            turns,
            state.extras + shared[self.first_extra :],
        )


def _log_slope(off: FloatArray) -> FloatArray:
    """d log(R exp(w)) / dw at log R = ``off``: the inverse right Jacobian to second order (the angles are small)."""
    k = skew(off)
    return np.asarray(np.eye(3) + k / 2 + k @ k / 12)
