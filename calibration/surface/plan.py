"""Which levels of a lens to measure: where the overlay error between levels is expected to be worst, until it is small.

An ask/tell object. The first levels stand evenly over the zoom range, its ends among them. Then, with the surface
through all levels told so far:

* along zoom, each gap between neighbouring levels has its largest expected error E; m levels put into it leave about
  E (m + 1)^-1.5 (a lens rougher than the surface's own kind falls no faster), so further levels are shared out one by
  one to the gap that is worst after those it has, and a gap's levels are spread evenly in it. With few levels it is
  little known where the lens is rough; until more are told, the gaps' errors count only in part and their widths for
  the rest.
* with a focus range, one level after the other goes to the worst place of a grid, each counted as measured for the
  choice of the next.

About half of what is left is asked for at a time, ordered so that the lens moves little. Each new level is first
compared with the surface that had not seen it. The plan ends when the wanted accuracy is both expected everywhere and
was met at the levels of the last batch, or when levels or time are used up. A level that its neighbours contradict is
asked for once more.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError, InvalidInput
from calibration.surface.fit import FEWEST_TO_JUDGE, against, find_outliers
from calibration.surface.model import LensModel, PriorMean
from calibration.surface.quantities import LevelData
from calibration.tables import LevelResult
from calibration.types import FloatArray

Place = tuple[float, float]
"""Encoder values (zoom, focus)."""

_FALL = 1.5
_SHARE = 0.5
_TRUST_LEVELS = 8.0
# Levels after which the gaps' own errors count by half more than before.
_GRID = 201
_FOCUS_GRID = 5
_ZOOM_GRID = 33
_NARROWEST = 0.012
# Levels nearer than this along zoom tell nothing new: 50 counts of a 12-bit encoder.
_DIGITS = 4


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """What a plan may cost and what it is for.

    ``accuracy_px``: largest overlay error wanted between levels, None: as good as the levels allow; ``max_levels``,
    ``max_seconds`` (of measuring; None: no limit); ``zoom_range``; ``focus_range`` (low, high), equal: one focus;
    ``first_levels``: evenly over zoom before anything is known, fewer with a prior.
    """

    accuracy_px: float | None = 1.0
    max_levels: int = 13
    max_seconds: float | None = None
    zoom_range: tuple[float, float] = (0.0, 1.0)
    focus_range: tuple[float, float] = (0.5, 0.5)
    first_levels: int = 5

    def __post_init__(self) -> None:
        if self.accuracy_px is not None and not self.accuracy_px > 0:
            raise InvalidInput("accuracy_px", self.accuracy_px, "must be a positive number")
        if self.max_levels < 2:
            raise InvalidInput("max_levels", self.max_levels, "a zoom range needs at least its two ends")
        if self.first_levels < 2:
            raise InvalidInput("first_levels", self.first_levels, "must be at least 2")
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise InvalidInput("max_seconds", self.max_seconds, "must be a positive number")
        for name in ("zoom_range", "focus_range"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high)) or low > high or (name == "zoom_range" and low == high):
                raise InvalidInput(name, (low, high), "must be two encoder values, the lower one first")


@dataclass(frozen=True, slots=True)
class PlanStep:
    """What one batch showed. ``levels`` told so far; ``predicted_px``: the largest expected error between levels;
    ``held_out_px``: the largest error at the batch's levels of the surface before it, None for the first batch."""

    levels: int
    predicted_px: float
    held_out_px: float | None


