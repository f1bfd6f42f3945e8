"""One level's fit side by side: ours, OpenCV's, mrcal's, least squares with known poses, and the study's descent.

Every method gets the same corners in the same run; baselines that are usually run on OpenCV's own corners are run on
those too. The truth is read after the fits.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from app.documents import read_picture_set
from app.picture_sets import transfer_of
from benchmarks.level_fits import (
    Corners,
    Fitted,
    known_poses,
    mrcal,
    on_other_corners,
    opencv,
    ours,
    overlay_max_px,
    pull_rms,
    study,
)
from benchmarks.rows import Column, Progress, Row, decimals, percent, readable
from calibration.camera import camera_rotation, inside_picture, project_target, rays_of
from calibration.compare import NEGLIGIBLE_PX, edge_effect_px
from calibration.detect.target import find_target
from calibration.errors import InvalidInput
from calibration.image import decode_picture
from calibration.lens import Lens
from calibration.solve.geometry import shape_m
from calibration.solve.problem import View
from calibration.synthetic import observe
from calibration.types import (
    CameraPose,
    Detection,
    FloatArray,
    IntArray,
    Picture,
    Quality,
    Target,
    TargetKind,
    TargetPose,
)
from engine_adapters.sim.optics import Optics
from engine_adapters.sim.optics import View as SimView
from engine_adapters.sim.render import render_real
from engine_adapters.sim.room import build_room

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

PLOTS = (
    ("overlay_max_px", "largest overlay error, px"),
    ("rms_px", "residual RMS per coordinate, px"),
    ("ratio", "CPU time of the fit, 1 = OpenCV's calibrateCamera"),
)
OURS, OPENCV, MRCAL = "lensmatch", "OpenCV calibrateCamera", "mrcal"
KNOWN, STUDY = "least squares, known poses", "the study's descent, offline"
_ON_SB = ", SB ACCURACY corners"
_VIEWS = 20
_SHARP, _HARD = (0.6, 2.0), (4.0, 5.0)
_SIZE = (1920, 1080)
_WIDE = Lens.from_fov(_SIZE, 58.0, -0.15, 0.04, (3.4, -2.2))
_DASH = Lens((1280, 720), 1168.0, -0.2445, -0.02, (33.9, 28.6))
_BOARD = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((0.0, 5.0, 1.6)))
_HELD = Target(TargetKind.CHESSBOARD, squares=(10, 7), square_m=0.03)
_BOW_MM = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Corners of one level, its true lens where that is known, other detectors' corners, or why it cannot be run."""

    name: str
    corners: Corners | None = None
    truth: Lens | None = None
    sb: Corners | None = None
    problem: str = ""
    methods: tuple[str, ...] = field(default=(OURS, OPENCV, MRCAL))


FITS: dict[str, Callable[[Corners], Fitted]] = {
    OURS: ours,
    OPENCV: opencv,
    MRCAL: mrcal,
    KNOWN: known_poses,
    STUDY: study,
}


def run(*, quick: bool, progress: Progress | None = None) -> list[Row]:
    """Rows by case and method; ``quick``: three cases, few repeats, and OpenCV's slow detector left out.

    ``rms_px`` and ``held_out_px`` (pictures left out in turn) are per coordinate, ``outliers`` the share of points
    cut, ``overlay_max_px`` the largest overlay error against the truth, ``pull_rms`` the RMS of error over sigma,
    ``cpu_ms`` the least CPU time of the fit alone, ``ratio`` that over OpenCV's on the same case.
    """
    makers = _cases(quick)
    rows: list[Row] = []
    for number, make in enumerate(makers):
        case = make()
        rows += _rows(case)
        if progress is not None:
            progress((number + 1) / len(makers))
    return rows


