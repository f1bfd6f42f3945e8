"""Damaged and foreign files: one clear line that names the field, never a half-read table and never another error."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.tables import LensTable, LevelStatus
from storage.errors import BadDocument
from storage.exports import EXPORTS, Export
from storage.exports.base import MAX_DOCUMENT_BYTES
from storage.schemas import document_to_table, lens_table_schema_text, table_to_document

REPOSITORY = Path(__file__).parents[2]
GOLDEN = REPOSITORY / "tests" / "golden"
EXACT = pytest.mark.parametrize("export", [EXPORTS["json"], EXPORTS["csv"]], ids=["json", "csv"])

# The example of the public contract, letter by letter.
CONTRACT = """
{"lens_table": 1, "lens": "XA 20x", "camera": "Cam0", "version": 3, "created": "2026-11-21T10:00:00Z", "image_size": [1920, 1080], "sensor_mm": [9.59, 5.39], "pixel_aspect": 1.0,
 "method": "joint", "levels": [{"zoom": 0.0, "focus": 0.5, "status": "ok", "fov_x_deg": 56.1, "fov_y_deg": 33.4, "f_px": 1800.2,
   "k1": -0.12, "k2": 0.031, "k1_hw": -0.034, "k2_hw": 0.0025, "center_shift_px": [4.31, -2.70], "nodal_offset_mm": 121.3,
   "sigma": {"fov_x_deg": 0.0008, "k1": 0.0002, "k2": 0.0011, "center_shift_px": [0.01, 0.01], "nodal_offset_mm": 0.2},
   "residual_px": {"rms": 0.021, "max": 0.06}, "held_out_px": {"rms": 0.03, "max": 0.07}, "predicted_overlay_px": {"rms": 0.02, "max": 0.05},
   "engine_overlay_px": {"rms": 0.03, "max": 0.08}, "scenario": 1, "frames": {"real": 4, "virtual": 5}, "seconds": 0.6, "left_out": []}],
 "interpolation": {"kind": "...", "held_out_px": {"rms": 0.1, "max": 0.3}}}
