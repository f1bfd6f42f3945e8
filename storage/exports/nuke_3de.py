"""Nuke script with one 3DEqualizer node ``LD_3DE4_Radial_Standard_Degree_4`` per level (classic "Degree 4" lens).

Units and signs of the node: centimetres, y up, radius 1 at half the filmback's diagonal R, centre = filmback's centre
plus lens centre offset, distorted to undistorted:

    x_u = x (1 + c2 r^2 + c4 r^4),   c2 = ``Distortion_Degree_2``, c4 = ``Quartic_Distortion_Degree_4``

so c2, c4 are refitted over the picture. Two terms cannot be exact (1.5 px at the corner of a lens that pulls it in by
11 %): each node's label states what is left, and the comment line before it carries k1 and k2 themselves, which is how
this program reads its own file back exactly, once it has found that the node still holds their refit. Nuke drops
comments when it saves; a node without one is read by refit, with what that leaves said.

Focal length and filmback width come from the sensor's stated width; the filmback's height is the one its pixels have.
Offsets: x = sx w/W, y = -sy h/H. ``custom_focus_distance`` has no part in this model and is left at its default.

One node a level rather than curves in one node: a curve's parameter is the frame, and which frame has which zoom only
the shot knows. Nodes stand unconnected (``inputs 0``), to be copied one by one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from calibration.compare import Overlay
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.refit import InverseRadial, fit_inverse, inverse_overlay
from calibration.tables import LensTable, LevelResult
from storage.errors import BadDocument, CannotExport
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
    read_level,
    read_note,
    read_table,
)
from storage.exports.millimetres import (
    check_count,
    degraded_by,
    exact_sensor_mm,
    pixel_aspect_of,
    refit_advice,
    refit_note,
    refitted_lens,
    unfolded_lens,
)
from storage.schemas import Number

_CARRIER = "3DEqualizer/Nuke"
_AGAIN = "correct it, or export it again"
_NODE = "LD_3DE4_Radial_Standard_Degree_4"
_TABLE_NOTE, _LEVEL_NOTE = "# lensmatch table ", "# lensmatch level "
_MM_PER_CM = 10.0
_FOREIGN_WIDTH_PX = 1920
# A plain node tells no picture size; the lens is the same at any, and its errors are in px of this one.
_SAME_REFIT = 1e-6
# Two computers' least squares differ in the last digits, a hand's change in the first.
_MOST_DEPTH = 64

_FILMBACK = ("tde4_filmback_width_cm", "tde4_filmback_height_cm")
_FOCAL = "tde4_focal_length_cm"
_OFFSET = ("tde4_lens_center_offset_x_cm", "tde4_lens_center_offset_y_cm")
_TERMS = ("Distortion_Degree_2", "Quartic_Distortion_Degree_4")
_ASPECT = "tde4_pixel_aspect"
_FIXED: Mapping[str, float] = {
    "U_Degree_2": 0,
    "V_Degree_2": 0,
    "U_Degree_4": 0,
    "V_Degree_4": 0,
    "Phi_Cylindric_Direction": 0,
    "B_Cylindric_Bending": 0,
    "field_of_view_xa_unit": 0,
    "field_of_view_xb_unit": 1,
    "field_of_view_ya_unit": 0,
    "field_of_view_yb_unit": 1,
}
# Knobs that must have this value; Nuke leaves out knobs that stand at their default.
_PHI = "Phi_Cylindric_Direction"  # without bending its direction has no effect

_KNOB = re.compile(r"([A-Za-z_][\w.]*)(?:\s+(.*))?")
_OPEN = re.compile(r"([A-Za-z_]\w*)\s*\{\s*(\})?")
_FORMAT = re.compile(r'"?(\d{1,6}) (\d{1,6}) ')


class _LevelNote(Mark):
    """A level's note in its comment line."""

    k1: Number
    k2: Number


