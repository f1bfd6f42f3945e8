"""The simulated engine's own camera: every convention against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine_adapters.sim.engine_camera import EngineCamera
from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.optics import Optics, RayTable, View

SIZE = (1920, 1080)
SENSOR_MM = (9.6, 5.4)
VALUES = {"fov_x": 60.0, "k1": 0.1, "k2": 0.02, "center_shift_x": 3.0, "center_shift_y": -2.0, "nodal_offset": 40.0}
F_PX = 960.0 / math.tan(math.radians(30.0))


@pytest.mark.parametrize(
    ("unit", "unit_px"),
    [
        ("focal_length", F_PX),
        ("half_width", 960.0),
        ("half_height", 540.0),
        ("half_diagonal", math.hypot(960.0, 540.0)),
        ("sensor_mm", 200.0),
    ],
)
def test_the_radius_unit(unit: str, unit_px: float) -> None:
    optics, _ = EngineCamera.parse((f"radius_unit={unit}",)).optics(VALUES, SIZE, SENSOR_MM)
    # At one unit from the axis the polynomial moves a ray by k1 + k2 units.
    r = unit_px / F_PX
    assert optics.f_px * r * (optics.k1 * r**2 + optics.k2 * r**4) == pytest.approx(unit_px * 0.12, rel=1e-12)


def test_signs_origins_axes_and_units() -> None:
    def lens(*specs: str, **values: float) -> tuple[Optics, float]:
        return EngineCamera.parse(specs).optics({**VALUES, **values}, SIZE, SENSOR_MM)

    assert lens("center_shift_sign_x=-1")[0].center_shift_px == (-3.0, -2.0)
    assert lens("center_shift_sign_y=-1")[0].center_shift_px == (3.0, 2.0)
    absolute = lens("center_shift=absolute_pixel", center_shift_x=962.5, center_shift_y=537.5)[0]
    assert absolute.center_shift_px == pytest.approx((3.0, -2.0))
    half = lens("center_shift=absolute_pixel", "pixel_centres=half", center_shift_x=963.0, center_shift_y=538.0)[0]
    assert half.center_shift_px == pytest.approx((3.0, -2.0))
    assert lens("overscan=1.25")[0].f_px == pytest.approx(F_PX / 1.25)
    assert lens("fov_unit=rad", fov_x=math.pi / 3)[0].f_px == pytest.approx(F_PX)
    up_and_down = math.degrees(2 * math.atan(540.0 / F_PX))
    assert lens("fov_axis=y", fov_x=up_and_down)[0].f_px == pytest.approx(F_PX)
    assert lens("distortion_sign=-1")[0].k1 == pytest.approx(-0.1)
    assert lens("nodal_sign=-1")[1] == -40.0
    assert lens("nodal_unit=m", nodal_offset=0.04)[1] == pytest.approx(40.0)


def test_a_value_is_read_back_as_it_was_meant() -> None:
    camera = EngineCamera.parse(("fov_axis=y", "fov_unit=rad"))
    assert camera.fov_x_deg(camera.fov_value(37.0, SIZE), SIZE) == pytest.approx(37.0, rel=1e-12)


@pytest.mark.parametrize("k", [(-0.08, 0.01), (0.15, 0.02), (0.05, -0.01)])
def test_the_reverse_polynomial_draws_what_it_looks_through(k: tuple[float, float]) -> None:
    """Forward (world to pixel) and backward (pixel to ray) agree, and the derivative is the numeric one."""
    optics = Optics(SIZE, 1400.0, *k, (3.0, -2.0), 1.0, reverse=True)
    view = View(optics, (0.0, 0.0, 0.0))
    u, v = np.meshgrid(np.linspace(0.0, 1919.0, 25), np.linspace(0.0, 1079.0, 15))
    x, y = RayTable(optics).rays(u, v)
    back = view.to_pixels(np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)]))
    assert np.abs(back - np.column_stack([u.ravel(), v.ravel()])).max() < 1e-6
    r_d = np.hypot(u - optics.center_px[0], v - optics.center_px[1]) / optics.f_px
    assert np.hypot(x, y) == pytest.approx(r_d * (1 + k[0] * r_d**2 + k[1] * r_d**4), abs=1e-9)
    q = np.linspace(0.0, 0.4, 9)
    step = 1e-6
    numeric = (optics.bent(q + step)[0] - optics.bent(np.abs(q - step))[0]) / (q + step - np.abs(q - step) + 1e-30)
    assert optics.bent(q)[1][1:] == pytest.approx(numeric[1:], rel=1e-5)


@pytest.mark.parametrize("spec", ["radius_unit=miles", "colour=red", "overscan=0", "overscan=x", "nodal_sign=2"])
def test_what_no_engine_has_is_refused(spec: str) -> None:
    with pytest.raises(SimulatorError, match="engine"):
        EngineCamera.parse((spec,))
