"""The evidence of a level: what its numbers rest on, whether the model suits the pictures, and how to solve it again.

A picture's chi2 is the sum of its squared whitened residuals, with 2 n - sum(h) degrees of freedom, h the leverages.
Tests of the lens model are in :mod:`calibration.solve.misfit`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtrc

from calibration.compare import Overlay, predicted_overlay
from calibration.errors import InvalidInput
from calibration.lens import LENS_PARAMETERS, Lens
from calibration.solve.iteration import Fit, LevelFit, per_unknown
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.misfit import Coverage, Minimum, Misfit, coverage_of, misfit_of
from calibration.solve.mistakes import Mistake, Priors
from calibration.solve.outcome import level_result, pixel_error
from calibration.solve.problem import LENS_COUNT, View
from calibration.tables import LeftOut, LevelResult, Parallax, PixelError
from calibration.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LevelInputs:
    """What a level was solved from, all of it: :func:`solve_again` needs nothing else.

    ``views``: every picture that was handed to the fit, those it dropped included; ``left_out``: pictures that never
    came so far. ``picture_sha256``: hash of each picture's bytes by the view's name, missing where unknown.
    ``versions``: of the product and of the libraries that the numbers depend on.
    """

    zoom: float
    focus: float
    image_size: tuple[int, int]
    views: tuple[View, ...]
    pixel_aspect: float = 1.0
    nodal_offset_mm: float = 0.0
    nodal_sigma_mm: float = 0.0
    priors: Priors = field(default_factory=Priors)
    left_out: tuple[LeftOut, ...] = ()
    picture_sha256: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PictureEvidence:
    """One picture in the fit. ``chi2`` with ``dof`` degrees of freedom (leverage taken off), ``p_value``: chance of a
    larger chi2. ``held_out_px``: the same picture under the lens of all others, None where it could not be spared."""

    name: str
    points: int
    used: int
    rms_px: float
    chi2: float
    dof: float
    p_value: float
    held_out_px: PixelError | None


@dataclass(frozen=True, slots=True)
class Outlier:
    """A point that the fit left out: which of the target's points in which picture, how far off, in px and sigmas."""

    picture: str
    point: int
    distance_px: float
    sigmas: float


@dataclass(frozen=True, slots=True)
class Noise:
    """``expected_px``: RMS per coordinate that the detector's covariances promise; ``found_px``: the residuals', of as
    many degrees of freedom; ``floor_px``: what was added to the former so that the two agree."""

    expected_px: float
    found_px: float
    floor_px: float


@dataclass(frozen=True, slots=True, eq=False)
class LevelEvidence:
    """All that a level's numbers rest on.

    ``covariance`` is of ``parameters``: (f_px, k1, k2, sx, sy) and, where it was an unknown, nodal_offset_mm.
    ``fold_margin``: distorted radius at which the lens folds over that of the frame's farthest corner, infinite where
    it never folds; above 1 or the level is refused. ``outlier_share`` above 0.03 fails a level.
    ``mistakes`` and ``parallax`` as the fit tells them.
    """

    inputs: LevelInputs
    lens: Lens
    parameters: tuple[str, ...]
    covariance: FloatArray
    noise: Noise
    chi2: float
    dof: float
    pictures: tuple[PictureEvidence, ...]
    outliers: tuple[Outlier, ...]
    outlier_share: float
    coverage: Coverage
    fold_margin: float
    misfit: Misfit
    mistakes: tuple[Mistake, ...] = ()
    parallax: Parallax | None = None

    @property
    def correlation(self) -> FloatArray:
        """Correlations of ``parameters``; 0 beside a parameter without variance."""
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        inverse = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0)
        return np.asarray(self.covariance * np.outer(inverse, inverse))

    def expected(self) -> Overlay:
        """The map of the overlay error to expect (one sigma): it follows from the lens and its covariance."""
        return predicted_overlay(self.lens, self.covariance[:LENS_COUNT, :LENS_COUNT])


