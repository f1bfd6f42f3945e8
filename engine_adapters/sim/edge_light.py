"""Pixels along a panel's edges, away from its corners: one exact crossing for each picture row or column.

An edge that runs rather upright crosses each picture row once. There its exact column is found by Newton on the
closed-form projection, and its direction from the same derivatives. Between two plain colours a pixel beside it sees

    light = near + (far - near) Phi(d / sigma),   d = (u - u_edge) cos(angle between edge and column),

d being the distance to the edge in pixels (the edge's own bend over a few pixels is under 0.001 px). Edges that run
rather level are treated the same way with rows and columns changed over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from engine_adapters.sim.light import Colour, LightArray, code, light_of, light_of_colour, pack, unpack
from engine_adapters.sim.optics import View
from engine_adapters.sim.panel_grid import BEHIND, PanelGrid
from engine_adapters.sim.room import Panel

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]

_SAMPLES = 25
_STEPS_PER_SIGMA = 512
_REACH_SIGMAS = 4.0
_LEAST_SLANT = 0.3


@dataclass(frozen=True, slots=True)
class _Crossings:
    """Where edges cross picture lines. ``line``: row (or column) number, ``at``: exact position along it, ``slant``:
    cosine to the line's normal, signed so that it is positive where the edge's far side lies at growing positions;
    ``near``, ``far``: what the two sides show."""

    line: IndexArray
    at: FloatArray
    slant: FloatArray
    near: IndexArray
    far: IndexArray


class EdgeLight:
    """The edges of one panel in one view."""

    def __init__(self, view: View, panel: Panel, grid: PanelGrid, sigma_px: float, reach_px: float) -> None:
        self._view = view
        self._panel = panel
        self._grid = grid
        self._sigma_px = sigma_px
        self._reach_px = reach_px
        axes = panel.axes
        centre = view.to_camera(np.array([panel.centre_m]))[0]
        self._origin = centre
        self._along = axes[:2] @ view.axes.T

    def draw(self, words: NDArray[np.uint32], behind: NDArray[np.uint32] | Colour) -> None:
        """Draw the edges into packed pixels (H, W) over what lies ``behind``: a picture like it, or one colour."""
        picture_behind = behind if isinstance(behind, np.ndarray) else None
        behind_colour = (0, 0, 0) if isinstance(behind, np.ndarray) else behind
        table = _profile_table((behind_colour, self._panel.margin_colour, *self._panel.colours))
        for axis in (0, 1):
            for upright in (True, False):
                found = self._crossings(axis, upright)
                if found is not None:
                    self._paint(words, found, upright, table, picture_behind)

    def _paint(
        self,
        words: NDArray[np.uint32],
        found: _Crossings,
        upright: bool,
        table: NDArray[np.uint32],
        behind: NDArray[np.uint32] | None,
    ) -> None:
        height, width = words.shape
        length, line_stride, step_stride = (width, width, 1) if upright else (height, 1, width)
        reach = math.ceil(self._reach_px / float(np.abs(found.slant).min()))
        offsets = np.arange(-reach, reach + 1)
        nearest = np.rint(found.at).astype(np.intp)
        positions = nearest[:, np.newaxis] + offsets
        z = ((offsets - (found.at - nearest)[:, np.newaxis]) * (found.slant / self._sigma_px)[:, np.newaxis]).astype(
            np.float32
        )
        flat = found.line[:, np.newaxis] * line_stride + positions * step_stride
        inside = np.abs(z) <= _REACH_SIGMAS
        if nearest.min() < reach or nearest.max() >= length - reach:
            inside &= (positions >= 0) & (positions < length)
        pixels = words.reshape(-1)
        over_behind = (found.near == BEHIND) | (found.far == BEHIND)
        known = np.ones_like(over_behind) if behind is None else ~over_behind
        index = (np.clip(z, -_REACH_SIGMAS, _REACH_SIGMAS) * np.float32(_STEPS_PER_SIGMA)).round().astype(np.intp)
        index += (found.near * 4 + found.far)[:, np.newaxis] * table.shape[1] + table.shape[1] // 2
        chosen = inside & known[:, np.newaxis]
        pixels[flat[chosen]] = table.reshape(-1)[index[chosen]]
        if behind is None or not over_behind.any():
            return
        chosen = inside & over_behind[:, np.newaxis]
        rows = np.nonzero(chosen)[0]
        share = ndtr(z[chosen])[:, np.newaxis]
        where = flat[chosen]
        far_behind = (found.far == BEHIND)[rows]
        share[far_behind] = 1 - share[far_behind]
        shown = np.where(found.near == BEHIND, found.far, found.near)[rows]
        lights = self._lights()[shown]
        under = light_of(unpack(behind.reshape(-1)[where]))
        pixels[where] = pack(code(under + (lights - under) * share))

    def _lights(self) -> LightArray:
        panel = self._panel
        colours = ((0, 0, 0), panel.margin_colour, *panel.colours)
        return np.stack([light_of_colour(colour) for colour in colours])

    def _crossings(self, axis: int, upright: bool) -> _Crossings | None:
        """Where the edges across ``axis`` that run upright (or level) cross picture rows (or columns)."""
        width, height = self._view.optics.image_size
        lines_in_picture, length = (height, width) if upright else (width, height)
        edges, others = self._grid.edges[axis], self._grid.edges[1 - axis]
        samples = np.linspace(others[0], others[-1], _SAMPLES)
        fixed, running = np.repeat(edges, _SAMPLES), np.tile(samples, len(edges))
        camera = self._origin + np.outer(fixed, self._along[axis]) + np.outer(running, self._along[1 - axis])
        paths = self._view.to_pixels(camera).reshape(len(edges), _SAMPLES, 2)
        travel = np.abs(paths[:, -1] - paths[:, 0])
        runs_upright = travel[:, 1] >= travel[:, 0]
        along = 1 if upright else 0
        chosen_lines, chosen_guess, chosen_edge = [], [], []
        for number in np.flatnonzero(runs_upright == upright):
            path, across = paths[number, :, along], paths[number, :, 1 - along]
            if across.max() < -self._reach_px or across.min() > length - 1 + self._reach_px:
                continue
            order = path if path[-1] >= path[0] else path[::-1]
            first, last = max(0, math.ceil(order[0])), min(lines_in_picture - 1, math.floor(order[-1]))
            if first > last:
                continue
            numbers = np.arange(first, last + 1)
            chosen_lines.append(numbers)
            chosen_guess.append(np.interp(numbers, order, samples if order is path else samples[::-1]))
            chosen_edge.append(np.full(len(numbers), number))
        if not chosen_lines:
            return None
        line, running, edge = np.concatenate(chosen_lines), np.concatenate(chosen_guess), np.concatenate(chosen_edge)
        pixels, tangent, reached = self._project(axis, edges[edge], running)
        # The guess is a tenth of a pixel off at most; one Newton step leaves the square of that times the curvature.
        step = (line - pixels[along]) / tangent[along]
        running = running + step
        at = pixels[1 - along] + tangent[1 - along] * step
        # Far side of an edge: growing "right" (axis 0) or "down" (axis 1) in the panel. With the panel's face to the
        # camera, right x down keeps its sign in the picture, so the tangent's own sign tells on which side it lies.
        sign = 1.0 if (axis == 0) == upright else -1.0
        slant = sign * tangent[along] / np.hypot(*tangent)
        cell = np.searchsorted(others, running)
        areas = self._grid.areas if axis == 0 else self._grid.areas.T
        near, far = areas[cell, edge], areas[cell, edge + 1]
        kept = (near != far) & (at > -self._reach_px) & (at < length - 1 + self._reach_px)
        kept &= reached & (np.abs(slant) > _LEAST_SLANT)
        if not kept.any():
            return None
        return _Crossings(*(part[kept] for part in (line, at, slant, near, far)))

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
        scale = 1.0 + q * (optics.k1 + optics.k2 * q)
        scale_t = (2.0 * optics.k1 + 4.0 * optics.k2 * q) * (x * x_t + y * y_t)
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
    half = int(_REACH_SIGMAS * _STEPS_PER_SIGMA)
    share = ndtr(np.arange(-half, half + 1) / _STEPS_PER_SIGMA).astype(np.float32)[:, np.newaxis]
    lights = [light_of_colour(colour) for colour in colours]
    rows = [pack(code(start + (end - start) * share)) for start in lights for end in lights]
    return np.stack(rows)
