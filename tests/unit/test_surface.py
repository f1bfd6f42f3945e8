"""The surface over a lens's levels: against true lenses, its uncertainty, its speed's shape, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.compare import overlay
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.surface import LensSurface, fit_surface
from calibration.surface.process import Joint, Shape, Smoothness, Trend
from calibration.surface.quantities import QUANTITIES, frame_rays, lens_of, picture_jacobian, values_of
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, LevelStatus, Sigma
from engine_adapters.sim.lens_truth import load_embedded
from tests.support.surfaces import table_of_levels

SIZE = (1920, 1080)
NO_EVIDENCE = dict.fromkeys(EVIDENCE_QUANTITIES, "not tried")
DEMO = load_embedded("Demo ENG 8x")


def true_lens(zoom: float, focus: float) -> Lens:
    state = DEMO.at(zoom, focus)
    optics = state.optics
    shift = (float(optics.center_shift_px[0]), float(optics.center_shift_px[1]))
    return Lens(SIZE, optics.f_px, optics.k1, optics.k2, shift, nodal_offset_mm=state.nodal_offset_mm)


def level(zoom: float, focus: float = 0.5, lens: Lens | None = None) -> LevelResult:
    return LevelResult.from_lens(zoom, focus, lens or true_lens(zoom, focus), reasons=NO_EVIDENCE)


def table(zooms: int, focuses: tuple[float, ...] = (0.5,)) -> LensTable:
    return table_of_levels([level(float(z), t) for z in np.linspace(0, 1, zooms) for t in focuses])


@pytest.fixture(scope="module")
def thirteen() -> LensSurface:
    return fit_surface(table(13)).surface


def test_between_thirteen_levels_the_lens_is_right_to_a_tenth_of_a_pixel(thirteen: LensSurface) -> None:
    errors = [overlay(true_lens(z, 0.5), thirteen.at(z, 0.5).lens).max_px for z in np.linspace(0, 1, 41).tolist()]
    assert max(errors) < 0.1
    assert thirteen.at(0.21, 0.5).lens.nodal_offset_mm == pytest.approx(true_lens(0.21, 0.5).nodal_offset_mm, abs=0.5)


def test_the_expected_error_is_not_far_from_the_true_one(thirteen: LensSurface) -> None:
    places = np.linspace(0, 1, 101).tolist()
    expected = max(thirteen.at(z, 0.5).predicted_px.max for z in places)
    true = max(overlay(true_lens(z, 0.5), thirteen.at(z, 0.5).lens).max_px for z in places)
    assert 0.2 * true < expected < 10 * true


def test_focus_is_followed() -> None:
    surface = fit_surface(table(9, (0.25, 0.5, 0.75))).surface
    errors = [
        overlay(true_lens(z, t), surface.at(z, t).lens).max_px
        for z in np.linspace(0, 1, 17).tolist()
        for t in (0.25, 0.4, 0.6, 0.75)
    ]
    assert max(errors) < 1.0
    breathing = surface.at(0.5, 0.25).lens.f_px / surface.at(0.5, 0.75).lens.f_px
    assert breathing == pytest.approx(true_lens(0.5, 0.25).f_px / true_lens(0.5, 0.75).f_px, rel=1e-4)


def test_one_and_many_agree_and_outside_is_clamped_with_a_flag(thirteen: LensSurface) -> None:
    rng = np.random.default_rng(3)
    zoom, focus = rng.uniform(-0.2, 1.2, 300), rng.uniform(0, 1, 300)
    many = thirteen.at_many(zoom, focus)
    for i in range(0, 300, 17):
        one = thirteen.at(float(zoom[i]), float(focus[i]))
        assert one.lens.f_px == pytest.approx(many.f_px[i], rel=1e-12)
        assert (one.lens.k1, one.lens.k2) == (pytest.approx(many.k1[i]), pytest.approx(many.k2[i]))
        assert one.lens.center_shift_px == pytest.approx(tuple(many.center_shift_px[i]))
        assert one.clamped == bool(many.clamped[i])
        assert one.predicted_px.max == pytest.approx(many.predicted_max_px[i])
    beyond = thirteen.at(1.5, 0.5)
    assert (beyond.clamped, beyond.zoom) == (True, 1.0)
    assert beyond.lens == thirteen.at(1.0, 0.5).lens
    assert not thirteen.at(0.3, 0.5).clamped
    with pytest.raises(InvalidInput):
        thirteen.at(math.nan, 0.5)
    with pytest.raises(InvalidInput):
        thirteen.at_many(np.array([math.inf]), np.array([0.5]))


def test_the_field_of_view_always_falls_and_no_lens_folds(thirteen: LensSurface) -> None:
    fov = thirteen.at_many(np.linspace(0, 1, 5001), np.full(5001, 0.5)).fov_x_deg
    assert np.all(np.diff(fov) < 0)
    for zoom in np.linspace(0, 1, 101).tolist():
        assert not thirteen.at(zoom, 0.5).lens.folds_inside()


def test_a_wrong_level_is_found_explained_and_left_out() -> None:
    levels = list(table(13).levels)
    levels[4] = level(levels[4].zoom, lens=true_lens(levels[4].zoom + 0.05, 0.5))
    fit = fit_surface(table_of_levels(levels))
    assert [check.zoom for check in fit.left_out] == [levels[4].zoom]
    reason = fit.left_out[0].reason
    assert reason is not None
    assert "the lens had not arrived" in reason
    assert f"{levels[4].zoom + 0.05:.2f}"[:4] in reason
    everything = fit_surface(table_of_levels(levels), reject=False)
    assert everything.left_out == ()
    clean = fit_surface(table(13))
    assert clean.left_out == ()
    assert clean.held_out_px is not None
    assert everything.held_out_px is not None
    assert everything.held_out_px.max > 10 * clean.held_out_px.max


def test_a_wrong_centre_is_named() -> None:
    levels = list(table(13).levels)
    lens = true_lens(levels[7].zoom, 0.5)
    moved = replace(lens, center_shift_px=(lens.center_shift_px[0] + 25.0, lens.center_shift_px[1]))
    levels[7] = level(levels[7].zoom, lens=moved)
    fit = fit_surface(table_of_levels(levels))
    assert [check.zoom for check in fit.left_out] == [levels[7].zoom]
    assert "centre shift x is +25" in (fit.left_out[0].reason or "")


def test_few_levels_make_a_surface_that_says_how_little_it_knows() -> None:
    one = fit_surface(table_of_levels([level(0.3)])).surface
    assert overlay(true_lens(0.3, 0.5), one.at(0.3, 0.5).lens).max_px < 0.01
    assert one.at(0.4, 0.5).clamped
    two = fit_surface(table(2)).surface
    middle = two.at(0.5, 0.5)
    assert middle.predicted_px.max > 10
    assert two.at(0.0, 0.5).predicted_px.max < 0.1
    assert overlay(true_lens(1.0, 0.5), two.at(1.0, 0.5).lens).max_px < 0.1


def test_a_lens_of_the_same_type_as_prior_saves_levels() -> None:
    prior = fit_surface(table(13)).surface

    def other(zoom: float) -> Lens:
        lens = true_lens(zoom, 0.5)
        shift = (lens.center_shift_px[0] + 3.0, lens.center_shift_px[1] - 2.0)
        moved = lens.with_hw(lens.f_px * (1.004 + 0.002 * zoom), lens.k1_hw + 0.001, lens.k2_hw)
        return replace(moved, center_shift_px=shift)

    few = table_of_levels([level(z, lens=other(z)) for z in (0.0, 0.5, 1.0)])
    with_prior, without = fit_surface(few, prior=prior).surface, fit_surface(few).surface
    worst = max(overlay(other(z), with_prior.at(z, 0.5).lens).max_px for z in np.linspace(0, 1, 21).tolist())
    assert worst < 1.0
    assert worst < 0.1 * max(overlay(other(z), without.at(z, 0.5).lens).max_px for z in np.linspace(0, 1, 21).tolist())
    with pytest.raises(InvalidInput, match="prior"):
        fit_surface(
            replace(few, image_size=(1280, 720), levels=(level(0.0, lens=Lens((1280, 720), 900.0)),)), prior=prior
        )


def test_what_no_surface_can_be_made_of_is_refused() -> None:
    backwards = [level(1.0 - z, lens=true_lens(z, 0.5)) for z in np.linspace(0, 1, 9).tolist()]
    with pytest.raises(InvalidInput, match="runs backwards"):
        fit_surface(table_of_levels(backwards))
    twice = [*table(9).levels, level(0.5005, lens=true_lens(0.6, 0.5))]
    with pytest.raises(InvalidInput, match="stand at one place"):
        fit_surface(table_of_levels(twice))
    with pytest.raises(InvalidInput, match="field of view"):
        fit_surface(table_of_levels([LevelResult.failed(0.0, 0.5, "no board")]))


def test_failed_levels_are_passed_over() -> None:
    levels = [*table(7).levels, LevelResult.failed(0.9, 0.5, "no board")]
    fit = fit_surface(table_of_levels(levels))
    assert fit.checks[-1].used is False
    assert "no board" in (fit.checks[-1].reason or "")
    assert fit.left_out == ()


def test_a_level_counts_by_its_covariance() -> None:
    """A level whose sigmas are large bends the surface less than one whose sigmas are small."""
    base = list(table(9).levels)
    wrong = true_lens(base[4].zoom, 0.5)
    wrong = wrong.with_hw(wrong.f_px * 1.0005, wrong.k1_hw, wrong.k2_hw)
    moved = []
    for scale in (1.0, 300.0):
        sigma = Sigma(0.001 * scale, 1e-3 * scale, 1e-2 * scale, (0.02 * scale, 0.02 * scale))
        levels = base.copy()
        levels[4] = replace(level(base[4].zoom, lens=wrong), sigma=sigma, status=LevelStatus.OK)
        surface = fit_surface(table_of_levels(levels), reject=False).surface
        moved.append(abs(math.log(surface.at(base[4].zoom, 0.5).lens.f_px / true_lens(base[4].zoom, 0.5).f_px)))
    assert moved[1] < 0.7 * moved[0]


@given(
    st.floats(0.0, 1.0),
    st.sampled_from(range(5)),
    st.floats(-1.0, 1.0),
)
def test_the_pixel_jacobian_is_that_of_the_lens(zoom: float, quantity: int, side: float) -> None:
    lens = true_lens(zoom, 0.5)
    rays = frame_rays(lens)
    jacobian = picture_jacobian(np.array([lens.k1_hw]), np.array([lens.k2_hw]), rays, SIZE)[0]
    step = np.zeros(len(QUANTITIES))
    step[quantity] = (1e-6 if quantity < 3 else 1e-3) * (1 if side >= 0 else -1)
    moved = lens_of((values_of(lens) + step).tolist(), SIZE, 1.0)
    world = rays * lens.half_width
    numeric = moved.project(world) - lens.project(world)
    np.testing.assert_allclose(numeric, jacobian @ step, atol=2e-6 * float(np.max(np.abs(jacobian @ step))) + 1e-8)


def test_leave_one_out_is_what_leaving_one_out_gives() -> None:
    rng = np.random.default_rng(1)
    zoom, focus = np.sort(rng.random(8)), rng.random(8)
    values = np.column_stack([np.sin(3 * zoom), zoom**2]) + 0.01 * rng.normal(size=(8, 2))
    noise = np.array([np.array([[1.0, 0.6], [0.6, 1.0]]) * 1e-4] * 8)
    smooth = [Smoothness(Trend(1), ((0.5, Shape(0.4, 0.1, 1.0)), (0.1, Shape(1.0, 0.1, 1.0))), 0.0)] * 2
    joint = Joint.solve([(zoom, focus)] * 2, smooth, values, noise)
    for out in (0, 3, 7):
        keep = np.arange(8) != out
        rest = Joint.solve([(zoom[keep], focus[keep])] * 2, smooth, values[keep], noise[keep])
        here = (zoom[out : out + 1], focus[out : out + 1])
        residual, covariance = joint.left_out(out)
        predicted = np.array([rest.mean(q, *here)[0] for q in (0, 1)])
        np.testing.assert_allclose(residual, values[out] - predicted, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(covariance, rest.covariance([here, here])[0] + noise[out], rtol=1e-4, atol=1e-8)
