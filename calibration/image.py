"""Pictures as numbers: decoding with bounds, and light instead of coded values.

An edge is measured on linear light: a blur is linear in light, so on coded values a blurred edge between a dark
and a bright colour stands too far out (a red outline by 0.035 px on BT.709 pictures).
"""

from __future__ import annotations

import io
from enum import StrEnum
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from calibration import MAX_PICTURE_PIXELS
from calibration.errors import InvalidInput
from calibration.types import Picture

# Pillow only reads headers here, and the bound on the size is our own, with its own words.
Image.MAX_IMAGE_PIXELS = None


class Transfer(StrEnum):
    """How light was coded into the picture's values."""

    BT709 = "bt709"
    """Studio video (the inverse of the BT.709 camera curve)."""
    SRGB = "srgb"
    """Photographs and computer pictures (IEC 61966-2-1)."""
    LINEAR = "linear"


@cache
def light_table(transfer: Transfer) -> NDArray[np.float32]:
    """Light 0..1 for each coded value 0..255, shape (256,), float32.

    BT.709 (ITU-R BT.709-6, item 1.2, inverted): L = V / 4.5 for V < 0.081, else ((V + 0.099) / 1.099)^(1/0.45).
    sRGB (IEC 61966-2-1): L = V / 12.92 for V <= 0.04045, else ((V + 0.055) / 1.055)^2.4.
    """
    coded = np.arange(256, dtype=np.float64) / 255.0
    if transfer is Transfer.BT709:
        light = np.where(coded < 0.081, coded / 4.5, ((coded + 0.099) / 1.099) ** (1 / 0.45))
    elif transfer is Transfer.SRGB:
        light = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    else:
        light = coded
    table = light.astype(np.float32)
    table.setflags(write=False)
    return table


def to_light(values: NDArray[np.uint8], transfer: Transfer) -> NDArray[np.float32]:
    """Coded values (any shape, uint8) to linear light 0..1 (same shape, float32)."""
    return light_table(transfer)[values]


def decode_picture(data: bytes, *, expected_size: tuple[int, int] | None = None) -> Picture:
    """Decode a PNG, JPEG or BMP file to a picture (H, W, 3) uint8 BGR.

    The header is read first: a picture of more than ``calibration.MAX_PICTURE_PIXELS``, or of another size than
    ``expected_size`` (width, height), is refused before any pixel is decoded. Raises :class:`InvalidInput`.
    """
    if not data:
        raise InvalidInput("picture", "0 bytes", "the picture is empty")
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "BMP")) as header:
            width, height = header.size
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise InvalidInput("picture", f"{len(data)} bytes", "not a PNG, JPEG or BMP picture") from error
    if width * height > MAX_PICTURE_PIXELS or width < 1 or height < 1:
        raise InvalidInput("picture size", f"{width}x{height}", f"at most {MAX_PICTURE_PIXELS} pixels are read")
    if expected_size is not None and (width, height) != expected_size:
        raise InvalidInput("picture size", f"{width}x{height}", f"expected {expected_size[0]}x{expected_size[1]}")
    # The pixels as stored are what the lens drew: an EXIF turn would move the principal point.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise InvalidInput("picture", f"{len(data)} bytes", "the picture cannot be decoded") from error
    if picture is None:
        raise InvalidInput("picture", f"{len(data)} bytes", "the picture is damaged")
    return np.asarray(picture, dtype=np.uint8)
