"""Plain filled quadrilaterals in a picture, roughly: where they are and how well each one is such a thing.

Works on a reduced picture; the corners are good to a pixel or two and only start the fit of the edges.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.detect.mask import Channel, ColourField
from calibration.types import FloatArray

LEAST_SIDE = 5.0
"""Shortest side, in pixels of the reduced picture, at which a shape can still be told."""

# Largest tilt of the target's plane that is accepted, as its cosine: beyond 60 degrees an edge-on thing of any
# shape fits, and its corners are poorly determined.
_LEAST_TILT_COS = 0.5
_LEAST_FILL = 0.88
_MOST_OF_ONE_COLOUR = 0.1
"""Largest difference of purity, as a share, within one paint under one lamp."""
# What a thing in front may hide: of the whole, and of each side.
_LEAST_LEFT, _LEAST_OUTLINE, _LEAST_OF_SIDE = 0.7, 0.6, 0.35
_WHOLE_OUTLINE = 0.85
_LEAST_HIDDEN_PERIMETER = 80.0
"""A smaller outline with a corner missing could be anything."""
_MOST_LINES = 6
_HIDDEN_COUNTS = 0.2
"""How much a missing part of the outline counts beside a missing part of the area."""
_GRID = 8
_MOST_SAMPLES = 1500
_NEXT = np.array([1, 2, 3, 0])
_BEFORE = np.array([3, 0, 1, 2])


@dataclass(frozen=True, slots=True, eq=False)
class Quad:
    """A candidate: ``corners`` (4, 2) clockwise from the top left, reduced pixels.

    ``fill`` overlap of the region with the quadrilateral (0..1), ``tilt_cos`` cosine of the tilt that its shape
    implies for the target's true proportions, ``side`` length of a square of the same area, ``unevenness`` deviation
    of its light or its colour from a smooth gradient over the median, whichever is less, ``strength`` and ``purity`` of
    its colour, ``cut`` whether the frame cuts it.
    """

    corners: FloatArray
    fill: float
    tilt_cos: float
    unevenness: float
    strength: float
    purity: float
    cut: bool
    side: float

    @property
    def score(self) -> float:
        """How much it is a plain, saturated quadrilateral of the right proportions; only ratios mean anything.

        Shape and evenness decide; colour and size tell apart things that are equal in these, with small powers
        because lamps and distances change them.
        """
        return float(
            _shape_score(self.fill, self.tilt_cos)
            * math.exp(-((self.unevenness / 0.12) ** 2))
            * math.sqrt(self.strength)
            * self.purity**2
            * self.side**0.3
        )


def find_quads(
    field: ColourField, size_m: tuple[float, float], *, frame_edges: tuple[bool, bool, bool, bool]
) -> list[Quad]:
    """Candidates in a reduced picture, best first, each place once.

    ``size_m``: the target's width and height. ``frame_edges``: which borders of this field (left, top, right, bottom)
    are borders of the whole picture; a region that touches another border is no candidate, one that touches
    a border of the picture is reported as cut.
    """
    shapes: list[_Shape] = []
    seen: set[tuple[int, ...]] = set()
    for plane, level in field.levels:
        binary = (plane > level).view(np.uint8)
        contours, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for outline in contours:
            contour = np.asarray(outline, dtype=np.int32)
            if len(contour) < 4 * LEAST_SIDE - 8:
                continue
            # A sharp region has the same outline at most levels: one judgement is enough.
            left, top, width, height = cv2.boundingRect(contour)
            area = cv2.contourArea(contour)
            grain = max(2, max(width, height) // 16)
            box = (left // grain, top // grain, (left + width) // grain, (top + height) // grain)
            key = (*box, int(25 * math.log(area + 1.0)))
            if min(width, height) < LEAST_SIDE or key in seen:
                continue
            seen.add(key)
            shape = _shape_of(contour, (left, top, width, height), field.strength.shape, size_m, frame_edges)
            if shape is not None:
                _keep_best(shapes, shape)
    quads = [_with_colour(shape, field) for shape in shapes]
    ranked = sorted((quad for quad in quads if quad is not None), key=lambda quad: -quad.score)
    return [quad for quad in ranked if not any(_is_lit_part(quad, other) for other in ranked)]


def _is_lit_part(quad: Quad, whole: Quad) -> bool:
    """Whether a candidate is the lit part of a target across which a shadow falls.

    It lies in the whole, which has its colour throughout and is the better shape of the two.
    """
    if quad.side > 0.97 * whole.side or whole.cut or whole.unevenness > _MOST_OF_ONE_COLOUR:
        return False
    if abs(quad.purity - whole.purity) > _MOST_OF_ONE_COLOUR * whole.purity:
        return False
    if _shape_score(quad.fill, quad.tilt_cos) > _shape_score(whole.fill, whole.tilt_cos):
        return False
    outline = np.asarray(whole.corners, dtype=np.float32)
    slack = 2.0 + 0.03 * whole.side
    return all(cv2.pointPolygonTest(outline, (float(u), float(v)), True) > -slack for u, v in quad.corners)


def clockwise_from_top_left(corners: FloatArray) -> FloatArray:
    """Order four corners clockwise (rows down), beginning with the one that is top left when read upright."""
    centre = corners.mean(axis=0)
    angle = np.arctan2(corners[:, 1] - centre[1], corners[:, 0] - centre[0])
    ordered = corners[np.argsort(angle)]
    # The top side is the one whose direction is nearest to +u.
    sides = ordered[_NEXT] - ordered
    first = int(np.argmax(sides[:, 0] / np.maximum(np.hypot(sides[:, 0], sides[:, 1]), 1e-9)))
    return np.asarray(ordered[(np.arange(4) + first) % 4], dtype=np.float64)


def homography(corners: FloatArray, size_m: tuple[float, float]) -> FloatArray:
    """Plane (metres, origin at the target's centre, rows down) to pixels, (3, 3), from the four corners clockwise."""
    half_w, half_h = size_m[0] / 2, size_m[1] / 2
    plane = np.array([[-half_w, -half_h], [half_w, -half_h], [half_w, half_h], [-half_w, half_h]], dtype=np.float32)
    return np.asarray(cv2.getPerspectiveTransform(plane, corners.astype(np.float32)), dtype=np.float64)


def tilt_cosine(corners: FloatArray, size_m: tuple[float, float]) -> float:
    """Cosine of the angle between the plane's normal and the line of sight, as the four corners imply it.

    At its centre the picture of the plane is affine, x' = J x; seen from far away (weak perspective) J has the
    singular values s and s cos(tilt), so their ratio is the cosine, for the target's true width and height.
    """
    h = homography(corners, size_m)
    if not np.isfinite(h).all() or abs(h[2, 2]) < 1e-12:
        return 0.0
    h = h / h[2, 2]
    jacobian = h[:2, :2] - np.outer(h[:2, 2], h[2, :2])
    # Of a 2 x 2 matrix: s1 s2 = |det|, s1^2 + s2^2 = squared Frobenius norm.
    total = float(np.sum(jacobian**2))
    product = abs(float(jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]))
    root = math.sqrt(max(total * total / 4 - product * product, 0.0))
    return product / (total / 2 + root) if total > 0 else 0.0


