"""Pictures of the room, drawn without sampling: every edge of a target as its blurred profile.

Targets are drawn in linear light and coded with the BT.709 curve: plain areas are filled, the pixels along an edge
take the profile of :mod:`.edge_light`, those around a corner (and small cells altogether) :mod:`.corner_light`.
The backdrop is plain polygons: nothing is measured on it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr, ndtr

from calibration.types import Picture
from engine_adapters.sim.corner_light import CornerLight
from engine_adapters.sim.edge_light import EdgeLight
from engine_adapters.sim.light import code, light_of, pack, unpack
from engine_adapters.sim.optics import RayTable, View
from engine_adapters.sim.panel_grid import PanelGrid
from engine_adapters.sim.room import Decoy, Lamp, Panel, Room

FloatArray = NDArray[np.float64]
Words = NDArray[np.uint32]

PIXEL_APERTURE_VARIANCE = 1.0 / 12.0
"""Variance of a pixel's own width (px^2), added to the lens's blur."""
VIRTUAL_BLUR_PX = 0.5
"""Blur of the engine's own render: a sharp, anti-aliased edge."""

_REACH_SIGMAS = 4.0
_STRAIGHT_SIGMAS = 100.0
_CHUNK = 16_384
_FIXED_POINT_BITS = 4
_FAR_PX = 20_000.0
_NEAR_M = 0.05
_BLACK = (0, 0, 0)
_OPAQUE = 255


def render_real(view: View, room: Room, blur_px: float) -> Picture:
    """The camera's picture without noise: the room with its targets, (H, W, 3) uint8 BGR."""
    canvas = _Canvas(view, blur_px)
    canvas.draw_backdrop(room.backdrop)
    canvas.draw_targets(room, over_black=False)
    return canvas.picture()


def render_virtual(view: View, room: Room, *, over: Picture | None = None) -> Picture:
    """The engine's own render of the targets on black, or ``over`` the camera's picture, (H, W, 3) uint8 BGR."""
    canvas = _Canvas(view, VIRTUAL_BLUR_PX, over)
    canvas.draw_targets(room, over_black=over is None)
    return canvas.picture()


