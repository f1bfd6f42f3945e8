"""The edges and areas of a panel in its own plane, metres (right, down) from its centre."""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from engine_adapters.sim.room import Panel

FloatArray = NDArray[np.float64]

BEHIND, MARGIN, FIRST, SECOND = range(4)
"""What an area shows: what lies behind the panel, its margin, its first or its second colour."""

_SIDE_PIECES = 40
_CELL_PIECES = 6


class PanelGrid:
    """Edges along both axes, outermost included, and the colours between them. Points in the world are (N, 3).

    ``edges[axis]``: ascending positions of the edges that cross that axis (0 right, 1 down). ``areas`` (rows, columns):
    what each cell between edges shows, with one more row and column outside on every side.
    """

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self.edges = tuple(_edges(panel, axis) for axis in (0, 1))
        columns, rows = panel.squares
        checker = (np.add.outer(np.arange(rows), np.arange(columns)) % 2) + FIRST
        if panel.colours[0] == panel.colours[1]:
            checker[...] = FIRST
        if panel.margin_m > 0.0:
            checker = np.pad(checker, 1, constant_values=MARGIN)
        self.areas = np.pad(checker, 1, constant_values=BEHIND)
        # Both sides of an edge as one number, near * 4 + far: by the cell along the edge, then by the edge.
        self.sides = tuple(areas[:, :-1] * 4 + areas[:, 1:] for areas in (self.areas, self.areas.T))

    @cached_property
    def corners_m(self) -> FloatArray:
        """The four outermost corners."""
        a, b = self.edges
        return self._panel.to_world(np.array([(a[0], b[0]), (a[-1], b[0]), (a[-1], b[-1]), (a[0], b[-1])]))

    @cached_property
    def crossings_m(self) -> FloatArray:
        """Every crossing of two edges, row by row."""
        right, down = np.meshgrid(*self.edges)
        return self._panel.to_world(np.column_stack([right.ravel(), down.ravel()]))

    @cached_property
    def outline_m(self) -> FloatArray:
        """The outermost outline, finely divided."""
        a, b = self.edges
        return self._panel.to_world(_rectangle(a[0], a[-1], b[0], b[-1], _SIDE_PIECES))

    @cached_property
    def checker_outline_m(self) -> FloatArray:
        """The outline without the margin, finely divided."""
        half_a, half_b = self._panel.half_m
        return self._panel.to_world(_rectangle(-half_a, half_a, -half_b, half_b, _SIDE_PIECES))

    @cached_property
    def first_colour_cells_m(self) -> FloatArray:
        """Outlines of the squares of the first colour, (cells, points, 3)."""
        (columns, rows), (width, height) = self._panel.squares, self._panel.cell_m
        cell = _rectangle(0.0, width, 0.0, height, _CELL_PIECES)
        corners = [
            (column * width, row * height) for row in range(rows) for column in range(columns) if not (column + row) % 2
        ]
        cells = cell[np.newaxis] + np.array(corners)[:, np.newaxis] - np.array(self._panel.half_m)
        return self._panel.to_world(cells.reshape(-1, 2)).reshape(*cells.shape[:2], 3)

    def cell_of(self, axis: int, position_m: FloatArray) -> NDArray[np.intp]:
        """Row (axis 1) or column (axis 0) of ``areas`` at positions on the panel along an axis."""
        count = self._panel.squares[axis]
        first = -count * self._panel.cell_m[axis] / 2.0
        beyond = 1 if self._panel.margin_m > 0.0 else 0
        cell = (position_m - first) * (1.0 / self._panel.cell_m[axis])
        # Cut off towards zero after the shift: one below the first square stays apart from the first square.
        return np.asarray(np.clip(cell + (1 + beyond), 1, count + 2 * beyond).astype(np.intp))


@lru_cache(maxsize=64)
def grid_of(panel: Panel) -> PanelGrid:
    """The grid of a panel: it is the same in every view."""
    return PanelGrid(panel)


def _edges(panel: Panel, axis: int) -> FloatArray:
    count = panel.squares[axis]
    edges: FloatArray = (np.arange(count + 1, dtype=np.float64) - count / 2.0) * panel.cell_m[axis]
    if panel.margin_m > 0.0:
        edges = np.pad(edges, 1, mode="reflect", reflect_type="odd")
        edges[0], edges[-1] = edges[1] - panel.margin_m, edges[-2] + panel.margin_m
    return edges


def _rectangle(a0: float, a1: float, b0: float, b1: float, pieces: int) -> FloatArray:
    corners = np.array([(a0, b0), (a1, b0), (a1, b1), (a0, b1)], dtype=np.float64)
    steps = np.arange(pieces, dtype=np.float64)[:, np.newaxis] / pieces
    sides = [start + (end - start) * steps for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return np.concatenate(sides)
