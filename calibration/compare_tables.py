"""How far two lens tables are apart: pixels of overlay over zoom and focus, and what explains them.

At each level of either table, and on a grid between them, the distance in px between where the two put the same ray,
over the pixels of the first one's picture (:mod:`calibration.compare`). Two simple causes are tried on the whole
field of differences at once: a constant move of the centre, as a refitted sensor or lens mount leaves, and a constant
ratio of focal lengths, as another sensor width or a scaled output leaves. For a ray that the first table puts at pixel
p, with c its principal point and d the way from there to where the second puts it,

    d = s + (r - 1) (p - c),   s: centre shift (px), r: focal length of the second over that of the first

is solved for s, for r, and for both (least squares over all levels); what is left over is what they do not explain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from calibration.compare import grid_pixels
from calibration.errors import CalibrationError, GeometryError, InvalidInput
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult, PixelError, other_picture
from calibration.types import FloatArray

LensAt = Callable[[float, float], Lens]
"""A table's lens at any (zoom, focus) of its range. Raises :class:`calibration.errors.CalibrationError`."""

MAP_GRID = (17, 9)
"""Zooms x focuses of the map: steps of a sixteenth and an eighth of the common range."""

AGREEING_SIGMAS = 3.0
"""Two tables agree where their difference at no level is larger than this many of its stated sigmas: a level apart by
chance alone exceeds it with p < 0.003."""

_NOTHING_PX = 1e-6
# Rounding moves a ray by 1e-12 px; less than this is no difference to be explained.

MAX_LEVELS = 2000
"""Most levels of two tables together: two of 1,000, the most that a job measures; they take seconds."""

CENTER_SHIFT, F_RATIO, BOTH = "center_shift", "f_ratio", "both"
_COLUMNS = {CENTER_SHIFT: [0, 1], F_RATIO: [2], BOTH: [0, 1, 2]}


@dataclass(frozen=True, slots=True)
class PlaceDifference:
    """Two tables at one (zoom, focus); ``measured``: whether it is a level with a lens of the first, of the second.

    ``difference_px``: RMS and maximum over the picture of the distance between where they put the same ray;
    ``worst_px``: the pixel of the maximum. ``center_shift_px``, ``f_ratio``: second minus first, second over first.
    ``sigma_px``: the RMS distance to expect from what both levels state of their own error, None where one does not.
    ``reason``: why there is no difference to tell.
    """

    zoom: float
    focus: float
    measured: tuple[bool, bool]
    difference_px: PixelError | None = None
    worst_px: tuple[float, float] | None = None
    center_shift_px: tuple[float, float] | None = None
    f_ratio: float | None = None
    sigma_px: float | None = None
    reason: str | None = None

    @property
    def sigmas(self) -> float | None:
        """The RMS difference in units of its sigma."""
        if self.difference_px is None or self.sigma_px is None:
            return None
        return self.difference_px.rms / self.sigma_px


@dataclass(frozen=True, slots=True)
class Explanation:
    """A constant cause tried on all levels at once, and the difference that is ``left_px`` without it. ``cause``:
    :data:`CENTER_SHIFT`, :data:`F_RATIO` or :data:`BOTH`; what was not tried is (0, 0) and 1."""

    cause: str
    center_shift_px: tuple[float, float]
    f_ratio: float
    left_px: PixelError


@dataclass(frozen=True, slots=True)
class DifferenceMap:
    """Differences on a grid over the range of zoom and focus that both tables cover: ``places`` focus by focus, each
    row from the first zoom to the last."""

    zooms: tuple[float, ...]
    focuses: tuple[float, ...]
    places: tuple[PlaceDifference, ...]


@dataclass(frozen=True, slots=True)
class TableComparison:
    """Two tables compared. ``levels``: every level of either, by zoom and focus; ``grid``: the places between, None
    without surfaces or without a common range; ``difference_px``: RMS over the levels that can be told (over the
    grid where none can), maximum over both; ``worst``: the place of that maximum; ``explanations``: empty where no
    level differs."""

    levels: tuple[PlaceDifference, ...]
    grid: DifferenceMap | None
    difference_px: PixelError
    worst: PlaceDifference
    explanations: tuple[Explanation, ...]

    @property
    def most_sigmas(self) -> float | None:
        """The largest RMS difference of a level in its own sigmas; None where no level has sigmas in both tables."""
        told = [place.sigmas for place in self.levels if place.sigmas is not None]
        return max(told) if told else None

    @property
    def agree(self) -> bool | None:
        """Whether the tables agree within their stated sigmas (:data:`AGREEING_SIGMAS`); None where they state none."""
        most = self.most_sigmas
        return None if most is None else most <= AGREEING_SIGMAS


