"""Which pixels a corner's fit looks at, and their light: two strips along its two edges.

Away from the edges a pixel tells nothing about the place of the corner, so a strip is as wide as the blur: as arrays
(corner, place along, place across) it needs no search for pixels. A blur of several pixels is fitted on a picture
reduced by whole factors, each value the mean of that many pixels' light: the box of the larger pixel widens the blur a
little (its information falls by about the same share), and there are the square of the factor fewer values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.types import FloatArray, IntArray, Picture

Pixels = NDArray[np.float32]

PIXEL_VARIANCE_PX2 = 1 / 12
SHARPEST_SIGMA_PX = 0.25
WINDOW_SHARE = 0.45
"""A pixel belongs to a corner's window within this share of a square along both of the board's directions."""


@dataclass(frozen=True, slots=True, eq=False)
class CornerState:
    """The parameters of N corners: ``points_px`` (N, 2), ``angles`` (N, 2) radians; the others (N,)."""

    points_px: FloatArray
    angles: FloatArray
    sigma_px: FloatArray
    offset: FloatArray
    gain: FloatArray

    def of(self, which: IntArray) -> CornerState:
        """Some of the corners."""
        return CornerState(
            self.points_px[which], self.angles[which], self.sigma_px[which], self.offset[which], self.gain[which]
        )

    def put(self, which: IntArray, new: CornerState) -> None:
        """Replace some of the corners, in place."""
        self.points_px[which], self.angles[which], self.sigma_px[which] = new.points_px, new.angles, new.sigma_px
        self.offset[which], self.gain[which] = new.offset, new.gain

    def copy(self) -> CornerState:
        """Arrays of its own."""
        return CornerState(
            self.points_px.copy(), self.angles.copy(), self.sigma_px.copy(), self.offset.copy(), self.gain.copy()
        )


class Plane(Protocol):
    """A picture of one number a pixel: ``size`` (width, height) of its pixels, each ``pixel_px`` wide, the first one's
    corner at ``origin_px`` of the whole picture's; ``variance_dark``, ``variance_bright`` its noise where it is 0, 1.
    """

    @property
    def size(self) -> tuple[int, int]: ...

    @property
    def pixel_px(self) -> int: ...

    @property
    def origin_px(self) -> tuple[int, int]: ...

    @property
    def variance_dark(self) -> float: ...

    @property
    def variance_bright(self) -> float: ...

    def at(self, index: NDArray[np.int32]) -> Pixels:
        """Values at ``row * width + column``."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """A board's light as one number a pixel: I = sum of ``tables[c][picture[..., c]]``, dark squares 0, bright ones 1.

    ``tables`` (3, 256) float32. The noise variance of I is linear in I, ``variance_dark`` at 0 and ``variance_bright``
    at 1: so it is for photon noise, and nearly so for equal noise on coded values.
    """

    picture: Picture
    tables: Pixels
    variance_dark: float
    variance_bright: float

    @property
    def size(self) -> tuple[int, int]:
        return self.picture.shape[1], self.picture.shape[0]

    @property
    def pixel_px(self) -> int:
        return 1

    @property
    def origin_px(self) -> tuple[int, int]:
        return 0, 0

    def at(self, index: NDArray[np.int32]) -> Pixels:
        """Values at ``row * width + column``."""
        flat = self.picture.reshape(-1)
        first = index * np.int32(3)
        light = self.tables[0].take(flat.take(first))
        light += self.tables[1].take(flat[1:].take(first))
        light += self.tables[2].take(flat[2:].take(first))
        return np.asarray(light)

    def reduced(self, factor: int, low_px: FloatArray, high_px: FloatArray) -> Reduced:
        """The light between two corners of a box, each value the mean of ``factor`` x ``factor`` pixels."""
        left, top = (max(int(low // factor), 0) * factor for low in low_px)
        columns, rows = (
            max(min(int(np.ceil(high)), side) - start, 0) // factor
            for high, side, start in zip(high_px, self.size, (left, top), strict=True)
        )
        if not columns or not rows:
            return Reduced(np.zeros((1, 1), dtype=np.float32), factor, (left, top), 1.0, 1.0)
        part = self.picture[top : top + rows * factor, left : left + columns * factor]
        light = cv2.transform(cv2.LUT(part, self.tables.T.reshape(1, 256, 3)), np.ones((1, 3), dtype=np.float32))
        light = cv2.resize(light, (columns, rows), interpolation=cv2.INTER_AREA)
        count = factor * factor
        return Reduced(
            np.asarray(light, dtype=np.float32),
            factor,
            (left, top),
            self.variance_dark / count,
            self.variance_bright / count,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """A :class:`Plane` with its values at hand: ``values`` (H, W) float32."""

    values: Pixels
    pixel_px: int
    origin_px: tuple[int, int]
    variance_dark: float
    variance_bright: float

    @property
    def size(self) -> tuple[int, int]:
        return self.values.shape[1], self.values.shape[0]

    def at(self, index: NDArray[np.int32]) -> Pixels:
        """Values at ``row * width + column``."""
        return self.values.reshape(-1).take(index)


@dataclass(frozen=True, slots=True, eq=False)
class Shading:
    """How the light falls at N corners: ``offset`` (N,) and, per pixel, the change of the ``offset`` and the relative
    change of the gain, (N, 2) each.
    """

    offset: FloatArray
    offset_per_px: FloatArray
    gain_per_px: FloatArray

    def of(self, which: IntArray) -> Shading:
        """Some of the corners."""
        return Shading(self.offset[which], self.offset_per_px[which], self.gain_per_px[which])


def to_plane(plane: Plane, state: CornerState) -> CornerState:
    """``state`` in the plane's own pixels; the box of its pixel is part of the blur."""
    points = (state.points_px + 0.5 - np.array(plane.origin_px)) / plane.pixel_px - 0.5
    blur = np.maximum(state.sigma_px**2 - PIXEL_VARIANCE_PX2, 0.0) / plane.pixel_px**2 + PIXEL_VARIANCE_PX2
    return CornerState(points, state.angles, np.maximum(np.sqrt(blur), SHARPEST_SIGMA_PX), state.offset, state.gain)


