"""Finding squares and lights beside the study's detector and a plain centroid, on pictures with known points.

``vs_crb`` is the RMS of the errors normalised with the Cramer-Rao bound of each picture (1 is the best that is
possible), ``nees`` the mean squared error normalised with the stated covariance, per coordinate (1 where it is honest).
Times are medians of CPU time on one thread.

The study's detector is built from its text (3.1 and 6.4): a red mask in HSV, Canny's edges within it, contours
simplified to polygons, and the largest polygon of four corners. Its text gives no thresholds; these are the usual ones.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.pictures import View, random_view
from benchmarks.square_pictures import (
    Array,
    Coded,
    Spot,
    coded,
    corner_bound,
    spot_bound,
    spot_light,
    square_scene,
)
from calibration.detect.prediction import Prediction
from calibration.detect.target import find_target
from calibration.image import decode_picture
from calibration.types import Detection, Target, TargetKind

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

RED, GREY, DARK = (0.02, 0.018, 0.55), (0.2, 0.2, 0.2), (0.03, 0.035, 0.03)
SQUARE = Target(TargetKind.SQUARE, size_m=(0.6, 0.6), colours=("red",))
LIGHT = Target(TargetKind.LIGHT, diameter_m=0.01, colours=("white",))
PREDICTION_SIGMA_PX = 4.0
_SPOT_PX = 160
_WRONG_PX = 20.0
_QUICK = ("g0.7", "g0.7 shadow edge", "saturated disk")


@dataclass(frozen=True)
class _Case:
    picture: Coded
    target: Target
    points: Array  # (N, 2) px
    bound: Array | None  # (N, 2, 2) px^2


@dataclass(frozen=True)
class _Found:
    points: Array
    covariance: Array | None = None


_Finder = Callable[[_Case], _Found | None]


@dataclass
class _Score:
    pictures: int = 0
    errors: list[Array] = field(default_factory=list)
    over_bound: list[float] = field(default_factory=list)
    over_stated: list[float] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)


def run(*, quick: bool, progress: Callable[[float], None] | None = None) -> list[dict[str, object]]:
    """Rows {case, method, pictures, found, rmse_px, bias_px, max_px, vs_crb, nees, ms} by case and method.

    ``found`` counts points within 20 px of the true ones; ``bias_px`` is the mean error along the target's outward
    direction (squares) or the length of the mean error (lights). ``quick``: one picture of a few drawn cases.
    """
    scores: dict[tuple[str, str], _Score] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        cases = list(_cases(quick))
        for number, (name, make) in enumerate(cases):
            case = make()
            for method, finder in _METHODS[case.target.kind].items():
                _add(scores.setdefault((name, method), _Score()), case, finder)
            if progress is not None:
                progress((number + 1) / len(cases))
    finally:
        cv2.setNumThreads(threads)
    return [_row(name, method, score) for (name, method), score in scores.items()]


def _add(score: _Score, case: _Case, finder: _Finder) -> None:
    started = time.thread_time()
    found = finder(case)
    score.milliseconds.append(1e3 * (time.thread_time() - started))
    score.pictures += 1
    if found is None:
        return
    error = found.points - case.points
    if np.abs(error).max() > _WRONG_PX:
        return
    score.errors.append(_outward(error, case.points))
    if case.bound is not None:
        score.over_bound.append(_normalised(error, case.bound))
    if found.covariance is not None:
        score.over_stated.append(_normalised(error, found.covariance))


def _normalised(error: Array, covariance: Array) -> float:
    return float(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)) / 2)


def _outward(error: Array, points: Array) -> Array:
    """Errors turned so that the first coordinate points away from the points' centre; as they are for one point."""
    if len(points) == 1:
        return error
    away = points - points.mean(axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([np.sum(error * away, axis=1), error[:, 1] * away[:, 0] - error[:, 0] * away[:, 1]], axis=1)


def _row(name: str, method: str, score: _Score) -> dict[str, object]:
    row: dict[str, object] = {
        "case": name,
        "method": method,
        "pictures": score.pictures,
        "found": len(score.errors),
        **dict.fromkeys(("rmse_px", "bias_px", "max_px", "vs_crb", "nees")),
        "ms": float(np.median(score.milliseconds)),
    }
    if score.errors:
        errors = np.concatenate(score.errors)
        mean = errors.mean(axis=0)
        row["rmse_px"] = float(np.sqrt(np.mean(errors**2)))
        row["bias_px"] = float(mean[0] if len(score.errors[0]) > 1 else np.hypot(mean[0], mean[1]))
        row["max_px"] = float(np.abs(errors).max())
    if score.over_bound:
        row["vs_crb"] = float(np.sqrt(np.mean(score.over_bound)))
    if score.over_stated:
        row["nees"] = float(np.mean(score.over_stated))
    return row


def _cases(quick: bool) -> Iterator[tuple[str, Callable[[], _Case]]]:
    count = 1 if quick else 8
    for name, studio in _SQUARES.items():
        if quick and name not in _QUICK:
            continue
        for seed in range(count):
            yield f"square {name}", partial(_square, seed, studio)
    for name, (spot, noise) in _LIGHTS.items():
        if quick and name not in _QUICK:
            continue
        for seed in range(count if quick else 3 * count):
            yield f"light {name}", partial(_light, seed, spot, noise)
    if not quick:
        yield from _renders()


@dataclass(frozen=True)
class _Studio:
    """How a square is seen; ``exposure`` on all light, ``uneven`` across the picture, ``shadow`` left of the target."""

    sigma_px: float
    disk_px: float = 0.0
    noise: float = 2.0
    exposure: float = 1.0
    uneven: float = 0.0
    shadow: float = 1.0
    jpeg: int = 0
    around: tuple[float, float, float] = GREY


_SQUARES: dict[str, _Studio] = {
    "g0.7": _Studio(sigma_px=0.7),
    "g3": _Studio(sigma_px=3.0),
    "g8": _Studio(sigma_px=8.0),
    "d4": _Studio(sigma_px=0.5, disk_px=4.0),
    "d16": _Studio(sigma_px=0.5, disk_px=16.0),
    "g0.7 noise 5": _Studio(sigma_px=0.7, noise=5.0),
    "g0.7 low light": _Studio(sigma_px=0.7, exposure=0.06, noise=3.0),
    "g0.7 uneven light": _Studio(sigma_px=0.7, uneven=0.6),
    "g0.7 shadow edge": _Studio(sigma_px=0.7, shadow=0.4),
    "g0.7 JPEG q80": _Studio(sigma_px=0.7, jpeg=80),
    "g0.7 JPEG q60": _Studio(sigma_px=0.7, jpeg=60),
    "g0.7 dark surround": _Studio(sigma_px=0.7, around=DARK),
}

_LIGHTS: dict[str, tuple[Spot, float]] = {
    "saturated disk": (Spot(8, 5.0, 0.7), 2.0),
    "saturated small": (Spot(2.5, 3.0, 0.7), 2.0),
    "unsaturated": (Spot(4, 0.6, 1.0), 2.0),
    "glow": (Spot(5, 4.0, 0.7, glow=0.25), 2.0),
    "glow and gradient": (Spot(5, 4.0, 0.7, glow=0.25, level=0.12, gradient=(1e-3, 5e-4)), 2.0),
    "blurred g4": (Spot(3, 2.0, 4.0), 2.0),
    "saturated noise 5": (Spot(6, 5.0, 1.0), 5.0),
    "dim": (Spot(4, 0.12, 1.0, level=0.004), 3.0),
}


def _square(seed: int, studio: _Studio) -> _Case:
    rng = np.random.default_rng([20261125, seed])
    view: View = random_view((1, 1), rng, share=0.4)
    scene = square_scene(view, sigma_px=studio.sigma_px, disk_px=studio.disk_px)
    behind = np.array(studio.around)
    light = studio.exposure * (behind + scene.share[..., None] * (np.array(RED) - behind))
    width = light.shape[1]
    if studio.uneven:
        light *= (1 + studio.uneven * (np.linspace(-1, 1, width)))[None, :, None]
    if studio.shadow < 1:
        across = np.arange(width) - scene.corners[:, 0].mean()
        light *= (studio.shadow + (1 - studio.shadow) / (1 + np.exp(-across / 2)))[None, :, None]
    picture = coded(light, studio.noise, rng)
    if studio.jpeg:
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, studio.jpeg])
        picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
    even = not (studio.jpeg or studio.uneven or studio.shadow < 1)
    bound = None
    if even:
        bound = corner_bound(
            scene,
            studio.sigma_px,
            studio.disk_px,
            studio.exposure * np.array(RED),
            studio.exposure * behind,
            studio.noise,
        )
    return _Case(picture, SQUARE, scene.corners, bound)


