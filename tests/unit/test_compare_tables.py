"""Comparing two lens tables: the distance itself, what explains it, between levels, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.compare import overlay
from calibration.compare_tables import BOTH, CENTER_SHIFT, F_RATIO, TableComparison, compare_tables
from calibration.errors import FoldedLens, InvalidInput
from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, PixelError

SIZE = (1920, 1080)
NO_EVIDENCE = dict.fromkeys(EVIDENCE_QUANTITIES, "not tried")


def zoom_lens(zoom: float, focus: float = 0.5) -> Lens:
    """A made-up 8x zoom whose field of view breathes with the focus."""
    fov_x_deg = math.degrees(2 * math.atan(0.6 * 8**-zoom * (1 + 0.02 * focus)))
    flat = Lens.from_fov(SIZE, fov_x_deg, center_shift_px=(3.0 + zoom, -2.0))
    return flat.with_hw(flat.f_px, -0.08 + 0.1 * zoom, 0.01)


def level(zoom: float, focus: float, lens: Lens, expected_px: float | None = None) -> LevelResult:
    reasons = dict(NO_EVIDENCE)
    evidence: dict[str, Any] = {}
    if expected_px is not None:
        evidence["predicted_overlay_px"] = PixelError(expected_px, 2 * expected_px)
        del reasons["predicted_overlay_px"]
    return LevelResult.from_lens(zoom, focus, lens, reasons=reasons, **evidence)


def table(
    places: list[tuple[float, float]],
    at: Callable[[float, float], Lens] = zoom_lens,
    expected_px: float | None = None,
    **changes: Any,
) -> LensTable:
    levels = tuple(level(*place, at(*place), expected_px) for place in places)
    plain = LensTable("XA 20x", "Cam0", 1, datetime(2026, 11, 21, 10, tzinfo=UTC), SIZE, "joint", levels)
    return replace(plain, **changes)


def changed(shift: tuple[float, float] = (0.0, 0.0), ratio: float = 1.0) -> Callable[[float, float], Lens]:
    """The zoom lens moved by ``shift`` px and with ``ratio`` times the focal length, k1 and k2 as they were."""

    def at(zoom: float, focus: float) -> Lens:
        lens = zoom_lens(zoom, focus)
        moved = (lens.center_shift_px[0] + shift[0], lens.center_shift_px[1] + shift[1])
        return replace(lens, f_px=lens.f_px * ratio, center_shift_px=moved)

    return at


PLACES = [(zoom, focus) for zoom in (0.0, 0.5, 1.0) for focus in (0.25, 0.75)]


def explained(comparison: TableComparison) -> dict[str, tuple[tuple[float, float], float, float]]:
    return {one.cause: (one.center_shift_px, one.f_ratio, one.left_px.max) for one in comparison.explanations}


def test_a_table_equals_itself_everywhere() -> None:
    comparison = compare_tables(table(PLACES, expected_px=0.01), table(PLACES, expected_px=0.01), zoom_lens, zoom_lens)
    assert comparison.difference_px.max < 1e-9
    assert (comparison.agree, comparison.explanations) == (True, ())
    assert comparison.most_sigmas == pytest.approx(0.0, abs=1e-7)
    assert [(place.zoom, place.focus) for place in comparison.levels] == PLACES
    assert all(place.measured == (True, True) and place.f_ratio == 1.0 for place in comparison.levels)


def test_a_level_is_compared_as_its_lenses_are() -> None:
    at = changed((1.0, -0.5), 1.002)
    comparison = compare_tables(table(PLACES), table(PLACES, at))
    for place in comparison.levels:
        expected = overlay(zoom_lens(place.zoom, place.focus), at(place.zoom, place.focus))
        assert place.difference_px is not None
        assert place.difference_px.rms == pytest.approx(expected.rms_px, rel=1e-12)
        assert place.difference_px.max == pytest.approx(expected.max_px, rel=1e-12)
        assert place.center_shift_px == pytest.approx((1.0, -0.5))
        assert place.f_ratio == pytest.approx(1.002)
    squares = [place.difference_px.rms**2 for place in comparison.levels if place.difference_px]
    assert comparison.difference_px.rms == pytest.approx(math.sqrt(sum(squares) / len(squares)))
    assert comparison.worst == max(comparison.levels, key=lambda one: one.difference_px.max if one.difference_px else 0)
    assert comparison.grid is None
    assert comparison.agree is None


def test_the_worst_pixel_is_where_the_pictures_part() -> None:
    (place,) = compare_tables(table([(0.0, 0.5)]), table([(0.0, 0.5)], changed((4.0, 3.0), 1.01))).levels
    assert place.worst_px == (SIZE[0] - 1, SIZE[1] - 1)


@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(0.98, 1.02))
def test_a_constant_cause_is_found_and_leaves_nothing(x: float, y: float, ratio: float) -> None:
    comparison = compare_tables(table(PLACES), table(PLACES, changed((x, y), ratio)))
    if not comparison.explanations:
        assert (x, y, ratio) == (pytest.approx(0.0, abs=1e-6), pytest.approx(0.0, abs=1e-6), pytest.approx(1.0))
        return
    shift, found, left_px = explained(comparison)[BOTH]
    # The grid's symmetry leaves a mean of 2e-13 of the focal length: all is exact but for rounding.
    assert shift == pytest.approx((x, y), abs=1e-8)
    assert found == pytest.approx(ratio, abs=1e-10)
    assert left_px < 1e-7


def test_each_cause_is_tried_by_itself() -> None:
    moved = explained(compare_tables(table(PLACES), table(PLACES, changed((2.0, -1.0)))))
    assert moved[CENTER_SHIFT][0] == pytest.approx((2.0, -1.0))
    assert moved[CENTER_SHIFT][2] < 1e-9
    assert moved[F_RATIO][:1] == ((0.0, 0.0),)
    assert moved[F_RATIO][2] > 2.0
    scaled = explained(compare_tables(table(PLACES), table(PLACES, changed(ratio=1.003))))
    assert scaled[F_RATIO][1] == pytest.approx(1.003)
    assert scaled[F_RATIO][2] < 1e-9
    assert scaled[CENTER_SHIFT][1] == 1.0
    assert scaled[CENTER_SHIFT][2] > 2.0


def test_what_no_constant_explains_is_left() -> None:
    def other(zoom: float, focus: float) -> Lens:
        lens = zoom_lens(zoom, focus)
        return lens.with_hw(lens.f_px, lens.k1_hw + 0.01, lens.k2_hw)

    comparison = compare_tables(table(PLACES), table(PLACES, other))
    assert explained(comparison)[BOTH][2] > 1.0


# Between the levels


def test_between_the_levels_the_surfaces_are_asked_inside_both_ranges_only() -> None:
    asked: list[tuple[float, float]] = []

    def second_at(zoom: float, focus: float) -> Lens:
        asked.append((zoom, focus))
        return changed((zoom, 0.0))(zoom, focus)

    first = table([(0.0, 0.25), (0.6, 0.25), (0.6, 0.75)])
    second = table([(0.2, 0.5), (1.0, 0.5), (0.4, 0.25)], second_at)
    asked.clear()
    comparison = compare_tables(first, second, zoom_lens, second_at, map_grid=(5, 3))
    grid = comparison.grid
    assert grid is not None
    assert grid.zooms == pytest.approx((0.2, 0.3, 0.4, 0.5, 0.6))
    assert grid.focuses == pytest.approx((0.25, 0.375, 0.5))
    assert all(0.2 <= zoom <= 1.0 and 0.25 <= focus <= 0.5 for zoom, focus in asked)
    for index, place in enumerate(grid.places):
        assert (place.zoom, place.focus) == (grid.zooms[index % 5], grid.focuses[index // 5])
        assert place.difference_px is not None
        assert place.difference_px.max == pytest.approx(place.zoom)
    told = {(place.zoom, place.focus): place for place in comparison.levels}
    assert told[0.6, 0.25].measured == (True, False)
    assert told[0.6, 0.25].difference_px.rms == pytest.approx(0.6)
    assert told[0.0, 0.25].reason == "in the second table it lies outside the levels"
    assert told[1.0, 0.5].reason == "in the first table it lies outside the levels"
    assert comparison.worst.zoom == 0.6


def test_a_bump_between_the_levels_is_found_on_the_map() -> None:
    def bumped(zoom: float, focus: float) -> Lens:
        return changed((3.0 * math.exp(-(((zoom - 0.25) / 0.1) ** 2)), 0.0))(zoom, focus)

    comparison = compare_tables(table(PLACES), table(PLACES), zoom_lens, bumped)
    assert comparison.difference_px.rms < 0.02
    assert comparison.difference_px.max == pytest.approx(3.0)
    assert comparison.worst.zoom == 0.25
    assert comparison.worst.measured == (False, False)


def test_one_focus_makes_a_map_of_one_row_and_no_common_range_none() -> None:
    row = compare_tables(table([(0.0, 0.5), (1.0, 0.5)]), table(PLACES), zoom_lens, zoom_lens).grid
    assert row is not None
    assert (len(row.zooms), row.focuses) == (17, (0.5,))
    with pytest.raises(InvalidInput, match="there is no place to compare it with the first at"):
        compare_tables(table([(0.0, 0.1)]), table([(1.0, 0.9)]), zoom_lens, zoom_lens)


def test_levels_that_never_coincide_are_compared_between() -> None:
    first, second = table([(0.0, 0.5), (1.0, 0.5)]), table([(0.5, 0.0), (0.5, 1.0)])
    comparison = compare_tables(first, second, zoom_lens, changed((1.0, 0.0)))
    assert all(place.difference_px is None for place in comparison.levels)
    assert (comparison.difference_px.rms, comparison.difference_px.max) == pytest.approx((1.0, 1.0))
    assert comparison.explanations == ()


def test_a_surface_that_cannot_tell_costs_its_place_only() -> None:
    def torn(zoom: float, focus: float) -> Lens:
        if zoom > 0.5:
            raise FoldedLens(1.0, 2.0)
        return zoom_lens(zoom, focus)

    grid = compare_tables(table(PLACES), table(PLACES), zoom_lens, torn).grid
    assert grid is not None
    # The last zoom of the row is a level of both, which needs no surface.
    assert [place.reason is None for place in grid.places[:17]] == [True] * 9 + [False] * 7 + [True]
    assert "has no lens there (the lens folds" in (grid.places[15].reason or "")


def test_a_lens_that_folds_inside_the_others_picture_is_said_so() -> None:
    folded = level(0.5, 0.25, Lens.from_fov(SIZE, 30.0, k1=-6.0))
    second = table(PLACES)
    second = replace(second, levels=(*(one for one in second.levels if (one.zoom, one.focus) != (0.5, 0.25)), folded))
    place = next(one for one in compare_tables(table(PLACES), second).levels if (one.zoom, one.focus) == (0.5, 0.25))
    assert (place.difference_px, place.reason) == (None, "the second table's lens folds inside the first one's picture")


# Levels without a lens, and sigmas


def test_failed_levels_are_no_levels() -> None:
    first = table(PLACES)
    second = replace(first, levels=(*first.levels[1:], LevelResult.failed(*PLACES[0], "dark")))
    comparison = compare_tables(first, second)
    assert comparison.levels[0].measured == (True, False)
    assert comparison.levels[0].reason == "in the second table it is no level with a lens"
    nothing = replace(first, levels=(LevelResult.failed(0.0, 0.5, "dark"),))
    with pytest.raises(InvalidInput, match="in the second table it is no level with a lens"):
        compare_tables(first, nothing)
    with pytest.raises(InvalidInput, match="no level of either has a lens"):
        compare_tables(nothing, nothing)


@pytest.mark.parametrize(("shift_px", "agree"), [(0.0, True), (0.14, True), (0.16, False)])
def test_tables_agree_within_three_sigmas_of_both(shift_px: float, agree: bool) -> None:
    first = table(PLACES, expected_px=0.03)
    second = table(PLACES, changed((shift_px, 0.0)), expected_px=0.04)
    comparison = compare_tables(first, second)
    assert comparison.levels[0].sigma_px == pytest.approx(0.05)
    assert comparison.most_sigmas == pytest.approx(shift_px / 0.05, abs=1e-7)
    assert comparison.agree is agree


def test_measurements_of_one_lens_agree_as_often_as_their_sigmas_say() -> None:
    rng = np.random.default_rng(20261121)
    sigma_px = 0.05

    def measured() -> LensTable:
        shifts = {place: tuple(rng.normal(0, sigma_px, 2)) for place in PLACES}
        return table(PLACES, lambda *place: changed(shifts[place])(*place), expected_px=sigma_px * math.sqrt(2))

    told = [place.sigmas for _ in range(20) for place in compare_tables(measured(), measured()).levels]
    squares = [one**2 for one in told if one is not None]
    assert len(squares) == 20 * len(PLACES)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.25)
    assert max(squares) < 9


# What is refused


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"image_size": (1280, 720)}, "pictures of 1920 x 1080 px there, of 1280 x 720 px here"),
        ({"pixel_aspect": 1.0005}, "pixel aspect 1 there, 1.0005 here"),
        ({"sensor_mm": (9.6, 5.4)}, None),
        ({"sensor_mm": (9.7, 5.39)}, "a sensor of 9.59 x 5.39 mm there, of 9.7 x 5.39 mm here"),
        ({"sensor_mm": None}, None),
    ],
)
def test_tables_of_other_pictures_are_not_compared(change: dict[str, Any], told: str | None) -> None:
    first = table(PLACES, sensor_mm=(9.59, 5.39))
    failed = (LevelResult.failed(0.3, 0.3, "dark"),)
    levels = first.levels if "sensor_mm" in change else failed
    second = replace(first, levels=levels, **change)
    if told is None:
        assert compare_tables(first, second).difference_px.max < 1e-9
        return
    with pytest.raises(InvalidInput, match="cannot be compared with the first: " + told):
        compare_tables(first, second)


def test_more_levels_than_two_jobs_measure_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calibration.compare_tables.MAX_LEVELS", 7)
    other = table([(0.1, 0.1), (0.2, 0.2)])
    with pytest.raises(InvalidInput, match="levels of both tables = 8: at most 7 are compared"):
        compare_tables(table(PLACES), other)
    assert compare_tables(table(PLACES), table(PLACES)).levels
