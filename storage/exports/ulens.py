"""Unreal Engine Lens File (.ulens), model "Spherical": JSON with comma-separated tables in it.

Columns, in this order (the importer reads columns by their place, not by their name): ``FocusEncoder, ZoomEncoder`` as
here 0..1, then ``Fx, Fy`` = f_px/W, a f_px/H; ``Cx, Cy`` = (c_x + 0.5)/W, (c_y + 0.5)/H with c the principal point,
pixel centres at whole numbers, so that 0.5 is the picture's centre (files of other programs often leave out the half
pixel); ``K1, K2, K3, P1, P2`` = k1, k2, 0, 0, 0 in focal-length units, undistorted to distorted, as OpenCV's; nodal
offset as quaternion and translation in OpenCV axes (x right, y down, z forward): ``0, 0, 0, 1, 0, 0, Tz``.

Tz is the nodal offset, from the pivot to the entrance pupil, in Unreal's centimetres: right where the tracking tells
Unreal the pose of the pivot. A level that tells no nodal offset has no row there. ``FocusCM`` is left empty: a table
knows encoder values, no distances. Sensor size: the stated width, and the height that the pixels have.

None of these files was tried in an editor of the maker; direction and half pixel are to be checked there once.
"""

from __future__ import annotations

import json
import math
import re
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict
from pydantic.alias_generators import to_camel

from calibration.tables import LensTable, LevelResult
from storage.errors import BadDocument
from storage.exports.base import (
    EVIDENCE_LOST,
    UNKNOWN_TIME,
    Export,
    Head,
    Mark,
    decode_text,
    head_of,
    lens_levels,
    lens_of_file,
    mark_of,
    note_text,
    noted_level,
    noted_table,
    parse_json,
    provenance_of,
    read_level,
    read_note,
    read_table,
)
from storage.exports.millimetres import check_count, exact_sensor_mm, unfolded_lens
from storage.schemas import Positive, Side, Text, validated

_CARRIER = "Unreal lens"
_AGAIN = "correct it, or export it again"
_TYPE, _VERSION, _MODEL = "LensFile", "0.0.0", "Spherical"
_ENCODERS = ("FocusEncoder", "ZoomEncoder")
_COLUMNS = {
    "FocalLengthTable": ("Fx", "Fy"),
    "ImageCenterTable": ("Cx", "Cy"),
    "NodalOffsetTable": ("Qx", "Qy", "Qz", "Qw", "Tx", "Ty", "Tz"),
    "DistortionTable": ("K1", "K2", "K3", "P1", "P2"),
}
_ENCODER_TABLES = {"Focus": "FocusEncoder, FocusCM", "Iris": "IrisEncoder, IrisFstop"}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_LONGEST_NUMBER = 400  # 1e-308 without an exponent has 310 characters
_TABLE_NOTE, _LEVEL_NOTE = "lensmatch table", "lensmatch level"
_ASPECT_TOLERANCE = 1e-3
# Between a foreign file's levels: a table here has one pixel aspect.
_MM_PER_CM = 10.0

_Key = tuple[float, float]
_Rows = dict[_Key, tuple[float, ...]]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, alias_generator=to_camel)


class _LensInfo(_Part):
    serial_number: Text
    model_name: Text
    distortion_model: Text


