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

from benchmarks.blur import Array, Blur, Disk, Gaussian
from benchmarks.pictures import draw_board, random_view
from calibration.detect.prediction import Prediction
from calibration.detect.target import find_target
from calibration.image import decode_picture
from calibration.types import Detection, Target, TargetKind

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

SQUARES = (11, 11)
PREDICTION_SIGMA_PX = 4.0
POSES = 3
HARD = ("g8", "d16")
HARD_POSES = 20
"""Pictures of the hardest cases, for ours alone: the others are done after the first ``POSES``."""
_SLOW = ("findChessboardCorners + cornerSubPix", "findChessboardCornersSB", "findChessboardCornersSB ACCURACY")

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Found:
    """``points`` (N, 2) px, NaN where left out; ``covariance`` (N, 2, 2) where the method says one."""

    points: Array
    covariance: Array | None = None


Finder = Callable[[Picture, Picture, Target, Array], Found | None]


@dataclass
class _Score:
    pictures: int = 0
    found: int = 0
    squares: list[float] = field(default_factory=list)
    means: list[Array] = field(default_factory=list)
    normalised: list[float] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class _Drawn:
    """A case of drawn boards; ``light`` scales the board's light, ``jpeg`` is the quality of its coding."""

    blur: Blur
    noise: float = 2.0
    squares: tuple[int, int] = SQUARES
    light: float = 1.0
    uneven: bool = False
    jpeg: int | None = None


DRAWN = {
    "g0.7": _Drawn(Gaussian(0.7)),
    "g1": _Drawn(Gaussian(1.0)),
    "g1 noise 5": _Drawn(Gaussian(1.0), 5.0),
    "g3": _Drawn(Gaussian(3.0)),
    "g5": _Drawn(Gaussian(5.0)),
    "g8": _Drawn(Gaussian(8.0)),
    "g8 noise 5": _Drawn(Gaussian(8.0), 5.0),
    "d4": _Drawn(Disk(4.0)),
    "d16": _Drawn(Disk(16.0)),
    "d16 noise 5": _Drawn(Disk(16.0), 5.0),
    "low light": _Drawn(Gaussian(1.0), 3.0, light=0.06),
    "uneven light": _Drawn(Gaussian(1.0), uneven=True),
    "JPEG 70": _Drawn(Gaussian(1.0), jpeg=70),
    "7x7 corners": _Drawn(Gaussian(1.0), squares=(8, 8)),
}


def run(*, quick: bool, progress: Callable[[float], None] | None = None) -> list[dict[str, object]]:
    """Rows by case and method; ``quick``: one picture a case and no slow baseline but on the first case.

    ``rmse_px`` and ``bias_px`` (mean over the pictures, the larger coordinate) are per coordinate, ``vs_crb`` the root
    of the normalised squared error ``nees`` (1: the error is what the covariance says, the Cramer-Rao bound where the
    fit's chi2 is 1), ``cpu_ms`` the median of the process' time, ``ratio`` the time of SB ACCURACY over it.
    """
    scores: dict[tuple[str, str], _Score] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        cases = list(_cases(quick))
        shown: dict[str, int] = {}
        for number, (case, make) in enumerate(cases):
            picture, target, corners = make()
            grey = _grey(picture, target)
            shown[case] = shown.get(case, 0) + 1
            for method, finder in METHODS.items():
                if method in _SLOW and (shown[case] > 1 or (quick and number > 0)):
                    continue
                if shown[case] > POSES and method != "lensmatch" and case in HARD:
                    continue
                score = scores.setdefault((case, method), _Score())
                started = time.process_time()
                found = finder(picture, grey, target, corners)
                score.milliseconds.append(1e3 * (time.process_time() - started))
                score.pictures += 1
                _judge(score, found, corners, target.grid)
            if progress is not None:
                progress((number + 1) / len(cases))
    finally:
        cv2.setNumThreads(threads)
    slowest = [scores[key].milliseconds for key in scores if key[1] == "findChessboardCornersSB ACCURACY"]
    every = [one for times in slowest for one in times]
    typical = float(np.median(every)) if every else None
    return [_row(case, method, score, typical) for (case, method), score in scores.items()]


def _judge(score: _Score, found: Found | None, corners: Array, grid: tuple[int, int]) -> None:
    error = None if found is None else _error(found.points, corners, grid)
    if found is None or error is None:
        return
    seen = np.isfinite(error).all(axis=1)
    score.found += 1
    score.squares.extend((error[seen] ** 2).ravel().tolist())
    score.means.append(error[seen].mean(axis=0))
    if found.covariance is not None:
        known = found.covariance[seen]
        score.normalised.extend((error[seen] * np.linalg.solve(known, error[seen][..., None])[..., 0]).sum(axis=1) / 2)


