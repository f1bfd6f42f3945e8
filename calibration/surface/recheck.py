"""A stored lens checked again at a few levels: does it hold, does a remount explain what changed, or is it another one?

A remounted lens keeps its optics. Its axis moves on the sensor, by the same d pixels everywhere, and the encoders read
other numbers for the same ring positions. With S the stored surface and m the quantities measured at encoder values
(z, f), a remount says

    m = S(z - dz, f - df) + (0, 0, 0, dx, dy),

solved for (dx, dy), dz and df by generalised least squares over all levels, weighted by the covariances of level and
surface (taken as independent from level to level). Few parameters are tried first. An explanation is taken only if what
it leaves is noise (chi^2), stays within the goal, and each of its parameters is there for certain; so a lens that has
changed in itself is never corrected.

Covariances tell noise. A surface is besides off by :data:`FLOOR_PX` in ways that no noise tells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy import stats

from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.surface.evaluate import LensSurface
from calibration.surface.quantities import (
    QUANTITIES,
    LevelData,
    frame_rays,
    lens_of,
    overlay_of,
    picture_jacobian,
)
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, Provenance
from calibration.types import FloatArray

GOAL_PX = 1.0
"""Overlay error up to which a stored lens holds."""

AGREEING_SIGMAS = 3.0
"""A level agrees with the stored lens, and a correction is certain, at this many standard deviations."""

FLOOR_PX = 0.05
"""RMS error over the frame that levels and surfaces have beyond what their covariances tell."""

MISFIT_CHANCE = 0.001
"""Chance of a larger misfit under which an explanation is refused."""

MOST_SHIFT, MOST_ZOOM, MOST_FOCUS = 0.025, 0.1, 0.25
"""Largest remount: centre shift in picture widths, offsets of the encoders; what is larger is another mistake."""

_STARTS = 21
# Offsets of the zoom encoder tried first, so that the nearest hollow is not taken for the deepest.
_STEP = 1e-4
# Of derivatives over zoom and focus.
_MOST_STEPS, _MOST_HALVINGS, _ARRIVED = 30, 12, 1e-6
# Of the descent; it has arrived where a step lowers chi^2 by less.
_LEAST_TOLD = 1.0
# Information under which an offset up to the largest remount would not be seen at all.
_INSIDE = 0.99
_HOPELESS = 4.0
_SHIFT, _ZOOM, _FOCUS = (0, 1), (2,), (3,)
_EXPLANATIONS = ((_SHIFT,), (_ZOOM,), (_FOCUS,), (_SHIFT, _ZOOM), (_SHIFT, _FOCUS), (_ZOOM, _FOCUS))
_LAST = (_SHIFT, _ZOOM, _FOCUS)
_INSET = 0.03
# Share of the range by which checked places stay off its ends: there an offset of the encoder has something to show.
_SLIP = 0.001
# Encoder error whose cost in px counts beside the surface's own uncertainty where the middle place is chosen.


class Verdict(StrEnum):
    """What a re-check says."""

    HOLDS = "holds"
    CORRECTED = "corrected"
    CHANGED = "changed"


@dataclass(frozen=True, slots=True)
class Remount:
    """What a remount moved, each with its standard deviation; None: not needed to explain what was measured.

    ``center_shift_px``: new minus stored principal point. ``zoom_offset``, ``focus_offset``: new minus stored encoder
    value of the same ring position.
    """

    center_shift_px: tuple[float, float] | None = None
    center_shift_sigma_px: tuple[float, float] | None = None
    zoom_offset: float | None = None
    zoom_offset_sigma: float | None = None
    focus_offset: float | None = None
    focus_offset_sigma: float | None = None

    def __str__(self) -> str:
        told = []
        if self.center_shift_px is not None:
            told.append(f"centre shift {self.center_shift_px[0]:+.2f}, {self.center_shift_px[1]:+.2f} px")
        if self.zoom_offset is not None:
            told.append(f"zoom encoder {self.zoom_offset:+.4f}")
        if self.focus_offset is not None:
            told.append(f"focus encoder {self.focus_offset:+.4f}")
        return ", ".join(told) or "nothing moved"


@dataclass(frozen=True, slots=True)
class LevelAgreement:
    """A measured level against the stored lens: largest overlay error over the frame (px), its standard deviation, and
    what is left of it after the correction (None without one)."""

    zoom: float
    focus: float
    error_px: float
    expected_px: float
    left_px: float | None = None


@dataclass(frozen=True, slots=True)
class Recheck:
    """How a stored lens stands. ``error_px``, ``left_px``: worst of all levels, before and after the correction (None
    without one); ``remount``: None without a correction; ``reason``: one line."""

    verdict: Verdict
    goal_px: float
    error_px: float
    left_px: float | None
    levels: tuple[LevelAgreement, ...]
    remount: Remount | None
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """Parameters (4,) dx, dy, dz, df with their covariance (unused ones 0), and what they leave."""

    parts: tuple[tuple[int, ...], ...]
    values: FloatArray
    covariance: FloatArray
    chi2: float
    chance: float
    left_px: FloatArray
    certain: bool
    inside: bool


def recheck(surface: LensSurface, levels: LevelData, *, goal_px: float = GOAL_PX) -> Recheck:
    """Levels measured again, against the stored lens. Outside the surface's range its nearest place holds.

    Raises :class:`InvalidInput` for levels of another picture, or a goal that is no positive number.
    """
    if levels.image_size != surface.image_size or not math.isclose(levels.pixel_aspect, surface.pixel_aspect):
        raise InvalidInput("levels", levels.image_size, f"are of other pictures than the table ({surface.image_size})")
    if not (math.isfinite(goal_px) and goal_px > 0):
        raise InvalidInput("goal_px", goal_px, "must be a positive number of px")
    check = _Check(surface, levels)
    nothing = np.zeros(4)
    error = check.overlay_px(nothing)
    noise = check.expected_px()
    agreements = tuple(
        LevelAgreement(float(z), float(f), float(e), float(s))
        for z, f, e, s in zip(levels.zoom, levels.focus, error, noise, strict=True)
    )
    worst = float(error.max())
    if np.all((error <= goal_px) | (error <= AGREEING_SIGMAS * noise)):
        within = "" if worst <= goal_px else f", which their noise ({float(noise.max()):.2f} px, one sigma) allows"
        reason = f"the stored lens is at most {worst:.2f} px off at {len(levels)} levels{within}"
        return Recheck(Verdict.HOLDS, goal_px, worst, None, agreements, None, reason)
    candidates = _candidates(surface)
    # The fewer the parameters, the larger the misfit: where that of all of them is hopeless, none needs to be tried.
    most = check.explain(candidates[-1])
    hopeless = most.chi2 > _HOPELESS * stats.chi2.isf(MISFIT_CHANCE, len(QUANTITIES) * len(levels))
    for parts in () if hopeless else candidates:
        found = most if parts == candidates[-1] else check.explain(parts)
        if found.certain and found.inside and found.chance >= MISFIT_CHANCE and np.all(found.left_px <= goal_px):
            left = tuple(replace(a, left_px=float(px)) for a, px in zip(agreements, found.left_px, strict=True))
            remount, left_px = _remount(found), float(found.left_px.max())
            reason = f"a remount explains {worst:.2f} px: {remount}; {left_px:.2f} px are left"
            return Recheck(Verdict.CORRECTED, goal_px, worst, left_px, left, remount, reason)
    place = agreements[int(np.argmax(error))]
    reason = (
        f"the stored lens is {worst:.2f} px off at zoom {place.zoom:g}, focus {place.focus:g} (expected "
        f"{place.expected_px:.2f} px), and no remount explains it: calibrate the lens again"
    )
    return Recheck(Verdict.CHANGED, goal_px, worst, None, agreements, None, reason)


def check_places(surface: LensSurface) -> tuple[tuple[float, float], ...]:
    """Where to check a stored lens, (zoom, focus): near both ends of the zoom and where the lens is known least or
    changes fastest between, at the middle focus; of a lens that does not zoom, near both ends of the focus."""
    (wide, tele), (far, near) = surface.zoom_range, surface.focus_range
    middle = (far + near) / 2
    if tele <= wide:
        ends = sorted({far + _INSET * (near - far), near - _INSET * (near - far)})
        return tuple((wide, focus) for focus in ends)
    along = np.linspace(wide + 0.25 * (tele - wide), tele - 0.25 * (tele - wide), 101)
    at = np.full(len(along), middle)
    mean = surface.quantities(along, at)
    slope = (surface.quantities(along + _STEP, at) - surface.quantities(along - _STEP, at)) / (2 * _STEP)
    rays = frame_rays(lens_of([*mean[len(mean) // 2, :3], 0.0, 0.0], surface.image_size, 1.0))
    jacobian = picture_jacobian(mean[:, 1], mean[:, 2], rays, surface.image_size)
    moved = np.linalg.norm(np.einsum("mnij,mj->mni", jacobian, slope * _SLIP), axis=-1).max(axis=1)
    score = np.hypot(moved, surface.at_many(along, at).predicted_max_px)
    zooms = (wide + _INSET * (tele - wide), float(along[int(np.argmax(score))]), tele - _INSET * (tele - wide))
    return tuple((round(zoom, 4), round(middle, 4)) for zoom in zooms)


def corrected_table(
    table: LensTable, surface: LensSurface, found: Recheck, *, software: str, parent_sha256: str, job_id: str | None
) -> LensTable:
    """The stored table as the remount that was found makes it: its encoder values and centre shifts moved.

    A level whose encoder value would leave 0..1 cannot be driven to any more: the lens at that border, read off the
    surface, stands there instead (one for all such levels). The sigma of the correction is added to that of the centre
    shift. Raises :class:`InvalidInput` where nothing was corrected.
    """
    remount = found.remount
    if remount is None:
        raise InvalidInput("verdict", str(found.verdict), "has no correction to apply")
    shift, sigma = remount.center_shift_px or (0.0, 0.0), remount.center_shift_sigma_px or (0.0, 0.0)
    offsets = (remount.zoom_offset or 0.0, remount.focus_offset or 0.0)
    levels: dict[tuple[float, float], LevelResult] = {}
    borders: dict[tuple[float, float], LevelResult] = {}
    for level in table.levels:
        zoom, focus = level.zoom + offsets[0], level.focus + offsets[1]
        place = (min(max(zoom, 0.0), 1.0), min(max(focus, 0.0), 1.0))
        if place == (zoom, focus):
            levels[place] = _moved(level, place, shift, sigma)
        elif level.fov_x_deg is not None and place not in borders:
            borders[place] = _moved(_at_border(surface, place, offsets), place, shift, sigma)
    everything = {**borders, **levels}
    note = f"corrected by a re-check: {remount}; {found.error_px:.2f} px before, {found.left_px or 0.0:.2f} px after"
    return replace(
        table,
        levels=tuple(everything[place] for place in sorted(everything)),
        provenance=Provenance("corrected", software, job_id=job_id, parent_sha256=parent_sha256, note=note),
    )


def _at_border(surface: LensSurface, place: tuple[float, float], offsets: tuple[float, float]) -> LevelResult:
    at = surface.at(place[0] - offsets[0], place[1] - offsets[1])
    why = "read off the stored surface at the encoder's end, not measured"
    reasons = {name: why for name in EVIDENCE_QUANTITIES if name != "predicted_overlay_px"}
    if not at.nodal_told:
        reasons["nodal_offset_mm"] = "no level of the table tells it"
    return LevelResult.from_lens(*place, at.lens, reasons=reasons, sigma=at.sigma, predicted_overlay_px=at.predicted_px)


def _moved(
    level: LevelResult, place: tuple[float, float], shift: tuple[float, float], sigma: tuple[float, float]
) -> LevelResult:
    changes: dict[str, object] = {"zoom": place[0], "focus": place[1]}
    if level.center_shift_px is not None and shift != (0.0, 0.0):
        changes["center_shift_px"] = _sum(level.center_shift_px, shift)
        known = level.sigma.center_shift_px
        if known is not None:
            wider = (math.hypot(known[0], sigma[0]), math.hypot(known[1], sigma[1]))
            changes["sigma"] = replace(level.sigma, center_shift_px=wider)
        told = level.engine_values
        if told is not None:
            changes["engine_values"] = replace(told, center_shift_px=_sum(told.center_shift_px, shift))
    return replace(level, **changes)  # type: ignore[arg-type]


def _sum(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    return (first[0] + second[0], first[1] + second[1])


def _candidates(surface: LensSurface) -> list[tuple[tuple[int, ...], ...]]:
    """Explanations, the simplest first; offsets only of encoders along which the stored lens changes."""
    still: set[tuple[int, ...]] = set()
    if surface.zoom_range[0] == surface.zoom_range[1]:
        still.add(_ZOOM)
    if surface.focus_range[0] == surface.focus_range[1]:
        still.add(_FOCUS)
    return [parts for parts in (*_EXPLANATIONS, _LAST) if not still & set(parts)]


def _remount(found: _Explanation) -> Remount:
    dx, dy, dz, df = found.values.tolist()
    sx, sy, sz, sf = np.sqrt(np.diag(found.covariance)).tolist()
    shift, zoom, focus = (part in found.parts for part in (_SHIFT, _ZOOM, _FOCUS))
    return Remount(
        (dx, dy) if shift else None,
        (sx, sy) if shift else None,
        dz if zoom else None,
        sz if zoom else None,
        df if focus else None,
        sf if focus else None,
    )


class _Check:
    """The levels beside the surface, and the solution for a remount."""

    def __init__(self, surface: LensSurface, levels: LevelData) -> None:
        self._surface = surface
        self._levels = levels
        # Where each level puts the frame's rays is linear in the quantities about the level's own lens.
        lenses = [lens_of(row.tolist(), levels.image_size, 1.0) for row in levels.values]
        self._jacobians = [_jacobian(lens) for lens in lenses]
        self._floor = np.array([_floor(jacobian) for jacobian in self._jacobians])
        self._most = np.array([*[MOST_SHIFT * levels.image_size[0]] * 2, MOST_ZOOM, MOST_FOCUS])

    def _places(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        return (
            np.clip(self._levels.zoom - values[2], *self._surface.zoom_range),
            np.clip(self._levels.focus - values[3], *self._surface.focus_range),
        )

    def residuals(self, values: FloatArray) -> FloatArray:
        """Measured minus stored quantities (n, 5) under a remount (4,)."""
        stored = self._surface.quantities(*self._places(values))
        stored[:, 3:] += values[:2]
        return np.asarray(self._levels.values - stored)

    def covariances(self, values: FloatArray) -> FloatArray:
        """Covariance (n, 5, 5) of the residuals."""
        return np.asarray(self._surface.model.covariance(*self._places(values)) + self._levels.covariance + self._floor)

    def overlay_px(self, values: FloatArray) -> FloatArray:
        """Largest overlay error over the frame, (n,)."""
        rest = self.residuals(values)
        pairs = zip(self._jacobians, rest, strict=True)
        return np.array([float(np.linalg.norm(jacobian @ row, axis=-1).max()) for jacobian, row in pairs])

    def expected_px(self) -> FloatArray:
        """Its standard deviation (n,) for a lens that holds."""
        pairs = zip(self._jacobians, self.covariances(np.zeros(4)), strict=True)
        return np.array([float(overlay_of(cov[None], jacobian[None])[1][0]) for jacobian, cov in pairs])

    def explain(self, parts: tuple[tuple[int, ...], ...]) -> _Explanation:
        """The remount of these parameters that explains the levels best: Gauss-Newton within the largest remount."""
        used = [index for part in parts for index in part]
        most = self._most[used]
        values = self._start(used)
        cost, normal = math.inf, np.zeros((len(used), len(used)))
        for _ in range(2):
            # Weights at the place found before, so that the sum minimised is of one set of weights.
            weights = np.asarray(np.linalg.inv(self.covariances(values)), dtype=np.float64)
            values, cost, normal = self._descend(values, used, weights)
        scaled = normal * np.outer(most, most)
        known = bool(np.linalg.eigvalsh(scaled)[0] > _LEAST_TOLD)
        covariance = np.zeros((4, 4))
        if known:
            covariance[np.ix_(used, used)] = np.linalg.inv(scaled) * np.outer(most, most)
        freedom = len(QUANTITIES) * len(self._levels) - len(used)
        return _Explanation(
            parts,
            values,
            covariance,
            cost,
            float(stats.chi2.sf(cost, freedom)),
            self.overlay_px(values),
            known and all(_is_certain(values, covariance, part) for part in parts),
            bool(np.all(np.abs(values[used]) < _INSIDE * most)),
        )

    def _descend(
        self, values: FloatArray, used: list[int], weights: FloatArray
    ) -> tuple[FloatArray, float, FloatArray]:
        """(parameters (4,), chi^2, normal matrix) at the bottom of the hollow that ``values`` lies in."""
        cost = _cost(self.residuals(values), weights)
        for _ in range(_MOST_STEPS):
            rest, slope = self.residuals(values), self._slopes(values)[..., used]
            normal = np.einsum("nip,nij,njq->pq", slope, weights, slope)
            step = _whole(np.linalg.lstsq(normal, np.einsum("nip,nij,nj->p", slope, weights, rest))[0], used)
            for _ in range(_MOST_HALVINGS):
                tried = np.clip(values + step, -self._most, self._most)
                lower = _cost(self.residuals(tried), weights)
                if lower <= cost:
                    break
                step = step / 2
            else:
                break
            gained, values, cost = cost - lower, tried, lower
            if gained < _ARRIVED:
                break
        slope = self._slopes(values)[..., used]
        return values, cost, np.einsum("nip,nij,njq->pq", slope, weights, slope)

    def _slopes(self, values: FloatArray) -> FloatArray:
        """d(stored quantities)/d(parameters), (n, 5, 4)."""
        slopes = np.zeros((len(self._levels), len(QUANTITIES), 4))
        slopes[:, 3, 0] = slopes[:, 4, 1] = 1.0
        for index in (2, 3):
            step = np.eye(4)[index] * _STEP
            slopes[..., index] = (self.residuals(values - step) - self.residuals(values + step)) / (2 * _STEP)
        return slopes

    def _start(self, used: list[int]) -> FloatArray:
        """The best of a few zoom offsets, each with the centre shift that suits it."""
        weights = np.asarray(np.linalg.inv(self.covariances(np.zeros(4))), dtype=np.float64)
        best, least = np.zeros(4), math.inf
        for zoom in np.linspace(-0.9, 0.9, _STARTS) * MOST_ZOOM if 2 in used else (0.0,):
            values = np.array([0.0, 0.0, float(zoom), 0.0])
            if 0 in used:
                shift = np.median(self.residuals(values)[:, 3:], axis=0)
                values[:2] = np.clip(shift, -0.9 * self._most[:2], 0.9 * self._most[:2])
            cost = _cost(self.residuals(values), weights)
            if cost < least:
                best, least = values, cost
        return best


def _cost(rest: FloatArray, weights: FloatArray) -> float:
    return float(np.einsum("ni,nij,nj->", rest, weights, rest))


def _whole(some: FloatArray, used: list[int]) -> FloatArray:
    full = np.zeros(4)
    full[used] = some
    return full


def _is_certain(values: FloatArray, covariance: FloatArray, part: tuple[int, ...]) -> bool:
    """Whether a correction differs from none by more than :data:`AGREEING_SIGMAS`; a shift counts as one correction."""
    some, block = values[list(part)], covariance[np.ix_(part, part)]
    chance = stats.chi2.sf(float(some @ np.linalg.solve(block, some)), len(part))
    return bool(chance < stats.chi2.sf(AGREEING_SIGMAS**2, 1))


def _jacobian(lens: Lens) -> FloatArray:
    rays = frame_rays(lens)
    jacobian = picture_jacobian(np.array([lens.k1_hw]), np.array([lens.k2_hw]), rays, lens.image_size)
    return np.asarray(jacobian[0])


def _floor(jacobian: FloatArray) -> FloatArray:
    """Covariance (5, 5) of an error of :data:`FLOOR_PX` RMS, spread as evenly over the frame as the lens model can."""
    even = np.linalg.inv(np.einsum("nij,nik->jk", jacobian, jacobian))
    return np.asarray(even * (FLOOR_PX**2 / overlay_of(even[None], jacobian[None])[0][0] ** 2))
