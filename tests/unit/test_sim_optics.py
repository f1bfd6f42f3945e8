"""The simulated camera's optics against the written conventions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine_adapters.sim.optics import Optics, RayTable, View, undistorted_radius

VECTOR = Optics((1920, 1080), 1339.375739, -0.191619, 0.0689969, (3.0, -2.0))


def test_the_conventions_vector_lands_where_it_is_written() -> None:
    view = View(VECTOR, (0.0, 0.0, 0.0))
    (u, v) = view.to_pixels(np.array([[0.5, 0.2, 1.0]]))[0]
    assert (u, v) == pytest.approx((1598.859600, 792.043840), abs=1e-6)
    undistorted = View(Optics((1920, 1080), 1339.375739, 0.0, 0.0, (3.0, -2.0)), (0.0, 0.0, 0.0))
    assert tuple(undistorted.to_pixels(np.array([[0.5, 0.2, 1.0]]))[0]) == pytest.approx(
        (1632.187869, 805.375148), abs=1e-6
    )


def test_field_of_view_gives_the_focal_length_of_the_vector() -> None:
    assert Optics.from_fov((1920, 1080), 71.262261).f_px == pytest.approx(1339.375739, abs=1e-4)


@pytest.mark.parametrize(
    ("turn", "point", "side"),
    [
        ({"pan_deg": 10.0}, (0.0, 5.0, 0.0), ("u", -1)),  # turned right: what was ahead moves left
        ({"tilt_deg": 10.0}, (0.0, 5.0, 0.0), ("v", +1)),  # raised: what was ahead sinks
        ({"roll_deg": 10.0}, (1.0, 5.0, 0.0), ("v", -1)),  # clockwise from behind: what was at the right rises
        ({}, (1.0, 5.0, 0.0), ("u", +1)),
        ({}, (0.0, 5.0, 1.0), ("v", -1)),
    ],
)
def test_turning_has_the_signs_of_the_conventions(
    turn: dict[str, float], point: tuple[float, float, float], side: tuple[str, int]
) -> None:
    optics = Optics((1920, 1080), 1500.0)
    u, v = View(optics, (0.0, 0.0, 0.0), **turn).project(np.array([point]))[0]
    offset = {"u": u - 959.5, "v": v - 539.5}[side[0]]
    assert math.copysign(1, offset) == side[1]
    assert abs(offset) > 10


def test_pan_comes_before_tilt_and_tilt_before_roll() -> None:
    view = View(Optics((1920, 1080), 1500.0), (0.0, 0.0, 0.0), 90.0, 30.0, 90.0)
    right, down, forward = view.axes
    assert forward == pytest.approx([math.cos(math.radians(30)), 0.0, 0.5], abs=1e-12)
    # Rolled 90 degrees clockwise, the camera's right points down the raised vertical.
    assert right == pytest.approx([0.5, 0.0, -math.cos(math.radians(30))], abs=1e-12)
    assert np.cross(right, down) == pytest.approx(forward, abs=1e-12)


def test_the_pupil_stands_ahead_of_the_pivot_by_the_nodal_offset() -> None:
    view = View(VECTOR, (1.0, 2.0, 3.0), pan_deg=90.0, nodal_offset_mm=250.0)
    assert view.pupil_m == pytest.approx([1.25, 2.0, 3.0], abs=1e-12)


@pytest.mark.parametrize("k", [(-0.19, 0.069), (0.3, 0.0), (48.0, 900.0), (-0.25, 0.0), (0.0, 0.0)])
def test_each_pixels_ray_projects_back_onto_it(k: tuple[float, float]) -> None:
    f_px = 13_700.0 if k[0] > 1 else 1700.0
    optics = Optics((1920, 1080), f_px, *k, (3.0, -2.0), pixel_aspect=1.0008)
    u, v = (part.ravel() for part in np.meshgrid(np.linspace(0, 1919, 61), np.linspace(0, 1079, 47)))
    x, y = RayTable(optics).rays(u, v)
    back = View(optics, (0.0, 0.0, 0.0)).to_pixels(np.column_stack([x, y, np.ones_like(x)]))
    assert np.abs(back - np.column_stack([u, v])).max() < 1e-6


def test_the_radius_inverse_is_exact_up_to_the_fold_and_nan_beyond() -> None:
    optics = Optics((1920, 1080), 1000.0, -0.3, 0.01)
    fold = optics.fold_radius
    assert 1 + 3 * optics.k1 * fold**2 + 5 * optics.k2 * fold**4 == pytest.approx(0.0, abs=1e-12)
    radius = np.linspace(0.0, fold * 0.999, 200)
    distorted = radius * (1 + optics.k1 * radius**2 + optics.k2 * radius**4)
    assert undistorted_radius(optics, distorted) == pytest.approx(radius, abs=1e-10)
    top = fold * (1 + optics.k1 * fold**2 + optics.k2 * fold**4)
    assert np.isnan(undistorted_radius(optics, np.array([top * 1.01]))).all()


def test_points_behind_the_camera_have_no_pixel() -> None:
    assert np.isnan(View(VECTOR, (0.0, 0.0, 0.0)).project(np.array([[0.0, -1.0, 0.0]]))).all()
