"""Finding a chessboard: ours beside OpenCV's detectors, on pictures with known corners, in one run.

Errors are per coordinate over the corners of the pictures in which the board was found; times are medians of the same
run, on one thread. Baselines get one channel, the one of greatest contrast for the board's colours, before the clock
starts; ours gets the colour picture.
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

from benchmarks.blur import Array
from benchmarks.pictures import draw_board, random_view
from calibration.detect.prediction import Prediction
from calibration.detect.target import find_target
from calibration.image import decode_picture
from calibration.types import Detection, Target, TargetKind

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

SQUARES = (11, 11)
BLURS_PX = (0.7, 1.0, 3.0, 5.0)
NOISE = 2.0
PREDICTION_SIGMA_PX = 4.0

Picture = NDArray[np.uint8]
Finder = Callable[[Picture, Picture, Target, Array], Array | None]


@dataclass
class _Score:
    pictures: int = 0
    found: int = 0
    squares: list[float] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)


def run(*, quick: bool, progress: Callable[[float], None] | None = None) -> list[dict[str, object]]:
    """Rows {case, method, pictures, found, rmse_px, max_px, ms} by case and method; ``quick``: one picture a case."""
    scores: dict[tuple[str, str], _Score] = {}
    largest: dict[tuple[str, str], float] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        cases = list(_cases(quick))
        for number, (case, make) in enumerate(cases):
            picture, target, corners = make()
            grey = _grey(picture, target)
            for method, finder in METHODS.items():
                score = scores.setdefault((case, method), _Score())
                started = time.perf_counter()
                points = finder(picture, grey, target, corners)
                score.milliseconds.append(1e3 * (time.perf_counter() - started))
                score.pictures += 1
                error = None if points is None else _error(points, corners, target.grid)
                if error is not None:
                    score.found += 1
                    score.squares.extend((error**2).ravel().tolist())
                    largest[case, method] = max(largest.get((case, method), 0.0), float(np.abs(error).max()))
            if progress is not None:
                progress((number + 1) / len(cases))
    finally:
        cv2.setNumThreads(threads)
    return [
        {
            "case": case,
            "method": method,
            "pictures": score.pictures,
            "found": score.found,
            "rmse_px": float(np.sqrt(np.mean(score.squares))) if score.squares else None,
            "max_px": largest.get((case, method)),
            "ms": float(np.median(score.milliseconds)),
        }
        for (case, method), score in scores.items()
    ]


def _cases(quick: bool) -> Iterator[tuple[str, Callable[[], tuple[Picture, Target, Array]]]]:
    target = Target(TargetKind.CHESSBOARD, squares=SQUARES, square_m=0.05, colours=("red", "white"))
    for blur in BLURS_PX:
        for pose in range(1 if quick else 5):
            yield f"synthetic 1080p g{blur:g}", partial(_synthetic, target, blur, pose)
    data = Path(os.environ.get("LENSMATCH_SHARED") or Path(__file__).resolve().parents[2] / "shared") / "data"
    for folder in sorted((data / "renders").glob("*")):
        if not (folder / "set.json").is_file():
            continue
        described = json.loads((folder / "set.json").read_text(encoding="utf-8"))
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["pictures"]
        entries = [one for one in described["pictures"] if described["targets"][one["target"]]["kind"] == "chessboard"]
        for entry in entries[: 1 if quick else None]:
            known = next(one for one in truth[entry["file"]] if one["target"] == entry["target"])
            corners = np.array(known["inner_corners"], dtype=np.float64).reshape(-1, 2)
            board = described["targets"][entry["target"]]
            asked = Target(
                TargetKind.CHESSBOARD,
                squares=(board["squares"][0], board["squares"][1]),
                square_m=board["square_m"],
                colours=tuple(board["colours"]),
            )
            yield f"render {folder.name}", partial(_render, folder / entry["file"], asked, corners)


def _synthetic(target: Target, blur_px: float, pose: int) -> tuple[Picture, Target, Array]:
    rng = np.random.default_rng([20261122, pose, round(100 * blur_px)])
    drawn = draw_board(SQUARES, random_view(SQUARES, rng), blur_px, NOISE, rng)
    return drawn.picture, target, drawn.corners


def _render(path: Path, target: Target, corners: Array) -> tuple[Picture, Target, Array]:
    return decode_picture(path.read_bytes()), target, corners


def _grey(picture: Picture, target: Target) -> Picture:
    """One channel for the detectors that take one: that in which the board's named colours differ most."""
    if set(target.colours) == {"red", "black"}:
        plane = cv2.extractChannel(picture, 2)
    elif set(target.colours) == {"red", "white"}:
        plane = cv2.addWeighted(cv2.extractChannel(picture, 0), 0.5, cv2.extractChannel(picture, 1), 0.5, 0)
    else:
        plane = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    return np.asarray(plane, dtype=np.uint8)


def _error(points: Array, corners: Array, grid: tuple[int, int]) -> Array | None:
    """Found minus true in the reading of the grid that fits best; None where it is another grid (over 5 px off).

    The baselines read a square board from any of its corners, and may mirror it. Corners left out are NaN.
    """
    columns, rows = grid
    table = points.reshape(rows, columns, 2)
    readings = [np.rot90(side, turn) for side in (table, np.swapaxes(table, 0, 1)) for turn in range(4)]
    errors = [r.reshape(-1, 2) - corners for r in readings if r.shape == table.shape]
    best = min(errors, key=lambda error: float(np.nanmax(np.abs(error))))
    best = best[np.isfinite(best).all(axis=1)]
    return best if np.abs(best).max() < 5 else None


def _filled(result: Detection, count: int) -> Array:
    points = np.full((count, 2), np.nan)
    points[result.point_ids] = result.points_px
    return points


def _ours(picture: Picture, grey: Picture, target: Target, corners: Array) -> Array | None:
    result = find_target(picture, target)
    return _filled(result, len(corners)) if isinstance(result, Detection) else None


def _ours_predicted(picture: Picture, grey: Picture, target: Target, corners: Array) -> Array | None:
    expected = corners + np.random.default_rng(1).normal(0, PREDICTION_SIGMA_PX, 2)
    result = find_target(picture, target, prediction=Prediction(expected, PREDICTION_SIGMA_PX))
    return _filled(result, len(corners)) if isinstance(result, Detection) else None


def _subpix(picture: Picture, grey: Picture, target: Target, corners: Array) -> Array | None:
    found, points = cv2.findChessboardCorners(grey, target.grid)
    if not found:
        return None
    table = points.reshape(-1, 2)
    side = float(np.median(np.linalg.norm(np.diff(table.reshape(target.grid[1], target.grid[0], 2), axis=1), axis=2)))
    half = int(np.clip(0.3 * side, 3, 11))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-3)
    return np.asarray(cv2.cornerSubPix(grey, points, (half, half), (-1, -1), stop).reshape(-1, 2), dtype=np.float64)


def _sb(flags: int) -> Finder:
    def find(picture: Picture, grey: Picture, target: Target, corners: Array) -> Array | None:
        found, points = cv2.findChessboardCornersSB(grey, target.grid, flags=flags)
        return np.asarray(points.reshape(-1, 2), dtype=np.float64) if found else None

    return find


METHODS: dict[str, Finder] = {
    "lensmatch": _ours,
    "lensmatch, predicted": _ours_predicted,
    "findChessboardCorners + cornerSubPix": _subpix,
    "findChessboardCornersSB": _sb(0),
    "findChessboardCornersSB ACCURACY": _sb(cv2.CALIB_CB_ACCURACY),
}
