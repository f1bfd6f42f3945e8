"""What every format of a lens table offers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.tables import LENS_QUANTITIES, REASON_KEYS, LensTable, LevelResult, LevelStatus, Provenance
from storage.errors import BadDocument, CannotExport
from storage.schemas import Moment, Name, Number, Positive, Side, format_utc

MAX_DOCUMENT_BYTES = 64 * 1024 * 1024
"""A table of 1,000 levels has about 2 MB: more than this is another file, and is not read into memory."""


UNKNOWN_TIME = datetime(1970, 1, 1, tzinfo=UTC)
"""``created`` of a table from a file that does not tell it: the same file always gives the same table."""

EVIDENCE_LOST = "sigmas, errors in px and other evidence, pictures, interpolation, engine values; failed levels"
"""What every format of coefficients loses, in words for the operator."""

ONLY_IN_A_NOTE = "zoom, focus and nodal offset, but for a note that other programs ignore"
"""What a format of another trade has no place for."""

_REASON_CHARS = 200


@dataclass(frozen=True, slots=True)
class Export:
    """A format. ``suffix`` with its dot; ``cannot_carry`` names what a round trip loses, in words for the operator.

    ``max_bytes``: the largest file that is read. ``write_overscan``: ``write`` with an overscan factor (1: none), where
    the format has one. ``read_with_fov``: ``read`` of a file that does not tell the field of view, with ``fov_x_deg``.
    ``advice``: what to tell the operator beside the file.
    """

    name: str
    title: str
    suffix: str
    media_type: str
    write: Callable[[LensTable], bytes]
    read: Callable[[bytes], LensTable]
    cannot_carry: tuple[str, ...] = ()
    max_bytes: int = MAX_DOCUMENT_BYTES
    write_overscan: Callable[[LensTable, float], bytes] | None = None
    read_with_fov: Callable[[bytes, float], LensTable] | None = None
    advice: Callable[[LensTable], str] | None = None


def decode_text(data: bytes) -> str:
    """The text of a file, UTF-8 with or without a byte order mark."""
    if len(data) > MAX_DOCUMENT_BYTES:
        raise BadDocument(
            "", f"has {len(data)} bytes, at most {MAX_DOCUMENT_BYTES} are read", "is this a lens table file?"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadDocument(
            "", f"is not UTF-8 text (byte {error.start})", "is this a lens table file, saved as UTF-8?"
        ) from error


def lens_levels(table: LensTable) -> tuple[LevelResult, ...]:
    """The levels that have a lens: a format of coefficients carries no others. Raises :class:`CannotExport` when there
    is none."""
    told = tuple(level for level in table.levels if level.fov_x_deg is not None)
    if not told:
        raise CannotExport("no level of this table has a field of view; measure it again")
    return told


def provenance_of(table: LensTable) -> dict[str, str]:
    """What every format says of where its numbers come from, as name and text: plain characters, no line breaks."""
    facts = {
        "lens": table.lens,
        "camera": table.camera,
        "version": str(table.version),
        "created": format_utc(table.created),
        "method": table.method,
    }
    if table.provenance is not None:
        facts["source"] = table.provenance.source
        facts["software"] = table.provenance.software
        for name in ("job_id", "profile", "inputs_sha256", "parent_sha256"):
            if (value := getattr(table.provenance, name)) is not None:
                facts[name] = value
    return facts


def read_level(
    zoom: float, focus: float, lens: Lens, carrier: str, *, missing: Iterable[str] = (), degraded: str | None = None
) -> LevelResult:
    """A level of a file that carries coefficients and no evidence. ``carrier``: the format, for the reasons;
    ``missing``: the lens quantities that it does not carry; ``degraded``: why the level is no better than that.
    Raises :class:`BadDocument`."""
    told = set(LENS_QUANTITIES) - set(missing)
    reasons = {name: f"not in the {carrier} file" for name in REASON_KEYS if name not in told}
    try:
        lens.require_unfolded()
        status = LevelStatus.DEGRADED if degraded else LevelStatus.OK
        return LevelResult.from_lens(zoom, focus, lens, status=status, reason=degraded, reasons=reasons)
    except CalibrationError as error:
        raise BadDocument(f"zoom {zoom:g}, focus {focus:g}", str(error), "correct it, or export it again") from error


def read_table(
    data: bytes,
    carrier: str,
    levels: Iterable[LevelResult],
    *,
    lens: str,
    camera: str,
    created: datetime,
    image_size: tuple[int, int],
    version: int = 1,
    sensor_mm: tuple[float, float] | None = None,
    pixel_aspect: float = 1.0,
    method: str = "imported",
    software: str = "unknown",
    note: str | None = None,
) -> LensTable:
    """The table of a file's levels, with the file's hash as its provenance. ``note``: what was done to its numbers.
    Raises :class:`BadDocument`."""
    told = f"read from a {carrier} file" + (f"; {note}" if note else "")
    provenance = Provenance("imported", software, inputs_sha256=hashlib.sha256(data).hexdigest(), note=told)
    try:
        return LensTable(
            lens=lens,
            camera=camera,
            version=version,
            created=created,
            image_size=image_size,
            method=method,
            levels=tuple(levels),
            sensor_mm=sensor_mm,
            pixel_aspect=pixel_aspect,
            provenance=provenance,
        )
    except CalibrationError as error:
        raise BadDocument("", str(error), "correct it, or export it again") from error


class Note(BaseModel):
    """Facts that a format has no field for, in a place of the file that other programs skip."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class Head(Note):
    """What a format notes of the table as a whole, beside its own fields."""

    lens_table: Literal[1]
    lens: Name
    camera: Name
    version: Annotated[int, Field(strict=True, ge=1)]
    created: Moment
    method: Name
    image_size: tuple[Side, Side]
    sensor_mm: tuple[Positive, Positive] | None = None
    pixel_aspect: Positive = 1.0
    levels: Annotated[int, Field(strict=True, ge=1)]
    source: Name = "unknown"
    software: Name = "unknown"