class _Canvas:
    """A picture being drawn, as BGRA words (single words are gathered and scattered fastest)."""

    def __init__(self, view: View, blur_px: float, over: Picture | None = None) -> None:
        width, height = view.optics.image_size
        self._view = view
        self._width, self._height = width, height
        self._sigma_px = math.sqrt(blur_px**2 + PIXEL_APERTURE_VARIANCE)
        self._reach_px = _REACH_SIGMAS * self._sigma_px + 1.0
        self._pixels: NDArray[np.uint8]
        if over is None:
            self._pixels = np.zeros((height, width, 4), dtype=np.uint8)
        else:
            self._pixels = np.asarray(cv2.cvtColor(over, cv2.COLOR_BGR2BGRA), dtype=np.uint8)
        self._words: Words = self._pixels.view(np.uint32)[..., 0]
        self._table = RayTable(view.optics)

    def picture(self) -> Picture:
        """What has been drawn, (H, W, 3) uint8 BGR."""
        return np.asarray(cv2.cvtColor(self._pixels, cv2.COLOR_BGRA2BGR), dtype=np.uint8)

    def draw_targets(self, room: Room, *, over_black: bool) -> None:
        """Draw every target that stands wholly in front of the camera."""
        # One copy serves every panel: none stands before another.
        behind = None if over_black else self._words.copy()
        for panel in room.panels:
            self._draw_panel(panel, behind)
        for lamp in room.lamps:
            self._draw_lamp(lamp)
        if self._view.optics.folds_inside_picture:
            self._black_out_beyond_fold()

    def draw_backdrop(self, backdrop: tuple[Decoy, ...]) -> None:
        """Fill the picture with the room's surfaces, far to near."""
        visible = _clipped(self._view, backdrop)
        # What lies behind a surface that fills the picture need not be drawn (every backdrop polygon is convex).
        fills = [number for number, (outline, _) in enumerate(visible) if self._fills_picture(outline)]
        for outline, decoy in visible[fills[-1] if fills else 0 :]:
            line = cv2.LINE_AA if decoy.smooth else cv2.LINE_8
            cv2.fillPoly(self._pixels, [outline], (*decoy.colour, _OPAQUE), line, _FIXED_POINT_BITS)

    def _fills_picture(self, outline: NDArray[np.int32]) -> bool:
        right, bottom = ((side - 1) << _FIXED_POINT_BITS for side in (self._width, self._height))
        left_most, top_most, wide, high = cv2.boundingRect(outline)
        if left_most > 0 or top_most > 0 or left_most + wide <= right or top_most + high <= bottom:
            return False
        corners = ((0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom))
        return all(cv2.pointPolygonTest(outline, corner, False) >= 0 for corner in corners)

    def _draw_panel(self, panel: Panel, behind: Words | None) -> None:
        """Draw over what lies ``behind`` the panels (None: black)."""
        grid = PanelGrid(panel)
        if self._view.to_camera(panel.to_world(grid.corners()))[:, 2].min() <= _NEAR_M:
            return
        outline = self._to_pixels(panel, grid.outline())
        low, high = outline.min(axis=0) - self._reach_px, outline.max(axis=0) + self._reach_px
        if high[0] < 0 or high[1] < 0 or low[0] > self._width - 1 or low[1] > self._height - 1:
            return
        self._fill_areas(panel, grid, outline)
        edges = EdgeLight(self._view, panel, grid, self._sigma_px, self._reach_px)
        edges.draw(self._words, _BLACK if behind is None else behind)
        u, v = self._pixels_around_corners(panel, grid, outline)
        corners = CornerLight(self._view, self._table, panel, grid, self._sigma_px)
        for start in range(0, len(u), _CHUNK):
            part_u, part_v = u[start : start + _CHUNK], v[start : start + _CHUNK]
            under = np.zeros((len(part_u), 3), dtype=np.uint8) if behind is None else unpack(behind[part_v, part_u])
            light, seen = corners.at(part_u.astype(np.float64), part_v.astype(np.float64), under)
            self._words[part_v[seen], part_u[seen]] = pack(code(light))[seen]

    def _fill_areas(self, panel: Panel, grid: PanelGrid, outline: FloatArray) -> None:
        """The areas away from any edge, as plain polygons."""
        if panel.margin_m > 0.0:
            cv2.fillPoly(self._pixels, [_whole(outline)], (*panel.margin_colour, _OPAQUE))
        checker = _whole(self._to_pixels(panel, grid.checker_outline()))
        cv2.fillPoly(self._pixels, [checker], (*panel.colours[1], _OPAQUE))
        if panel.colours[0] != panel.colours[1]:
            cells = grid.first_colour_cells()
            pixels = _whole(self._to_pixels(panel, cells.reshape(-1, 2))).reshape(cells.shape)
            cv2.fillPoly(self._pixels, list(pixels), (*panel.colours[0], _OPAQUE))

    def _to_pixels(self, panel: Panel, plane_m: FloatArray) -> FloatArray:
        return self._view.to_pixels(self._view.to_camera(panel.to_world(plane_m)))

    def _pixels_around_corners(
        self, panel: Panel, grid: PanelGrid, outline: FloatArray
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pixels (u, v) that more than one edge reaches: around each crossing, or all where cells are small."""
        reach = self._reach_px
        crossings = self._to_pixels(panel, grid.crossings())
        lattice = crossings.reshape(len(grid.edges[1]), len(grid.edges[0]), 2)
        steps = np.abs(np.concatenate([np.diff(lattice, axis=axis).reshape(-1, 2) for axis in (0, 1)]))
        slope = float(np.max(steps.min(axis=1) / np.maximum(steps.max(axis=1), 1e-9)))
        half = math.ceil(reach * (1.0 + slope))
        mask = np.zeros((self._height, self._width), dtype=np.uint8)
        if float(np.hypot(steps[:, 0], steps[:, 1]).min()) < 2 * reach:
            whole = _whole(outline)
            cv2.fillPoly(mask, [whole], 255)
            cv2.polylines(mask, [whole], True, 255, 2 * math.ceil(reach) + 1)
        else:
            inside = (crossings > -half).all(axis=1)
            inside &= (crossings < (self._width + half, self._height + half)).all(axis=1)
            for u, v in _whole(crossings[inside]):
                mask[max(0, v - half) : v + half + 1, max(0, u - half) : u + half + 1] = 255
        low = np.maximum(outline.min(axis=0) - half - 1, 0).astype(int)
        high = np.maximum(outline.max(axis=0) + half + 2, 0).astype(int)
        found = cv2.findNonZero(np.ascontiguousarray(mask[low[1] : high[1], low[0] : high[0]]))
        if found is None:
            return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
        found = found.reshape(-1, 2)
        return found[:, 0].astype(np.intp) + low[0], found[:, 1].astype(np.intp) + low[1]

    def _draw_lamp(self, lamp: Lamp) -> None:
        """A bright disk: its mean under a Gaussian is the non-central chi-square distribution, a large disk's Phi."""
        half = lamp.diameter_m / 2.0
        points = np.array([(0.0, 0.0, 0.0), (half, 0.0, 0.0), (0.0, 0.0, -half)]) + np.array(lamp.centre_m)
        camera = self._view.to_camera(points)
        if camera[:, 2].min() <= _NEAR_M:
            return
        pixels = np.clip(self._view.to_pixels(camera), -_FAR_PX, _FAR_PX)
        radius_px = math.sqrt(abs(float(np.linalg.det(pixels[1:] - pixels[0]))))
        reach = math.ceil(radius_px + self._reach_px) + 1
        (low_u, low_v), (high_u, high_v) = (
            np.floor(pixels[0]).astype(int) - reach,
            np.ceil(pixels[0]).astype(int) + reach,
        )
        low_u, low_v = max(0, low_u), max(0, low_v)
        patch = self._pixels[low_v : max(0, high_v + 1), low_u : max(0, high_u + 1), :3]
        if patch.size == 0:
            return
        rows, columns = patch.shape[:2]
        distance2 = ((np.arange(columns) + low_u - pixels[0, 0]) ** 2)[np.newaxis, :]
        distance2 = distance2 + ((np.arange(rows) + low_v - pixels[0, 1]) ** 2)[:, np.newaxis]
        if radius_px > _STRAIGHT_SIGMAS * self._sigma_px:
            share = ndtr((radius_px - np.sqrt(distance2)) / self._sigma_px)
        else:
            variance = self._sigma_px**2
            share = chndtr(radius_px**2 / variance, 2.0, distance2 / variance)
        share = share.astype(np.float32)[..., np.newaxis]
        patch[...] = code(light_of(patch) * (1 - share) + share)

    def _black_out_beyond_fold(self) -> None:
        """No ray reaches the pixels beyond the fold."""
        optics = self._view.optics
        fold = optics.fold_radius
        limit = fold * (1.0 + optics.k1 * fold**2 + optics.k2 * fold**4)
        cu, cv = optics.center_px
        x2 = ((np.arange(self._width) - cu) / optics.f_px) ** 2
        y2 = ((np.arange(self._height) - cv) / (optics.f_px * optics.pixel_aspect)) ** 2
        self._words[x2[np.newaxis, :] + y2[:, np.newaxis] > limit * limit] = 0


def _whole(pixels: FloatArray) -> NDArray[np.int32]:
    return np.asarray(np.rint(np.clip(pixels, -_FAR_PX, _FAR_PX)), dtype=np.int32)


def _fixed_point(outline: FloatArray) -> NDArray[np.int32]:
    scaled = np.clip(outline, -_FAR_PX, _FAR_PX) * (1 << _FIXED_POINT_BITS)
    return np.asarray(np.rint(scaled), dtype=np.int32)


def _clipped(view: View, backdrop: tuple[Decoy, ...]) -> list[tuple[NDArray[np.int32], Decoy]]:
    """The outlines in fixed-point pixels, cut outside the picture (so that nothing behind the camera is projected)."""
    if not backdrop:
        return []
    points = view.to_camera(np.concatenate([decoy.outline_m for decoy in backdrop]))
    # A point is kept while both |x| and |y| stay under ``wide`` times its depth: four planes through the pupil.
    wide = 2.0 * view.picture_radius
    planes = np.array([(1.0, 0.0, wide), (-1.0, 0.0, wide), (0.0, 1.0, wide), (0.0, -1.0, wide)])
    inside = points @ planes.T
    ends = np.cumsum([len(decoy.outline_m) for decoy in backdrop])
    begins = np.concatenate([[0], ends[:-1]])
    lowest, highest = (pick.reduceat(inside, begins, axis=0) for pick in (np.minimum, np.maximum))
    kept = []
    for number in np.flatnonzero((highest > 0.0).all(axis=1)):
        outline = points[begins[number] : ends[number]]
        for plane in planes[lowest[number] < 0.0]:
            outline = _cut(outline, plane)
        if len(outline) >= 3:
            kept.append((outline, backdrop[number]))
    if not kept:
        return []
    pixels = _fixed_point(view.to_pixels(np.concatenate([outline for outline, _ in kept])))
    starts = np.cumsum([0, *(len(outline) for outline, _ in kept)])
    return [(pixels[starts[i] : starts[i + 1]], decoy) for i, (_, decoy) in enumerate(kept)]


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
