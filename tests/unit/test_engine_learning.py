"""Learning an engine from its renders: every kind of engine, noise, what cannot be told, and refusal."""

from __future__ import annotations

import numpy as np
import pytest

from app.engines import EngineFacts
from app.jobs.engine import disagreements
from benchmarks.engine import learn, right_model
from benchmarks.engine_corners import SENSOR_MM, SIZE, Array, CornerEngine, Level, Warp, level_of
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.solve.engine_fit import LearnedEngine
from calibration.solve.engine_learning import EngineLearning
from calibration.solve.search import LevelTask, Observation
from calibration.types import DetectionResult, Refusal, Target, TargetKind, TargetPose
from engine_adapters.sim.engine_camera import EngineCamera

FACTS = EngineFacts(SIZE, 1.0, SENSOR_MM[0])
WIDE, MIDDLE, LONG = (62.0, -0.1, 0.02), (30.0, -0.02, 0.003), (11.0, 0.02, 0.0)


def level(fov: float, k1_hw: float, k2_hw: float) -> Level:
    straight = Lens.from_fov(SIZE, fov, center_shift_px=(5.0, -3.0))
    return level_of(straight.with_hw(straight.f_px, k1_hw, k2_hw), np.random.default_rng(3))


def learned_from(
    *settings: str, truth: tuple[float, float, float] = WIDE, sigma_px: float = 0.005, warp: Warp | None = None
) -> LearnedEngine:
    engine = CornerEngine(EngineCamera.parse(settings), np.random.default_rng(5), sigma_px=sigma_px, warp=warp)
    learned = learn(level(*truth), engine)
    assert engine.renders <= 16
    return learned


CASES: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    ((), ()),
    (("radius_unit=half_width", "overscan=1.1"), ("radius_unit", "1.1 times as wide")),
    (("radius_unit=half_height",), ("radius_unit says focal_length, the engine behaves as half_height",)),
    (("radius_unit=half_diagonal", "distortion_sign=-1"), ("half_diagonal", "opposite sign")),
    (("radius_unit=sensor_mm",), ("the engine behaves as sensor_mm",)),
    (("direction=reverse", "center_shift_sign_x=-1"), ("the engine behaves as reverse", "center_shift_sign_x")),
    (("center_shift=absolute_pixel",), ("center_shift says offset, the engine behaves as absolute_pixel",)),
    (("fov_axis=y", "center_shift_sign_y=-1"), ("fov_axis says x, the engine behaves as y", "center_shift_sign_y")),
    (("nodal_unit=m", "nodal_sign=-1"), ("nodal_unit", "nodal_sign")),
]


@pytest.mark.parametrize(
    ("settings", "said", "truth"),
    [(*case, WIDE) for case in CASES]
    # Through a long lens the target is small, and smaller still where the engine's field is wider.
    + [(("center_shift=absolute_pixel", "fov_axis=y"), ("absolute_pixel", "fov_axis"), LONG)],
)
def test_every_kind_of_engine_is_told_and_named(
    settings: tuple[str, ...], said: tuple[str, ...], truth: tuple[float, float, float]
) -> None:
    learned = learned_from(*settings, truth=truth)
    assert learned.trusted, learned.reason
    assert learned.rms_px < 0.01
    right = right_model(EngineCamera.parse(settings))
    assert (learned.model.direction, learned.model.unit_power) == (right.direction, right.unit_power)
    assert learned.model.focal_gain == pytest.approx(right.focal_gain, rel=1e-4)
    assert learned.model.k1_gain == pytest.approx(right.k1_gain, rel=1e-3)
    lines = disagreements(learned.model, FACTS)
    assert len(lines) == len(said), lines
    for words in said:
        assert any(words in line for line in lines), lines


def test_an_engine_that_is_as_its_profile_says_takes_nine_renders_and_is_the_identity() -> None:
    learned = learned_from(truth=MIDDLE)
    assert learned.renders == 9
    right = right_model(EngineCamera())
    assert learned.model == right


def test_noise_does_not_change_what_is_told() -> None:
    learned = learned_from("radius_unit=half_width", "direction=reverse", sigma_px=0.1)
    assert learned.trusted, learned.reason
    lines = disagreements(learned.model, FACTS)
    assert {line.split(" ")[0] for line in lines} == {"engine.radius_unit", "engine.direction"}


def tangential(pixels: Array) -> Array:
    x, y = ((pixels - 960) / 960).T
    return np.asarray(pixels + 960 * np.stack([0.002 * (3 * x * x + y * y), 0.004 * x * y], axis=-1))


def sixth_order(pixels: Array) -> Array:
    """Some px in the frame's corner, and next to nothing in its middle."""
    middle = (np.asarray(SIZE) - 1) / 2
    away = (pixels - middle) / 960
    return np.asarray(middle + 960 * away * (1 + 0.02 * np.sum(away**2, axis=-1, keepdims=True) ** 3))


@pytest.mark.parametrize("warp", [tangential, sixth_order])
@pytest.mark.parametrize("truth", [WIDE, MIDDLE])
def test_an_engine_that_no_model_describes_is_not_trusted(warp: Warp, truth: tuple[float, float, float]) -> None:
    learned = learned_from(warp=warp, truth=truth)
    assert not learned.trusted
    assert "explains" in learned.reason or "alike" in learned.reason


def test_renders_too_noisy_to_tell_two_models_apart_are_not_trusted() -> None:
    learned = learned_from(sigma_px=2.0)
    assert not learned.trusted
    assert "two models explain" in learned.reason


def shown(count: int, *, stale: bool) -> LearnedEngine:
    """Learn where only the first renders are what was asked for: after them the last comes again, or nothing."""
    room = level(*MIDDLE)
    engine = CornerEngine(EngineCamera(), np.random.default_rng(5))
    learning = EngineLearning(room.task)
    last: DetectionResult = Refusal("black")
    while (capture := learning.ask()) is not None and capture.lens is not None:
        assert capture.step < 30
        pose = room.task.pose(capture.pan_deg, capture.tilt_deg)
        if engine.renders < count:
            last = engine.render(capture.lens, pose, room.task.targets[capture.target])
        elif not stale:
            last = Refusal("black")
        learning.tell(Observation(capture.step, last, pose))
    return learning.result()


@pytest.mark.parametrize("count", [1, 3, 8])
def test_a_render_that_does_not_change_is_never_learned_from(count: int) -> None:
    learned = shown(count, stale=True)
    assert not learned.trusted
    assert "did not change with the lens asked for" in learned.reason


@pytest.mark.parametrize(("count", "why"), [(0, "not found in any"), (3, "found in 3 of")])
def test_a_target_that_is_not_seen_says_so_with_the_reason(count: int, why: str) -> None:
    learned = shown(count, stale=False)
    assert not learned.trusted
    assert why in learned.reason
    assert "black" in learned.reason


def test_a_light_teaches_no_engine() -> None:
    light = Target(TargetKind.LIGHT, diameter_m=0.05, pose=TargetPose((0.0, 5.0, 1.6)))
    with pytest.raises(InvalidInput, match="board or a square"):
        EngineLearning(LevelTask(0.0, 0.0, SIZE, {"light": light}, (0.0, 0.0, 1.6)))
