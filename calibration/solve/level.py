"""Joint least squares over all pictures of a level: FoV, k1, k2, centre shift and every pose that is not known.

What is fitted, and when once more: pictures that contradict the rest are dropped, the nodal offset is held unless the
pictures contradict it, and what the pictures do not show is held at 0 and said to be untold. The iteration itself is in
:mod:`calibration.solve.iteration`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.compare import predicted_overlay
from calibration.errors import InvalidInput, NotConverged, NotEnoughData
from calibration.lens import Lens
from calibration.solve.iteration import Fit, LevelFit
from calibration.solve.mistakes import Priors
from calibration.solve.nodal import MEASURED_MM, parallax, two_distances
from calibration.solve.problem import (
    LENS_COUNT,
    PRIOR_K1_HW,
    PRIOR_K2_HW,
    PRIOR_NODAL_MM,
    PRIOR_SHIFT_OF_WIDTH,
    View,
)
from calibration.solve.start import start
from calibration.types import FloatArray

MISFIT_PX = 1.0
"""A floor above this is no bent board any more: something is wrong with a pose or with the survey."""
_ODD_SHARE = 0.2
# Leaving one picture out must take the floor down to this share of it before that picture is blamed.
_NODAL_SIGNIFICANT = 4.0
# Sigmas by which the pictures must contradict the nodal offset that was given before theirs is used instead.
_BEND = ("k1", "k2")
_USELESS_OF_WIDTH = 0.1
# With every pose free, an expected error above this share of the width means that even the field of view is a guess.
_UNTOLD = 0.3
# A quantity whose sigma is above this share of its prior's says no more than the prior.


def solve_level(
    views: Sequence[View],
    image_size: tuple[int, int],
    *,
    pixel_aspect: float = 1.0,
    nodal_offset_mm: float = 0.0,
    nodal_sigma_mm: float = 0.0,
    guess: Lens | None = None,
    straight: bool = False,
    priors: Priors | None = None,
) -> LevelFit:
    """Fit one lens to all pictures of a level. Raises :class:`calibration.errors.CalibrationError`.

    ``nodal_offset_mm`` stands unless the pictures contradict it, or show targets at two distances and tell it; with a
    ``nodal_sigma_mm`` it is only a prior, and what the pictures and the prior leave open shows in the covariance.
    ``guess`` is a lens to start from; without one the start is found from the pictures alone. ``straight`` holds k1 and
    k2 at 0: for the first pictures, which tell only where to look next. ``priors``: how large mistakes of survey,
    board, head and camera may be (:class:`calibration.solve.mistakes.Priors`).
    """
    if not views:
        raise NotEnoughData("no picture of this level shows its target")
    names = [v.name for v in views]
    if len(set(names)) != len(names):
        raise InvalidInput("picture names", names, "each view needs a name of its own")
    bend = _BEND if straight else ()
    known = _Known(image_size, pixel_aspect, nodal_offset_mm, nodal_sigma_mm, guess, bend, priors or Priors())
    try:
        fit = _solve(views, known)
    except np.linalg.LinAlgError as error:
        raise NotConverged("the level's fit (its equations are singular)", 0, math.nan) from error
    fit.lens.require_unfolded()
    if all(view.free for view in views):
        expected_px = predicted_overlay(fit.lens, fit.covariance).max_px
        if not expected_px < _USELESS_OF_WIDTH * image_size[0]:
            raise NotEnoughData(
                f"a target in unknown pose does not tell the lens from these pictures (expected error up to "
                f"{expected_px:.0f} px): turn it to different angles, away from facing the camera"
            )
    return fit


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What a fit is told besides its pictures; see :func:`solve_level`. ``bend``: lens quantities held at 0."""

    image_size: tuple[int, int]
    pixel_aspect: float
    nodal_offset_mm: float
    nodal_sigma_mm: float
    guess: Lens | None
    bend: tuple[str, ...]
    priors: Priors


