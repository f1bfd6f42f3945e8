"""Finding a plain red square and a light spot: ours beside the study's way and a thresholded centroid, in one run.

Errors are per coordinate, of the points that were found, against known ones; a result more than 20 px off is another
thing and counts as not found. Times are medians of the process' time, on one thread.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.blur import Array, Disk, Gaussian
from benchmarks.square_pictures import draw_light, draw_square
from calibration.detect.prediction import Prediction
from calibration.detect.target import find_target
from calibration.image import decode_picture
from calibration.types import Detection, Target, TargetKind

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

Picture = NDArray[np.uint8]
Shown = tuple[Picture, Target, Array]

POSES = 6
PREDICTION_SIGMA_PX = 4.0
_ANOTHER_THING_PX = 20.0
_SQUARE = Target(TargetKind.SQUARE, size_m=(0.5, 0.5), colours=("red",))
_LIGHT = Target(TargetKind.LIGHT, diameter_m=0.01, colours=("white",))

SQUARES = {
    "square sharp": partial(draw_square, Gaussian(0.4), 2.0),
    "square g3": partial(draw_square, Gaussian(3.0), 2.0),
    "square g8": partial(draw_square, Gaussian(8.0), 2.0),
    "square d16": partial(draw_square, Disk(16.0), 2.0),
    "square noise 5": partial(draw_square, Gaussian(1.0), 5.0),
    "square low light": partial(draw_square, Gaussian(1.0), 3.0, level=0.06),
    "square uneven light": partial(draw_square, Gaussian(1.0), 2.0, uneven=True),
    "square JPEG 70": partial(draw_square, Gaussian(1.0), 2.0),
    "square half hidden": partial(draw_square, Gaussian(0.6), 2.0, hidden=True),
    "square decoys": partial(draw_square, Gaussian(0.6), 2.0, decoys=True),
}
LIGHTS = {
    "light sharp": partial(draw_light),
    "light saturated": partial(draw_light, power=6.0),
    "light glow": partial(draw_light, power=3.0, glow=0.4),
    "light blurred": partial(draw_light, radius_px=5.0, sigma_px=4.0),
    "light noise 8": partial(draw_light, noise=8.0),
    "light slope": partial(draw_light, power=3.0, slope=0.2),
    "light among weaker": partial(draw_light, others=3),
}


@dataclass
class _Score:
    pictures: int = 0
    found: int = 0
    errors: list[Array] = field(default_factory=list)
    normalised: list[float] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Found:
    """``error`` (N, 2) px of the points found, and their ``covariance`` (N, 2, 2) where the method says one."""

    error: Array
    covariance: Array | None = None


def run(*, quick: bool, progress: Callable[[float], None] | None = None) -> list[dict[str, object]]:
    """Rows by case and method (as of the boards: ``rmse_px``, ``bias_px``, ``nees``, ``vs_crb`` its root, ``cpu_ms``)
    with ``max_px``, the largest error of a coordinate. ``quick``: one picture a case.
    """
    scores: dict[tuple[str, str], _Score] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        cases = list(_cases(quick))
        for number, (case, make) in enumerate(cases):
            picture, target, points = make()
            for method, finder in METHODS[target.kind].items():
                score = scores.setdefault((case, method), _Score())
                started = time.process_time()
                found = finder(picture, target, points)
                score.milliseconds.append(1e3 * (time.process_time() - started))
                score.pictures += 1
                if found is None or np.abs(found.error).max() > _ANOTHER_THING_PX:
                    continue
                score.found += 1
                score.errors.append(found.error)
                if found.covariance is not None:
                    solved = np.linalg.solve(found.covariance, found.error[..., None])[..., 0]
                    score.normalised.extend((found.error * solved).sum(axis=1) / 2)
            if progress is not None:
                progress((number + 1) / len(cases))
    finally:
        cv2.setNumThreads(threads)
    return [_row(case, method, score) for (case, method), score in scores.items()]


def _row(case: str, method: str, score: _Score) -> dict[str, object]:
    nees = float(np.mean(score.normalised)) if score.normalised else None
    error = np.concatenate(score.errors) if score.errors else None
    return {
        "case": case,
        "method": method,
        "pictures": score.pictures,
        "found": score.found,
        "rmse_px": None if error is None else float(np.sqrt(np.mean(error**2))),
        "bias_px": None if error is None else float(np.abs(error.mean(axis=0)).max()),
        "max_px": None if error is None else float(np.abs(error).max()),
        "vs_crb": None if nees is None else float(np.sqrt(nees)),
        "nees": nees,
        "cpu_ms": float(np.median(score.milliseconds)),
    }


def _cases(quick: bool) -> Iterator[tuple[str, Callable[[], Shown]]]:
    for cases, target in ((SQUARES, _SQUARE), (LIGHTS, _LIGHT)):
        for case, draw in cases.items():
            for pose in range(1 if quick else POSES):
                yield case, partial(_drawn, case, draw, target, pose)
    data = Path(os.environ.get("LENSMATCH_SHARED") or Path(__file__).resolve().parents[2] / "shared") / "data"
    for folder in sorted((data / "renders").glob("*")):
        if not (folder / "set.json").is_file():
            continue
        described = json.loads((folder / "set.json").read_text(encoding="utf-8"))
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["pictures"]
        kinds = {name: one["kind"] for name, one in described["targets"].items()}
        entries = [one for one in described["pictures"] if kinds[one["target"]] in ("square", "light")]
        for entry in entries[: 1 if quick else None]:
            known = next(one for one in truth[entry["file"]] if one["target"] == entry["target"])
            kind = kinds[entry["target"]]
            if kind == "square":
                told = described["targets"][entry["target"]]
                size = (float(told["size_m"][0]), float(told["size_m"][1]))
                asked = Target(TargetKind.SQUARE, size_m=size, colours=tuple(told["colours"]))
                points = np.array(known["outer_corners_tl_tr_br_bl"], dtype=np.float64)[[0, 1, 3, 2]]
            else:
                asked, points = _LIGHT, np.array([known["centre"]], dtype=np.float64)
            yield f"{kind} render {folder.name}", partial(_render, folder / entry["file"], asked, points)


def _drawn(case: str, draw: Callable[..., tuple[Picture, Array]], target: Target, pose: int) -> Shown:
    rng = np.random.default_rng([20261123, pose, *case.encode()])
    picture, points = draw(rng=rng)
    if "JPEG" in case:
        picture = decode_picture(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes())
    return picture, target, points


def _render(path: Path, target: Target, points: Array) -> Shown:
    return decode_picture(path.read_bytes()), target, points


def _ours(picture: Picture, target: Target, points: Array, *, prediction: Prediction | None = None) -> Found | None:
    result = find_target(picture, target, prediction=prediction)
    if not isinstance(result, Detection):
        return None
    return Found(result.points_px - points[result.point_ids], result.covariance_px2)


def _predicted(picture: Picture, target: Target, points: Array) -> Found | None:
    expected = points + np.random.default_rng(1).normal(0, PREDICTION_SIGMA_PX, 2)
    return _ours(picture, target, points, prediction=Prediction(expected, PREDICTION_SIGMA_PX))


def _study(picture: Picture, target: Target, points: Array) -> Found | None:
    """The study's detector as its text tells it: red cut out in HSV, the rest masked, Canny, contours, and the largest
    that simplifies to a quadrilateral. Its constants are not told; these are the usual ones of its sources.
    """
    hsv = cv2.cvtColor(cv2.GaussianBlur(picture, (5, 5), 0), cv2.COLOR_BGR2HSV)
    low = cv2.inRange(hsv, np.array([0, 100, 50]), np.array([10, 255, 255]))
    high = cv2.inRange(hsv, np.array([170, 100, 50]), np.array([180, 255, 255]))
    masked = cv2.bitwise_and(picture, picture, mask=cv2.bitwise_or(low, high))
    edges = cv2.Canny(cv2.cvtColor(masked, cv2.COLOR_BGR2GRAY), 50, 150)
    contours, _ = cv2.findContours(edges, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    largest, corners = 0.0, None
    for contour in contours:
        polygon = cv2.approxPolyDP(contour, 0.02 * cv2.arcLength(contour, True), True)
        area = cv2.contourArea(polygon)
        if len(polygon) == 4 and cv2.isContourConvex(polygon) and area > largest:
            largest, corners = area, polygon.reshape(4, 2).astype(np.float64)
    if corners is None:
        return None
    by_row = corners[np.argsort(corners[:, 1])]
    ordered = np.concatenate([pair[np.argsort(pair[:, 0])] for pair in (by_row[:2], by_row[2:])])
    return Found(ordered - points)


def _centroid(picture: Picture, target: Target, points: Array) -> Found | None:
    """The mean place of the pixels above half of the brightest, of the largest such region."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    binary = (grey > grey.max() / 2).astype(np.uint8)
    count, _, stats, centres = cv2.connectedComponentsWithStats(binary)
    if count < 2:
        return None
    chosen = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return Found(np.asarray(centres[chosen][None, :] - points, dtype=np.float64))


Finder = Callable[[Picture, Target, Array], Found | None]
METHODS: dict[TargetKind, dict[str, Finder]] = {
    TargetKind.SQUARE: {
        "lensmatch": _ours,
        "lensmatch, predicted": _predicted,
        "the study: mask, Canny, polygon": _study,
    },
    TargetKind.LIGHT: {"lensmatch": _ours, "lensmatch, predicted": _predicted, "thresholded centroid": _centroid},
}
