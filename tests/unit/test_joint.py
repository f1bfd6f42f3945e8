"""The joint method against perfect detectors: few pictures, the goal reached, everything that can go wrong named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibration.compare import overlay
from calibration.errors import FoldedLens, InvalidInput, NotEnoughData
from calibration.lens import Lens
from calibration.solve import joint
from calibration.solve.joint import JointMethod
from calibration.solve.search import Capture, LevelTask, Observation, Source
from calibration.synthetic import observe
from calibration.tables import LevelResult, LevelStatus
from calibration.types import DetectionResult, Refusal, Target, TargetKind, TargetPose

SIZE = (1920, 1080)
TARGETS = {
    "large": Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((-0.6, 5.0, 1.6))),
    "small": Target(TargetKind.CHESSBOARD, squares=(8, 6), square_m=0.03, pose=TargetPose((0.35, 5.0, 1.6))),
}
Engine = Callable[[Lens], Lens]


def task(guess: Lens | None = None) -> LevelTask:
    return LevelTask(0.5, 0.25, SIZE, TARGETS, (0.0, 0.0, 1.6), guess=guess)


def drive(
    method: JointMethod,
    truth: Lens,
    level: LevelTask,
    *,
    seed: int = 1,
    sigma_px: float = 0.02,
    engine_sigma_px: float = 0.005,
    engine: Engine = lambda lens: lens,
    refuse: Callable[[Capture], str | None] = lambda capture: None,
) -> tuple[LevelResult, list[Capture]]:
    rng = np.random.default_rng(seed)
    captures: list[Capture] = []
    waiting: list[Capture] = []
    while not method.done:
        capture = method.ask()
        if capture is not None:
            captures.append(capture)
            waiting.append(capture)
            assert len(captures) < 80
            continue
        if method.done:
            break
        told = waiting.pop(0)
        pose = level.pose(told.pan_deg, told.tilt_deg)
        target = level.targets[told.target]
        why = refuse(told)
        result: DetectionResult
        if why:
            result = Refusal(why)
        elif told.source is Source.REAL:
            result = observe(truth, pose, target, rng, sigma_px)
        else:
            assert told.lens is not None
            result = observe(engine(told.lens), pose, target, rng, engine_sigma_px)
        method.tell(Observation(told.step, result, pose, f"picture {told.step}"))
    return method.result(), captures


def lens(fov: float, k1_hw: float, k2_hw: float, shift: tuple[float, float] = (5.0, -3.0)) -> Lens:
    straight = Lens.from_fov(SIZE, fov, center_shift_px=shift)
    return straight.with_hw(straight.f_px, k1_hw, k2_hw)


@pytest.mark.parametrize(
    "truth",
    [lens(62, -0.1, 0.02), lens(40, -0.03, 0.005), lens(25, 0.0, 0.0), lens(14, 0.02, 0.0), lens(8, 0.03, -0.002)],
)
def test_a_level_takes_few_pictures_and_reaches_a_tenth_of_a_pixel(truth: Lens) -> None:
    level = task()
    result, captures = drive(JointMethod(level), truth, level)
    assert result.status is LevelStatus.OK
    assert len(captures) <= 16
    assert overlay(truth, result.lens(SIZE)).max_px < 0.15
    assert result.engine_overlay_px is not None
    assert result.engine_overlay_px.max < 0.15
    assert result.nodal_offset_mm is None or abs(result.nodal_offset_mm) < 2


def test_a_guess_from_the_level_before_saves_a_picture() -> None:
    truth = lens(40, -0.03, 0.005)
    level = task(guess=lens(41, -0.03, 0.004))
    _, with_guess = drive(JointMethod(level), truth, level)
    _, without = drive(JointMethod(task()), truth, task())
    assert len(with_guess) <= len(without)


def test_an_engine_with_another_lens_model_is_searched_not_believed() -> None:
    truth = lens(62, -0.1, 0.02)
    level = task()

    def half_width(values: Lens) -> Lens:  # an engine that takes k1, k2 with radius 1 at half width
        return values.with_hw(values.f_px, values.k1, values.k2)

    result, captures = drive(JointMethod(level), truth, level, engine=half_width)
    assert result.status is LevelStatus.OK, result.reason
    assert overlay(truth, result.lens(SIZE)).max_px < 0.15
    told = result.engine_values
    assert told is not None, "the engine is not asked for the lens itself"
    drawn = half_width(Lens.from_fov(SIZE, told.fov_x_deg, told.k1, told.k2, told.center_shift_px))
    assert overlay(truth, drawn).max_px < 0.3
    assert len(captures) <= 40


def test_an_engine_that_cannot_draw_the_lens_is_said_so() -> None:
    truth = lens(62, -0.02, 0.0)
    level = task()

    def straight(values: Lens) -> Lens:  # an engine that takes no notice of k1 and k2
        return replace(values, k1=0.0, k2=0.0)

    result, captures = drive(JointMethod(level), truth, level, engine=straight)
    assert result.status is LevelStatus.DEGRADED
    assert "could not be brought nearer" in (result.reason or "")
    assert result.engine_overlay_px is not None
    assert result.engine_overlay_px.max > 0.3
    assert overlay(truth, result.lens(SIZE)).max_px < 0.15
    assert len(captures) < 80


def test_a_target_that_is_nowhere_fails_with_every_reason() -> None:
    level = task()
    with pytest.raises(NotEnoughData, match=r"no target was found .*too dark"):
        drive(JointMethod(level), lens(40, 0, 0), level, refuse=lambda c: "too dark")


def test_single_refusals_are_left_out_with_their_reasons() -> None:
    truth = lens(40, -0.03, 0.005)
    level = task()
    result, _ = drive(JointMethod(level), truth, level, refuse=lambda c: "a person in front" if c.step == 3 else None)
    assert any(out.reason == "a person in front" for out in result.left_out)
    assert overlay(truth, result.lens(SIZE)).max_px < 0.15


def test_an_unreadable_render_leaves_the_level_usable_with_the_reason() -> None:
    truth = lens(40, -0.03, 0.005)
    level = task()
    result, _ = drive(
        JointMethod(level), truth, level, refuse=lambda c: "black" if c.source is Source.VIRTUAL else None
    )
    assert result.engine_overlay_px is None
    assert "black" in result.reasons["engine_overlay_px"]


def test_a_light_is_never_looked_for_and_alone_is_refused() -> None:
    light = {"light": Target(TargetKind.LIGHT, diameter_m=0.01, pose=TargetPose((0.0, 5.0, 1.6)))}
    truth = lens(8, 0.03, 0.0)
    level = replace(task(), targets={**light, **TARGETS})
    _, captures = drive(JointMethod(level), truth, level)
    assert {capture.target for capture in captures} <= set(TARGETS)
    with pytest.raises(InvalidInput, match="a board or a square"):
        JointMethod(replace(level, targets=light))


@pytest.mark.parametrize("truth", [lens(95, -0.15, 0.02), lens(55, -0.05, 0.005), lens(100, -0.12, 0.01)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_strong_bend_does_not_fold_the_first_pictures(truth: Lens, seed: int) -> None:
    """One picture in the middle hardly tells k1 and k2: a fold that comes of it must not end the level."""
    level = task()
    result, _ = drive(JointMethod(level), truth, level, seed=seed, sigma_px=0.2 if seed == 3 else 0.02)
    assert result.status is not LevelStatus.FAILED
    assert not any("folds" in out.reason for out in result.left_out)
    assert overlay(truth, result.lens(SIZE)).max_px < (2.0 if seed == 3 else 0.15)


def test_a_render_whose_corners_are_uncertain_is_no_disagreement() -> None:
    """An engine without anti-aliasing draws corners to 0.3 px only, and the detector says so."""
    truth = lens(40, -0.03, 0.005)
    level = task()
    result, _ = drive(JointMethod(level), truth, level, engine_sigma_px=0.3)
    assert result.engine_overlay_px is not None
    assert result.engine_overlay_px.max > 0.5
    assert result.status is LevelStatus.OK


def test_a_bend_held_for_aiming_is_never_published(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three pictures whose full fit folds, and no more to be had: the level fails, it does not say k1 = 0."""
    solve = joint.solve_level

    def folding(*arguments: object, straight: bool, **named: object) -> object:
        if not straight:
            raise FoldedLens(0.5, 0.6)
        return solve(*arguments, straight=True, **named)  # type: ignore[arg-type]  # passed on as they came

    monkeypatch.setattr(joint, "solve_level", folding)
    truth = lens(40, -0.03, 0.005)
    level = task()
    with pytest.raises(NotEnoughData, match="do not tell the lens's bend"):
        drive(JointMethod(level), truth, level, refuse=lambda c: "a person in front" if c.step > 2 else None)
