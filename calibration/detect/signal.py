"""What a board's two colours and the picture's noise are, measured on its squares, and the best single channel of them.

With D_c the difference of the two colours in channel c (linear light) and v_c the noise variance there, the sum of
channels with weights D_c / v_c has the largest ratio of contrast to noise (noise independent between channels).
Noise is taken from flat places, the middles of squares, with a mask that no plane or slow shading passes:
[1 -2 1] x [1 -2 1], whose output has 36 times the variance of a pixel (Immerkaer, CVIU 64 (1996) 300).

The squares also show how the light falls over the board: each colour's level is a quadratic in column and row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.detect.grid import predict_missing, steps_of
from calibration.detect.windows import Shading, Signal
from calibration.image import Transfer, light_table
from calibration.types import FloatArray, Picture

_MIDDLE_SHARE = 0.2
_LARGEST_HALF_PX = 4
_QUANTUM_VARIANCE = 1 / 12  # of a rounded coded value
_SMALLEST_VARIANCE_RATIO = 0.01
_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_LEAST_GAIN = 0.1
"""Of the board's: local contrast read from the squares is not trusted below this."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardLight:
    """``signal`` and how it falls over the board at its corners, in the order of the grid's points: ``offset`` (N,)
    middle of the two colours, ``gain`` (N,) half their difference, > 0; ``per_step`` (N, 2, 2): change, relative to the
    gain, of offset [:, 0] and gain [:, 1] from a column and a row to the next.
    """

    signal: Signal
    offset: FloatArray
    gain: FloatArray
    per_step: FloatArray

    def shading(self, steps_px: FloatArray) -> Shading:
        """The changes per pixel, with the grid's ``steps_px`` (N, 2, 2)."""
        inverse = np.linalg.inv(steps_px)  # [pixel axis, step]
        change = np.einsum("nps,nks->nkp", inverse, self.per_step)
        return Shading(self.offset, change[:, 0] * self.gain[:, None], change[:, 1])


def surrounded(points_px: FloatArray) -> FloatArray:
    """A grid (rows, columns, 2) with one more line of expected points on every side, (rows + 2, columns + 2, 2)."""
    grown = np.full((points_px.shape[0] + 2, points_px.shape[1] + 2, 2), np.nan)
    grown[1:-1, 1:-1] = points_px
    for _ in range(2):  # the second pass reaches the four outermost points
        expected = predict_missing(grown)
        grown = np.where(np.isfinite(grown), grown, expected)
    return grown


def measure_signal(picture: Picture, points_px: FloatArray, polarity: int, transfer: Transfer) -> BoardLight | None:
    """The signal of a board whose inner corners stand near ``points_px`` (rows, columns, 2).

    ``polarity`` +1: the square between the column and row direction at point (0, 0) is bright. None where the two
    colours cannot be told apart.
    """
    grown = surrounded(points_px)
    centres = (grown[:-1, :-1] + grown[1:, :-1] + grown[:-1, 1:] + grown[1:, 1:]) / 4
    rows, columns = centres.shape[:2]
    place = np.column_stack([np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)])
    side = float(np.nanmedian(np.linalg.norm(steps_of(points_px), axis=3).min(axis=2)))
    half = int(min(_MIDDLE_SHARE * side, _LARGEST_HALF_PX))
    reach = half + 1
    middle = np.rint(centres.reshape(-1, 2))
    height, width = picture.shape[:2]
    inside = ((middle >= reach) & (middle < np.array([width, height]) - reach)).all(axis=1)  # False where NaN
    middle, place = middle[inside].astype(np.int64), place[inside]
    bright = (place.sum(axis=1) % 2 == 0) == (polarity > 0)  # grown point (1, 1) is the grid's (0, 0): the same parity
    if bright.sum() < 2 or (~bright).sum() < 2:
        return None
    offset = np.arange(-reach, reach + 1)
    index = (middle[:, 1] * width + middle[:, 0])[:, None, None] + (offset[:, None] * width + offset[None, :])
    coded = picture.reshape(-1, 3).take(index.ravel(), axis=0).reshape(len(middle), len(offset), len(offset), 3)
    table = light_table(transfer)
    light = table.take(coded)
    flat = light[:, 1:-1, 1:-1].mean(axis=(1, 2), dtype=np.float64)
    levels = np.stack([np.median(flat[~bright], axis=0), np.median(flat[bright], axis=0)])
    slope = np.gradient(table.astype(np.float64))
    code = np.minimum(np.searchsorted(table, levels), 255)
    quantum = slope[code] ** 2 * _QUANTUM_VARIANCE  # (2, 3)
    passed = _passed(light)
    noise = np.stack([_clipped_square(passed[chosen]) for chosen in (~bright, bright)])
    variance = np.maximum(noise, quantum).mean(axis=0)
    difference = levels[1] - levels[0]
    weight = difference / np.maximum(variance, 1e-12)
    contrast = float(weight @ difference)
    if not contrast > 0:
        return None
    weight /= contrast
    combined = passed @ weight.astype(np.float32)
    found = [
        max(float(_clipped_square(combined[chosen][..., None])[0]), float(weight**2 @ low))
        for chosen, low in zip((~bright, bright), quantum, strict=True)
    ]
    least = _SMALLEST_VARIANCE_RATIO * max(found)
    tables: NDArray[np.float64] = weight[:, None] * (table.astype(np.float64)[None, :] - levels[0][:, None])
    signal = Signal(picture, tables.astype(np.float32), max(found[0], least), max(found[1], least))
    return _spread(signal, (flat - levels[0]) @ weight, place, bright, points_px.shape)