class Mark(Note):
    """What a format notes of a level, beside its own fields. ``untold``: quantities that the level does not tell and
    the format's own fields show as 0."""

    zoom: Number
    focus: Number
    nodal_offset_mm: Number | None = None
    untold: tuple[Literal["k1", "k2", "center_shift_px"], ...] = ()
    degraded: Annotated[str, Field(strict=True, min_length=1, max_length=_REASON_CHARS)] | None = None


_N = TypeVar("_N", bound=Note)


def head_of(table: LensTable) -> dict[str, Any]:
    """The table's :class:`Head` and its provenance, to be written as JSON."""
    told = {name: _one_line(text) for name, text in provenance_of(table).items()}
    facts: dict[str, Any] = {"lens_table": 1, **told, "version": table.version}
    facts["image_size"] = list(table.image_size)
    if table.sensor_mm is not None:
        facts["sensor_mm"] = list(table.sensor_mm)
    return {**facts, "pixel_aspect": table.pixel_aspect, "levels": len(lens_levels(table))}


def mark_of(level: LevelResult) -> dict[str, Any]:
    """The level's :class:`Mark`, to be written as JSON."""
    facts: dict[str, Any] = {"zoom": level.zoom, "focus": level.focus}
    if level.nodal_offset_mm is not None:
        facts["nodal_offset_mm"] = level.nodal_offset_mm
    if untold := [name for name in ("k1", "k2", "center_shift_px") if getattr(level, name) is None]:
        facts["untold"] = untold
    if level.status is LevelStatus.DEGRADED and level.reason:
        facts["degraded"] = _one_line(level.reason)
    return facts


def _one_line(text: str) -> str:
    """At most 200 characters that can stand in any file."""
    return "".join(character if character.isprintable() else " " for character in text)[:_REASON_CHARS]


def note_text(facts: Mapping[str, Any]) -> str:
    """Facts as JSON on one line of ASCII, without ``--``: they can stand in any comment."""
    return json.dumps(facts, allow_nan=False).replace("--", "-\\u002d")


