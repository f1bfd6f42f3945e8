"""The formats of coefficients: OpenCV, COLMAP, Gyroflow, lensfun, R3. Each there and back, the common test vector, and
public readers that know nothing of us."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import lensfunpy
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.lens import Lens
from calibration.tables import EngineValues, LevelResult
from engine_adapters.ports import LensValues
from engine_adapters.profile import StudioProfile
from engine_adapters.r3.commands import multi_export
from engine_adapters.r3.mapping import EngineMapping
from storage.errors import CannotExport
from storage.exports import EXPORTS
from storage.exports.r3_commands import EXPORT_NAMES, SCENE, command_lines, number_text, quoted
from tests.support.lens_tables import (
    VECTOR_LENS,
    VECTOR_PX,
    VECTOR_RAY,
    assert_carried,
    lens_tables,
    level_of,
    table_of,
    vector_table,
)

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

FORMATS = ("opencv", "colmap", "gyroflow", "lensfun", "r3")
ONE_FOCUS = ("gyroflow", "lensfun")


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=30)
@given(data=st.data())
def test_there_and_back(name: str, data: st.DataObject) -> None:
    table = data.draw(lens_tables(one_focus=name in ONE_FOCUS, square=name == "lensfun"))
    export = EXPORTS[name]
    written = export.write(table)
    back = export.read(written)
    assert_carried(table, back)
    assert_carried(back, export.read(export.write(back)))


@pytest.mark.parametrize("name", FORMATS)
def test_a_table_without_lenses_is_refused(name: str) -> None:
    with pytest.raises(CannotExport, match="field of view"):
        EXPORTS[name].write(table_of(LevelResult.failed(0, 0, "no board")))


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_lost_is_said(name: str) -> None:
    export = EXPORTS[name]
    assert export.name == name
    assert "sigmas" in export.cannot_carry[0]
    assert ("engine values" in export.cannot_carry[0]) == (name != "r3")


@pytest.mark.parametrize("name", ONE_FOCUS)
def test_several_focuses_are_refused_with_a_way_out(name: str) -> None:
    table = table_of(level_of(VECTOR_LENS, 0, 0.0), level_of(VECTOR_LENS, 0.5, 0.5))
    with pytest.raises(CannotExport, match=r"no place for focus and this table has 0, 0\.5.*--focus"):
        EXPORTS[name].write(table)


def test_opencv_reads_a_single_level_at_the_usual_place() -> None:
    text = EXPORTS["opencv"].write(vector_table()).decode()
    file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    matrix, coefficients = (file.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    size = [int(file.getNode(key).real()) for key in ("image_width", "image_height")]
    zoom = file.getNode("levels").at(0).getNode("zoom").real()
    file.release()
    assert (size, zoom) == ([1920, 1080], 0.0)
    assert matrix == pytest.approx(np.array([[1339.375739, 0, 962.5], [0, 1339.375739, 537.5], [0, 0, 1]]), abs=1e-9)
    assert coefficients.ravel() == pytest.approx([-0.191619, 0.0689969, 0, 0, 0], abs=1e-12)
    points = cv2.projectPoints(np.array([[*VECTOR_RAY, 1.0]]), np.zeros(3), np.zeros(3), matrix, coefficients)[0]
    assert points.ravel() == pytest.approx(VECTOR_PX, abs=1e-5)


FOREIGN_OPENCV = """%YAML:1.0
---
calibration_time: "Fri Nov 20 10:00:00 2026"
# a comment [ with a bracket
image_width: 1920
image_height: 1080
board: [ 9, 6 ]
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1339.375739, 0., 962.5, 0., 1339.375739, 537.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.191619, 0.0689969, 0., 0., 0. ]
"""
FOREIGN_ROS = """%YAML:1.0
---
image_width: 1920
image_height: 1080
camera_name: "cam"
camera_matrix:
   rows: 3
   cols: 3
   data: [1339.375739, 0, 962.5, 0, 1339.375739, 537.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
   rows: 1
   cols: 5
   data: [-0.191619, 0.0689969, 0, 0, 0]
"""
FOREIGN_COLMAP = "# Camera list\n\n7 {} 1920 1080 {}\n"
FOREIGN_GYROFLOW = {
    "name": "x",
    "calib_dimension": {"w": 1920, "h": 1080},
    "asymmetrical": True,
    "fisheye_params": {
        "camera_matrix": [[1339.375739, 0, 962.5], [0, 1339.375739, 537.5], [0, 0, 1]],
        "distortion_coeffs": [-0.191619, 0.0689969, 0, 0],
    },
    "calibrator_version": "1.6.0",
    "distortion_model": "opencv_standard",
}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("opencv", FOREIGN_OPENCV),
        ("opencv", FOREIGN_OPENCV.replace("\n", "\r\n")),
        ("opencv", FOREIGN_ROS),
        ("colmap", FOREIGN_COLMAP.format("RADIAL", "1339.375739 963 538 -0.191619 0.0689969")),
        ("colmap", FOREIGN_COLMAP.format("OPENCV", "1339.375739 1339.375739 963 538 -0.191619 0.0689969 0 0")),
        (
            "colmap",
            FOREIGN_COLMAP.format("FULL_OPENCV", "1339.375739 1339.375739 963 538 -0.191619 0.0689969 0 0 0 0 0 0"),
        ),
        ("gyroflow", json.dumps(FOREIGN_GYROFLOW)),
    ],
)
def test_a_foreign_lens_is_read(name: str, text: str) -> None:
    table = EXPORTS[name].read(text.encode())
    (level,) = table.levels
    assert (level.zoom, level.focus, level.nodal_offset_mm, table.lens) == (0.0, 0.0, None, "unknown")
    (pixel,) = level.lens(table.image_size).project(np.array([VECTOR_RAY]))
    assert pixel == pytest.approx(VECTOR_PX, abs=1e-5)


def test_gyroflow_without_asymmetry_has_its_centre_in_the_middle() -> None:
    text = json.dumps({**FOREIGN_GYROFLOW, "asymmetrical": False})
    assert EXPORTS["gyroflow"].read(text.encode()).levels[0].center_shift_px == (0.0, 0.0)


def test_gyroflow_has_what_its_loader_asks_for() -> None:
    table = table_of(level_of(VECTOR_LENS, 0.5), level_of(replace(VECTOR_LENS, f_px=4000.0), 1.0))
    profile = json.loads(EXPORTS["gyroflow"].write(table))
    assert profile["calibrator_version"]
    assert profile["calib_dimension"] == {"w": 1920, "h": 1080}
    assert profile["asymmetrical"] is True
    assert profile["fisheye_params"]["distortion_coeffs"] == [-0.191619, 0.0689969, 0.0, 0.0]
    assert [float(key) for key in profile["interpolations"]] == [0.5, 1.0]
    assert profile["interpolations"]["1.000000"]["camera_matrix"][0][0] == pytest.approx(4000.0, abs=1e-9)
    assert profile["focal_length"] == pytest.approx(9.199, abs=1e-6)


@pytest.mark.parametrize("pixel_aspect", [1.0, 1.0667])
def test_colmap_reads_its_cameras(pixel_aspect: float, tmp_path: Path) -> None:
    lenses = [replace(VECTOR_LENS, pixel_aspect=pixel_aspect), Lens((1920, 1080), 5000.0, pixel_aspect=pixel_aspect)]
    table = table_of(*(level_of(lens, number / 2) for number, lens in enumerate(lenses)), pixel_aspect=pixel_aspect)
    (tmp_path / "cameras.txt").write_bytes(EXPORTS["colmap"].write(table))
    for name in ("images", "points3D", "rigs", "frames"):
        (tmp_path / f"{name}.txt").write_text("")
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path))
    rays = np.array([VECTOR_RAY, (-0.3, 0.1), (0.0, 0.0)])
    for number, lens in enumerate(lenses, start=1):
        camera = model.cameras[number]
        assert str(camera.model.name) == ("RADIAL" if pixel_aspect == 1 else "OPENCV")
        pixels = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        assert np.abs(pixels - 0.5 - lens.project(rays)).max() < 1e-6


def test_colmaps_test_vector() -> None:
    line = EXPORTS["colmap"].write(vector_table()).decode().splitlines()[-1].split()
    assert line[:4] == ["1", "RADIAL", "1920", "1080"]
    assert [float(word) for word in line[4:]] == pytest.approx([1339.375739, 963, 538, -0.191619, 0.0689969], abs=1e-9)


def lensfun_map(xml: bytes, lens: Lens, focal_mm: float, pixels: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """Where lensfun itself looks in the camera's picture for these undistorted pixels, one call each: over a whole row
    lensfun 0.3.4 adds up float32 steps and is up to 0.8 px off."""
    width, height = lens.image_size
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lens.xml"
        path.write_bytes(xml)
        base = lensfunpy.Database(paths=[str(path)], load_common=False, load_bundled=False)
    camera = base.cameras[0]
    (found,) = base.find_lenses(camera, "Lensmatch", "XA 20x")
    modifier = lensfunpy.Modifier(found, camera.crop_factor, width, height)
    modifier.initialize(focal_mm, 4.0, 10.0, pixel_format=np.uint8, flags=lensfunpy.ModifyFlags.DISTORTION)
    return np.array([modifier.apply_geometry_distortion(u, v, 1, 1).reshape(2) for u, v in pixels])


def test_lensfun_bends_the_picture_as_the_lens_does() -> None:
    """At two focal lengths and nine pixels each, with lensfun 0.3.4's diagonal of a picture: between pixel centres."""
    wide = replace(VECTOR_LENS, center_shift_px=(0.0, 0.0))  # which lensfun has no place for
    tele = Lens((1920, 1080), 6000.0).with_hw(6000.0, 0.03, -0.002)
    xml = EXPORTS["lensfun"].write(table_of(level_of(wide), level_of(tele, 1.0)))
    pixels = np.array([(u, v) for u in (20.0, 700.0, 1900.0) for v in (10.0, 500.0, 1070.0)])
    middle = np.array(wide.principal_point_px)
    for lens in (wide, tele):
        focal_mm = lens.f_px * 13.1868 / 1920
        found = lensfun_map(xml, lens, focal_mm, pixels)
        longer = np.hypot(1920, 1080) / np.hypot(1919, 1079)
        as_it_measures = lens.with_hw(lens.f_px, lens.k1_hw * longer**2, lens.k2_hw * longer**4)
        wanted = as_it_measures.project((pixels - middle) / lens.f_px)
        assert np.abs(found - wanted).max() < 0.001
        assert np.abs(found - lens.project((pixels - middle) / lens.f_px)).max() < 0.1
        assert np.abs(found - pixels).max() > 5


def test_lensfuns_test_vector() -> None:
    text = EXPORTS["lensfun"].write(vector_table()).decode()
    values = dict(part.split("=") for part in text.split("<distortion ")[1].split("/>")[0].split())
    h_over_f = 7.4176 / 2 / 9.199
    assert float(values["focal"].strip('"')) == pytest.approx(9.199, abs=1e-6)
    assert float(values["k1"].strip('"')) == pytest.approx(-0.191619 * h_over_f**2, rel=1e-4)
    assert float(values["k2"].strip('"')) == pytest.approx(0.0689969 * h_over_f**4, rel=1e-4)
    assert float(text.split("<cropfactor>")[1].split("<")[0]) == pytest.approx(43.2666 / 15.1299, rel=1e-4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sensor_mm": None}, "sensor"),
        ({"pixel_aspect": 1.1}, "square pixels"),
    ],
)
def test_lensfun_refuses_what_it_cannot_count(change: dict[str, object], words: str) -> None:
    level = level_of(replace(VECTOR_LENS, pixel_aspect=change.get("pixel_aspect", 1.0)))  # type: ignore[arg-type]
    with pytest.raises(CannotExport, match=words):
        EXPORTS["lensfun"].write(table_of(level, **change))  # type: ignore[arg-type]