def _light(seed: int, spot: Spot, noise: float) -> _Case:
    rng = np.random.default_rng([20261126, seed])
    own = (_SPOT_PX - 1) / 2 + rng.uniform(-3, 3, 2)
    light = np.repeat(spot_light(spot, own, _SPOT_PX)[..., None], 3, axis=2)
    room = np.full((360, 640, 3), spot.level)
    top, left = 100, 240
    room[top : top + _SPOT_PX, left : left + _SPOT_PX] = light
    bound = spot_bound(spot, own, _SPOT_PX, noise)
    return _Case(coded(room, noise, rng), LIGHT, (own + [left, top])[None], bound[None])


def _renders() -> Iterator[tuple[str, Callable[[], _Case]]]:
    data = Path(os.environ.get("LENSMATCH_SHARED") or Path(__file__).resolve().parents[2] / "shared") / "data"
    for folder in sorted((data / "renders").glob("*")):
        if not (folder / "set.json").is_file():
            continue
        described = json.loads((folder / "set.json").read_text(encoding="utf-8"))
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["pictures"]
        entries = [one for one in described["pictures"] if described["targets"][one["target"]]["kind"] != "chessboard"]
        for entry in entries:
            known = next(one for one in truth[entry["file"]] if one["target"] == entry["target"])
            asked = described["targets"][entry["target"]]
            if asked["kind"] == "square":
                corners = np.array(known["outer_corners_tl_tr_br_bl"], dtype=np.float64)[[0, 1, 3, 2]]
                size = (float(asked["size_m"][0]), float(asked["size_m"][1]))
                target = replace(SQUARE, size_m=size, colours=tuple(asked["colours"]))
            else:
                corners, target = np.array([known["centre"]], dtype=np.float64), LIGHT
            yield f"{asked['kind']} render {folder.name}", partial(_render, folder / entry["file"], target, corners)