class _Entry(BaseModel):
    """An entry of the user metadata; another program writes ``key`` for ``name``."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    name: Text | None = None
    value: Text = ""


class _Metadata(_Part):
    type: Literal["LensFile"]
    version: Literal["0.0.0"]
    lens_info: _LensInfo
    name: Text
    nodal_offset_coordinate_system: Literal["OpenCV"]
    fx_fy_units: Literal["Normalized"]
    cx_cy_units: Literal["Normalized"]
    user_metadata: tuple[_Entry, ...] = ()


class _Sensor(_Part):
    width: Positive
    height: Positive
    units: Literal["Millimeters"]


class _Picture(_Part):
    width: Side
    height: Side


class _Table(_Part):
    parameter_name: Text
    header: Text
    data: Text


class _LensFile(_Part):
    metadata: _Metadata
    sensor_dimensions: _Sensor
    image_dimensions: _Picture
    camera_parameter_tables: tuple[_Table, ...]
    encoder_tables: tuple[_Table, ...]


def write_ulens(table: LensTable) -> bytes:
    """The table as a lens file. Raises :class:`CannotExport`."""
    levels = lens_levels(table)
    sensor_mm = exact_sensor_mm(table, _CARRIER)
    facts = {**provenance_of(table), _TABLE_NOTE: note_text(head_of(table))}
    entries = [{"name": name, "value": value} for name, value in facts.items()]
    entries += [{"name": _LEVEL_NOTE, "value": note_text(mark_of(level))} for level in levels]
    rows = [_rows_of(table, level) for level in levels]
    document = {
        "metadata": {
            "type": _TYPE,
            "version": _VERSION,
            "lensInfo": {"serialNumber": "None", "modelName": table.lens, "distortionModel": _MODEL},
            "name": f"{table.lens} {table.camera} v{table.version}",
            "nodalOffsetCoordinateSystem": "OpenCV",
            "fxFyUnits": "Normalized",
            "cxCyUnits": "Normalized",
            "userMetadata": entries,
        },
        "sensorDimensions": {"width": sensor_mm[0], "height": sensor_mm[1], "units": "Millimeters"},
        "imageDimensions": {"width": table.image_size[0], "height": table.image_size[1]},
        "cameraParameterTables": [
            {
                "parameterName": name,
                "header": ", ".join((*_ENCODERS, *columns)),
                "data": "; ".join(", ".join(map(_plain, row[name])) for row in rows if name in row),
            }
            for name, columns in _COLUMNS.items()
        ],
        "encoderTables": [
            {"parameterName": name, "header": header, "data": ""} for name, header in _ENCODER_TABLES.items()
        ],
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False).encode("utf-8") + b"\n"


def _rows_of(table: LensTable, level: LevelResult) -> dict[str, tuple[float, ...]]:
    """The level's row in each table that it has one in."""
    lens = unfolded_lens(table, level)
    width, height = table.image_size
    cx, cy = lens.principal_point_px
    encoders = (float(level.focus), float(level.zoom))
    rows = {
        "FocalLengthTable": (*encoders, lens.f_px / width, lens.pixel_aspect * lens.f_px / height),
        "ImageCenterTable": (*encoders, (cx + 0.5) / width, (cy + 0.5) / height),
        "DistortionTable": (*encoders, lens.k1, lens.k2, 0.0, 0.0, 0.0),
    }
    if level.nodal_offset_mm is not None:
        rows["NodalOffsetTable"] = (*encoders, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, level.nodal_offset_mm / _MM_PER_CM)
    return rows


def _plain(value: float) -> str:
    """All digits and no exponent: an importer that takes "numbers only" may not know one."""
    return np.format_float_positional(value, trim="0")


def read_ulens(data: bytes) -> LensTable:
    """The table of a lens file. Raises :class:`BadDocument`, naming table and row."""
    document = parse_json(decode_text(data), "")
    _check_kind(document)
    read = validated(_LensFile, document)
    tables = _tables(read.camera_parameter_tables)
    image_size = read.image_dimensions.width, read.image_dimensions.height
    head, marks = _notes(read.metadata.user_metadata)
    if head is not None and head.image_size != image_size:
        raise BadDocument("imageDimensions", f"contradict the note of the table, {head.image_size}", _AGAIN)
    aspects = {key: (fy * image_size[1]) / (fx * image_size[0]) for key, (fx, fy) in tables["FocalLengthTable"].items()}
    aspect = _pixel_aspect(aspects, head)
    levels = []
    for key, (fx, _) in tables["FocalLengthTable"].items():
        focus, zoom = key
        cx, cy = tables["ImageCenterTable"][key]
        k1, k2 = tables["DistortionTable"][key][:2]
        nodal = tables["NodalOffsetTable"].get(key)
        nodal_mm = None if nodal is None else nodal[-1] * _MM_PER_CM
        shift_px = cx * image_size[0] - image_size[0] / 2, cy * image_size[1] - image_size[1] / 2
        place = f"zoom {zoom:g}, focus {focus:g}"
        lens = lens_of_file(place, image_size, fx * image_size[0], k1, k2, shift_px, aspect, nodal_mm)
        if head is None:
            missing = () if nodal is not None else ("nodal_offset_mm",)
            levels.append(read_level(zoom, focus, lens, _CARRIER, missing=missing))
            continue
        mark = marks.get(key)
        if mark is None:
            raise BadDocument(place, "has no note, though the table has one", _AGAIN)
        levels.append(noted_level(mark.model_copy(update={"nodal_offset_mm": nodal_mm}), lens, _CARRIER))
    if head is not None:
        return noted_table(data, _CARRIER, head, levels)
    return read_table(
        data,
        _CARRIER,
        levels,
        lens=read.metadata.lens_info.model_name.strip() or "unknown",
        camera="unknown",
        created=UNKNOWN_TIME,
        image_size=image_size,
        sensor_mm=(read.sensor_dimensions.width, read.sensor_dimensions.height),
        pixel_aspect=aspect,
    )


