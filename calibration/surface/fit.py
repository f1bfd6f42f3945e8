"""One fit over all levels of a table: the surface, and what each level says of its neighbours.

Each level is also compared with the surface through all others (leave-one-out). One that does not fit is explained
and left out: with chi^2 = r' C^-1 r of its five quantities over the covariance of that comparison, chi^2 / 5 follows
an F distribution with 5 and as many degrees of freedom as the smoothness was learned from, so a level is left out
where that leaves less than a chance of one in a hundred for any level of the table. A level that costs less than half
a pixel stays whatever its chance: leaving it out would cost more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from calibration.errors import InvalidInput
from calibration.surface.evaluate import LensSurface
from calibration.surface.model import LensModel, LevelMisfit, PriorMean, misfit
from calibration.surface.quantities import QUANTITIES, LevelData
from calibration.tables import LensTable, PixelError
from calibration.types import FloatArray

REJECTED_CHANCE = 0.01
"""Chance that any good level of a table is left out."""

HARMLESS_PX = 0.5
"""A level that disagrees by less than this is kept."""

FEWEST_TO_JUDGE = 6
"""With fewer levels none can be told wrong: the others do not show how smooth the lens is."""

_MOST_LEFT_OUT = 0.25
_SUSPECTS = 3
_RARER = 0.01
# Each further wrong level of a table is so much less likely; beside one left out, an end of the range is extrapolated.
_ARRIVED = 0.05
# Chance above which a level is taken to fit at another zoom.
_ELSEWHERE = 0.01
# Steps of zoom below which that is no other place.
_SAME_PLACE = (0.002, 0.02)
# Encoder steps under which two levels stand at one place and must agree.
_CONTRADICTION_PX, _CONTRADICTION_SIGMA = 1.0, 6.0


@dataclass(frozen=True, slots=True)
class LevelCheck:
    """How one level fits its neighbours. ``error_px``: largest overlay error of the surface through the others at its
    place, ``expected_px`` its standard deviation (None for a level without a lens, or where there is nothing to compare
    with); ``chance``: of a larger disagreement; ``used``; ``reason``: why not, or what is odd about it."""

    zoom: float
    focus: float
    used: bool
    error_px: float | None = None
    expected_px: float | None = None
    chance: float | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """The surface over a table's levels. ``checks``: in the order of the table's levels; ``held_out_px``: overlay error
    at levels left out of the fit, over those used (rms and max of each level's largest), None with too few."""

    surface: LensSurface
    checks: tuple[LevelCheck, ...]
    held_out_px: PixelError | None

    @property
    def left_out(self) -> tuple[LevelCheck, ...]:
        """The levels with a lens that were left out."""
        return tuple(check for check in self.checks if not check.used and check.error_px is not None)


def fit_surface(table: LensTable, *, prior: LensSurface | None = None, reject: bool = True) -> SurfaceFit:
    """The surface over a table's levels. ``prior``: of a lens of the same type, to which the differences are fitted;
    ``reject`` False: every level with a lens is used.

    Raises :class:`InvalidInput` for a table without a usable level, encoders that run backwards, levels that contradict
    each other at one place, or a prior of another picture; :class:`calibration.errors.NotConverged`.
    """
    data = LevelData.of(table)
    mean: PriorMean | None = None
    if prior is not None:
        if prior.image_size != table.image_size or not math.isclose(prior.pixel_aspect, table.pixel_aspect):
            raise InvalidInput("prior table", prior.image_size, f"is of other pictures than {table.image_size}")
        mean = prior.quantities
    _require_consistent(data)
    dropped: dict[int, tuple[LevelMisfit, float, str]] = {}
    if reject and len(data) >= FEWEST_TO_JUDGE:
        dropped = find_outliers(data, mean)
    kept = [i for i in range(len(data)) if i not in dropped]
    used = data.only(kept)
    _require_forward(used)
    model = LensModel.fit(used, mean)
    surface = LensSurface.compile(model)
    return SurfaceFit(surface, _checks(table, data, model, kept, dropped), _held_out(model))


def find_outliers(data: LevelData, prior: PriorMean | None) -> dict[int, tuple[LevelMisfit, float, str]]:
    """The levels that do not fit their neighbours: place in ``data`` -> (misfit, chance, explanation)."""
    dropped: dict[int, tuple[LevelMisfit, float, str]] = {}
    most = int(_MOST_LEFT_OUT * len(data))
    while len(dropped) < most:
        kept = [i for i in range(len(data)) if i not in dropped]
        model = LensModel.fit(data.only(kept), prior)
        ratios = [m.error_px / max(m.expected_px, 1e-9) for m in model.misfits]
        suspects = np.argsort(ratios)[::-1][:_SUSPECTS]
        worst: tuple[float, int, LensModel, LevelMisfit] | None = None
        for place in suspects:
            level = kept[int(place)]
            # The smoothness is learned again without it: with it, a wrong level makes every lens look rough.
            others = LensModel.fit(data.only([i for i in kept if i != level]), prior)
            found = against(others, data, level)
            chance = chance_of(found, others.spare)
            if worst is None or chance < worst[0]:
                worst = (chance, level, others, found)
        needed = REJECTED_CHANCE / len(data) * _RARER ** len(dropped)
        if worst is None or worst[0] >= needed or worst[3].error_px < HARMLESS_PX:
            return dropped
        chance, level, others, found = worst
        dropped[level] = (found, chance, _explain(others, data, level, found))
    return dropped


def against(model: LensModel, data: LevelData, level: int) -> LevelMisfit:
    """A level of ``data`` against a model that has not seen it."""
    place = (data.zoom[level : level + 1], data.focus[level : level + 1])
    covariance = model.covariance(*place)[0] + data.covariance[level]
    return misfit(data.values[level] - model.mean(*place)[0], covariance, data.values[level], data.image_size)


def chance_of(found: LevelMisfit, spare: int) -> float:
    """Chance of a larger misfit against a surface whose smoothness was learned from ``spare`` degrees of freedom."""
    size = len(QUANTITIES)
    chi2 = float(found.residual @ np.linalg.solve(found.covariance, found.residual))
    return float(stats.f.sf(chi2 / size, size, max(spare, 1)))


def _require_consistent(data: LevelData) -> None:
    for a in range(len(data)):
        for b in range(a + 1, len(data)):
            same = (
                abs(data.zoom[a] - data.zoom[b]) < _SAME_PLACE[0]
                and abs(data.focus[a] - data.focus[b]) < (_SAME_PLACE[1])
            )
            if not same:
                continue
            found = misfit(
                data.values[a] - data.values[b],
                data.covariance[a] + data.covariance[b],
                data.values[a],
                data.image_size,
            )
            if found.error_px > max(_CONTRADICTION_PX, _CONTRADICTION_SIGMA * found.expected_px):
                raise InvalidInput(
                    "levels",
                    ((float(data.zoom[a]), float(data.focus[a])), (float(data.zoom[b]), float(data.focus[b]))),
                    f"stand at one place and differ by {found.error_px:.1f} px: remove the wrong one",
                )


def _require_forward(data: LevelData) -> None:
    """Refuse a lens whose focal length shrinks as its zoom encoder grows."""
    order = np.argsort(data.zoom, kind="stable")
    zoom, log_f = data.zoom[order], data.values[order, 0]
    if zoom[-1] - zoom[0] < _SAME_PLACE[0]:
        return
    slope = float(np.polyfit(zoom, log_f, 1)[0])
    sigma = float(np.sqrt(np.max(data.covariance[:, 0, 0])))
    if slope < 0 and log_f[0] - log_f[-1] > max(0.02, 5 * sigma):
        raise InvalidInput(
            "levels",
            f"zoom {zoom[0]:g} to {zoom[-1]:g}",
            "the focal length falls from wide to tele: the zoom encoder runs backwards (0 must be wide, 1 tele)",
        )


def _explain(model: LensModel, data: LevelData, level: int, found: LevelMisfit) -> str:
    """What is wrong with a level, for the operator."""
    zoom, focus = float(data.zoom[level]), float(data.focus[level])
    told = f"{found.error_px:.1f} px from where its neighbours put it (expected {found.expected_px:.1f} px)"

    def misfit_at(zooms: FloatArray) -> FloatArray:
        places = (zooms, np.full(len(zooms), focus))
        covariances = model.covariance(*places) + data.covariance[level]
        rest = data.values[level] - model.mean(*places)
        return np.asarray(np.einsum("ni,ni->n", rest, np.linalg.solve(covariances, rest[..., None])[..., 0]))

    along = np.linspace(float(data.zoom.min()), float(data.zoom.max()), 201)
    near = along[max(int(np.argmin(misfit_at(along))) - 1, 0)]
    best = optimize.minimize_scalar(
        lambda place: float(misfit_at(np.array([place]))[0]),
        bounds=(near, min(near + 2 * (along[1] - along[0]), float(along[-1]))),
        method="bounded",
        options={"xatol": 1e-6},
    )
    size = len(QUANTITIES)
    if stats.f.sf(best.fun / size, size, max(model.spare, 1)) > _ARRIVED and abs(best.x - zoom) > _ELSEWHERE:
        return f"{told}: it fits at zoom {best.x:.3f}; the lens had not arrived, or its encoder slipped"
    spread = np.sqrt(np.diag(found.covariance))
    quantity = int(np.argmax(np.abs(found.residual) / spread))
    value, sigmas = float(found.residual[quantity]), abs(float(found.residual[quantity])) / float(spread[quantity])
    if quantity == 0:
        what = f"its focal length is {math.expm1(value):+.2%} off"
    elif quantity < 3:
        what = f"its {QUANTITIES[quantity]} is {value:+.4f} off"
    else:
        what = f"its centre shift {'x' if quantity == 3 else 'y'} is {value:+.1f} px off"
    return f"{told}: {what} ({sigmas:.0f} sigma)"


def _checks(
    table: LensTable,
    data: LevelData,
    model: LensModel,
    kept: Sequence[int],
    dropped: dict[int, tuple[LevelMisfit, float, str]],
) -> tuple[LevelCheck, ...]:
    at = {data.index[place]: place for place in range(len(data))}
    in_model = {place: i for i, place in enumerate(kept)}
    checks = []
    for index, level in enumerate(table.levels):
        place = at.get(index)
        if place is None:
            checks.append(LevelCheck(level.zoom, level.focus, False, reason=f"has no lens: {level.reason}"))
        elif place in dropped:
            found, chance, reason = dropped[place]
            checks.append(LevelCheck(level.zoom, level.focus, False, found.error_px, found.expected_px, chance, reason))
        elif not model.misfits:
            checks.append(LevelCheck(level.zoom, level.focus, True, reason="too few levels to compare with"))
        else:
            found = model.misfits[in_model[place]]
            chance = chance_of(found, model.spare)
            checks.append(LevelCheck(level.zoom, level.focus, True, found.error_px, found.expected_px, chance))
    return tuple(checks)


def _held_out(model: LensModel) -> PixelError | None:
    if not model.misfits:
        return None
    errors: FloatArray = np.array([found.error_px for found in model.misfits])
    return PixelError(float(np.sqrt(np.mean(errors**2))), float(np.max(errors)))
