"""The nodal offset from targets at one and at two distances, surveyed and not, beside public ways to find it.

Corner level: a camera pans past boards at 2 m and 4 m, nine pans over 70 % of the half field of view, corners good to
0.05 px, drawn by the simulated studio's own optics. ``surveyed``: targets known to 1 mm and 0.02 degrees; unsurveyed:
to 10 mm and 0.2 degrees. ``told``: measured to 1 mm; the others are refused or degraded, with the reason. Baselines:
the study's operator looks for parallax by eye, 60 to 120 minutes a lens (said, not measured); and the camera's centre
from OpenCV's solvePnP in each picture, the nodal offset being how far the centres lie from the pivot along the axis
(the field of view from calibrateCamera with the same pictures). Then the picture set of another renderer (a pupil
40 mm behind the pivot) where the sample data is at hand.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.rows import Progress, Row
from calibration.detect.target import find_target
from calibration.errors import CalibrationError
from calibration.image import decode_picture
from calibration.lens import Lens
from calibration.solve.iteration import LevelFit
from calibration.solve.level import solve_level
from calibration.solve.nodal import MEASURED_MM
from calibration.solve.problem import View
from calibration.types import CameraPose, Detection, FloatArray, Quality, Target, TargetKind, TargetPose
from engine_adapters.sim.optics import Optics
from engine_adapters.sim.optics import View as SimulatedView

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

SIZE = (1920, 1080)
FOVS_DEG = (65.0, 36.0, 18.0, 9.0, 4.6)
NEAR_M, FAR_M = 2.0, 4.0
NODAL_MM = 85.0
CORNER_SIGMA_PX = 0.05
_PANS, _PAN_SHARE = 9, 0.7
_SEEDS, _QUICK_SEEDS = 12, 2
_FILL = 0.4
PLOTS = (("error_mm", "error of the nodal offset, RMS, mm"), ("parallax_px", "parallax left over a whole pan, px"))


@dataclass(frozen=True, slots=True)
class _Survey:
    name: str
    sigma_m: float
    sigma_deg: float


_SURVEYS = (_Survey("surveyed to 1 mm", 0.001, 0.02), _Survey("unsurveyed", 0.01, 0.2))


def run(*, quick: bool = False, progress: Progress | None = None) -> list[Row]:
    """Rows {case, method, lenses, told, error_mm, sigma_mm, pull_rms, fov_error_deg, parallax_px} by field of view,
    number of distances and survey."""
    show = progress or (lambda share: None)
    rows: list[Row] = []
    seeds = _QUICK_SEEDS if quick else _SEEDS
    cases = [(fov, far) for fov in FOVS_DEG for far in (True, False)]
    for number, (fov_deg, two) in enumerate(cases):
        distances = (NEAR_M, FAR_M) if two else (FAR_M,)
        for survey in _SURVEYS if two else _SURVEYS[:1]:
            rows += _rows(fov_deg, distances, survey, seeds)
        show((number + 1) / (len(cases) + 1))
    rows.append({"case": "any lens", "method": "by eye, as the study says", "minutes": "60 to 120"})
    rows.append(_renders())
    show(1.0)
    return rows


def _rows(fov_deg: float, distances_m: Sequence[float], survey: _Survey, seeds: int) -> list[Row]:
    case = f"FoV {fov_deg:g} deg, {len(distances_m)} distance{'s' * (len(distances_m) > 1)}, {survey.name}"
    ours: list[tuple[float, float, float, float]] = []
    opencv: list[tuple[float, float]] = []
    told = 0
    for seed in range(seeds):
        rng = np.random.default_rng([int(10 * fov_deg), len(distances_m), round(1e4 * survey.sigma_m), seed])
        truth, views = _pictures(fov_deg, distances_m, survey, rng)
        fit = _solved(views)
        if fit is not None and fit.nodal_seen_mm is not None:
            told += fit.nodal_told and fit.nodal_seen_mm[1] <= MEASURED_MM
            error, sigma = fit.nodal_seen_mm[0] - NODAL_MM, fit.nodal_seen_mm[1]
            left = fit.parallax.sigma_px if fit.parallax is not None else math.nan
            ours.append((error, sigma, fit.lens.fov_x_deg - fov_deg, left))
        opencv.append(_by_pnp(views, truth))
    rows: list[Row] = [{"case": case, "method": "joint fit", "lenses": seeds, "told": told} | _figures(ours)]
    errors = np.array(opencv)
    rows.append(
        {
            "case": case,
            "method": "OpenCV: calibrateCamera, solvePnP, pivot",
            "lenses": seeds,
            "error_mm": float(np.sqrt(np.nanmean(errors[:, 0] ** 2))),
            "fov_error_deg": float(np.sqrt(np.nanmean(errors[:, 1] ** 2))),
        }
    )
    return rows


def _figures(found: Sequence[tuple[float, float, float, float]]) -> Row:
    if not found:
        return {}
    error, sigma, fov, left = np.array(found).T
    return {
        "error_mm": float(np.sqrt(np.mean(error**2))),
        "sigma_mm": float(np.median(sigma)),
        "pull_rms": float(np.sqrt(np.mean((error / sigma) ** 2))),
        "fov_error_deg": float(np.sqrt(np.mean(fov**2))),
        "parallax_px": float(np.nanmean(left)) if np.isfinite(left).any() else None,
    }


def _pictures(
    fov_deg: float, distances_m: Sequence[float], survey: _Survey, rng: np.random.Generator
) -> tuple[Optics, list[View]]:
    """A random lens of this field of view, and what is known of pictures of boards at these distances."""
    shift = (float(rng.uniform(-8, 8)), float(rng.uniform(-8, 8)))
    half = math.tan(math.radians(fov_deg) / 2)
    k1_hw, k2_hw = float(rng.uniform(-0.1, 0.05)), float(rng.uniform(0.0, 0.02))
    optics = Optics.from_fov(SIZE, fov_deg, k1_hw / half**2, k2_hw / half**4, shift)
    views: list[View] = []
    for distance_m in distances_m:
        # Each board fills the same share of the picture.
        square_m = _FILL * SIZE[1] / optics.f_px * distance_m / 7
        drawn = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=square_m)
        centre = (0.0, distance_m, 1.5)
        off_m, off_deg = rng.normal(0, survey.sigma_m, 3), rng.normal(0, survey.sigma_deg, 3)
        said = TargetPose(
            (centre[0] + off_m[0], centre[1] + off_m[1], centre[2] + off_m[2]),
            float(off_deg[0]),
            float(off_deg[1]),
            float(off_deg[2]),
            sigma_m=survey.sigma_m,
            sigma_deg=survey.sigma_deg,
        )
        points = drawn.points_m()
        world = np.column_stack([points[:, 0], np.full(len(points), distance_m), 1.5 - points[:, 1]])
        for pan_deg in np.linspace(-1, 1, _PANS) * _PAN_SHARE * fov_deg / 2:
            tilt_deg = float(rng.uniform(-0.1, 0.1)) * fov_deg
            camera = SimulatedView(optics, (0.0, 0.0, 1.5), float(pan_deg), tilt_deg, nodal_offset_mm=NODAL_MM)
            pixels = camera.project(world)
            seen = np.flatnonzero(((pixels > 4) & (pixels < np.array(SIZE) - 5)).all(axis=1))
            if len(seen) < len(points) // 2:
                continue
            noisy = pixels[seen] + rng.normal(0, CORNER_SIGMA_PX, (len(seen), 2))
            covariance = np.tile(np.eye(2) * CORNER_SIGMA_PX**2, (len(seen), 1, 1))
            found = Detection(TargetKind.CHESSBOARD, noisy, seen, covariance, noisy.mean(axis=0), 0.5, Quality(1.0))
            name = f"{distance_m:g} m, pan {pan_deg:.2f}"
            pose = CameraPose((0.0, 0.0, 1.5), float(pan_deg), tilt_deg)
            views.append(View(name, f"board at {distance_m:g} m", replace(drawn, pose=said), found, pose))
    return optics, views


def _solved(views: Sequence[View]) -> LevelFit | None:
    try:
        return solve_level(views, SIZE)
    except CalibrationError:
        return None


def _by_pnp(views: Sequence[View], truth: Optics) -> tuple[float, float]:
    """(error of the nodal offset in mm, of the field of view in degrees): intrinsics from calibrateCamera, the camera's
    centre in each picture from solvePnP and the surveyed board, its distance from the pivot along the optical axis."""
    flat = [np.column_stack([v.target.points_m()[v.detection.point_ids], np.zeros(len(v.detection.points_px))])
            .astype(np.float32) for v in views]  # fmt: skip
    seen = [v.detection.points_px.astype(np.float32) for v in views]
    start = np.array([[truth.f_px, 0, 959.5], [0, truth.f_px, 539.5], [0, 0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    try:
        _, matrix, bend, _, _ = cv2.calibrateCamera(flat, seen, SIZE, start, np.zeros(5), flags=flags)
    except cv2.error:
        return math.nan, math.nan
    offsets = []
    for view in views:
        world = _world(view)
        solved, turn, shift = cv2.solvePnP(world, view.detection.points_px, matrix, bend)
        if solved:
            R = cv2.Rodrigues(turn)[0]
            centre = (-R.T @ shift).ravel() - np.array([0.0, 0.0, 1.5])
            offsets.append(1000 * float(centre @ R[2]))
    fov_deg = 2 * math.degrees(math.atan(SIZE[0] / 2 / matrix[0, 0]))
    true_deg = 2 * math.degrees(math.atan(SIZE[0] / 2 / truth.f_px))
    return float(np.mean(offsets)) - NODAL_MM if offsets else math.nan, fov_deg - true_deg


def _world(view: View) -> FloatArray:
    """Where the survey says that a view's points are, for boards that face the camera but for small angles."""
    pose, points = view.target.pose, view.target.points_m()[view.detection.point_ids]
    if pose is None:
        raise ValueError("every board of this benchmark is surveyed")
    yaw, pitch, roll = np.radians([pose.yaw_deg, pose.pitch_deg, pose.roll_deg])
    turn = cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0] @ cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))[0]
    turn = turn @ cv2.Rodrigues(np.array([0.0, roll, 0.0]))[0]
    flat = np.column_stack([points[:, 0], np.zeros(len(points)), -points[:, 1]])
    return np.asarray(flat @ turn.T + np.asarray(pose.centre_m))


