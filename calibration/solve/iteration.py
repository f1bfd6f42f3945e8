"""The iteration of a level's fit: damped Gauss-Newton, robust start, noise floor, outliers, and what it leaves.

Levenberg-Marquardt damping on whitened residuals; the unknowns of single pictures are eliminated from the normal
equations, so that many pictures cost little more than few. The variance of a point is its detection's covariance plus
one common floor (``floor_px``) for what the model does not describe (an edge that is not straight, a sharpened
photograph): the floor is chosen so that chi2 equals the degrees of freedom (variance component estimation), so that
uncertainties stay true where the detector's own are too small to be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.errors import NotConverged, NotEnoughData
from calibration.lens import Lens
from calibration.solve.mistakes import Mistake, Priors
from calibration.solve.normal import NormalEquations
from calibration.solve.problem import (
    LENS_COUNT,
    OWN,
    PRIOR_NODAL_MM,
    Evaluation,
    FreePoses,
    Problem,
    State,
    Step,
    View,
)
from calibration.solve.rotation import rotation_log
from calibration.tables import Parallax
from calibration.types import FloatArray

_ITERATIONS = 200
# Boards that all face the camera leave a valley along which the fit creeps; all else needs ten to twenty.
_CONVERGED_PX = 1e-7
# A step that moves no point by more than this is the end: five orders below the best detector.
_ROUGH_PX = 1e-3
# The same between the rounds in which floor and outliers are still sought.
_IDLE = 0.1
# A step that is told to move no point by this share of what ends an iteration is not worth another evaluation.
_FIRST_DAMPING, _LATER_DAMPING = 1e-4, 1e-8
# Later rounds start beside their minimum: what holds a far start back would only take them several steps to get there.
_OUTLIER_CHI2 = 25.0
# Squared distance over its variance, 2 degrees of freedom: 5 sigma, one point in 270,000.
_VIEW_OUTLIERS = 0.3
# A picture with more outliers than this was read wrongly as a whole (a shifted grid, a stale picture).
_FLOOR_ROUNDS = 6
_FLOOR_STEPS = 60
_PLACE = ("place across", "place in depth", "height")
_TURN = ("turn about its columns", "turn about its rows", "turn in its plane")


@dataclass(frozen=True, slots=True, eq=False)
class ViewResidual:
    """One picture's residuals: model minus picture (N, 2) px, which points counted, RMS per coordinate and maximum."""

    name: str
    target_name: str
    points_px: FloatArray
    residual_px: FloatArray
    used: NDArray[np.bool_]
    rms_px: float
    max_px: float
    chi2_per_dof: float


