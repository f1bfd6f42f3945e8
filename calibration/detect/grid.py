"""From corner candidates to grids: link neighbours, walk the links, complete rows.

Two candidates are neighbours when their bright diagonals are crossed (colours alternate), the line between them is
an edge all along with the bright side where both say, and each is the other's nearest such candidate in its quadrant.
Nothing is assumed about the lens: only neighbouring steps are compared.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calibration.detect.saddle import Saddles, sample
from calibration.types import FloatArray, IntArray

NEIGHBOURS_ASKED = 20
MOST_GRIDS = 12
_CROSSED_RAD = np.deg2rad(40)
_QUADRANT_MARGIN_RAD = np.deg2rad(10)
_AMPLITUDE_RATIO = 4.0
_EDGE_SHARE = 0.3
_SEARCH_STEPS = 0.3
_PATTERN_SHARE = 0.3
_PATTERN_BALANCE = 0.35
_LARGEST_SIDE = 80
_DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A grid of corners: ``points`` (rows, columns, 2), NaN where one is missing, in the pixels it was found in.

    Columns to rows turns the same way as u to v (never mirrored). ``polarity``: +1 where the quadrant between the
    column and the row direction at point (0, 0) is bright, -1 where it is dark; it alternates from point to point.
    ``amplitude`` median amplitude of its corners (coded values).
    """

    points: FloatArray
    polarity: int
    amplitude: float

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        return self.points.shape[1], self.points.shape[0]

    @property
    def present(self) -> int:
        """Number of corners that were seen."""
        return int(np.isfinite(self.points[..., 0]).sum())


def find_grids(saddles: Saddles, least: int = 4, longest: int = 20) -> list[Grid]:
    """The ``MOST_GRIDS`` largest grids of at least ``least`` linked corners, the one with most corners first.

    A grid that is longer than ``longest`` is not completed further: its size is then too small by what is missing.
    """
    if len(saddles.points) < least:
        return []
    neighbours = _link(saddles)
    weak = cKDTree(saddles.weak)
    grids: list[Grid] = []
    pieces = sorted((places for places in _walk(neighbours) if len(places) >= least), key=len, reverse=True)
    for places in pieces[:MOST_GRIDS]:
        columns = [place[0] for place in places.values()]
        rows = [place[1] for place in places.values()]
        width, height = max(columns) - min(columns) + 1, max(rows) - min(rows) + 1
        if min(width, height) < 2 or max(width, height) > _LARGEST_SIDE:
            continue
        points = np.full((height, width, 2), np.nan)
        for index, (column, row) in places.items():
            points[row - min(rows), column - min(columns)] = saddles.points[index]
        grid = _complete(points, saddles, float(np.median(saddles.amplitude[list(places)])), weak, longest)
        if grid is not None:
            grids.append(grid)
    return sorted(grids, key=lambda grid: -grid.present)


def _link(saddles: Saddles) -> IntArray:
    """(M, 4): the neighbour in each quadrant of a candidate's own frame (its bright diagonal), -1 where none."""
    points, phase, amplitude = saddles.points, saddles.phase, saddles.amplitude
    count = len(points)
    asked = min(NEIGHBOURS_ASKED + 1, count)
    nearest = cKDTree(points).query(points, k=asked)
    distance, other = np.asarray(nearest[0], dtype=np.float64), np.asarray(nearest[1], dtype=np.int64)
    first = np.repeat(np.arange(count), asked - 1)
    second, length = other[:, 1:].ravel(), distance[:, 1:].ravel()

    crossed = np.abs(np.remainder(phase[first] - phase[second], np.pi) - np.pi / 2) < _CROSSED_RAD
    ratio = amplitude[first] / amplitude[second]
    keep = crossed & (ratio < _AMPLITUDE_RATIO) & (ratio > 1 / _AMPLITUDE_RATIO) & (length > 0)
    first, second, length = first[keep], second[keep], length[keep]
    delta = points[second] - points[first]
    turned = np.remainder(np.arctan2(delta[:, 1], delta[:, 0]) - phase[first], 2 * np.pi)
    within = np.remainder(turned, np.pi / 2)
    keep = (within > _QUADRANT_MARGIN_RAD) & (within < np.pi / 2 - _QUADRANT_MARGIN_RAD)
    first, second, length, turned, delta = first[keep], second[keep], length[keep], turned[keep], delta[keep]

    along = np.array([0.2, 0.35, 0.5, 0.65, 0.8])[None, :, None]
    middle = points[first][:, None, :] + along * delta[:, None, :]
    across = 0.2 * np.column_stack([-delta[:, 1], delta[:, 0]])[:, None, :]
    step = sample(saddles.gray, middle + across) - sample(saddles.gray, middle - across)
    step *= -np.sign(np.sin(2 * turned))[:, None]
    needed = _EDGE_SHARE * np.minimum(amplitude[first], amplitude[second])
    keep = step.min(axis=1, initial=np.inf) > needed
    first, second, length, turned = first[keep], second[keep], length[keep], turned[keep]

    quadrant = np.minimum((turned / (np.pi / 2)).astype(np.int64), 3)
    order = np.lexsort((length, first * 4 + quadrant))
    first, second, quadrant = first[order], second[order], quadrant[order]
    slot, where = np.unique(first * 4 + quadrant, return_index=True)
    neighbours = np.full(count * 4, -1, dtype=np.int64)
    neighbours[slot] = second[where]
    table = neighbours.reshape(count, 4)
    mutual = (table[table] == np.arange(count)[:, None, None]).any(axis=2) & (table >= 0)
    return np.where(mutual, table, -1)


