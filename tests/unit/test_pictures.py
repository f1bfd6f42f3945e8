"""Picture files by their first and last bytes, and strict base64 in blocks."""

from __future__ import annotations

import base64
import binascii

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine_adapters import pictures
from engine_adapters.errors import BadPicture
from engine_adapters.pictures import PictureFormat, check_whole, decode_base64, picture_format


@given(data=st.binary(max_size=200), block=st.integers(4, 64), width=st.integers(1, 80))
def test_base64_is_the_same_in_any_block_and_line_width(data: bytes, block: int, width: int) -> None:
    text = base64.b64encode(data)
    broken = b"\r\n".join(text[start : start + width] for start in range(0, len(text), width))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "_BASE64_BLOCK", block)
        assert decode_base64(broken) == data


@given(text=st.text("AB=+/ \n", max_size=40).map(str.encode), block=st.integers(1, 16))
def test_base64_is_as_strict_in_blocks_as_at_once(text: bytes, block: int) -> None:
    try:
        expected = binascii.a2b_base64(b"".join(text.split()), strict_mode=True)
    except binascii.Error:
        expected = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "_BASE64_BLOCK", block)
        if expected is None:
            with pytest.raises(binascii.Error):
                decode_base64(text)
        else:
            assert decode_base64(text) == expected


def test_formats_are_told_by_the_first_bytes() -> None:
    assert picture_format(b"\x89PNG\r\n\x1a\n") is PictureFormat.PNG
    assert picture_format(b"\xff\xd8\xff") is PictureFormat.JPEG
    assert picture_format(b"BM" + bytes(24)) is PictureFormat.BMP
    for data in (b"", b"BM", b"GIF89a", b"RIFF"):
        with pytest.raises(BadPicture):
            picture_format(data)


def test_a_bitmap_without_its_size_is_taken() -> None:
    assert check_whole(b"BM" + bytes(60)) is PictureFormat.BMP
