"""What a board's two colours and the picture's noise are, measured on its squares, and the best single channel of them.

With D_c the difference of the two colours in channel c (linear light) and v_c the noise variance there, the sum of
channels with weights D_c / v_c has the largest ratio of contrast to noise (noise independent between channels).
Noise is taken from flat places, the middles of squares, with a mask that no plane or slow shading passes:
[1 -2 1] x [1 -2 1], whose output has 36 times the variance of a pixel (Immerkaer, CVIU 64 (1996) 300).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.detect.corner import Signal
from calibration.detect.grid import predict_missing, steps_of
from calibration.image import Transfer, light_table
from calibration.types import FloatArray, Picture

_MIDDLE_SHARE = 0.2
_LARGEST_HALF_PX = 5
_QUANTUM_VARIANCE = 1 / 12  # of a rounded coded value
_SMALLEST_VARIANCE_RATIO = 0.01


def surrounded(points_px: FloatArray) -> FloatArray:
    """A grid (rows, columns, 2) with one more line of expected points on every side, (rows + 2, columns + 2, 2)."""
    grown = np.full((points_px.shape[0] + 2, points_px.shape[1] + 2, 2), np.nan)
    grown[1:-1, 1:-1] = points_px
    for _ in range(2):  # the second pass reaches the four outermost points
        expected = predict_missing(grown)
        grown = np.where(np.isfinite(grown), grown, expected)
    return grown


def measure_signal(picture: Picture, points_px: FloatArray, polarity: int, transfer: Transfer) -> Signal | None:
    """The signal of a board whose inner corners stand near ``points_px`` (rows, columns, 2), all finite.

    ``polarity`` +1: the square between the column and row direction at point (0, 0) is bright. None where the two
    colours cannot be told apart.
    """
    grown = surrounded(points_px)
    centres = (grown[:-1, :-1] + grown[1:, :-1] + grown[:-1, 1:] + grown[1:, 1:]) / 4
    parity = (-1) ** np.add.outer(np.arange(centres.shape[0]), np.arange(centres.shape[1]))
    side = float(np.median(np.linalg.norm(steps_of(points_px), axis=3).min(axis=2)))
    half = int(min(_MIDDLE_SHARE * side, _LARGEST_HALF_PX))
    reach = half + 1
    place = np.rint(centres.reshape(-1, 2))
    bright = (parity.ravel() * polarity) > 0  # grown point (1, 1) is the grid's (0, 0): the same parity
    size = np.array([picture.shape[1], picture.shape[0]])
    inside = ((place >= reach) & (place < size - reach)).all(axis=1)  # False where a place is NaN
    place, bright = place[inside].astype(np.int64), bright[inside]
    if bright.sum() < 2 or (~bright).sum() < 2:
        return None
    offset = np.arange(-reach, reach + 1)
    coded = picture[place[:, 1, None, None] + offset[:, None], place[:, 0, None, None] + offset[None, :]]

    table = light_table(transfer).astype(np.float64)
    light = table[coded]
    flat = light[:, 1:-1, 1:-1].mean(axis=(1, 2))
    dark_level, bright_level = np.median(flat[~bright], axis=0), np.median(flat[bright], axis=0)
    slope = np.gradient(table)
    levels = [np.median(coded[chosen].reshape(-1, 3), axis=0).astype(np.int64) for chosen in (~bright, bright)]
    quantum = [slope[level] ** 2 * _QUANTUM_VARIANCE for level in levels]
    noise = [np.array([_variance(light[chosen][..., channel]) for channel in range(3)]) for chosen in (~bright, bright)]
    variance = (np.maximum(noise[0], quantum[0]) + np.maximum(noise[1], quantum[1])) / 2
    difference = bright_level - dark_level
    weight = difference / np.maximum(variance, 1e-12)
    contrast = float(weight @ difference)
    if not contrast > 0:
        return None
    weight /= contrast
    combined = (light - dark_level) @ weight
    found = [
        max(_variance(combined[chosen]), float(weight**2 @ low))
        for chosen, low in zip((~bright, bright), quantum, strict=True)
    ]
    least = _SMALLEST_VARIANCE_RATIO * max(found)
    tables: NDArray[np.float64] = weight[:, None] * (table[None, :] - dark_level[:, None])
    return Signal(picture, tables.astype(np.float32), max(found[0], least), max(found[1], least))


def _variance(values: FloatArray) -> float:
    """Noise variance of (K, h, w) flat patches, robust to a few that are not flat."""
    across = values[:, :, :-2] - 2 * values[:, :, 1:-1] + values[:, :, 2:]
    passed = ((across[:, :-2] - 2 * across[:, 1:-1] + across[:, 2:]) / 6).ravel()
    scale = 1.4826 * float(np.median(np.abs(passed)))
    if scale > 0:
        passed = np.clip(passed, -4 * scale, 4 * scale)
    return float(np.mean(passed * passed))