@dataclass(frozen=True)
class _Node:
    """A node as it stands in the file. ``note``: the comment before it that is ours, with its line."""

    kind: str
    line: int
    knobs: dict[str, str]
    note: tuple[int, str] | None

    @property
    def place(self) -> str:
        return f"line {self.line}, node {self.knobs.get('name', self.kind)[:40]}"

    def number(self, knob: str, default: float | None = None) -> float:
        """A knob's value. Raises :class:`BadDocument`, also for an animated one."""
        text = self.knobs.get(knob)
        if text is None:
            if default is None:
                raise BadDocument(self.place, f"has no {knob}", "write it into the node")
            return default
        if "curve" in text:
            raise BadDocument(self.place, f"{knob} is animated", "bake the frame that is meant into plain numbers")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise BadDocument(self.place, f"{knob} is {text[:40]!r}, no number", _AGAIN)
        return value


def write_nuke(table: LensTable) -> bytes:
    """The table as a Nuke script. Raises :class:`CannotExport`."""
    levels = lens_levels(table)
    sensor_mm = exact_sensor_mm(table, _CARRIER)
    lines = [_TABLE_NOTE + note_text(head_of(table))]
    for number, level in enumerate(levels, start=1):
        lens = unfolded_lens(table, level)
        inverse, left = _refit(lens, level)
        refit = {"rms": left.rms_px, "max": left.max_px}
        lines.append(_LEVEL_NOTE + note_text({**mark_of(level), "k1": lens.k1, "k2": lens.k2, "refit_px": refit}))
        label = f"zoom {level.zoom:g}, focus {level.focus:g}: off by rms {left.rms_px:.2g}, max {left.max_px:.2g} px"
        lines.append(f"{_NODE} {{")
        lines.append(" inputs 0")
        lines += [f" {name} {value!r}" for name, value in _knobs(table, lens, inverse, sensor_mm).items()]
        lines += [" direction undistort", f" name lens{number}", f' label "{label}"', "}"]
    return ("\n".join(lines) + "\n").encode("utf-8")


def read_nuke(data: bytes) -> LensTable:
    """The table of a script of this program, or of a script with one node of the kind. Raises :class:`BadDocument`."""
    nodes, note = _parse(decode_text(data))
    ours = [node for node in nodes if node.kind == _NODE]
    if not ours:
        raise BadDocument("", f"has no {_NODE} node", "is this a Nuke script with 3DEqualizer lens nodes?")
    check_count(len(ours))
    if note is None:
        return _foreign(data, ours, nodes)
    head = read_note(Head, note[1], f"line {note[0]}")
    return noted_table(data, _CARRIER, head, [_own_level(node, head) for node in ours])


def advice(table: LensTable) -> str:
    """How exact the refits are. Raises :class:`CannotExport`."""
    return refit_advice((level, _refit(unfolded_lens(table, level), level)[1]) for level in lens_levels(table))


def _refit(lens: Lens, level: LevelResult) -> tuple[InverseRadial, Overlay]:
    try:
        inverse = fit_inverse(lens, len(_TERMS))
    except CalibrationError as error:
        raise CannotExport(f"zoom {level.zoom:g}, focus {level.focus:g}: {error}") from error
    return inverse, inverse_overlay(lens, inverse)


def _knobs(table: LensTable, lens: Lens, inverse: InverseRadial, sensor_mm: tuple[float, float]) -> dict[str, float]:
    width, height = table.image_size
    focal_cm = lens.f_px * sensor_mm[0] / width / _MM_PER_CM
    filmback_cm = sensor_mm[0] / _MM_PER_CM, sensor_mm[1] / _MM_PER_CM
    sx, sy = lens.center_shift_px
    c2, c4 = inverse.in_unit(_half_diagonal(filmback_cm) / focal_cm).numerator
    plain = {name: float(value) for name, value in _FIXED.items()}
    return {
        _FOCAL: focal_cm,
        _FILMBACK[0]: filmback_cm[0],
        _FILMBACK[1]: filmback_cm[1],
        _OFFSET[0]: sx * filmback_cm[0] / width,
        _OFFSET[1]: -sy * filmback_cm[1] / height,
        _ASPECT: lens.pixel_aspect,
        _TERMS[0]: c2,
        _TERMS[1]: c4,
        **plain,
    }


def _half_diagonal(filmback_cm: tuple[float, float]) -> float:
    return math.hypot(*filmback_cm) / 2


