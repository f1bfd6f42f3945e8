"""Truth files of the simulated lens: what is read, what is refused, what lies between levels."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded, load_lens, parse_lens
from engine_adapters.sim.optics import Optics

TRUTH: dict[str, Any] = {
    "lens_truth": 1,
    "lens": "Test 3x",
    "image_size": [1920, 1080],
    "sensor_mm": [9.59, 5.39],
    "levels": [
        {"zoom": 0.0, "focus": 0.5, "fov_x_deg": 60.0, "k1": -0.2, "k2": 0.1, "center_shift_px": [3.0, -2.0]},
        {"zoom": 0.5, "focus": 0.5, "fov_x_deg": 40.0, "k1": -0.1, "k2": 0.0, "f_px": 1.0},
        {"zoom": 1.0, "focus": 0.5, "fov_x_deg": 20.0, "blur_px": 1.5, "noise_sigma": 0.0, "nodal_offset_mm": 90.0},
    ],
}


def spoilt(**changes: Any) -> dict[str, Any]:
    content = copy.deepcopy(TRUTH)
    for name, value in changes.items():
        target = content["levels"][1] if name in {"zoom", "focus", "fov_x_deg", "k1", "center_shift_px"} else content
        if value is None:
            del target[name]
        else:
            target[name] = value
    return content


def test_levels_come_back_exactly() -> None:
    lens = parse_lens(TRUTH)
    for level in TRUTH["levels"]:
        state = lens.at(level["zoom"], level["focus"])
        expected = Optics.from_fov((1920, 1080), level["fov_x_deg"])
        assert state.optics.f_px == pytest.approx(expected.f_px, rel=1e-12)
        assert state.optics.k1 == pytest.approx(level.get("k1", 0.0), abs=1e-12)
        assert state.optics.k2 == pytest.approx(level.get("k2", 0.0), abs=1e-12)
        assert state.optics.center_shift_px == pytest.approx(level.get("center_shift_px", [0, 0]), abs=1e-12)
        assert state.noise_sigma == pytest.approx(level.get("noise_sigma", 2.0))
        assert state.nodal_offset_mm == pytest.approx(level.get("nodal_offset_mm", 0.0))


def test_between_levels_the_focal_length_goes_on_smoothly_in_its_logarithm() -> None:
    content = copy.deepcopy(TRUTH)
    content["levels"] = [
        {"zoom": zoom, "focus": 0.5, "fov_x_deg": math.degrees(2 * math.atan(0.5 * 8.0**-zoom))}
        for zoom in (0.0, 0.3, 0.6, 1.0)
    ]
    lens = parse_lens(content)
    # An exactly exponential zoom is a straight line in log f, which the interpolation must follow.
    for zoom in np.linspace(0.0, 1.0, 21):
        assert lens.at(float(zoom), 0.1).optics.f_px == pytest.approx(1920.0 * 8.0**zoom, rel=1e-9)


def test_outside_the_levels_the_nearest_one_holds() -> None:
    content = copy.deepcopy(TRUTH)
    content["levels"] = [
        {"zoom": zoom, "focus": focus, "fov_x_deg": 50 - 20 * zoom - focus}
        for zoom, focus in ((0.2, 0.25), (0.2, 0.75), (0.8, 0.25))
    ]
    lens = parse_lens(content)
    assert lens.at(0.0, 0.0).optics == lens.at(0.2, 0.25).optics
    assert lens.at(1.0, 1.0).optics == lens.at(0.8, 0.25).optics
    middle = lens.at(0.2, 0.5).optics.f_px
    assert lens.at(0.2, 0.25).optics.f_px < middle < lens.at(0.2, 0.75).optics.f_px


def test_a_single_level_is_a_prime_lens() -> None:
    content = copy.deepcopy(TRUTH)
    content["levels"] = content["levels"][:1]
    lens = parse_lens(content)
    assert lens.at(0.9, 0.1) == lens.at(0.0, 0.5)


@pytest.mark.parametrize("name", embedded_lens_names())
def test_embedded_lenses_are_whole(name: str) -> None:
    lens = load_embedded(name)
    assert lens.name == name
    assert parse_lens(lens.truth()).levels == lens.levels
    for zoom in np.linspace(0, 1, 41):
        for focus in (0.0, 0.4, 1.0):
            assert not lens.at(float(zoom), focus).optics.folds_inside_picture


def test_the_default_lens_has_levels_with_and_without_a_second_coefficient() -> None:
    lens = load_embedded(embedded_lens_names()[0])
    assert len({level.zoom for level in lens.levels}) == 7
    assert len({level.focus for level in lens.levels}) == 2
    corner_px = []
    for level in lens.levels:
        optics = lens.at(level.zoom, level.focus).optics
        corner_px.append(abs(optics.k2) * optics.corner_radius**5 * optics.f_px)
    assert sum(effect < 0.3 for effect in corner_px) >= 4
    assert sum(effect > 1.0 for effect in corner_px) >= 4


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ([], "JSON object"),
        (spoilt(lens_truth=2), "version 1"),
        (spoilt(image_size=[0, 1080]), "picture size"),
        (spoilt(image_size=[1920]), "image_size"),
        (spoilt(sensor_mm=None), "sensor_mm"),
        (spoilt(levels=[]), "at least one level"),
        (spoilt(levels=["x"]), "level 0"),
        (spoilt(fov_x_deg=None), "level 1: fov_x_deg is missing"),
        (spoilt(fov_x_deg=math.nan), "level 1: fov_x_deg is nan"),
        (spoilt(fov_x_deg=180.0), "not a field of view"),
        (spoilt(fov_x_deg="40"), "not a number"),
        (spoilt(fov_x_deg=10**400), "not a finite number"),
        (spoilt(zoom=1.5), "not an encoder value"),
        (spoilt(zoom=0.0), "stands twice"),
        (spoilt(k1=-3.0), "fold inside the picture"),
        (spoilt(center_shift_px=[1.0]), "center_shift_px"),
    ],
)
def test_a_bad_truth_is_refused_in_one_clear_line(content: object, told: str) -> None:
    with pytest.raises(SimulatorError) as caught:
        parse_lens(content, where="lens.json")
    assert told in str(caught.value)
    assert str(caught.value).startswith("lens.json")
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there_or_not_json_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SimulatorError, match="no such lens file"):
        load_lens(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{", encoding="utf-8")
    with pytest.raises(SimulatorError, match="not a JSON file"):
        load_lens(tmp_path / "bad.json")
    (tmp_path / "deep.json").write_text("[" * 100_000, encoding="utf-8")
    with pytest.raises(SimulatorError, match="not a JSON file"):
        load_lens(tmp_path / "deep.json")
    (tmp_path / "good.json").write_text(json.dumps(TRUTH), encoding="utf-8")
    assert load_lens(tmp_path / "good.json").name == "Test 3x"
    with pytest.raises(SimulatorError, match="no embedded lens"):
        load_embedded("none")


def test_truth_files_of_other_renderers_can_be_read(shared_data: Path) -> None:
    lens = load_lens(shared_data / "renders" / "chess_Z0F0" / "truth.json")
    assert lens.pixel_aspect == pytest.approx(1.0008116883)
    assert lens.at(0.0, 0.25).optics.f_px == pytest.approx(1781.856100104, rel=1e-9)
