"""The room's surfaces behind the targets: plain polygons, far to near. Nothing is measured on them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from engine_adapters.sim.optics import View
from engine_adapters.sim.room import Decoy

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]

FAR_PX = 20_000.0
"""Outlines are cut off here: OpenCV's own fixed-point numbers end not far beyond."""

_FIXED_POINT_BITS = 4
_OPAQUE = 255
_SAME_PLANE_M = 1e-6


class Backdrop:
    """The surfaces of one room, which are convex, ready to be drawn in any view."""

    def __init__(self, decoys: tuple[Decoy, ...]) -> None:
        self.decoys = decoys
        counts = np.array([len(decoy.outline_m) for decoy in decoys], dtype=np.intp)
        self._ends = np.cumsum(counts)
        self._begins = self._ends - counts
        self._points_m = np.concatenate([decoy.outline_m for decoy in decoys]) if decoys else np.empty((0, 3))
        self._next = np.arange(1, len(self._points_m) + 1)
        self._next[self._ends - 1] = self._begins
        self._covered = [_holds(*pair) for pair in pairwise(decoys)] + [False]

    def draw(self, view: View, pixels: NDArray[np.uint8], origin: tuple[int, int]) -> None:
        """Draw into BGRA pixels (H, W, 4), the view's pixel (0, 0) at ``origin``; black where no surface is."""
        points = view.to_camera(self._points_m)
        fills: list[int] = np.flatnonzero(self._fills(view, points)).tolist() if self.decoys else []
        if not fills:
            pixels.fill(0)
        if not self.decoys:
            return
        # OpenCV takes an offset in the fixed-point numbers' own unit.
        offset = origin[0] << _FIXED_POINT_BITS, origin[1] << _FIXED_POINT_BITS
        # What lies behind a surface that fills the picture need not be drawn.
        for outlines, decoy in self._outlines(view, points, fills[-1] if fills else 0):
            line = cv2.LINE_AA if decoy.smooth else cv2.LINE_8
            cv2.fillPoly(pixels, outlines, (*decoy.colour, _OPAQUE), line, _FIXED_POINT_BITS, offset)

    def _outlines(self, view: View, points: FloatArray, first: int) -> Iterator[tuple[list[NDArray[np.int32]], Decoy]]:
        """From a first surface on, in fixed-point pixels: the outline, cut outside the picture (so that nothing behind
        the camera is projected), and the next surface's as a hole where that covers a part of it."""
        # A point is kept while both |x| and |y| stay under ``wide`` times its depth: four planes through the pupil.
        wide = 2.0 * view.picture_radius
        planes = np.array([(1.0, 0.0, wide), (-1.0, 0.0, wide), (0.0, 1.0, wide), (0.0, -1.0, wide)])
        inside = points @ planes.T
        lowest, highest = (pick.reduceat(inside, self._begins, axis=0) for pick in (np.minimum, np.maximum))
        visible = np.flatnonzero((highest > 0.0).all(axis=1))
        numbers = visible[visible >= first].tolist()
        kept: list[tuple[FloatArray, int]] = []
        for number in numbers:
            outline = points[self._begins[number] : self._ends[number]]
            for plane in planes[lowest[number] < 0.0]:
                outline = _cut(outline, plane)
            if len(outline) >= 3:
                kept.append((outline, number))
        if not kept:
            return
        pixels = np.clip(view.to_pixels(np.concatenate([outline for outline, _ in kept])), -FAR_PX, FAR_PX)
        ends = np.cumsum([len(outline) for outline, _ in kept])
        starts = np.concatenate([[0], ends[:-1]])
        low, high = (pick.reduceat(pixels, starts, axis=0) for pick in (np.minimum, np.maximum))
        seen = ((high >= -1.0) & (low <= view.optics.image_size)).all(axis=1)
        fixed = np.asarray(np.rint(pixels * (1 << _FIXED_POINT_BITS)), dtype=np.int32)
        drawn = {kept[i][1]: fixed[starts[i] : ends[i]] for i in np.flatnonzero(seen)}
        for shown, pixel_outline in drawn.items():
            holed = self._covered[shown] and shown + 1 in drawn
            yield [pixel_outline, drawn[shown + 1]] if holed else [pixel_outline], self.decoys[shown]

    def _fills(self, view: View, points: FloatArray) -> NDArray[np.bool_]:
        """Which surfaces, ``points`` in camera axes, are met by every ray of the picture."""
        following = points[self._next]
        (px, py, pz), (qx, qy, qz) = points.T, following.T
        # A ray inside a convex outline lies on the same side of each plane through the pupil and one of its sides.
        sides = np.column_stack([py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx])
        radius = view.picture_radius
        width, height = view.optics.image_size
        stretch = max(1.0, radius / view.optics.corner_radius) / view.optics.f_px
        x = min(radius, (width / 2.0 + abs(view.optics.center_shift_px[0])) * stretch)
        y = min(radius, (height / 2.0 + abs(view.optics.center_shift_px[1])) * stretch / view.optics.pixel_aspect)
        heights = sides @ np.array([(x, y, 1.0), (-x, y, 1.0), (-x, -y, 1.0), (x, -y, 1.0)]).T
        least = np.minimum.reduceat(heights.min(axis=1), self._begins)
        most = np.maximum.reduceat(heights.max(axis=1), self._begins)
        facing = np.add.reduceat(sides, self._begins, axis=0)
        ahead = (facing * points[self._begins]).sum(axis=1) * facing[:, 2] > 0.0
        return np.asarray(((least >= 0.0) | (most <= 0.0)) & ahead)


def _holds(below: Decoy, above: Decoy) -> bool:
    """Whether a surface lies in another's plane and within its outline, both plain-edged (they share those pixels)."""
    if below.smooth or above.smooth:
        return False
    points = below.outline_m
    following = np.roll(points, -1, axis=0)
    normal = np.cross(points, following).sum(axis=0)
    normal /= np.linalg.norm(normal)
    apart = above.outline_m[:, np.newaxis] - points
    inward = np.cross(normal, following - points)
    flat = np.abs(apart @ normal).max() < _SAME_PLANE_M
    return bool(flat and (apart * inward).sum(axis=2).min() > -_SAME_PLANE_M)


def _cut(outline: FloatArray, plane: FloatArray) -> FloatArray:
    """The part of a polygon (N, 3) on the positive side of a plane through the origin.

    I. E. Sutherland and G. W. Hodgman, "Reentrant polygon clipping", 1974.
    """
    if len(outline) == 0:
        return outline
    heights = outline @ plane
    kept = heights > 0.0
    following = np.concatenate((outline[1:], outline[:1]))
    next_heights = np.concatenate((heights[1:], heights[:1]))
    crossing = kept != (next_heights > 0.0)
    share = heights / np.where(crossing, heights - next_heights, 1.0)
    cuts = outline + share[:, np.newaxis] * (following - outline)
    both = np.stack([outline, cuts], axis=1).reshape(-1, 3)
    return np.asarray(both[np.column_stack([kept, crossing]).ravel()], dtype=np.float64)