def _area(corners: FloatArray) -> float:
    u, v = corners[:, 0], corners[:, 1]
    return float(abs(np.dot(u, v[_NEXT]) - np.dot(v, u[_NEXT])) / 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Shape:
    """A quadrilateral outline before its colour is judged (see ``Quad``)."""

    corners: FloatArray
    centre: tuple[float, float]
    fill: float
    tilt_cos: float
    side: float
    cut: bool

    @property
    def score(self) -> float:
        return _shape_score(self.fill, self.tilt_cos)


def _shape_score(fill: float, tilt_cos: float) -> float:
    return float(math.exp(-(((1.0 - fill) / 0.08) ** 2)) * tilt_cos**1.5)


def _keep_best(shapes: list[_Shape], shape: _Shape) -> None:
    """Add an outline unless a better one stands in the same place; a worse one there goes."""
    for index, other in enumerate(shapes):
        apart = math.dist(other.centre, shape.centre)
        if apart < 0.25 * min(shape.side, other.side) and 0.6 < shape.side / other.side < 1.6:
            if shape.score > other.score:
                shapes[index] = shape
            return
    shapes.append(shape)


def _shape_of(
    contour: NDArray[np.int32],
    box: tuple[int, int, int, int],
    field_shape: tuple[int, ...],
    size_m: tuple[float, float],
    frame_edges: tuple[bool, bool, bool, bool],
) -> _Shape | None:
    left, top, wide, tall = box
    height, width = field_shape[:2]
    touched = (left <= 0, top <= 0, left + wide >= width, top + tall >= height)
    if any(touch and not border for touch, border in zip(touched, frame_edges, strict=True)):
        return None
    hull = np.asarray(cv2.convexHull(contour), dtype=np.int32)
    # A contour runs through the centres of the outermost pixels, half a pixel inside the region.
    perimeter = cv2.arcLength(hull, True)
    area = cv2.contourArea(contour) + cv2.arcLength(contour, True) / 2
    share = area / (cv2.contourArea(hull) + perimeter / 2)
    cut = any(touched)
    rough = _rough_corners(hull, perimeter) if share >= _LEAST_FILL else None
    if not cut and share >= _LEAST_LEFT and perimeter >= _LEAST_HIDDEN_PERIMETER:
        points = contour.reshape(-1, 2)
        if rough is None or _outline_share(rough, points, perimeter) < _WHOLE_OUTLINE:
            hidden = _half_hidden(hull, points, perimeter, area, size_m)
            if hidden is not None:
                return hidden
    if rough is None:
        return None
    tilt_cos = _cut_tilt(touched, (wide, tall), size_m) if cut else tilt_cosine(rough, size_m)
    if tilt_cos < _LEAST_TILT_COS - 0.1:
        return None
    corners = _fitted_corners(rough, contour.reshape(-1, 2))
    if corners is None:
        return None
    edges = corners[_NEXT] - corners
    if np.hypot(edges[:, 0], edges[:, 1]).min() < LEAST_SIDE:
        return None
    full = _area(corners)
    fill = min(area / full, full / area)
    if not cut:
        tilt_cos = tilt_cosine(corners, size_m)
    if fill < _LEAST_FILL or tilt_cos < _LEAST_TILT_COS:
        return None
    centre = corners.mean(axis=0)
    return _Shape(corners, (float(centre[0]), float(centre[1])), fill, tilt_cos, math.sqrt(full), cut)


def _half_hidden(
    hull: NDArray[np.int32],
    points: NDArray[np.int32],
    perimeter: float,
    area: float,
    size_m: tuple[float, float],
) -> _Shape | None:
    """A quadrilateral of which something in front hides a part: the four straight pieces of its outline that hold
    the most of it, each prolonged to its neighbours. What is hidden is only missing: nothing may stand outside.
    """
    polygon = cv2.approxPolyDP(hull, 0.012 * perimeter, True).reshape(-1, 2).astype(np.float64)
    length = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1)
    kept = [int(i) for i in np.argsort(-length)[:_MOST_LINES] if length[i] > 0.06 * perimeter]
    if length[kept].sum() < _LEAST_OUTLINE * perimeter:
        return None
    best: tuple[float, FloatArray] | None = None
    for four in itertools.combinations(sorted(kept), 4):
        starts = polygon[list(four)]
        ways = (polygon[(np.array(four) + 1) % len(polygon)] - starts) / length[list(four), None]
        corners = _crossings(starts, ways)
        if corners is None or not _LEAST_LEFT < area / _area(corners) < 1.05:
            continue
        corners = clockwise_from_top_left(corners)
        outline = _outline_share(corners, points, perimeter)
        if outline < _LEAST_OUTLINE or (best is not None and outline <= best[0]):
            continue
        if tilt_cosine(corners, size_m) >= _LEAST_TILT_COS:
            best = (outline, corners)
    if best is None:
        return None
    fitted = _fitted_corners(best[1], points, hidden=True)
    if fitted is None:
        return None
    tilt_cos = tilt_cosine(fitted, size_m)
    full = _area(fitted)
    outline = _outline_share(fitted, points, perimeter)
    if outline < _LEAST_OUTLINE or tilt_cos < _LEAST_TILT_COS or not _LEAST_LEFT < area / full < 1.05:
        return None
    centre = fitted.mean(axis=0)
    fill = 1 - _HIDDEN_COUNTS * (1 - outline)
    return _Shape(fitted, (float(centre[0]), float(centre[1])), fill, tilt_cos, math.sqrt(full), False)


