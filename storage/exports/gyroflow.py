"""Gyroflow's lens profile (JSON), distortion model ``opencv_standard``.

Coefficients as in OpenCV: k1, k2, p1, p2 with p1 = p2 = 0, radius in focal lengths, undistorted to distorted, camera
matrix in px. ``asymmetrical`` is true, without which Gyroflow would put the centre into the middle. Several zooms
stand in ``interpolations`` under their zoom values, the first of them also as the profile itself; Gyroflow has no
place for focus, so that a table of several focuses is refused. What Gyroflow takes for the key on a running camera was
not traced: check it there. ``lensmatch`` holds what Gyroflow ignores: zoom, focus, nodal offset, and the table's facts.

Also read: a profile of another program in ``opencv_standard`` with k1 and k2 only, as zoom 0, focus 0.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any

from calibration.lens import Lens
from calibration.tables import MAX_PICTURE_SIDE_PX, LensTable, LevelResult
from storage.errors import BadDocument, CannotExport
from storage.exports.base import (
    EVIDENCE_LOST,
    ONLY_IN_A_NOTE,
    Export,
    Head,
    Mark,
    decode_text,
    foreign_table,
    head_of,
    lens_levels,
    lens_of_file,
    mark_of,
    noted_level,
    noted_table,
    one_focus,
    parse_json,
    provenance_of,
    read_note,
)

_CARRIER = "Gyroflow"
_ADVICE = "is this a Gyroflow lens profile?"
_MODEL = "opencv_standard"
_KEY_DIGITS = 6
"""Gyroflow looks keys up to this many decimals."""


def write_gyroflow(table: LensTable) -> bytes:
    """The levels that have a lens, all of one focus. Raises :class:`CannotExport`."""
    levels = tuple(sorted(lens_levels(table), key=lambda level: level.zoom))
    one_focus(levels, "a Gyroflow lens profile")
    keys = [f"{level.zoom:.{_KEY_DIGITS}f}" for level in levels]
    if len(set(keys)) != len(keys):
        raise CannotExport(
            "two levels have zooms alike to six decimals, Gyroflow cannot tell them apart; export one (--zoom)"
        )
    width, height = table.image_size
    size = {"w": width, "h": height}
    facts = provenance_of(table)
    entries = [_entry(table, level) for level in levels]
    profile: dict[str, Any] = {
        "name": f"{table.camera} {table.lens} {width}x{height}",
        "note": f"lens table version {table.version}, focus {levels[0].focus:g}",
        "calibrated_by": facts.get("software", "Lensmatch"),
        "camera_brand": "",
        "camera_model": table.camera,
        "lens_model": table.lens,
        "camera_setting": "",
        "calib_dimension": size,
        "orig_dimension": size,
        "input_horizontal_stretch": 1.0,
        "input_vertical_stretch": 1.0,
        "num_images": sum(level.frames.real for level in levels),
        "fps": 0.0,
        "official": False,
        "asymmetrical": True,
        "fisheye_params": {
            "RMS_error": levels[0].residual_px.rms if levels[0].residual_px else 0.0,
            "camera_matrix": entries[0]["camera_matrix"],
            "distortion_coeffs": entries[0]["distortion_coeffs"],
        },
        "calibrator_version": facts.get("software", "Lensmatch"),
        "date": facts["created"][:10],
        "distortion_model": _MODEL,
        "focal_length": entries[0]["focal_length"],
        "lensmatch": {"table": head_of(table), "levels": [mark_of(level) for level in levels]},
    }
    if len(levels) > 1:
        profile["interpolations"] = dict(zip(keys, entries, strict=True))
    text = json.dumps(profile, allow_nan=False, sort_keys=True)
    profile["identifier"] = hashlib.sha256(text.encode()).hexdigest()[:16]
    return json.dumps(profile, indent=1, ensure_ascii=False, allow_nan=False).encode("utf-8") + b"\n"


def _entry(table: LensTable, level: LevelResult) -> dict[str, Any]:
    lens = level.lens(table.image_size, table.pixel_aspect)
    cx, cy = lens.principal_point_px
    matrix = [[lens.f_px, 0.0, cx], [0.0, lens.pixel_aspect * lens.f_px, cy], [0.0, 0.0, 1.0]]
    focal_mm = lens.f_px * table.sensor_mm[0] / table.image_size[0] if table.sensor_mm else None
    return {"camera_matrix": matrix, "distortion_coeffs": [lens.k1, lens.k2, 0.0, 0.0], "focal_length": focal_mm}


def read_gyroflow(data: bytes) -> LensTable:
    """The table of our own profile, or the lens of another's. Raises :class:`BadDocument`."""
    profile = parse_json(decode_text(data), "")
    if not isinstance(profile, dict) or not isinstance(profile.get("fisheye_params"), dict):
        raise BadDocument("fisheye_params", "is not there", _ADVICE)
    model = profile.get("distortion_model")
    if model != _MODEL:
        told = "opencv_fisheye" if model is None else str(model)[:40]
        raise BadDocument(
            "distortion_model", f"is {told}, only {_MODEL} is read", "calibrate again with k1 and k2 of that model"
        )
    if profile.get("input_horizontal_stretch", 1) != 1 or profile.get("input_vertical_stretch", 1) != 1:
        raise BadDocument("input_horizontal_stretch", "a stretched picture is not read", "calibrate it unstretched")
    size = _size(profile.get("calib_dimension"))
    note = profile.get("lensmatch")
    if note is None:
        return _foreign(data, profile, size)
    if not isinstance(note, dict) or not isinstance(note.get("levels"), list) or not note["levels"]:
        raise BadDocument("lensmatch.levels", "must be a list of levels", _ADVICE)
    head = read_note(Head, note.get("table"), "lensmatch.table")
    if size != head.image_size:
        raise BadDocument("calib_dimension", "contradicts lensmatch.table.image_size", "export it again")
    marks = [read_note(Mark, entry, f"lensmatch.levels[{n}]") for n, entry in enumerate(note["levels"])]
    entries: Any = profile.get("interpolations")
    if len(marks) == 1:
        entries = {f"{marks[0].zoom:.{_KEY_DIGITS}f}": profile["fisheye_params"]}
    elif not isinstance(entries, dict) or len(entries) != len(marks):
        raise BadDocument("interpolations", f"must hold {len(marks)} levels", "export it again")
    levels = []
    for mark in marks:
        key = f"{mark.zoom:.{_KEY_DIGITS}f}"
        place = f"interpolations.{key}" if len(marks) > 1 else "fisheye_params"
        lens = _lens(entries.get(key), place, size, head.pixel_aspect, mark.nodal_offset_mm)
        levels.append(noted_level(mark, lens, _CARRIER))
    return noted_table(data, _CARRIER, head, levels)