def _solve(views: Sequence[View], known: _Known) -> LevelFit:
    nodal_offset_mm, nodal_sigma_mm, bend, priors = (
        known.nodal_offset_mm, known.nodal_sigma_mm, known.bend, known.priors,
    )  # fmt: skip
    kept, dropped = list(views), []
    while True:
        _require_enough(kept)
        fitted = _first_fit(kept, known)
        bad = fitted.worst_view() if len(kept) > 2 else None
        if bad is None:
            bad = _odd_one_out(kept, fitted)
        if bad is None:
            break
        dropped.append((kept[bad[0]].name, bad[1]))
        del kept[bad[0]]
    fit = fitted.result(tuple(dropped))
    seen = None if fit.sigma_nodal_mm is None else (fit.lens.nodal_offset_mm, fit.sigma_nodal_mm)
    nodal_told = False
    if seen is not None:
        measured = two_distances(kept) and seen[1] <= MEASURED_MM
        nodal_told = measured or nodal_sigma_mm > 0 or abs(seen[0] - nodal_offset_mm) > _NODAL_SIGNIFICANT * seen[1]
        if not nodal_told:
            # What contradicts nothing stays as given: left free, it would only take exactness from the field of view.
            given = replace(fit.lens, nodal_offset_mm=nodal_offset_mm)
            held = Fit(kept, given, fitted.free_poses(), held=(*bend, "nodal_offset_mm"), priors=priors)
            held.run(after=fitted)
            fitted = held
            fit = fitted.result(tuple(dropped))
    untold = () if bend else _untold(fit)
    if untold:
        held_at = untold if nodal_told else (*untold, "nodal_offset_mm")
        again = Fit(kept, fit.lens, fitted.free_poses(), held=held_at, priors=priors)
        again.run(after=fitted)
        fit = replace(again.result(tuple(dropped)), covariance=fit.covariance, sigma_nodal_mm=fit.sigma_nodal_mm)
    check = parallax(fit.lens, nodal_offset_mm, seen[1], kept) if seen is not None and nodal_told else None
    return replace(fit, untold=untold, nodal_told=nodal_told, nodal_seen_mm=seen, parallax=check)


def _first_fit(kept: list[View], known: _Known) -> Fit:
    """The fit from the quick start; with every pose free, from the thorough one too where the quick one led nowhere."""

    def fitted_from(thorough: bool) -> Fit:
        lens, poses = start(
            kept, known.image_size, known.pixel_aspect, known.nodal_offset_mm, known.guess, thorough=thorough
        )
        nodal_sigma_mm = known.nodal_sigma_mm or PRIOR_NODAL_MM
        fit = Fit(kept, lens, poses, held=known.bend, nodal_sigma_mm=nodal_sigma_mm, priors=known.priors)
        fit.run()
        return fit

    if known.guess is not None or not all(view.free for view in kept):
        return fitted_from(False)
    try:
        quick = fitted_from(False)
    except (NotConverged, NotEnoughData, np.linalg.LinAlgError):
        return fitted_from(True)
    # From afar a board in its mirrored pose looks nearly the same, and a lens can be bent to suit a few such mistakes:
    # only residuals that the detector's noise explains say that none was made.
    explained = quick.floor_px <= quick.noise_px and quick.worst_view() is None
    if explained and not quick.state.lens.folds_inside():
        return quick
    try:
        thorough = fitted_from(True)
    except (NotConverged, NotEnoughData, np.linalg.LinAlgError):
        return quick
    return thorough if thorough.floor_px < quick.floor_px else quick


