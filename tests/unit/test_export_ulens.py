"""Unreal lens files: the test vector in their units, their layout key by key, round trips and bad files."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.compare import overlay
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult
from storage.errors import BadDocument, CannotExport
from storage.exports import EXPORTS
from storage.exports.ulens import read_ulens, write_ulens
from tests.support.real_lenses import SIZE, VECTOR, assert_same_lenses, level_of, real_tables, table_of, vector_table

ULENS = EXPORTS["ulens"]
Document = dict[str, Any]


def document_of(table: LensTable) -> Document:
    found: Document = json.loads(write_ulens(table))
    return found


def two_levels() -> LensTable:
    return table_of(level_of(VECTOR), level_of(VECTOR, 0.5))


def foreign() -> Document:
    """Two levels without this program's own notes."""
    document = document_of(two_levels())
    document["metadata"]["userMetadata"] = [{"key": "who", "value": "another program"}]
    return document


def read(document: object) -> LensTable:
    return read_ulens(json.dumps(document).encode())


def table_named(document: Document, name: str) -> Document:
    found: Document
    (found,) = (table for table in document["cameraParameterTables"] if table["parameterName"] == name)
    return found


def rows(document: Document, name: str) -> list[list[float]]:
    return [[float(cell) for cell in row.split(",")] for row in table_named(document, name)["data"].split(";")]


# Golden values


def test_the_test_vector_normalised() -> None:
    document = document_of(vector_table())
    assert rows(document, "FocalLengthTable") == [[0.5, 0.0, pytest.approx(0.697591531), pytest.approx(1.240162722)]]
    assert rows(document, "ImageCenterTable") == [[0.5, 0.0, pytest.approx(0.5015625), pytest.approx(0.498148148)]]
    assert rows(document, "DistortionTable") == [[0.5, 0.0, -0.191619, 0.0689969, 0, 0, 0]]
    assert rows(document, "NodalOffsetTable") == [[0.5, 0.0, 0, 0, 0, 1, 0, 0, pytest.approx(12.13)]]


def test_a_ray_lands_where_the_engines_formula_puts_it() -> None:
    """uv = C + F x (1 + K1 r2 + K2 r4), for the ray (0.5, 0.2) of the test vector."""
    document = document_of(vector_table())
    (fx, fy), (cx, cy) = (rows(document, name)[0][2:] for name in ("FocalLengthTable", "ImageCenterTable"))
    k1, k2 = rows(document, "DistortionTable")[0][2:4]
    r2 = 0.5**2 + 0.2**2
    gain = 1 + k1 * r2 + k2 * r2 * r2
    assert (cx + fx * 0.5 * gain, cy + fy * 0.2 * gain) == pytest.approx((0.832999792, 0.733836889), abs=1e-9)


def test_the_layout_is_the_importers() -> None:
    document = document_of(two_levels())
    assert list(document) == [
        "metadata",
        "sensorDimensions",
        "imageDimensions",
        "cameraParameterTables",
        "encoderTables",
    ]
    metadata = document["metadata"]
    assert (metadata["type"], metadata["version"]) == ("LensFile", "0.0.0")
    assert metadata["lensInfo"] == {"serialNumber": "None", "modelName": "XA 20x", "distortionModel": "Spherical"}
    assert (metadata["nodalOffsetCoordinateSystem"], metadata["fxFyUnits"], metadata["cxCyUnits"]) == (
        "OpenCV",
        "Normalized",
        "Normalized",
    )
    assert {"name": "method", "value": "joint"} in metadata["userMetadata"]
    assert all(isinstance(entry["value"], str) for entry in metadata["userMetadata"])
    assert document["sensorDimensions"]["units"] == "Millimeters"
    assert document["imageDimensions"] == {"width": 1920, "height": 1080}
    assert [(table["parameterName"], table["header"]) for table in document["cameraParameterTables"]] == [
        ("FocalLengthTable", "FocusEncoder, ZoomEncoder, Fx, Fy"),
        ("ImageCenterTable", "FocusEncoder, ZoomEncoder, Cx, Cy"),
        ("NodalOffsetTable", "FocusEncoder, ZoomEncoder, Qx, Qy, Qz, Qw, Tx, Ty, Tz"),
        ("DistortionTable", "FocusEncoder, ZoomEncoder, K1, K2, K3, P1, P2"),
    ]
    assert document["encoderTables"] == [
        {"parameterName": "Focus", "header": "FocusEncoder, FocusCM", "data": ""},
        {"parameterName": "Iris", "header": "IrisEncoder, IrisFstop", "data": ""},
    ]


@settings(max_examples=25)
@given(table=real_tables())
def test_rows_are_plain_numbers_as_many_as_their_header(table: LensTable) -> None:
    for found in document_of(table)["cameraParameterTables"]:
        width = len(found["header"].split(","))
        for row in found["data"].split(";") if found["data"] else []:
            cells = row.split(",")
            assert len(cells) == width
            assert all(set(cell.strip()) <= set("0123456789.-") for cell in cells)


