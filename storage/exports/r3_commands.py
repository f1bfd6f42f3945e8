"""Command lines for R3, the render engine: one MultiExport a level, in a text file.

Each level has a line that begins with ``scene``, as the engine's text socket takes it, with the scene and export
names of a studio profile's defaults and the values in the product's own conventions (degrees, px, mm, k1 and k2 in
focal-length units). For an engine of other names or conventions, publish the table with its studio profile instead.
A level with ``engine_values`` sets those: they are what makes this engine show the lens.

Lines that begin with ``#`` tell which level follows. They are for people and for our reader, R3 knows no comments: who
sends the file leaves them out (:func:`command_lines` does). All levels set the same exports, so one line is sent, that
of the level where the lens stands.
"""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass, replace
from decimal import Decimal

from calibration.errors import CalibrationError
from calibration.lens import Lens, fov_to_f_px
from calibration.tables import EngineValues, LensTable, LevelResult
from storage.errors import BadDocument, CannotExport
from storage.exports.base import (
    EVIDENCE_LOST,
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
    read_note,
)
from storage.schemas import Angle, Number

SCENE = "Lensmatch/Calibration"
EXPORT_NAMES = (
    "lens.center_shift_x",
    "lens.center_shift_y",
    "lens.fov_x",
    "lens.k1",
    "lens.k2",
    "lens.nodal_offset",
)
"""Scene and exports of a studio profile's defaults."""

_CARRIER = "R3 command"
_HEAD, _LEVEL = "# lensmatch table ", "# lensmatch level "
_ADVICE = "export the table again"
_LINE = re.compile(r'scene "([^"]*)" export ((?:"[^"]*" SetValue "[^"]*" ?)+)')
_PAIR = re.compile(r'"([^"]*)" SetValue "([^"]*)"')
_NUMBER = re.compile(r"-?\d+\.\d+")


class _Mark(Mark):
    """With the lens itself where the command tells the engine something else."""

    fov_x_deg: Angle | None = None
    k1: Number = 0.0
    k2: Number = 0.0
    center_shift_px: tuple[Number, Number] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class CommandLine:
    """The line that sets a level's lens in the engine."""

    zoom: float
    focus: float
    line: str


def quoted(text: str) -> str:
    """``text`` between double quotes. What could end the quotes or the line is refused, never escaped: how the engine
    would read an escape is not known. Raises :class:`CannotExport`."""
    if not text or any(
        character in '"\\\u02ba\u030e\u201c\u201d\u201e\u201f\u2033\u2036\u275d\u275e\u301d\u301e\u301f\uff02'
        or unicodedata.category(character) in {"Cc", "Cf", "Cs", "Zl", "Zp"}
        for character in text
    ):
        raise CannotExport(f"{text[:60]!r} cannot stand in a command: no quotes, backslashes, control characters")
    return f'"{text}"'


def number_text(value: float) -> str:
    """A finite number as plain decimal digits that read back to the same double: no exponent, no locale."""
    if not math.isfinite(value):
        raise CannotExport(f"{value} cannot stand in a command: must be a finite number")
    text = format(Decimal(repr(float(value) + 0.0)), "f")
    return text if "." in text else f"{text}.0"


def write_r3_commands(table: LensTable) -> bytes:
    """A command line for each level that has a lens."""
    lines = [f"{_HEAD}{note_text(head_of(table))}"]
    for level in lens_levels(table):
        mark = mark_of(level)
        lens = level.lens(table.image_size, table.pixel_aspect)
        if level.engine_values is not None:
            mark |= {"fov_x_deg": lens.fov_x_deg, "k1": lens.k1, "k2": lens.k2}
            mark["center_shift_px"] = list(lens.center_shift_px)
        lines.append(f"{_LEVEL}{note_text(mark)}")
        lines.append(_command(level.engine_values or EngineValues.of(lens)))
    return ("\n".join(lines) + "\n").encode("ascii")


