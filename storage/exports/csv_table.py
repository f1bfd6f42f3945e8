"""The lens table as CSV: one row a level, for spreadsheets; carries everything, exactly.

RFC 4180 (commas, CRLF, doubled quotes), UTF-8, one header row with units in the names. What holds for the whole
table (``lens`` to ``interpolation_...``) is repeated in every row, so that rows can be sorted, filtered and joined; on
reading, all rows must agree on it. Columns may stand in any order and further columns are ignored. Numbers have all
their digits; an empty cell is "not told". ``provenance``, ``correlation``,
``left_out``, ``reasons``, ``engine_values``, ``parallax`` and ``evidence`` hold JSON.

A text cell that a spreadsheet would take for a formula (it begins with = + - @, tab or carriage return) gets a
leading apostrophe, which the reader takes away again.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

from calibration.tables import EVIDENCE_QUANTITIES, LensTable
from storage.errors import BadDocument
from storage.exports.base import MAX_DOCUMENT_BYTES, Export, decode_text
from storage.schemas import document_to_table, table_to_document

_TRIGGERS = ("=", "+", "-", "@", "\t", "\r", "'")
_ADVICE = "correct the cell, or export the table again"

_TEXT, _INT, _FLOAT, _JSON = "text", "int", "float", "json"

# Column: (its place in the document, its kind). A place ends in 0 or 1 for the half of a pair.
_Path = tuple[str | int, ...]
_TABLE_COLUMNS: dict[str, tuple[_Path, str]] = {
    "lens_table": (("lens_table",), _INT),
    "lens": (("lens",), _TEXT),
    "camera": (("camera",), _TEXT),
    "version": (("version",), _INT),
    "created": (("created",), _TEXT),
    "image_width_px": (("image_size", 0), _INT),
    "image_height_px": (("image_size", 1), _INT),
    "sensor_width_mm": (("sensor_mm", 0), _FLOAT),
    "sensor_height_mm": (("sensor_mm", 1), _FLOAT),
    "pixel_aspect": (("pixel_aspect",), _FLOAT),
    "method": (("method",), _TEXT),
    "interpolation_kind": (("interpolation", "kind"), _TEXT),
    "interpolation_held_out_rms_px": (("interpolation", "held_out_px", "rms"), _FLOAT),
    "interpolation_held_out_max_px": (("interpolation", "held_out_px", "max"), _FLOAT),
    "provenance": (("provenance",), _JSON),
}
_LEVEL_COLUMNS: dict[str, tuple[_Path, str]] = {
    "zoom": (("zoom",), _FLOAT),
    "focus": (("focus",), _FLOAT),
    "status": (("status",), _TEXT),
    "reason": (("reason",), _TEXT),
    "fov_x_deg": (("fov_x_deg",), _FLOAT),
    "fov_y_deg": (("fov_y_deg",), _FLOAT),
    "f_px": (("f_px",), _FLOAT),
    "k1": (("k1",), _FLOAT),
    "k2": (("k2",), _FLOAT),
    "k1_hw": (("k1_hw",), _FLOAT),
    "k2_hw": (("k2_hw",), _FLOAT),
    "center_shift_x_px": (("center_shift_px", 0), _FLOAT),
    "center_shift_y_px": (("center_shift_px", 1), _FLOAT),
    "nodal_offset_mm": (("nodal_offset_mm",), _FLOAT),
    "sigma_fov_x_deg": (("sigma", "fov_x_deg"), _FLOAT),
    "sigma_k1": (("sigma", "k1"), _FLOAT),
    "sigma_k2": (("sigma", "k2"), _FLOAT),
    "sigma_center_shift_x_px": (("sigma", "center_shift_px", 0), _FLOAT),
    "sigma_center_shift_y_px": (("sigma", "center_shift_px", 1), _FLOAT),
    "sigma_nodal_offset_mm": (("sigma", "nodal_offset_mm"), _FLOAT),
    "correlation": (("sigma", "correlation"), _JSON),
    **{
        f"{name.removesuffix('_px')}_{part}_px": ((name, part), _FLOAT)
        for name in EVIDENCE_QUANTITIES
        for part in ("rms", "max")
    },
    "scenario": (("scenario",), _INT),
    "frames_real": (("frames", "real"), _INT),
    "frames_virtual": (("frames", "virtual"), _INT),
    "seconds": (("seconds",), _FLOAT),
    "left_out": (("left_out",), _JSON),
    "reasons": (("reasons",), _JSON),
    "engine_values": (("engine_values",), _JSON),
    "parallax": (("parallax",), _JSON),
    "evidence": (("evidence",), _JSON),
}
_LATER_COLUMNS = ("provenance", "correlation", "engine_values", "parallax", "evidence")
"""Columns that files of earlier versions do not have; without one, nothing of it is told."""


def write_csv(table: LensTable) -> bytes:
    """The table as CSV; the same bytes for the same table."""
    document = table_to_document(table)
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow([*_TABLE_COLUMNS, *_LEVEL_COLUMNS])
    shared = [_cell(document, *column) for column in _TABLE_COLUMNS.values()]
    for level in document["levels"]:
        writer.writerow([*shared, *(_cell(level, *column) for column in _LEVEL_COLUMNS.values())])
    return out.getvalue().encode("utf-8")


def read_csv(data: bytes) -> LensTable:
    """The table of a CSV file. Raises :class:`BadDocument`, naming row and column."""
    header, rows = _rows(decode_text(data))
    missing = [name for name in (*_TABLE_COLUMNS, *_LEVEL_COLUMNS) if name not in (*header, *_LATER_COLUMNS)]
    if missing:
        hint = "save it with commas between the columns" if ";" in header[0] else "is this a lens table file?"
        raise BadDocument("header", f"has no column {', '.join(missing[:3])}", hint)
    document: dict[str, Any] = {}
    levels: list[dict[str, Any]] = []
    for number, row in rows:
        if len(row) != len(header):
            raise BadDocument(f"row {number}", f"has {len(row)} cells, the header {len(header)}", _ADVICE)
        cells = dict(zip(header, row, strict=True))
        shared = _read_cells(cells, _TABLE_COLUMNS, number)
        if document and shared != document:
            differing = next(name for name in {**document, **shared} if shared.get(name) != document.get(name))
            raise BadDocument(f"row {number}, {differing}", "differs from the first row", _ADVICE)
        document = shared
        levels.append(_read_cells(cells, _LEVEL_COLUMNS, number))
    if not levels:
        raise BadDocument("", "has no row under its header", "export the table again")
    return document_to_table({**document, "levels": levels})


def _rows(text: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The header, and the rows under it with their numbers as a spreadsheet shows them; empty rows are skipped."""
    if csv.field_size_limit() < MAX_DOCUMENT_BYTES:
        csv.field_size_limit(MAX_DOCUMENT_BYTES)  # a long list of left-out pictures exceeds the module's 128 KiB
    try:
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        rows = [(number, row) for number, row in enumerate(reader, start=1) if row]
    except csv.Error as error:
        raise BadDocument("", f"is not CSV ({error})", "is this a lens table file?") from error
    if not rows:
        raise BadDocument("", "is empty", "export the table again")
    header = rows[0][1]
    if len(set(header)) != len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise BadDocument("header", f"has column {twice!r} twice", "remove one of them")
    return rows[0][1], rows[1:]


