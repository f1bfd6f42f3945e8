"""Does a render show what a lens predicts: the poses that are looked at, and what is said of the render."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.camera import inside_picture
from calibration.errors import NotEnoughData
from calibration.lens import Lens
from calibration.solve.outcome import ENGINE_AGREES_PX
from calibration.solve.render_check import RenderAgreement, RenderCheck
from calibration.solve.search import Capture, LevelTask, Observation
from calibration.synthetic import observe
from calibration.types import Refusal, Target, TargetKind, TargetPose

SIZE = (1920, 1080)
LARGE = Target(TargetKind.CHESSBOARD, squares=(8, 8), square_m=0.12, pose=TargetPose((0.3, 5.0, 1.6), yaw_deg=8.0))
SMALL = Target(TargetKind.CHESSBOARD, squares=(8, 8), square_m=0.02, pose=TargetPose((-1.0, 5.0, 1.6)))
TASK = LevelTask(0.5, 0.5, SIZE, {"large": LARGE, "small": SMALL}, (0.0, 0.0, 1.6))
LENS = Lens.from_fov(SIZE, 50.0, k1=-0.15, k2=0.05, center_shift_px=(6.0, -4.0), nodal_offset_mm=80.0)
SIGMA_PX = 0.01


def run(
    check: RenderCheck,
    drawn: Lens,
    task: LevelTask = TASK,
    refuse: Callable[[Capture], bool] = lambda capture: False,
) -> tuple[RenderAgreement, list[Capture]]:
    """The check's end on an engine that draws ``drawn``, and what it asked for."""
    rng = np.random.default_rng(5)
    asked: list[Capture] = []
    while not check.done:
        capture = check.ask()
        if capture is None:
            break
        assert check.ask() is None, "one render at a time"
        asked.append(capture)
        pose = task.pose(capture.pan_deg, capture.tilt_deg)
        found = observe(drawn, pose, task.targets[capture.target], rng, SIGMA_PX)
        check.tell(Observation(capture.step, Refusal("nothing there") if refuse(capture) else found, pose))
    return check.result(), asked


def test_a_render_of_the_lens_agrees_from_the_middle_to_opposite_corners() -> None:
    agreement, asked = run(RenderCheck(LENS, LENS, TASK), LENS)
    assert agreement.trouble == ""
    assert agreement.renders == 3
    assert agreement.off_px is not None
    assert agreement.off_px.rms == pytest.approx(SIGMA_PX, rel=0.3)
    assert agreement.limit_px == ENGINE_AGREES_PX
    assert {capture.target for capture in asked} == {"large"}
    centres = [np.mean(capture.expected_px, axis=0) for capture in asked if capture.expected_px is not None]
    assert np.linalg.norm(centres[0] - np.array([959.5, 539.5])) < 10
    assert np.all(centres[1] - centres[0] > 50)
    assert np.all(centres[2] - centres[0] < -50)


@pytest.mark.parametrize(
    "drawn",
    [
        replace(LENS, center_shift_px=(6.0, -3.7)),
        replace(LENS, k1=-0.14),
        replace(LENS, f_px=LENS.f_px * 1.002),
        replace(LENS, nodal_offset_mm=120.0),
    ],
)
def test_an_engine_that_draws_another_lens_is_off_by_its_pixels(drawn: Lens) -> None:
    agreement, _ = run(RenderCheck(LENS, LENS, TASK), drawn)
    assert agreement.off_px is not None
    assert agreement.off_px.max > ENGINE_AGREES_PX
    assert f"up to {agreement.off_px.max:.2f} px off" in agreement.trouble
    allowed, _ = run(RenderCheck(LENS, LENS, TASK, limit_px=agreement.off_px.max + 0.01), drawn)
    assert allowed.trouble == ""
    known, _ = run(RenderCheck(LENS, LENS, TASK, known_px=agreement.off_px.max + 0.01), drawn)
    assert known.trouble == ""


def test_a_target_not_found_in_the_middle_is_a_disagreement() -> None:
    agreement, asked = run(RenderCheck(LENS, LENS, TASK), LENS, refuse=lambda capture: capture.step == 0)
    assert "the target large was not found in the engine's render: nothing there" in agreement.trouble
    assert len(asked) == 1


def test_a_target_not_found_in_a_corner_is_looked_at_once_more_nearer_to_the_middle() -> None:
    agreement, asked = run(RenderCheck(LENS, LENS, TASK), LENS, refuse=lambda capture: capture.step == 1)
    assert (agreement.trouble, agreement.renders, len(asked)) == ("", 3, 4)
    assert abs(asked[2].pan_deg - asked[0].pan_deg) < abs(asked[1].pan_deg - asked[0].pan_deg)
    agreement, _ = run(RenderCheck(LENS, LENS, TASK), LENS, refuse=lambda capture: capture.step in (1, 2))
    assert "not found" in agreement.trouble


@given(st.floats(4.0, 75.0), st.floats(-0.09, 0.09), st.floats(-0.01, 0.02))
def test_every_view_shows_the_whole_target_whatever_the_lens(fov_x_deg: float, k1_hw: float, k2_hw: float) -> None:
    straight = Lens.from_fov(SIZE, fov_x_deg)
    lens = straight.with_hw(straight.f_px, k1_hw, k2_hw)
    agreement, asked = run(RenderCheck(lens, lens, TASK), lens)
    assert agreement.trouble == ""
    for capture in asked:
        assert capture.expected_px is not None
        assert inside_picture(capture.expected_px, SIZE)


def test_no_target_that_suits_the_lens_is_told() -> None:
    lens = Lens.from_fov(SIZE, 2.0)
    with pytest.raises(NotEnoughData, match="no target suits a field of view of 2"):
        RenderCheck(lens, lens, replace(TASK, targets={"large": LARGE}))


def test_a_target_out_of_the_heads_reach_is_told() -> None:
    behind = replace(LARGE, pose=TargetPose((0.0, -5.0, 1.6), yaw_deg=180.0))
    task = replace(TASK, targets={"behind": behind})
    agreement, asked = run(RenderCheck(LENS, LENS, task), LENS, task)
    assert asked == []
    assert "cannot be brought into the middle" in agreement.trouble