def _walk(neighbours: IntArray) -> list[dict[int, tuple[int, int]]]:
    """Connected candidates with their (column, row), one dictionary for each connected piece."""
    table = neighbours.tolist()
    seen = [False] * len(table)
    pieces: list[dict[int, tuple[int, int]]] = []
    for start in range(len(table)):
        if seen[start] or max(table[start]) < 0:
            continue
        seen[start] = True
        places = {start: (0, 0)}
        taken = {(0, 0)}
        turn = {start: 0}
        queue = deque([start])
        while queue:
            node = queue.popleft()
            column, row = places[node]
            for quadrant, other in enumerate(table[node]):
                if other < 0 or seen[other] or node not in table[other]:
                    continue
                direction = (quadrant + turn[node]) % 4
                place = (column + _DIRECTIONS[direction][0], row + _DIRECTIONS[direction][1])
                if place in taken:
                    continue
                seen[other] = True
                places[other] = place
                taken.add(place)
                turn[other] = (direction + 2 - table[other].index(node)) % 4
                queue.append(other)
        pieces.append(places)
    return pieces


def steps_of(points: FloatArray) -> FloatArray:
    """Local step vectors of a grid (rows, columns, 2) -> (rows, columns, 2, 2): [..., 0, :] to the next column.

    Central differences where both neighbours are there, one-sided else, NaN where neither is.
    """
    steps = np.full((*points.shape[:2], 2, 2), np.nan)
    for axis, which in ((1, 0), (0, 1)):
        forward = np.full_like(points, np.nan)
        backward = np.full_like(points, np.nan)
        difference = np.diff(points, axis=axis)
        if axis == 1:
            forward[:, :-1], backward[:, 1:] = difference, difference
        else:
            forward[:-1], backward[1:] = difference, difference
        both = (forward + backward) / 2
        one = np.where(np.isfinite(forward), forward, backward)
        steps[:, :, which] = np.where(np.isfinite(both), both, one)
    return steps


def mean_steps(points: FloatArray) -> FloatArray:
    """(2, 2): the mean step along columns and along rows, NaN where no two neighbours are there."""
    steps = steps_of(points).reshape(-1, 2, 2)
    known = np.isfinite(steps)
    total = np.where(known, steps, 0.0).sum(axis=0)
    count = known.sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan), dtype=np.float64)


def predict_missing(points: FloatArray) -> FloatArray:
    """Where the points of a grid are expected from their neighbours along rows and columns, NaN where nothing tells."""
    guesses: list[FloatArray] = []
    for axis in (0, 1):
        moved = np.moveaxis(points, axis, 0)
        padded = np.concatenate([np.full((2, *moved.shape[1:]), np.nan), moved, np.full((2, *moved.shape[1:]), np.nan)])
        for guess in (
            (padded[1:-3] + padded[3:-1]) / 2,
            2 * padded[1:-3] - padded[:-4],
            2 * padded[3:-1] - padded[4:],
        ):
            guesses.append(np.moveaxis(guess, 0, axis))
    stack = np.stack(guesses)
    weight = np.isfinite(stack) * np.array([4.0, 1.0, 1.0, 4.0, 1.0, 1.0])[:, None, None, None]
    total = weight.sum(axis=0)
    mean = np.nansum(np.where(weight > 0, stack, 0.0) * weight, axis=0) / np.maximum(total, 1)
    return np.asarray(np.where(total > 0, mean, np.nan), dtype=np.float64)


def corner_pattern(saddles: Saddles, points: FloatArray, steps: FloatArray) -> FloatArray:
    """Signed strength (coded values) of the corner pattern at ``points`` (K, 2) with local ``steps`` (K, 2, 2).

    The smaller of the two alternations across the four quadrants where both have one sign, else 0; positive where the
    quadrant between the column and the row step is bright.
    """
    right, down = 0.25 * steps[:, 0], 0.25 * steps[:, 1]
    value = sample(saddles.gray, np.stack([points + right + down, points - right + down, points - right - down,
                                           points + right - down], axis=1))  # fmt: skip
    pairs = np.stack([value[:, 0] - value[:, 1], value[:, 2] - value[:, 3], value[:, 0] - value[:, 3],
                      value[:, 2] - value[:, 1]])  # fmt: skip
    low, high = pairs.min(axis=0), pairs.max(axis=0)
    # Outside a board's outline two quadrants are alike: one pair alternates, the other is left to chance.
    bright = (low > 0) & (low > _PATTERN_BALANCE * high)
    dark = (high < 0) & (high < _PATTERN_BALANCE * low)
    return np.asarray(np.where(bright, low, np.where(dark, high, 0.0)), dtype=np.float64)