def _odd_one_out(kept: list[View], fitted: Fit) -> tuple[int, str] | None:
    """(index, reason) of the one picture without which the misfit goes away: few pictures bend the lens to suit a wrong
    pose, and leave residuals everywhere instead of outliers in one place."""
    if fitted.floor_px <= MISFIT_PX or len(kept) < 4:
        return None
    lens = fitted.state.lens
    floors: list[float] = []
    for index in range(len(kept)):
        others = kept[:index] + kept[index + 1 :]
        try:
            first, poses = start(others, lens.image_size, lens.pixel_aspect, fitted.problem.nodal_prior_mm)
            without = Fit(others, first, poses, held=("nodal_offset_mm",))
            without.run()
        except (NotConverged, NotEnoughData, np.linalg.LinAlgError):
            floors.append(math.inf)
        else:
            floors.append(without.floor_px)
    best = int(np.argmin(floors))
    if floors[best] > _ODD_SHARE * fitted.floor_px:
        return None
    return best, (
        f"its pose contradicts the other pictures: without it the misfit falls from {fitted.floor_px:.1f} to "
        f"{floors[best]:.2f} px"
    )


def _untold(fit: LevelFit) -> tuple[str, ...]:
    """Quantities whose uncertainty is nearly that of knowing nothing: the pictures do not show them."""
    h = fit.lens.half_width
    width = fit.lens.image_size[0]
    sigma = fit.sigma
    known = {
        "k1": sigma[1] * h**2 < _UNTOLD * PRIOR_K1_HW,
        "k2": sigma[2] * h**4 < _UNTOLD * PRIOR_K2_HW,
        "center_shift_px": max(sigma[3], sigma[4]) < _UNTOLD * PRIOR_SHIFT_OF_WIDTH * width,
    }
    return tuple(name for name, told in known.items() if not told)


def residual_of(view: View, lens: Lens, lifted: Mapping[str, FloatArray] | None = None) -> FloatArray | None:
    """Residuals (N, 2) px of a picture under a lens that was fitted without it; its own free pose is fitted first.
    ``lifted``: how the boards stand out of their planes (:meth:`calibration.solve.geometry.Geometry.lifted`).

    None where the lens cannot explain the picture at all.
    """
    try:
        _, poses = start([view], lens.image_size, lens.pixel_aspect, lens.nodal_offset_mm, lens)
        fitted = Fit([view], lens, poses, lens_free=False, lifted=lifted)
        if fitted.problem.count:
            fitted.iterate(robust=False)
        residual = fitted.problem.residuals(fitted.state)
    except (NotConverged, NotEnoughData, np.linalg.LinAlgError):
        return None
    return residual if np.isfinite(residual).all() else None


def held_out_residuals(fit: LevelFit, views: Sequence[View]) -> dict[str, FloatArray]:
    """Residuals of each picture under the lens fitted to all the others, by name; pictures that cannot be spared
    (too few would be left) are missing."""
    used = [v for v in views if v.name not in {name for name, _ in fit.dropped}]
    residuals: dict[str, FloatArray] = {}
    for index, view in enumerate(used):
        others = used[:index] + used[index + 1 :]
        try:
            _require_enough(others)
            _, poses = start(others, fit.lens.image_size, fit.lens.pixel_aspect, fit.lens.nodal_offset_mm, fit.lens)
            without = Fit(others, fit.lens, poses, priors=fit.priors)
            without.floor_px = fit.floor_px
            without.iterate(robust=False)
        except (NotConverged, NotEnoughData, np.linalg.LinAlgError):
            continue
        lifted = without.problem.geometry.lifted(without.state)
        residual = residual_of(view, without.state.lens, lifted)
        if residual is not None:
            residuals[view.name] = residual
    return residuals


def _require_enough(views: Sequence[View]) -> None:
    points = sum(len(v.detection.points_px) for v in views)
    unknowns = LENS_COUNT + 6 * sum(v.free for v in views)
    if 2 * points < unknowns or not views:
        raise NotEnoughData(
            f"{len(views)} picture(s) with {points} points cannot tell {unknowns} unknowns; take more pictures"
        )
    if all(v.free for v in views) and len(views) < 2:
        raise NotEnoughData("one picture of a target in unknown pose does not tell a lens; take at least two")
