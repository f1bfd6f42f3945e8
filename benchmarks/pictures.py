"""Exact pictures of chessboards for the benchmarks: the blurred edges are evaluated at each pixel's own ray.

Nothing is resampled and nothing is shared with the detector. A pixel's ray is undistorted in closed form
(x = x_d (1 + a r_d^2), the division-free inverse model) and carried to the board's plane by a homography. A board is a
sum of products of side functions of its lines, one along columns and one along rows, so blurred it is the same sum of
the products' means (see :mod:`benchmarks.blur`). A line's distance in pixels is taken to second order, with the change
of scale that perspective makes across a wide blur. The curvature of a line within its own blur is what is neglected: it
moves an edge by below 0.001 px here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.blur import Array, Blur, Gaussian


@dataclass(frozen=True)
class BoardPicture:
    """``picture`` (H, W, 3) uint8 BGR, coded values; ``corners`` (N, 2) px, row by row; ``squares`` (columns, rows)."""

    picture: NDArray[np.uint8]
    corners: Array
    squares: tuple[int, int]


@dataclass(frozen=True)
class View:
    """How a board is seen: ``homography`` from squares (0, 0 the board's top left corner) to undistorted focal units,
    ``focal_px``, the inverse radial coefficient ``a`` and the picture's (width, height).
    """

    homography: Array
    focal_px: float
    inverse_k: float
    size: tuple[int, int]


def random_view(
    squares: tuple[int, int], rng: np.random.Generator, *, size: tuple[int, int] = (1920, 1080), share: float = 0.8
) -> View:
    """A board turned at random (25 deg out of the picture's plane, 20 deg in it) that fills ``share`` of the height."""
    yaw, pitch = np.deg2rad(rng.uniform(-25, 25, 2))
    roll = np.deg2rad(rng.uniform(-20, 20))
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    turn = (
        np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
        @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    )
    focal = 0.9 * size[0]
    extent = max(squares) * np.sqrt(1 + np.abs(np.sin(2 * roll)))
    depth = focal * extent / (share * size[1])
    shift = np.array([rng.uniform(-0.15, 0.15) * size[0] / focal * depth, rng.uniform(-0.02, 0.02) * depth, depth])
    centre = np.array([[1, 0, -squares[0] / 2], [0, 1, -squares[1] / 2], [0, 0, 1.0]])
    homography = np.column_stack([turn[:, 0], turn[:, 1], shift]) @ centre
    return View(homography, focal, 0.12, size)


def project(view: View, board: Array) -> Array:
    """Board points (N, 2) in squares to pixels (N, 2): Newton on the distorted radius, to 1e-12."""
    ray = np.column_stack([board, np.ones(len(board))]) @ view.homography.T
    ray = ray[:, :2] / ray[:, 2:]
    radius = np.hypot(ray[:, 0], ray[:, 1])
    distorted = radius.copy()
    for _ in range(20):
        distorted -= (distorted + view.inverse_k * distorted**3 - radius) / (1 + 3 * view.inverse_k * distorted**2)
    scale = np.divide(distorted, radius, out=np.ones_like(radius), where=radius > 0)
    centre = (np.array(view.size) - 1) / 2
    return np.asarray(ray * scale[:, None] * view.focal_px + centre)


def draw_board(
    squares: tuple[int, int],
    view: View,
    blur: float | Blur,
    noise: float,
    rng: np.random.Generator,
    *,
    bright: tuple[float, float, float] = (0.8, 0.8, 0.8),
    dark: tuple[float, float, float] = (0.05, 0.05, 0.6),
    surround: float = 0.2,
    shade: Array | None = None,
) -> BoardPicture:
    """A board with a margin of one bright square about it. ``blur``: a Gaussian's sigma in px, or any :class:`Blur`.

    Colours are light 0..1 (B, G, R), coded with BT.709; ``shade`` (H, W) multiplies the light (slow against the blur);
    ``noise`` is the standard deviation on coded values 0..255.
    """
    width, height = view.size
    if not isinstance(blur, Blur):
        blur = Gaussian(blur)
    outline = np.array([(c, r) for c in (-1.0, squares[0] + 1.0) for r in (-1.0, squares[1] + 1.0)])
    edge = np.linspace(0, 1, 9)[:, None]
    around = project(view, np.concatenate([outline[a] * (1 - edge) + outline[b] * edge for a, b in _OUTLINE]))
    reach = blur.reach_px + 4
    left, top = (int(max(np.floor(low - reach), 0)) for low in around.min(axis=0))
    right, bottom = (
        int(np.clip(np.ceil(high + reach), 0, side)) for high, side in zip(around.max(axis=0), view.size, strict=True)
    )
    inked, sheet = np.zeros((height, width)), np.zeros((height, width))
    if left < right and top < bottom:
        for du, dv, weight in blur.offsets:
            for field, part in zip(
                (inked, sheet),
                _fields(
                    squares,
                    view,
                    blur,
                    np.arange(left, right, dtype=np.float64) + du,
                    np.arange(top, bottom, dtype=np.float64) + dv,
                ),
                strict=True,
            ):
                field[top:bottom, left:right] += weight * part
    light = np.stack(
        [surround * (1 - sheet) + b * (sheet - inked) + d * inked for b, d in zip(bright, dark, strict=True)], -1
    )
    if shade is not None:
        light *= shade[..., None]
    light = np.clip(light, 0, 1)
    coded = 255 * np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    coded += noise * rng.standard_normal(coded.shape, dtype=np.float32)
    picture = np.clip(np.rint(coded), 0, 255).astype(np.uint8)
    inner = np.array(
        [(column, row) for row in range(1, squares[1]) for column in range(1, squares[0])], dtype=np.float64
    ).reshape(-1, 2)
    return BoardPicture(picture, project(view, inner), squares)


_OUTLINE = ((0, 1), (1, 3), (3, 2), (2, 0))


@dataclass(frozen=True)
class _Axis:
    """The board's lines across one of its two directions, at every pixel: ``distance`` (px) of line k is
    2 w / (g + sqrt(g^2 - 2 c w)), w = ``way`` - k in squares; ``slope`` (2, ...) and g = ``steep``, c = ``change`` are
    its first and second derivative along the line's normal.
    """

    way: Array
    slope: Array
    steep: Array
    change: Array

    def distance(self, line: float, window: tuple[slice, slice] = (slice(None), slice(None))) -> Array:
        w, steep = self.way[window] - line, self.steep[window]
        root = np.sqrt(np.maximum(steep**2 - 2 * self.change[window] * w, 0.0))
        return np.asarray(2 * w / (steep + root))

    def side(self, line: float, blur: Blur) -> Array:
        """The blurred side function of one line."""
        value = np.sign(self.way - line)
        near = np.nonzero(np.abs(self.way - line) < 1.2 * blur.reach_px * self.steep)
        w, steep = self.way[near] - line, self.steep[near]
        value[near] = blur.profile(2 * w / (steep + np.sqrt(np.maximum(steep**2 - 2 * self.change[near] * w, 0.0))))
        return value


def _axis(way: Array) -> _Axis:
    slope_v, slope_u = np.gradient(way)
    steep = np.hypot(slope_u, slope_v)
    change_v, change_u = np.gradient(steep)
    return _Axis(way, np.stack([slope_u, slope_v]), steep, (change_u * slope_u + change_v * slope_v) / steep)


def _fields(squares: tuple[int, int], view: View, blur: Blur, u: Array, v: Array) -> tuple[Array, Array]:
    """Blurred shares (0..1) of the inked squares and of the sheet, at columns ``u`` and rows ``v`` (V, U)."""
    width, height = view.size
    x, y = np.meshgrid((u - (width - 1) / 2) / view.focal_px, (v - (height - 1) / 2) / view.focal_px)
    grow = 1 + view.inverse_k * (x * x + y * y)
    inverse = np.linalg.inv(view.homography)
    x *= grow
    y *= grow
    rest = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
    axes = [_axis((inverse[axis, 0] * x + inverse[axis, 1] * y + inverse[axis, 2]) / rest) for axis in (0, 1)]
    weights = [_weights(count) for count in squares]
    checks, boxes, margins = [], [], []
    for axis, count, table in zip(axes, squares, weights, strict=True):
        sides = {line: axis.side(line, blur) for line in range(-1, count + 2)}
        checks.append(sum(table[line][0] * sides[line] for line in range(count + 1)))
        boxes.append((sides[0] - sides[count]) / 2)
        margins.append((sides[-1] - sides[count + 1]) / 2)
    inked = np.asarray(boxes[0] * boxes[1] + checks[0] * checks[1]) / 2
    sheet = np.asarray(margins[0] * margins[1])
    places = [(c, r) for c in (-1, squares[0] + 1) for r in (-1, squares[1] + 1)]
    crossings = [(c, r) for c in range(squares[0] + 1) for r in range(squares[1] + 1)]
    for (column, row), seen in zip(
        places + crossings, project(view, np.array(places + crossings, dtype=np.float64)), strict=True
    ):
        # Where both lines are within the blur: skewed lines reach further than the blur itself.
        span = 2 * blur.reach_px
        window = (
            slice(*np.searchsorted(v, [seen[1] - span, seen[1] + span])),
            slice(*np.searchsorted(u, [seen[0] - span, seen[0] + span])),
        )
        if inked[window].size == 0:
            continue
        normals = [axis.slope[(slice(None), *window)] / axis.steep[window] for axis in axes]
        more = blur.crossing(
            axes[0].distance(column, window), axes[1].distance(row, window), (normals[0] * normals[1]).sum(axis=0)
        )
        if (column, row) in places:
            sheet[window] += (1 if column < 0 else -1) * (1 if row < 0 else -1) * more / 4
        else:
            pair = [weights[0][column], weights[1][row]]
            inked[window] += (pair[0][0] * pair[1][0] + pair[0][1] * pair[1][1]) * more / 2
    return inked, sheet


def _weights(count: int) -> list[tuple[float, float]]:
    """What the side function of each line of one direction counts in the alternating squares, and in their box."""
    check = [0.5, *((-1.0) ** line for line in range(1, count)), -0.5 * (-1.0) ** (count - 1)]
    return [(one, {0: 0.5, count: -0.5}.get(line, 0.0)) for line, one in enumerate(check)]
