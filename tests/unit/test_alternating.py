"""The study's alternating method against a camera and an engine in memory: goals, scenarios, bounds, protocol."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calibration.compare import overlay, relative_errors
from calibration.errors import InvalidInput, NotEnoughData
from calibration.lens import Lens
from calibration.solve.alternating import AlternatingMethod, AlternatingSettings
from calibration.solve.search import LevelTask, Observation, Source
from calibration.synthetic import observe
from calibration.tables import LevelResult, LevelStatus
from calibration.types import Refusal, Role, Target, TargetKind, TargetPose

SIZE = (1920, 1080)
TARGETS = {
    "big": Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((-0.6, 5.0, 1.6))),
    "small": Target(TargetKind.CHESSBOARD, squares=(8, 6), square_m=0.03, pose=TargetPose((0.35, 5.0, 1.6))),
}
LEVELS = [  # fov_x_deg, k1_hw, k2_hw, center shift
    (60.0, -0.08, 0.015, (4.0, -3.0)),
    (48.0, -0.05, 0.006, (3.5, -2.0)),
    (36.0, -0.03, 0.003, (-2.0, 1.0)),
    (27.0, -0.06, 0.0, (0.0, 0.0)),
    (20.0, 0.03, 0.004, (1.0, 5.0)),
    (13.0, 0.02, 0.0, (-5.0, -1.0)),
    (8.0, 0.03, 0.008, (6.0, 2.0)),
]

Drive = Callable[..., tuple[LevelResult, int, int]]


def lens_of(fov_x_deg: float, k1_hw: float, k2_hw: float, shift: tuple[float, float] = (3.0, -2.0)) -> Lens:
    lens = Lens.from_fov(SIZE, fov_x_deg, center_shift_px=shift)
    return lens.with_hw(lens.f_px, k1_hw, k2_hw)


def task(**more: Any) -> LevelTask:
    known: dict[str, Any] = {"image_size": SIZE, "targets": TARGETS, "pivot_m": (0.0, 0.0, 1.6)}
    return LevelTask(zoom=0.0, focus=0.5, **(known | more))


@pytest.mark.parametrize("level", LEVELS)
def test_reaches_the_study_s_goals(drive: Drive, level: tuple[float, float, float, tuple[float, float]]) -> None:
    truth = lens_of(*level)
    result, real, virtual = drive(AlternatingMethod(task()), truth, task(), np.random.default_rng(1))
    found = result.lens(SIZE)
    errors, apart = relative_errors(truth, found), overlay(truth, found)
    print(
        f"fov {level[0]:g} deg, scenario {result.scenario}: {real} real + {virtual} virtual pictures, overlay "
        f"{apart.rms_px:.3f} px rms, {apart.max_px:.3f} px max, relative errors {errors}"
    )
    assert result.status is LevelStatus.OK
    assert errors["fov_x_deg"] is not None
    assert errors["k1"] is not None
    assert errors["fov_x_deg"] < 0.05
    assert errors["k1"] < 0.05
    assert errors["k2"] is None or errors["k2"] < 0.10
    assert (errors["k2"] is None) == (level[2] == 0.0)
    assert result.center_shift_px == pytest.approx(truth.center_shift_px, abs=0.05)
    assert real <= 5
    assert virtual <= 500


def test_scenario_1_leaves_k2_at_zero_and_needs_few_renders(drive: Drive) -> None:
    result, _, virtual = drive(AlternatingMethod(task()), lens_of(27.0, -0.06, 0.0), task(), np.random.default_rng(2))
    assert result.scenario == 1
    assert result.k2 == 0.0
    assert virtual < 40


def test_scenario_2_finds_k2_and_tells_what_it_cannot_tell(drive: Drive) -> None:
    result, _, virtual = drive(AlternatingMethod(task()), lens_of(48.0, -0.05, 0.01), task(), np.random.default_rng(3))
    assert result.scenario == 2
    assert virtual > 40
    assert result.residual_px is not None
    assert result.residual_px.max <= 0.11
    assert result.engine_overlay_px == result.residual_px
    assert result.sigma.fov_x_deg is None
    assert "no uncertainty" in result.reasons["predicted_overlay_px"]
    assert "nodal_offset_mm" in result.reasons


def test_knows_nothing_of_the_engine_s_model(drive: Drive) -> None:
    """An engine with its radius in half widths and the signs turned: other numbers, the same picture."""
    truth = lens_of(40.0, -0.06, 0.008)

    def engine(lens: Lens) -> Lens:
        return replace(lens, k1=-lens.k1 / lens.half_width**2, k2=-lens.k2 / lens.half_width**4)

    result, _, _ = drive(AlternatingMethod(task()), truth, task(), np.random.default_rng(4), engine=engine)
    assert result.status is LevelStatus.OK
    assert overlay(truth, engine(result.lens(SIZE))).max_px < 0.3


def test_scenario_3_an_engine_that_cannot_match_is_degraded_with_its_reason(drive: Drive) -> None:
    def engine(lens: Lens) -> Lens:
        return replace(lens, center_shift_px=(lens.center_shift_px[0] + 0.5, lens.center_shift_px[1]))

    truth = lens_of(34.0, -0.02, 0.0)
    result, _, virtual = drive(AlternatingMethod(task()), truth, task(), np.random.default_rng(5), engine=engine)
    assert result.status is LevelStatus.DEGRADED
    assert result.scenario == 3
    assert "forced steps" in (result.reason or "")
    assert virtual <= AlternatingSettings().max_trials + 3


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        ("k2", lambda lens: replace(lens, k2=0.0)),
        ("k1", lambda lens: replace(lens, k1=0.0)),
        ("fov_x_deg", lambda lens: replace(lens, f_px=2600.0)),
    ],
)
def test_a_coefficient_without_effect_is_named(drive: Drive, name: str, engine: Callable[[Lens], Lens]) -> None:
    truth = lens_of(40.0, -0.05, 0.015)
    result, _, _ = drive(AlternatingMethod(task()), truth, task(), np.random.default_rng(6), engine=engine)
    assert result.status is LevelStatus.FAILED
    assert (result.reason or "").startswith(f"{name} cannot be found")


def test_the_renders_are_bounded(drive: Drive) -> None:
    method = AlternatingMethod(task(), AlternatingSettings(max_trials=9))
    result, _, virtual = drive(method, lens_of(40.0, -0.06, 0.01), task(), np.random.default_rng(7))
    assert result.status is LevelStatus.FAILED
    assert "in 9 renders" in (result.reason or "")
    assert virtual == 9


def test_the_largest_target_that_fits_is_used(drive: Drive) -> None:
    for fov_x_deg, name in ((60.0, "big"), (8.0, "small")):
        method = AlternatingMethod(task())
        names = [captured.target for captured in _captures(method, lens_of(fov_x_deg, -0.01, 0.0))]
        assert set(names[2:]) == {name}


def test_a_target_bent_out_of_the_picture_is_taken_again_further_inside(drive: Drive) -> None:
    only = {"targets": {"small": TARGETS["small"]}}
    method = AlternatingMethod(task(**only), AlternatingSettings(margin=0.001, edge_offset=0.95))
    result, real, _ = drive(method, lens_of(40.0, 0.1, 0.0), task(**only), np.random.default_rng(8))
    assert result.status is LevelStatus.OK
    assert real > 4
    assert len(result.left_out) == real - 4
    assert "border" in result.left_out[0].reason


def test_a_guess_saves_renders(drive: Drive) -> None:
    truth = lens_of(40.0, -0.06, 0.0)
    _, _, without = drive(AlternatingMethod(task()), truth, task(), np.random.default_rng(9))
    known = task(guess=replace(truth, f_px=truth.f_px * 1.02))
    _, real, virtual = drive(AlternatingMethod(known), truth, known, np.random.default_rng(9))
    assert virtual < without
    assert real == 4


def test_a_head_that_turns_one_way_only_uses_the_other_side(drive: Drive) -> None:
    """The head cannot pan left of the target, so the target cannot come to the picture's right."""
    only = {"targets": {"small": TARGETS["small"]}, "pan_range_deg": (4.0, 90.0)}
    result, _, _ = drive(
        AlternatingMethod(task(**only)), lens_of(20.0, -0.04, 0.0), task(**only), np.random.default_rng(1)
    )
    assert result.status is LevelStatus.OK