def _own_level(node: _Node, head: Head) -> LevelResult:
    """A level of a file of this program: k1 and k2 from its comment, if the node holds their refit."""
    if node.note is None:
        raise BadDocument(node.place, "has no comment of its level before it", "remove all comments to read by refit")
    line, text = node.note
    note = read_note(_LevelNote, text, f"line {line}")
    frame, inverse = _frame(node, head.image_size, head.pixel_aspect)
    try:
        lens = replace(frame, k1=note.k1, k2=note.k2, nodal_offset_mm=note.nodal_offset_mm or 0.0)
        wanted = fit_inverse(lens, len(_TERMS))
    except CalibrationError as error:
        raise BadDocument(f"line {line}", str(error), _AGAIN) from error
    corner = lens.corner_radius()
    for n, (found, term) in enumerate(zip(inverse.numerator, wanted.numerator, strict=True), start=1):
        if abs(found - term) * corner ** (2 * n) > _SAME_REFIT:
            why = f"{_TERMS[n - 1]} is not the refit of k1, k2 in the comment before it"
            raise BadDocument(node.place, why, "remove all comments to read the nodes as they are")
    return noted_level(note, lens, _CARRIER)


def _foreign(data: bytes, ours: list[_Node], nodes: list[_Node]) -> LensTable:
    """The table of a plain node: one level, its picture as wide as the script says, else 1920 px."""
    if len(ours) > 1:
        raise BadDocument(
            ours[1].place, "is the second node, and no comment tells zoom and focus", "leave one node in the file"
        )
    (node,) = ours
    filmback_cm = _filmback(node)
    image_size = _script_size(nodes)
    assumed = image_size is None
    if image_size is None:
        aspect = node.number(_ASPECT, 1.0)
        rows = _FOREIGN_WIDTH_PX * filmback_cm[1] / filmback_cm[0] * aspect
        image_size = (_FOREIGN_WIDTH_PX, round(rows) if 2 <= rows <= 1e5 else 0)
    sensor_mm = filmback_cm[0] * _MM_PER_CM, filmback_cm[1] * _MM_PER_CM
    frame, inverse = _frame(node, image_size, pixel_aspect_of(image_size, sensor_mm) if min(image_size) else 1.0)
    lens, left = refitted_lens(frame, inverse, node.place)
    level = read_level(0.0, 0.0, lens, _CARRIER, missing=("nodal_offset_mm",), degraded=degraded_by(left))
    note = refit_note([left])
    if assumed:
        note = f"{note}; the file tells no picture size, {image_size[0]} x {image_size[1]} was taken"
    return read_table(
        data,
        _CARRIER,
        [level],
        lens="unknown",
        camera="unknown",
        created=UNKNOWN_TIME,
        image_size=image_size,
        sensor_mm=sensor_mm,
        pixel_aspect=lens.pixel_aspect,
        note=note,
    )


def _script_size(nodes: list[_Node]) -> tuple[int, int] | None:
    """The picture's size as the script's Root says it, None without one."""
    roots = [node for node in nodes if node.kind == "Root" and "format" in node.knobs]
    found = _FORMAT.match(roots[0].knobs["format"]) if roots else None
    return None if found is None else (int(found[1]), int(found[2]))


def _filmback(node: _Node) -> tuple[float, float]:
    width_cm, height_cm = (node.number(name) for name in _FILMBACK)
    for name, value in zip(_FILMBACK, (width_cm, height_cm), strict=True):
        if not 1e-3 <= value <= 1e3:
            raise BadDocument(node.place, f"{name} is {value:g}", "must be a length in centimetres")
    return width_cm, height_cm