def compare_tables(
    first: LensTable,
    second: LensTable,
    first_at: LensAt | None = None,
    second_at: LensAt | None = None,
    map_grid: tuple[int, int] = MAP_GRID,
) -> TableComparison:
    """Compare two tables; ``first_at``, ``second_at``: their lenses between levels, asked only inside the range of the
    levels that have a lens. Without them only the levels that both have can be told, and there is no map.

    Raises :class:`InvalidInput` when the pictures, sensors or pixel aspects differ, or no place can be told.
    """
    difference = other_picture(first, second)
    if difference is not None:
        raise InvalidInput("second table", second.lens, f"cannot be compared with the first: {difference}")
    sides = (_Side(first, first_at), _Side(second, second_at))
    union = sorted({*sides[0].levels, *sides[1].levels})
    if len(union) > MAX_LEVELS:
        raise InvalidInput("levels of both tables", len(union), f"at most {MAX_LEVELS} are compared")
    causes = _Causes()
    levels = tuple(_level_difference(sides, place, causes) for place in union)
    grid = _difference_map(sides, map_grid)
    told = [place for place in (*levels, *(grid.places if grid else ())) if place.difference_px is not None]
    if not told:
        why = next((place.reason for place in levels if place.reason), "no level of either has a lens")
        raise InvalidInput("second table", second.lens, f"there is no place to compare it with the first at: {why}")
    worst = max(told, key=_max_px)
    squares = [place.difference_px.rms**2 for place in levels if place.difference_px is not None]
    squares = squares or [place.difference_px.rms**2 for place in told if place.difference_px is not None]
    overall = PixelError(math.sqrt(math.fsum(squares) / len(squares)), _max_px(worst))
    return TableComparison(levels, grid, overall, worst, causes.explanations())


def _max_px(place: PlaceDifference) -> float:
    return place.difference_px.max if place.difference_px is not None else 0.0


class _Side:
    """One table: its levels that have a lens, and its lens anywhere."""

    def __init__(self, table: LensTable, at: LensAt | None) -> None:
        self.table = table
        self.at = at
        self.levels = {(level.zoom, level.focus): level for level in table.levels if level.fov_x_deg is not None}
        self.zooms = _range(zoom for zoom, _ in self.levels)
        self.focuses = _range(focus for _, focus in self.levels)

    def lens(self, place: tuple[float, float]) -> Lens | str:
        """The lens there, or why there is none."""
        level = self.levels.get(place)
        try:
            if level is not None:
                return level.lens(self.table.image_size, self.table.pixel_aspect)
            if self.at is None:
                return "is no level with a lens"
            if not (_inside(place[0], self.zooms) and _inside(place[1], self.focuses)):
                return "lies outside the levels"
            return self.at(*place)
        except CalibrationError as error:
            return f"has no lens there ({error})"


_Range = tuple[float, float]


def _range(values: Iterable[float]) -> _Range:
    told = tuple(values)
    return (min(told), max(told)) if told else (math.inf, -math.inf)


def _inside(value: float, limits: _Range) -> bool:
    return limits[0] <= value <= limits[1]


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
    """At (N, 2) pixels of the first's picture: the way (N, 2) px from the first's principal point to the pixel, and
    from the pixel to where the second puts the same ray."""

    pixels: FloatArray
    from_centre: FloatArray
    way: FloatArray


def _field(first: Lens, second: Lens) -> _Field:
    """Raises :class:`GeometryError` where not every ray of the first's picture lands in the second's plane."""
    pixels = grid_pixels(first.image_size)
    rays = first.unproject(pixels)
    seen = np.isfinite(rays[..., 0])
    if not seen.any():
        raise GeometryError("no pixel of the first table's picture is reached by a ray")
    way = (second.project(rays) - pixels)[seen]
    if not np.isfinite(way).all():
        raise GeometryError("the second table's lens folds inside the first one's picture")
    return _Field(pixels[seen], pixels[seen] - np.asarray(first.principal_point_px), way)


