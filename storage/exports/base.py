"""What every format of a lens table offers."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime

from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.tables import REASON_KEYS, LensTable, LevelResult, LevelStatus, Provenance
from storage.errors import BadDocument, CannotExport
from storage.schemas import format_utc

MAX_DOCUMENT_BYTES = 64 * 1024 * 1024
"""A table of 1,000 levels has about 2 MB: more than this is another file, and is not read into memory."""


@dataclass(frozen=True, slots=True)
class Export:
    """A format. ``suffix`` with its dot; ``cannot_carry`` names what a round trip loses, in words for the operator."""

    name: str
    title: str
    suffix: str
    media_type: str
    write: Callable[[LensTable], bytes]
    read: Callable[[bytes], LensTable]
    cannot_carry: tuple[str, ...] = ()


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


def read_level(zoom: float, focus: float, lens: Lens, carrier: str, *, missing: Iterable[str] = ()) -> LevelResult:
    """A level of a file that carries coefficients and no evidence. ``carrier``: the format, for the reasons;
    ``missing``: the lens quantities that it does not carry. Raises :class:`BadDocument`."""
    told = {name for name in ("fov_x_deg", "k1", "k2", "center_shift_px", "nodal_offset_mm") if name not in missing}
    reasons = {name: f"not in the {carrier} file" for name in REASON_KEYS if name not in told}
    try:
        lens.require_unfolded()
        return LevelResult.from_lens(zoom, focus, lens, status=LevelStatus.OK, reasons=reasons)
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
) -> LensTable:
    """The table of a file's levels, with the file's hash as its provenance. Raises :class:`BadDocument`."""
    provenance = Provenance(
        "imported", software, inputs_sha256=hashlib.sha256(data).hexdigest(), note=f"read from a {carrier} file"
    )
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