def _cases(quick: bool) -> list[Callable[[], Case]]:
    repeats = 2 if quick else 7
    data = Path(os.environ.get("LENSMATCH_SHARED") or Path(__file__).resolve().parents[2] / "shared") / "data"
    hand = partial(_hand_held, repeats)
    if quick:
        return [
            partial(_posed, repeats, False),
            partial(hand, _BOW_MM),
            partial(_render_set, repeats, data / "renders" / "chess_Z0F0", with_sb=False),
        ]
    sets = [f"{kind}_{level}" for kind in ("chess", "square") for level in ("Z0F0", "Z1F0", "Z3F1")]
    return [
        partial(_posed, repeats, False),
        partial(_posed, repeats, True),
        partial(hand, 0.0),
        partial(hand, _BOW_MM),
        partial(_photographs, repeats, data / "photos_chessboard"),
        *(partial(_render_set, repeats, data / "renders" / name) for name in sets),
        partial(_simulated, repeats, "simulated pictures, sharp", *_SHARP),
        partial(_simulated, repeats, "simulated pictures, blur 4 px, noise 5", *_HARD),
    ]


def _rows(case: Case) -> list[Row]:
    if case.corners is None:
        return [{"case": case.name, "method": method, "note": case.problem} for method in case.methods]
    rows: list[Row] = []
    reference: float | None = None
    fits = [(method, case.corners, FITS[method]) for method in case.methods]
    if case.sb is not None:
        others = (OPENCV, KNOWN) if KNOWN in case.methods else (OPENCV,)
        fits += [(method + _ON_SB, case.sb, FITS[method]) for method in others]
    found = [(method, corners, fit(corners)) for method, corners, fit in fits]
    reference = next((fitted.cpu_ms for method, _, fitted in found if method == OPENCV), None)
    for method, corners, fitted in found:
        rows.append(_row(case, method, corners, fitted, reference))
    return rows


def _row(case: Case, method: str, corners: Corners, fitted: Fitted, reference_ms: float | None) -> Row:
    row: Row = {
        "case": case.name,
        "method": method,
        "pictures": len(corners.views),
        "points": sum(len(view.detection.points_px) for view in corners.views),
        "rms_px": fitted.rms_px,
        "outliers": fitted.outliers,
        "held_out_px": fitted.held_out_px,
        "evaluations": fitted.evaluations,
        "cpu_ms": fitted.cpu_ms,
        "ratio": fitted.cpu_ms / reference_ms if fitted.cpu_ms is not None and reference_ms else None,
        "note": fitted.problem or fitted.model,
    }
    if case.truth is not None and fitted.values is not None:
        effects = edge_effect_px(case.truth)
        for name, found, true, effect in zip(
            ("k1_error", "k2_error"), fitted.values[4:6], (case.truth.k1, case.truth.k2), effects, strict=True
        ):
            row[name] = abs(float(found) - true) / abs(true) if effect > NEGLIGIBLE_PX else None
        row["overlay_max_px"] = overlay_max_px(case.truth, fitted.values)
        row["pull_rms"] = pull_rms(case.truth, fitted)
    return row


def _posed(repeats: int, rough: bool) -> Case:
    """Twenty pictures of a surveyed board; ``rough``: the head is 0.01 deg off each time, the survey 2 mm and 0.1 deg,
    and ours is told so."""
    rng = np.random.default_rng(20)
    views: list[View] = []
    place, turn = (rng.normal(0, 0.002, 3), rng.normal(0, 0.1, 3)) if rough else (np.zeros(3), np.zeros(3))
    nominal = replace(_BOARD, pose=TargetPose((0.0, 5.0, 1.6), sigma_m=0.002 * rough, sigma_deg=0.1 * rough))
    stands = replace(_BOARD, pose=TargetPose((place[0], 5 + place[1], 1.6 + place[2]), *turn.tolist()))
    while len(views) < _VIEWS:
        pose = CameraPose((0.0, 0.0, 1.6), rng.uniform(-22, 22), rng.uniform(-12, 12), sigma_deg=0.01 * rough)
        off = rng.normal(0, 0.01, 3) if rough else np.zeros(3)
        looks = CameraPose(pose.pivot_m, pose.pan_deg + off[0], pose.tilt_deg + off[1], off[2])
        seen = observe(_WIDE, looks, stands, rng, 0.02)
        if isinstance(seen, Detection):
            views.append(View(f"{len(views)}", "board", nominal, seen, pose))
    name = f"{_VIEWS} posed views, " + ("with priors" if rough else "poses exact")
    corners = Corners(tuple(views), _SIZE, repeats=repeats)
    return Case(name, corners, _WIDE, methods=(OURS, OPENCV, MRCAL, KNOWN, STUDY))


