"""Which picture file the capture card should send: its size, what unpacking and decoding cost, what it does to corners.

Each format is fetched from a simulated studio over HTTP, one picture after the other, in both ways: decoded before the
next is asked for, and decoded while the next is on its way. One and the same noisy picture is written in every format
to see how far the format alone moves the corners that are found in it.
"""

from __future__ import annotations

import asyncio
import base64
import statistics
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from app.bootstrap import make_studio
from app.cli.simulated import studio_profile
from benchmarks.rows import Progress, Row
from calibration.detect.target import find_target
from calibration.errors import InvalidInput
from calibration.image import decode_picture
from calibration.types import Detection, FloatArray, Picture, Target, TargetKind
from engine_adapters.mockboard.payload import decode_payload
from engine_adapters.ports import FrameSource, Shown
from engine_adapters.sim.camera_output import PictureFormat, encode_picture
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded

_PICTURES, _QUICK_PICTURES = 40, 6
_PICTURE_TIME_MS = 15.0
_ROUNDS = 3
_SETTLE_S = 0.5
_BOARD = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, colours=("red", "white"))
PLOTS = (
    ("cpu_ms", "processor time to unpack and decode a picture, ms"),
    ("ms_overlapped", "time for a picture, decoded while the next is fetched, ms"),
    ("mib", "size of an answer, MiB"),
)


def run(*, quick: bool = False, progress: Progress | None = None) -> list[Row]:
    """A row for each format: ``mib`` of an answer, ``cpu_ms`` to unpack and decode it, ``ms_in_turn`` and
    ``ms_overlapped`` for a picture, and ``corners_moved_px`` (RMS per coordinate) against the uncompressed file."""
    return asyncio.run(_run(_QUICK_PICTURES if quick else _PICTURES, progress or (lambda share: None)))


async def _run(pictures: int, progress: Progress) -> list[Row]:
    rows: list[Row] = []
    reference: Picture | None = None
    for index, picture_format in enumerate((PictureFormat.BMP, PictureFormat.PNG, PictureFormat.JPEG)):
        row, seen = await _of_format(picture_format, pictures)
        reference = seen if reference is None else reference
        rows.append({"case": "1080p, noise 2/255", "method": picture_format.value} | row)
        progress((index + 1) / 4)
    if reference is not None:
        exact = _corners(reference)
        for row in rows:
            written = bytes(encode_picture(reference, PictureFormat(str(row["method"]))))
            row["corners_moved_px"] = _moved(exact, _corners(decode_picture(written)))
    progress(1.0)
    return rows


async def _of_format(picture_format: PictureFormat, pictures: int) -> tuple[Row, Picture]:
    lens = load_embedded(embedded_lens_names()[0])
    options = (
        "--lens",
        lens.name,
        "--payload-format",
        picture_format.value,
        "--picture-time-ms",
        f"{_PICTURE_TIME_MS}",
    )
    with ThreadPoolExecutor(2, thread_name_prefix="payload") as pool:
        async with launched_studio(options) as addresses:
            studio = make_studio(studio_profile(addresses, lens))
            try:
                await studio.engine.show(Shown.REAL)
                await asyncio.sleep(_SETTLE_S)
                frame = await studio.frames.fetch()
                in_turn, overlapped = [], []
                for _ in range(_ROUNDS):
                    # Round by round, so that a machine that is busy for a while is busy for both.
                    in_turn.append(await _in_turn(studio.frames, pool, pictures))
                    overlapped.append(await _overlapped(studio.frames, pool, pictures))
            finally:
                await studio.close()
    row: Row = {
        "pictures": 2 * _ROUNDS * pictures,
        "mib": len(frame.data) * 4 / 3 / 2**20,
        "cpu_ms": _decode_ms(frame.data, pictures),
        "ms_in_turn": min(in_turn),
        "ms_overlapped": min(overlapped),
    }
    return row, decode_picture(frame.data)


async def _in_turn(frames: FrameSource, pool: ThreadPoolExecutor, pictures: int) -> float:
    """Milliseconds for a picture, each decoded before the next is asked for."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    for _ in range(pictures):
        frame = await frames.fetch()
        await loop.run_in_executor(pool, decode_picture, frame.data)
    return 1000 * (loop.time() - began) / pictures


async def _overlapped(frames: FrameSource, pool: ThreadPoolExecutor, pictures: int) -> float:
    """Milliseconds for a picture, each decoded while the next is on its way."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    decoding: asyncio.Future[Picture] | None = None
    for _ in range(pictures):
        frame = await frames.fetch()
        if decoding is not None:
            await decoding
        decoding = loop.run_in_executor(pool, decode_picture, frame.data)
    if decoding is not None:
        await decoding
    return 1000 * (loop.time() - began) / pictures


def _decode_ms(data: bytes, pictures: int) -> float:
    """Processor time of this thread to unpack the base64 text and decode the file, median."""
    body = base64.b64encode(data)
    times: list[float] = []
    for _ in range(pictures):
        began = time.thread_time()
        decode_picture(decode_payload(body))
        times.append(1000 * (time.thread_time() - began))
    return statistics.median(times)


def _corners(picture: Picture) -> FloatArray:
    found = find_target(picture, _BOARD)
    if not isinstance(found, Detection):
        raise InvalidInput("benchmark picture", found.reason, "the simulated board must be found in it")
    corners = np.full((_BOARD.grid[0] * _BOARD.grid[1], 2), np.nan)
    corners[found.point_ids] = found.points_px
    return corners


def _moved(exact: FloatArray, seen: FloatArray) -> float:
    return float(np.sqrt(np.nanmean((seen - exact) ** 2)))
