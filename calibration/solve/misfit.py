"""Whether the lens model suits a level's pictures, and where in the frame they were measured.

All figures come from the fit at its minimum, from whitened residuals r and Jacobian J (priors included), with
C = (J^T J)^-1 and leverages h_i = J_i C J_i^T. The unknowns of single pictures are eliminated: with S = J_s - J_o
C_o^-1 J_o^T J_s, the shared unknowns' Jacobian less what the pictures' own ones follow, J_i C J_j^T is
S_i C_s S_j^T, plus J_oi C_o^-1 J_oj^T within a picture (Triggs et al., Bundle adjustment, 2000, section 6):

- A term that the model lacks, with whitened derivatives E, is tested by its score (Rao 1948), which for least squares
  is also the likelihood ratio to first order: with E' = E - J C J^T E its value would be a = -(E'^T E')^-1 E'^T r, and
  a^T (E'^T E') a is chi2 with as many degrees of freedom as terms. How much it matters is how far the lens would move
  anywhere in the frame were it fitted as well, all other unknowns following.
- Neighbouring points of a target must have unrelated residuals: the mean product over all neighbours, less what the
  fit itself brings (-J_i C J_j^T), over its standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtr

from calibration.compare import grid_pixels, predicted_overlay
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.solve.iteration import LevelFit, per_unknown
from calibration.solve.problem import LENS_COUNT
from calibration.types import FloatArray

CELLS = (8, 5)
"""Columns x rows of cells of the frame for which it is told whether a point was measured in them."""

SIGNIFICANT = 1e-3
"""A test whose p-value is below this speaks against the model: by chance one level in a thousand, for each test."""

CERTAIN = 1e-4
NOTABLE_PX = 0.1
"""A missing term whose p-value is below the one and whose size is above the other stands in the lens table."""

_Term = Callable[[Lens, FloatArray], FloatArray]
# Derivatives of pixels after a term's coefficients, at rays.


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Where in the frame points were measured. ``cells`` (5, 8): how many in each cell; ``share`` of cells with any;
    ``radius_share``: the farthest point's distance from the principal point over the farthest corner's;
    ``corner_px``: largest expected overlay error (one sigma) at the frame's four corners."""

    cells: NDArray[np.int64]
    share: float
    radius_share: float
    corner_px: float


@dataclass(frozen=True, slots=True)
class Test:
    """A test of the model. ``statistic`` is chi2 with ``dof`` degrees of freedom; ``size_px``: what the missing term
    would change at most in the frame, None for a test that is of no term."""

    name: str
    statistic: float
    dof: int
    p_value: float
    size_px: float | None = None

    @property
    def significant(self) -> bool:
        return self.p_value < SIGNIFICANT


