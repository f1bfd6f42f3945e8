"""Pictures inside the page: made small enough to send, and written into it as data."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from calibration import image as _bounds  # sets OpenCV's own bound on picture sizes  # noqa: F401
from calibration.types import Picture

_WIDTH, _SMALL_WIDTH = 960, 480
_JPEG_QUALITY = 82


@dataclass(frozen=True, slots=True)
class Image:
    """A picture of the page; ``data_uri`` is empty for a file that is no picture."""

    title: str
    text: str
    alt: str
    data_uri: str
    width: int
    height: int
    small: bool


def embedded(data: bytes, title: str, text: str, alt: str, *, small: bool = False) -> Image:
    """An encoded picture, brought to at most 960 (small: 480) px width, as a data URI."""
    picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR) if data else None
    if picture is None:
        return Image(title, "The stored picture cannot be read.", alt, "", 0, 0, small)
    shrunk = _shrunk(np.asarray(picture, dtype=np.uint8), _SMALL_WIDTH if small else _WIDTH)
    made, file = cv2.imencode(".jpg", shrunk, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not made:
        raise RuntimeError("OpenCV could not write a JPEG picture")
    code = base64.b64encode(bytes(file)).decode("ascii")
    height, width = shrunk.shape[:2]
    return Image(title, text, alt, f"data:image/jpeg;base64,{code}", width, height, small)


def _shrunk(picture: Picture, most: int) -> Picture:
    height, width = picture.shape[:2]
    if width <= most:
        return picture
    size = (most, max(round(height * most / width), 1))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