def _hand_held(repeats: int, bow_mm: float) -> Case:
    """Twenty pictures of a board held by hand, flat or bowed along its columns."""
    rng = np.random.default_rng(21)
    board = np.column_stack([_HELD.points_m(), shape_m(_HELD, "bow along columns", bow_mm)])
    views: list[View] = []
    while len(views) < _VIEWS:
        R = camera_rotation(*rng.uniform(-35, 35, 3)) @ camera_rotation(0, 0, 0).T
        shift = np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.25, 0.45)])
        pixels = _DASH.project(rays_of(board @ R.T + shift))
        if not ((pixels > 5) & (pixels < np.array(_DASH.image_size) - 6)).all():
            continue
        pixels = pixels + rng.normal(0, 0.05, pixels.shape)
        views.append(View(f"{len(views)}", "board", _HELD, _detection(pixels, 0.05)))
    name = f"{_VIEWS} hand-held views, " + (f"board bowed {bow_mm:g} mm" if bow_mm else "board flat")
    return Case(name, Corners(tuple(views), _DASH.image_size, repeats=repeats), _DASH)


def _detection(points: FloatArray, sigma_px: float) -> Detection:
    covariance = np.tile(np.eye(2) * sigma_px**2, (len(points), 1, 1))
    ids = np.arange(len(points))
    return Detection(TargetKind.CHESSBOARD, points, ids, covariance, points.mean(axis=0), 0.5, Quality(1.0))


def _photographs(repeats: int, folder: Path) -> Case:
    name = "photographs of a hand-held board"
    if not (folder / "set.json").is_file():
        return Case(name, problem="sample data not there")
    views, sb, size, _ = _found_in(folder, True)
    corners = Corners(views, size, repeats=repeats, held_out=True)
    return Case(name, corners, sb=on_other_corners(corners, sb))


def _render_set(repeats: int, folder: Path, *, with_sb: bool = True) -> Case:
    methods = (OURS, OPENCV, MRCAL, KNOWN, STUDY)
    if not (folder / "set.json").is_file():
        return Case(f"renders {folder.name}", problem="sample data not there", methods=methods)
    views, sb, size, aspect = _found_in(folder, with_sb)
    corners = Corners(views, size, aspect, repeats=repeats)
    level = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["levels"][0]
    shift = level["center_shift_px"]
    truth = Lens(size, level["f_px"], level["k1"], level["k2"], (shift[0], shift[1]), aspect)
    other = on_other_corners(corners, sb) if sb else None
    return Case(f"renders {folder.name}", corners, truth, other, methods=methods)


def _found_in(
    folder: Path, with_sb: bool
) -> tuple[tuple[View, ...], dict[str, tuple[FloatArray, IntArray]], tuple[int, int], float]:
    """The targets found in a picture set by our detector and by OpenCV's, the pictures' size and aspect."""
    described = read_picture_set(folder)
    views: list[View] = []
    other: dict[str, tuple[FloatArray, IntArray]] = {}
    for entry in described.pictures:
        try:
            picture = decode_picture((folder / entry.file).read_bytes(), expected_size=described.image_size)
        except InvalidInput:  # a picture of another size is none of this level's
            continue
        target = described.targets[entry.target].to_target()
        seen = find_target(picture, target, transfer=transfer_of(described, entry.file))
        if not isinstance(seen, Detection):
            continue
        pose = entry.camera_pose.to_pose() if entry.camera_pose is not None else None
        views.append(View(entry.file, entry.target, target, seen, pose))
        if with_sb and target.kind is TargetKind.CHESSBOARD:
            corners = _sb_corners(picture, target, seen)
            if corners is not None:
                other[entry.file] = corners
    return tuple(views), other, described.image_size, described.pixel_aspect