# There and back


@settings(max_examples=40)
@given(table=real_tables())
def test_there_and_back(table: LensTable) -> None:
    assert_same_lenses(table, read_ulens(write_ulens(table)), 1e-8)


def test_a_file_of_another_program_is_read() -> None:
    table = read(foreign())
    assert (table.lens, table.camera, table.version) == ("XA 20x", "unknown", 1)
    assert [(level.zoom, level.focus) for level in table.levels] == [(0.0, 0.5), (0.5, 0.5)]
    assert overlay(VECTOR, table.levels[0].lens(table.image_size)).max_px < 1e-9
    assert table.levels[1].nodal_offset_mm == pytest.approx(121.3)


def test_a_level_without_nodal_offset_has_no_row_and_is_told() -> None:
    table = table_of(level_of(VECTOR), level_of(VECTOR, 0.5, untold=("nodal_offset_mm",)))
    assert len(rows(document_of(table), "NodalOffsetTable")) == 1
    assert ULENS.advice is not None
    assert ULENS.advice(table).endswith("; no nodal offset at zoom 0.5, focus 0.5")
    assert [level.nodal_offset_mm for level in read(document_of(table)).levels] == [pytest.approx(121.3), None]
    none = table_of(level_of(VECTOR, untold=("nodal_offset_mm",)))
    assert table_named(document_of(none), "NodalOffsetTable")["data"] == ""
    assert read(document_of(none)).levels[0].nodal_offset_mm is None


def test_pixels_that_are_not_square_keep_their_aspect() -> None:
    document = foreign()
    stretched = Lens(SIZE, VECTOR.f_px, pixel_aspect=1.1)
    table_named(document, "FocalLengthTable")["data"] = "; ".join(
        f"0.5, {zoom}, {stretched.f_px / 1920}, {1.1 * stretched.f_px / 1080}" for zoom in (0.0, 0.5)
    )
    assert read(document).pixel_aspect == pytest.approx(1.1)


def test_tables_that_cannot_be_carried() -> None:
    no_sensor = LensTable("a", "b", 1, vector_table().created, SIZE, "joint", (level_of(VECTOR),))
    folded = table_of(level_of(Lens(SIZE, 1000.0, k1=-0.5)))
    failed = table_of(LevelResult.failed(0, 0, "no board"))
    for table, words in ((no_sensor, "sensor_mm"), (folded, "folds"), (failed, "no level of this table")):
        with pytest.raises(CannotExport, match=words):
            write_ulens(table)


# Bad files

Change = Callable[[Document], object]


def data(name: str, text: str) -> Change:
    return lambda document: table_named(document, name).update(data=text)


def header(name: str, text: str) -> Change:
    return lambda document: table_named(document, name).update(header=text)


