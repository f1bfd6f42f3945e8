"""Pure numerics of lens calibration: arrays and frozen dataclasses in and out.

Nothing in this package knows asyncio, sockets, SQL, pydantic, files, the clock or the environment, but for one
bound that OpenCV reads only while it is imported, and which therefore stands here, before any module can import it.
"""

import os

MAX_PICTURE_PIXELS = 64_000_000
"""Largest picture that is decoded: an 8K frame is 33 million, anything far beyond is a mistake or an attack."""

# OpenCV's own default admits a 1 MB file that takes 6 GB to decode.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PICTURE_PIXELS))
