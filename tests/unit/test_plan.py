"""The adaptive plan: what it asks for, when it ends, and that it is no worse than an even grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.compare import overlay
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.surface.model import LensModel
from calibration.surface.plan import AdaptivePlan, PlanOptions, in_order
from calibration.surface.quantities import LevelData, lens_of
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult
from engine_adapters.sim.lens_truth import ZoomLens, load_embedded
from tests.support.surfaces import table_of_levels

SIZE = (1920, 1080)
NO_EVIDENCE = dict.fromkeys(EVIDENCE_QUANTITIES, "not tried")


def true_lens(lens: ZoomLens, zoom: float, focus: float) -> Lens:
    state = lens.at(zoom, focus)
    optics = state.optics
    shift = (float(optics.center_shift_px[0]), float(optics.center_shift_px[1]))
    return Lens(SIZE, optics.f_px, optics.k1, optics.k2, shift, nodal_offset_mm=state.nodal_offset_mm)


def measured(lens: ZoomLens, place: tuple[float, float]) -> LevelResult:
    return LevelResult.from_lens(
        *place,
        true_lens(lens, *place),
        reasons=NO_EVIDENCE,
    )


def follow(plan: AdaptivePlan, lens: ZoomLens) -> list[LevelResult]:
    results: list[LevelResult] = []
    while asked := plan.ask():
        for place in asked:
            results.append(measured(lens, place))
            plan.tell(results[-1])
    return results


def worst_px(results: list[LevelResult], lens: ZoomLens, focuses: tuple[float, ...]) -> float:
    model = LensModel.fit(LevelData.of_levels(results, SIZE))
    errors = []
    for focus in focuses:
        zooms = np.linspace(0, 1, 41)
        means = model.mean(zooms, np.full(41, focus))
        for zoom, row in zip(zooms, means, strict=True):
            errors.append(overlay(true_lens(lens, float(zoom), focus), lens_of(row.tolist(), SIZE, 1.0)).max_px)
    return max(errors)


def test_the_first_levels_hold_the_ends_and_the_plan_ends_when_the_accuracy_is_reached() -> None:
    lens = load_embedded("Demo ENG 8x")
    plan = AdaptivePlan(PlanOptions(accuracy_px=1.0, max_levels=20), SIZE)
    first = plan.ask()
    assert {first[0][0], first[-1][0]} == {0.0, 1.0}
    for place in first:
        plan.tell(measured(lens, place))
    results = [measured(lens, place) for place in first] + follow(plan, lens)
    assert plan.reason is not None
    assert "is reached" in plan.reason
    assert plan.steps[-1].predicted_px <= 1.0
    assert plan.steps[-1].held_out_px is not None
    assert plan.steps[-1].held_out_px <= 1.0
    assert worst_px(results, lens, (0.5,)) <= 1.0
    assert plan.ask() == []


def test_a_budget_is_kept() -> None:
    lens = load_embedded("Demo ENG 8x")
    plan = AdaptivePlan(PlanOptions(accuracy_px=1e-6, max_levels=9), SIZE)
    results = follow(plan, lens)
    assert len(results) == 9
    assert plan.reason is not None
    assert "9 levels are measured" in plan.reason
    timed = AdaptivePlan(PlanOptions(accuracy_px=1e-6, max_levels=30, max_seconds=60.0), SIZE)
    spent = 0.0
    while asked := timed.ask():
        for place in asked:
            timed.tell(replace(measured(lens, place), seconds=6.0))
            spent += 6.0
    assert 30.0 < spent < 120.0
    assert timed.reason is not None
    assert "time is used up" in timed.reason


def test_a_focus_range_is_covered() -> None:
    lens = load_embedded("Demo ENG 8x")
    plan = AdaptivePlan(PlanOptions(accuracy_px=None, max_levels=24, focus_range=(0.0, 1.0)), SIZE)
    results = follow(plan, lens)
    assert len({(r.zoom, r.focus) for r in results}) == 24
    even = [measured(lens, (float(z), t)) for z in np.linspace(0, 1, 8) for t in (0.0, 0.5, 1.0)]
    assert worst_px(results, lens, (0.0, 0.3, 1.0)) < 1.2 * worst_px(even, lens, (0.0, 0.3, 1.0))


def test_a_level_that_contradicts_its_neighbours_is_asked_for_again() -> None:
    lens = load_embedded("Demo ENG 8x")
    plan = AdaptivePlan(PlanOptions(accuracy_px=0.5, max_levels=13), SIZE)
    again: list[tuple[float, float]] = []
    seen: set[tuple[float, float]] = set()
    wrong: tuple[float, float] | None = None
    while asked := plan.ask():
        for place in asked:
            result = measured(lens, place)
            if place in seen:
                again.append(place)
            elif wrong is None and len(seen) == 6:
                wrong = place
                result = LevelResult.from_lens(*place, true_lens(lens, place[0] / 2, place[1]), reasons=NO_EVIDENCE)
            seen.add(place)
            plan.tell(result)
    assert again == [wrong]


def test_failed_levels_are_not_asked_for_again() -> None:
    lens = load_embedded("Demo ENG 8x")
    plan = AdaptivePlan(PlanOptions(max_levels=9), SIZE)
    places: list[tuple[float, float]] = []
    while asked := plan.ask():
        for place in asked:
            places.append(place)
            plan.tell(LevelResult.failed(*place, "no board") if len(places) == 2 else measured(lens, place))
    assert len(places) == len({*places}) <= 9
    nothing = AdaptivePlan(PlanOptions(), SIZE)
    for place in nothing.ask():
        nothing.tell(LevelResult.failed(*place, "no board"))
    assert nothing.ask() == []
    assert nothing.reason == "no level could be measured"


def test_the_order_moves_the_lens_little() -> None:
    places = [(1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (1.0, 1.0)]
    assert in_order(places) == [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)]


@pytest.mark.parametrize(
    "wrong",
    [
        {"accuracy_px": 0.0},
        {"max_levels": 1},
        {"first_levels": 1},
        {"max_seconds": -1.0},
        {"zoom_range": (0.5, 0.5)},
        {"focus_range": (1.0, 0.0)},
    ],
)
def test_bad_options_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidInput):
        PlanOptions(**wrong)  # type: ignore[arg-type]


def test_a_table_of_a_plan_makes_the_same_surface(  # the plan's data and a table's are one
) -> None:
    lens = load_embedded("Demo ENG 8x")
    results = follow(AdaptivePlan(PlanOptions(max_levels=9), SIZE), lens)
    table: LensTable = table_of_levels(results)
    np.testing.assert_array_equal(LevelData.of(table).values, LevelData.of_levels(results, SIZE).values)