"""  # noqa: E501


def contract() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(CONTRACT)
    return document


def read_json(text: str) -> LensTable:
    return EXPORTS["json"].read(text.encode())


def test_the_contracts_example_keeps_its_names_and_values() -> None:
    written = table_to_document(document_to_table(contract()))
    level = written["levels"][0]
    assert (level.pop("reason"), level.pop("reasons")) == (None, {})
    assert written == contract()


def test_the_schema_file_is_up_to_date() -> None:
    path = REPOSITORY / "docs" / "reference" / "lens-table.schema.json"
    again = 'python -c "from storage.schemas import *; print(lens_table_schema_text(), end=str())"'
    assert path.read_text(encoding="utf-8") == lens_table_schema_text(), f"write it again with {again}"


def test_the_schema_accepts_what_is_written_and_refuses_what_is_not() -> None:
    schema = json.loads(lens_table_schema_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    assert validator.is_valid(json.loads((GOLDEN / "lens_table.json").read_bytes()))
    assert validator.is_valid(contract())
    assert not validator.is_valid({**contract(), "lens_table": 2})
    assert not validator.is_valid({**contract(), "levels": []})


def test_fields_of_a_newer_table_are_ignored() -> None:
    document = contract()
    document["colour"] = "blue"
    document["levels"][0]["k3"] = 0.1
    document["levels"][0]["reasons"] = {"k4": "a quantity of tomorrow"}
    assert document_to_table(document) == document_to_table(contract())


def test_what_follows_from_the_lens_may_be_left_out() -> None:
    document = contract()
    for name in ("f_px", "fov_y_deg", "k1_hw", "k2_hw"):
        del document["levels"][0][name]
    level = document_to_table(document).levels[0]
    assert level.f_px == pytest.approx(1801.70, abs=0.01)
    assert level.k1_hw == pytest.approx(-0.12 * 0.2839, rel=1e-3)


def test_a_null_without_a_reason_gets_one_that_says_so() -> None:
    document = contract()
    document["levels"][0] |= {"nodal_offset_mm": None, "status": "degraded"}
    level = document_to_table(document).levels[0]
    assert level.status is LevelStatus.DEGRADED
    assert level.reason == level.reasons["nodal_offset_mm"] == "not told: the document gives no reason"


def test_text_that_is_no_unicode_is_made_storable() -> None:
    level = read_json(CONTRACT.replace('"left_out": []', r'"left_out": [], "reason": "caf\udce9.png"')).levels[0]
    assert level.reason == r"caf\udce9.png"


Change = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("change", "field", "words"),
    [
        (lambda d: d.pop("lens_table"), "", "is this a lens table file"),
        (lambda d: d.update(lens_table=2), "lens_table", "newer version"),
        (lambda d: d.update(lens=""), "lens", "at least 1 character"),
        (lambda d: d.update(camera=5), "camera", "valid string, not 5"),
        (lambda d: d.update(version=0), "version", "greater than or equal to 1"),
        (lambda d: d.update(version="3"), "version", "valid integer"),
        (lambda d: d.update(created="yesterday"), "created", "yesterday"),
        (lambda d: d.update(created="2026-11-21T10:00:00"), "created", "time zone"),
        (lambda d: d.update(created="0001-01-01T00:00:00+14:00"), "created", "years 1 to 9999"),
        (lambda d: d.update(created=17), "created", "must be a text"),
        (lambda d: d.update(image_size=[1920]), "image_size[1]", "required"),
        (lambda d: d.update(image_size=[1920, 0]), "image_size[1]", "not 0"),
        (lambda d: d.update(image_size=[1920.5, 1080]), "image_size[0]", "integer"),
        (lambda d: d.update(sensor_mm=[-1, 5]), "sensor_mm[0]", "greater than 0"),
        (lambda d: d.update(pixel_aspect=0), "pixel_aspect", "greater than 0"),
        (lambda d: d.update(method=None), "method", "valid string"),
        (lambda d: d.update(levels=[]), "levels", "at least 1 item"),
        (lambda d: d.update(levels={}), "levels", "valid tuple"),
        (lambda d: d.update(interpolation={}), "interpolation.kind", "required"),
        (lambda d: d["levels"].append(copy.deepcopy(d["levels"][0])), "", "twice"),
        (lambda d: d["levels"][0].pop("zoom"), "levels[0].zoom", "required"),
        (lambda d: d["levels"][0].update(status="fine"), "levels[0].status", "'ok', 'degraded' or 'failed'"),
        (lambda d: d["levels"][0].update(k1="-0.12"), "levels[0].k1", "valid number"),
        (lambda d: d["levels"][0].update(k1=True), "levels[0].k1", "valid number"),
        (lambda d: d["levels"][0].update(k1=float("inf")), "levels[0].k1", "finite"),
        (lambda d: d["levels"][0].update(fov_x_deg=180), "levels[0].fov_x_deg", "less than 180"),
        (lambda d: d["levels"][0].update(fov_x_deg=26.1), "", "f_px of level .* contradicts"),
        (lambda d: d["levels"][0].update(fov_x_deg=None), "levels[0]", "cannot be told while fov_x_deg is not"),
        (lambda d: d["levels"][0].update(status="failed"), "levels[0]", "a failed level has no numbers"),
        (lambda d: d["levels"][0].update(center_shift_px=[1]), "levels[0].center_shift_px[1]", "required"),
        (lambda d: d["levels"][0].update(residual_px={"rms": -1, "max": 0}), "levels[0].residual_px.rms", "not -1"),
        (lambda d: d["levels"][0].update(sigma={"k1": -1}), "levels[0].sigma.k1", "greater than or equal to 0"),
        (lambda d: d["levels"][0].update(scenario=4), "levels[0].scenario", "1, 2 or 3"),
        (lambda d: d["levels"][0].update(frames={"real": -1}), "levels[0].frames.real", "greater than or equal"),
        (lambda d: d["levels"][0].update(left_out=[{"picture": "a"}]), "levels[0].left_out[0].reason", "required"),
    ],
)
def test_each_bad_field_is_named(change: Change, field: str, words: str) -> None:
    document = contract()
    change(document)
    with pytest.raises(BadDocument, match=words) as raised:
        document_to_table(document)
    assert raised.value.field == field
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not JSON"),
        ("[1, 2]", "not a JSON object"),
        ('"lens_table"', "not a JSON object"),
        (CONTRACT[:400], "line 4, column .* is not JSON"),
        (CONTRACT.replace("-0.12", "NaN"), "holds NaN"),
        (CONTRACT.replace("-0.12", "-Infinity"), "holds -Infinity"),
        (CONTRACT.replace("-0.12", "1e999"), "finite"),
        ("[" * 100_000, "nested too deeply"),
        ("1" * 5000, "number too long"),
        ("lens_table,lens\r\n", "is not JSON"),
    ],
)
def test_bad_json_says_where(text: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        read_json(text)


def csv_with(old: str, new: str) -> bytes:
    text = (GOLDEN / "lens_table.csv").read_bytes().decode()
    assert old in text
    return text.replace(old, new, 1).encode()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"a,b\r\n1,2\r\n", "header: has no column lens_table, lens, camera"),
        (b"lens_table;lens;camera\r\n", "commas between the columns"),
        (csv_with("camera", "lens"), "header: has column 'lens' twice"),
        (csv_with("-0.191619", "about -0.19"), "row 2, k1: 'about -0.19' is no number"),
        (csv_with(",1,4,5,", ",1.5,4,5,"), "row 2, scenario: '1.5' is no whole number"),
        (csv_with("-0.191619", "nan"), r"levels\[0\].k1: .*finite"),
        (csv_with("3.0,-2.0", "3.0,"), "row 2, center_shift_y_px: is empty while the other half"),
        (csv_with("0.021,0.06", "0.021,"), r"levels\[0\].residual_px.max"),
        (csv_with("XA 20x,'-Cam0,3,", "XA 20x,'-Cam0,4,"), "row 3, version: differs from the first row"),
        (csv_with("0.6,,", "0.6,"), "row 2: has 52 cells, the header 53"),
        (csv_with('"[{""picture""', '"[""picture""'), "row 3, left_out: is not JSON"),
        (csv_with('in 4 pictures"', "in 4 pictures"), "is not CSV"),
        ((GOLDEN / "lens_table.csv").read_bytes().split(b"\n")[0], "no row under its header"),
    ],
)
def test_bad_csv_says_where(data: bytes, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        EXPORTS["csv"].read(data)


@pytest.mark.parametrize("export", EXPORTS.values(), ids=EXPORTS.keys())
def test_other_files_are_refused_in_one_line(export: Export) -> None:
    others = [b"\x89PNG\r\n\x1a\n\x00\xff", b"\xff\xfe1\x00", bytes(MAX_DOCUMENT_BYTES + 1), b"\x00" * 100]
    for data in others:
        with pytest.raises(BadDocument) as raised:
            export.read(data)
        assert "\n" not in str(raised.value)


@EXACT
@settings(max_examples=150)
@given(data=st.data())
def test_a_damaged_file_is_read_rightly_or_refused(export: Export, data: st.DataObject) -> None:
    """Bytes cut out, put in or changed: a table or a BadDocument, no other error."""
    whole = (GOLDEN / f"lens_table{export.suffix}").read_bytes()
    start = data.draw(st.integers(0, len(whole)))
    length = data.draw(st.sampled_from([0, 1, 2, 10, 1000]))
    damaged = whole[:start] + data.draw(st.binary(max_size=4)) + whole[start + length :]
    try:
        table = export.read(damaged)
    except BadDocument as error:
        assert "\n" not in str(error)  # noqa: PT017 either outcome is right
    else:
        assert export.read(export.write(table)) == table
