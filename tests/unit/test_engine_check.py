"""The last step of a level in front of an engine: one render where it was learned, a search where it was not, and never
an agreement that is none."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.engine import check, learn
from benchmarks.engine_corners import CornerEngine, Level, Warp, level_of
from calibration.errors import NotEnoughData
from calibration.lens import Lens
from calibration.solve.engine_check import MOST_RENDERS, EngineAgreement, EngineCheck
from calibration.solve.engine_model import EngineModel
from calibration.solve.outcome import level_result
from calibration.tables import LevelStatus
from calibration.types import Refusal
from engine_adapters.sim.engine_camera import EngineCamera
from tests.unit.test_engine_learning import SIZE, sixth_order, tangential

MILD = (40.0, -0.03, 0.005)


def level(fov: float, k1_hw: float, k2_hw: float) -> Level:
    straight = Lens.from_fov(SIZE, fov, center_shift_px=(5.0, -3.0))
    return level_of(straight.with_hw(straight.f_px, k1_hw, k2_hw), np.random.default_rng(9))


def checked(
    *settings: str, model: EngineModel | None = None, warp: Warp | None = None
) -> tuple[EngineAgreement, CornerEngine, Level]:
    """A level in front of an engine that is learned first, or taken to be as ``model`` says."""
    room = level(*MILD)
    engine = CornerEngine(EngineCamera.parse(settings), np.random.default_rng(4), warp=warp)
    if model is None:
        learned = learn(room, engine)
        assert learned.trusted, learned.reason
        model = learned.model
    engine.renders = 0
    _, agreement = check(room, engine, model)
    assert agreement is not None
    assert agreement.renders == engine.renders <= MOST_RENDERS + 20
    return agreement, engine, room


def off_px(agreement: EngineAgreement, engine: CornerEngine, room: Level) -> float:
    return float(np.sqrt(np.mean(engine.off_px(agreement.asked, room.fit.lens) ** 2)))


@pytest.mark.parametrize(
    "settings",
    [(), ("radius_unit=half_width", "overscan=1.1"), ("center_shift_sign_x=-1",), ("center_shift=absolute_pixel",)],
)
def test_a_learned_engine_takes_one_render(settings: tuple[str, ...]) -> None:
    agreement, engine, room = checked(*settings)
    assert (agreement.renders, agreement.searched, agreement.trouble) == (1, "model", "")
    assert off_px(agreement, engine, room) < 0.01


def test_a_reverse_polynomial_that_cannot_draw_the_lens_is_degraded_with_its_pixels() -> None:
    room = level(62.0, -0.1, 0.02)
    engine = CornerEngine(EngineCamera.parse(("direction=reverse",)), np.random.default_rng(4))
    learned = learn(room, engine)
    checking, agreement = check(room, engine, learned.model)
    assert checking.renders == 1
    shortfall = learned.model.shortfall_px(room.fit.lens)
    assert shortfall > 1.0
    result = level_result(room.fit, 0, 0, held_out={}, engine=agreement, engine_shortfall_px=shortfall)
    assert result.status is LevelStatus.DEGRADED
    assert result.reason is not None
    assert f"nearer than {shortfall:.2f} px" in result.reason


@pytest.mark.parametrize("settings", [("overscan=1.02", "center_shift_sign_y=-1"), ("overscan=1.02",)])
def test_an_engine_that_is_not_as_believed_is_searched(settings: tuple[str, ...]) -> None:
    agreement, engine, room = checked(*settings, model=EngineModel())
    assert agreement.trouble == ""
    assert agreement.searched != "model"
    assert agreement.renders > 3
    assert off_px(agreement, engine, room) < 0.1


@pytest.mark.parametrize(
    "settings", [("radius_unit=half_width",), ("radius_unit=sensor_mm", "distortion_sign=-1", "overscan=1.1")]
)
def test_what_is_far_from_the_profile_is_found_or_said(settings: tuple[str, ...]) -> None:
    agreement, engine, room = checked(*settings, model=EngineModel())
    assert agreement.searched in ("Broyden", "finite differences")
    assert agreement.trouble or off_px(agreement, engine, room) < 0.1


@pytest.mark.parametrize("warp", [tangential, sixth_order])
def test_what_no_value_brings_to_agree_is_said_with_its_pixels(warp: Warp) -> None:
    agreement, _, _ = checked(model=EngineModel(), warp=warp)
    assert agreement.searched != "model"
    assert "could not be brought nearer than" in agreement.trouble or "not found" in agreement.trouble


def test_an_engine_that_does_not_follow_k1_says_so() -> None:
    room = level(*MILD)
    deaf = EngineModel(k1_gain=0.0)
    checking = EngineCheck(room.fit.lens, room.views, deaf)
    engine = CornerEngine(EngineCamera(), np.random.default_rng(4))
    while (wanted := checking.ask()) is not None:
        pose = wanted.view.camera_pose
        assert pose is not None
        straight = wanted.asked.with_hw(wanted.asked.f_px, 0.0, wanted.asked.k2_hw)
        checking.tell(engine.render(straight, pose, wanted.view.target))
    assert checking.result().trouble


def test_a_render_without_the_target_is_never_an_agreement() -> None:
    room = level(*MILD)
    checking = EngineCheck(room.fit.lens, room.views, EngineModel())
    while checking.ask() is not None:
        checking.tell(Refusal("black"))
    assert checking.done
    with pytest.raises(NotEnoughData, match="not found in the engine's render: black"):
        checking.result()


def test_the_same_render_is_asked_for_until_it_is_told() -> None:
    room = level(*MILD)
    checking = EngineCheck(room.fit.lens, room.views, EngineModel())
    assert checking.ask() is checking.ask()
    assert not checking.done


def test_pictures_without_a_pose_cannot_be_compared() -> None:
    room = level(*MILD)
    with pytest.raises(NotEnoughData, match="known pose"):
        EngineCheck(room.fit.lens, [], EngineModel())