def _crossings(starts: FloatArray, ways: FloatArray) -> FloatArray | None:
    """Where each of four lines (4, 2) crosses the one before it; None where two are nearly parallel."""
    before, before_way = starts[_BEFORE], ways[_BEFORE]
    cross = before_way[:, 0] * ways[:, 1] - before_way[:, 1] * ways[:, 0]
    if np.any(np.abs(cross) < 0.2):
        return None
    apart = starts - before
    step = (apart[:, 0] * ways[:, 1] - apart[:, 1] * ways[:, 0]) / cross
    return np.asarray(before + before_way * step[:, None], dtype=np.float64)


def _outline_share(corners: FloatArray, points: NDArray[np.int32], perimeter: float) -> float:
    """Share (0..1) of a quadrilateral's outline on which a contour's points (N, 2) lie; 0 if a side has too few."""
    thin = max(1, len(points) // 400)
    sample = points[::thin].astype(np.float64)
    along = corners[_NEXT] - corners
    length = np.hypot(along[:, 0], along[:, 1])
    # A contour has a point for each step along the longer of the two directions.
    expected = np.maximum(np.abs(along).max(axis=1) / thin, 1.0)
    along = along / np.maximum(length, 1e-9)[:, None]
    place = sample @ along.T - np.sum(corners * along, axis=1)
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    off = np.abs(sample @ outward.T - np.sum(corners * outward, axis=1))
    on = (off < 1.3 + 0.003 * perimeter) & (place > -1) & (place < length + 1)
    count = np.minimum(on.sum(axis=0), expected)
    if np.any(count < _LEAST_OF_SIDE * expected):
        return 0.0
    return float(count.sum() / expected.sum())


def _with_colour(shape: _Shape, field: ColourField) -> Quad | None:
    strength, purity, unevenness = _inside(shape.corners, field)
    if not math.isfinite(unevenness):
        return None
    return Quad(shape.corners, shape.fill, shape.tilt_cos, unevenness, strength, purity, shape.cut, shape.side)


def _cut_tilt(touched: tuple[bool, bool, bool, bool], extent: tuple[int, int], size_m: tuple[float, float]) -> float:
    """Bound of the tilt's cosine for a region that the frame cuts: what is seen of it is a least extent."""
    wide, tall = extent[0] / size_m[0], extent[1] / size_m[1]
    cut_across, cut_down = touched[0] or touched[2], touched[1] or touched[3]
    if cut_across and cut_down:
        return 1.0
    return float(min(1.0, tall / wide)) if cut_across else float(min(1.0, wide / tall))


def _rough_corners(hull: NDArray[np.int32], perimeter: float) -> FloatArray | None:
    """Corners (4, 2), clockwise, of a hull that simplifies to four."""
    for fraction in (0.02, 0.03, 0.045, 0.065, 0.09, 0.115):
        polygon = cv2.approxPolyDP(hull, fraction * perimeter, True)
        if len(polygon) == 4:
            return clockwise_from_top_left(polygon.reshape(4, 2).astype(np.float64))
        if len(polygon) < 4:
            return None
    return None


def _fitted_corners(rough: FloatArray, contour: NDArray[np.int32], *, hidden: bool = False) -> FloatArray | None:
    """Corners (4, 2), clockwise: crossings of lines through the contour's points between the rough corners.

    ``hidden``: points off a first line are left out, as they may be the outline of what is in front.
    """
    along = rough[_NEXT] - rough
    length = np.hypot(along[:, 0], along[:, 1])
    if length.min() < LEAST_SIDE - 2:
        return None
    along /= length[:, None]
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    points = contour[:: max(1, len(contour) // 200)].astype(np.float64)
    place = points @ along.T - np.sum(rough * along, axis=1)  # (N, 4): along each side
    off = points @ outward.T - np.sum(rough * outward, axis=1)
    reach = np.maximum(2.0, (0.02 if hidden else 0.06) * length)
    near = ((np.abs(off) < reach) & (np.abs(place - length / 2) < 0.4 * length)).astype(float)
    mean_place, mean_off, slope, rms = _lines_through(near, place, off)
    if hidden:
        apart = np.abs(off - mean_off - slope * (place - mean_place))
        near *= apart < np.maximum(1.0, 1.5 * rms)
        mean_place, mean_off, slope, rms = _lines_through(near, place, off)
    if near.sum(axis=0).min() < 3 or np.any(rms > np.maximum(0.7, 0.025 * length)):
        return None
    # A contour runs through the centres of the outermost pixels, half a pixel inside the region.
    start = rough + along * mean_place[:, None] + outward * (mean_off + 0.5)[:, None]
    return _crossings(start, along + outward * slope[:, None])


def _lines_through(
    near: FloatArray, place: FloatArray, off: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Lines through the points (N, 4) with weight ``near``: mean place and offset, slope and RMS, (4,) each."""
    count = np.maximum(near.sum(axis=0), 1.0)
    mean_place, mean_off = (near * place).sum(axis=0) / count, (near * off).sum(axis=0) / count
    from_place, from_off = near * (place - mean_place), near * (off - mean_off)
    slope = (from_place * from_off).sum(axis=0) / np.maximum((from_place**2).sum(axis=0), 1e-9)
    rms = np.sqrt(((from_off - slope * from_place) ** 2).sum(axis=0) / count)
    return mean_place, mean_off, slope, rms


def _inside(corners: FloatArray, field: ColourField) -> tuple[float, float, float]:
    """Median strength and purity inside, and the unevenness, of the light or of the colour, whichever is less."""
    height, width = field.strength.shape
    low = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(corners.max(axis=0)), [width - 1, height - 1]).astype(int)
    step = max(1, int(math.sqrt(float(np.prod(high - low + 1)) / _MOST_SAMPLES)))
    u, v = np.meshgrid(np.arange(low[0], high[0] + 1, step), np.arange(low[1], high[1] + 1, step))
    inverse = np.linalg.inv(homography(corners, (1.0, 1.0)))
    place = inverse @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    x, y = place[0] / place[2], place[1] / place[2]
    # The rim is mixed with the surroundings: two pixels and a tenth of the side are left out.
    reach = 0.4 - min(0.2, 2.0 / max(1.0, math.sqrt(_area(corners))))
    inner = (np.abs(x) < reach) & (np.abs(y) < reach)
    count = int(np.count_nonzero(inner))
    if count < 4:
        return 0.0, 0.0, math.nan
    values: Channel = field.strength[v.ravel()[inner], u.ravel()[inner]]
    purity: Channel = field.purity[v.ravel()[inner], u.ravel()[inner]]
    strength = float(np.median(values))
    grid = int(np.clip(math.sqrt(count / 12), 2, _GRID))
    cell_x = np.clip(((x[inner] / reach + 1) / 2 * grid).astype(int), 0, grid - 1)
    cell_y = np.clip(((y[inner] / reach + 1) / 2 * grid).astype(int), 0, grid - 1)
    cell = cell_y * grid + cell_x
    pure = float(np.median(purity))
    if strength <= 0:
        return strength, pure, 0.0
    # A shadow's edge changes the light but not the colour; a pattern or another thing changes both.
    return strength, pure, min(_unevenness(values, cell, grid), _unevenness(purity, cell, grid))


def _unevenness(values: Channel, cell: NDArray[np.int64], grid: int) -> float:
    """Deviation of the cells' means from a plane, over the median."""
    number = np.bincount(cell, minlength=grid * grid)
    full = number > 0
    if np.count_nonzero(full) < 4:
        return 0.0
    mean = np.bincount(cell, weights=values, minlength=grid * grid)[full] / number[full]
    where = np.flatnonzero(full)
    plane = np.column_stack([np.ones(len(where)), where % grid, where // grid]).astype(np.float64)
    rest = mean - plane @ np.linalg.lstsq(plane, mean, rcond=None)[0]
    return float(np.sqrt(np.mean(rest**2))) / max(float(np.median(values)), 1e-6)
