"""The lens model against its test vector, its own inverse and numeric derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import FoldedLens, InvalidInput
from calibration.lens import Lens, f_px_to_fov, fov_to_f_px, invert_radius, valid_radius

VECTOR = Lens((1920, 1080), 1339.375739, -0.191619, 0.0689969, (3.0, -2.0))


def test_the_conventions_test_vector() -> None:
    ray = np.array([[0.5, 0.2]])
    np.testing.assert_allclose(VECTOR.project(ray), [[1598.859600, 792.043840]], atol=1e-6)
    straight = Lens((1920, 1080), 1339.375739, center_shift_px=(3.0, -2.0))
    np.testing.assert_allclose(straight.project(ray), [[1632.187869, 805.375148]], atol=1e-6)
    assert VECTOR.fov_x_deg == pytest.approx(71.262261, abs=1e-6)
    # The vector's own 43.916047 comes from the rounded sensor height; the picture's 1080 rows give 43.915913.
    assert VECTOR.fov_y_deg == pytest.approx(43.915913, abs=1e-6)
    assert VECTOR.k1_hw == pytest.approx(-0.0984410368, rel=1e-8)
    assert VECTOR.k2_hw == pytest.approx(0.0182097842, rel=1e-8)


def test_half_width_units_round_trip() -> None:
    back = VECTOR.with_hw(VECTOR.f_px, VECTOR.k1_hw, VECTOR.k2_hw)
    assert back.k1 == pytest.approx(VECTOR.k1, rel=1e-14)
    assert back.k2 == pytest.approx(VECTOR.k2, rel=1e-14)


def test_pixel_aspect_scales_the_vertical_alone() -> None:
    wide = Lens((1920, 1080), 1500.0, pixel_aspect=1.01)
    u, v = wide.project(np.array([[0.1, 0.1]]))[0]
    assert u == pytest.approx(959.5 + 150)
    assert v == pytest.approx(539.5 + 151.5)
    assert wide.fov_y_deg == pytest.approx(math.degrees(2 * math.atan(1080 / (2 * 1515))))


@given(
    fov=st.floats(2, 110),
    k1_hw=st.floats(-0.2, 0.2),
    k2_hw=st.floats(-0.1, 0.1),
    u=st.floats(0, 1919),
    v=st.floats(0, 1079),
)
def test_unproject_inverts_project(fov: float, k1_hw: float, k2_hw: float, u: float, v: float) -> None:
    lens = Lens.from_fov((1920, 1080), fov, center_shift_px=(5, -7))
    lens = lens.with_hw(lens.f_px, k1_hw, k2_hw)
    pixel = np.array([[u, v]])
    ray = lens.unproject(pixel)
    if lens.folds_inside():
        if np.isfinite(ray).all():
            np.testing.assert_allclose(lens.project(ray), pixel, atol=1e-7)
        return
    np.testing.assert_allclose(lens.project(ray), pixel, atol=1e-8)


@given(k1=st.floats(-0.5, 0.5), k2=st.floats(-0.5, 0.5))
def test_valid_radius_is_where_the_slope_first_vanishes(k1: float, k2: float) -> None:
    radius = valid_radius(k1, k2)
    grid = np.linspace(0, min(radius, 20.0), 400, endpoint=False)
    slope = 1 + 3 * k1 * grid**2 + 5 * k2 * grid**4
    assert np.all(slope > -1e-9)
    if math.isfinite(radius):
        s = radius**2
        assert abs(1 + 3 * k1 * s + 5 * k2 * s * s) < 1e-6 * (1 + abs(3 * k1 * s) + abs(5 * k2 * s * s))


def test_rays_beyond_the_fold_are_nan_both_ways() -> None:
    lens = Lens((1920, 1080), 1000.0, k1=-0.5)
    fold = lens.valid_radius
    assert np.isnan(lens.project(np.array([[fold * 1.01, 0.0]]))).all()
    assert np.isfinite(lens.project(np.array([[fold * 0.99, 0.0]]))).all()
    farthest = fold * (1 + lens.k1 * fold**2)
    assert np.isnan(invert_radius(np.array([farthest * 1.001]), lens.k1, 0.0)).all()
    with pytest.raises(FoldedLens, match="folds inside the picture"):
        lens.require_unfolded()
    Lens((1920, 1080), 3000.0, k1=-0.5).require_unfolded()


@pytest.mark.parametrize("lens", [VECTOR, Lens((1280, 720), 900.0, 0.1, -0.02, (-4, 9), 1.002)])
def test_jacobians_agree_with_numeric_ones(lens: Lens) -> None:
    rays = np.array([[0.3, -0.2], [-0.5, 0.25], [0.01, 0.0]])
    step = 1e-6
    numeric = np.stack(
        [(lens.project(rays + step * e) - lens.project(rays - step * e)) / (2 * step) for e in np.eye(2)], axis=-1
    )
    np.testing.assert_allclose(lens.jacobian_rays(rays), numeric, rtol=1e-6, atol=1e-4)
    base = np.array([lens.f_px, lens.k1, lens.k2, *lens.center_shift_px])
    columns = []
    for i, size in enumerate([1e-3, 1e-6, 1e-6, 1e-3, 1e-3]):
        pair = []
        for sign in (1, -1):
            p = base.copy()
            p[i] += sign * size
            moved = Lens(lens.image_size, p[0], p[1], p[2], (p[3], p[4]), lens.pixel_aspect)
            pair.append(moved.project(rays))
        columns.append((pair[0] - pair[1]) / (2 * size))
    np.testing.assert_allclose(lens.jacobian_parameters(rays), np.stack(columns, axis=-1), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fov", [0.0, 180.0, -5.0, math.nan, math.inf])
def test_impossible_fields_of_view_are_refused(fov: float) -> None:
    with pytest.raises(InvalidInput, match="field of view"):
        fov_to_f_px(fov, 1920)


@pytest.mark.parametrize(
    "arguments",
    [
        {"image_size": (0, 1080), "f_px": 1000.0},
        {"image_size": (1920, 1080), "f_px": 0.0},
        {"image_size": (1920, 1080), "f_px": math.nan},
        {"image_size": (1920, 1080), "f_px": 1000.0, "k1": math.inf},
        {"image_size": (1920, 1080), "f_px": 1000.0, "pixel_aspect": -1.0},
    ],
)
def test_impossible_lenses_are_refused(arguments: dict[str, object]) -> None:
    with pytest.raises(InvalidInput):
        Lens(**arguments)  # type: ignore[arg-type]  # the point of the test is what types allow and physics does not


def test_fov_and_focal_length_invert_each_other() -> None:
    assert f_px_to_fov(fov_to_f_px(33.3, 1920), 1920) == pytest.approx(33.3, abs=1e-12)