def _check_kind(document: object) -> None:
    """Type, version and model first: whatever else is wrong in a foreign file follows from them."""
    metadata = document.get("metadata") if isinstance(document, dict) else None
    if not isinstance(metadata, dict):
        raise BadDocument("metadata", "is missing", "is this an Unreal lens file?")
    info = metadata.get("lensInfo")
    model = info.get("distortionModel") if isinstance(info, dict) else None
    for place, found, wanted in (
        ("metadata.type", metadata.get("type"), _TYPE),
        ("metadata.version", metadata.get("version"), _VERSION),
        ("metadata.lensInfo.distortionModel", model, _MODEL),
    ):
        # The importer compares the model's name without regard to case.
        if not isinstance(found, str) or found.casefold() != wanted.casefold():
            raise BadDocument(place, f"is {str(found)[:40]!r}, {wanted!r} is read", "export it in that form")


def _tables(read: tuple[_Table, ...]) -> dict[str, _Rows]:
    """The rows of each table by (focus, zoom), the same ones in all; the nodal offset's may lack some."""
    tables: dict[str, _Rows] = {}
    for table in read:
        name = table.parameter_name
        if name not in _COLUMNS:
            raise BadDocument(f"cameraParameterTables, {name[:40]}", "is a table that is not known here", "remove it")
        if name in tables:
            raise BadDocument(name, "stands in the file twice", "remove one of them")
        tables[name] = _rows(table)
    if missing := [name for name in _COLUMNS if name not in tables]:
        raise BadDocument(missing[0], "is missing", "export the lens file again")
    wanted = tables["FocalLengthTable"].keys()
    check_count(len(wanted), "FocalLengthTable")
    if not wanted:
        raise BadDocument("FocalLengthTable", "has no row", "export the lens file again")
    for name, rows in tables.items():
        more = rows.keys() - wanted
        fewer = set() if name == "NodalOffsetTable" else wanted - rows.keys()
        if different := sorted(more or fewer):
            focus, zoom = different[0]
            here, there = ("has", "lacks") if more else ("lacks", "has")
            why = f"{here} focus {focus:g}, zoom {zoom:g}, which FocalLengthTable {there}"
            raise BadDocument(name, why, "give every table the same levels")
    for key, values in tables["FocalLengthTable"].items():
        if min(values) <= 0:
            why = f"focus {key[0]:g}, zoom {key[1]:g} has Fx {values[0]:g}, Fy {values[1]:g}; both must be positive"
            raise BadDocument("FocalLengthTable", why, _AGAIN)
    for key, values in tables["DistortionTable"].items():
        if any(values[2:]):
            why = f"focus {key[0]:g}, zoom {key[1]:g} has K3, P1 or P2, which this lens model lacks"
            raise BadDocument("DistortionTable", why, "calibrate the lens with K1 and K2 alone")
    for key, values in tables["NodalOffsetTable"].items():
        if values[:6] not in ((0, 0, 0, 1, 0, 0), (0, 0, 0, -1, 0, 0)):
            why = f"focus {key[0]:g}, zoom {key[1]:g} is turned or beside the axis, which this lens model lacks"
            raise BadDocument("NodalOffsetTable", why, "give it a translation along z alone")
    return tables