def test_lensfun_refuses_two_levels_of_one_focal_length() -> None:
    with pytest.raises(CannotExport, match="focal length"):
        EXPORTS["lensfun"].write(table_of(level_of(VECTOR_LENS, 0.0), level_of(VECTOR_LENS, 0.1)))


def test_r3_lines_are_those_of_the_adapter() -> None:
    """Names, scene, order and digits are the adapter's own with a profile's defaults."""
    profile = StudioProfile()
    mapping = EngineMapping.from_profile(profile)
    assert mapping.lens_exports == EXPORT_NAMES
    assert profile.r3.scene == SCENE
    (sent,) = command_lines(EXPORTS["r3"].write(vector_table()))
    lens = VECTOR_LENS
    values = LensValues(lens.fov_x_deg, lens.k1, lens.k2, lens.center_shift_px, lens.nodal_offset_mm)
    assert sent.line == multi_export(profile.r3.scene, mapping.lens_to_engine(values)).line
    assert (sent.zoom, sent.focus) == (0.0, 0.5)


def test_r3_tells_the_engine_what_makes_it_show_the_lens() -> None:
    asked = EngineValues(71.5, -0.2, 0.07, (2.0, -1.0), 120.0)
    table = table_of(replace(level_of(VECTOR_LENS), engine_values=asked), level_of(VECTOR_LENS, 1.0))
    data = EXPORTS["r3"].write(table)
    first, second = command_lines(data)
    assert '"lens.fov_x" SetValue "71.5"' in first.line
    assert '"lens.k1" SetValue "-0.191619"' in second.line
    back = EXPORTS["r3"].read(data)
    assert_carried(table, back)
    assert [level.engine_values for level in back.levels] == [asked, None]


@given(value=st.floats(allow_nan=False, allow_infinity=False))
def test_r3_numbers_have_no_exponent_and_all_their_digits(value: float) -> None:
    text = number_text(value)
    assert float(text) == value
    assert text.strip("-0123456789.") == ""


@pytest.mark.parametrize("text", ["", 'a"b', "a\nb", "a\\", "\u201d", "a\u2028", "\x7f"])
def test_r3_refuses_what_could_end_the_quotes(text: str) -> None:
    with pytest.raises(CannotExport):
        quoted(text)
