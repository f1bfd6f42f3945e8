"""The MockBoard's answer: every wrapping read, everything else refused with a reason."""

from __future__ import annotations

import base64
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine_adapters.errors import BadPicture
from engine_adapters.mockboard.payload import decode_payload

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 3 + b"\x00\x00\x00\x00IEND\xaeB`\x82"
JPEG = b"\xff\xd8\xff\xe0" + bytes(range(200)) + b"\xff\xd9"
BMP = b"BM" + (300).to_bytes(4, "little") + bytes(294)
PICTURES = {"png": PNG, "jpeg": JPEG, "bmp": BMP}
TEXT = base64.b64encode(PNG)

WRAPPINGS = {
    "bare": TEXT,
    "line breaks": base64.encodebytes(PNG),
    "windows line breaks": base64.encodebytes(PNG).replace(b"\n", b"\r\n"),
    "spaces around": b" \r\n\t" + TEXT + b"\r\n\r\n",
    "byte order mark": b"\xef\xbb\xbf" + TEXT,
    "json": json.dumps(TEXT.decode()).encode(),
    "json with escaped slashes": json.dumps(TEXT.decode()).replace("/", "\\/").encode(),
    "json with line breaks": json.dumps(base64.encodebytes(PNG).decode()).encode() + b"\n",
    "data uri": b"data:image/png;base64," + TEXT,
    "data uri, upper case": b"DATA:IMAGE/PNG;BASE64," + TEXT,
    "data uri in json": json.dumps(f"data:image/png;base64,{TEXT.decode()}").encode(),
}


@pytest.mark.parametrize("name", WRAPPINGS)
def test_each_wrapping_gives_the_picture(name: str) -> None:
    assert decode_payload(WRAPPINGS[name]) == PNG


@pytest.mark.parametrize("kind", PICTURES)
def test_each_picture_file_is_known(kind: Any) -> None:
    body = base64.b64encode(PICTURES[kind])
    assert decode_payload(body, picture_format=kind) == PICTURES[kind]
    other: Any = "png" if kind != "png" else "bmp"
    with pytest.raises(BadPicture, match=f"a {kind} picture came"):
        decode_payload(body, picture_format=other)


@pytest.mark.parametrize(
    ("payload", "name"),
    [("base64", "json"), ("base64", "data uri"), ("json", "bare"), ("data_uri", "bare"), ("data_uri", "json")],
)
def test_a_pinned_wrapping_takes_no_other(payload: Any, name: str) -> None:
    with pytest.raises(BadPicture):
        decode_payload(WRAPPINGS[name], payload=payload)


@pytest.mark.parametrize(("payload", "name"), [("base64", "bare"), ("json", "json"), ("data_uri", "data uri")])
def test_a_pinned_wrapping_is_read(payload: Any, name: str) -> None:
    assert decode_payload(WRAPPINGS[name], payload=payload) == PNG


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (b"", "empty"),
        (b" \r\n", "empty"),
        (b"<html><body>MockBoard</body></html>", "not base64"),
        (b"{}", "not base64"),
        (b'"abc', "not a JSON string"),
        (b'""', "the picture is empty"),
        ('"é"'.encode(), "not a string of base64"),
        (b"data:image/png," + TEXT, "data URI"),
        (b"data:image/png;base64", "data URI"),
        (b"%%%%", "not base64"),
        (b"AAAA=AAA", "not base64"),
        (base64.urlsafe_b64encode(b"\xff\xfe\xfd" * 9), "not base64"),
        (TEXT[:-1], "not base64"),
        (PNG, "not base64"),
        (base64.b64encode(b"GIF89a" + bytes(50)), "not a PNG, JPEG or BMP"),
        (base64.b64encode(PNG[:-6]), "cut off"),
        (base64.b64encode(JPEG[:-1]), "cut off"),
        (base64.b64encode(BMP[:-1]), "cut off"),
    ],
)
def test_anything_else_is_refused_with_its_reason(body: bytes, told: str) -> None:
    with pytest.raises(BadPicture, match=told):
        decode_payload(body)


def test_padding_after_the_pictures_end_is_allowed() -> None:
    for data in (PNG + bytes(3), JPEG + b"\r\n", BMP + bytes(10)):
        assert decode_payload(base64.b64encode(data)) == data


def test_the_size_is_bounded() -> None:
    assert decode_payload(TEXT, limit_bytes=len(TEXT)) == PNG
    with pytest.raises(BadPicture, match="larger than its limit"):
        decode_payload(TEXT, limit_bytes=len(TEXT) - 1)


@given(st.binary(max_size=300))
def test_any_bytes_give_a_picture_or_a_reason(body: bytes) -> None:
    with pytest.raises(BadPicture):
        decode_payload(body)


@given(cut=st.integers(0, len(TEXT) - 1))
def test_a_text_cut_anywhere_is_refused(cut: int) -> None:
    with pytest.raises(BadPicture):
        decode_payload(TEXT[:cut])
