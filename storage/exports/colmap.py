"""COLMAP's ``cameras.txt``: one camera a level.

COLMAP puts the centre of the top left pixel at (0.5, 0.5), so cx and cy are the product's plus half a pixel; the rest
is the same (radius in focal lengths, undistorted to distorted). Square pixels: ``RADIAL f cx cy k1 k2``; others:
``OPENCV fx fy cx cy k1 k2 p1 p2`` with p1 = p2 = 0. Camera ids count the levels from 1. A comment of COLMAP's
(``#``) before each camera holds its zoom, focus and nodal offset as JSON, one at the top what holds for the table.

Also read: the one camera of another program's file, as zoom 0, focus 0, in any model of which only k1 and k2 are
used.
"""

from __future__ import annotations

import math

from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult
from storage.errors import BadDocument
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
    note_text,
    noted_level,
    noted_table,
    read_note,
)

_CARRIER = "COLMAP"
_ADVICE = "is this the cameras.txt of COLMAP?"
_HEAD, _LEVEL = "# lensmatch table ", "# lensmatch level "
_HALF_PIXEL = 0.5

# Model: its parameters in their order. f: both focal lengths; what is none of these must be 0.
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}


def write_colmap(table: LensTable) -> bytes:
    """The levels that have a lens as cameras."""
    width, height = table.image_size
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        f"{_HEAD}{note_text(head_of(table))}",
    ]
    for number, level in enumerate(lens_levels(table), start=1):
        lens = level.lens(table.image_size, table.pixel_aspect)
        cx, cy = (value + _HALF_PIXEL for value in lens.principal_point_px)
        if lens.pixel_aspect == 1:
            model, params = "RADIAL", [lens.f_px, cx, cy, lens.k1, lens.k2]
        else:
            model = "OPENCV"
            params = [lens.f_px, lens.pixel_aspect * lens.f_px, cx, cy, lens.k1, lens.k2, 0.0, 0.0]
        lines.append(f"{_LEVEL}{note_text(mark_of(level))}")
        lines.append(f"{number} {model} {width} {height} {' '.join(repr(float(value)) for value in params)}")
    return ("\n".join(lines) + "\n").encode("ascii")


def read_colmap(data: bytes) -> LensTable:
    """The table of our own file, or of the only camera of another's. Raises :class:`BadDocument`."""
    head: Head | None = None
    mark: Mark | None = None
    levels: list[LevelResult] = []
    lenses: list[Lens] = []
    ids: set[str] = set()
    for number, line in enumerate(decode_text(data).splitlines(), start=1):
        place, text = f"line {number}", line.strip()
        if text.startswith(_HEAD):
            if head is not None or lenses:
                raise BadDocument(place, "tells the table a second time, or after its cameras", _ADVICE)
            head = read_note(Head, text.removeprefix(_HEAD), place)
        elif text.startswith(_LEVEL):
            if head is None or mark is not None:
                raise BadDocument(place, "stands before no camera, or under no table", _ADVICE)
            mark = read_note(Mark, text.removeprefix(_LEVEL), place)
        elif text and not text.startswith("#"):
            camera, lens = _camera(text, place, head, mark)
            if camera in ids:
                raise BadDocument(place, f"has camera {camera} a second time", "remove one of them")
            ids.add(camera)
            lenses.append(lens)
            if mark is not None:
                levels.append(noted_level(mark, lens, _CARRIER))
                mark = None
            elif head is not None:
                raise BadDocument(place, "has a camera without its zoom and focus", "export the table again")
    if not lenses:
        raise BadDocument("", "holds no camera", _ADVICE)
    if head is not None:
        return noted_table(data, _CARRIER, head, levels)
    if len(lenses) > 1:
        raise BadDocument(
            "", f"has {len(lenses)} cameras and tells no zoom and focus of them", "keep one camera in the file"
        )
    return foreign_table(data, _CARRIER, lenses[0])


def _camera(text: str, place: str, head: Head | None, mark: Mark | None) -> tuple[str, Lens]:
    """A camera's id and its lens."""
    words = text.split()
    if len(words) < 4 or words[1] not in _MODELS:
        model = f"camera model {words[1][:30]!r} is not read" if len(words) > 1 else "is no camera"
        raise BadDocument(place, model, f"have COLMAP use one of {', '.join(_MODELS)}")
    names = _MODELS[words[1]].split()
    try:
        width, height = int(words[2]), int(words[3])
        numbers = [float(word) for word in words[4:]]
    except ValueError as error:
        raise BadDocument(place, "holds a word that is no number", _ADVICE) from error
    if len(numbers) != len(names) or not all(math.isfinite(number) for number in numbers):
        raise BadDocument(place, f"{words[1]} needs {len(names)} finite numbers: {' '.join(names)}", _ADVICE)
    told = dict(zip(names, numbers, strict=True))
    extra = [name for name in ("p1", "p2", "k3", "k4", "k5", "k6") if told.get(name)]
    if extra:
        raise BadDocument(
            place, f"{', '.join(extra)} must be 0: a lens here has k1 and k2 only", "refine the camera as RADIAL"
        )
    f_px = told["f"] if "f" in told else told["fx"]
    aspect = told["fy"] / f_px if "fy" in told and f_px else 1.0
    if head is not None:
        if (width, height) != head.image_size or not math.isclose(aspect, head.pixel_aspect, rel_tol=1e-9):
            raise BadDocument(place, "has another picture size or pixel aspect than the table", "export it again")
        aspect = head.pixel_aspect
    shift = (told["cx"] - _HALF_PIXEL - (width - 1) / 2, told["cy"] - _HALF_PIXEL - (height - 1) / 2)
    nodal = mark.nodal_offset_mm if mark else None
    lens = lens_of_file(place, (width, height), f_px, told.get("k1", 0.0), told.get("k2", 0.0), shift, aspect, nodal)
    return words[0], lens


COLMAP = Export(
    name="colmap",
    title="COLMAP cameras.txt",
    suffix=".txt",
    media_type="text/plain",
    write=write_colmap,
    read=read_colmap,
    cannot_carry=(EVIDENCE_LOST, ONLY_IN_A_NOTE),
)