def _cell(document: Mapping[str, Any], path: _Path, kind: str) -> str:
    value: Any = document
    for part in path:
        value = None if value is None else value.get(part) if isinstance(value, Mapping) else value[part]
    if kind == _JSON:
        return json.dumps(value, ensure_ascii=False) if value else ""
    if value is None:
        return ""
    if kind == _TEXT:
        text = str(value)
        return f"'{text}" if text.startswith(_TRIGGERS) else text
    return repr(value)


def _read_cells(cells: Mapping[str, str], columns: Mapping[str, tuple[_Path, str]], number: int) -> dict[str, Any]:
    """The part of the document that the cells of one row make, without what is empty."""
    flat = {path: _value(cells.get(name, ""), kind, f"row {number}, {name}") for name, (path, kind) in columns.items()}
    for name, (path, _) in columns.items():
        partner = (*path[:-1], 1 - path[-1]) if isinstance(path[-1], int) else None
        if partner is not None and flat[path] is None and flat[partner] is not None:
            raise BadDocument(f"row {number}, {name}", "is empty while the other half of the pair is not", _ADVICE)
    nested = _nested(list(flat.items())) or {}
    return {name: value for name, value in nested.items() if value is not None}


def _nested(items: Sequence[tuple[_Path, Any]]) -> Any:
    if len(items) == 1 and not items[0][0]:
        return items[0][1]
    parts: dict[str | int, list[tuple[_Path, Any]]] = {}
    for path, value in items:
        parts.setdefault(path[0], []).append((path[1:], value))
    built = {part: _nested(inside) for part, inside in parts.items()}
    if 0 in built:
        return None if built[0] is None else [built[0], built[1]]
    return None if all(value is None for value in built.values()) else built


def _value(cell: str, kind: str, place: str) -> Any:
    if kind == _JSON:
        try:
            return json.loads(cell) if cell else None
        except (ValueError, RecursionError) as error:
            raise BadDocument(place, "is not JSON", _ADVICE) from error
    if kind == _TEXT:
        text = cell[1:] if len(cell) > 1 and cell[0] == "'" and cell[1] in _TRIGGERS else cell
        return text or None
    if not cell.strip():
        return None
    try:
        return int(cell) if kind == _INT else float(cell)
    except ValueError as error:
        shown = cell if len(cell) <= 40 else f"{cell[:37]}..."
        raise BadDocument(place, f"{shown!r} is no {'whole number' if kind == _INT else 'number'}", _ADVICE) from error


CSV_TABLE = Export(
    name="csv",
    title="One row a level, for spreadsheets",
    suffix=".csv",
    media_type="text/csv",
    write=write_csv,
    read=read_csv,
)
