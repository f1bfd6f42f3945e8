"""What kind of picture file some bytes are, and whether they are whole; nothing is decoded.

A picture cut on the wire still decodes to something: half a frame that looks plausible. So its end is checked too.
"""

from __future__ import annotations

import binascii
from enum import StrEnum

from engine_adapters.errors import BadPicture

WHITESPACE = b" \t\r\n\f\v"

_BASE64_BLOCK = 256 * 1024
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"


class PictureFormat(StrEnum):
    """The picture files that the product reads."""

    PNG = "png"
    JPEG = "jpeg"
    BMP = "bmp"


def picture_format(data: bytes, *, where: str = "") -> PictureFormat:
    """The format told by the first bytes. Raises ``BadPicture``."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return PictureFormat.PNG
    if data.startswith(b"\xff\xd8\xff"):
        return PictureFormat.JPEG
    if data.startswith(b"BM") and len(data) >= 26:
        return PictureFormat.BMP
    if not data:
        raise BadPicture("the picture is empty", where=where)
    raise BadPicture(f"not a PNG, JPEG or BMP picture (it begins with {data[:16]!r})", where=where)


def check_whole(data: bytes, *, where: str = "") -> PictureFormat:
    """The format of a picture whose end has arrived too (padding after it is allowed). Raises ``BadPicture``."""
    kind = picture_format(data, where=where)
    tail = data[-64:].rstrip(b"\x00\r\n ")
    if kind is PictureFormat.PNG:
        whole = tail.endswith(_PNG_END)
    elif kind is PictureFormat.JPEG:
        whole = tail.endswith(_JPEG_END)
    else:
        # The size in a BMP header may be 0 (some writers leave it out); the pixels then speak for themselves.
        whole = int.from_bytes(data[2:6], "little") <= len(data)
    if not whole:
        raise BadPicture(f"the {kind.value.upper()} picture was cut off ({len(data)} bytes came)", where=where)
    return kind


def decode_base64(text: bytes) -> bytes:
    """The bytes of a base64 text, strictly (alphabet, padding), whitespace left out. Raises ``binascii.Error``.

    Worked off in blocks: one call on megabytes would hold the interpreter's lock, and with it the event loop, for tens
    of milliseconds, in whichever thread it runs.
    """
    decoded = bytearray()
    rest = b""
    ended = False
    for start in range(0, len(text), _BASE64_BLOCK):
        block = text[start : start + _BASE64_BLOCK]
        # Looking for whitespace is twenty times as fast as taking it out.
        if any(space in block for space in WHITESPACE):
            block = block.translate(None, WHITESPACE)
        block = rest + block
        whole = len(block) // 4 * 4
        if block and ended:
            raise binascii.Error("text after the padding")
        decoded += binascii.a2b_base64(block[:whole], strict_mode=True)
        ended = block[:whole].endswith(b"=")
        rest = block[whole:]
        if rest and ended:
            raise binascii.Error("text after the padding")
    if rest:
        raise binascii.Error("incomplete last group")
    return bytes(decoded)
