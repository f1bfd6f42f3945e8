"""lensfun's XML: distortion model ``poly5``, one entry a focal length.

``r_d = r_u (1 + k1' r_u^2 + k2' r_u^4)`` with radius 1 at half of the picture's short side, h px: with the focal
length f px, k1' = k1 (h / f)^2 and k2' = k2 (h / f)^4. Lengths are in mm, so the table must know its sensor's width;
its height is what square pixels make of it. ``focal`` is the focal length F = f sensor width / W, crop factor the
diagonal of 24 x 36 mm over the sensor's. (``real-focal`` is left out: with poly5 it is the focal length anyway, and
lensfun 0.3.4 refuses a file that has it.) lensfun 0.3.4 measures a picture's diagonal between its outer pixel
centres, later versions between its edges: these coefficients are for the edges.

lensfun has no place for the centre shift, focus, encoder values, and pixels that are not square. Comments, which
lensfun skips, hold them as JSON, so that our own reader gets them back. Files without these comments are refused: they
tell neither zoom nor focus nor the picture's size.
"""

from __future__ import annotations

import math
from typing import Any
from xml.etree.ElementTree import Comment, Element, ParseError, TreeBuilder
from xml.sax.saxutils import escape

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from calibration.tables import LensTable, LevelResult
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
    one_focus,
    read_note,
)
from storage.schemas import Number

_CARRIER = "lensfun"
_ADVICE = "only files that Lensmatch wrote tell all that a lens table needs"
_HEAD, _LEVEL = "lensmatch table ", "lensmatch level "
_FULL_FRAME_MM = math.hypot(36, 24)
_MOUNT = "Lensmatch"
_MODEL = "poly5"


class _Mark(Mark):
    center_shift_px: tuple[Number, Number] | None = None


def write_lensfun(table: LensTable) -> bytes:
    """The levels that have a lens, all of one focus, by focal length. Raises :class:`CannotExport`."""
    levels = sorted(lens_levels(table), key=lambda level: -(level.fov_x_deg or 0))
    one_focus(tuple(levels), "lensfun")
    if table.sensor_mm is None:
        raise CannotExport("lensfun counts in mm and this table does not know its sensor; add sensor_mm to it")
    if table.pixel_aspect != 1:
        raise CannotExport(f"lensfun knows square pixels only and this table has {table.pixel_aspect:g}")
    width, height = table.image_size
    sensor_mm = (table.sensor_mm[0], table.sensor_mm[0] * height / width)
    crop = _FULL_FRAME_MM / math.hypot(*sensor_mm)
    aspect = max(width, height) / min(width, height)
    entries, focals = [], set()
    for level in levels:
        lens = level.lens(table.image_size)
        unit = min(width, height) / 2 / lens.f_px
        focal_mm = lens.f_px * sensor_mm[0] / width
        if focal_mm in focals:
            raise CannotExport(f"two levels have the focal length {focal_mm:g} mm, by which lensfun tells them apart")
        focals.add(focal_mm)
        mark = mark_of(level)
        if level.center_shift_px is not None:
            mark["center_shift_px"] = list(level.center_shift_px)
        k1, k2 = lens.k1 * unit**2, lens.k2 * unit**4
        entries.append(f"            <!-- {_LEVEL}{note_text(mark)} -->")
        entries.append(f'            <distortion model="{_MODEL}" focal="{focal_mm!r}" k1="{k1!r}" k2="{k2!r}"/>')
    lens_name, camera_name = escape(table.lens), escape(table.camera)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<lensdatabase version="1">',
        f"    <!-- {_HEAD}{note_text(head_of(table))} -->",
        f"    <mount><name>{_MOUNT}</name></mount>",
        "    <camera>",
        f"        <maker>Lensmatch</maker><model>{camera_name}</model><mount>{_MOUNT}</mount>",
        f"        <cropfactor>{crop!r}</cropfactor>",
        "    </camera>",
        "    <lens>",
        f"        <maker>Lensmatch</maker><model>{lens_name}</model><mount>{_MOUNT}</mount>",
        f"        <cropfactor>{crop!r}</cropfactor>",
        f"        <aspect-ratio>{aspect!r}</aspect-ratio>",
        "        <calibration>",
        *entries,
        "        </calibration>",
        "    </lens>",
        "</lensdatabase>",
    ]
    return ("\n".join(lines) + "\n").encode("utf-8")


