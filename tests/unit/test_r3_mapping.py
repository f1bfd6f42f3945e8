"""The conversion between the product's lens and an engine's, with the golden vector of the conventions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine_adapters.errors import ProtocolError, UnsafeText
from engine_adapters.ports import LensValues, Shown
from engine_adapters.profile import EngineSettings, PictureSettings, R3Settings, StudioProfile
from engine_adapters.r3.commands import number_text
from engine_adapters.r3.mapping import EngineMapping, same_value

# docs: conventions.md and protocols/README.md, "Test vector".
GOLDEN = LensValues(71.262261, k1=-0.191619, k2=0.0689969, center_shift_px=(3.0, -2.0), nodal_offset_mm=121.3)
SENSOR_MM = (13.1868, 7.4176)


def mapping(picture: dict[str, Any] | None = None, **engine: Any) -> EngineMapping:
    return EngineMapping.from_profile(
        StudioProfile(
            engine=EngineSettings(**engine),
            picture=PictureSettings(**({"sensor_mm": SENSOR_MM} | (picture or {}))),
        )
    )


def sent(values: LensValues, **engine: Any) -> dict[str, float]:
    pairs = mapping(**engine).lens_to_engine(values)
    return {name.removeprefix("lens."): float(text) for name, text in pairs}


def test_by_default_nothing_is_converted() -> None:
    assert sent(GOLDEN) == {
        "center_shift_x": 3.0,
        "center_shift_y": -2.0,
        "fov_x": 71.262261,
        "k1": -0.191619,
        "k2": 0.0689969,
        "nodal_offset": 121.3,
    }


@pytest.mark.parametrize(
    ("radius_unit", "k1", "k2", "relative"),
    [
        ("focal_length", -0.191619, 0.0689969, 1e-15),
        ("half_width", -0.0984410368, 0.0182097842, 1e-7),
        # The references' diagonal comes from the sensor, whose sides are rounded to 0.1 um.
        ("half_diagonal", -0.129588606, 0.0315563000, 1e-5),
        ("sensor_mm", -0.00226442182, 9.63534131e-06, 1e-6),
        ("half_height", -0.191619 * (540 / 1339.375739) ** 2, 0.0689969 * (540 / 1339.375739) ** 4, 1e-7),
    ],
)
def test_golden_vector_in_each_radius_unit(radius_unit: str, k1: float, k2: float, relative: float) -> None:
    values = sent(GOLDEN, radius_unit=radius_unit)
    assert values["k1"] == pytest.approx(k1, rel=relative)
    assert values["k2"] == pytest.approx(k2, rel=relative)


@pytest.mark.parametrize(
    ("settings", "shift"),
    [
        ({}, (3.0, -2.0)),
        ({"center_shift_sign_x": -1, "center_shift_sign_y": -1}, (-3.0, 2.0)),
        ({"center_shift": "absolute_pixel"}, (962.5, 537.5)),
        ({"center_shift": "absolute_pixel", "pixel_centres": "half"}, (963.0, 538.0)),
        # A v that counts upwards from the bottom row: 1079 - 537.5.
        ({"center_shift": "absolute_pixel", "center_shift_sign_y": -1}, (962.5, 541.5)),
    ],
)
def test_golden_vector_in_each_centre_shift(settings: dict[str, Any], shift: tuple[float, float]) -> None:
    values = sent(GOLDEN, **settings)
    assert (values["center_shift_x"], values["center_shift_y"]) == shift


@pytest.mark.parametrize(
    ("settings", "fov"),
    [
        ({"fov_axis": "y"}, 43.916047),
        ({"fov_unit": "rad"}, math.radians(71.262261)),
        ({"fov_axis": "y", "fov_unit": "rad"}, math.radians(43.916047)),
    ],
)
def test_golden_vector_in_each_field_of_view(settings: dict[str, Any], fov: float) -> None:
    # The vector's vertical angle comes from the sensor's rounded height: with square pixels it is 43.915913 degrees.
    assert sent(GOLDEN, **settings)["fov_x"] == pytest.approx(fov, rel=5e-6)


def test_golden_vector_of_the_nodal_offset() -> None:
    assert sent(GOLDEN, nodal_unit="m")["nodal_offset"] == pytest.approx(0.1213)
    assert sent(GOLDEN, nodal_sign=-1)["nodal_offset"] == -121.3


def test_pixel_aspect_counts_for_the_vertical_field_of_view_and_the_height() -> None:
    tall = mapping({"pixel_aspect": 1.2}, fov_axis="y", radius_unit="half_height")
    values = {name: float(text) for name, text in tall.lens_to_engine(GOLDEN)}
    # fov_y = 2 atan(H / (2 a f_px))
    assert values["lens.fov_x"] == pytest.approx(math.degrees(2 * math.atan(540 / (1.2 * 1339.375739))), rel=1e-7)
    assert values["lens.k1"] == pytest.approx(-0.191619 * (450 / 1339.375739) ** 2, rel=1e-7)


@given(
    radius_unit=st.sampled_from(["focal_length", "half_width", "half_height", "half_diagonal", "sensor_mm"]),
    center_shift=st.sampled_from(["offset", "absolute_pixel"]),
    pixel_centres=st.sampled_from(["whole", "half"]),
    signs=st.tuples(*[st.sampled_from([1, -1])] * 3),
    fov_axis=st.sampled_from(["x", "y"]),
    fov_unit=st.sampled_from(["deg", "rad"]),
    nodal_unit=st.sampled_from(["mm", "m"]),
    pixel_aspect=st.floats(0.5, 2.0),
    fov_x_deg=st.floats(0.5, 150.0),
    k1=st.floats(-1.0, 50.0),
    k2=st.floats(-1e4, 1e4),
    shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
    nodal=st.floats(-500, 500),
)
def test_there_and_back_is_the_same_lens(
    radius_unit: str,
    center_shift: str,
    pixel_centres: str,
    signs: tuple[int, int, int],
    fov_axis: str,
    fov_unit: str,
    nodal_unit: str,
    pixel_aspect: float,
    fov_x_deg: float,
    k1: float,
    k2: float,
    shift: tuple[float, float],
    nodal: float,
) -> None:
    converter = mapping(
        {"pixel_aspect": pixel_aspect},
        radius_unit=radius_unit,
        center_shift=center_shift,
        pixel_centres=pixel_centres,
        center_shift_sign_x=signs[0],
        center_shift_sign_y=signs[1],
        nodal_sign=signs[2],
        fov_axis=fov_axis,
        fov_unit=fov_unit,
        nodal_unit=nodal_unit,
    )
    values = LensValues(fov_x_deg, k1, k2, shift, nodal)
    back = converter.lens_from_engine(dict(converter.lens_to_engine(values)))
    assert back.fov_x_deg == pytest.approx(fov_x_deg, rel=1e-12)
    assert [back.k1, back.k2] == pytest.approx([k1, k2], rel=1e-10, abs=1e-300)
    assert back.center_shift_px == pytest.approx(shift, abs=1e-9)
    assert back.nodal_offset_mm == pytest.approx(nodal, rel=1e-12, abs=1e-300)


def test_a_reverse_polynomial_keeps_its_own_coefficients() -> None:
    """Which way a polynomial goes is the learned engine's business; here only the unit of its radius counts."""
    values = dict(mapping(direction="reverse", radius_unit="half_width").lens_to_engine(GOLDEN))
    forward = dict(mapping(radius_unit="half_width").lens_to_engine(GOLDEN))
    assert values == forward
    assert mapping(direction="reverse", radius_unit="half_width").lens_from_engine(values).k1 == pytest.approx(
        GOLDEN.k1
    )