class AdaptivePlan:
    """See the module. ``prior``: the surface of another lens of the same type."""

    def __init__(
        self,
        options: PlanOptions,
        image_size: tuple[int, int],
        pixel_aspect: float = 1.0,
        prior: PriorMean | None = None,
    ) -> None:
        self._options = options
        self._picture = (image_size, pixel_aspect)
        self._prior = prior
        self._told: dict[Place, LevelResult] = {}
        self._asked: list[Place] = []
        self._again: set[Place] = set()
        self._model: LensModel | None = None
        self._batch: list[Place] = []
        self.steps: list[PlanStep] = []
        self.reason: str | None = None

    def ask(self) -> list[Place]:
        """The levels to measure next, in this order; empty: the plan is done and ``reason`` says why."""
        if self.reason is not None:
            return []
        if not self._asked:
            return self._give(self._first())
        try:
            return self._give(self._further())
        except CalibrationError as error:
            self.reason = f"the levels make no surface: {error}"
            return []

    def tell(self, result: LevelResult) -> None:
        """What came of a level that was asked for; of one that was asked for again, the later counts."""
        place = (result.zoom, result.focus)
        if place in self._told and result.fov_x_deg is None:
            return
        self._told[place] = result

    def _give(self, places: Sequence[Place]) -> list[Place]:
        ordered = in_order(places)
        self._asked += ordered
        self._batch = ordered
        return ordered

    def _first(self) -> list[Place]:
        options = self._options
        low, high = options.focus_range
        count = min(options.first_levels if self._prior is None else 3, options.max_levels)
        zooms = np.linspace(*options.zoom_range, count).round(_DIGITS).tolist()
        middle = round((low + high) / 2, _DIGITS)
        places = [(zoom, middle) for zoom in zooms]
        if high > low:
            places += [(zoom, focus) for zoom in options.zoom_range for focus in (low, high)]
        return places[: options.max_levels]

    def _further(self) -> list[Place]:
        options = self._options
        measured = [result for result in self._told.values() if result.fov_x_deg is not None]
        if not measured:
            self.reason = "no level could be measured"
            return []
        data = LevelData.of_levels(measured, *self._picture)
        held_out = self._held_out(data)
        if again := self._suspects(data):
            return again
        self._model = LensModel.fit(data, self._prior)
        zoom, focus = self._grid()
        predicted = self._model.predicted_px(zoom, focus)[1]
        self.steps.append(PlanStep(len(data), float(predicted.max()), held_out))
        left = options.max_levels - len({*self._asked})
        if self._reached(held_out, float(predicted.max())) or self._used_up(left):
            return []
        # A few are needed at once, so that their order saves moves; not all, so that what they show still counts.
        places = self._along_zoom(predicted, left) if self._one_focus else self._by_place(data, left)
        if not places:
            self.reason = f"no place is left to measure between the levels (expected {predicted.max():.2f} px)"
        return places

    @property
    def _one_focus(self) -> bool:
        low, high = self._options.focus_range
        return low == high

    def _grid(self) -> tuple[FloatArray, FloatArray]:
        low, high = self._options.focus_range
        if self._one_focus:
            zoom = np.linspace(*self._options.zoom_range, _GRID)
            return zoom, np.full(_GRID, low)
        zooms, focuses = np.meshgrid(
            np.linspace(*self._options.zoom_range, _ZOOM_GRID), np.linspace(low, high, _FOCUS_GRID), indexing="ij"
        )
        return zooms.ravel(), focuses.ravel()

    def _held_out(self, data: LevelData) -> float | None:
        """The largest error of the surface before the last batch at that batch's levels."""
        if self._model is None:
            return None
        new = [i for i in range(len(data)) if (float(data.zoom[i]), float(data.focus[i])) in self._batch]
        return max((against(self._model, data, i).error_px for i in new), default=None)

    def _suspects(self, data: LevelData) -> list[Place]:
        if len(data) < FEWEST_TO_JUDGE:
            return []
        found = find_outliers(data, self._prior)
        places = [(float(data.zoom[i]), float(data.focus[i])) for i in found]
        again = [place for place in places if place not in self._again]
        self._again |= {*again}
        return again

    def _reached(self, held_out: float | None, predicted: float) -> bool:
        wanted = self._options.accuracy_px
        if wanted is None or held_out is None or predicted > wanted or held_out > wanted:
            return False
        self.reason = (
            f"{wanted:g} px between levels is reached: {predicted:.2f} px expected at most, {held_out:.2f} px off at "
            "the last levels before they were used"
        )
        return True

    def _used_up(self, left: int) -> bool:
        options = self._options
        expected = self.steps[-1].predicted_px
        spent = sum(result.seconds or 0.0 for result in self._told.values())
        each = spent / max(len(self._told), 1)
        if left <= 0:
            self.reason = f"{options.max_levels} levels are measured; {expected:.2f} px expected between them"
        elif options.max_seconds is not None and spent + each > options.max_seconds:
            self.reason = f"the time is used up ({spent:.0f} s); {expected:.2f} px expected between levels"
        return self.reason is not None

    def _along_zoom(self, predicted: FloatArray, left: int) -> list[Place]:
        focus = self._options.focus_range[0]
        grid = self._grid()[0]
        low, high = self._options.zoom_range
        known = np.unique(np.array([low, high, *(zoom for zoom, _ in self._asked)]))
        errors, widths = np.zeros(len(known) - 1), np.diff(known)
        for i, (a, b) in enumerate(itertools.pairwise(known.tolist())):
            if b - a > _NARROWEST:
                errors[i] = predicted[(grid >= a) & (grid <= b)].max(initial=0.0)
        if not errors.any():
            return []
        errors = _tempered(errors, widths, len(known))
        shares = np.zeros(len(errors), dtype=int)
        wanted = self._options.accuracy_px or 0.0
        for _ in range(left):
            after = errors * (shares + 1.0) ** -_FALL
            worst = int(np.argmax(after))
            if after[worst] <= wanted and shares.any():
                break
            shares[worst] += 1
        most = max(1, math.ceil(float(shares.sum()) * _SHARE))
        places: list[Place] = []
        for i in np.argsort(-errors, kind="stable"):
            if shares[i] == 0 or len(places) >= most:
                continue
            inside = known[i] + widths[i] * np.arange(1, shares[i] + 1) / (shares[i] + 1)
            places += [(float(zoom), focus) for zoom in inside.round(_DIGITS)]
        return places[:left]

    def _by_place(self, data: LevelData, left: int) -> list[Place]:
        zoom, focus = self._grid()
        free = np.array([(z, t) not in self._asked for z, t in zip(zoom.tolist(), focus.tolist(), strict=True)])
        wanted = self._options.accuracy_px or 0.0
        places: list[Place] = []
        for _ in range(max(1, math.ceil(left * _SHARE / 2))):
            model = LensModel.fit(data, self._prior)
            predicted = np.where(free, model.predicted_px(zoom, focus)[1], 0.0)
            worst = int(np.argmax(predicted))
            if predicted[worst] == 0.0 or (places and predicted[worst] <= wanted):
                break
            free[worst] = False
            places.append((round(float(zoom[worst]), _DIGITS), round(float(focus[worst]), _DIGITS)))
            data = _with(data, model, zoom[worst : worst + 1], focus[worst : worst + 1])
        return places