def from_plane(plane: Plane, state: CornerState) -> CornerState:
    """The inverse of :func:`to_plane`."""
    points = (state.points_px + 0.5) * plane.pixel_px - 0.5 + np.array(plane.origin_px)
    blur = np.maximum(state.sigma_px**2 - PIXEL_VARIANCE_PX2, 0.0) * plane.pixel_px**2 + PIXEL_VARIANCE_PX2
    sigma = np.sqrt(blur) if plane.pixel_px > 1 else state.sigma_px
    return CornerState(points, state.angles, sigma, state.offset, state.gain)


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The pixels of N corners, P for each: ``values`` light, ``used`` 1 or 0, ``du``, ``dv`` offsets from the
    ``centres`` (N, 2), whole pixels of the plane. All others (N, P).
    """

    values: Pixels
    used: Pixels
    centres: FloatArray
    du: Pixels
    dv: Pixels
    variance_dark: float
    variance_bright: float

    def of(self, which: IntArray) -> Windows:
        """The windows of some of the corners, in order; all of them without a copy."""
        if len(which) == len(self.centres):
            return self
        return Windows(
            self.values[which],
            self.used[which],
            self.centres[which],
            self.du[which],
            self.dv[which],
            self.variance_dark,
            self.variance_bright,
        )

    def block(self, start: int, stop: int) -> Windows:
        """Neighbouring corners, as views."""
        part = slice(start, stop)
        return Windows(
            self.values[part],
            self.used[part],
            self.centres[part],
            self.du[part],
            self.dv[part],
            self.variance_dark,
            self.variance_bright,
        )


def strip_windows(
    plane: Plane,
    state: CornerState,
    steps_px: FloatArray,
    half_px: float,
    band_px: float,
    shading: Shading | None = None,
) -> Windows:
    """Strips ``band_px`` to either side of the edges of ``state``, ``half_px`` long from the corner, within
    ``WINDOW_SHARE`` of a square. All in the plane's pixels; ``steps_px`` (N, 2, 2): vectors to the next corner along
    columns and along rows. The ``shading`` is taken off the values: left in, it would move a corner.
    """
    count = len(state.points_px)
    centres = np.rint(state.points_px)
    local = state.points_px - centres
    cos, sin = np.cos(state.angles), np.sin(state.angles)
    level = np.abs(cos) >= np.abs(sin)  # (N, 2): the strip runs along pixel rows
    slope = np.where(level, sin, cos) / np.where(level, cos, sin)
    shift = np.where(level, local[:, 1:] - slope * local[:, :1], local[:, :1] - slope * local[:, 1:])
    lengths = np.linalg.norm(steps_px, axis=2)
    longest = np.minimum(half_px, WINDOW_SHARE * lengths) * np.maximum(np.abs(cos), np.abs(sin))
    reach = max(int(np.ceil(longest.max(initial=1.0))), 2)
    widest = band_px / float(np.maximum(np.abs(cos), np.abs(sin)).min(initial=1.0))
    wide = max(int(np.ceil(widest)), 1)

    # (N, edge, across, along): numpy is quick where the last axis is long.
    along = np.arange(-reach, reach + 1, dtype=np.float32)
    middle = np.rint(slope[:, :, None] * along + shift[:, :, None]).astype(np.float32)  # (N, 2, K)
    across = middle[:, :, None, :] + np.arange(-wide, wide + 1, dtype=np.float32)[:, None]
    du, dv = across.copy(), across
    for edge in (0, 1):
        du[level[:, edge], edge] = along
        dv[~level[:, edge], edge] = along
    each = across.shape[2] * across.shape[3]
    du, dv = du.reshape(count, 2 * each), dv.reshape(count, 2 * each)

    determinant = steps_px[:, 0, 0] * steps_px[:, 1, 1] - steps_px[:, 0, 1] * steps_px[:, 1, 0]
    adjugate = np.stack([steps_px[:, 1, 1], -steps_px[:, 1, 0], -steps_px[:, 0, 1], steps_px[:, 0, 0]])
    inverse = (adjugate / (determinant * WINDOW_SHARE)).astype(np.float32)[:, :, None]
    used = np.ones(du.shape, dtype=bool)
    for k in (0, 2):
        place = inverse[k] * du
        place += inverse[k + 1] * dv
        place -= (inverse[k, :, 0] * local[:, 0] + inverse[k + 1, :, 0] * local[:, 1]).astype(np.float32)[:, None]
        used &= np.abs(place, out=place) <= 1
    by_edge = used.reshape(count, 2, each // len(along), len(along))
    by_edge &= (np.abs(along) <= longest[..., None] + 0.5)[:, :, None, :]
    # A pixel of both strips counts once.
    first = level[:, :1]
    first_along = np.where(first, du[:, each:], dv[:, each:])
    line = first_along * slope[:, :1].astype(np.float32)
    line += shift[:, :1].astype(np.float32)
    np.rint(line, out=line)
    line -= np.where(first, dv[:, each:], du[:, each:])
    twice = np.abs(line, out=line) <= wide
    twice &= np.abs(first_along, out=first_along) <= longest[:, :1] + 0.5
    used[:, each:] &= ~twice

    width, height = plane.size
    u = du + centres[:, :1].astype(np.float32)
    v = dv + centres[:, 1:].astype(np.float32)
    low, high = centres.min(axis=0, initial=0) - reach - 1, centres.max(axis=0, initial=0) + reach + 1
    if low.min() < reach or high[0] > width - 1 - reach or high[1] > height - 1 - reach:
        used &= (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        np.clip(u, 0, width - 1, out=u)
        np.clip(v, 0, height - 1, out=v)
    index = v.astype(np.int32)
    index *= np.int32(width)
    index += u.astype(np.int32)
    values = plane.at(index)
    if shading is not None:
        _flatten(values, du, dv, local, shading, plane.pixel_px)
    return Windows(
        values,
        used.astype(np.float32),
        centres,
        du,
        dv,
        plane.variance_dark,
        plane.variance_bright,
    )


def _flatten(values: Pixels, du: Pixels, dv: Pixels, local: FloatArray, shading: Shading, pixel_px: int) -> None:
    """I - (o' + g'/g (I - o)) r, in place: what would be seen with the light of the corner's place all over."""
    offset = shading.offset.astype(np.float32)[:, None]
    offset_change = (shading.offset_per_px * pixel_px).astype(np.float32)
    gain_change = (shading.gain_per_px * pixel_px).astype(np.float32)
    from_offset = values - offset
    change = np.zeros_like(values)
    for axis, way in ((0, du), (1, dv)):
        one = slice(axis, axis + 1)
        part = from_offset * gain_change[:, one]
        part += offset_change[:, one]
        part *= way - local[:, one].astype(np.float32)
        change += part
    values -= change