@dataclass(frozen=True, slots=True, eq=False)
class LevelFit:
    """A level's lens with its evidence.

    ``covariance`` (5, 5) is of (f_px, k1, k2, sx, sy) as :data:`calibration.lens.LENS_PARAMETERS`. ``rms_px`` is per
    coordinate, ``max_px`` a distance, both over the points that counted. ``floor_px`` see the module.
    ``outliers``: (picture, point number, distance px); ``dropped``: pictures left out with their reasons. ``poses``:
    camera from target (R, t in metres) of each free picture, by name. ``untold`` names the quantities (``k1``, ``k2``,
    ``center_shift_px``) that the pictures do not show: they are held at 0 in ``lens``, while ``covariance`` is still
    that of the fit with all of them free. ``nodal_seen_mm``: the nodal offset that posed pictures tell and its sigma,
    None without such pictures; ``nodal_told``: it contradicts the one given, so that it stands in ``lens`` (else the
    given one does); ``sigma_nodal_mm`` is its sigma in the fit, None where held. ``parallax``: the operator's check,
    where it was told. ``mistakes``: what the pictures say of survey, board, head and camera where they were unknowns
    with ``priors``. ``solved``: the iteration at its minimum, from which the level's evidence is taken.
    """

    lens: Lens
    covariance: FloatArray
    floor_px: float
    rms_px: float
    max_px: float
    points: int
    views: tuple[ViewResidual, ...]
    outliers: tuple[tuple[str, int, float], ...]
    dropped: tuple[tuple[str, str], ...]
    poses: dict[str, tuple[FloatArray, FloatArray]]
    iterations: int
    untold: tuple[str, ...] = ()
    sigma_nodal_mm: float | None = None
    mistakes: tuple[Mistake, ...] = ()
    priors: Priors = field(default_factory=Priors)
    nodal_told: bool = False
    nodal_seen_mm: tuple[float, float] | None = None
    parallax: Parallax | None = None
    solved: Fit | None = None

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of (f_px, k1, k2, sx, sy), shape (5,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def sigma_fov_x_deg(self) -> float:
        """d fov_x / d f = -2 (W/2) / (f^2 + (W/2)^2), radians per px."""
        half = self.lens.image_size[0] / 2
        return math.degrees(2 * half / (self.lens.f_px**2 + half**2)) * float(self.sigma[0])


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """A fit's residuals and Jacobians, its whitening (see :meth:`Fit._whitening`) and its normal equations."""

    evaluation: Evaluation
    whiten: FloatArray
    normal: NormalEquations


class Fit:
    """One run of the iteration over one set of views."""

    def __init__(
        self,
        views: Sequence[View],
        lens: Lens,
        poses: FreePoses,
        *,
        lens_free: bool = True,
        held: tuple[str, ...] = (),
        nodal_sigma_mm: float = PRIOR_NODAL_MM,
        priors: Priors | None = None,
        lifted: Mapping[str, FloatArray] | None = None,
    ) -> None:
        self.priors = priors or Priors()
        self.problem = Problem(
            views,
            lens,
            poses,
            lens_free=lens_free,
            held=held,
            nodal_sigma_mm=nodal_sigma_mm,
            priors=self.priors,
            lifted=lifted,
        )
        self.state: State = self.problem.state
        self._at: tuple[State, Evaluation] | None = None
        self.detector_px2 = np.concatenate([v.detection.covariance_px2 for v in views])
        self.used = np.ones(len(self.detector_px2), dtype=bool)
        self.floor_px = 0.0
        self.iterations = 0
        ends = np.cumsum([len(v.detection.points_px) for v in views])
        self._rows = [
            slice(int(end) - len(v.detection.points_px), int(end)) for v, end in zip(views, ends, strict=True)
        ]

    @property
    def noise_px(self) -> float:
        """RMS per coordinate of what the detector promises of all points."""
        return math.sqrt(float(np.mean(np.trace(self.detector_px2, axis1=1, axis2=2))) / 2)

    def free_poses(self) -> FreePoses:
        """The poses that were free, as they now stand."""
        return {int(i): (self.state.R[i], self.state.t[i]) for i in np.flatnonzero(self.problem.own_count == OWN)}

    def run(self, after: Fit | None = None) -> None:
        """Robust start, then rounds of: floor from the residuals, outliers by it, fit.

        ``after``: a fit of the same pictures that differs by a few unknowns; its floor and outliers are the start.
        """
        if after is None:
            self.floor_px = 1.0
            self.iterate(robust=True, settled_px=_ROUGH_PX)
        else:
            self.floor_px, self.used = after.floor_px, after.used.copy()
            self.iterate(robust=False, settled_px=_ROUGH_PX)
        for _ in range(_FLOOR_ROUNDS):
            before = self.floor_px, self.used.copy()
            residual = self._evaluation().residual_px
            self.floor_px = self._robust_floor(residual)
            self._reject(residual)
            self.iterate(robust=False, settled_px=_ROUGH_PX)
            if abs(self.floor_px - before[0]) <= 0.01 * before[0] + 1e-6 and np.array_equal(self.used, before[1]):
                break
        self.floor_px = self._floor_for_chi2()
        self.iterate(robust=False)

    def iterate(self, *, robust: bool, settled_px: float = _CONVERGED_PX) -> None:
        """Gauss-Newton with Levenberg-Marquardt damping until no point moves; raises NotConverged."""
        damping = _FIRST_DAMPING if robust else _LATER_DAMPING
        whiten = self._whitening()
        evaluation = self._evaluation()
        cost = self._cost(evaluation, whiten, robust)
        if not math.isfinite(cost):
            raise NotEnoughData("the start puts points where no lens draws; give a guess for the field of view")
        moved = math.inf
        for _ in range(_ITERATIONS):
            self.iterations += 1
            normal = self._normal(evaluation, whiten, robust)
            for _ in range(12):
                step = normal.solved(damping)
                if step is None:
                    damping = max(damping, 1e-6) * 10
                    continue
                if damping < _FIRST_DAMPING and self._told(evaluation, step) < _IDLE * settled_px:
                    return
                trial = self.problem.stepped(self.state, step)
                trial_evaluation = self.problem.evaluate(trial)
                trial_cost = self._cost(trial_evaluation, whiten, robust)
                if math.isfinite(trial_cost) and trial_cost <= cost * (1 + 1e-12):
                    break
                damping = max(damping, 1e-6) * 10
            else:
                return  # no step makes it better: this is the minimum, to rounding
            difference = trial_evaluation.residual_px - evaluation.residual_px
            moved = float(np.nanmax(np.abs(difference[self.used])))
            gained = cost - trial_cost
            self.state, evaluation, cost = trial, trial_evaluation, trial_cost
            self._at = trial, trial_evaluation
            damping = max(damping / 10, 1e-12)
            if moved < settled_px or (robust and gained < 1e-3 * (1 + cost)):
                return
        if moved > 1e-3 and not robust:
            raise NotConverged("the level's fit", _ITERATIONS, moved)

    def _evaluation(self) -> Evaluation:
        """Residuals and derivatives where the fit stands."""
        if self._at is None or self._at[0] is not self.state:
            self._at = self.state, self.problem.evaluate(self.state)
        return self._at[1]

    def _told(self, evaluation: Evaluation, step: Step) -> float:
        """How far (px) a step moves a point at most, to first order."""
        moved = evaluation.shared @ step.shared
        if self.problem.own_count.any():
            by_point = step.own[self.problem.view_of]
            for column in range(OWN):
                moved += evaluation.own[..., column] * by_point[:, column, None]
        return float(np.max(np.abs(moved[self.used]), initial=0.0))

    def _whitening(self) -> FloatArray:
        """(N, 3): w11, w21, w22 of lower triangles W with W^T W = inverse covariance of each point; zero for points
        that do not count. From the Cholesky factor of the 2 x 2 covariance in closed form."""
        covariance = self.detector_px2
        uu, uv, vv = covariance[:, 0, 0] + self.floor_px**2, covariance[:, 0, 1], covariance[:, 1, 1] + self.floor_px**2
        l11 = np.sqrt(uu)
        l21 = uv / l11
        l22 = np.sqrt(vv - l21 * l21)
        whiten = np.column_stack([1 / l11, -l21 / (l11 * l22), 1 / l22])
        return np.where(self.used[:, None], whiten, 0.0)

    def _robust_weights(self, whitened: FloatArray) -> FloatArray:
        # Cauchy: far points pull ever less, so a start with a few wrong ones still converges.
        return np.asarray(1.0 / (1.0 + np.sum(whitened**2, axis=1) / 4.0))

    def _cost(self, evaluation: Evaluation, whiten: FloatArray, robust: bool) -> float:
        whitened = _whitened(whiten, evaluation.residual_px, self.used)
        squares = np.sum(whitened**2, axis=1)
        data = float(np.sum(4.0 * np.log1p(squares / 4.0))) if robust else float(np.sum(squares))
        priors = float(np.sum(evaluation.prior_residual**2)) + float(np.sum(evaluation.own_prior_residual**2))
        return data + priors

    def _normal(self, evaluation: Evaluation, whiten: FloatArray, robust: bool) -> NormalEquations:
        if robust:
            weights = self._robust_weights(_whitened(whiten, evaluation.residual_px, self.used))
            whiten = whiten * np.sqrt(weights)[:, None]
        return NormalEquations.of(self._rows, self.problem.own_count, evaluation, whiten, self.used)

    def _degrees_of_freedom(self) -> int:
        # Unknowns with a prior bring one observation each, so they take nothing from the points.
        return max(2 * int(self.used.sum()) - (self.problem.count - self.problem.prior_count), 1)

    def _robust_floor(self, residual: FloatArray) -> float:
        """The floor that explains the residuals but for gross errors.

        Scatter from the 90th percentile (Gaussian: 1.645 sigma) of the coordinates within ten times the scatter that
        the median tells: half the points may be grossly wrong, yet the long tails of a bent board still count.
        """
        finite = np.abs(residual[np.isfinite(residual).all(axis=1)])
        if len(finite) == 0:
            raise NotEnoughData("the lens found cannot draw any point; check the target's size and pose")
        gross = 10 * float(np.median(finite)) / 0.6745 + 1e-12
        scatter = float(np.quantile(finite[finite <= gross], 0.9)) / 1.645
        scatter *= math.sqrt(2 * len(finite) / max(2 * len(finite) - self.problem.count, len(finite) * 0.2))
        own = float(np.median(np.trace(self.detector_px2, axis1=1, axis2=2)) / 2)
        return math.sqrt(max(scatter**2 - own, 0.0))

    def _floor_for_chi2(self) -> float:
        """The floor at which chi2 equals the degrees of freedom (0 if it is below them without one).

        Newton on 1 / chi2, which is concave in the floor's square (Moré and Sorensen's way with a trust region): it
        comes from below and does not overshoot.
        """
        residual, covariance = self._evaluation().residual_px[self.used], self.detector_px2[self.used]
        u, v = residual[:, 0], residual[:, 1]
        uu, uv, vv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        goal, square = self._degrees_of_freedom(), 0.0
        for _ in range(_FLOOR_STEPS):
            determinant = (uu + square) * (vv + square) - uv * uv
            y_u, y_v = ((vv + square) * u - uv * v) / determinant, ((uu + square) * v - uv * u) / determinant
            chi2 = float(u @ y_u + v @ y_v)
            step = (chi2 / goal - 1) * chi2 / max(float(y_u @ y_u + y_v @ y_v), 1e-300)
            if step <= 1e-13 * square:
                break
            square += step
        return math.sqrt(square)

    def _reject(self, residual: FloatArray) -> None:
        safe = np.where(np.isfinite(residual), residual, 1e6)
        self.used = _distance2(safe, self.detector_px2, self.floor_px) <= _OUTLIER_CHI2
        if self.used.sum() * 2 < self.problem.count + 2:
            raise NotEnoughData("most points disagree with any lens; check the target's size, its pose and the angles")

    def worst_view(self) -> tuple[int, str] | None:
        """(index, reason) of the picture with most outliers, if it is to be dropped."""
        residual = self._evaluation().residual_px
        worst: tuple[int, float] | None = None
        for index in range(len(self.problem.views)):
            share = 1 - float(np.mean(self.used[self.problem.view_of == index]))
            if share > _VIEW_OUTLIERS and (worst is None or share > worst[1]):
                worst = index, share
        if worst is None:
            return None
        distance = np.median(np.linalg.norm(residual[self.problem.view_of == worst[0]], axis=1))
        return worst[0], f"{worst[1]:.0%} of its points disagree with the other pictures (median {distance:.1f} px)"

    def at_minimum(self) -> Minimum:
        """Everything of the fit as it now stands."""
        evaluation, whiten = self._evaluation(), self._whitening()
        return Minimum(evaluation, whiten, self._normal(evaluation, whiten, robust=False))

    def result(self, dropped: tuple[tuple[str, str], ...]) -> LevelFit:
        at = self.at_minimum()
        evaluation, whiten, lens = at.evaluation, at.whiten, self.state.lens
        inverse = at.normal.shared_covariance()
        T = per_unknown(lens)
        covariance = T @ inverse[:LENS_COUNT, :LENS_COUNT] @ T.T
        column = self.problem.nodal_column
        residual = evaluation.residual_px
        whitened = _whitened(whiten, residual, self.used)
        views, outliers = [], []
        for index, view in enumerate(self.problem.views):
            rows = self.problem.view_of == index
            used = self.used[rows]
            counted = residual[rows][used]
            distance = np.linalg.norm(residual[rows], axis=1)
            views.append(
                ViewResidual(
                    view.name,
                    view.target_name,
                    view.detection.points_px,
                    residual[rows],
                    used,
                    float(np.sqrt(np.mean(counted**2))) if len(counted) else math.nan,
                    float(np.max(distance[used])) if used.any() else math.nan,
                    float(np.sum(whitened[rows] ** 2)) / max(2 * int(used.sum()), 1),
                )
            )
            ids = view.detection.point_ids
            outliers += [(view.name, int(ids[i]), float(distance[i])) for i in np.flatnonzero(~used)]
        counted = residual[self.used]
        return LevelFit(
            lens=lens,
            covariance=covariance,
            floor_px=self.floor_px,
            rms_px=float(np.sqrt(np.mean(counted**2))),
            max_px=float(np.max(np.linalg.norm(counted, axis=1))),
            points=int(self.used.sum()),
            views=tuple(views),
            outliers=tuple(outliers),
            dropped=dropped,
            poses={self.problem.views[i].name: pose for i, pose in self.free_poses().items()},
            iterations=self.iterations,
            sigma_nodal_mm=math.sqrt(max(inverse[column, column], 0.0)) if column >= 0 else None,
            mistakes=self._mistakes(inverse),
            priors=self.priors,
            solved=self,
        )

    def _mistakes(self, covariance: FloatArray) -> tuple[Mistake, ...]:
        """What became of each mistake that was an unknown; ``covariance`` of the shared unknowns."""
        problem, state, geometry = self.problem, self.state, self.problem.geometry
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        found: list[Mistake] = []

        def add(
            first: int, names: Sequence[str], subject: str, unit: str, off: FloatArray, prior: float, per: float = 1.0
        ) -> None:
            for i, name in enumerate(names):
                spread = float(sigma[first + i]) * per
                found.append(Mistake(name, subject, unit, float(off[i]) * per, spread, prior * per))

        for index, prior in enumerate(geometry.pivot_sigmas_m):
            off = state.pivots[index] - geometry.pivots_m[index]
            add(problem.first_pivot + 3 * index, _PLACE, "pivot", "mm", off, float(prior), 1000.0)
        for index, prior in enumerate(geometry.place_sigmas_m):
            off = state.places[index] - geometry.places_m[index]
            add(problem.first_place + 3 * index, _PLACE, geometry.place_names[index], "mm", off, float(prior), 1000.0)
        for index, prior in enumerate(geometry.turn_sigmas_rad):
            off = rotation_log(geometry.turns[index].T @ state.turns[index])
            first, name = problem.first_turn + 3 * index, geometry.turn_names[index]
            add(first, _TURN, name, "deg", off, float(prior), math.degrees(1.0))
        extras = problem.extras
        for index, name in enumerate(extras.names):
            subject, unit, prior = extras.subjects[index], extras.units[index], float(extras.sigmas[index])
            add(problem.first_extra + index, [name], subject, unit, state.extras[index : index + 1], prior)
        return tuple(found)


def _distance2(residual: FloatArray, covariance: FloatArray, floor_px: float) -> FloatArray:
    """Squared distances (N,) of residuals (N, 2) in their own standard deviations: r' C^-1 r, C with the floor."""
    uu, uv, vv = covariance[:, 0, 0] + floor_px**2, covariance[:, 0, 1], covariance[:, 1, 1] + floor_px**2
    u, v = residual[:, 0], residual[:, 1]
    return np.asarray((vv * u * u - 2 * uv * u * v + uu * v * v) / (uu * vv - uv * uv))


def _whitened(whiten: FloatArray, residual: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """W residual, (N, 2), zero where not used (whatever stands there)."""
    u, v = residual[:, 0], residual[:, 1]
    out = np.column_stack([whiten[:, 0] * u, whiten[:, 1] * u + whiten[:, 2] * v])
    out[~used] = 0.0
    return out


def per_unknown(lens: Lens) -> FloatArray:
    """d (f, k1, k2, sx, sy) / d (log f, k1_hw, k2_hw, sx, sy), (5, 5)."""
    h = lens.half_width
    T = np.zeros((5, 5))
    T[0, 0] = lens.f_px
    T[1, 0], T[1, 1] = 2 * lens.k1, 1 / h**2
    T[2, 0], T[2, 2] = 4 * lens.k2, 1 / h**4
    T[3, 3] = T[4, 4] = 1.0
    return T