def _renders() -> Row:
    """The sample picture set with a far square and a near board."""
    row: Row = {"case": "renders of another program, nodal_B", "method": "joint fit"}
    data = Path(os.environ.get("LENSMATCH_SHARED") or Path(__file__).resolve().parents[2] / "shared") / "data"
    folder = data / "renders" / "nodal_B"
    if not (folder / "set.json").is_file():
        return row | {"note": "the sample data is not here"}
    described = json.loads((folder / "set.json").read_text(encoding="utf-8"))
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    views = []
    for entry in described["pictures"]:
        target, pose = described["targets"][entry["target"]], entry["camera_pose"]
        stand = {key: value for key, value in target["pose"].items()}
        asked = Target(
            TargetKind(target["kind"]),
            squares=tuple(target["squares"]) if "squares" in target else None,
            square_m=target.get("square_m"),
            size_m=tuple(target["size_m"]) if "size_m" in target else None,
            colours=tuple(target.get("colours", ())),
            pose=TargetPose(**{**stand, "centre_m": tuple(stand["centre_m"])}),
        )
        found = find_target(decode_picture((folder / entry["file"]).read_bytes()), asked)
        if isinstance(found, Detection):
            camera = CameraPose(**{**pose, "pivot_m": tuple(pose["pivot_m"])})
            views.append(View(f"{entry['file']} {entry['target']}", entry["target"], asked, found, camera))
    fit = solve_level(views, tuple(described["image_size"]), pixel_aspect=described.get("pixel_aspect", 1.0))
    if fit.nodal_seen_mm is None:
        return row | {"note": "not told"}
    known = _true_lens(truth, tuple(described["image_size"]))
    error, sigma = fit.nodal_seen_mm[0] - known.nodal_offset_mm, fit.nodal_seen_mm[1]
    return row | {
        "lenses": 1,
        "told": int(fit.nodal_told),
        "error_mm": abs(error),
        "sigma_mm": sigma,
        "pull_rms": abs(error) / sigma,
        "fov_error_deg": abs(fit.lens.fov_x_deg - known.fov_x_deg),
        "parallax_px": fit.parallax.sigma_px if fit.parallax is not None else None,
    }


def _true_lens(truth: dict[str, object], image_size: tuple[int, int]) -> Lens:
    levels = truth["levels"]
    level = levels[0] if isinstance(levels, list) else {}
    return Lens.from_fov(image_size, level["fov_x_deg"], nodal_offset_mm=level["nodal_offset_mm"])
