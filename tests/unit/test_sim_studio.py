"""The studio's state: values, delay, movements, tracking; no sockets, no waiting."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine_adapters.sim.camera_output import CameraOutput, PayloadStyle, PictureFormat
from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.lens_truth import parse_lens
from engine_adapters.sim.room import build_room
from engine_adapters.sim.studio import OutputState, Studio, StudioError, StudioSetup

SCENE = "Lensmatch/Calibration"
PICTURE_TIME_S = 0.015


class Clock:
    """Time that passes only when told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def build(clock: Clock, **setup: float) -> Studio:
    lens = parse_lens(
        {
            "lens_truth": 1,
            "image_size": [320, 180],
            "sensor_mm": [9.6, 5.4],
            "levels": [
                {"zoom": 0.0, "focus": 0.5, "fov_x_deg": 60.0, "k1": -0.1, "noise_sigma": 2.0},
                {"zoom": 1.0, "focus": 0.5, "fov_x_deg": 30.0},
            ],
        }
    )
    return Studio(lens, build_room(), StudioSetup(**setup), clock=clock)  # type: ignore[arg-type]


def shown(studio: Studio, clock: Clock) -> OutputState:
    return studio.output(studio.frame_at(clock()))


def test_an_untuned_engine_shows_both_layers_with_its_own_lens() -> None:
    clock = Clock()
    state = shown(build(clock), clock)
    assert state.real is not None
    assert state.virtual is not None
    assert state.virtual.optics.f_px == pytest.approx(160 / math.tan(math.radians(25)))
    assert state.real[0].optics.f_px == pytest.approx(160 / math.tan(math.radians(30)))


@pytest.mark.parametrize("delay", [0, 1, 2, 5])
def test_a_change_shows_after_exactly_the_delay(delay: int) -> None:
    clock = Clock()
    studio = build(clock, delay_frames=delay)
    for step in range(1, 8):
        clock.now_s += PICTURE_TIME_S * 20.37
        set_in = studio.frame_at(clock())
        studio.set_value(SCENE, "lens.fov_x", str(40 + step))
        f_px = 160 / math.tan(math.radians((40 + step) / 2))
        visible = [
            state.virtual is not None and state.virtual.optics.f_px == pytest.approx(f_px)
            for state in (studio.output(set_in + offset) for offset in range(-1, 8))
        ]
        assert visible == [offset >= delay for offset in range(-1, 8)]


def test_layers_are_switched_apart_and_nothing_is_black() -> None:
    clock = Clock()
    studio = build(clock, delay_frames=0)
    for background in ("1", "0"):
        for thing in ("true", "false"):
            studio.set_value(SCENE, "background.visible", background)
            studio.set_value(SCENE, "object.visible", thing)
            clock.now_s += 1.0
            state = shown(studio, clock)
            assert (state.real is not None) is (background == "1")
            assert (state.virtual is not None) is (thing == "true")
    output = CameraOutput(studio.room, studio.lens.image_size, seed=1, statistics=studio.statistics)
    assert not output.picture(OutputState(None, None)).any()


def test_the_head_turns_at_its_speed_and_is_delayed_like_a_value() -> None:
    clock = Clock()
    studio = build(clock, delay_frames=2, head_speed_deg_s=100.0)
    stands_in_s = studio.move(pan_deg=-30.0, tilt_deg=10.0)
    assert stands_in_s == pytest.approx(0.35)
    clock.now_s += 0.15
    assert studio.head().pan_deg == pytest.approx(-15.0)
    late = shown(studio, clock)
    assert late.real is not None
    # One frame counts as what it shows at its end.
    assert -15.0 < late.real[0].pan_deg <= -15.0 + 100.0 * 2 * PICTURE_TIME_S
    clock.now_s += 0.5
    settled = shown(studio, clock)
    assert settled.real is not None
    assert settled.virtual is not None
    assert (settled.real[0].pan_deg, settled.virtual.tilt_deg) == (-30.0, 10.0)
    assert settled == studio.standing()


def test_the_lens_takes_half_a_second_from_end_to_end_and_a_stay_takes_nothing() -> None:
    clock = Clock()
    studio = build(clock)
    assert studio.move(zoom=1.0, focus=0.5) == pytest.approx(0.55)
    clock.now_s += 1.0
    assert studio.head().zoom == 1.0
    assert studio.move(zoom=1.0, pan_deg=0.0) == 0.0
    assert studio.stats()["movements"] == 1
    assert studio.stats()["movements_s"] == pytest.approx(0.55)


def test_a_new_goal_in_the_middle_of_a_movement_starts_from_there() -> None:
    clock = Clock()
    studio = build(clock, head_speed_deg_s=10.0)
    studio.move(pan_deg=20.0)
    clock.now_s += 1.0
    assert studio.move(pan_deg=0.0) == pytest.approx(1.05)
    clock.now_s += 0.5
    assert studio.head().pan_deg == pytest.approx(5.0)


@pytest.mark.parametrize(
    "goal",
    [
        {"pan_deg": math.nan},
        {"pan_deg": 171.0},
        {"tilt_deg": -61.0},
        {"tilt_deg": 91.0},
        {"zoom": 1.1},
        {"focus": -0.1},
    ],
)
def test_goals_out_of_range_are_refused_and_nothing_moves(goal: dict[str, float]) -> None:
    clock = Clock()
    studio = build(clock)
    with pytest.raises(StudioError, match="out of range"):
        studio.move(**goal)
    clock.now_s += 5.0
    assert studio.head().pan_deg == 0.0