def _render(path: Path, target: Target, points: Array) -> _Case:
    return _Case(decode_picture(path.read_bytes()), target, points, None)


def _ours(case: _Case) -> _Found | None:
    result = find_target(case.picture, case.target)
    return _of(result, len(case.points)) if isinstance(result, Detection) else None


def _ours_predicted(case: _Case) -> _Found | None:
    expected = case.points + np.random.default_rng(1).normal(0, PREDICTION_SIGMA_PX, 2)
    result = find_target(case.picture, case.target, prediction=Prediction(expected, PREDICTION_SIGMA_PX))
    return _of(result, len(case.points)) if isinstance(result, Detection) else None


def _of(result: Detection, count: int) -> _Found | None:
    return _Found(result.points_px, result.covariance_px2) if len(result.points_px) == count else None


def _study(case: _Case) -> _Found | None:
    hsv = cv2.cvtColor(case.picture, cv2.COLOR_BGR2HSV)
    low = cv2.inRange(hsv, np.array((0, 80, 50)), np.array((10, 255, 255)))
    high = cv2.inRange(hsv, np.array((170, 80, 50)), np.array((180, 255, 255)))
    edges = cv2.Canny(cv2.GaussianBlur(cv2.bitwise_or(low, high), (5, 5), 0), 50, 150)
    contours, _ = cv2.findContours(edges, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    polygons = [cv2.approxPolyDP(contour, 0.02 * cv2.arcLength(contour, True), True) for contour in contours]
    fours = [polygon.reshape(4, 2).astype(np.float64) for polygon in polygons if len(polygon) == 4]
    if not fours:
        return None
    corners = max(fours, key=lambda polygon: cv2.contourArea(polygon.astype(np.float32)))
    by_sum, by_difference = corners.sum(axis=1), corners[:, 0] - corners[:, 1]
    order = [by_sum.argmin(), by_difference.argmax(), by_difference.argmin(), by_sum.argmax()]
    return _Found(corners[order])


def _centroid(case: _Case) -> _Found | None:
    grey = cv2.cvtColor(case.picture, cv2.COLOR_BGR2GRAY)
    threshold = 0.5 * (float(grey.max()) + float(np.median(grey)))
    _, _, stats, centres = cv2.connectedComponentsWithStats((grey > threshold).astype(np.uint8))
    if len(stats) < 2:
        return None
    return _Found(centres[1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))][None])


_METHODS: dict[TargetKind, dict[str, _Finder]] = {
    TargetKind.SQUARE: {
        "lensmatch": _ours,
        "lensmatch, predicted": _ours_predicted,
        "the study: red mask, Canny, largest polygon": _study,
    },
    TargetKind.LIGHT: {
        "lensmatch": _ours,
        "lensmatch, predicted": _ours_predicted,
        "centroid above half the peak": _centroid,
    },
}