def _complete(points: FloatArray, saddles: Saddles, amplitude: float, weak: cKDTree, longest: int) -> Grid | None:
    """Fill holes and add rows and columns that the links missed, drop stray points; None where nothing holds up."""
    strength = _strengths(points, saddles)
    parity = _parity(points.shape[0], points.shape[1])
    signs = np.sign(strength) * parity
    polarity = 1 if np.nansum(signs) >= 0 else -1
    points = np.where((signs == polarity)[..., None], points, np.nan)
    points = _trim(points)
    if min(points.shape[:2]) < 2:
        return None
    polarity = _polarity(points, saddles)
    size = (saddles.gray.shape[1], saddles.gray.shape[0])
    for _ in range(longest):
        if max(points.shape[:2]) > longest:
            break
        grown = np.full((points.shape[0] + 2, points.shape[1] + 2, 2), np.nan)
        grown[1:-1, 1:-1] = points
        expected = predict_missing(grown)
        missing = ~np.isfinite(grown[..., 0]) & np.isfinite(expected[..., 0])
        margin = 1.0
        inside = (expected > margin).all(axis=2) & (expected < np.array(size) - 1 - margin).all(axis=2)
        places = np.argwhere(missing & inside)
        filled = _pick(grown, expected, places, polarity, saddles, amplitude, weak)
        # A new outer row counts only when half of what the picture could show of it is there.
        for line in (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]):
            possible = int((missing & inside)[line].sum())
            got = np.isfinite(filled[line][:, 0])
            if got.sum() < max(2, 0.5 * possible):
                filled[line] = np.nan
        rows = slice(0 if np.isfinite(filled[0]).any() else 1, None if np.isfinite(filled[-1]).any() else -1)
        columns = slice(0 if np.isfinite(filled[:, 0]).any() else 1, None if np.isfinite(filled[:, -1]).any() else -1)
        new = filled[rows, columns]
        flips = (1 - (rows.start or 0)) + (1 - (columns.start or 0))
        changed = new.shape != points.shape or int(np.isfinite(new).sum()) != int(np.isfinite(points).sum())
        points, polarity = new, polarity * (-1) ** flips
        if not changed:
            break
    return Grid(points, polarity, amplitude)


def _pick(
    points: FloatArray,
    expected: FloatArray,
    places: IntArray,
    polarity: int,
    saddles: Saddles,
    amplitude: float,
    weak: cKDTree,
) -> FloatArray:
    """``points`` with the saddles that stand where ``expected`` says and alternate as the grid does."""
    filled = points.copy()
    if not len(places):
        return filled
    steps = steps_of(np.where(np.isfinite(points), points, expected))[places[:, 0], places[:, 1]]
    guess = expected[places[:, 0], places[:, 1]]
    reach = _SEARCH_STEPS * np.linalg.norm(steps, axis=2).min(axis=1)
    good = np.isfinite(reach)
    places, steps, guess, reach = places[good], steps[good], guess[good], reach[good]
    if not len(places):
        return filled
    nearest = weak.query(guess)
    distance, index = np.asarray(nearest[0], dtype=np.float64), np.asarray(nearest[1], dtype=np.int64)
    near = distance < reach
    places, steps, index = places[near], steps[near], index[near]
    if not len(places):
        return filled
    found = saddles.weak[index]
    strength = corner_pattern(saddles, found, steps) * polarity * (-1.0) ** places.sum(axis=1)
    for (row, column), point, value in zip(places.tolist(), found, strength.tolist(), strict=True):
        if value > _PATTERN_SHARE * amplitude:
            filled[row, column] = point
    return filled


def _parity(rows: int, columns: int) -> FloatArray:
    return np.asarray((-1.0) ** (np.arange(rows)[:, None] + np.arange(columns)[None, :]), dtype=np.float64)


def _strengths(points: FloatArray, saddles: Saddles) -> FloatArray:
    steps = steps_of(points)
    known = np.isfinite(points[..., 0]) & np.isfinite(steps).all(axis=(2, 3))
    strength = np.zeros(points.shape[:2])
    strength[known] = corner_pattern(saddles, points[known], steps[known])
    return strength


def _polarity(points: FloatArray, saddles: Saddles) -> int:
    return 1 if (np.sign(_strengths(points, saddles)) * _parity(*points.shape[:2])).sum() >= 0 else -1


def _trim(points: FloatArray) -> FloatArray:
    """Without outer rows and columns of which less than 40 % is there (stray links)."""
    while min(points.shape[:2]) >= 2:
        there = np.isfinite(points[..., 0])
        lines = [there[0].mean(), there[-1].mean(), there[:, 0].mean(), there[:, -1].mean()]
        worst = int(np.argmin(lines))
        if lines[worst] >= 0.4:
            break
        points = (points[1:], points[:-1], points[:, 1:], points[:, :-1])[worst]
    return points
