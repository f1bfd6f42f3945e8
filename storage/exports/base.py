"""What every format of a lens table offers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from calibration.tables import LensTable
from storage.errors import BadDocument

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