@pytest.mark.parametrize("fov_x_deg", [0.0, -1.0, 180.0, math.nan, math.inf])
def test_an_impossible_field_of_view_is_not_sent(fov_x_deg: float) -> None:
    with pytest.raises(UnsafeText, match="fov_x_deg"):
        mapping().lens_to_engine(LensValues(fov_x_deg))


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("lens.fov_x", "0", "no field of view"),
        ("lens.fov_x", "200", "no field of view"),
        ("lens.k1", "abc", "no number"),
        ("lens.k2", "nan", "no number"),
        ("lens.center_shift_x", "inf", "no number"),
        ("lens.nodal_offset", "1,5", "no number"),
    ],
)
def test_a_value_that_is_no_lens_is_told_with_its_export(name: str, text: str, told: str) -> None:
    exports = dict(mapping().lens_to_engine(GOLDEN)) | {name: text}
    with pytest.raises(ProtocolError, match=f"{name} = .*{told}"):
        mapping().lens_from_engine(exports)


@pytest.mark.parametrize(
    ("asked", "got", "same"),
    [
        ("-0.191619", "-0.191619", True),
        ("-0.191619", "-1.9161900e-1", True),
        ("-0.191619", "-0.19161899", True),  # single precision
        ("963.81", "963.81", True),
        ("71.262261000000000", "71.26226", True),
        ("71.262261", "71.2620", False),  # a digit cut off, not rounded
        ("-0.191619", "-0.19", False),  # rounded, but too much is lost
        ("1.3", "1", False),
        ("0.0", "0", True),
        ("0.0", "0.00001", False),
        ("3.0", "-3.0", False),
        ("3.0", "nan", False),
        ("3.0", "inf", False),
        ("3.0", "on", False),
        ("3.0", "", False),
        ("0.0", "0e400", True),
    ],
)
def test_a_value_read_back_is_the_same_within_the_engines_digits(asked: str, got: str, same: bool) -> None:
    assert same_value(asked, got) is same