def in_order(places: Sequence[Place]) -> list[Place]:
    """Zoom by zoom, the focuses there and back again, so that the lens travels little."""
    by_zoom: dict[float, list[float]] = {}
    for zoom, focus in places:
        by_zoom.setdefault(zoom, []).append(focus)
    ordered: list[Place] = []
    for index, zoom in enumerate(sorted(by_zoom)):
        ordered += [(zoom, focus) for focus in sorted(by_zoom[zoom], reverse=index % 2 == 1)]
    return ordered


def _tempered(errors: FloatArray, widths: FloatArray, levels: int) -> FloatArray:
    """The gaps' errors drawn towards those of a lens equally rough everywhere, the more the fewer the levels."""
    open_gaps = errors > 0
    rate = widths**_FALL
    even = math.exp(float(np.mean(np.log(errors[open_gaps] / rate[open_gaps])))) * rate
    doubt = 0.5 ** (levels / _TRUST_LEVELS)
    return np.where(open_gaps, np.maximum(errors, 1e-12) ** (1 - doubt) * even**doubt, 0.0)


def _with(data: LevelData, model: LensModel, zoom: FloatArray, focus: FloatArray) -> LevelData:
    """The data with one place more, as if measured just where the model has it."""
    return replace(
        data,
        index=(*data.index, max(data.index) + 1),
        zoom=np.append(data.zoom, zoom),
        focus=np.append(data.focus, focus),
        values=np.vstack([data.values, model.mean(zoom, focus)]),
        covariance=np.concatenate([data.covariance, np.median(data.covariance, axis=0)[None]]),
        nodal_mm=np.append(data.nodal_mm, np.nan),
        nodal_variance=np.append(data.nodal_variance, np.nan),
    )