def _frame(node: _Node, image_size: tuple[int, int], pixel_aspect: float) -> tuple[Lens, InverseRadial]:
    """The node's lens without distortion, and its map."""
    for name, wanted in _FIXED.items():
        if name != _PHI and node.number(name, wanted) != wanted:
            why = f"{name} is not {wanted}: tangential terms, bending and a part of the picture"
            raise BadDocument(node.place, why, "are not in this lens model")
    filmback_cm, focal_cm = _filmback(node), node.number(_FOCAL)
    if not 1e-3 <= focal_cm <= 1e4:
        raise BadDocument(node.place, f"{_FOCAL} is {focal_cm:g}", "must be a length in centimetres")
    width, height = image_size
    offset_cm = [node.number(name, 0.0) for name in _OFFSET]
    shift_px = offset_cm[0] * width / filmback_cm[0], -offset_cm[1] * height / filmback_cm[1]
    lens = lens_of_file(node.place, image_size, focal_cm * width / filmback_cm[0], 0.0, 0.0, shift_px, pixel_aspect)
    terms = [node.number(name, 0.0) for name in _TERMS]
    try:
        return lens, InverseRadial.from_unit(terms, (), _half_diagonal(filmback_cm) / focal_cm)
    except CalibrationError as error:
        raise BadDocument(node.place, str(error), _AGAIN) from error


def _parse(text: str) -> tuple[list[_Node], tuple[int, str] | None]:
    """The nodes of a script, and the note of the table with its line. Commands outside of nodes are skipped."""
    nodes: list[_Node] = []
    table_note: tuple[int, str] | None = None
    level_note: tuple[int, str] | None = None
    lines = iter(enumerate(text.splitlines(), start=1))
    for number, line in lines:
        stripped = line.strip()
        if line.startswith(_TABLE_NOTE):
            if table_note is not None:
                raise BadDocument(f"line {number}", "is the second note of a table", "put each table into its own file")
            table_note = number, line.removeprefix(_TABLE_NOTE)
        elif line.startswith(_LEVEL_NOTE):
            if level_note is not None:
                raise BadDocument(f"line {number}", "is a note of a level without its node", _AGAIN)
            level_note = number, line.removeprefix(_LEVEL_NOTE)
        elif not stripped.startswith("#") and (found := _OPEN.fullmatch(stripped)):
            knobs = {} if found[2] else _read_knobs(lines, number)
            nodes.append(_Node(found[1], number, knobs, level_note))
            level_note = None
    if level_note is not None:
        raise BadDocument(f"line {level_note[0]}", "is a note of a level without its node", _AGAIN)
    return nodes, table_note


def _read_knobs(lines: Iterator[tuple[int, str]], opened: int) -> dict[str, str]:
    """The knobs of a node up to its closing brace; a value in braces or quotes may go over several lines."""
    knobs: dict[str, str] = {}
    for number, line in lines:
        stripped = line.strip()
        if stripped == "}":
            return knobs
        found = _KNOB.fullmatch(stripped)
        if not found:
            if stripped.startswith("#") or not stripped:
                continue
            raise BadDocument(f"line {number}", "is no knob of a node", "is this a Nuke script?")
        name, value = found[1], found[2] or ""
        while not _is_whole(value, number):
            number, line = next(lines, (opened, ""))
            if number == opened:
                raise BadDocument(f"line {opened}", "opens a node that has no end: the file is cut off", _AGAIN)
            value += f"\n{line}"
        if name in knobs and name != "addUserKnob":
            raise BadDocument(f"line {number}", f"gives {name[:40]} a second time", "remove one of them")
        knobs[name] = value.strip().strip('"')
    raise BadDocument(f"line {opened}", "opens a node that has no end: the file is cut off", _AGAIN)


def _is_whole(value: str, number: int) -> bool:
    """Whether braces and quotes of a knob's value are closed."""
    depth, quoted, escaped = 0, False, False
    for character in value:
        if escaped:
            escaped = False
        elif character == "\\":
            escaped = True
        elif character == '"' and depth == 0:
            quoted = not quoted
        elif not quoted:
            depth += (character == "{") - (character == "}")
            if depth > _MOST_DEPTH:
                raise BadDocument(f"line {number}", "is nested too deeply", "is this a Nuke script?")
    return depth <= 0 and not quoted


NUKE_3DE = Export(
    name="nuke-3de",
    title="Nuke script with 3DEqualizer lens nodes (Radial - Standard, Degree 4)",
    suffix=".nk",
    media_type="text/plain",
    write=write_nuke,
    read=read_nuke,
    cannot_carry=(
        EVIDENCE_LOST,
        "k1 and k2 themselves, zoom, focus and nodal offset, but for comments that Nuke drops when it saves",
    ),
    advice=advice,
)
