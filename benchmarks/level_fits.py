"""The ways to a level's lens that the benchmark sets side by side, each from the same corners to the same figures.

Whatever a method calls its values, they end as OpenCV's eight (fx, fy, cx, cy, k1, k2, p1, p2), so that all are judged
by the same projection.
"""

from __future__ import annotations

import json
import math
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.compare import grid_pixels
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.solve.center_shift import center_shift_from_points
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.mistakes import Priors
from calibration.solve.problem import View
from calibration.types import FloatArray, IntArray, TargetKind

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

MRCAL_PYTHON = "/usr/bin/python3"
MRCAL_TIMEOUT_S = 60.0
_MRCAL_SCRIPT = Path(__file__).with_name("mrcal_process.py")
_SETTLED_PX = 0.003
_MOST_ROUNDS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """``values`` (8,) as OpenCV's, None with the ``problem``; ``rms_px`` per coordinate; ``outliers`` the share of
    points cut; ``sigma`` of (f, cx, cy, k1, k2) where the method says one; ``cpu_ms`` of the fit alone."""

    values: FloatArray | None = None
    problem: str = ""
    rms_px: float | None = None
    outliers: float | None = None
    held_out_px: float | None = None
    sigma: FloatArray | None = None
    evaluations: int | None = None
    cpu_ms: float | None = None
    model: str = "f, centre, k1, k2"


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """What every method gets: views, picture size, priors for ours, how often a fit is timed, whether pictures are
    left out in turn."""

    views: tuple[View, ...]
    image_size: tuple[int, int]
    pixel_aspect: float = 1.0
    priors: Priors | None = None
    repeats: int = 5
    held_out: bool = False


def project(values: FloatArray, rays: FloatArray) -> FloatArray:
    """Rays (..., 2) to pixels through OpenCV's model with its eight values."""
    fx, fy, cx, cy, k1, k2, p1, p2 = values
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    gain = 1 + k1 * r2 + k2 * r2 * r2
    u = x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


def overlay_max_px(truth: Lens, values: FloatArray) -> float:
    """Largest distance between where the two put a ray, on the grid of the true picture."""
    pixels = grid_pixels(truth.image_size)
    distance = np.linalg.norm(project(values, truth.unproject(pixels)) - pixels, axis=-1)
    return float(np.nanmax(distance))


def pull_rms(truth: Lens, fitted: Fitted) -> float | None:
    """RMS of (found - true) / sigma over f, cx, cy, k1, k2: 1 where the sigmas are true."""
    if fitted.sigma is None or fitted.values is None:
        return None
    true = np.array([truth.f_px, *truth.principal_point_px, truth.k1, truth.k2])
    return float(np.sqrt(np.mean(((fitted.values[[0, 2, 3, 4, 5]] - true) / fitted.sigma) ** 2)))


def _timed(work: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """The work's answer and its least CPU time, ms, on one thread of OpenCV's."""
    threads, times = cv2.getNumThreads(), []
    cv2.setNumThreads(1)
    try:
        answer = None
        for _ in range(repeats):
            started = time.process_time()
            answer = work()
            times.append(time.process_time() - started)
    finally:
        cv2.setNumThreads(threads)
    return answer, 1e3 * min(times)


def _rms(residuals: Sequence[FloatArray]) -> float | None:
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))) if residuals else None


def _values(lens: Lens) -> FloatArray:
    return np.array([lens.f_px, lens.pixel_aspect * lens.f_px, *lens.principal_point_px, lens.k1, lens.k2, 0.0, 0.0])


def ours(corners: Corners) -> Fitted:
    """``calibration.solve.level.solve_level``."""
    views, size = corners.views, corners.image_size
    try:
        fit, cpu_ms = _timed(
            lambda: solve_level(views, size, pixel_aspect=corners.pixel_aspect, priors=corners.priors), corners.repeats
        )
    except CalibrationError as error:
        return Fitted(problem=str(error))
    held = list(held_out_residuals(fit, views).values()) if corners.held_out else []
    return Fitted(
        _values(fit.lens),
        rms_px=fit.rms_px,
        outliers=len(fit.outliers) / (fit.points + len(fit.outliers)),
        held_out_px=_rms(held),
        sigma=fit.sigma[[0, 3, 4, 1, 2]],
        evaluations=fit.iterations,
        cpu_ms=cpu_ms,
    )


