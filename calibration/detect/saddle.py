"""Coarse search: points of a picture where four alternating quadrants meet.

On a smoothed picture I the corner of a chessboard is a saddle: the Hessian's determinant is negative. The measure is
S = Lxy^2 - Lxx Lyy (its negative), which is about 0 on straight edges and below 0 on blobs. Around each maximum of S a
ring of samples I(t) is taken; on a corner its second harmonic A cos 2(t - phase) holds most of the ring's variation
(8 / pi^2 = 0.81 for a sharp right-angled corner), on an edge or an outline's corner the first harmonic does.
The idea of the ring: Bennett and Lasenby, ChESS, CVIU 118 (2014).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.types import FloatArray, IntArray, Picture

Gray = NDArray[np.float32]

RING_RADIUS_PX = 3.0
RING_SAMPLES = 16
MOST_CANDIDATES = 1500
_SECOND_HARMONIC_SHARE = 0.55
_EIGENVALUE_RATIO = 0.08  # tan^2 of half the sharpest angle (about 32 deg) between a board's two edge directions
_NOISE_FACTOR = 6.0
_PEAK_REACH_PX = 2
_RING_ANGLES = 2 * np.pi * np.arange(RING_SAMPLES) / RING_SAMPLES


@dataclass(frozen=True, slots=True, eq=False)
class Saddles:
    """Corner candidates in one reduced picture.

    ``points`` (M, 2) in reduced pixels; ``phase`` (M,) radians, direction of the bright diagonal (from u towards v,
    modulo pi); ``amplitude`` (M,) of the ring's second harmonic in coded values. ``weak`` (K, 2): every local maximum
    of the saddle measure above the noise, the ring not asked. ``gray`` the smoothed reduced picture.
    """

    points: FloatArray
    phase: FloatArray
    amplitude: FloatArray
    weak: FloatArray
    gray: Gray


def sample(gray: Gray, points: FloatArray) -> FloatArray:
    """Values of ``gray`` at ``points`` (..., 2), bilinear, the border's value outside; good for decisions only."""
    flat = points.reshape(-1, 2).astype(np.float32)
    values = np.empty(len(flat), dtype=np.float64)
    block = 30000  # remap takes maps of less than 32768 rows
    for start in range(0, len(flat), block):
        part = flat[start : start + block]
        result = cv2.remap(gray, part[:, 0], part[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values[start : start + block] = result.ravel()
    return values.reshape(points.shape[:-1])


def reduce_picture(picture: Picture, factor: int) -> Picture:
    """The picture at 1/``factor`` (a power of two) of its size, each pixel the mean of factor x factor pixels."""
    while factor > 1:
        height, width = picture.shape[0] // 2, picture.shape[1] // 2
        whole = picture[: 2 * height, : 2 * width]
        picture = np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        factor //= 2
    return picture


def _one_of_each_plateau(peaks: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Rows and columns of the peaks less those within reach of an earlier one: such two are equal to the last bit.

    A corner half way between pixels of a picture without noise is so symmetric that two or four pixels around it
    share the maximum; each would then link a grid of its own. No peak may be nearer to the border than the reach.
    """
    rows, columns = np.nonzero(peaks)
    repeated = np.zeros(len(rows), dtype=bool)
    for down in range(-_PEAK_REACH_PX, 1):
        for right in range(-_PEAK_REACH_PX, _PEAK_REACH_PX + 1 if down < 0 else 0):
            repeated |= peaks[rows + down, columns + right]
    return rows[~repeated], columns[~repeated]


def find_saddles(gray: Gray) -> Saddles:
    """Corner candidates of ``gray`` (H, W) float32, coded values."""
    smooth = np.asarray(cv2.GaussianBlur(gray, (0, 0), 1.0), dtype=np.float32)
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    measure = xy * xy - xx * yy
    noise = float(np.median(np.abs(xy[::3, ::3]))) * 1.4826
    floor = (_NOISE_FACTOR * max(noise, 0.02)) ** 2
    peak = cv2.dilate(measure, np.ones((2 * _PEAK_REACH_PX + 1,) * 2, np.uint8))
    mask = (measure >= peak) & (measure > floor)
    border = _PEAK_REACH_PX
    mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = False, False, False, False
    rows, columns = _one_of_each_plateau(mask)
    if len(rows) > 4 * MOST_CANDIDATES:
        order = np.argsort(-measure[rows, columns], kind="stable")[: 4 * MOST_CANDIDATES]
        rows, columns = rows[order], columns[order]
    h_xx, h_yy, h_xy = (part[rows, columns].astype(np.float64) for part in (xx, yy, xy))
    g_x = (smooth[rows, columns + 1].astype(np.float64) - smooth[rows, columns - 1]) / 2
    g_y = (smooth[rows + 1, columns].astype(np.float64) - smooth[rows - 1, columns]) / 2
    determinant = h_xx * h_yy - h_xy * h_xy  # below -floor, so never 0
    step = np.column_stack([-(h_yy * g_x - h_xy * g_y) / determinant, -(h_xx * g_y - h_xy * g_x) / determinant])
    points = np.column_stack([columns, rows]) + np.clip(step, -1.0, 1.0)

    trace = h_xx + h_yy
    root = np.sqrt(trace * trace / 4 - determinant)
    large, small = np.abs(trace) / 2 + root, root - np.abs(trace) / 2
    keep = (small > _EIGENVALUE_RATIO * large) & (np.abs(step).max(axis=1, initial=0.0) < 1.5)
    points, weak = points[keep], points
    if not len(points):
        return Saddles(points, np.zeros(0), np.zeros(0), weak, smooth)

    ring = points[:, None, :] + RING_RADIUS_PX * np.column_stack([np.cos(_RING_ANGLES), np.sin(_RING_ANGLES)])
    spectrum = np.fft.rfft(sample(smooth, ring), axis=1)
    energy = np.abs(spectrum[:, 1:]) ** 2
    share = energy[:, 1] / np.maximum(energy.sum(axis=1), 1e-9)
    amplitude = 2 * np.abs(spectrum[:, 2]) / RING_SAMPLES
    phase = -np.angle(spectrum[:, 2]) / 2
    chosen = np.nonzero(share > _SECOND_HARMONIC_SHARE)[0]
    if len(chosen) > MOST_CANDIDATES:
        chosen = chosen[np.argsort(-amplitude[chosen], kind="stable")[:MOST_CANDIDATES]]
    return Saddles(points[chosen], phase[chosen], amplitude[chosen], weak, smooth)
