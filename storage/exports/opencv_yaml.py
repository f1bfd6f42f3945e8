"""OpenCV's YAML (``cv2.FileStorage``): camera matrix and distortion coefficients of each level.

The convention is the product's own: pixel centres at whole numbers, k1 and k2 in focal-length units, undistorted to
distorted, ``distortion_coefficients`` = k1, k2, p1, p2, k3 with p1 = p2 = k3 = 0. ``levels`` is a sequence of maps
with ``zoom``, ``focus``, ``camera_matrix``, ``distortion_coefficients`` and, where known, ``nodal_offset_mm``. A table
of one level also has the usual keys at the top, so that any reader of a single calibration takes it.

Also read: the calibration of a single camera by another program (``camera_matrix``, ``distortion_coefficients``, the
picture's size, under their usual names), as zoom 0, focus 0.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult
from calibration.types import FloatArray
from storage.errors import BadDocument
from storage.exports.base import (
    EVIDENCE_LOST,
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
    read_note,
)

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

_CARRIER = "OpenCV"
_ADVICE = "is this an OpenCV calibration file?"
_MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "camMtx", "K")
_COEFFICIENT_KEYS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D")
_WIDTH_KEYS, _HEIGHT_KEYS = ("image_width", "imageWidth", "width"), ("image_height", "imageHeight", "height")
_MOST_COEFFICIENTS = 14
_MOST_LEVELS = 10_000
_MOST_DEPTH, _MOST_INDENT, _MOST_COLONS = 2, 40, 8
_TEXT_LINE = re.compile(r'[ -]*[A-Za-z_]\w*: *"(?:[^"\\]|\\.)*" *\r?$')
_BRACKETS = re.compile(r"[\[\]{}\"'#]")


def write_opencv_yaml(table: LensTable) -> bytes:
    """The levels that have a lens, as ``cv2.FileStorage`` writes YAML."""
    levels = lens_levels(table)
    file = cv2.FileStorage("", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    _put(file, "table", head_of(table))
    width, height = table.image_size
    _put(file, "image_width", width)
    _put(file, "image_height", height)
    if len(levels) == 1:
        _put_lens(file, levels[0], table)
    file.startWriteStruct("levels", cv2.FILE_NODE_SEQ)
    for level in levels:
        file.startWriteStruct("", cv2.FILE_NODE_MAP)
        for name, value in mark_of(level).items():
            _put(file, name, value)
        _put_lens(file, level, table)
        file.endWriteStruct()
    file.endWriteStruct()
    return str(file.releaseAndGetString()).encode("utf-8")


def _put_lens(file: cv2.FileStorage, level: LevelResult, table: LensTable) -> None:
    lens = level.lens(table.image_size, table.pixel_aspect)
    cx, cy = lens.principal_point_px
    matrix = [[lens.f_px, 0.0, cx], [0.0, lens.pixel_aspect * lens.f_px, cy], [0.0, 0.0, 1.0]]
    file.write("camera_matrix", np.array(matrix))
    file.write("distortion_coefficients", np.array([[lens.k1, lens.k2, 0.0, 0.0, 0.0]]))


def _put(file: cv2.FileStorage, name: str, value: Any) -> None:
    """A value of a note: texts, numbers, and lists and maps of them."""
    if isinstance(value, dict):
        file.startWriteStruct(name, cv2.FILE_NODE_MAP)
        for key, part in value.items():
            _put(file, key, part)
        file.endWriteStruct()
    elif isinstance(value, list):
        file.startWriteStruct(name, cv2.FILE_NODE_SEQ)
        for part in value:
            _put(file, "", part)
        file.endWriteStruct()
    elif isinstance(value, str):
        # In quotes of our own: cv2 takes a text that begins and ends with a quote for one that has them already.
        file.write(name, '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"')
    else:
        file.write(name, value)


def read_opencv_yaml(data: bytes) -> LensTable:
    """The table of our own file, or of the calibration of a single camera. Raises :class:`BadDocument`."""
    text = decode_text(data)
    _require_flat(text)
    try:
        file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise BadDocument("", "is not a file of cv2.FileStorage", _ADVICE) from error
    try:
        root = _value(file.root(), 0)
    except cv2.error as error:
        raise BadDocument("", "is not a file of cv2.FileStorage", _ADVICE) from error
    finally:
        file.release()
    if not isinstance(root, dict):
        raise BadDocument("", "holds no keys", _ADVICE)
    return _own_table(data, root) if "table" in root else _foreign(data, root)


def _require_flat(text: str) -> None:
    """Refuse what cv2's parser, which calls itself for each bracket, indent and key, would end the process on.

    Brackets may stand two deep, and between them neither quotes nor comments (which could hide brackets from this
    look); a whole line ``key: "text"`` may hold anything. Raises :class:`BadDocument`.
    """
    if not text.startswith("%YAML") or "\0" in text:
        raise BadDocument("", "does not begin with %YAML", _ADVICE)
    depth = 0
    for number, line in enumerate(text.split("\n"), start=1):
        if depth == 0 and _TEXT_LINE.match(line):
            continue
        deep = len(line) - len(line.lstrip(" \t-?")) > _MOST_INDENT or line.count(":") > _MOST_COLONS
        for character in _BRACKETS.findall(line):
            depth = max(0, depth + {"[": 1, "{": 1, "]": -1, "}": -1}.get(character, 0))
            deep = deep or depth > _MOST_DEPTH or (depth > 0 and character in "\"'#")
        if deep:
            raise BadDocument(f"line {number}", "is nested too deeply, or has texts in a list", _ADVICE)


def _own_table(data: bytes, root: dict[str, Any]) -> LensTable:
    head = read_note(Head, root["table"], "table")
    entries = root.get("levels")
    if not isinstance(entries, list) or not 1 <= len(entries) <= _MOST_LEVELS:
        raise BadDocument("levels", f"must be a list of 1 to {_MOST_LEVELS} levels", _ADVICE)
    levels = []
    for number, entry in enumerate(entries):
        place = f"levels[{number}]"
        mark = read_note(Mark, entry, place)
        lens = _lens(entry, place, head.image_size, mark.nodal_offset_mm, head.pixel_aspect)
        levels.append(noted_level(mark, lens, _CARRIER))
    if any(name in root and root[name] != entries[0].get(name) for name in (_MATRIX_KEYS[0], _COEFFICIENT_KEYS[0])):
        raise BadDocument(_MATRIX_KEYS[0], "differs from that of levels[0]", "correct one of them, or export it again")
    return noted_table(data, _CARRIER, head, levels)


def _foreign(data: bytes, root: dict[str, Any]) -> LensTable:
    size = []
    for what, names in (("width", _WIDTH_KEYS), ("height", _HEIGHT_KEYS)):
        side = next((root[name] for name in names if name in root), None)
        if not isinstance(side, (int, float)) or side != side or not 2 <= side <= 100_000 or side != int(side):
            raise BadDocument(f"image_{what}", "the picture's size is not told in px", f"add image_{what} to the file")
        size.append(int(side))
    return foreign_table(data, _CARRIER, _lens(root, "", (size[0], size[1])))


def _lens(
    entry: dict[str, Any],
    place: str,
    image_size: tuple[int, int],
    nodal_offset_mm: float | None = None,
    pixel_aspect: float | None = None,
) -> Lens:
    """The lens of a camera matrix and its coefficients; the pixel aspect as known, else from the matrix."""
    matrix = _numbers(entry, _MATRIX_KEYS, place)
    if matrix.shape != (9,):
        raise BadDocument(_at(place, _MATRIX_KEYS[0]), f"has {matrix.size} numbers, not 3 x 3", _ADVICE)
    fx, skew, cx, zero_1, fy, cy, *last = matrix
    if not fx > 0 or not fy > 0 or skew or zero_1 or last != [0, 0, 1]:
        raise BadDocument(_at(place, _MATRIX_KEYS[0]), "is not [fx 0 cx, 0 fy cy, 0 0 1]", _ADVICE)
    coefficients = _numbers(entry, _COEFFICIENT_KEYS, place)
    if not 2 <= coefficients.size <= _MOST_COEFFICIENTS:
        raise BadDocument(_at(place, _COEFFICIENT_KEYS[0]), f"has {coefficients.size} numbers, not 5", _ADVICE)
    if extra := [f"{value:g}" for value in coefficients[2:] if value]:
        raise BadDocument(
            _at(place, _COEFFICIENT_KEYS[0]),
            f"p1, p2, k3 and higher terms must be 0 and are not ({', '.join(extra)})",
            "calibrate again with k1 and k2 only (in OpenCV: CALIB_ZERO_TANGENT_DIST and CALIB_FIX_K3)",
        )
    width, height = image_size
    shift = (float(cx) - (width - 1) / 2, float(cy) - (height - 1) / 2)
    aspect = float(fy / fx)
    if pixel_aspect is not None:
        if not math.isclose(aspect, pixel_aspect, rel_tol=1e-9):
            raise BadDocument(
                _at(place, _MATRIX_KEYS[0]), f"fy / fx = {aspect:g}, the table has {pixel_aspect:g}", _ADVICE
            )
        aspect = pixel_aspect
    k1, k2 = (float(value) for value in coefficients[:2])
    return lens_of_file(place, image_size, float(fx), k1, k2, shift, aspect, nodal_offset_mm)


def _numbers(entry: dict[str, Any], names: tuple[str, ...], place: str) -> FloatArray:
    """The first of the keys that is there, as a flat array of finite numbers."""
    name = next((name for name in names if name in entry), None)
    if name is None:
        raise BadDocument(_at(place, names[0]), "is not there", _ADVICE)
    found = entry[name]
    if isinstance(found, dict):  # a plain map instead of a tagged matrix, as ROS has it
        found = found.get("data")
    try:
        numbers = np.asarray(found, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise BadDocument(_at(place, name), "is no list of numbers", _ADVICE) from error
    if not np.isfinite(numbers).all():
        raise BadDocument(_at(place, name), "holds what is no finite number", _ADVICE)
    return numbers


def _at(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _value(node: cv2.FileNode, depth: int) -> Any:
    """A node with everything under it."""
    if depth > 6:
        raise BadDocument("", "is nested too deeply", _ADVICE)
    if node.isString():
        return node.string()
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return node.real()
    if node.isMap():
        names = list(node.keys())
        if len(set(names)) != len(names):
            raise BadDocument(next(name for name in names if names.count(name) > 1), "stands there twice", _ADVICE)
        return {name: _value(node.getNode(name), depth + 1) for name in names}
    if node.isSeq():
        return [_value(node.at(index), depth + 1) for index in range(node.size())]
    return None


OPENCV_YAML = Export(
    name="opencv",
    title="OpenCV YAML",
    suffix=".yaml",
    media_type="application/yaml",
    write=write_opencv_yaml,
    read=read_opencv_yaml,
    cannot_carry=(EVIDENCE_LOST,),
)
