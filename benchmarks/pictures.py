"""Exact pictures of chessboards for the benchmarks: the edge profile is evaluated at each pixel's own ray.

Nothing is resampled and nothing is shared with the detector. A pixel's ray is undistorted in closed form
(x = x_d (1 + a r_d^2), the division-free inverse model), carried to the board's plane by a homography, and each of the
board's lines gives a Gaussian-blurred edge in the signed distance in pixels. The pixel's box counts as 1/12 px^2 of
blur variance. The curvature of a line within its own blur is what is neglected: below 0.001 px here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]


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
    blur_px: float,
    noise: float,
    rng: np.random.Generator,
    *,
    bright: tuple[float, float, float] = (0.8, 0.8, 0.8),
    dark: tuple[float, float, float] = (0.05, 0.05, 0.6),
    surround: float = 0.2,
) -> BoardPicture:
    """A board with a margin of one bright square about it. Colours are light 0..1 (B, G, R), coded with BT.709;
    ``noise`` is the standard deviation on coded values 0..255.
    """
    width, height = view.size
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    x, y = (u - (width - 1) / 2) / view.focal_px, (v - (height - 1) / 2) / view.focal_px
    r2 = x * x + y * y
    grow = 1 + view.inverse_k * r2
    inverse = np.linalg.inv(view.homography)
    rays = np.stack([x * grow, y * grow, np.ones_like(x)], axis=-1) @ inverse.T
    plane = rays[..., :2] / rays[..., 2:]
    sigma = np.sqrt(blur_px**2 + 1 / 12)
    checks: list[Array] = []
    boxes: list[Array] = []
    margins: list[Array] = []
    for axis in (0, 1):
        way = plane[..., axis]
        slope_v, slope_u = np.gradient(way)
        scale = 1 / (np.hypot(slope_u, slope_v) * sigma * np.sqrt(2))
        count = squares[axis]
        steps = [erf((way - line) * scale) for line in range(count + 1)]
        check = sum((-1) ** line * (steps[line] - steps[line + 1]) for line in range(count)) / 2
        checks.append(np.asarray(check))
        boxes.append((steps[0] - steps[count]) / 2)
        margins.append((erf((way + 1) * scale) - erf((way - count - 1) * scale)) / 2)
    inked = (boxes[0] * boxes[1] + checks[0] * checks[1]) / 2
    sheet = margins[0] * margins[1]
    light = np.stack(
        [surround * (1 - sheet) + b * (sheet - inked) + d * inked for b, d in zip(bright, dark, strict=True)], -1
    )
    light = np.clip(light, 0, 1)
    coded = 255 * np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    coded = np.clip(np.rint(coded + rng.normal(0, noise, coded.shape)), 0, 255).astype(np.uint8)
    inner = np.array(
        [(column, row) for row in range(1, squares[1]) for column in range(1, squares[0])], dtype=np.float64
    )
    return BoardPicture(coded, project(view, inner), squares)
