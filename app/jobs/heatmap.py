"""A map of overlay error over the picture, with its colour bar, for people."""

from __future__ import annotations

import math

import cv2
import numpy as np

from calibration.types import FloatArray, Picture

_MAP_WIDTH = 960
_BAR_WIDTH, _BAR_GAP, _LABELS_WIDTH = 26, 24, 148
_MARGIN, _FOOT = 12, 52
_STEPS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_PAPER, _INK = (255, 255, 255), (58, 48, 42)
_UNREACHED, _INFINITE = (225, 225, 225), (40, 40, 200)
# Grey: no ray reaches the pixel, nothing to say. Red: the lens cannot draw it at all; viridis has neither.


def scale_end_px(largest_px: float) -> float:
    """The end of a colour bar: the next of a few round steps times a power of ten, at least 1e-4."""
    if not math.isfinite(largest_px) or largest_px <= 1e-4:
        return 1e-4
    decade = 10.0 ** math.floor(math.log10(largest_px))
    return float(next(step for step in _STEPS if step * decade >= largest_px * (1 - 1e-9)) * decade)


def heat_map(map_px: FloatArray, image_size: tuple[int, int], end_px: float | None = None) -> Picture:
    """The map (rows, columns) of px, first and last samples on the picture's outermost pixels, as a picture (BGR).

    Colours are viridis (readable without colour vision) from 0 to ``end_px``, else to :func:`scale_end_px` of the
    largest finite value. NaN (no ray there) is grey, infinity (the lens folds there) red. A ring marks the largest
    value; the foot says it.
    """
    width, height = image_size
    map_height = max(round(_MAP_WIDTH * height / width), 120)
    finite = map_px[np.isfinite(map_px)]
    end = end_px or scale_end_px(float(finite.max()) if finite.size else 0.0)
    canvas = np.full(
        (map_height + _MARGIN + _FOOT, _MARGIN + _MAP_WIDTH + _BAR_GAP + _BAR_WIDTH + _LABELS_WIDTH, 3),
        _PAPER,
        dtype=np.uint8,
    )
    canvas[_MARGIN : _MARGIN + map_height, _MARGIN : _MARGIN + _MAP_WIDTH] = _coloured(map_px, end, map_height)
    _bar(canvas, end, map_height)
    _foot(canvas, map_px, image_size, map_height)
    return canvas


def _coloured(map_px: FloatArray, end: float, map_height: int) -> Picture:
    rows, columns = map_px.shape
    # Values are interpolated, not colours; corner samples stay in the corners.
    u = np.tile(np.linspace(0, columns - 1, _MAP_WIDTH, dtype=np.float32), (map_height, 1))
    v = np.tile(np.linspace(0, rows - 1, map_height, dtype=np.float32)[:, None], (1, _MAP_WIDTH))
    known = np.where(np.isfinite(map_px), map_px, 0.0).astype(np.float32)
    smooth = cv2.remap(known, u, v, cv2.INTER_LINEAR)
    levels = np.asarray(np.clip(smooth / end, 0, 1) * 255 + 0.5, dtype=np.uint8)
    coloured = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    for where, colour in ((np.isnan(map_px), _UNREACHED), (np.isinf(map_px), _INFINITE)):
        if where.any():
            mask = cv2.remap(where.astype(np.float32), u, v, cv2.INTER_NEAREST) > 0.5
            coloured[mask] = colour
    return coloured


def _bar(canvas: Picture, end: float, map_height: int) -> None:
    left = _MARGIN + _MAP_WIDTH + _BAR_GAP
    ramp = np.linspace(255, 0, map_height).round().astype(np.uint8)[:, None]
    bar = np.asarray(cv2.applyColorMap(np.tile(ramp, (1, _BAR_WIDTH)), cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    canvas[_MARGIN : _MARGIN + map_height, left : left + _BAR_WIDTH] = bar
    for share in (0.0, 0.5, 1.0):
        y = _MARGIN + round((1 - share) * (map_height - 1))
        cv2.line(canvas, (left + _BAR_WIDTH, y), (left + _BAR_WIDTH + 6, y), _INK, 1, cv2.LINE_AA)
        baseline = min(max(y + 9, _MARGIN + 21), _MARGIN + map_height)
        text = "0" if share == 0 else f"{share * end:.3g} px"
        _text(canvas, text, (left + _BAR_WIDTH + 12, baseline))


def _foot(canvas: Picture, map_px: FloatArray, image_size: tuple[int, int], map_height: int) -> None:
    baseline = _MARGIN + map_height + 34
    infinite = float(np.mean(np.isinf(map_px)))
    finite = np.where(np.isfinite(map_px), map_px, -1.0)
    row, column = np.unravel_index(int(np.argmax(finite)), map_px.shape)
    largest = float(finite[row, column])
    if largest < 0:
        _text(canvas, "nothing in the picture can be compared", (_MARGIN, baseline))
        return
    share_u, share_v = column / (map_px.shape[1] - 1), row / (map_px.shape[0] - 1)
    at = (round(share_u * (image_size[0] - 1)), round(share_v * (image_size[1] - 1)))
    centre = (_MARGIN + round(share_u * (_MAP_WIDTH - 1)), _MARGIN + round(share_v * (map_height - 1)))
    for colour, thickness in ((_INK, 5), (_PAPER, 2)):
        cv2.circle(canvas, centre, 9, colour, thickness, cv2.LINE_AA)
    text = f"ring: largest, {_digits(largest)} px at pixel ({at[0]}, {at[1]})"
    if infinite > 0:
        text += f"; red: cannot be drawn at all ({infinite:.0%} of the picture)"
    _text(canvas, text, (_MARGIN, baseline))


def _digits(value: float) -> str:
    return f"{value:.4f}" if value < 0.1 else f"{value:.3g}"


def _text(canvas: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.9, _INK, 1, cv2.LINE_AA)
