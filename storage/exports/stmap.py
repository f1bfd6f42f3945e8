"""ST maps (UV maps) for compositing: for each level two 32-bit float OpenEXR pictures in one ZIP.

A map is a lookup: R = s, G = t tell, for each pixel of the picture that comes OUT, the place in the picture that goes
IN, from 0 to 1 over that picture, s to the right, t UPWARDS from its lower edge, pixel centres at half pixels:
``s = (x + 0.5) / W``, ``t = 1 - (y + 0.5) / H`` for the pixel (x, y) of the product's conventions. B is 0.

``..._undistort_plate-to-flat.exr``: the camera's picture (plate) goes in, a picture without distortion (flat) comes
out. ``..._distort_flat-to-plate.exr``: the other way, by the exact inverse of the lens. The flat picture has the lens's
focal length and centre; with an overscan it is larger by the same margin left and right, above and below. Values
outside 0..1 are kept: they point beside the picture. Where no ray lands, s = t = -1.

The header attribute ``lensmatch`` holds the lens, the table and the margins as JSON. The reader takes the lens from
it and refuses the file where the pixels differ from that lens by more than 0.01 px. A map of another program has no
such attribute: see :mod:`storage.exports.foreign_map`.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from calibration.errors import CalibrationError
from calibration.lens import Lens, fov_to_f_px
from calibration.tables import LensTable, LevelResult
from calibration.types import FloatArray
from storage.errors import BadDocument, CannotExport
from storage.exports.base import (
    EVIDENCE_LOST,
    Export,
    Head,
    Mark,
    Note,
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
from storage.exports.foreign_map import fit_map
from storage.exports.map_picture import MAX_MAP_PX, NOTE, MapPicture, decode_map, encode_map, map_size
from storage.schemas import Angle, Number

MAX_PX = 80_000_000
"""In all maps of a file: 18 levels of 1080p, 4 of 4K, one of 8K."""
MAX_FILE_BYTES = 768 * 1024 * 1024
MAX_OVERSCAN = 2.0
AGREE_PX = 0.01

_CARRIER = "ST map"
_NOWHERE = np.float32(-1)
_BLOCK_ROWS = 64
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
_MOST_FILES = 2000
_AGAIN = "the file is damaged or was changed; export it again"
_WAYS = {"undistort": "plate-to-flat", "distort": "flat-to-plate"}


class _Mark(Mark):
    fov_x_deg: Angle
    k1: Number
    k2: Number
    center_shift_px: tuple[Number, Number]


_Margin = Annotated[int, Field(strict=True, ge=0, le=100_000)]


class _Note(Note):
    map: Literal["undistort", "distort"]
    margin_px: tuple[_Margin, _Margin]
    table: Head
    level: _Mark


def write_stmap(table: LensTable, overscan: float = 1.0) -> bytes:
    """Both maps of each level that has a lens, in a ZIP. ``overscan``: size of the flat picture over the plate's.

    Raises :class:`CannotExport` for a lens that folds inside the picture, and for more pixels than are read.
    """
    if not 1 <= overscan <= MAX_OVERSCAN:
        raise CannotExport(f"overscan {overscan:g} must lie between 1 and {MAX_OVERSCAN:g}")
    levels = lens_levels(table)
    width, height = table.image_size
    margin = tuple(math.ceil(side * (overscan - 1) / 2 - 1e-9) for side in table.image_size)
    flat_px = (width + 2 * margin[0]) * (height + 2 * margin[1])
    if flat_px > MAX_MAP_PX or len(levels) * (width * height + flat_px) > MAX_PX:
        most = MAX_PX // (width * height + flat_px) if flat_px <= MAX_MAP_PX else 0
        raise CannotExport(
            f"{len(levels)} levels of {width} x {height} px are too much for one file of ST maps, which takes {most}; "
            "export one of them (--zoom and --focus)"
        )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for level in levels:
            for kind, way in _WAYS.items():
                info = zipfile.ZipInfo(
                    f"zoom{float(level.zoom)!r}_focus{float(level.focus)!r}_{kind}_{way}.exr", _ZIP_TIME
                )
                archive.writestr(info, encode_map(_draw(table, level, kind, (margin[0], margin[1]))))
    return out.getvalue()


def overscan_needed(lens: Lens) -> float:
    """The smallest overscan whose flat picture holds every pixel of the plate. Raises :class:`FoldedLens`."""
    lens.require_unfolded()
    width, height = lens.image_size
    across, down = np.linspace(-0.5, width - 0.5, 65), np.linspace(-0.5, height - 0.5, 65)
    sides = [[x, y] for x in (across[0], across[-1]) for y in down] + [
        [x, y] for y in (down[0], down[-1]) for x in across
    ]
    flat = _flat_from_rays(lens, lens.unproject(np.array(sides)))
    beyond = np.abs(flat - np.array([(width - 1) / 2, (height - 1) / 2])) / np.array([width / 2, height / 2])
    return max(1.0, float(np.max(beyond)))


def _draw(table: LensTable, level: LevelResult, kind: str, margin: tuple[int, int]) -> MapPicture:
    """One map of a level, with its lens in the header."""
    lens = level.lens(table.image_size, table.pixel_aspect)
    try:
        needed = overscan_needed(lens)
    except CalibrationError as error:
        raise CannotExport(f"zoom {level.zoom:g}, focus {level.focus:g}: {error}") from error
    plate = table.image_size
    flat = (plate[0] + 2 * margin[0], plate[1] + 2 * margin[1])
    size, source = (flat, plate) if kind == "undistort" else (plate, flat)
    s, t = (np.empty((size[1], size[0]), np.float32) for _ in range(2))
    for rows, pixels in _blocks(size):
        if kind == "undistort":
            found = lens.project(_rays_of_flat(lens, pixels - margin))
        else:
            found = _flat_from_rays(lens, lens.unproject(pixels)) + margin
        lands = np.isfinite(found[..., 0])
        s[rows] = np.where(lands, (found[..., 0] + 0.5) / source[0], _NOWHERE)
        t[rows] = np.where(lands, 1 - (found[..., 1] + 0.5) / source[1], _NOWHERE)
    mark = mark_of(level) | {"fov_x_deg": lens.fov_x_deg, "k1": lens.k1, "k2": lens.k2}
    mark |= {"k1_hw": lens.k1_hw, "k2_hw": lens.k2_hw, "center_shift_px": list(lens.center_shift_px)}
    note = {"map": kind, "margin_px": list(margin), "overscan_needed": round(needed, 4)}
    note |= {"table": head_of(table), "level": mark}
    comments = (
        f"ST map {_WAYS[kind]}: {source[0]} x {source[1]} px go in, {size[0]} x {size[1]} px come out; "
        "R = s to the right, G = t upwards, 0..1 over the picture that goes in, pixel centres at half pixels"
    )
    return MapPicture(s, t, {NOTE: note_text(note), "comments": comments})


def _rays_of_flat(lens: Lens, pixels: FloatArray) -> FloatArray:
    """Rays of the flat picture's pixels, counted from the plate's first: a pinhole of the lens's focal length."""
    scale = np.array([lens.f_px, lens.pixel_aspect * lens.f_px])
    return np.asarray((pixels - np.array(lens.principal_point_px)) / scale)


