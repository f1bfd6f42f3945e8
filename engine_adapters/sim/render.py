"""Pictures of the room, drawn without sampling: every edge of a target as its blurred profile.

Targets are drawn in linear light and coded with the BT.709 curve: plain areas are filled, the pixels along an edge
take the profile of :mod:`.edge_light`, those around a corner (and small cells altogether) :mod:`.corner_light`.
The backdrop is plain polygons: nothing is measured on it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr, ndtr

from calibration.types import Picture
from engine_adapters.sim.backdrop import FAR_PX, Backdrop
from engine_adapters.sim.corner_light import CornerLight
from engine_adapters.sim.edge_light import REACH_SIGMAS, EdgeLight
from engine_adapters.sim.light import Colour, code, light_of
from engine_adapters.sim.optics import View, ray_table
from engine_adapters.sim.panel_grid import PanelGrid, grid_of
from engine_adapters.sim.room import Decoy, Lamp, Panel, Room

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]
Words = NDArray[np.uint32]

PIXEL_APERTURE_VARIANCE = 1.0 / 12.0
"""Variance of a pixel's own width (px^2), added to the lens's blur."""
VIRTUAL_BLUR_PX = 0.5
"""Blur of the engine's own render: a sharp, anti-aliased edge."""

_BEND = 1.05
_STRAIGHT_SIGMAS = 100.0
_CHUNK = 16_384
_BORDER_PX = 8
"""Kept left and right of the picture: OpenCV's polygons spill over into the outermost columns."""
_ORIGIN = (_BORDER_PX, 0)
_NEAR_M = 0.05
_OPAQUE = 255


def render_real(view: View, room: Room, blur_px: float) -> Picture:
    """The camera's picture without noise: the room with its targets, (H, W, 3) uint8 BGR."""
    canvas = _Canvas(view, blur_px)
    canvas.draw_backdrop(room.backdrop)
    canvas.draw_targets(room, over_black=False)
    return canvas.picture()


def render_virtual(view: View, room: Room, *, over: Picture | None = None) -> Picture:
    """The engine's own render of the targets on black, or ``over`` the camera's picture, (H, W, 3) uint8 BGR."""
    canvas = _Canvas(view, VIRTUAL_BLUR_PX)
    canvas.begin_over(over)
    canvas.draw_targets(room, over_black=over is None)
    return canvas.picture()


