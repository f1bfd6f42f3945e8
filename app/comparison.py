"""Two lens tables compared, as a document and as a sentence for a person."""

from __future__ import annotations

from datetime import datetime
from typing import Self

from pydantic import BaseModel, ConfigDict, Field

from app.lens_at import between_levels
from calibration.compare_tables import (
    AGREEING_SIGMAS,
    BOTH,
    CENTER_SHIFT,
    F_RATIO,
    DifferenceMap,
    Explanation,
    PlaceDifference,
    TableComparison,
    compare_tables,
)
from calibration.tables import LensTable, PixelError

_EXPLAINED, _AS_GOOD, _NEGLIGIBLE = 0.3, 1.5, 0.02
# A constant cause is named as the explanation where it leaves less than this share of the RMS difference, and no more
# than this many times what both causes together leave (or a negligible share).


class _View(BaseModel):
    model_config = ConfigDict(frozen=True)


class PixelErrorView(_View):
    """A distance in px: its root mean square and its maximum."""

    rms: float
    max: float

    @classmethod
    def of(cls, error: PixelError) -> Self:
        return cls(rms=error.rms, max=error.max)


class ComparedTable(_View):
    """Which table was compared."""

    lens: str
    camera: str
    version: int
    created: datetime

    @classmethod
    def of(cls, table: LensTable) -> Self:
        return cls(lens=table.lens, camera=table.camera, version=table.version, created=table.created)


class PlaceView(_View):
    """The two tables at one zoom and focus."""

    zoom: float
    focus: float
    measured: tuple[bool, bool] = Field(description="whether it is a level with a lens of the first, of the second")
    difference_px: PixelErrorView | None = Field(
        description="distance between where the two put the same ray, over the picture; null: not told, see reason"
    )
    worst_px: tuple[float, float] | None = Field(description="pixel of the maximum in the first table's picture")
    center_shift_px: tuple[float, float] | None = Field(description="second minus first, right and down")
    f_ratio: float | None = Field(description="focal length of the second over that of the first")
    sigma_px: float | None = Field(description="RMS distance to expect from what both levels state; null: not stated")
    sigmas: float | None = Field(description="RMS distance over sigma_px")
    reason: str | None = Field(description="why there is nothing to tell")

    @classmethod
    def of(cls, place: PlaceDifference) -> Self:
        return cls(
            zoom=place.zoom,
            focus=place.focus,
            measured=place.measured,
            difference_px=None if place.difference_px is None else PixelErrorView.of(place.difference_px),
            worst_px=place.worst_px,
            center_shift_px=place.center_shift_px,
            f_ratio=place.f_ratio,
            sigma_px=place.sigma_px,
            sigmas=place.sigmas,
            reason=place.reason,
        )


class ExplanationView(_View):
    """A constant cause tried on all levels at once, and the difference that is left without it."""

    cause: str = Field(description=f"{CENTER_SHIFT}, {F_RATIO} or {BOTH}")
    center_shift_px: tuple[float, float] = Field(description="second minus first, right and down")
    f_ratio: float = Field(description="focal length of the second over that of the first")
    left_px: PixelErrorView

    @classmethod
    def of(cls, found: Explanation) -> Self:
        return cls(
            cause=found.cause,
            center_shift_px=found.center_shift_px,
            f_ratio=found.f_ratio,
            left_px=PixelErrorView.of(found.left_px),
        )


class MapView(_View):
    """Differences in px over zoom and focus: one row for each focus, one column for each zoom; null: not told."""

    zooms: tuple[float, ...]
    focuses: tuple[float, ...]
    rms_px: tuple[tuple[float | None, ...], ...]
    max_px: tuple[tuple[float | None, ...], ...]

    @classmethod
    def of(cls, found: DifferenceMap) -> Self:
        width = len(found.zooms)
        rows = [found.places[start : start + width] for start in range(0, len(found.places), width)]
        errors = [[place.difference_px for place in row] for row in rows]
        return cls(
            zooms=found.zooms,
            focuses=found.focuses,
            rms_px=tuple(tuple(None if error is None else error.rms for error in row) for row in errors),
            max_px=tuple(tuple(None if error is None else error.max for error in row) for row in errors),
        )