def _flat_from_rays(lens: Lens, rays: FloatArray) -> FloatArray:
    scale = np.array([lens.f_px, lens.pixel_aspect * lens.f_px])
    return np.asarray(rays * scale + np.array(lens.principal_point_px))


def _blocks(size: tuple[int, int]) -> Iterator[tuple[slice, FloatArray]]:
    """The pixels (rows, W, 2) of a picture, some rows at a time: a lens takes a dozen arrays of their size."""
    width, height = size
    for first in range(0, height, _BLOCK_ROWS):
        rows = slice(first, min(first + _BLOCK_ROWS, height))
        v, u = np.mgrid[rows, 0:width]
        yield rows, np.stack([u, v], axis=-1).astype(np.float64)


def read_stmap(data: bytes) -> LensTable:
    """The table of our own ZIP, or of one EXR of it. Raises :class:`BadDocument`; for a map of another program it says
    what such a map tells and that the field of view is missing."""
    maps = list(_files(data))
    pixels = 0
    for place, content in maps:
        width, height = map_size(content, place)
        pixels += width * height
    if pixels > MAX_PX:
        raise BadDocument("", f"has {pixels} px in all its maps, at most {MAX_PX} are read", "take some of them out")
    return _own_table(data, maps)


def read_foreign_stmap(data: bytes, fov_x_deg: float) -> LensTable:
    """The table of one map of another program, given its horizontal field of view: zoom 0, focus 0."""
    maps = list(_files(data))
    if len(maps) != 1:
        raise BadDocument("", f"holds {len(maps)} maps, with a field of view one is read", "give one EXR file")
    picture = decode_map(maps[0][1], maps[0][0])
    if NOTE in picture.texts:
        raise BadDocument(maps[0][0], "tells its own field of view", "read it without --fov-x")
    fit = fit_map(picture, maps[0][0])
    try:
        lens = Lens(picture.size, fov_to_f_px(fov_x_deg, picture.size[0]), center_shift_px=fit.center_shift_px)
        lens = lens.with_hw(lens.f_px, fit.k1_hw, fit.k2_hw)
    except CalibrationError as error:
        raise BadDocument("", str(error), "give another field of view") from error
    return foreign_table(data, _CARRIER, lens)


def _is_zip(data: bytes) -> bool:
    return data.startswith((b"PK\3\4", b"PK\5\6"))