def _command(values: EngineValues) -> str:
    numbers = (*values.center_shift_px, values.fov_x_deg, values.k1, values.k2, values.nodal_offset_mm)
    pairs = (
        f"{quoted(name)} SetValue {quoted(number_text(number))}"
        for name, number in zip(EXPORT_NAMES, numbers, strict=True)
    )
    return f"scene {quoted(SCENE)} export {' '.join(pairs)}"


def command_lines(data: bytes) -> tuple[CommandLine, ...]:
    """The lines to send, each with its level. Raises :class:`BadDocument`."""
    _, found = _parse(data)
    return tuple(CommandLine(mark.zoom, mark.focus, line) for mark, line, _ in found)


def read_r3_commands(data: bytes) -> LensTable:
    """The table of our own file. Raises :class:`BadDocument`."""
    head, found = _parse(data)
    levels = [_level(head, mark, values, number) for number, (mark, _, values) in enumerate(found)]
    return noted_table(data, _CARRIER, head, levels)


def _parse(data: bytes) -> tuple[Head, list[tuple[_Mark, str, EngineValues]]]:
    head: Head | None = None
    mark: _Mark | None = None
    found = []
    for number, line in enumerate(decode_text(data).splitlines(), start=1):
        place = f"line {number}"
        if line.startswith(_HEAD) and head is None:
            head = read_note(Head, line.removeprefix(_HEAD), place)
        elif line.startswith(_LEVEL) and head is not None and mark is None:
            mark = read_note(_Mark, line.removeprefix(_LEVEL), place)
        elif line.startswith("scene") and mark is not None:
            found.append((mark, line, _values(line, place)))
            mark = None
        elif line.strip():
            raise BadDocument(place, "is not what stands here in a file of R3 commands", "is this one of Lensmatch's?")
    if head is None or mark is not None or not found:
        raise BadDocument("", "is not whole", "is this a file of R3 commands that Lensmatch wrote?")
    return head, found


def _values(line: str, place: str) -> EngineValues:
    """What a command line tells the engine."""
    parts = _LINE.fullmatch(line)
    pairs = _PAIR.findall(parts[2]) if parts else []
    if parts is None or parts[1] != SCENE or tuple(name for name, _ in pairs) != EXPORT_NAMES:
        raise BadDocument(place, f"does not set {', '.join(EXPORT_NAMES)} of {SCENE}, in this order", _ADVICE)
    for name, text in pairs:
        if not _NUMBER.fullmatch(text):
            raise BadDocument(f"{place}, {name}", f"{text[:40]!r} is no plain number", _ADVICE)
    shift_x, shift_y, fov_x_deg, k1, k2, nodal = (float(text) for _, text in pairs)
    try:
        return EngineValues(fov_x_deg, k1, k2, (shift_x, shift_y), nodal)
    except CalibrationError as error:
        raise BadDocument(place, str(error), _ADVICE) from error


def _level(head: Head, mark: _Mark, values: EngineValues, number: int) -> LevelResult:
    lens = _lens(head, mark, values, f"level {number}")
    level = noted_level(mark, lens, _CARRIER)
    return level if mark.fov_x_deg is None else replace(level, engine_values=values)


def _lens(head: Head, mark: _Mark, values: EngineValues, place: str) -> Lens:
    """The lens of a level: beside the command where that tells the engine something else, else the command's."""
    told = values if mark.fov_x_deg is None else mark
    try:
        f_px = fov_to_f_px(told.fov_x_deg or 0.0, head.image_size[0])
    except CalibrationError as error:
        raise BadDocument(place, str(error), _ADVICE) from error
    return lens_of_file(
        place, head.image_size, f_px, told.k1, told.k2, told.center_shift_px, head.pixel_aspect, mark.nodal_offset_mm
    )


R3_COMMANDS = Export(
    name="r3",
    title="R3 command lines",
    suffix=".txt",
    media_type="text/plain",
    write=write_r3_commands,
    read=read_r3_commands,
    cannot_carry=(
        EVIDENCE_LOST.replace(", engine values", ""),
        "zoom and focus, but for lines with # that are not sent: R3 knows no comments",
    ),
)
