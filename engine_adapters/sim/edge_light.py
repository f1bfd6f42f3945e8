"""Pixels along a panel's edges, away from its corners: one exact crossing for each picture row or column.

An edge that runs rather upright crosses each picture row once. There its exact column is found by Newton on the
closed-form projection, and its direction from the same derivatives. Between two plain colours a pixel beside it sees

    light = near + (far - near) Phi(d / sigma),   d = (u - u_edge) cos(angle between edge and column),

d being the distance to the edge in pixels (the edge's own bend over a few pixels is under 0.001 px). Edges that run
rather level are treated the same way with rows and columns changed over.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from engine_adapters.sim.light import Colour, blend, code, light_of_colour, pack
from engine_adapters.sim.optics import View
from engine_adapters.sim.panel_grid import BEHIND, PanelGrid
from engine_adapters.sim.room import Panel

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]
Words = NDArray[np.uint32]

REACH_SIGMAS = 4.0
"""Beyond this distance an edge adds nothing that the coded values could show (3e-5 of its step)."""

_SAMPLES = 25
_STEPS_PER_SIGMA = 512
_LEAST_SLANT = 0.3
_BLACK = (0, 0, 0)


@dataclass(frozen=True, slots=True)
class _Crossings:
    """Where edges cross picture lines. ``line``: row (or column) number, ``at``: exact position along it, ``slant``:
    cosine to the line's normal, signed so that it is positive where the edge's far side lies at growing positions;
    ``sides``: what the two sides show, near * 4 + far."""

    line: IndexArray
    at: FloatArray
    slant: FloatArray
    sides: IndexArray


@dataclass(frozen=True, slots=True)
class _Strokes:
    """Pixels to paint along crossings of one kind: pixel ``base + k * stride`` for k = -reach..reach, at a distance of
    ``start + k * scale`` sigmas. ``border``: distance of the base from both ends of its line, None if all are inside.
    """

    base: IndexArray
    stride: int
    reach: int
    start: NDArray[np.float32]
    scale: NDArray[np.float32]
    sides: IndexArray
    border: tuple[IndexArray, IndexArray] | None

    @property
    def offsets(self) -> NDArray[np.float32]:
        """All k."""
        return np.arange(-self.reach, self.reach + 1, dtype=np.float32)

    def places(self) -> tuple[IndexArray, NDArray[np.bool_]]:
        """The words of all k and crossings that lie in the picture (N,), and which those are (k, crossings)."""
        k = np.arange(-self.reach, self.reach + 1)[:, np.newaxis]
        if self.border is None:
            inside = np.ones((len(k), len(self.base)), dtype=np.bool_)
        else:
            inside = (self.border[0] + k >= 0) & (self.border[1] - k >= 0)
        return (self.base + k * self.stride)[inside], inside

    def pixels(self, words: Words) -> Iterator[tuple[int, Words, IndexArray, NDArray[np.bool_] | None]]:
        """For each k: the words and the places in them, and which of the crossings they belong to (None: all)."""
        first = self.base - self.reach * self.stride
        for k in range(-self.reach, self.reach + 1):
            if self.border is None:
                # The same places in words that begin later: one addition for all pixels less.
                yield k, words[(k + self.reach) * self.stride :], first, None
            else:
                inside = (self.border[0] + k >= 0) & (self.border[1] - k >= 0)
                yield k, words, self.base[inside] + k * self.stride, inside


class EdgeLight:
    """The edges of one panel in one view, for a picture whose pixel (u, v) is word v * ``row`` + u."""

    def __init__(self, view: View, panel: Panel, grid: PanelGrid, sigma_px: float, row: int) -> None:
        self._view = view
        self._panel = panel
        self._grid = grid
        self._sigma_px = sigma_px
        self._row = row
        self._reach_px = REACH_SIGMAS * sigma_px + 1.0
        self._origin = view.to_camera(np.array([panel.centre_m]))[0]
        self._along = panel.axes[:2] @ view.axes.T
        self.painted_px = REACH_SIGMAS * sigma_px
        """How far from an edge pixels are painted at most."""
        self._plain: list[_Strokes] = []
        self._open: list[_Strokes] = []
        for axis in (0, 1):
            for upright, found in self._crossings(axis):
                beside = (found.sides < 4) | (found.sides % 4 == BEHIND)
                for strokes, chosen in ((self._open, beside), (self._plain, ~beside)):
                    if chosen.any():
                        strokes.append(self._strokes(found, chosen, upright))

    def draw(self, words: Words, behind: list[Words] | None) -> None:
        """Draw the edges into packed pixels over what :meth:`behind` found, or over black."""
        colours = (_BLACK, self._panel.margin_colour, *self._panel.colours)
        table = _profile_table(colours)
        row = table.shape[1]
        entries = table.reshape(-1)
        for strokes in self._plain if behind is not None else [*self._plain, *self._open]:
            start = strokes.start * np.float32(_STEPS_PER_SIGMA) + np.float32(row // 2 + 0.5)
            scale = strokes.scale * np.float32(_STEPS_PER_SIGMA)
            begins = (strokes.sides * row).astype(np.float32)
            for k, part, where, among in strokes.pixels(words):
                index = start + np.float32(k) * scale
                np.clip(index, 0, row - 1, out=index)
                index += begins
                chosen = index.astype(np.intp) if among is None else index[among].astype(np.intp)
                part[where] = entries.take(chosen, mode="clip")
        if behind is None:
            return
        lights = np.stack([light_of_colour(colour) for colour in colours])
        for strokes, under in zip(self._open, behind, strict=True):
            # One of the two sides is what lies behind, area 0.
            near, far = strokes.sides >> 2, strokes.sides & 3
            toward = np.where(near == BEHIND, np.float32(1), np.float32(-1))
            where, reached = strokes.places()
            distance = np.multiply.outer(strokes.offsets, strokes.scale * toward) + strokes.start * toward
            shown = np.broadcast_to(near + far, distance.shape)[reached]
            words[where] = blend(under, lights[shown], ndtr(distance[reached]))

    def behind(self, words: Words) -> list[Words]:
        """What now stands in the picture where the panel's outermost edges will be drawn."""
        return [words[strokes.places()[0]] for strokes in self._open]

    def _strokes(self, found: _Crossings, chosen: NDArray[np.bool_], upright: bool) -> _Strokes:
        width, height = self._view.optics.image_size
        length, line_stride, stride = (width, self._row, 1) if upright else (height, 1, self._row)
        line, sides = found.line[chosen], found.sides[chosen]
        at, slant = found.at[chosen], found.slant[chosen]
        reach = math.floor(REACH_SIGMAS * self._sigma_px / float(np.abs(slant).min()) + 0.5)
        self.painted_px = max(self.painted_px, (reach + 0.5) * float(np.abs(slant).max()))
        nearest = np.rint(at).astype(np.intp)
        scale = slant * (1.0 / self._sigma_px)
        start = ((nearest - at) * scale).astype(np.float32)
        after = length - 1 - nearest
        within = nearest.min() >= reach and after.min() >= reach
        base = line * line_stride + nearest * stride
        border = None if within else (nearest, after)
        return _Strokes(base, stride, reach, start, scale.astype(np.float32), sides, border)

    def _crossings(self, axis: int) -> Iterator[tuple[bool, _Crossings]]:
        """Where the edges across ``axis`` cross picture rows (those that run upright) or columns (the others)."""
        edges, others = self._grid.edges[axis], self._grid.edges[1 - axis]
        samples = np.linspace(others[0], others[-1], _SAMPLES)
        camera = (self._origin + np.outer(edges, self._along[axis]))[:, np.newaxis] + np.outer(
            samples, self._along[1 - axis]
        )
        paths = self._view.to_pixels(camera.reshape(-1, 3)).reshape(len(edges), _SAMPLES, 2)
        travel = np.abs(paths[:, -1] - paths[:, 0])
        runs_upright = travel[:, 1] >= travel[:, 0]
        for upright, chosen in ((True, runs_upright), (False, ~runs_upright)):
            numbers = np.flatnonzero(chosen)
            if len(numbers):
                found = self._crossings_of(axis, upright, numbers, paths[numbers], samples)
                if found is not None:
                    yield upright, found

    def _crossings_of(
        self, axis: int, upright: bool, numbers: IndexArray, paths: FloatArray, samples: FloatArray
    ) -> _Crossings | None:
        """The crossings of the edges ``numbers``, which pass ``paths`` (edges, samples, 2) at ``samples``."""
        width, height = self._view.optics.image_size
        lines, length = (height, width) if upright else (width, height)
        along = 1 if upright else 0
        path, across = paths[:, :, along], paths[:, :, 1 - along]
        falling = path[:, -1] < path[:, 0]
        path = np.where(falling[:, np.newaxis], path[:, ::-1], path)
        first = np.ceil(np.maximum(path[:, 0], 0)).astype(np.intp)
        last = np.floor(np.minimum(path[:, -1], lines - 1)).astype(np.intp)
        seen = (across.max(axis=1) >= -self._reach_px) & (across.min(axis=1) <= length - 1 + self._reach_px)
        kept = np.flatnonzero(seen & (last >= first))
        if len(kept) == 0:
            return None
        counts = last[kept] - first[kept] + 1
        line = np.arange(counts.sum()) + np.repeat(first[kept] - np.cumsum(counts) + counts, counts)
        edge = np.repeat(numbers[kept], counts)
        ends = np.cumsum(counts)
        running = np.empty(len(line))
        for number, begin, end in zip(kept, ends - counts, ends, strict=True):
            at_samples = samples[::-1] if falling[number] else samples
            running[begin:end] = np.interp(line[begin:end], path[number], at_samples)
        pixels, tangent, reached = self._project(axis, self._grid.edges[axis][edge], running)
        # The guess is a tenth of a pixel off at most; one Newton step leaves the square of that times the curvature.
        step = (line - pixels[along]) / tangent[along]
        at = pixels[1 - along] + tangent[1 - along] * step
        # Far side of an edge: growing "right" (axis 0) or "down" (axis 1) in the panel. With the panel's face to the
        # camera, right x down keeps its sign in the picture, so the tangent's own sign tells on which side it lies.
        sign = 1.0 if (axis == 0) == upright else -1.0
        slant = sign * tangent[along] / np.sqrt(tangent[0] * tangent[0] + tangent[1] * tangent[1])
        sides = self._grid.sides[axis][self._grid.cell_of(1 - axis, running + step), edge]
        drawn = (sides % 5 != 0) & (at > -self._reach_px) & (at < length - 1 + self._reach_px)
        drawn &= reached & (np.abs(slant) > _LEAST_SLANT)
        if not drawn.any():
            return None
        return _Crossings(*(part[drawn] for part in (line, at, slant, sides)))

    def _project(
        self, axis: int, fixed: FloatArray, running: FloatArray
    ) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray], NDArray[np.bool_]]:
        """Pixels (u, v) of points on edges across ``axis``, their derivative by the running coordinate, and which of
        them a ray of the picture reaches (beyond it the polynomial may fold back into the picture)."""
        optics = self._view.optics
        fixed_x, fixed_y, fixed_z = self._along[axis]
        dx, dy, dz = self._along[1 - axis]
        origin_x, origin_y, origin_z = self._origin
        inverse_depth = 1.0 / (origin_z + fixed * fixed_z + running * dz)
        x = (origin_x + fixed * fixed_x + running * dx) * inverse_depth
        y = (origin_y + fixed * fixed_y + running * dy) * inverse_depth
        x_t, y_t = (dx - x * dz) * inverse_depth, (dy - y * dz) * inverse_depth
        q = x * x + y * y
        scale, bend = optics.bent(q)
        scale_t = 2.0 * bend * (x * x_t + y * y_t)
        f_u, f_v = optics.f_px, optics.f_px * optics.pixel_aspect
        cu, cv = optics.center_px
        pixels = f_u * x * scale + cu, f_v * y * scale + cv
        tangent = f_u * (x_t * scale + x * scale_t), f_v * (y_t * scale + y * scale_t)
        return pixels, tangent, q <= self._view.picture_radius**2


@lru_cache(maxsize=32)
def _profile_table(colours: tuple[Colour, ...]) -> NDArray[np.uint32]:
    """Packed pixel for each (near * 4 + far) and each distance in steps of sigma / 512, (16, steps).

    ``colours`` of what lies behind, the margin, the first and the second colour (the areas' numbers).
    """
    half = int(REACH_SIGMAS * _STEPS_PER_SIGMA)
    share = ndtr(np.arange(-half, half + 1) / _STEPS_PER_SIGMA).astype(np.float32)[:, np.newaxis]
    lights = [light_of_colour(colour) for colour in colours]
    rows = [pack(code(start + (end - start) * share)) for start in lights for end in lights]
    return np.stack(rows)