def _place_difference(
    sides: tuple[_Side, _Side], zoom: float, focus: float, causes: _Causes | None = None
) -> PlaceDifference:
    """The difference there; its field is added to ``causes``."""
    bare = PlaceDifference(zoom, focus, (False, False))
    lenses = []
    for name, side in zip(("first", "second"), sides, strict=True):
        lens = side.lens((zoom, focus))
        if isinstance(lens, str):
            return replace(bare, reason=f"in the {name} table it {lens}")
        lenses.append(lens)
    first, second = lenses
    try:
        field = _field(first, second)
    except CalibrationError as error:
        return replace(bare, reason=str(error))
    if causes is not None:
        causes.add(first, second, field)
    lengths = _Lengths()
    lengths.add(field.way)
    worst = field.pixels[int(np.argmax(np.sum(field.way * field.way, axis=-1)))]
    shifts = (first.center_shift_px, second.center_shift_px)
    return replace(
        bare,
        difference_px=lengths.error(),
        worst_px=(float(worst[0]), float(worst[1])),
        center_shift_px=(shifts[1][0] - shifts[0][0], shifts[1][1] - shifts[0][1]),
        f_ratio=second.f_px / first.f_px,
    )


def _level_difference(sides: tuple[_Side, _Side], place: tuple[float, float], causes: _Causes) -> PlaceDifference:
    difference = _place_difference(sides, *place, causes)
    first, second = (side.levels.get(place) for side in sides)
    return replace(difference, measured=(first is not None, second is not None), sigma_px=_sigma_px(first, second))


def _sigma_px(first: LevelResult | None, second: LevelResult | None) -> float | None:
    """The RMS distance that the stated errors of two independent levels let expect; None where one states none."""
    if first is None or second is None or first.predicted_overlay_px is None or second.predicted_overlay_px is None:
        return None
    return math.hypot(first.predicted_overlay_px.rms, second.predicted_overlay_px.rms) or None


def _difference_map(sides: tuple[_Side, _Side], shape: tuple[int, int]) -> DifferenceMap | None:
    if any(side.at is None for side in sides):
        return None
    zooms = _steps(sides[0].zooms, sides[1].zooms, shape[0])
    focuses = _steps(sides[0].focuses, sides[1].focuses, shape[1])
    if not zooms or not focuses:
        return None
    places = tuple(_place_difference(sides, zoom, focus) for focus in focuses for zoom in zooms)
    return DifferenceMap(zooms, focuses, places)


def _steps(first: _Range, second: _Range, count: int) -> tuple[float, ...]:
    """Even steps through what two ranges have in common: one value where that is a point, none where it is nothing."""
    low, high = max(first[0], second[0]), min(first[1], second[1])
    if low > high:
        return ()
    return (low,) if low == high else tuple(float(value) for value in np.linspace(low, high, count))


class _Lengths:
    """RMS and maximum of the lengths of ways (N, 2), added up field by field."""

    def __init__(self) -> None:
        self._total, self._count, self._largest = 0.0, 0, 0.0

    def add(self, way: FloatArray) -> None:
        squared = np.sum(way * way, axis=-1)
        self._total += float(np.sum(squared))
        self._count += squared.size
        self._largest = max(self._largest, float(np.max(squared)))

    def error(self) -> PixelError:
        return PixelError(math.sqrt(self._total / self._count), math.sqrt(self._largest))


class _Causes:
    """The constant causes, fitted to the fields of all levels. Fields are let go once they are added, and made again
    to see what is left: those of 1,000 levels would take 100 MB."""

    def __init__(self) -> None:
        self._pairs: list[tuple[Lens, Lens]] = []
        self._lengths = _Lengths()
        self._normal, self._right = np.zeros((3, 3)), np.zeros(3)
        # Columns: shift to the right, shift down, ratio minus 1.

    def add(self, first: Lens, second: Lens, field: _Field) -> None:
        self._pairs.append((first, second))
        self._lengths.add(field.way)
        for axis in (0, 1):
            columns = np.zeros((len(field.way), 3))
            columns[:, axis] = 1.0
            columns[:, 2] = field.from_centre[:, axis]
            self._normal += columns.T @ columns
            self._right += columns.T @ field.way[:, axis]

    def explanations(self) -> tuple[Explanation, ...]:
        """Each cause with what it leaves; empty where no level differs."""
        if not self._pairs or self._lengths.error().max < _NOTHING_PX:
            return ()
        tried = [(cause, self._solved(used), _Lengths()) for cause, used in _COLUMNS.items()]
        for first, second in self._pairs:
            field = _field(first, second)
            for _, solved, left in tried:
                left.add(field.way - solved[:2] - solved[2] * field.from_centre)
        return tuple(
            Explanation(cause, (float(solved[0]), float(solved[1])), 1.0 + float(solved[2]), left.error())
            for cause, solved, left in tried
        )

    def _solved(self, used: list[int]) -> FloatArray:
        solved = np.zeros(3)
        solved[used] = np.linalg.solve(self._normal[np.ix_(used, used)], self._right[used])
        return solved