def _sb_corners(picture: Picture, target: Target, ours_found: Detection) -> tuple[FloatArray, IntArray] | None:
    """OpenCV's best corners, numbered as ours number the same ones: it may begin at any corner of the board."""
    colours = set(target.colours)
    if colours == {"red", "black"}:
        plane = cv2.extractChannel(picture, 2)
    elif colours == {"red", "white"}:
        plane = cv2.addWeighted(cv2.extractChannel(picture, 0), 0.5, cv2.extractChannel(picture, 1), 0.5, 0)
    else:
        plane = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    found, points = cv2.findChessboardCornersSB(
        np.asarray(plane, dtype=np.uint8), target.grid, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    )
    if not found:
        return None
    table = points.reshape(-1, 2).astype(np.float64)
    away = np.linalg.norm(table[:, None] - ours_found.points_px[None], axis=2)
    nearest = np.argmin(away, axis=0)
    if len(set(nearest.tolist())) < len(nearest):
        return None
    return table[nearest], ours_found.point_ids


def _simulated(repeats: int, name: str, blur_px: float, noise: float) -> Case:
    """Pictures of the simulated camera, its board put in the middle, at the sides and in the corners."""
    rng = np.random.default_rng(22)
    room = build_room()
    panel = next(panel for panel in room.panels if panel.name == "board_large")
    pose = TargetPose(panel.centre_m, panel.yaw_deg, panel.pitch_deg, panel.roll_deg)
    target = Target(
        TargetKind.CHESSBOARD, squares=panel.squares, square_m=panel.cell_m[0], colours=("red", "white"), pose=pose
    )
    optics = Optics(_SIZE, _WIDE.f_px, _WIDE.k1, _WIDE.k2, _WIDE.center_shift_px)
    middle = math.degrees(math.atan2(panel.centre_m[0] - room.pivot_m[0], panel.centre_m[1] - room.pivot_m[1]))
    views: list[View] = []
    for pan, tilt in _around(middle):
        camera = CameraPose(room.pivot_m, pan, tilt)
        points = project_target(_WIDE, camera, target)
        if not inside_picture(points, _SIZE, margin_px=20.0):
            continue
        drawn = render_real(SimView(optics, room.pivot_m, pan, tilt), room, blur_px)
        noisy = np.clip(np.rint(drawn + rng.normal(0, noise, drawn.shape)), 0, 255).astype(np.uint8)
        seen = find_target(noisy, target)
        if isinstance(seen, Detection):
            views.append(View(f"{pan:.0f} {tilt:.0f}", panel.name, target, seen, camera))
    methods = (OURS, OPENCV, MRCAL, KNOWN, STUDY)
    if not views:
        return Case(name, problem="the board was found in no picture", methods=methods)
    return Case(name, Corners(tuple(views), _SIZE, repeats=repeats), _WIDE, methods=methods)


def _around(middle_deg: float) -> Iterator[tuple[float, float]]:
    for pan in (-18.0, -9.0, 0.0, 9.0, 18.0):
        for tilt in (-8.0, 0.0, 8.0):
            yield middle_deg + pan, tilt


def columns() -> list[Column]:
    """How a person reads the rows: column and format."""

    return [
        ("case", readable),
        ("method", readable),
        ("pictures", readable),
        ("points", readable),
        ("rms_px", decimals(4)),
        ("outliers", percent(2)),
        ("held_out_px", decimals(4)),
        ("overlay_max_px", decimals(4)),
        ("k1_error", percent(2)),
        ("k2_error", percent(2)),
        ("pull_rms", decimals(2)),
        ("evaluations", readable),
        ("cpu_ms", decimals(1)),
        ("ratio", decimals(2)),
        ("note", readable),
    ]