@pytest.mark.parametrize(
    ("change", "field", "words"),
    [
        (lambda d: d.pop("metadata"), "metadata", "is this an Unreal lens file"),
        (lambda d: d["metadata"].update(type="Camera"), "metadata.type", "'Camera', 'LensFile' is read"),
        (lambda d: d["metadata"].update(version="0.1.0"), "metadata.version", "'0.1.0', '0.0.0' is read"),
        (lambda d: d["metadata"].pop("version"), "metadata.version", "'None'"),
        (lambda d: d["metadata"].update(version=0), "metadata.version", "'0'"),
        (
            lambda d: d["metadata"]["lensInfo"].update(distortionModel="Anamorphic"),
            "metadata.lensInfo.distortionModel",
            "'Anamorphic', 'Spherical' is read",
        ),
        (lambda d: d["metadata"].pop("lensInfo"), "metadata.lensInfo.distortionModel", "'None'"),
        (lambda d: d["metadata"].update(fxFyUnits="Pixels"), "metadata.fxFyUnits", "Normalized"),
        (
            lambda d: d["metadata"].update(nodalOffsetCoordinateSystem="Unreal"),
            "metadata.nodalOffsetCoordinateSystem",
            "O",
        ),
        (lambda d: d["metadata"].pop("name"), "metadata.name", "required"),
        (lambda d: d.update(colour="blue"), "colour", "not permitted"),
        (lambda d: d.pop("encoderTables"), "encoderTables", "required"),
        (lambda d: d["sensorDimensions"].update(width=-1), "sensorDimensions.width", "greater than 0"),
        (lambda d: d["imageDimensions"].update(width=10**7), "imageDimensions.width", "100000"),
        (lambda d: d["imageDimensions"].update(width="1920"), "imageDimensions.width", "integer"),
        (lambda d: d["cameraParameterTables"].pop(), "DistortionTable", "is missing"),
        (lambda d: d["cameraParameterTables"].append(d["cameraParameterTables"][0]), "FocalLengthTable", "twice"),
        (
            lambda d: d["cameraParameterTables"].append({"parameterName": "STMapTable", "header": "", "data": ""}),
            "cameraParameterTables, STMapTable",
            "not known",
        ),
        (
            header("DistortionTable", "FocusEncoder, ZoomEncoder, K1, K2, P1, P2, K3"),
            "DistortionTable, header",
            "order",
        ),
        (data("FocalLengthTable", ""), "FocalLengthTable", "has no row"),
        (
            data("FocalLengthTable", "0.5, 0.0, 0.7, 1.24; 0.5, 0.5, 0.7"),
            "FocalLengthTable, row 2",
            "3 values, its header 4",
        ),
        (data("DistortionTable", "0.5, 0.0, 0, 0, 0, 0"), "DistortionTable, row 1", "has 6 values, its header 7"),
        (
            data("ImageCenterTable", "0.5, 0.0, 0.5, nan; 0.5, 0.5, 0.5, 0.5"),
            "ImageCenterTable, row 1",
            "'nan' is no num",
        ),
        (
            data("ImageCenterTable", "0.5, 0.0, 0.5, 1_0; 0.5, 0.5, 0.5, 0.5"),
            "ImageCenterTable, row 1",
            "'1_0' is no num",
        ),
        (
            data("ImageCenterTable", "0.5, 0.0, 0.5, 1e999; 0.5, 0.5, 0, 0"),
            "ImageCenterTable, row 1",
            "'1e999' is no num",
        ),
        (data("ImageCenterTable", "0.5, 0.0, 0.5, 0.5"), "ImageCenterTable", "lacks focus 0.5, zoom 0.5, which Focal"),
        (
            data("NodalOffsetTable", "0.5, 0.7, 0, 0, 0, 1, 0, 0, 5"),
            "NodalOffsetTable",
            "has focus 0.5, zoom 0.7, which FocalLengthTable lacks",
        ),
        (data("NodalOffsetTable", "0.5, 0.5, 0, 0, 0, 1, 2, 0, 5"), "NodalOffsetTable", "beside the axis"),
        (
            data("DistortionTable", "0.5, 0.0, 0, 0, 0, 0, 0; 0.5, 0.0, 0, 0, 0, 0, 0"),
            "DistortionTable, row 2",
            "second of",
        ),
        (
            data("DistortionTable", "0.5, 0, 0, 0, 1, 0, 0; 0.5, 0.5, 0, 0, 0, 0, 0"),
            "DistortionTable",
            "has K3, P1 or P2",
        ),
        (data("DistortionTable", "0.5, 0, -0.9, 0, 0, 0, 0; 0.5, 0.5, 0, 0, 0, 0, 0"), "zoom 0, focus 0.5", "folds"),
        (
            data("FocalLengthTable", "0.5, 0.0, 0, 1; 0.5, 0.5, 0.7, 1.24"),
            "FocalLengthTable",
            "must be positive",
        ),
        (
            data("FocalLengthTable", "0.5, 0.0, 0.7, 1.3; 0.5, 0.5, 0.7, 1.24444"),
            "FocalLengthTable",
            "one pixel aspect",
        ),
    ],
)
def test_each_mistake_is_named(change: Change, field: str, words: str) -> None:
    document = foreign()
    change(document)
    with pytest.raises(BadDocument, match=words) as raised:
        read(document)
    assert raised.value.field == field
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("lensmatch level", "lensmatch Level", "has no note, though the table has one"),
        ('\\"zoom\\": 0.5', '\\"zoom\\": 0.0', "second note of this level"),
        ('\\"lens_table\\": 1', '\\"lens_table\\": 2', "lens_table"),
        ('\\"image_size\\": [1920', '\\"image_size\\": [1280', "contradict the note"),
        ('\\"levels\\": 2', '\\"levels\\": 3', "2 levels of the 3"),
        ('\\"pixel_aspect\\": 1.0', '\\"pixel_aspect\\": 1.5', "one pixel aspect"),
        ("lensmatch level", "lensmatch table", "is the second note of the table"),
    ],
)
def test_a_note_that_contradicts_its_file_is_refused(old: str, new: str, words: str) -> None:
    text = write_ulens(two_levels()).decode()
    assert old in text
    with pytest.raises(BadDocument, match=words):
        read_ulens(text.replace(old, new, 1).encode())


def test_more_levels_than_any_table_are_refused() -> None:
    document = foreign()
    table_named(document, "FocalLengthTable")["data"] = ";".join(f"0,{zoom},1,1" for zoom in np.arange(10_001))
    with pytest.raises(BadDocument, match="has 10001 levels"):
        read(document)


@settings(max_examples=100)
@given(draw=st.data())
def test_a_damaged_file_is_read_rightly_or_refused(draw: st.DataObject) -> None:
    whole = write_ulens(two_levels())
    start = draw.draw(st.integers(0, len(whole)))
    length = draw.draw(st.sampled_from([0, 1, 2, 10, 1000]))
    damaged = whole[:start] + draw.draw(st.binary(max_size=4)) + whole[start + length :]
    try:
        table = read_ulens(damaged)
    except BadDocument as error:
        assert "\n" not in str(error)  # noqa: PT017 either outcome is right
    else:
        assert len(table.levels) == 2
