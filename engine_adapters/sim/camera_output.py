"""From a frame's state to its picture: rendering with caches, noise, and the capture card's payload."""

from __future__ import annotations

import base64
import time
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.types import Picture
from engine_adapters.sim.optics import View
from engine_adapters.sim.render import render_real, render_virtual
from engine_adapters.sim.room import Room
from engine_adapters.sim.studio import OutputState, Statistics

_SPARE_NOISE = 1 << 20


class PayloadStyle(StrEnum):
    """How the capture card wraps the picture."""

    BARE = "bare"
    JSON = "json"
    DATA_URI = "data_uri"


class PictureFormat(StrEnum):
    """The picture file inside the payload."""

    PNG = "png"
    JPEG = "jpeg"
    BMP = "bmp"


class CameraOutput:
    """Pictures of output states. Not thread-safe: one worker thread owns it.

    A noiseless picture is drawn once for each view (a standing camera gives the same one again); noise is fresh for
    each picture: a window at a random place of a bank of Gaussian noise, rounded, added on the coded values.
    """

    def __init__(self, room: Room, image_size: tuple[int, int], *, seed: int, statistics: Statistics) -> None:
        self._room = room
        self._size = image_size
        self._rng = np.random.default_rng(seed)
        self._statistics = statistics
        self._real = _Drawn()
        self._virtual = _Drawn()
        width, height = image_size
        self._black: Picture = np.zeros((height, width, 3), dtype=np.uint8)
        self._bank = self._rng.standard_normal(width * height * 3 + _SPARE_NOISE, dtype=np.float32)
        self._noise: tuple[float, NDArray[np.uint8], NDArray[np.uint8]] | None = None

    def prepare(self, state: OutputState) -> None:
        """Draw the state's noiseless picture ahead of the request for it.

        It is kept until the next one is prepared: pictures asked for on the way there do not displace it.
        """
        if state.real is not None:
            self._real.ahead = state.real[:2], self._real_picture(*state.real[:2])
            self._noise_parts(state.real[2])
        elif state.virtual is not None:
            self._virtual.ahead = state.virtual, self._virtual_picture(state.virtual)

    def picture(self, state: OutputState) -> Picture:
        """The picture of a state, (H, W, 3) uint8 BGR; not to be written to."""
        if state.real is None:
            return self._black if state.virtual is None else self._virtual_picture(state.virtual)
        view, blur_px, noise_sigma = state.real
        picture = self._noisy(self._real_picture(view, blur_px), noise_sigma)
        return picture if state.virtual is None else render_virtual(state.virtual, self._room, over=picture)

    def payload(self, state: OutputState, style: PayloadStyle, picture_format: PictureFormat) -> bytes:
        """The capture card's answer: the picture as a base64 string, as the style has it."""
        coded = base64.b64encode(encode_picture(self.picture(state), picture_format))
        if style is PayloadStyle.JSON:
            return b'"' + coded + b'"'
        if style is PayloadStyle.DATA_URI:
            return b"data:image/" + picture_format.value.encode() + b";base64," + coded
        return coded

    def _real_picture(self, view: View, blur_px: float) -> Picture:
        picture = self._real.find((view, blur_px))
        if picture is None:
            with _Timed(self._statistics):
                picture = render_real(view, self._room, blur_px)
            self._real.latest = (view, blur_px), picture
        return picture

    def _virtual_picture(self, view: View) -> Picture:
        picture = self._virtual.find(view)
        if picture is None:
            with _Timed(self._statistics):
                picture = render_virtual(view, self._room)
            self._virtual.latest = view, picture
        return picture

    def _noisy(self, picture: Picture, sigma: float) -> Picture:
        if sigma == 0.0:
            return picture
        above, below = self._noise_parts(sigma)
        start = int(self._rng.integers(_SPARE_NOISE))
        window = slice(start, start + picture.size)
        brighter = cv2.add(picture, above[window].reshape(picture.shape))
        return np.asarray(cv2.subtract(brighter, below[window].reshape(picture.shape), dst=brighter), dtype=np.uint8)

    def _noise_parts(self, sigma: float) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The bank at a strength, as what it adds and what it takes (saturating bytes are several times faster)."""
        if self._noise is None or self._noise[0] != sigma:
            rounded = np.rint(self._bank * np.float32(sigma))
            above = np.clip(rounded, 0, 255).astype(np.uint8)
            below = np.clip(-rounded, 0, 255).astype(np.uint8)
            self._noise = sigma, above, below
        return self._noise[1], self._noise[2]


@dataclass(slots=True)
class _Drawn:
    """Noiseless pictures at hand, each with what it was drawn for: the latest, and the one drawn ahead."""

    latest: tuple[object, Picture] | None = None
    ahead: tuple[object, Picture] | None = None

    def find(self, wanted: object) -> Picture | None:
        for kept in (self.latest, self.ahead):
            if kept is not None and kept[0] == wanted:
                return kept[1]
        return None


class _Timed:
    """Counts a render and the processor time of its thread."""

    def __init__(self, statistics: Statistics) -> None:
        self._statistics = statistics

    def __enter__(self) -> None:
        self._began = time.thread_time()

    def __exit__(self, *_: object) -> None:
        self._statistics.renders += 1
        self._statistics.render_ms_total += (time.thread_time() - self._began) * 1000.0


def encode_picture(picture: Picture, picture_format: PictureFormat) -> memoryview:
    """The picture as a file."""
    options = {
        PictureFormat.PNG: [cv2.IMWRITE_PNG_COMPRESSION, 1],
        # Full colour resolution: halved, it would blur every red edge.
        PictureFormat.JPEG: [
            cv2.IMWRITE_JPEG_QUALITY,
            95,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
        ],
        PictureFormat.BMP: [],
    }[picture_format]
    done, data = cv2.imencode("." + picture_format.value, picture, options)
    if not done:
        raise RuntimeError(f"the {picture_format} encoder failed")
    return np.asarray(data, dtype=np.uint8).reshape(-1).data