def _files(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Name and content of each EXR: those of a ZIP, or the file itself."""
    if not _is_zip(data):
        yield "", data
        return
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            total = sum(entry.file_size for entry in entries)
            if len(entries) > _MOST_FILES or total > MAX_FILE_BYTES:
                raise BadDocument(
                    "", f"unpacks to {len(entries)} files of {total} bytes", f"at most {MAX_FILE_BYTES} are read"
                )
            if len({entry.filename for entry in entries}) != len(entries):
                raise BadDocument("", "holds a file twice", "take one of them out")
            for entry in entries:
                if not entry.filename.lower().endswith(".exr"):
                    raise BadDocument(repr(entry.filename[:80]), "is no EXR file", "take it out of the ZIP")
                with archive.open(entry) as file:
                    yield repr(entry.filename[:80]), file.read(entry.file_size)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, OSError) as error:
        # zipfile says by RuntimeError that a file has a password, by NotImplementedError that it does not know how
        # a file is packed.
        why = "is a damaged ZIP, or one with a password or of an unknown packing"
        raise BadDocument("", why, _AGAIN) from error


def _note_of(picture: MapPicture, place: str) -> _Note:
    text = picture.texts.get(NOTE)
    if text is None:
        fit = fit_map(picture, place)
        raise BadDocument(
            place,
            f"tells no lens in its header; its pixels tell {fit}, but no map tells the field of view",
            "give it: --fov-x DEGREES",
        )
    return read_note(_Note, text, f"{place} header".strip())


def _own_table(data: bytes, maps: list[tuple[str, bytes]]) -> LensTable:
    head: Head | None = None
    lenses: dict[tuple[float, float], tuple[_Mark, Lens]] = {}
    seen: set[tuple[str, float, float]] = set()
    for place, content in maps:
        picture = decode_map(content, place)  # one at a time: each takes up to 600 MB
        note = _note_of(picture, place)
        mark = note.level
        head = head or note.table
        if note.table != head:
            raise BadDocument(place, "is of another table than the first map", "keep one table in a file")
        key = (note.map, mark.zoom, mark.focus)
        known = lenses.get((mark.zoom, mark.focus))
        if key in seen or (known is not None and known[0] != mark):
            raise BadDocument(place, "contradicts another map of this level", "keep one of them")
        seen.add(key)
        lens = _lens_of(mark, head, place)
        _require_agreement(picture, note, lens, place)
        lenses[mark.zoom, mark.focus] = (mark, lens)
    if head is None:
        raise BadDocument("", "holds no map", "is this a ZIP of ST maps?")
    if not _is_zip(data):
        head = head.model_copy(update={"levels": 1})
    levels = [noted_level(mark, lens, _CARRIER) for mark, lens in lenses.values()]
    return noted_table(data, _CARRIER, head, levels)


def _lens_of(mark: _Mark, head: Head, place: str) -> Lens:
    f_px = fov_to_f_px(mark.fov_x_deg, head.image_size[0])
    lens = lens_of_file(
        place, head.image_size, f_px, mark.k1, mark.k2, mark.center_shift_px, head.pixel_aspect, mark.nodal_offset_mm
    )
    if lens.folds_inside():
        raise BadDocument(place, "tells a lens that folds inside the picture", _AGAIN)
    return lens


def _require_agreement(picture: MapPicture, note: _Note, lens: Lens, place: str) -> None:
    """Refuse a map whose pixels are not those of the lens in its header, to :data:`AGREE_PX` of the plate."""
    margin = note.margin_px
    plate = lens.image_size
    flat = (plate[0] + 2 * margin[0], plate[1] + 2 * margin[1])
    size, source = (flat, plate) if note.map == "undistort" else (plate, flat)
    if picture.size != size:
        told = f"{picture.size[0]} x {picture.size[1]} px, its header tells {size[0]} x {size[1]}"
        raise BadDocument(place, f"has {told}", _AGAIN)
    for rows, pixels in _blocks(size):
        s, t = picture.s[rows].astype(np.float64), picture.t[rows].astype(np.float64)
        found = np.stack([s * source[0] - 0.5, (1 - t) * source[1] - 0.5], axis=-1)
        if note.map == "undistort":
            wanted = lens.project(_rays_of_flat(lens, pixels - margin))
            nowhere = np.isnan(wanted[..., 0])
            off = np.where(nowhere, np.where((s == _NOWHERE) & (t == _NOWHERE), 0.0, np.inf), _distance(found, wanted))
        else:
            # Both ways round the value agrees: through the lens it leads back to the pixel that it is written in.
            off = _distance(lens.project(_rays_of_flat(lens, found - margin)), pixels)
        if not (off <= AGREE_PX).all():
            worst = float(np.max(np.where(np.isfinite(off), off, np.inf)))
            raise BadDocument(place, f"has pixels that are {worst:.3g} px off the lens in its header", _AGAIN)


def _distance(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]))


def _advice(table: LensTable) -> str:
    """What overscan keeps the corners of every level."""
    needed = max(overscan_needed(level.lens(table.image_size, table.pixel_aspect)) for level in lens_levels(table))
    return f"an overscan of {math.ceil(needed * 1000) / 1000:g} keeps every pixel of the plate in the flat picture"


STMAP = Export(
    name="stmap",
    title="ST maps (EXR in a ZIP)",
    suffix=".zip",
    media_type="application/zip",
    write=write_stmap,
    read=read_stmap,
    cannot_carry=(EVIDENCE_LOST, "the field of view, zoom, focus and nodal offset, but in the EXR header"),
    max_bytes=MAX_FILE_BYTES,
    write_overscan=write_stmap,
    read_with_fov=read_foreign_stmap,
    advice=_advice,
)