def read_note(kind: type[_N], found: object, place: str) -> _N:
    """A note of a file, as JSON text or what came out of it. Raises :class:`BadDocument`."""
    facts = parse_json(found, place) if isinstance(found, str) else found
    try:
        return kind.model_validate(facts)
    except ValidationError as error:
        details = error.errors()[0]
        where = ".".join(str(part) for part in details["loc"])
        raise BadDocument(f"{place}, {where}" if where else place, details["msg"].lower(), _AGAIN) from error


def parse_json(text: str, place: str) -> Any:
    """A JSON text; NaN and the infinities are refused. Raises :class:`BadDocument`."""

    def refuse(name: str) -> NoReturn:
        raise BadDocument(place, f"holds {name}, which is no number", _AGAIN)

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(found := dict(pairs)) != len(pairs):
            raise BadDocument(place, "holds a key twice", _AGAIN)
        return found

    try:
        return json.loads(text, parse_constant=refuse, object_pairs_hook=once)
    except (ValueError, RecursionError) as error:
        raise BadDocument(place, "is not JSON", _AGAIN) from error


_AGAIN = "the file is damaged or of another format; export it again"


def lens_of_file(
    place: str,
    image_size: tuple[int, int],
    f_px: float,
    k1: float = 0.0,
    k2: float = 0.0,
    center_shift_px: tuple[float, float] = (0.0, 0.0),
    pixel_aspect: float = 1.0,
    nodal_offset_mm: float | None = None,
) -> Lens:
    """The lens of a file's numbers. Raises :class:`BadDocument`, naming the ``place``."""
    try:
        return Lens(image_size, f_px, k1, k2, center_shift_px, pixel_aspect, nodal_offset_mm or 0.0)
    except CalibrationError as error:
        raise BadDocument(place, str(error), "correct it, or export it again") from error


def noted_level(mark: Mark, lens: Lens, carrier: str) -> LevelResult:
    """The level of a mark and the lens beside it. Raises :class:`BadDocument`."""
    missing = {*mark.untold} | ({"nodal_offset_mm"} if mark.nodal_offset_mm is None else set())
    return read_level(mark.zoom, mark.focus, lens, carrier, missing=missing, degraded=mark.degraded)


def noted_table(
    data: bytes, carrier: str, head: Head, levels: Iterable[LevelResult], note: str | None = None
) -> LensTable:
    """The table of a head and its levels, all of them. Raises :class:`BadDocument`."""
    levels = tuple(levels)
    if len(levels) != head.levels:
        raise BadDocument("", f"has {len(levels)} levels of the {head.levels} that it tells", _AGAIN)
    return read_table(
        data,
        carrier,
        levels,
        lens=head.lens,
        camera=head.camera,
        created=head.created,
        image_size=head.image_size,
        version=head.version,
        sensor_mm=head.sensor_mm,
        pixel_aspect=head.pixel_aspect,
        method=head.method,
        software=head.software,
        note=note,
    )


def foreign_table(data: bytes, carrier: str, lens: Lens, *, sensor_mm: tuple[float, float] | None = None) -> LensTable:
    """The table of one lens in a file that no program of ours wrote: zoom 0, focus 0, and no names."""
    level = read_level(0.0, 0.0, lens, carrier, missing=("nodal_offset_mm",))
    return read_table(
        data,
        carrier,
        [level],
        lens="unknown",
        camera="unknown",
        created=UNKNOWN_TIME,
        image_size=lens.image_size,
        sensor_mm=sensor_mm,
        pixel_aspect=lens.pixel_aspect,
    )


def one_focus(levels: tuple[LevelResult, ...], carrier: str) -> None:
    """Refuse levels of several focuses, for a format that is keyed by the zoom alone. Raises :class:`CannotExport`."""
    focuses = sorted({level.focus for level in levels})
    if len(focuses) > 1:
        told = ", ".join(f"{focus:g}" for focus in focuses[:5])
        raise CannotExport(f"{carrier} has no place for focus and this table has {told}; export one of them (--focus)")