def _plane(view: View) -> FloatArray:
    points = view.target.points_m()[view.detection.point_ids]
    return np.column_stack([points, np.zeros(len(points))])


def opencv(corners: Corners) -> Fitted:
    """``cv2.calibrateCamera``, every pose free, f, centre, k1 and k2 only."""
    width, height = corners.image_size
    boards = [_plane(view).astype(np.float32) for view in corners.views]
    pixels = [view.detection.points_px.astype(np.float32) for view in corners.views]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3

    def camera() -> FloatArray:
        # Only the ratio of the first two counts: the focal length is OpenCV's own first guess.
        return np.array([[1.0, 0, (width - 1) / 2], [0, corners.pixel_aspect, (height - 1) / 2], [0, 0, 1]])

    def calibrated(without: int | None = None) -> Any:
        chosen = [i for i in range(len(boards)) if i != without]
        return cv2.calibrateCameraExtended(
            [boards[i] for i in chosen], [pixels[i] for i in chosen], (width, height), camera(), np.zeros(5),
            flags=flags,
        )  # fmt: skip

    def values(answer: Any) -> FloatArray:
        K, distortion = answer[1], np.ravel(answer[2])
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion[:4]])

    try:
        answer, cpu_ms = _timed(calibrated, corners.repeats)
    except cv2.error as error:
        return Fitted(problem=f"OpenCV: {error.err}")
    held = None
    if corners.held_out:
        held = [_left_out(view, values(calibrated(i)), _plane(view)) for i, view in enumerate(corners.views)]
    spread = np.ravel(answer[5])
    return Fitted(
        values(answer),
        rms_px=float(answer[0]) / math.sqrt(2),
        outliers=0.0,
        held_out_px=_rms(held) if held else None,
        sigma=spread[[1, 2, 3, 4, 5]] / [corners.pixel_aspect, 1, 1, 1, 1],  # of fy: fx follows it
        cpu_ms=cpu_ms,
    )


