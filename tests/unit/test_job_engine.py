"""Where an engine contradicts its studio profile: each setting by its name, and nothing for a profile that is right."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.engines import EngineFacts
from app.jobs.engine import disagreements
from calibration.solve.engine_model import Direction, EngineModel

SIZE = (1920, 1080)
FACTS = EngineFacts(SIZE, 1.0, 9.6)
HALF_WIDTH = EngineModel(unit_power=1)
"""An engine that counts in half widths behind a profile that says focal lengths."""

CASES = [
    (FACTS, HALF_WIDTH, "engine.radius_unit says focal_length, the engine behaves as half_width"),
    (
        replace(FACTS, radius_unit="half_width"),
        EngineModel(unit_power=-1),
        "engine.radius_unit says half_width, the engine behaves as focal_length",
    ),
    (
        replace(FACTS, radius_unit="half_width"),
        EngineModel(k1_gain=(1920 / 1080) ** 2, k2_gain=(1920 / 1080) ** 4),
        "engine.radius_unit says half_width, the engine behaves as half_height",
    ),
    (FACTS, EngineModel(k1_gain=1.3, k2_gain=1.1), "engine.radius_unit says focal_length, the engine takes k1 1.3"),
    (
        FACTS,
        EngineModel(direction=Direction.REVERSE),
        "engine.direction says undistorted_to_distorted, the engine behaves as reverse",
    ),
    (
        replace(FACTS, direction="reverse"),
        EngineModel(),
        "engine.direction says reverse, the engine behaves as undistorted_to_distorted",
    ),
    (FACTS, EngineModel(k1_gain=-1.0, k2_gain=-1.0), "the engine takes k1 and k2 with the opposite sign"),
    (
        FACTS,
        EngineModel(shift_gain=(-1.0, 1.0)),
        "engine.center_shift_sign_x says 1, the engine behaves as -1",
    ),
    (
        replace(FACTS, center_shift_signs=(1, -1)),
        EngineModel(shift_gain=(1.0, -1.0)),
        "engine.center_shift_sign_y says -1, the engine behaves as 1",
    ),
    (FACTS, EngineModel(shift_gain=(1.0, 2.0)), "the engine moves the centre 2 times as far as asked (y)"),
    (
        FACTS,
        EngineModel(shift_offset_px=(-959.5, -539.5)),
        "engine.center_shift says offset, the engine behaves as absolute_pixel",
    ),
    (
        replace(FACTS, center_shift="absolute_pixel"),
        EngineModel(shift_offset_px=(-0.5, -0.5)),
        "engine.pixel_centres says whole, the engine behaves as half",
    ),
    (FACTS, EngineModel(shift_offset_px=(12.0, 0.0)), "the engine's centre is (12.00, 0.00) px"),
    (
        FACTS,
        # k1 and k2 count in focal lengths, which the engine has made 9/16 as long.
        EngineModel(focal_gain=1080 / 1920, k1_gain=(16 / 9) ** 2 * (9 / 16) ** 2),
        "engine.fov_axis says x, the engine behaves as y",
    ),
    (FACTS, EngineModel(nodal_gain=1000.0), "engine.nodal_unit says mm, the engine behaves as m"),
    (FACTS, EngineModel(nodal_gain=-1.0), "engine.nodal_sign says 1, the engine behaves as -1"),
    (FACTS, EngineModel(aspect_gain=1.02), "picture.pixel_aspect says 1, the engine's pixels have 1.02"),
]


@pytest.mark.parametrize(("facts", "model", "said"), CASES)
def test_each_setting_is_named(facts: EngineFacts, model: EngineModel, said: str) -> None:
    lines = disagreements(model, facts)
    assert any(line.startswith(said) for line in lines), lines


@pytest.mark.parametrize(
    "facts",
    [FACTS, replace(FACTS, radius_unit="sensor_mm"), replace(FACTS, fov_axis="y", center_shift="absolute_pixel")],
)
def test_a_right_profile_has_no_disagreements(facts: EngineFacts) -> None:
    assert disagreements(EngineModel(), facts) == ()
    reverse = replace(facts, direction="reverse")
    assert disagreements(EngineModel(direction=Direction.REVERSE), reverse) == ()


def test_what_was_measured_with_noise_is_still_the_setting_it_is_near() -> None:
    noisy = EngineModel(
        focal_gain=1.00001, k1_gain=1.0004, k2_gain=0.998, shift_gain=(1.0002, 0.9999), shift_offset_px=(0.03, -0.02)
    )
    assert disagreements(noisy, FACTS) == ()


def test_several_at_once_are_several_lines() -> None:
    model = replace(HALF_WIDTH, shift_gain=(-1.0, -1.0), nodal_gain=-1000.0)
    lines = disagreements(model, FACTS)
    assert [line.split(" ")[0] for line in lines] == [
        "engine.radius_unit",
        "engine.center_shift_sign_x",
        "engine.center_shift_sign_y",
        "engine.nodal_unit",
        "engine.nodal_sign",
    ]