def level_evidence(fit: LevelFit, inputs: LevelInputs, held_out: Mapping[str, FloatArray]) -> LevelEvidence:
    """The evidence of ``fit``, which was solved from ``inputs``; ``held_out`` as
    :func:`calibration.solve.level.held_out_residuals` gives it."""
    solved = fit.solved
    if solved is None:
        raise InvalidInput("fit", None, "carries no solution; solve the level again")
    minimum = Minimum.of(fit)
    parameters, covariance = _covariance(fit, minimum)
    return LevelEvidence(
        inputs=inputs,
        lens=fit.lens,
        parameters=parameters,
        covariance=covariance,
        noise=_noise(fit, solved, minimum),
        chi2=float(np.sum(minimum.residual**2)),
        dof=2 * fit.points - float(np.sum(minimum.leverage)),
        pictures=tuple(_pictures(fit, minimum, held_out)),
        outliers=tuple(_outliers(solved)),
        outlier_share=len(fit.outliers) / max(fit.points + len(fit.outliers), 1),
        coverage=coverage_of(fit),
        fold_margin=fit.lens.fold_radius() / fit.lens.corner_radius(),
        misfit=misfit_of(fit, minimum),
        mistakes=fit.mistakes,
        parallax=fit.parallax,
    )


def solve_again(inputs: LevelInputs) -> LevelResult:
    """The level's entry from its stored inputs alone; what an engine's render added to the first one is not in it."""
    fit = solve_level(
        inputs.views,
        inputs.image_size,
        pixel_aspect=inputs.pixel_aspect,
        nodal_offset_mm=inputs.nodal_offset_mm,
        nodal_sigma_mm=inputs.nodal_sigma_mm,
        priors=inputs.priors,
    )
    held_out = held_out_residuals(fit, inputs.views)
    return level_result(fit, inputs.zoom, inputs.focus, held_out=held_out, left_out=inputs.left_out)


def _covariance(fit: LevelFit, minimum: Minimum) -> tuple[tuple[str, ...], FloatArray]:
    column = fit.solved.problem.nodal_column if fit.solved is not None else -1
    if column < 0 or fit.untold:
        return LENS_PARAMETERS, fit.covariance
    rows = [*range(LENS_COUNT), column]
    T = np.eye(LENS_COUNT + 1)
    T[:LENS_COUNT, :LENS_COUNT] = per_unknown(fit.lens)
    covariance = T @ minimum.shared_covariance[np.ix_(rows, rows)] @ T.T
    return (*LENS_PARAMETERS, "nodal_offset_mm"), covariance


def _noise(fit: LevelFit, solved: Fit, minimum: Minimum) -> Noise:
    own = solved.detector_px2[solved.used]
    free = max(2 * fit.points - float(np.sum(minimum.leverage)), 1.0)
    return Noise(
        math.sqrt(float(np.mean(np.trace(own, axis1=1, axis2=2))) / 2),
        math.sqrt(float(np.sum(minimum.raw_px**2)) / free),
        fit.floor_px,
    )


def _pictures(fit: LevelFit, minimum: Minimum, held_out: Mapping[str, FloatArray]) -> Sequence[PictureEvidence]:
    told = []
    for index, view in enumerate(fit.views):
        rows = minimum.view == index
        chi2 = float(np.sum(minimum.residual[rows] ** 2))
        dof = float(2 * np.sum(rows) - np.sum(minimum.leverage[rows]))
        held = pixel_error([held_out[view.name]]) if view.name in held_out else None
        p_value = float(chdtrc(dof, chi2)) if dof > 0 else math.nan
        told.append(
            PictureEvidence(view.name, len(view.used), int(np.sum(rows)), view.rms_px, chi2, dof, p_value, held)
        )
    return told


def _outliers(solved: Fit) -> Sequence[Outlier]:
    problem = solved.problem
    residual = problem.residuals(solved.state)
    ids = np.concatenate([view.detection.point_ids for view in problem.views])
    total_px2 = solved.detector_px2 + np.eye(2) * solved.floor_px**2
    told = []
    for row in np.flatnonzero(~solved.used):
        far = residual[row]
        if np.isfinite(far).all():
            sigmas = math.sqrt(float(far @ np.linalg.solve(total_px2[row], far)))
            distance = float(np.linalg.norm(far))
        else:
            sigmas = distance = math.inf
        told.append(Outlier(problem.views[problem.view_of[row]].name, int(ids[row]), distance, sigmas))
    return told
