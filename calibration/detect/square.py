"""The plain square: found by its shape among other things of its colour, measured by its blurred sides.

First a rough search on a reduced picture (``mask``, ``quads``), which decides WHICH thing is the target; then the
four sides are fitted to the pixels of the full picture in linear light (``edge``) and the corners are their
crossings.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from calibration.detect.mask import KNOWN_COLOURS, colour_field
from calibration.detect.prediction import Prediction
from calibration.detect.quads import Quad, find_quads
from calibration.detect.side import Side, corner_of
from calibration.detect.sides import fit_sides
from calibration.errors import InvalidInput
from calibration.image import Transfer
from calibration.types import (
    Detection,
    DetectionResult,
    FloatArray,
    Picture,
    Quality,
    Refusal,
    Target,
    TargetKind,
)

LEAST_SIDE_PX = 12.0
"""Shortest side that is measured."""

_COARSE_WIDTH = 960
_COARSE_MOST_FACTOR = 3
# The best candidate must beat the next by this factor; two squares of one colour and nearly one size are a tie.
_CLEARLY_BETTER = 1.35
_MOST_READINGS = 2
"""How many other outlines of the chosen thing are tried where its first one has no edges."""
_LEAST_USED = 0.35
_MOST_SIGMA_PX = 1.0
"""A corner less certain than this is left out; fewer than three are no target."""
_LEAST_CORNERS = 3
_PIXEL_VARIANCE = 1.0 / 12.0
_ROW_BY_ROW = (0, 1, 3, 2)
"""Clockwise corners (TL, TR, BR, BL) in the target's order (TL, TR, BL, BR)."""


def find_square(
    picture: Picture,
    target: Target,
    *,
    transfer: Transfer = Transfer.BT709,
    near: Prediction | None = None,
) -> DetectionResult:
    """Find a filled quadrilateral (``TargetKind.SQUARE``) and its four corners.

    ``picture`` (H, W, 3) uint8 BGR; ``transfer``: how its light is coded; ``near``: expected corners (4, 2) in px in
    the target's order (top left, top right, bottom left, bottom right) with their sigma: only that part is searched.

    Returns corners in that order, upright reading (roll within 45 degrees), with covariance (px^2), the crossing of
    the diagonals as centre (a corner that something hides is where its sides cross; too uncertain, it is left out),
    and the Gaussian sigma of the blur without the pixel's own. A refusal gives the reason:
    not found, cut by the frame, too small, several equally good candidates, edges too weak. Raises
    :class:`InvalidInput` for a target of another kind or a picture of the wrong shape.
    """
    if target.kind is not TargetKind.SQUARE or target.size_m is None:
        raise InvalidInput("target kind", str(target.kind), "this search is for a square")
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise InvalidInput("picture", picture.shape, "must be (H, W, 3) uint8")
    colour = target.colours[0].lower() if target.colours else "red"
    if colour not in KNOWN_COLOURS:
        return Refusal(f"a square of colour {colour!r} is not known; use one of {', '.join(KNOWN_COLOURS)}")
    chosen = _search(picture, colour, target.size_m, transfer, near)
    if isinstance(chosen, Refusal):
        return chosen
    refused: Refusal | None = None
    for corners, uncertainty_px in chosen:
        result = _fitted(picture, corners, uncertainty_px, colour, transfer)
        if isinstance(result, Detection):
            return result
        refused = refused or result
    return refused or Refusal(f"no {colour} square was found")


def _fitted(
    picture: Picture, corners: FloatArray, uncertainty_px: float, colour: str, transfer: Transfer
) -> DetectionResult:
    """The square whose rough ``corners`` (4, 2), clockwise, are off by up to ``uncertainty_px``; or why not."""
    shortest = float(np.min(np.linalg.norm(corners[[1, 2, 3, 0]] - corners, axis=1)))
    if shortest < LEAST_SIDE_PX - 1:
        return Refusal(f"the {colour} square is too small: side {shortest:.0f} px, at least {LEAST_SIDE_PX:.0f} needed")
    sides = fit_sides(picture, corners, transfer=transfer, uncertainty_px=uncertainty_px)
    if sides is None:
        return Refusal(f"the {colour} square's edges are too weak to be measured")
    return _measured(picture, corners, sides, colour, uncertainty_px)