def _row(case: str, method: str, score: _Score, slow_ms: float | None) -> dict[str, object]:
    nees = float(np.mean(score.normalised)) if score.normalised else None
    spent = float(np.median(score.milliseconds))
    return {
        "case": case,
        "method": method,
        "pictures": score.pictures,
        "found": score.found,
        "rmse_px": float(np.sqrt(np.mean(score.squares))) if score.squares else None,
        "bias_px": float(np.abs(np.mean(score.means, axis=0)).max()) if score.means else None,
        "vs_crb": None if nees is None else float(np.sqrt(nees)),
        "nees": nees,
        "cpu_ms": spent,
        "ratio": None if slow_ms is None else slow_ms / max(spent, 1e-3),
    }


def _cases(quick: bool) -> Iterator[tuple[str, Callable[[], tuple[Picture, Target, Array]]]]:
    for case, drawn in DRAWN.items():
        for pose in range(1 if quick else HARD_POSES if case in HARD else POSES):
            yield case, partial(_synthetic, case, drawn, pose)
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


def _synthetic(case: str, drawn: _Drawn, pose: int) -> tuple[Picture, Target, Array]:
    rng = np.random.default_rng([20261122, pose, *case.encode()])
    view = random_view(drawn.squares, rng)
    shade = None
    if drawn.uneven:
        width, height = view.size
        u, v = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
        shade = 0.3 + 0.5 * u + 0.2 * v
    bright, dark = (tuple(drawn.light * one for one in colour) for colour in ((0.8, 0.8, 0.8), (0.05, 0.05, 0.6)))
    board = draw_board(
        drawn.squares,
        view,
        drawn.blur,
        drawn.noise,
        rng,
        bright=(bright[0], bright[1], bright[2]),
        dark=(dark[0], dark[1], dark[2]),
        surround=0.2 * drawn.light,
        shade=shade,
    )
    picture = board.picture
    if drawn.jpeg is not None:
        picture = decode_picture(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, drawn.jpeg])[1].tobytes())
    target = Target(TargetKind.CHESSBOARD, squares=drawn.squares, square_m=0.05, colours=("red", "white"))
    return picture, target, board.corners


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
    return best if np.nanmax(np.abs(best)) < 5 else None


def _filled(result: Detection, count: int) -> Found:
    points, covariance = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    points[result.point_ids], covariance[result.point_ids] = result.points_px, result.covariance_px2
    return Found(points, covariance)


def _ours(picture: Picture, grey: Picture, target: Target, corners: Array) -> Found | None:
    result = find_target(picture, target)
    return _filled(result, len(corners)) if isinstance(result, Detection) else None


def _ours_predicted(picture: Picture, grey: Picture, target: Target, corners: Array) -> Found | None:
    expected = corners + np.random.default_rng(1).normal(0, PREDICTION_SIGMA_PX, 2)
    result = find_target(picture, target, prediction=Prediction(expected, PREDICTION_SIGMA_PX))
    return _filled(result, len(corners)) if isinstance(result, Detection) else None


def _subpix(picture: Picture, grey: Picture, target: Target, corners: Array) -> Found | None:
    found, points = cv2.findChessboardCorners(grey, target.grid)
    if not found:
        return None
    table = points.reshape(-1, 2)
    side = float(np.median(np.linalg.norm(np.diff(table.reshape(target.grid[1], target.grid[0], 2), axis=1), axis=2)))
    half = int(np.clip(0.3 * side, 3, 11))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-3)
    refined = cv2.cornerSubPix(grey, points, (half, half), (-1, -1), stop)
    return Found(np.asarray(refined.reshape(-1, 2), dtype=np.float64))


def _sb(flags: int) -> Finder:
    def find(picture: Picture, grey: Picture, target: Target, corners: Array) -> Found | None:
        found, points = cv2.findChessboardCornersSB(grey, target.grid, flags=flags)
        return Found(np.asarray(points.reshape(-1, 2), dtype=np.float64)) if found else None

    return find


METHODS: dict[str, Finder] = {
    "lensmatch": _ours,
    "lensmatch, predicted": _ours_predicted,
    "findChessboardCorners + cornerSubPix": _subpix,
    "findChessboardCornersSB": _sb(0),
    "findChessboardCornersSB ACCURACY": _sb(cv2.CALIB_CB_ACCURACY),
}