class _Canvas:
    """A picture being drawn, as BGRA words (single words are gathered and scattered fastest).

    Pixel (u, v) is word v * row + u; ``row`` is a little longer than the picture is wide.
    """

    def __init__(self, view: View, blur_px: float) -> None:
        width, height = view.optics.image_size
        self._view = view
        self._width, self._height = width, height
        self._sigma_px = math.sqrt(blur_px**2 + PIXEL_APERTURE_VARIANCE)
        self._reach_px = REACH_SIGMAS * self._sigma_px + 1.0
        self._row = width + 2 * _BORDER_PX
        self._frame = _kept.frame(height, self._row)
        self._pixels = self._frame[:, _BORDER_PX : _BORDER_PX + width]
        self._words: Words = self._frame.view(np.uint32).reshape(-1)[_BORDER_PX:]

    def picture(self) -> Picture:
        """What has been drawn, (H, W, 3) uint8 BGR."""
        return np.asarray(cv2.cvtColor(self._pixels, cv2.COLOR_BGRA2BGR), dtype=np.uint8)

    def begin_over(self, over: Picture | None) -> None:
        """Begin with a picture (H, W, 3) uint8 BGR, or with black."""
        if over is None:
            self._frame.fill(0)
        else:
            self._pixels[...] = cv2.cvtColor(over, cv2.COLOR_BGR2BGRA)

    def draw_targets(self, room: Room, *, over_black: bool) -> None:
        """Draw every target that stands wholly in front of the camera."""
        for panel in room.panels:
            self._draw_panel(panel, over_black=over_black)
        for lamp in room.lamps:
            self._draw_lamp(lamp)
        if self._view.optics.folds_inside_picture:
            self._black_out_beyond_fold()

    def draw_backdrop(self, decoys: tuple[Decoy, ...]) -> None:
        """Begin with the room's surfaces, far to near."""
        _kept.backdrop_of(decoys).draw(self._view, self._frame, _ORIGIN)

    def _draw_panel(self, panel: Panel, *, over_black: bool) -> None:
        grid = grid_of(panel)
        if self._view.to_camera(grid.corners_m)[:, 2].min() <= _NEAR_M:
            return
        outline = self._to_pixels(grid.outline_m)
        low, high = outline.min(axis=0) - self._reach_px, outline.max(axis=0) + self._reach_px
        if high[0] < 0 or high[1] < 0 or low[0] > self._width - 1 or low[1] > self._height - 1:
            return
        crossings = self._to_pixels(grid.crossings_m).reshape(len(grid.edges[1]), len(grid.edges[0]), 2)
        apart_px, spread = self._spacing(crossings)
        edges = None
        if apart_px >= 2.0 * self._reach_px + 1.0:
            edges = EdgeLight(self._view, panel, grid, self._sigma_px, self._row)
            if apart_px < 2.0 * edges.painted_px + 1.0:
                edges = None
        if edges is None:
            u, v = self._pixels_of(outline)
        else:
            half = np.floor(_BEND * edges.painted_px * spread + 0.5).astype(int)
            u, v = self._pixels_around(crossings.reshape(-1, 2), half)
        where = v * self._row + u
        under = None if over_black else self._words[where]
        if edges is not None:
            beside = None if over_black else edges.behind(self._words)
            self._fill_areas(panel, grid, outline)
            edges.draw(self._words, beside)
        corners = CornerLight(self._view, ray_table(self._view.optics), panel, grid, self._sigma_px)
        for start in range(0, len(u), _CHUNK):
            part = slice(start, start + _CHUNK)
            drawn, seen = corners.at(
                u[part].astype(np.float64), v[part].astype(np.float64), None if under is None else under[part]
            )
            self._words[where[part][seen]] = drawn[seen]

    def _fill_areas(self, panel: Panel, grid: PanelGrid, outline: FloatArray) -> None:
        """The areas away from any edge, as plain polygons."""
        if panel.margin_m > 0.0:
            self._fill([_whole(outline)], panel.margin_colour)
        checker = _whole(self._to_pixels(grid.checker_outline_m))
        self._fill([checker], panel.colours[1])
        if panel.colours[0] != panel.colours[1]:
            cells = grid.first_colour_cells_m
            pixels = self._to_pixels(cells.reshape(-1, 3)).reshape(*cells.shape[:2], 2)
            seen = (pixels.max(axis=1) >= 0.0) & (pixels.min(axis=1) <= (self._width, self._height))
            self._fill(list(_whole(pixels[seen.all(axis=1)])), panel.colours[0])

    def _fill(self, outlines: Sequence[NDArray[np.int32]], colour: Colour) -> None:
        cv2.fillPoly(self._frame, outlines, (*colour, _OPAQUE), offset=_ORIGIN)

    def _to_pixels(self, world_m: FloatArray) -> FloatArray:
        return self._view.to_pixels(self._view.to_camera(world_m))

    def _spacing(self, crossings: FloatArray) -> tuple[float, FloatArray]:
        """Of the cells in the picture, from their corners (rows, columns, 2): the least distance of two edges in px,
        and how far (in u and v) the pixels reach that are nearer than 1 px to two edges that cross."""
        down, across = np.diff(crossings, axis=0)[:, :-1], np.diff(crossings, axis=1)[:-1]
        corners = np.stack([crossings[:-1, :-1], crossings[1:, :-1], crossings[:-1, 1:], crossings[1:, 1:]])
        seen = (corners.max(axis=0) >= -self._reach_px) & (
            corners.min(axis=0) <= (self._width + self._reach_px, self._height + self._reach_px)
        )
        chosen = seen.all(axis=2)
        if not chosen.any():
            return math.inf, np.ones(2)
        down, across = down[chosen], across[chosen]
        long_down, long_across = np.hypot(*down.T), np.hypot(*across.T)
        area = np.maximum(np.abs(down[:, 0] * across[:, 1] - down[:, 1] * across[:, 0]), 1e-9)
        apart = float((area / np.maximum(np.maximum(long_down, long_across), 1e-9)).min())
        # A point s e + t g (unit vectors at the angle a) is nearer than 1 to both lines while |s|, |t| < 1 / sin a.
        reach = (np.abs(down) * long_across[:, np.newaxis] + np.abs(across) * long_down[:, np.newaxis]) / area[
            :, np.newaxis
        ]
        return apart, np.asarray(reach.max(axis=0), dtype=np.float64)

    def _pixels_around(self, crossings: FloatArray, half: NDArray[np.int_]) -> tuple[IndexArray, IndexArray]:
        """Pixels (u, v) of the boxes around crossings: those that more than one edge reaches."""
        limit = np.array([self._width, self._height])
        centres = np.rint(crossings[((crossings > -half - 1) & (crossings < limit + half)).all(axis=1)]).astype(np.intp)
        across, down = (np.arange(-reach, reach + 1) for reach in half)
        u = (centres[:, 0, np.newaxis] + np.tile(across, len(down))).ravel()
        v = (centres[:, 1, np.newaxis] + np.repeat(down, len(across))).ravel()
        inside = (u >= 0) & (u < self._width) & (v >= 0) & (v < self._height)
        return (u, v) if inside.all() else (u[inside], v[inside])

    def _pixels_of(self, outline: FloatArray) -> tuple[IndexArray, IndexArray]:
        """Pixels (u, v) of the whole panel and a little around it."""
        thick = math.ceil(self._reach_px)
        low = np.clip(np.floor(outline.min(axis=0)).astype(int) - thick - 1, 0, None)
        high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + thick + 2, (self._width, self._height))
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
        whole = _whole(outline - low)
        cv2.fillPoly(mask, [whole], 255)
        cv2.polylines(mask, [whole], True, 255, 2 * thick + 1)
        v, u = np.nonzero(mask)
        return u + low[0], v + low[1]

    def _draw_lamp(self, lamp: Lamp) -> None:
        """A bright disk: its mean under a Gaussian is the non-central chi-square distribution, a large disk's Phi."""
        half = lamp.diameter_m / 2.0
        points = np.array([(0.0, 0.0, 0.0), (half, 0.0, 0.0), (0.0, 0.0, -half)]) + np.array(lamp.centre_m)
        camera = self._view.to_camera(points)
        if camera[:, 2].min() <= _NEAR_M:
            return
        pixels = np.clip(self._view.to_pixels(camera), -FAR_PX, FAR_PX)
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
        limit = optics.fold_distorted
        cu, cv = optics.center_px
        x2 = ((np.arange(self._width) - cu) / optics.f_px) ** 2
        y2 = ((np.arange(self._height) - cv) / (optics.f_px * optics.pixel_aspect)) ** 2
        self._pixels[x2[np.newaxis, :] + y2[:, np.newaxis] > limit * limit] = 0


def _whole(pixels: FloatArray) -> NDArray[np.int32]:
    return np.asarray(np.rint(np.clip(pixels, -FAR_PX, FAR_PX)), dtype=np.int32)


class _Kept(threading.local):
    """What a thread keeps from one picture to the next: most often it draws the same room in the same size again."""

    _backdrop = Backdrop(())
    _frame: NDArray[np.uint8] = np.zeros((0, 0, 4), dtype=np.uint8)

    def backdrop_of(self, decoys: tuple[Decoy, ...]) -> Backdrop:
        if self._backdrop.decoys is not decoys:
            self._backdrop = Backdrop(decoys)
        return self._backdrop

    def frame(self, height: int, row: int) -> NDArray[np.uint8]:
        """Pixels (height, row, 4) with anything in them."""
        # Memory fresh from the system costs as much as all that is drawn into it.
        if self._frame.shape[:2] != (height, row):
            self._frame = np.empty((height, row, 4), dtype=np.uint8)
        return self._frame


_kept = _Kept()