@given(st.floats(-1e6, 1e6).filter(lambda value: abs(value) > 1e-9))
def test_single_precision_keeps_a_value_and_a_clipped_one_is_seen(value: float) -> None:
    asked = number_text("k1", value)
    assert same_value(asked, repr(float(np.float32(value))))
    assert not same_value(asked, number_text("k1", value * 1.001))


def test_a_missing_value_is_told() -> None:
    exports = dict(mapping().lens_to_engine(GOLDEN))
    del exports["lens.k1"]
    with pytest.raises(ProtocolError, match=r"no value for lens\.k1"):
        mapping().lens_from_engine(exports)


@pytest.mark.parametrize(
    ("shown", "background", "target"),
    [(Shown.REAL, "on", "off"), (Shown.VIRTUAL, "off", "on"), (Shown.BOTH, "on", "on"), (Shown.NOTHING, "off", "off")],
)
def test_what_is_shown_uses_the_profiles_words(shown: Shown, background: str, target: str) -> None:
    profile = StudioProfile(r3=R3Settings(visible_on="on", visible_off="off"))
    pairs = EngineMapping.from_profile(profile).shown_to_engine(shown)
    assert pairs == (("background.visible", background), ("object.visible", target))


def test_the_tracking_packet_follows_the_profiles_axes_and_units() -> None:
    packet = {"POSX": 100.0, "POSY": 150.0, "POSZ": -600.0, "ROTX": 5.0, "ROTY": 14.0, "ROTZ": 1.0, "FOVX": 60.0}
    converter = mapping(
        tracking_position_unit="cm",
        tracking_right="PosX",
        tracking_forward="-PosZ",
        tracking_up="PosY",
        tracking_pan="-RotY",
        tracking_tilt="RotX",
        tracking_roll="RotZ",
    )
    camera = converter.tracked_camera(packet)
    assert camera.pivot_m == pytest.approx((1.0, 6.0, 1.5))
    assert (camera.pan_deg, camera.tilt_deg, camera.roll_deg) == (-14.0, 5.0, 1.0)
    assert (camera.fov_x_deg, camera.fov_y_deg) == (60.0, None)
    del packet["ROTY"]
    with pytest.raises(ProtocolError, match="has no RotY"):
        converter.tracked_camera(packet)
