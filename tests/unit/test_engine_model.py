"""The model of an engine's camera against the simulated engine's own optics, and what to ask it for."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.engine import right_model
from benchmarks.engine_corners import SIZE, CornerEngine
from calibration.compare import grid_pixels
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.solve.engine_model import IDENTITY, Direction, EngineModel
from engine_adapters.sim.engine_camera import EngineCamera

SETTINGS = [
    (),
    ("radius_unit=half_width", "overscan=1.1"),
    ("radius_unit=half_height", "fov_axis=y"),
    ("radius_unit=half_diagonal", "distortion_sign=-1"),
    ("radius_unit=sensor_mm",),
    ("center_shift=absolute_pixel", "pixel_centres=half", "center_shift_sign_x=-1"),
]


def lens(fov: float, k1_hw: float, k2_hw: float) -> Lens:
    straight = Lens.from_fov(SIZE, fov, center_shift_px=(5.0, -3.0))
    return straight.with_hw(straight.f_px, k1_hw, k2_hw)


def engine(*settings: str) -> CornerEngine:
    return CornerEngine(EngineCamera.parse(settings), np.random.default_rng(1))


@pytest.mark.parametrize("settings", SETTINGS)
def test_what_is_asked_for_is_drawn_as_wanted(settings: tuple[str, ...]) -> None:
    model, wanted = right_model(EngineCamera.parse(settings)), lens(50, -0.06, 0.01)
    asked = model.asking_for(wanted)
    assert np.max(np.abs(engine(*settings).off_px(asked, wanted))) < 1e-8
    assert model.shortfall_px(wanted) < 1e-8
    drawn = model.drawn(asked).lens
    assert (drawn.f_px, drawn.k1, drawn.k2) == pytest.approx((wanted.f_px, wanted.k1, wanted.k2), rel=1e-12)
    assert drawn.center_shift_px == pytest.approx(wanted.center_shift_px, abs=1e-9)


@pytest.mark.parametrize(("fov", "k1", "k2"), [(62, -0.1, 0.02), (40, -0.03, 0.005), (8, 0.03, -0.002)])
def test_a_reverse_polynomial_says_how_far_it_stays_off(fov: float, k1: float, k2: float) -> None:
    wanted, model = lens(fov, k1, k2), EngineModel(Direction.REVERSE)
    off = engine("direction=reverse").off_px(model.asking_for(wanted), wanted)
    # The same shortfall by the engine's own optics, and no other values come nearer.
    assert model.shortfall_px(wanted) == pytest.approx(float(np.max(np.linalg.norm(off, axis=-1))), abs=1e-6)
    asked, least = model.asking_for(wanted), float(np.sum(off**2))
    for f, more1, more2 in ((1.0005, 0, 0), (0.9995, 0, 0), (1, 1e-3, 0), (1, -1e-3, 0), (1, 0, 1e-3), (1, 0, -1e-3)):
        near = asked.with_hw(f * asked.f_px, asked.k1_hw + more1, asked.k2_hw + more2)
        assert float(np.sum(engine("direction=reverse").off_px(near, wanted) ** 2)) > least


def test_the_shortfall_of_a_mild_lens_is_none_and_of_a_strong_one_is_seen() -> None:
    model = EngineModel(Direction.REVERSE)
    assert model.shortfall_px(lens(40, -0.01, 0.0)) < 0.01
    assert model.shortfall_px(lens(62, -0.1, 0.02)) > 1.0


def test_reverse_draws_by_the_distorted_radius() -> None:
    drawn = EngineModel(Direction.REVERSE).drawn(lens(50, -0.06, 0.01))
    rays = drawn.lens.unproject(grid_pixels(SIZE).reshape(-1, 2)) * 0.5
    at = drawn.project(rays) - (np.asarray(SIZE) - 1) / 2 - np.asarray(drawn.lens.center_shift_px)
    r_d = np.hypot(*at.T) / drawn.lens.f_px
    back = r_d * (1 + drawn.lens.k1 * r_d**2 + drawn.lens.k2 * r_d**4)
    assert back == pytest.approx(np.hypot(*rays.T), abs=1e-12)


def test_a_value_that_the_engine_does_not_follow_cannot_be_asked_for() -> None:
    with pytest.raises(InvalidInput, match="k1"):
        EngineModel(k1_gain=0.0).asking_for(lens(50, -0.06, 0.01))
    with pytest.raises(InvalidInput, match="centre shift"):
        EngineModel(shift_gain=(1.0, 0.0)).asking_for(lens(50, 0.0, 0.0))
    # One that is not needed is not missed.
    assert EngineModel(k1_gain=0.0, nodal_gain=0.0).asking_for(lens(50, 0.0, 0.0)).k1 == 0.0


def test_an_engine_that_draws_what_it_is_asked_for_is_asked_for_the_lens_itself() -> None:
    wanted = lens(50, -0.06, 0.01)
    asked = IDENTITY.asking_for(wanted)
    assert (asked.f_px, asked.k1_hw, asked.k2_hw) == pytest.approx((wanted.f_px, wanted.k1_hw, wanted.k2_hw), rel=1e-14)