@dataclass(frozen=True, slots=True)
class Misfit:
    """Whether the lens model suits the pictures. ``radial_px``, ``tangential_px``: mean residual away from and around
    the principal point; ``neighbours``: correlation of neighbouring points' residuals."""

    tests: tuple[Test, ...]
    radial_px: float
    tangential_px: float
    neighbours: float

    @property
    def flagged(self) -> bool:
        return any(test.significant for test in self.tests)

    @property
    def missing(self) -> Test | None:
        """The term that the lens lacks for certain and that matters most, see :data:`CERTAIN`."""
        terms = [t for t in self.tests if t.size_px is not None and t.p_value < CERTAIN and t.size_px > NOTABLE_PX]
        return max(terms, key=lambda test: test.size_px or 0.0, default=None)

    def sentence(self) -> str:
        """The verdict for a reader, in one sentence."""
        against = [test for test in self.tests if test.significant]
        if not against:
            return "Nothing in the residuals speaks against the lens model."
        parts = []
        for test in against:
            size = "" if test.size_px is None else f", worth up to {test.size_px:.3f} px in the frame"
            parts.append(f"{test.name} (p = {test.p_value:.1g}{size})")
        return "The residuals are not noise alone: " + "; ".join(parts) + "."


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """The fit at its minimum, whitened, points that count only: residuals (n, 2); Jacobians ``shared`` (n, 2, S), the
    pictures' own unknowns already taken off, and ``own`` (n, 2, 6); covariances of the shared unknowns (S, S) and of
    each picture's own ones were the shared ones known (V, 6, 6); rays (n, 2), leverages (n, 2), each point's picture
    and number."""

    whiten: FloatArray
    raw_px: FloatArray
    residual: FloatArray
    shared: FloatArray
    own: FloatArray
    shared_covariance: FloatArray
    own_covariance: FloatArray
    rays: FloatArray
    leverage: FloatArray
    view: NDArray[np.int64]
    point: NDArray[np.int64]

    @classmethod
    def of(cls, fit: LevelFit) -> Minimum:
        """Of a level's fit. Raises :class:`InvalidInput` for one that does not carry its iteration."""
        if fit.solved is None:
            raise InvalidInput("fit", None, "carries no solution; solve the level again")
        solved = fit.solved
        problem, used = solved.problem, solved.used
        at = solved.at_minimum()
        evaluation, normal = at.evaluation, at.normal
        view = problem.view_of[used]
        total_px2 = solved.detector_px2[used] + np.eye(2) * solved.floor_px**2
        whiten = np.linalg.inv(np.linalg.cholesky(total_px2))
        raw, own = evaluation.residual_px[used], whiten @ evaluation.own[used]
        own_covariance = np.asarray(np.linalg.pinv(normal.C, hermitian=True))
        follow = own_covariance @ np.swapaxes(normal.B, 1, 2)  # (V, 6, S)
        shared = whiten @ evaluation.shared[used] - np.einsum("nio,nos->nis", own, follow[view])
        points = problem.geometry.camera_points(solved.state)[used]
        minimum = cls(
            whiten,
            raw,
            (whiten @ raw[..., None])[..., 0],
            shared,
            own,
            normal.shared_covariance(),
            own_covariance,
            points[:, :2] / points[:, 2:],
            np.empty(0),
            view,
            np.concatenate([view.detection.point_ids for view in problem.views])[used],
        )
        every = np.arange(len(view))
        return replace(minimum, leverage=minimum.brought_by_fit(every, every))

    def brought_by_fit(self, a: NDArray[np.int64], b: NDArray[np.int64]) -> FloatArray:
        """J_a C J_b^T of pairs of points of the same picture, each coordinate with its like: (pairs, 2)."""
        shared = np.einsum("nis,st,nit->ni", self.shared[a], self.shared_covariance, self.shared[b], optimize=True)
        own = np.einsum("nio,nop,nip->ni", self.own[a], self.own_covariance[self.view[a]], self.own[b], optimize=True)
        return np.asarray(shared + own)

    def followed(self, E: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What the unknowns make of whitened derivatives ``E`` (n, 2, m): C_s S^T E (S, m) for the shared ones, and
        J C J^T E (n, 2, m)."""
        shared = self.shared_covariance @ np.einsum("nis,nim->sm", self.shared, E)
        each = np.zeros((len(self.own_covariance), self.own.shape[-1], E.shape[-1]))
        np.add.at(each, self.view, np.einsum("nio,nim->nom", self.own, E))
        each = self.own_covariance @ each
        return shared, self.shared @ shared + np.einsum("nio,nom->nim", self.own, each[self.view])


def coverage_of(fit: LevelFit) -> Coverage:
    """Where the fit's points lie in the frame."""
    width, height = fit.lens.image_size
    points = np.concatenate([view.points_px[view.used] for view in fit.views])
    columns = np.clip(((points[:, 0] + 0.5) * CELLS[0] / width).astype(np.int64), 0, CELLS[0] - 1)
    rows = np.clip(((points[:, 1] + 0.5) * CELLS[1] / height).astype(np.int64), 0, CELLS[1] - 1)
    cells = np.zeros((CELLS[1], CELLS[0]), dtype=np.int64)
    np.add.at(cells, (rows, columns), 1)
    centre = np.asarray(fit.lens.principal_point_px)
    corners = np.array([[0.0, 0.0], [width - 1.0, 0.0], [0.0, height - 1.0], [width - 1.0, height - 1.0]])
    farthest = float(np.max(np.linalg.norm(corners - centre, axis=1)))
    expected = predicted_overlay(fit.lens, fit.covariance).map_px
    return Coverage(
        cells,
        float(np.mean(cells > 0)),
        float(np.max(np.linalg.norm(points - centre, axis=1))) / farthest,
        float(np.nanmax(expected[[0, 0, -1, -1], [0, -1, 0, -1]])),
    )


def _radial_term(lens: Lens, rays: FloatArray) -> FloatArray:
    """d(u, v) / d k3 of a term k3 r^6: (N, 2, 1) px."""
    r2 = np.sum(rays**2, axis=-1, keepdims=True)
    return np.asarray((lens.f_px * np.array([1.0, lens.pixel_aspect]) * rays * r2**3)[..., None])


def _tangential_terms(lens: Lens, rays: FloatArray) -> FloatArray:
    """d(u, v) / d (p1, p2) of Brown's decentring: 2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y."""
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    along_u = np.stack([2 * x * y, r2 + 2 * x * x], -1)
    along_v = np.stack([r2 + 2 * y * y, 2 * x * y], -1)
    return np.asarray(lens.f_px * np.stack([along_u, lens.pixel_aspect * along_v], axis=-2))


def misfit_of(fit: LevelFit, minimum: Minimum) -> Misfit:
    """All tests of the lens model at the fit's minimum."""
    centre = np.asarray(fit.lens.principal_point_px)
    out = np.concatenate([view.points_px[view.used] for view in fit.views]) - centre
    out = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    around = np.stack([-out[:, 1], out[:, 0]], axis=-1)
    correlation, neighbours = _neighbours(fit, minimum)
    tests = (
        _score("a k3 term is missing", fit, minimum, _radial_term(fit.lens, minimum.rays), _radial_term),
        _score("the lens is decentred", fit, minimum, _tangential_terms(fit.lens, minimum.rays), _tangential_terms),
        _score("residuals point outwards or inwards", fit, minimum, out[..., None], None),
        _score("residuals turn about the centre", fit, minimum, around[..., None], None),
        neighbours,
    )
    return Misfit(
        tests,
        float(np.mean(np.sum(minimum.raw_px * out, axis=1))),
        float(np.mean(np.sum(minimum.raw_px * around, axis=1))),
        correlation,
    )


def _score(name: str, fit: LevelFit, minimum: Minimum, extra_px: FloatArray, term: _Term | None) -> Test:
    """The score test of extra derivatives (n, 2, m) px; with the term's function also how much it would change."""
    E = minimum.whiten @ extra_px
    E_scale = np.linalg.norm(E, axis=(0, 1))
    E = E / np.maximum(E_scale, 1e-300)
    follow, explained = minimum.followed(E)
    information = np.einsum("nik,nim->km", E, E - explained)
    score = np.einsum("nim,ni->m", E, minimum.residual)
    kept = np.linalg.eigvalsh(information)
    if not kept[0] > 1e-9:
        # The other unknowns do all that this term could do: nothing can be said about it.
        return Test(name, 0.0, E.shape[-1], 1.0, None if term is None else 0.0)
    amount = -np.linalg.solve(information, score)
    statistic = float(-score @ amount)
    size_px = None
    if term is not None:
        size_px = _moved_px(fit.lens, term(fit.lens, _grid_rays(fit.lens)) / E_scale, amount, -follow @ amount)
    return Test(name, statistic, E.shape[-1], float(chdtrc(E.shape[-1], statistic)), size_px)


def _grid_rays(lens: Lens) -> FloatArray:
    return lens.unproject(grid_pixels(lens.image_size)).reshape(-1, 2)


def _moved_px(lens: Lens, term: FloatArray, amount: FloatArray, others: FloatArray) -> float:
    """Largest distance on the grid by which the lens moves with ``amount`` of ``term`` and what the others then do."""
    per = lens.jacobian_parameters(_grid_rays(lens)) @ per_unknown(lens)
    return float(np.nanmax(np.linalg.norm(term @ amount + per @ others[:LENS_COUNT], axis=-1)))


def _neighbours(fit: LevelFit, minimum: Minimum) -> tuple[float, Test]:
    """Correlation of residuals of points beside one another on the same target, and its one-sided test."""
    problem = fit.solved.problem if fit.solved is not None else None
    first: list[int] = []
    second: list[int] = []
    for index, view in enumerate(problem.views if problem is not None else ()):
        columns = view.target.grid[0]
        rows = np.flatnonzero(minimum.view == index)
        place = {int(minimum.point[row]): int(row) for row in rows}
        for point, row in place.items():
            if (point + 1) % columns and point + 1 in place:
                first.append(row)
                second.append(place[point + 1])
            if point + columns in place:
                first.append(row)
                second.append(place[point + columns])
    name = "neighbouring points are off alike"
    if not first:
        return 0.0, Test(name, 0.0, 1, 1.0)
    a, b = np.array(first), np.array(second)
    products = minimum.residual[a] * minimum.residual[b]
    excess = float(np.sum(products + minimum.brought_by_fit(a, b)))
    z = excess / math.sqrt(products.size)
    return excess / products.size, Test(name, z * abs(z), 1, float(ndtr(-z)))
