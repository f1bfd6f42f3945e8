"""Light of the pixels around a panel's corners (and of any pixel of it), from each pixel's exact ray.

A panel is a sum of products of step functions of its plane's two axes (panel, checker area, checker). A pixel sees
them through a Gaussian of ``sigma_px`` in the picture; at the pixel's ray the local Jacobian turns it into standard
deviations ``s_a``, ``s_b`` and a correlation rho in the panel's plane. For step functions smoothed alone to F, G the
mean of their product is Mehler's series (W. F. Kibble, 1945)

    E[f g] = F G + rho s_a s_b F' G' + rho^2 / 2 s_a^2 s_b^2 F'' G'' + ...,

cut after the second term: rho stays under 0.2 in any view in which a panel can be measured.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from engine_adapters.sim.light import LightArray, code, light_of, light_of_colour, pack, unpack
from engine_adapters.sim.optics import RayTable, View
from engine_adapters.sim.panel_grid import PanelGrid, grid_of
from engine_adapters.sim.room import Panel

FloatArray = NDArray[np.float64]

_PANEL, _AREA, _CHECKER = range(3)
_ROOT_TWO_PI = math.sqrt(2.0 * math.pi)


class _Steps:
    """The three step functions of one axis: panel (0/1), checker area (0/1), checker (+1/-1, 0 outside), smoothed."""

    def __init__(self, panel: Panel, axis: int, edges: FloatArray, neighbours: int) -> None:
        count, self._cell = panel.squares[axis], panel.cell_m[axis]
        self._first = -count * self._cell / 2.0
        self._margin_m = panel.margin_m
        self._before = 1 if panel.margin_m > 0.0 else 0
        self._last = len(edges) - 1
        self._neighbours = neighbours
        self._edges = np.pad(edges, neighbours, mode="edge")
        levels = np.zeros((3, len(edges) + 1 + 2 * neighbours), dtype=np.float32)
        inner = slice(neighbours + self._before + 1, neighbours + self._before + 1 + count)
        levels[_PANEL, neighbours + 1 : neighbours + len(edges)] = 1.0
        levels[_AREA, inner] = 1.0
        levels[_CHECKER, inner] = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
        self._levels = levels
        self._jumps = np.diff(levels, axis=1)

    def smoothed(
        self, position: FloatArray, inverse_sigma: LightArray
    ) -> list[tuple[LightArray, LightArray, LightArray]]:
        """(F, s F', s^2 F'') of the three functions at positions (N,); ``inverse_sigma`` = 1/s."""
        near = np.rint((position - self._first) * (1.0 / self._cell)).astype(np.intp) + self._before
        np.clip(near, self._before, self._last - self._before, out=near)
        if self._before:
            near[position < self._first - self._margin_m / 2.0] = 0
            near[position > -self._first + self._margin_m / 2.0] = self._last
        result = [(levels[near], np.zeros_like(inverse_sigma), np.zeros_like(inverse_sigma)) for levels in self._levels]
        for offset in range(2 * self._neighbours + 1):
            index = near + offset
            z = (position - self._edges[index]).astype(np.float32) * inverse_sigma
            share = ndtr(z)
            density = np.exp(np.float32(-0.5) * z * z) * np.float32(1.0 / _ROOT_TWO_PI)
            slope = -z * density
            for jumps, (value, first, second) in zip(self._jumps, result, strict=True):
                jump = jumps[index]
                value += jump * share
                first += jump * density
                second += jump * slope
        return result


@lru_cache(maxsize=256)
def _steps(panel: Panel, axis: int, neighbours: int) -> _Steps:
    return _Steps(panel, axis, grid_of(panel).edges[axis], neighbours)


class CornerLight:
    """Light of a panel's pixels in one view."""

    def __init__(self, view: View, table: RayTable, panel: Panel, grid: PanelGrid, sigma_px: float) -> None:
        self._optics = view.optics
        self._table = table
        self._sigma_px = sigma_px
        axes = panel.axes
        centre = np.asarray(panel.centre_m) - view.pupil_m
        # Ray (x, y, 1) meets the plane at pupil + t d, t = n.c / n.d; (a, b) = axis . (t d - c): a homography.
        rays = view.axes.T
        self._normal = np.asarray(axes[2] @ rays, dtype=np.float64)
        reach = float(axes[2] @ centre)
        self._rows = [
            np.asarray(reach * (axes[i] @ rays) - float(axes[i] @ centre) * self._normal, dtype=np.float64)
            for i in (0, 1)
        ]
        nearest_m = min(float(np.diff(edges).min()) for edges in grid.edges)
        sigma_m = sigma_px * float(np.linalg.norm(centre)) / self._optics.f_px
        # An edge farther than 4 sigma from a pixel adds less than 3e-5; half a cell lies between it and the nearest.
        neighbours = math.ceil(max(0.0, 4.0 * sigma_m / nearest_m - 0.5))
        self._steps = [_steps(panel, axis, neighbours) for axis in (0, 1)]
        first, second = (light_of_colour(colour) for colour in panel.colours)
        margin = light_of_colour(panel.margin_colour) if panel.margin_m > 0.0 else np.zeros(3, dtype=np.float32)
        self._parts = np.stack([margin, (first + second) / 2.0 - margin, (first - second) / 2.0])
        self._covering = _PANEL if panel.margin_m > 0.0 else _AREA

    def at(
        self, u: FloatArray, v: FloatArray, behind: NDArray[np.uint32] | None
    ) -> tuple[NDArray[np.uint32], NDArray[np.bool_]]:
        """Packed pixels (N,) over what lies ``behind`` them (N, packed; None: black); which ones have a ray at all."""
        x, y = self._table.rays(u, v)
        seen = np.isfinite(x)
        if not seen.all():
            x, y = np.where(seen, x, 0.0), np.where(seen, y, 0.0)
        (a0, a1, a2), (b0, b1, b2), (n0, n1, n2) = *self._rows, self._normal
        depth = 1.0 / (n0 * x + n1 * y + n2)
        a = (a0 * x + a1 * y + a2) * depth
        b = (b0 * x + b1 * y + b2) * depth
        inverse_a, inverse_b, rho = self._spread(*(part.astype(np.float32) for part in (x, y, depth, a, b)))
        products = np.empty((3, len(x)), dtype=np.float32)
        for product, along_a, along_b in zip(
            products, self._steps[0].smoothed(a, inverse_a), self._steps[1].smoothed(b, inverse_b), strict=True
        ):
            product[...] = along_a[0] * along_b[0]
            product += rho * along_a[1] * along_b[1]
            product += (np.float32(0.5) * rho * rho) * along_a[2] * along_b[2]
        light = np.asarray(products.T @ self._parts, dtype=np.float32)
        if behind is not None:
            cover = products[self._covering]
            beside = np.flatnonzero(cover < np.float32(1.0 - 1e-5))
            light[beside] += light_of(unpack(behind[beside])) * (np.float32(1.0) - cover[beside, np.newaxis])
        return pack(code(light)), seen

    def _spread(
        self, x: LightArray, y: LightArray, depth: LightArray, a: LightArray, b: LightArray
    ) -> tuple[LightArray, LightArray, LightArray]:
        """1/s_a, 1/s_b (per metre) and the correlation of the pixel's Gaussian in the panel's plane."""
        optics = self._optics
        ratio, by_q = optics.bent(np.asarray(x * x + y * y, dtype=np.float64))
        scale: LightArray = ratio.astype(np.float32)
        bend: LightArray = (2 * by_q).astype(np.float32)
        xx, xy, yy = scale + bend * x * x, bend * x * y, scale + bend * y * y
        unit: LightArray = np.asarray(self._sigma_px / optics.f_px / (xx * yy - xy * xy), dtype=np.float32)
        flat = np.float32(1.0 / optics.pixel_aspect)
        x_u, y_u, x_v, y_v = yy * unit, -xy * unit, -xy * unit * flat, xx * unit * flat
        n0, n1 = (np.float32(part) for part in self._normal[:2])
        spread = []
        for (h0, h1), plane in ((self._rows[0][:2], a), (self._rows[1][:2], b)):
            by_x = (np.float32(h0) - plane * n0) * depth
            by_y = (np.float32(h1) - plane * n1) * depth
            spread.append((by_x * x_u + by_y * y_u, by_x * x_v + by_y * y_v))
        (a_u, a_v), (b_u, b_v) = spread
        inverse_a = 1 / np.sqrt(a_u * a_u + a_v * a_v)
        inverse_b = 1 / np.sqrt(b_u * b_u + b_v * b_v)
        return inverse_a, inverse_b, (a_u * b_u + a_v * b_v) * inverse_a * inverse_b
