"""An ST map as an OpenEXR file: one part, scan lines, 32-bit float R and G, and a lens's text in its header.

What a header asks for is checked before the library allocates or reads anything: the picture's size, its channels, and
that every chunk lies inside the file.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass, field

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from calibration.tables import MAX_PICTURE_SIDE_PX
from storage.errors import BadDocument

MAX_MAP_PX = 50_000_000
"""8K (33 million px) with an overscan of 1.2; decoded it has 600 MB."""

NOTE = "lensmatch"
"""The header attribute that holds the lens."""

_MAGIC = b"v/1\x01"
_ADVICE = "is this an ST map, one part of scan lines?"
_MOST_ATTRIBUTES, _MOST_CHANNELS = 1000, 8
_FLOAT = 2
_LINES_OF_A_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""By compression, as the format numbers them: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPicture:
    """The two channels of a map, (H, W) each: ``s`` to the right in R, ``t`` in G. ``texts``: header attributes."""

    s: NDArray[np.float32]
    t: NDArray[np.float32]
    texts: dict[str, str] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.s.shape[1], self.s.shape[0]


def encode_map(picture: MapPicture) -> bytes:
    """The map as OpenEXR: ZIP compression, B = 0."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **picture.texts}
    # The library takes the memory as it lies: of a view with steps it would write other pixels.
    s, t = (np.ascontiguousarray(channel, dtype=np.float32) for channel in (picture.s, picture.t))
    channels = {"R": s, "G": t, "B": np.zeros_like(s)}
    out = io.BytesIO()
    OpenEXR.File(header, channels).write(out)
    return out.getvalue()


def decode_map(data: bytes, place: str) -> MapPicture:
    """The map of an OpenEXR file. Raises :class:`BadDocument`, naming the ``place``."""
    width, height = map_size(data, place)
    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
            channels = file.channels()
            s, t = (np.asarray(channels[name].pixels) for name in ("R", "G"))
            texts = {name: value for name, value in file.header().items() if isinstance(value, str)}
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise BadDocument(place, "cannot be decoded", "the file is damaged; export it again") from error
    if s.shape != (height, width) or t.shape != s.shape or s.dtype != np.float32 or t.dtype != np.float32:
        raise BadDocument(place, "has not the pixels that its header tells", "the file is damaged; export it again")
    return MapPicture(s, t, texts)


def map_size(data: bytes, place: str) -> tuple[int, int]:
    """Width and height (px) that a header tells, with everything in it checked. Raises :class:`BadDocument`."""
    try:
        return _checked_size(data, place)
    except (struct.error, ValueError, IndexError) as error:
        raise BadDocument(place, "has a damaged or cut header", _ADVICE) from error


def _checked_size(data: bytes, place: str) -> tuple[int, int]:
    version = struct.unpack_from("<I", data, 4)[0] if data.startswith(_MAGIC) else 0
    if version & 0xFF != 2 or version & 0x1A00:  # tiles, deep data, several parts
        raise BadDocument(place, "is no OpenEXR picture of one part and scan lines", _ADVICE)
    attributes, at = _attributes(data)
    x_first, y_first, x_last, y_last = struct.unpack("<4i", attributes["dataWindow"])
    width, height = x_last - x_first + 1, y_last - y_first + 1
    if not (1 < width <= MAX_PICTURE_SIDE_PX and 1 < height <= MAX_PICTURE_SIDE_PX and width * height <= MAX_MAP_PX):
        raise BadDocument(
            place, f"is {width} x {height} px, at most {MAX_MAP_PX} px in all are read", "is this the right file?"
        )
    if attributes["displayWindow"] != attributes["dataWindow"]:
        raise BadDocument(place, "has a data window that is not its display window", "write it without a crop")
    channels = _channels(attributes["channels"])
    if any(channels.get(name) != _FLOAT for name in ("R", "G")):
        raise BadDocument(place, "has no 32-bit float R and G", "write it as 32-bit float: half is 0.4 px off")
    lines = _LINES_OF_A_CHUNK.get(attributes["compression"][0])
    if lines is None:
        raise BadDocument(place, "has a compression that is not read", "write it with ZIP compression")
    for chunk in struct.unpack_from(f"<{-(-height // lines)}Q", data, at):
        size = struct.unpack_from("<i", data, chunk + 4)[0] if chunk < len(data) else -1
        if size < 0 or chunk + 8 + size > len(data):
            raise BadDocument(place, "is cut off", "export it again")
    return width, height


def _attributes(data: bytes) -> tuple[dict[str, bytes], int]:
    """The header's attributes as raw bytes, and where the chunk table begins."""
    found: dict[str, bytes] = {}
    at = 8
    while data[at]:
        name_end = data.index(b"\0", at, at + 256)
        type_end = data.index(b"\0", name_end + 1, name_end + 257)
        size = struct.unpack_from("<i", data, type_end + 1)[0]
        name, begin = data[at:name_end].decode("ascii"), type_end + 5
        if size < 0 or begin + size >= len(data) or name in found or len(found) >= _MOST_ATTRIBUTES:
            raise ValueError(name)
        found[name] = data[begin : begin + size]
        at = begin + size
    if missing := {"dataWindow", "displayWindow", "channels", "compression"} - set(found):
        raise ValueError(missing)
    return found, at + 1


def _channels(raw: bytes) -> dict[str, int]:
    """Channel name: its pixel type; none of them may be subsampled."""
    found: dict[str, int] = {}
    at = 0
    while raw[at]:
        end = raw.index(b"\0", at)
        kind, _, x_step, y_step = struct.unpack_from("<4i", raw, end + 1)
        if (x_step, y_step) != (1, 1) or len(found) >= _MOST_CHANNELS:
            raise ValueError(raw[at:end])
        found[raw[at:end].decode("ascii")] = kind
        at = end + 17
    return found