def _foreign(data: bytes, profile: dict[str, Any], size: tuple[int, int]) -> LensTable:
    if profile.get("interpolations"):
        raise BadDocument("interpolations", "of another program tell no zoom and focus", "keep one level in the file")
    lens = _lens(profile["fisheye_params"], "fisheye_params", size, None, None)
    if not profile.get("asymmetrical"):  # Gyroflow itself then takes the middle
        lens = lens_of_file("", size, lens.f_px, lens.k1, lens.k2, pixel_aspect=lens.pixel_aspect)
    return foreign_table(data, _CARRIER, lens)


def _size(found: Any) -> tuple[int, int]:
    sides: list[Any] = [found.get("w"), found.get("h")] if isinstance(found, dict) else []
    if not sides or not all(isinstance(side, int) and 2 <= side <= MAX_PICTURE_SIDE_PX for side in sides):
        raise BadDocument("calib_dimension", f"must be w and h of 2 to {MAX_PICTURE_SIDE_PX} px", _ADVICE)
    return sides[0], sides[1]


def _lens(
    entry: Any, place: str, size: tuple[int, int], pixel_aspect: float | None, nodal_offset_mm: float | None
) -> Lens:
    """The lens of an entry; the pixel aspect as known, else from the matrix."""
    entry = entry if isinstance(entry, dict) else {}
    matrix = _numbers(entry.get("camera_matrix"), f"{place}.camera_matrix")
    rest = [value for place_in_it, value in enumerate(matrix) if place_in_it not in (0, 2, 4, 5)]
    if rest != [0, 0, 0, 0, 1] or matrix[0] <= 0 or matrix[4] <= 0:
        raise BadDocument(f"{place}.camera_matrix", "is not [fx 0 cx, 0 fy cy, 0 0 1]", _ADVICE)
    coefficients = _numbers(entry.get("distortion_coeffs"), f"{place}.distortion_coeffs")
    if len(coefficients) < 2 or any(coefficients[2:]):
        raise BadDocument(f"{place}.distortion_coeffs", "must be k1, k2 and nothing but 0 behind them", _ADVICE)
    fx, fy = matrix[0], matrix[4]
    if pixel_aspect is not None and not math.isclose(fy / fx, pixel_aspect, rel_tol=1e-9):
        raise BadDocument(f"{place}.camera_matrix", f"fy / fx is not the table's {pixel_aspect:g}", "export it again")
    shift = (matrix[2] - (size[0] - 1) / 2, matrix[5] - (size[1] - 1) / 2)
    aspect = fy / fx if pixel_aspect is None else pixel_aspect
    return lens_of_file(place, size, fx, coefficients[0], coefficients[1], shift, aspect, nodal_offset_mm)


def _numbers(found: Any, place: str) -> list[float]:
    """A list of numbers, or of lists of them, as a flat list."""
    rows = found if isinstance(found, list) else [None]
    flat: list[Any] = [value for row in rows for value in (row if isinstance(row, list) else [row])]
    if not all(isinstance(value, (int, float)) and abs(value) < math.inf for value in flat):
        raise BadDocument(place, "must be a list of finite numbers", _ADVICE)
    return [float(value) for value in flat]


GYROFLOW = Export(
    name="gyroflow",
    title="Gyroflow lens profile",
    suffix=".json",
    media_type="application/json",
    write=write_gyroflow,
    read=read_gyroflow,
    cannot_carry=(EVIDENCE_LOST, ONLY_IN_A_NOTE, "levels of several focuses: one focus a file"),
)