def _left_out(view: View, values: FloatArray, board: FloatArray) -> FloatArray:
    """Residuals of a picture under a lens fitted without it, its pose fitted alone."""
    fx, fy, cx, cy = values[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    _, turn, shift = cv2.solvePnP(board, view.detection.points_px, K, values[4:])
    turn, shift = cv2.solvePnPRefineLM(board, view.detection.points_px, K, values[4:], turn, shift)
    back = cv2.projectPoints(board, turn, shift, K, values[4:])[0].reshape(-1, 2)
    return np.asarray(back - view.detection.points_px, dtype=np.float64)


def _known_rays(corners: Corners) -> list[FloatArray] | None:
    """Each picture's rays by its surveyed pose, taken as exact; None where a pose is not known."""
    rays = []
    for view in corners.views:
        if view.camera_pose is None or view.target.pose is None:
            return None
        world = target_points_world(view.target.pose, view.target.points_m()[view.detection.point_ids])
        rays.append(rays_of(world_to_camera(view.camera_pose, 0.0, world)))
    return rays


def _radial(f_px: float, k1: float, k2: float, centre: FloatArray, aspect: float) -> FloatArray:
    return np.array([f_px, aspect * f_px, *centre, k1, k2, 0.0, 0.0], dtype=np.float64)


def known_poses(corners: Corners) -> Fitted:
    """scipy's ``least_squares`` over f, centre, k1, k2 with the poses taken as exact: the public baseline."""
    rays = _known_rays(corners)
    if rays is None:
        return Fitted(problem="the poses are not known")
    width, height = corners.image_size
    every, seen = np.concatenate(rays), np.concatenate([view.detection.points_px for view in corners.views])

    def residual(p: FloatArray) -> FloatArray:
        return np.ravel(project(_radial(p[0], p[1], p[2], p[3:], corners.pixel_aspect), every) - seen)

    start = [float(width), 0.0, 0.0, (width - 1) / 2, (height - 1) / 2]
    answer, cpu_ms = _timed(
        lambda: least_squares(residual, start, method="lm", x_scale=[1e3, 0.1, 0.1, 10.0, 10.0]), corners.repeats
    )
    variance = 2 * answer.cost / max(len(answer.fun) - 5, 1)
    sigma = np.sqrt(np.diag(np.linalg.pinv(answer.jac.T @ answer.jac)) * variance)
    return Fitted(
        _radial(answer.x[0], answer.x[1], answer.x[2], answer.x[3:], corners.pixel_aspect),
        rms_px=float(np.sqrt(np.mean(answer.fun**2))),
        outliers=0.0,
        sigma=sigma[[0, 3, 4, 1, 2]],
        evaluations=int(answer.nfev),
        cpu_ms=cpu_ms,
    )


def study(corners: Corners) -> Fitted:
    """The study's descent in one coefficient at a time, offline: FoV -> k1 -> FoV ..., then FoV -> k2.

    The centre shift comes from the picture nearest the middle. Each coefficient is searched (Brent) where the study
    looks for it: the field of view near the middle, k1 further out, k2 in the corners; with four pictures these are
    its four roles, with more the thirds by their distance. An evaluation stands for one render of the engine.
    """
    rays = _known_rays(corners)
    if rays is None:
        return Fitted(problem="the poses are not known")
    answer, cpu_ms = _timed(lambda: _descent(corners, rays), corners.repeats)
    values, evaluations = answer
    residual = project(values, np.concatenate(rays)) - np.concatenate([v.detection.points_px for v in corners.views])
    return Fitted(
        values,
        rms_px=float(np.sqrt(np.mean(residual**2))),
        outliers=0.0,
        evaluations=evaluations,
        cpu_ms=cpu_ms,
    )


def _descent(corners: Corners, rays: list[FloatArray]) -> tuple[FloatArray, int]:
    width, height = corners.image_size
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    away = [float(np.linalg.norm(view.detection.centre_px - middle)) for view in corners.views]
    order = [int(i) for i in np.argsort(away)]
    inner = order[0]
    f_px, shift = center_shift_from_points(
        corners.views[inner].detection, rays[inner], corners.image_size, corners.pixel_aspect
    )
    thirds = np.array_split(np.array(order[1:]), 3)
    pixels = [view.detection.points_px for view in corners.views]
    groups = [(np.concatenate([rays[i] for i in t]), np.concatenate([pixels[i] for i in t])) for t in thirds]
    centre = middle + np.asarray(shift.shift_px)
    p = np.array([math.log(f_px), 0.0, 0.0])
    # How far each goes at once: a tenth of the focal length, a tenth and a thirtieth of a bend at the picture's edge.
    h = width / (2 * f_px)
    spans = (0.1, 0.1 / h**2, 0.03 / h**4)
    evaluations = 0

    def drawn(at: FloatArray, group: int) -> FloatArray:
        return project(_radial(math.exp(at[0]), at[1], at[2], centre, corners.pixel_aspect), groups[group][0])

    def search(which: int) -> float:
        """Moves one coefficient to its best; how far that moved the corners, px."""
        nonlocal p, evaluations
        before, seen = drawn(p, which), groups[which][1]

        def misfit(value: float) -> float:
            at = p.copy()
            at[which] = value
            return float(np.mean((drawn(at, which) - seen) ** 2))

        bracket = (float(p[which] - spans[which]), float(p[which]), float(p[which] + spans[which]))
        try:
            found = minimize_scalar(misfit, bracket=bracket, method="brent", options={"xtol": 1e-7})
        except ValueError:  # the best does not lie in between: any two points show the way downhill
            found = minimize_scalar(misfit, bracket=bracket[1:], method="brent", options={"xtol": 1e-7})
        evaluations += int(found.nfev)
        p = p.copy()
        p[which] = float(found.x)
        return float(np.max(np.linalg.norm(drawn(p, which) - before, axis=1)))

    for stage in ((0, 1), (0, 1, 0, 2)):
        for _ in range(_MOST_ROUNDS):
            if max([search(which) for which in stage]) < _SETTLED_PX:
                break
    return _radial(math.exp(p[0]), p[1], p[2], centre, corners.pixel_aspect), evaluations


def mrcal(corners: Corners) -> Fitted:
    """mrcal in a process of its own, every pose free, the board's warp and its own rejection of outliers on."""
    model = "LENSMODEL_OPENCV4 (fx, fy, centre, k1, k2, p1, p2) and the board's warp"
    boards = {view.target for view in corners.views if view.target.kind is TargetKind.CHESSBOARD}
    squares = [view for view in corners.views if view.target.kind is not TargetKind.CHESSBOARD]
    if squares or len({(board.squares, board.square_m) for board in boards}) != 1:
        return Fitted(problem="takes chessboards of one size only", model=model)
    target = next(iter(boards))
    columns, rows = target.grid
    listed = np.zeros((len(corners.views), rows * columns, 3))
    listed[..., 2] = -1.0
    for row, view in zip(listed, corners.views, strict=True):
        row[view.detection.point_ids, :2], row[view.detection.point_ids, 2] = view.detection.points_px, 1.0
    observations = listed.reshape(len(corners.views), rows, columns, 3)
    found = _mrcal_process(observations, float(target.square_m or 0.0), corners)
    if "problem" in found:
        return Fitted(problem=str(found["problem"]), model=model)
    held = None
    if "without" in found:
        plane = target.points_m()
        x, y = (plane / np.abs(plane).max(axis=0)).T
        held = []
        for view, one in zip(corners.views, found["without"], strict=True):
            lifted = one["warp_m"][0] * (1 - x * x) + one["warp_m"][1] * (1 - y * y)
            board = np.column_stack([plane, lifted])[view.detection.point_ids]
            held.append(_left_out(view, np.array(one["intrinsics"]), board))
    return Fitted(
        np.array(found["intrinsics"]),
        rms_px=found["rms_px"],
        outliers=found["outliers"],
        held_out_px=_rms(held) if held else None,
        cpu_ms=found["cpu_ms"],
        model=model,
    )


def _mrcal_process(observations: FloatArray, spacing_m: float, corners: Corners) -> dict[str, Any]:
    if not Path(MRCAL_PYTHON).is_file():
        return {"problem": "not installed"}
    with tempfile.TemporaryDirectory(prefix="lensmatch-bench-") as folder:
        path = Path(folder) / "corners.npz"
        np.savez(
            path,
            observations=observations,
            spacing_m=spacing_m,
            image_size=corners.image_size,
            repeats=corners.repeats,
            held_out=corners.held_out,
        )
        try:
            done = subprocess.run(
                [MRCAL_PYTHON, "-I", str(_MRCAL_SCRIPT), str(path)],
                capture_output=True,
                text=True,
                timeout=MRCAL_TIMEOUT_S,
                check=False,
                cwd=folder,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return {"problem": f"mrcal's process: {error}"}
    if done.returncode != 0:
        return {"problem": f"mrcal: {(done.stderr.strip().splitlines() or ['no reason given'])[-1]}"}
    answer: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return answer


def on_other_corners(corners: Corners, found: dict[str, tuple[FloatArray, IntArray]]) -> Corners:
    """The same pictures with another detector's corners (points px, their numbers), by view's name; what it did not
    find is missing."""
    views = []
    for view in corners.views:
        if view.name not in found:
            continue
        points, ids = found[view.name]
        covariance = np.tile(np.eye(2) * 0.05**2, (len(points), 1, 1))
        detection = replace(view.detection, points_px=points, point_ids=ids, covariance_px2=covariance)
        views.append(replace(view, detection=detection))
    return replace(corners, views=tuple(views))
