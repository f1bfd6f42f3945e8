"""The MockBoard's answer, without I/O: base64 text in one of three wrappings to a picture file."""

from __future__ import annotations

import binascii
import json
from typing import Literal

from engine_adapters.errors import BadPicture
from engine_adapters.pictures import WHITESPACE, check_whole, decode_base64

Payload = Literal["auto", "base64", "json", "data_uri"]
"""``auto``: a text beginning with a quote is a JSON string, one beginning with ``data:`` a data URI."""

PAYLOAD_LIMIT_BYTES = 64 * 1024 * 1024
"""Largest answer that is decoded: a noisy 8K PNG in base64 stays below it."""


def decode_payload(
    body: bytes,
    *,
    payload: Payload = "auto",
    picture_format: Literal["auto", "png", "jpeg", "bmp"] = "auto",
    limit_bytes: int = PAYLOAD_LIMIT_BYTES,
) -> bytes:
    """The picture file (PNG, JPEG or BMP, whole) in an answer.

    Whitespace and line breaks around and within the base64 text do not matter. A JSON string may hold a data URI.
    Raises ``BadPicture`` for anything else, and for a picture that was cut off.
    """
    if len(body) > limit_bytes:
        raise BadPicture(f"the answer of {len(body)} bytes is larger than its limit of {limit_bytes} bytes")
    text = body.removeprefix(b"\xef\xbb\xbf").strip(WHITESPACE)
    if not text:
        raise BadPicture("the answer is empty; select the MockBoard as output in R3")
    if payload == "json" or (payload == "auto" and text.startswith(b'"')):
        text = _json_string(text)
    if payload == "data_uri" or (payload != "base64" and text[:5].lower() == b"data:"):
        text = _data_uri(text)
    try:
        data = decode_base64(text)
    except binascii.Error as error:
        raise BadPicture(f"the answer is not base64 text (it begins with {text[:24]!r})") from error
    kind = check_whole(data)
    if picture_format not in ("auto", kind.value):
        raise BadPicture(
            f"a {kind.value} picture came; mockboard.picture_format of the studio profile says {picture_format}"
        )
    return data


def _json_string(text: bytes) -> bytes:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadPicture(f"the answer is not a JSON string (it begins with {text[:24]!r})") from error
    if not isinstance(value, str) or not value.isascii():
        raise BadPicture("the answer is JSON, but not a string of base64 text")
    return value.strip().encode("ascii")


def _data_uri(text: bytes) -> bytes:
    head, comma, data = text.partition(b",")
    if not comma or not head.lower().startswith(b"data:") or not head.lower().rstrip().endswith(b";base64"):
        raise BadPicture(f"the answer is not a data URI with base64 text (it begins with {text[:24]!r})")
    return data