class ComparisonDocument(_View):
    """Two lens tables compared."""

    first: ComparedTable
    second: ComparedTable
    verdict: str = Field(description="what it comes to, in words")
    agree: bool | None = Field(description="whether they agree within their stated sigmas; null: they state none")
    most_sigmas: float | None = Field(description="the largest difference of a level, in its sigmas")
    difference_px: PixelErrorView = Field(description="RMS over the levels, maximum over these and the map")
    worst: PlaceView = Field(description="where that maximum is")
    levels: list[PlaceView] = Field(description="the levels of either, by zoom and focus")
    explanations: list[ExplanationView]
    map: MapView | None = Field(description="between the levels; null: it cannot be told")

    @classmethod
    def of(cls, first: LensTable, second: LensTable, found: TableComparison) -> Self:
        return cls(
            first=ComparedTable.of(first),
            second=ComparedTable.of(second),
            verdict=verdict(found),
            agree=found.agree,
            most_sigmas=found.most_sigmas,
            difference_px=PixelErrorView.of(found.difference_px),
            worst=PlaceView.of(found.worst),
            levels=[PlaceView.of(place) for place in found.levels],
            explanations=[ExplanationView.of(one) for one in found.explanations],
            map=None if found.grid is None else MapView.of(found.grid),
        )


def compared(first: LensTable, second: LensTable) -> ComparisonDocument:
    """Compare two tables. Raises :class:`calibration.errors.InvalidInput` where they cannot be compared."""
    return ComparisonDocument.of(
        first, second, compare_tables(first, second, between_levels(first), between_levels(second))
    )


def verdict(found: TableComparison) -> str:
    """Whether two tables agree, how far they are apart at most, and what explains it: one line."""
    apart = f"at most {found.difference_px.max:.3f} px apart, at {_where(found.worst)}"
    most = found.most_sigmas
    if most is None:
        told = f"The tables are {apart}; they state no sigmas at a common level to judge that by."
    elif found.agree:
        told = f"The tables agree within their stated sigmas ({most:.1f} at most); they are {apart}."
    else:
        place = max((place for place in found.levels if place.sigmas is not None), key=lambda one: one.sigmas or 0.0)
        told = (
            f"The tables differ by more than their stated sigmas explain ({most:.1f} at {_where(place)}, "
            f"{AGREEING_SIGMAS:g} are taken for chance); they are {apart}."
        )
    cause = _simplest(found)
    if cause is None or found.agree:
        return told
    return f"{told} {in_words(cause).capitalize()} explains all but {cause.left_px.max:.3f} px of it."


def in_words(cause: Explanation | ExplanationView) -> str:
    """A constant cause and its figures."""
    # Adding 0 makes no "-0.000" of what rounds to nothing.
    x, y = (round(value, 3) + 0.0 for value in cause.center_shift_px)
    shift, ratio = f"a constant centre shift of {x:+.3f}, {y:+.3f} px", f"ratio of focal lengths of {cause.f_ratio:.5f}"
    return {CENTER_SHIFT: shift, F_RATIO: f"a constant {ratio}", BOTH: f"{shift} with a {ratio}"}[cause.cause]


def _simplest(found: TableComparison) -> Explanation | None:
    """The first cause that explains the difference, and nearly as much of it as both do together."""
    rms = found.difference_px.rms
    both_px = min((one.left_px.rms for one in found.explanations), default=0.0)
    enough_px = max(_NEGLIGIBLE * rms, _AS_GOOD * both_px)
    told = (one for one in found.explanations if one.left_px.rms < _EXPLAINED * rms and one.left_px.rms <= enough_px)
    return next(told, None)


def _where(place: PlaceDifference) -> str:
    return f"zoom {place.zoom:.3f}, focus {place.focus:.2f}"
