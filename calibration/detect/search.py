"""Which grid in a picture is the asked board: levels of reduction, channels, size, reading direction, frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.detect.grid import Grid, find_grids, mean_steps, predict_missing, steps_of
from calibration.detect.prediction import Prediction
from calibration.detect.quality import median_sides
from calibration.detect.saddle import Gray, Saddles, find_saddles, reduce_picture
from calibration.detect.signal import surrounded
from calibration.detect.windows import Reduced
from calibration.types import FloatArray, Picture

_FIRST_WIDTH_PX = 1000
"""The picture is searched first at the power of two that brings it below twice this width."""
_SMALLEST_STEP_PX = 5.5
"""Grids with smaller squares, in pixels of the level they were found on, wait for a finer level."""
_LEAST_PRESENT = 0.8
_LEAST_REPORTED = 0.15
_LEAST_CUT = 12
_MARGIN_SIGMAS = 4.0
_MATCH_SIGMAS = 5.0
_FOLLOWED_SHARE = 0.9
"""Of the expected corners that must be seen before the search for a grid is spared."""


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """The asked grid as the coarse search saw it, in pixels of the picture.

    ``points_px`` (rows, columns, 2), every place filled (from its neighbours where not seen); ``polarity`` as in
    :class:`Grid`; ``whole``: the outer squares lie inside the picture; ``error_px`` how far a point may be off;
    ``plane`` the reduced channel it was found in, in coded values; ``seen`` (rows, columns): False for the lines that
    the frame cuts off.
    """

    points_px: FloatArray
    polarity: int
    whole: bool
    error_px: float
    plane: Reduced
    seen: NDArray[np.bool_]


def find_board(
    picture: Picture, size: tuple[int, int], colours: tuple[str, ...], near: Prediction | None
) -> Board | str:
    """The board with ``size`` = (columns, rows) inner corners, or one line that says why there is none."""
    corner = np.zeros(2, dtype=np.int64)
    part = picture
    if near is not None:
        window = _window(picture, size, near)
        if window is None:
            return "the target is expected outside the picture"
        corner = np.array(window[:2])
        part = picture[window[1] : window[3], window[0] : window[2]]
    others: list[Grid] = []
    least = max(4, round(_LEAST_REPORTED * size[0] * size[1]))
    for factor, gray in _levels(part, colours, near, size):
        saddles = find_saddles(gray)
        plane = Reduced(gray, factor, (int(corner[0]), int(corner[1])), 1.0, 1.0)
        if near is not None:
            followed = follow(saddles, plane, near, size)
            if followed is not None:
                return _board(followed, picture, 0.3 * factor, plane)
        grids = [
            grid for grid in find_grids(saddles, least, max(size) + 2) if factor == 1 or _step(grid) > _SMALLEST_STEP_PX
        ]
        boards: list[Board] = []
        for grid in grids:
            points = (grid.points + 0.5) * factor - 0.5 + corner
            full = Grid(points, grid.polarity, grid.amplitude)
            oriented = upright(full, size, near)
            if oriented is None:
                oriented = cut_reading(full, size, picture, near)
            elif oriented.present < _LEAST_PRESENT * size[0] * size[1]:
                oriented = None
            if oriented is None:
                others.append(full)
                continue
            board = _board(oriented, picture, 0.3 * factor, plane)
            if near is None or _fits(board, near):
                boards.append(board)
        result = _choose(boards, size, near)
        if result is not None:
            return result
    return _reason(others, size, picture, near)


def follow(saddles: Saddles, plane: Reduced, near: Prediction, size: tuple[int, int]) -> Grid | None:
    """The expected grid with its points at the saddles beside them, in pixels of the picture; None where in doubt.

    Only where the prediction tells one corner from the next: a common shift of the board is taken off first, then every
    point must be within a quarter of a square of a saddle whose bright diagonal turns as the board's does.
    """
    expected = (near.points_px + 0.5 - np.array(plane.origin_px)) / plane.pixel_px - 0.5
    steps = steps_of(expected.reshape(size[1], size[0], 2)).reshape(-1, 2, 2)
    side = np.linalg.norm(steps, axis=2).min(axis=1)
    height, width = saddles.gray.shape
    in_view = ((expected > 3) & (expected < np.array([width, height]) - 4)).all(axis=1)
    least = _FOLLOWED_SHARE * max(int(in_view.sum()), min(_LEAST_CUT, len(expected)), len(expected) / 2)
    if _MARGIN_SIGMAS * near.sigma_px / plane.pixel_px > 0.5 * float(np.median(side)) or len(saddles.points) < least:
        return None
    # The quadrant between the two steps is bright where the bright diagonal runs along their sum.
    diagonal = steps.sum(axis=1)
    parity = (-1.0) ** np.add.outer(np.arange(size[1]), np.arange(size[0])).ravel()
    away = saddles.points[None, :, :] - expected[:, None, :]
    distance = np.hypot(away[..., 0], away[..., 1])
    turned = saddles.phase[None, :] - np.arctan2(diagonal[:, 1], diagonal[:, 0])[:, None]
    sign = np.cos(2 * turned) * parity[:, None]
    reach = np.minimum(_MARGIN_SIGMAS * near.sigma_px / plane.pixel_px + 0.5, 0.5 * side)
    index = np.arange(len(expected))
    for polarity in (1, -1):
        possible = np.where(sign * polarity > 0.5, distance, np.inf)
        nearest = possible.argmin(axis=1)
        close = possible[index, nearest] < reach
        if close.sum() < least:
            continue
        shift = np.median(away[index, nearest][close], axis=0)
        rest = np.where(sign * polarity > 0.5, np.hypot(away[..., 0] - shift[0], away[..., 1] - shift[1]), np.inf)
        nearest = rest.argmin(axis=1)
        close = rest[index, nearest] < 0.25 * side
        if close.sum() < least:
            continue
        points = np.where(close[:, None], saddles.points[nearest], np.nan)
        amplitude = float(np.median(saddles.amplitude[nearest[close]]))
        full = (points.reshape(size[1], size[0], 2) + 0.5) * plane.pixel_px - 0.5 + np.array(plane.origin_px)
        return Grid(full, polarity, amplitude)
    return None


def upright(grid: Grid, size: tuple[int, int], near: Prediction | None = None) -> Grid | None:
    """``grid`` turned by quarters so that it has ``size`` and its rows run down the picture; None for another size.

    Of the readings that have the size, the one whose columns run most to the right and rows most downwards; with a
    prediction the one nearest to it.
    """
    best: Grid | None = None
    best_value = -np.inf
    points, polarity = grid.points, grid.polarity
    for _ in range(4):
        if (points.shape[1], points.shape[0]) == size:
            value = _reading_value(points, near)
            if value > best_value:
                best, best_value = Grid(points, polarity, grid.amplitude), value
        # A quarter turn: columns run where rows ran. The first point is the old last row's first one, and the square
        # between its new directions is the one across an edge from the old first quadrant there.
        polarity = polarity * (-1) ** (points.shape[0] - 1) * -1
        points = np.swapaxes(points, 0, 1)[:, ::-1]
    return best


def cut_reading(grid: Grid, size: tuple[int, int], picture: Picture, near: Prediction | None) -> Grid | None:
    """``grid``, short of ``size`` in one direction, with the lines that the frame cuts off as NaN; None where in doubt.

    The cut end is the one where a further line would be out of the picture, if the other three sides are in it; with a
    prediction it is the end that fits it. At least half of the corners, and ``_LEAST_CUT``, must be in view.
    """
    best: Grid | None = None
    best_value = -np.inf
    points, polarity = grid.points, grid.polarity
    least = max(_LEAST_CUT, size[0] * size[1] / 2)
    for _ in range(4):
        missing = (size[1] - points.shape[0], size[0] - points.shape[1])
        if min(missing) == 0 and max(missing) > 0 and points.shape[0] * points.shape[1] >= least:
            axis = int(np.argmax(missing))
            out = _sides_out(points, picture)
            for end in (0, 1):
                # The frame tells only where this side alone is at it.
                if near is None and not (out[axis][end] and sum(map(sum, out)) == 1):
                    continue
                pad = [(0, 0), (0, 0), (0, 0)]
                pad[axis] = (missing[axis], 0) if end == 0 else (0, missing[axis])
                read = Grid(
                    np.pad(points, pad, constant_values=np.nan), polarity * (-1) ** pad[axis][0], grid.amplitude
                )
                value = _reading_value(read.points, near)
                if value > best_value:
                    best, best_value = read, value
        polarity = polarity * (-1) ** (points.shape[0] - 1) * -1
        points = np.swapaxes(points, 0, 1)[:, ::-1]
    if best is None or best.present < _LEAST_PRESENT * grid.points.shape[0] * grid.points.shape[1]:
        return None
    return best


def _reading_value(points: FloatArray, near: Prediction | None) -> float:
    """The greater, the likelier: columns to the right and rows downwards, or near to what is expected."""
    if near is not None:
        return -float(np.nansum((points.reshape(-1, 2) - near.points_px) ** 2))
    steps = mean_steps(points)
    lengths = np.linalg.norm(steps, axis=1)
    return float(steps[0, 0] / lengths[0] + steps[1, 1] / lengths[1])


def _sides_out(points_px: FloatArray, picture: Picture) -> tuple[tuple[bool, bool], tuple[bool, bool]]:
    """(top, bottom) and (left, right): whether a further line on that side is for the most part out of the picture."""
    grown = surrounded(points_px)

    def out(line: FloatArray) -> bool:
        known = line[np.isfinite(line).all(axis=1)]
        return len(known) > 0 and float(_inside(known, picture).mean()) < 0.5

    return (out(grown[0, 1:-1]), out(grown[-1, 1:-1])), (out(grown[1:-1, 0]), out(grown[1:-1, -1]))


def _levels(
    picture: Picture, colours: tuple[str, ...], near: Prediction | None, size: tuple[int, int]
) -> Iterator[tuple[int, Gray]]:
    """(factor, reduced channel) in the order of trial."""
    finest = 1
    while picture.shape[1] / finest > 2 * _FIRST_WIDTH_PX:
        finest *= 2
    first = 2 * finest
    order = [2 * first, first, 4 * first, finest]
    if near is not None:
        side = float(median_sides(steps_of(near.points_px.reshape(size[1], size[0], 2))).min())
        order = [factor for factor in (4, 2, 8, 1) if side / factor > _SMALLEST_STEP_PX * 1.2] or [1]
    kinds = _channels(colours)
    reduced: dict[int, Picture] = {}
    for number, kind in enumerate(kinds):
        for factor in order if number == 0 else order[:2]:
            if min(picture.shape[:2]) // factor < 16:
                continue
            if factor not in reduced:
                reduced[factor] = reduce_picture(picture, factor)
            yield factor, _channel(reduced[factor], kind)


def _channels(colours: tuple[str, ...]) -> list[str]:
    """Which channels to search, the likeliest first: the one in which the named colours differ most."""
    named = {colour.lower() for colour in colours}
    if named == {"red", "white"}:
        return ["blue-green", "luma", "red"]
    if named == {"red", "black"}:
        return ["red", "luma", "blue-green"]
    return ["luma", "red", "blue-green"]


def _channel(picture: Picture, kind: str) -> Gray:
    if kind == "red":
        plane = cv2.extractChannel(picture, 2)
    elif kind == "blue-green":
        plane = cv2.addWeighted(cv2.extractChannel(picture, 0), 0.5, cv2.extractChannel(picture, 1), 0.5, 0)
    else:
        plane = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    return np.asarray(plane, dtype=np.float32)


def _window(picture: Picture, size: tuple[int, int], near: Prediction) -> tuple[int, int, int, int] | None:
    """(left, top, right, bottom) of where the expected board may stand, one square and a half around it."""
    height, width = picture.shape[:2]
    sides = median_sides(steps_of(near.points_px.reshape(size[1], size[0], 2)))
    margin = _MARGIN_SIGMAS * near.sigma_px + 1.6 * float(sides.max()) + 8
    low = np.floor(near.points_px.min(axis=0) - margin).astype(np.int64)
    high = np.ceil(near.points_px.max(axis=0) + margin).astype(np.int64)
    left, top = max(int(low[0]), 0), max(int(low[1]), 0)
    right, bottom = min(int(high[0]) + 1, width), min(int(high[1]) + 1, height)
    return (left, top, right, bottom) if right - left >= 16 and bottom - top >= 16 else None


def _step(grid: Grid) -> float:
    return float(median_sides(steps_of(grid.points)).min())


def _fits(board: Board, near: Prediction) -> bool:
    away = board.points_px.reshape(-1, 2) - near.points_px
    return float(np.sqrt((away**2).mean())) < _MATCH_SIGMAS * near.sigma_px + 2 * board.error_px


def _inside(points: FloatArray, picture: Picture) -> FloatArray:
    edge = np.array([picture.shape[1], picture.shape[0]]) - 1.0
    return np.asarray(((points >= 0) & (points <= edge)).all(axis=-1), dtype=np.float64)


def _open_sides(points_px: FloatArray, picture: Picture) -> tuple[int, int]:
    """How many of (left and right, top and bottom) sides are so near the frame that a further line is out of it."""
    inside = _inside(surrounded(points_px), picture)
    left_right = [inside[1:-1, 0].mean(), inside[1:-1, -1].mean()]
    top_bottom = [inside[0, 1:-1].mean(), inside[-1, 1:-1].mean()]
    return sum(share < 0.5 for share in left_right), sum(share < 0.5 for share in top_bottom)


def _board(grid: Grid, picture: Picture, error_px: float, plane: Reduced) -> Board:
    points = grid.points
    there = np.isfinite(points[..., 0])
    seen = np.logical_and.outer(there.any(axis=1), there.any(axis=0))
    while not np.isfinite(points).all():
        expected = predict_missing(points)
        filled = np.where(np.isfinite(points), points, expected)
        if np.isfinite(filled).sum() == np.isfinite(points).sum():
            break
        points = filled
    return Board(points, grid.polarity, bool(_inside(surrounded(points), picture).mean() > 0.9), error_px, plane, seen)


def _choose(boards: list[Board], size: tuple[int, int], near: Prediction | None) -> Board | str | None:
    """The one board, a reason where there are several, None where there is none."""
    boards = [board for board in boards if np.isfinite(board.points_px).all()]
    whole = [board for board in boards if board.whole]
    boards = whole or boards
    if near is not None and len(boards) > 1:
        away = [float(((board.points_px.reshape(-1, 2) - near.points_px) ** 2).mean()) for board in boards]
        return boards[int(np.argmin(away))]
    if len(boards) > 1:
        return f"ambiguous: {len(boards)} boards with {size[0]}x{size[1]} inner corners are in view; cover all but one"
    return boards[0] if boards else None


def cut_too_far(board: Board, picture: Picture) -> bool:
    """Whether the frame hides so much that a larger board, cut on two neighbouring sides, would look the same."""
    columns, rows = _open_sides(board.points_px, picture)
    return columns > 0 and rows > 0


def _reason(others: list[Grid], size: tuple[int, int], picture: Picture, near: Prediction | None) -> str:
    wanted = f"{size[0]}x{size[1]}"
    place = " near where the board is expected" if near is not None else ""
    seen = [grid for grid in others if grid.present >= max(6, _LEAST_REPORTED * size[0] * size[1])]
    if not seen:
        return f"no chessboard pattern found{place} (not in view, too dark, too blurred, or its squares too small)"
    grid = max(seen, key=lambda grid: grid.present * grid.amplitude)
    turned = upright(grid, grid.size) or grid
    steps = mean_steps(turned.points)
    columns, rows = turned.size
    if abs(steps[0, 0]) < abs(steps[0, 1]):
        columns, rows = rows, columns
    if (columns, rows) == size or (rows, columns) == size:
        return f"only {grid.present} of {wanted} inner corners can be seen{place}: the board is partly hidden"
    cut = ""
    if sum(_open_sides(grid.points, picture)) > 0 and columns * rows < size[0] * size[1]:
        cut = ": the board is cut by the frame"
        if any(all(ends) for ends in _sides_out(grid.points, picture)):
            cut += ", both ends are at it: which of the corners these are cannot be told; turn one end into view"
    return f"found {columns}x{rows} of {wanted} inner corners{place}{cut}"