def _search(
    picture: Picture, colour: str, size_m: tuple[float, float], transfer: Transfer, near: Prediction | None
) -> list[tuple[FloatArray, float]] | Refusal:
    """Rough corners (4, 2) clockwise in px and how far off they may be, the likeliest first; or why there are none.

    All of them are readings of one thing: a shadow on the target may part it at some levels.
    """
    height, width = picture.shape[:2]
    window = (0, 0, width, height) if near is None else _window(near, width, height)
    if window is None:
        return Refusal("the expected place of the square lies outside the picture")
    left, top, right, bottom = window
    part = picture[top:bottom, left:right]
    factor = max(1, min(_COARSE_MOST_FACTOR, round(max(part.shape[:2]) / _COARSE_WIDTH)))
    small = part
    if factor > 1:
        size = (max(1, part.shape[1] // factor), max(1, part.shape[0] // factor))
        small = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    field = colour_field(small, colour, transfer)
    edges = (left == 0, top == 0, right == width, bottom == height)
    scale = np.array([part.shape[1] / small.shape[1], part.shape[0] / small.shape[0]])
    # The centre of a reduced pixel lies in the middle of the pixels it stands for.
    offset = (scale - 1) / 2 + np.array([left, top])
    quads = find_quads(field, size_m, frame_edges=edges)
    if near is not None:
        quads = [quad for quad in quads if quad.cut or _agrees(quad.corners * scale + offset, near)]
    found = _choose(quads, colour, scale, offset, narrowed=near is not None)
    if isinstance(found, Refusal):
        return found
    same = [quad for quad in quads if quad is not found and not quad.cut and _overlap(quad, found)]
    return [
        (quad.corners * scale + offset, 2.0 * float(scale.max()) + 0.02 * quad.side * float(scale.mean()))
        for quad in [found, *same[:_MOST_READINGS]]
    ]


def _overlap(one: Quad, other: Quad) -> bool:
    """Whether the centre of one of two candidates lies in the other."""
    pairs = ((one, other), (other, one))
    return any(
        cv2.pointPolygonTest(a.corners.astype(np.float32), b.corners.mean(axis=0).tolist(), False) > 0 for a, b in pairs
    )


def _window(near: Prediction, width: int, height: int) -> tuple[int, int, int, int] | None:
    """Part of the picture (left, top, right, bottom) that holds the expected corners and some surroundings."""
    low, high = near.points_px.min(axis=0), near.points_px.max(axis=0)
    room = 3 * near.sigma_px + 0.15 * float(np.max(high - low)) + 12
    left, top = max(0, math.floor(low[0] - room)), max(0, math.floor(low[1] - room))
    right, bottom = min(width, math.ceil(high[0] + room) + 1), min(height, math.ceil(high[1] + room) + 1)
    return (left, top, right, bottom) if right - left > 4 and bottom - top > 4 else None


def _agrees(clockwise: FloatArray, near: Prediction) -> bool:
    """Whether rough corners lie where they are expected: within four sigma and what the rough search may be off."""
    if near.points_px.shape != (4, 2):
        return True
    off = np.linalg.norm(clockwise[list(_ROW_BY_ROW)] - near.points_px, axis=1)
    side = float(np.linalg.norm(clockwise[2] - clockwise[0])) / math.sqrt(2)
    return bool(np.max(off) < 4 * near.sigma_px + 4 + 0.05 * side)


def _choose(quads: list[Quad], colour: str, scale: FloatArray, offset: FloatArray, *, narrowed: bool) -> Quad | Refusal:
    """The target among the candidates, or why it cannot be told; a place is px = reduced px * scale + offset."""
    whole = [quad for quad in quads if not quad.cut]
    cut = [quad for quad in quads if quad.cut]
    where = " where it is expected" if narrowed else ""
    if cut and (not whole or cut[0].score > whole[0].score):
        u, v = cut[0].corners.mean(axis=0) * scale + offset
        if cut[0].side * scale.min() >= LEAST_SIDE_PX:
            return Refusal(
                f"the likeliest {colour} square, near u {u:.0f}, v {v:.0f}, is cut by the picture's frame: "
                "move the camera or the target"
            )
    if not whole:
        return Refusal(f"no {colour} square was found{where}")
    rivals = [quad for quad in whole[1:] if not _overlap(quad, whole[0])]
    if rivals and whole[0].score <= _CLEARLY_BETTER * rivals[0].score and not narrowed:
        a, b = (quad.corners.mean(axis=0) * scale + offset for quad in (whole[0], rivals[0]))
        return Refusal(
            f"two {colour} squares are equally likely, near ({a[0]:.0f}, {a[1]:.0f}) and ({b[0]:.0f}, {b[1]:.0f}): "
            "cover one of them"
        )
    return whole[0]


def _measured(
    picture: Picture, rough: FloatArray, sides: tuple[Side, Side, Side, Side], colour: str, uncertainty_px: float
) -> DetectionResult:
    """Corners from the fitted sides, checked against the rough ones."""
    height, width = picture.shape[:2]
    points, covariances = [], []
    for index in range(4):
        crossing = corner_of(sides[index], sides[index - 1], rough[index])
        if crossing is None:
            return Refusal(f"the {colour} square's sides do not meet in a corner")
        points.append(crossing[0])
        covariances.append(crossing[1])
    corners, covariance = np.array(points), np.array(covariances)
    side = math.sqrt(abs(_doubled_area(corners)) / 2)
    blur = float(np.mean([one.sigma_px for one in sides]))
    if np.max(np.linalg.norm(corners - rough, axis=1)) > 3 * uncertainty_px + 3 * blur + 0.05 * side:
        return Refusal(f"the {colour} square's edges are not where its outline is: blurred or covered in part")
    if corners.min() < 0 or corners[:, 0].max() > width - 1 or corners[:, 1].max() > height - 1:
        return Refusal(f"the {colour} square is cut by the picture's frame")
    used = min(one.used for one in sides)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    order = np.array([index for index in _ROW_BY_ROW if sigma[index] < _MOST_SIGMA_PX])
    if used < _LEAST_USED or len(order) < _LEAST_CORNERS:
        return Refusal(
            f"the {colour} square's edges are too weak to be measured "
            f"({used:.0%} of a side usable, corner sigma {np.max(sigma):.2f} px)"
        )
    worst = float(np.max(sigma[order]))
    return Detection(
        kind=TargetKind.SQUARE,
        points_px=corners[order],
        point_ids=np.array([_ROW_BY_ROW.index(int(index)) for index in order], dtype=np.int64),
        covariance_px2=covariance[order],
        centre_px=_diagonal_crossing(corners),
        blur_px=math.sqrt(max(blur**2 - _PIXEL_VARIANCE, 0.0)),
        quality=Quality(
            score=float(np.clip(used * min(1.0, 0.05 / max(worst, 1e-6)) ** 0.25, 0.0, 1.0)),
            contrast=float(min(one.contrast for one in sides)),
            fit_chi2=float(np.mean([one.chi2 for one in sides])),
        ),
    )


def _doubled_area(corners: FloatArray) -> float:
    u, v = corners[:, 0], corners[:, 1]
    return float(np.dot(u, v[[1, 2, 3, 0]]) - np.dot(v, u[[1, 2, 3, 0]]))


def _diagonal_crossing(corners: FloatArray) -> FloatArray:
    """Crossing (2,) of the diagonals of a convex quadrilateral (4, 2) in clockwise order."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    matrix = np.column_stack([first, -second])
    share = np.linalg.solve(matrix, corners[1] - corners[0])[0]
    return np.asarray(corners[0] + share * first)