def test_no_target_in_sight_fails_with_the_reasons() -> None:
    method = AlternatingMethod(task())
    while not method.done:
        capture = method.ask()
        assert capture is not None
        assert capture.source is Source.REAL
        method.tell(Observation(capture.step, Refusal("too dark"), task().pose(0.0, 0.0), f"p{capture.step}.png"))
    result = method.result()
    assert result.status is LevelStatus.FAILED
    assert "small: too dark; big: too dark" in (result.reason or "")
    assert [picture.picture for picture in result.left_out] == ["p0.png", "p1.png"]


def test_a_light_alone_is_refused_at_once() -> None:
    light = {"spot": Target(TargetKind.LIGHT, diameter_m=0.01, pose=TargetPose((0.0, 5.0, 1.6)))}
    method = AlternatingMethod(task(targets=light))
    assert method.done
    assert method.ask() is None
    assert "square or chessboard" in (method.result().reason or "")


def test_asks_for_one_picture_at_a_time() -> None:
    method = AlternatingMethod(task())
    with pytest.raises(NotEnoughData, match="not finished"):
        method.result()
    assert method.progress == pytest.approx(1 / 61)
    capture = method.ask()
    assert capture is not None
    assert (capture.step, capture.role, capture.source) == (0, Role.CENTER_SHIFT, Source.REAL)
    assert method.ask() is None
    with pytest.raises(InvalidInput, match="not the picture"):
        method.tell(Observation(7, Refusal("x"), task().pose(0.0, 0.0)))
    method.tell(Observation(0, Refusal("x"), task().pose(0.0, 0.0)))
    assert method.ask() is not None


@pytest.mark.parametrize("wrong", [{"threshold_px": 0.0}, {"edge_offset": 1.5}, {"max_trials": 0}])
def test_impossible_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInput):
        AlternatingSettings(**wrong)  # type: ignore[arg-type]


def _captures(method: AlternatingMethod, truth: Lens) -> list[Any]:
    """Every capture of a level without noise, in order."""
    rng, captures, in_engine = np.random.default_rng(0), [], truth
    while (capture := method.ask()) is not None:
        captures.append(capture)
        in_engine = capture.lens or in_engine
        lens = truth if capture.source is Source.REAL else in_engine
        pose = task().pose(capture.pan_deg, capture.tilt_deg)
        method.tell(Observation(capture.step, observe(lens, pose, TARGETS[capture.target], rng, 0.0), pose))
    return captures