def _passed(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """(K, h, w, C) flat patches through the mask, one variance of a pixel each."""
    across = light[:, :, :-2] + light[:, :, 2:]
    across -= 2 * light[:, :, 1:-1]
    down = across[:, :-2] + across[:, 2:]
    down -= 2 * across[:, 1:-1]
    down /= 6
    return np.asarray(down)


def _clipped_square(passed: NDArray[np.float32]) -> FloatArray:
    """Mean square of each channel of (K, h, w, C), robust to a few patches that are not flat."""
    values = passed.reshape(-1, passed.shape[-1])
    scale = 1.4826 * np.median(np.abs(values[:: 1 + len(values) // 1500]), axis=0)
    limit = np.where(scale > 0, 4 * scale, np.inf).astype(np.float32)
    values = np.clip(values, -limit, limit)
    return np.asarray(np.einsum("kc,kc->c", values, values, dtype=np.float64) / len(values))


def _spread(
    signal: Signal, level: FloatArray, place: NDArray[np.int64], bright: NDArray[np.bool_], shape: tuple[int, ...]
) -> BoardLight:
    """Quadratics through each colour's ``level`` (K,), at the corners between the squares at ``place``."""
    rows, columns = shape[:2]
    size = np.array([columns, rows], dtype=np.float64)
    # Square (c, r) has its middle half a step before corner (c, r): corners count from 0.5 in the squares' steps.
    corners = np.column_stack([np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)]) + 0.5
    scaled, at = (2 * place - size) / size, (2 * corners - size) / size
    value, slope = [], []
    for chosen in (~bright, bright):
        terms = _basis(scaled[chosen])
        terms = terms[:, : 6 if len(terms) >= 12 else 3 if len(terms) >= 6 else 1]
        known = level[chosen]
        kept = np.ones(len(known), dtype=bool)
        for _ in range(2):  # a square that is covered must not bend the rest
            solved = np.linalg.lstsq(terms[kept], known[kept], rcond=None)[0]
            away = np.abs(known - terms @ solved)
            kept = away <= max(4 * float(np.median(away)), 1e-9)
        solved = np.concatenate([solved, np.zeros(6 - len(solved))])
        value.append(_basis(at) @ solved)
        slope.append(np.column_stack([along @ solved for along in _slopes(at)]) * 2 / size)
    gain = np.maximum((value[1] - value[0]) / 2, _LEAST_GAIN)
    change = np.stack([slope[1] + slope[0], slope[1] - slope[0]], axis=1) / 2
    return BoardLight(signal, (value[0] + value[1]) / 2, gain, change / gain[:, None, None])


def _basis(at: FloatArray) -> FloatArray:
    return np.column_stack([at[:, 0] ** i * at[:, 1] ** j for i, j in _POWERS])


def _slopes(at: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y, zero, one = at[:, 0], at[:, 1], np.zeros(len(at)), np.ones(len(at))
    return (
        np.column_stack([zero, one, zero, 2 * x, y, zero]),
        np.column_stack([zero, zero, one, zero, x, 2 * y]),
    )