def read_lensfun(data: bytes) -> LensTable:
    """The table of our own file. Raises :class:`BadDocument`."""
    root = _parse(data)
    heads = [note for child in root if (note := _note(child, _HEAD)) is not None]
    if len(heads) != 1:
        raise BadDocument("", f"has {len(heads)} comments of a lens table, not one", _ADVICE)
    head = read_note(Head, heads[0], "the table's comment")
    if head.sensor_mm is None:
        raise BadDocument("the table's comment", "does not tell the sensor", "export the table again")
    lenses = root.findall("lens")
    if len(lenses) != 1:
        raise BadDocument("lens", f"is there {len(lenses)} times, not once", "remove the others")
    calibrations = lenses[0].findall("calibration")
    if len(calibrations) != 1:
        raise BadDocument("calibration", f"is there {len(calibrations)} times, not once", "remove the others")
    levels: list[LevelResult] = []
    mark: _Mark | None = None
    for child in calibrations[0]:
        place = f"level {len(levels)}"
        if (note := _note(child, _LEVEL)) is not None:
            if mark is not None:
                raise BadDocument(place, "has two comments", "export the table again")
            mark = read_note(_Mark, note, f"the comment of {place}")
        elif child.tag == "distortion":
            if mark is None:
                raise BadDocument(place, "has no comment with its zoom and focus", _ADVICE)
            levels.append(_level(child, mark, head, head.sensor_mm[0], place))
            mark = None
    return noted_table(data, _CARRIER, head, levels)


def _parse(data: bytes) -> Element:
    """The file's tree, comments in it. No DTD, no entities: nothing is fetched, nothing multiplies."""
    text = decode_text(data)
    parser = DefusedXMLParser(target=TreeBuilder(insert_comments=True), forbid_dtd=True)
    try:
        parser.feed(text)
        root: Element = parser.close()
    except DefusedXmlException as error:
        raise BadDocument("", "holds a DTD or entities, which are not read", "remove them") from error
    except ParseError as error:
        raise BadDocument("", f"is not XML ({error})", "is this a lensfun file?") from error
    if root.tag != "lensdatabase" or root.get("version") not in (None, "1"):
        raise BadDocument("", f"is <{str(root.tag)[:30]}>, not <lensdatabase> of version 1", "is this a lensfun file?")
    return root


def _note(element: Element, kind: str) -> str | None:
    """The JSON of a comment of this kind, None for anything else."""
    tag: object = element.tag  # a comment has the function that makes comments as its tag
    text = (element.text or "").strip() if tag is Comment else ""
    return text.removeprefix(kind) if text.startswith(kind) else None


def _level(entry: Element, mark: _Mark, head: Head, sensor_width_mm: float, place: str) -> LevelResult:
    numbers: dict[str, float] = {}
    if entry.get("model") != _MODEL:
        raise BadDocument(place, f"has the model {str(entry.get('model'))[:20]}, not {_MODEL}", _ADVICE)
    for name in ("focal", "k1", "k2"):
        try:
            numbers[name] = float(entry.get(name, "0"))
        except ValueError as error:
            raise BadDocument(f"{place}, {name}", "is no number", _ADVICE) from error
    width, height = head.image_size
    f_px = numbers["focal"] * width / sensor_width_mm
    if not 0 < f_px < math.inf:
        raise BadDocument(f"{place}, focal", "must be a positive number of mm", _ADVICE)
    unit = min(width, height) / 2 / f_px
    told: dict[str, Any] = {"nodal_offset_mm": mark.nodal_offset_mm}
    if mark.center_shift_px is not None:
        told["center_shift_px"] = mark.center_shift_px
    lens = lens_of_file(place, head.image_size, f_px, numbers["k1"] / unit**2, numbers["k2"] / unit**4, **told)
    return noted_level(mark, lens, _CARRIER)


LENSFUN = Export(
    name="lensfun",
    title="lensfun XML",
    suffix=".xml",
    media_type="application/xml",
    write=write_lensfun,
    read=read_lensfun,
    cannot_carry=(
        EVIDENCE_LOST,
        "centre shift, zoom, focus and nodal offset, but for comments that lensfun skips",
        "levels of several focuses (one focus a file), pixels that are not square",
    ),
)
