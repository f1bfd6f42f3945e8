"""Light and coded values: the simulated camera's transfer curve (BT.709) and packed pixels."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

LightArray = NDArray[np.float32]
Colour = tuple[int, int, int]

_STEPS = 65536


@cache
def _code_table() -> NDArray[np.uint8]:
    """Coded value 0..255 for light 0..1 in 65536 steps (ITU-R BT.709-6, item 1.2)."""
    light = np.arange(_STEPS) / (_STEPS - 1)
    coded = np.where(light < 0.018, 4.5 * light, 1.099 * np.power(light, 0.45) - 0.099)
    return np.asarray(np.rint(coded * 255.0), dtype=np.uint8)


@cache
def _light_table() -> LightArray:
    coded = np.arange(256) / 255.0
    light = np.where(coded < 4.5 * 0.018, coded / 4.5, ((coded + 0.099) / 1.099) ** (1 / 0.45))
    return np.asarray(light, dtype=np.float32)


def light_of(coded: NDArray[np.uint8]) -> LightArray:
    """Light 0..1 of coded values (any shape)."""
    return np.asarray(_light_table()[coded], dtype=np.float32)


def light_of_colour(colour: Colour) -> LightArray:
    """Light (3,) of a coded colour."""
    return light_of(np.array(colour, dtype=np.uint8))


def code(light: LightArray) -> NDArray[np.uint8]:
    """Coded values of light (any shape), rounded; light outside 0..1 is clipped."""
    steps = np.clip(light, np.float32(0.0), np.float32(1.0)) * np.float32(_STEPS - 1) + np.float32(0.5)
    return _code_table()[steps.astype(np.uint16)]


def pack(coded: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours (N, 3) uint8 as one little-endian BGRA word each (N,)."""
    words = coded.astype(np.uint32)
    packed = words[:, 0] | words[:, 1] << 8 | words[:, 2] << 16
    return np.asarray(packed | np.uint32(0xFF000000), dtype=np.uint32)


def unpack(words: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """The colours (N, 3) uint8 of BGRA words (N,)."""
    return np.ascontiguousarray(words).view(np.uint8).reshape(-1, 4)[:, :3]


def blend(under: NDArray[np.uint32], light: LightArray, share: LightArray) -> NDArray[np.uint32]:
    """BGRA words (N,) of ``share`` (N,) 0..1 of a light (N, 3) over packed pixels (N,)."""
    packed = np.full(len(under), 0xFF000000, dtype=np.uint32)
    for channel, shift in enumerate((0, 8, 16)):
        below = _light_table().take((under >> shift) & 0xFF)
        coded = code(below + (light[:, channel] - below) * share)
        packed |= coded.astype(np.uint32) << np.uint32(shift)
    return packed
