"""Pure numerics of lens calibration: arrays and frozen dataclasses in and out.

Nothing in this package knows asyncio, sockets, SQL, pydantic, files, the clock or the environment, but for what
OpenCV and NumPy read only while they are imported, and which therefore stands here, before any module can import them.
"""

import os

MAX_PICTURE_PIXELS = 64_000_000
"""Largest picture that is decoded: an 8K frame is 33 million, anything far beyond is a mistake or an attack."""

# OpenCV's own default admits a 1 MB file that takes 6 GB to decode.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PICTURE_PIXELS))

# The matrices here are small: a linear algebra library that spreads each over threads of its own spends three times as
# long, most of it waiting. Pictures are worked on in parallel instead.
for _variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ.setdefault(_variable, "1")
