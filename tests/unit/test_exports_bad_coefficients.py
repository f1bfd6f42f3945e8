"""Damaged, foreign and hostile files of the formats of coefficients: one clear line, no table, and no crash of a parser
that is not ours."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.errors import BadDocument
from storage.exports import EXPORTS
from tests.support.lens_tables import VECTOR_LENS, assert_carried, level_of, table_of

FORMATS = ("opencv", "colmap", "gyroflow", "lensfun", "r3")
TABLE = table_of(level_of(VECTOR_LENS, 0.0), level_of(replace(VECTOR_LENS, f_px=4000.0), 1.0, degraded="two pictures"))
WRITTEN = {name: EXPORTS[name].write(TABLE).decode() for name in FORMATS}
ONE = {name: EXPORTS[name].write(table_of(level_of(VECTOR_LENS))).decode() for name in FORMATS}
YAML = "%YAML:1.0\n---\n"
CALIBRATION = YAML + "image_width: 1920\nimage_height: 1080\ncamera_matrix: [ {} ]\ndistortion_coefficients: [ {} ]\n"
MATRIX = "1339., 0., 962., 0., 1339., 537., 0., 0., 1."
DEEP = 200_000


def change(name: str, old: str, new: str, count: int = 1) -> str:
    assert old in WRITTEN[name], old
    return WRITTEN[name].replace(old, new, count)


def gyroflow(**changes: object) -> str:
    return json.dumps({**json.loads(WRITTEN["gyroflow"]), **changes})


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_that_is_cut_off_is_refused_wherever(name: str) -> None:
    lines = WRITTEN[name].splitlines(keepends=True)
    for kept in range(len(lines)):
        with pytest.raises(BadDocument) as raised:
            EXPORTS[name].read("".join(lines[:kept]).encode())
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=200)
@given(data=st.data())
def test_a_damaged_file_is_read_rightly_or_refused(name: str, data: st.DataObject) -> None:
    whole = WRITTEN[name].encode()
    start = data.draw(st.integers(0, len(whole)))
    length = data.draw(st.sampled_from([0, 1, 2, 10, 1000]))
    damaged = whole[:start] + data.draw(st.binary(max_size=4)) + whole[start + length :]
    try:
        table = EXPORTS[name].read(damaged)
    except BadDocument as error:
        assert "\n" not in str(error)  # noqa: PT017 either outcome is right
    else:
        assert len(table.levels) == 2


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (r'(version"?: )3', r"\g<1>0", "version"),
        (r'(lens_table"?: )1', r"\g<1>2", "lens_table"),
        (r'(zoom"?: )1\.0?', r"\g<1>0.0", "twice|interpolations|hold"),
        (r'(levels"?: )2', r"\g<1>3", "levels"),
        (r'(zoom"?: )1\.0?', r"\g<1>NaN", "NaN|finite|number|cv2"),
        (r"2026-11-21T10", "2026-13-21T10", "created"),
    ],
)
def test_bad_notes_are_named(name: str, old: str, new: str, words: str) -> None:
    text, changes = re.subn(old, new, WRITTEN[name], count=1)
    assert changes == 1
    with pytest.raises(BadDocument, match=words):
        EXPORTS[name].read(text.encode())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "does not begin with %YAML"),
        ("<?xml version='1.0'?><opencv_storage/>", "does not begin with %YAML"),
        (YAML, "holds no keys|cv2"),
        (YAML + "a: 1\n", "image_width"),
        (YAML + "a: 1\na: 2\n", "a: stands there twice"),
        (CALIBRATION.format(MATRIX, "-0.1, 0.01, 0.001, 0., 0."), r"p1, p2, k3 .*\(0\.001\); calibrate again"),
        (CALIBRATION.format(MATRIX, "-0.1, 0.01, 0., 0., 0.2"), r"\(0\.2\)"),
        (CALIBRATION.format(MATRIX, "-0.1"), "has 1 numbers"),
        (CALIBRATION.format(MATRIX, ".NaN, 0.01"), "finite"),
        (CALIBRATION.format(MATRIX, '"a", 0.01'), "line 6: .*texts in a list"),
        (CALIBRATION.format("1, 2", "-0.1, 0.01"), "not 3 x 3"),
        (CALIBRATION.format(MATRIX.replace("0., 962", "5., 962"), "-0.1, 0.01"), "fx 0 cx"),
        (CALIBRATION.format(MATRIX.replace("1339., 0.", "-1339., 0."), "-0.1, 0.01"), "fx 0 cx"),
        (CALIBRATION.format(MATRIX, "-5., 0.").replace("1920", "2000000"), "image_width"),
        (CALIBRATION.format(MATRIX, "-5., 0."), "folds inside"),
        (ONE["opencv"].replace("962.5", "900.", 1), "differs from that of levels"),
        (change("opencv", "pixel_aspect: 1.", "pixel_aspect: 1.1"), "fy / fx = 1"),
        (change("opencv", "1920", "[ 1 ]"), "image_size|table"),
        # What would end the process in cv2's parser.
        (YAML + "a: " + "[" * DEEP, "nested too deeply"),
        (YAML + "a: " + "{a:" * DEEP, "nested too deeply"),
        (YAML + "- " * DEEP, "nested too deeply"),
        (YAML + "a: " * DEEP, "nested too deeply"),
        (YAML + 'b: ["]", ' + "[" * DEEP, "nested too deeply"),
        (YAML + 'b: [ # "]\n' + "[" * DEEP, "nested too deeply"),
        (YAML + 'b: x" [\n' + "[" * DEEP, "nested too deeply"),
        (YAML + "\n".join(" " * depth + "a:" for depth in range(2000)), "nested too deeply"),
    ],
)
def test_bad_opencv_files(text: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        EXPORTS["opencv"].read(text.encode())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# only comments\n", "holds no camera"),
        ("1 FISHEYE 1920 1080 1 2 3", "model 'FISHEYE' is not read"),
        ("1", "is no camera"),
        ("1 RADIAL 1920 1080 1000 960 540 0.1", "RADIAL needs 5"),
        ("1 RADIAL 1920 1080 1000 960 540 nan 0", "finite"),
        ("1 RADIAL 1920 1080 1000 960 540 x 0", "no number"),
        ("1 RADIAL 1920 1080 0 960 540 0 0", "f_px"),
        ("1 RADIAL -1 1080 1000 960 540 0 0", "image size"),
        ("1 PINHOLE 1920 1080 0 0 960 540", "f_px"),
        ("1 OPENCV 1920 1080 1000 1000 960 540 0 0 0.1 0", "p1 must be 0"),
        ("1 FULL_OPENCV 1920 1080 1000 1000 960 540 0 0 0 0 0 0 0 1", "k6 must be 0"),
        ("1 RADIAL 1920 1080 1000 960 540 0 0\n2 RADIAL 1920 1080 1000 960 540 0 0\n", "2 cameras and tells no zoom"),
        ("1 RADIAL 1920 1080 1000 960 540 0 0\n1 RADIAL 1920 1080 1000 960 540 0 0\n", "camera 1 a second time"),
        (change("colmap", "\n2 RADIAL", "\n1 RADIAL"), "camera 1 a second time"),
        (change("colmap", "1 RADIAL 1920", "1 RADIAL 1280"), "another picture size"),
        (change("colmap", "RADIAL", "RADIALS"), "not read"),
        (WRITTEN["colmap"] + "3 RADIAL 1920 1080 1000 960 540 0 0\n", "without its zoom and focus"),
        (WRITTEN["colmap"] + WRITTEN["colmap"], "a second time"),
        ('# lensmatch level {"zoom": 0, "focus": 0}\n', "under no table"),
    ],
)
def test_bad_colmap_files(text: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        EXPORTS["colmap"].read(text.encode())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "fisheye_params: is not there"),
        ("[" * DEEP, "is not JSON"),
        ('{"a": 1, "a": 2}', "a key twice"),
        (change("gyroflow", "962.5", "NaN"), "holds NaN"),
        (change("gyroflow", "962.5", "1e999", 9), "finite"),
        (gyroflow(distortion_model=None), "is opencv_fisheye, only opencv_standard"),
        (gyroflow(calib_dimension={"w": 0, "h": 1080}), "calib_dimension"),
        (gyroflow(calib_dimension={"w": 10**9, "h": 1080}), "calib_dimension"),
        (gyroflow(calib_dimension={"w": 1280, "h": 720}), "contradicts"),
        (gyroflow(input_horizontal_stretch=1.33), "stretched"),
        (gyroflow(interpolations=None), "must hold 2 levels"),
        (gyroflow(interpolations={"0.000000": {}, "0.5": {}}), r"interpolations\.0\.000000\.camera_matrix"),
        (gyroflow(lensmatch=None), "tell no zoom and focus"),
        (gyroflow(lensmatch={}), "lensmatch.levels"),
        (gyroflow(fisheye_params=5), "fisheye_params"),
        (change("gyroflow", "    0.0689969,\n    0.0,", "    0.0689969,\n    0.1,", 9), "nothing but 0 behind them"),
    ],
)
def test_bad_gyroflow_files(text: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        EXPORTS["gyroflow"].read(text.encode())


LAUGHS = '<!DOCTYPE l [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>'
OUTSIDE = '<!DOCTYPE l [<!ENTITY a SYSTEM "file:///etc/hostname">]>'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (change("lensfun", "<lensdatabase", LAUGHS + "<lensdatabase"), "DTD or entities"),
        (change("lensfun", "<lensdatabase", OUTSIDE + "<lensdatabase"), "DTD or entities"),
        (change("lensfun", "<lensdatabase", "<!DOCTYPE lensdatabase><lensdatabase"), "DTD or entities"),
        ("<a>" * DEEP, "is not XML"),
        ("<a/>", "is <a>, not <lensdatabase>"),
        ("<lensdatabase/>", "has 0 comments"),
        (change("lensfun", '<lensdatabase version="1"', '<lensdatabase version="2"'), "of version 1"),
        (change("lensfun", "</lens>", "</lens><lens/>"), "lens: is there 2 times"),
        (change("lensfun", "</calibration>", "</calibration><calibration/>"), "calibration: is there 2 times"),
        (change("lensfun", "poly5", "ptlens"), "model ptlens, not poly5"),
        (change("lensfun", 'k1="-0.', 'k1="-O.'), "k1: is no number"),
        (change("lensfun", 'k1="-0.', 'k1="nan" x="-0.'), "k1 = nan"),
        (change("lensfun", 'focal="9.', 'focal="-9.'), "focal: must be a positive"),
        (re.sub(r"<!-- lensmatch level .*?-->", "", WRITTEN["lensfun"], count=1), "no comment with its zoom"),
        (re.sub(r"<distortion .*?/>", "", WRITTEN["lensfun"], count=1), "has two comments"),
        (re.sub(r', "sensor_mm": \[.*?\]', "", WRITTEN["lensfun"]), "does not tell the sensor"),
    ],
)
def test_bad_lensfun_files(text: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        EXPORTS["lensfun"].read(text.encode())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('scene "a/b" export "x" SetValue "1"\n', "line 1: is not what stands here"),
        (change("r3", '"lens.k1" SetValue "-0.191619"', '"lens.k1" SetValue "-1e-1"'), "'-1e-1' is no plain number"),
        (change("r3", '"lens.k1" SetValue "-0.191619"', '"lens.k1" SetValue "nan"'), "'nan' is no plain number"),
        (change("r3", '"lens.k1" SetValue', '"lens.k9" SetValue'), "does not set lens.center_shift_x"),
        (change("r3", "Lensmatch/Calibration", "News/Desk"), "does not set"),
        (change("r3", 'scene "Lens', 'engine.takeSnapshot "x"\nscene "Lens'), "is not what stands here"),
        (change("r3", 'scene "Lens', 'scene  "Lens'), "does not set"),
        (re.sub(r'SetValue "71\.[0-9]+"', 'SetValue "181.0"', WRITTEN["r3"]), "field of view"),
        (WRITTEN["r3"].splitlines()[0] + "\n", "is not whole"),
        (WRITTEN["r3"] + WRITTEN["r3"].splitlines()[0] + "\n", "is not what stands here"),
    ],
)
def test_bad_r3_files(text: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        EXPORTS["r3"].read(text.encode())


@pytest.mark.parametrize("name", FORMATS)
def test_line_endings_and_byte_order_marks_do_no_harm(name: str) -> None:
    assert_carried(TABLE, EXPORTS[name].read(("\ufeff" + WRITTEN[name].replace("\n", "\r\n")).encode()))