def _rows(table: _Table) -> _Rows:
    name = table.parameter_name
    wanted = (*_ENCODERS, *_COLUMNS[name])
    header = [column.strip() for column in table.header.split(",")]
    if [column.casefold() for column in header] != [column.casefold() for column in wanted]:
        raise BadDocument(
            f"{name}, header", f"is not {', '.join(wanted)}", "columns are read by their place: put them in this order"
        )
    rows: _Rows = {}
    texts = table.data.split(";")
    if not texts[-1].strip():
        texts.pop()
    for number, text in enumerate(texts, start=1):
        cells = [cell.strip() for cell in text.split(",")]
        place = f"{name}, row {number}"
        if len(cells) != len(wanted):
            raise BadDocument(place, f"has {len(cells)} values, its header {len(wanted)}", _AGAIN)
        values = [_value(cell, place) for cell in cells]
        key = values[0], values[1]
        if key in rows:
            raise BadDocument(place, f"is the second of focus {key[0]:g}, zoom {key[1]:g}", "remove one of them")
        rows[key] = tuple(values[2:])
    return rows


def _value(cell: str, place: str) -> float:
    value = float(cell) if _NUMBER.fullmatch(cell) and len(cell) < _LONGEST_NUMBER else math.nan
    if not math.isfinite(value):
        raise BadDocument(place, f"{cell[:40]!r} is no number", _AGAIN)
    return value


def _notes(entries: tuple[_Entry, ...]) -> tuple[Head | None, dict[_Key, Mark]]:
    """What this program noted in its own files, None and nothing in others."""
    head: Head | None = None
    marks: dict[_Key, Mark] = {}
    for index, entry in enumerate(entries):
        place = f"metadata.userMetadata[{index}]"
        if entry.name == _TABLE_NOTE:
            if head is not None:
                raise BadDocument(place, "is the second note of the table", "remove one of them")
            head = read_note(Head, entry.value, place)
        elif entry.name == _LEVEL_NOTE:
            mark = read_note(Mark, entry.value, place)
            if (mark.focus, mark.zoom) in marks:
                raise BadDocument(place, "is the second note of this level", "remove one of them")
            marks[mark.focus, mark.zoom] = mark
    return head, marks


def _pixel_aspect(aspects: dict[_Key, float], head: Head | None) -> float:
    """The one pixel aspect of all levels, exactly 1 for square pixels."""
    aspect = head.pixel_aspect if head is not None else sorted(aspects.values())[len(aspects) // 2]
    if abs(aspect - 1) < _ASPECT_TOLERANCE and head is None:
        aspect = 1.0
    for (focus, zoom), found in aspects.items():
        if not math.isclose(found, aspect, rel_tol=_ASPECT_TOLERANCE):
            why = f"focus {focus:g}, zoom {zoom:g} has the pixel aspect {found:.6g}, the table {aspect:.6g}"
            raise BadDocument("FocalLengthTable", why, "a table has one pixel aspect: correct Fx and Fy")
    return aspect


def _advice(table: LensTable) -> str:
    told = "Tz is the nodal offset from the pivot, cm: the tracking must tell the pivot's pose"
    untold = [level for level in lens_levels(table) if level.nodal_offset_mm is None]
    if untold:
        told += f"; no nodal offset at zoom {untold[0].zoom:g}, focus {untold[0].focus:g}"
        told += f" and {len(untold) - 1} more levels" if len(untold) > 1 else ""
    return told


ULENS = Export(
    name="ulens",
    title="Unreal Engine lens file",
    suffix=".ulens",
    media_type="application/json",
    write=write_ulens,
    read=read_ulens,
    cannot_carry=(EVIDENCE_LOST, "k1, k2 or centre shift that are not told, but for a note: they stand as 0"),
    advice=_advice,
)