@pytest.mark.parametrize(
    ("export", "value"),
    [
        ("lens.k1", "abc"),
        ("lens.k1", "nan"),
        ("lens.k1", "1e400"),
        ("lens.fov_x", "0"),
        ("lens.fov_x", "-5"),
        ("lens.fov_x", "180"),
        ("object.visible", "2"),
        ("none", "1"),
    ],
)
def test_values_the_engine_cannot_take_are_refused_and_change_nothing(export: str, value: str) -> None:
    clock = Clock()
    studio = build(clock)
    before = studio.standing()
    with pytest.raises(StudioError):
        studio.set_value(SCENE, export, value)
    assert studio.standing() == before


def test_values_come_back_as_they_were_written_and_exports_can_be_renamed() -> None:
    studio = build(Clock())
    studio.set_value(SCENE, "lens.k2", " 1.50e-2")
    assert studio.get_value(SCENE, "lens.k2") == " 1.50e-2"
    studio.rename(SCENE, "lens.k2", "second")
    assert studio.get_value(SCENE, "second") == " 1.50e-2"
    with pytest.raises(StudioError, match="EXPORT NOT FOUND"):
        studio.get_value(SCENE, "lens.k2")
    with pytest.raises(StudioError, match="NAME IN USE"):
        studio.rename(SCENE, "second", "lens.k1")
    with pytest.raises(StudioError, match="SCENE NOT FOUND"):
        studio.get_value("other/scene", "second")


def test_the_history_does_not_grow_for_ever() -> None:
    clock = Clock()
    studio = build(clock)
    for number in range(5000):
        clock.now_s += PICTURE_TIME_S
        studio.set_value(SCENE, "lens.k1", str(number * 1e-6))
        studio.move(pan_deg=number % 2)
    assert len(studio._values) < 1500
    assert len(studio._moves) < 1500
    assert studio.get_value(SCENE, "lens.k1") == str(4999 * 1e-6)


def test_tracking_tells_the_pose_and_a_view_matrix_that_fits_it() -> None:
    clock = Clock()
    studio = build(clock)
    studio.move(pan_deg=20.0, tilt_deg=-5.0)
    clock.now_s += 10.0
    packet = studio.tracking("Cam0")
    assert (packet["RotZ"], packet["RotX"], packet["RotY"]) == (20.0, -5.0, 0.0)
    matrix = np.array(packet["ViewMatrix"]).reshape(4, 4)
    state = shown(studio, clock)
    assert state.virtual is not None
    point = np.array([0.3, 5.0, 1.9])
    assert matrix[:3] @ [*point, 1.0] == pytest.approx(state.virtual.to_camera(point[np.newaxis])[0])
    with pytest.raises(StudioError):
        studio.tracking("Cam9")


def test_noise_is_fresh_for_each_picture_has_its_strength_and_is_the_same_for_a_seed() -> None:
    clock = Clock()
    studio = build(clock)
    state = OutputState(shown(studio, clock).real, None)
    assert state.real is not None
    quiet = OutputState((*state.real[:2], 0.0), None)
    outputs = [CameraOutput(studio.room, (320, 180), seed=7, statistics=studio.statistics) for _ in range(2)]
    clean = outputs[0].picture(quiet).astype(int)
    first, second = (outputs[0].picture(state).astype(int) for _ in range(2))
    assert np.array_equal(first, outputs[1].picture(state))
    middle = (clean > 20) & (clean < 235)
    assert np.std((first - clean)[middle]) == pytest.approx(2.02, abs=0.05)
    assert abs(np.corrcoef((first - clean)[middle], (second - clean)[middle])[0, 1]) < 0.02


@pytest.mark.parametrize("picture_format", list(PictureFormat))
@pytest.mark.parametrize("style", list(PayloadStyle))
def test_payloads_hold_the_picture(style: PayloadStyle, picture_format: PictureFormat) -> None:
    import base64
    import json

    from calibration.image import decode_picture

    clock = Clock()
    studio = build(clock)
    output = CameraOutput(studio.room, (320, 180), seed=7, statistics=studio.statistics)
    state = OutputState(None, shown(studio, clock).virtual)
    text = output.payload(state, style, picture_format).decode("ascii")
    if style is PayloadStyle.JSON:
        text = json.loads(text)
    elif style is PayloadStyle.DATA_URI:
        head, text = text.split(",")
        assert head == f"data:image/{picture_format.value};base64"
    picture = decode_picture(base64.b64decode(text, validate=True), expected_size=(320, 180)).astype(int)
    difference = np.abs(picture - output.picture(state))
    assert difference.mean() < 3.0
    assert picture_format is PictureFormat.JPEG or difference.max() == 0


@pytest.mark.parametrize(
    "wrong", [{"delay_frames": -1}, {"picture_time_s": 0.0}, {"picture_time_s": math.nan}, {"head_speed_deg_s": 0.0}]
)
def test_impossible_setups_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SimulatorError):
        StudioSetup(**wrong)  # type: ignore[arg-type]
