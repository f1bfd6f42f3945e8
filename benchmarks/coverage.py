"""Whether the stated sigmas hold: many random lenses, pictures drawn and found and solved, errors against sigmas.

The pictures are those of the simulated camera (:mod:`engine_adapters.sim`), whose code shares nothing with detector
and fit. Each lens, from 70 to 5 degrees, barrel to pincushion, shifted, is solved from its pictures alone. Three kinds
of level: posed exactly; posed with errors of encoders, survey and nodal offset drawn from the sigmas that are stated;
and a hand-held board whose poses nobody knows. True values must lie within one sigma in 68 of 100 cases and within
1.96 in 95; the RMS of errors over their sigmas is 1. Levels that are refused are counted, never replaced.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Column, Progress, Row, decimals, percent, readable
from calibration.compare import overlay, predicted_overlay
from calibration.detect.target import find_target
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.solve.level import solve_level
from calibration.solve.problem import View
from calibration.types import CameraPose, Detection, Target, TargetKind, TargetPose
from engine_adapters.sim.optics import Optics
from engine_adapters.sim.optics import View as Camera
from engine_adapters.sim.render import render_real
from engine_adapters.sim.room import Panel, Room, RoomKind

KINDS = ("posed exactly", "posed with priors", "hand-held")
QUANTITIES = ("fov_x_deg", "k1", "k2", "center_shift_x_px", "center_shift_y_px")
LENSES, QUICK_LENSES = 45, 2
PLOTS = (
    ("within_1_sigma", "share of errors within one sigma (0.68)"),
    ("within_1_96_sigma", "share of errors within 1.96 sigma (0.95)"),
    ("pull_rms", "RMS of errors over their sigmas (1)"),
)

_SIZE = (960, 540)
_SQUARES = (9, 7)
_PIVOT_M = (0.0, 0.0, 1.6)
_DISTANCE_M = 5.0
_SHARP_PX = 0.6
_RED, _WHITE = (0, 0, 255), (255, 255, 255)
_PLACES = ((0, 0), (-1, 0), (1, 0), (-1, -1), (1, 1), (1, -1), (-1, 1), (0, -1), (0, 1))


@dataclass(frozen=True)
class _Case:
    """A lens with its room: ``height_m`` of the board, noise on coded values, blur and sigmas that are stated."""

    optics: Optics
    height_m: float
    noise: float
    blur_px: float
    angle_sigma_deg: float
    turn_sigma_deg: float
    place_sigma_m: float
    nodal_sigma_mm: float
    true_nodal_mm: float

    @property
    def target(self) -> Target:
        return Target(TargetKind.CHESSBOARD, _SQUARES, self.height_m / _SQUARES[1], colours=("red", "white"))

    def reach(self, axis: int) -> float:
        """Half of the picture over the focal length, along u or v."""
        return _SIZE[axis] / 2 / self.optics.f_px


@dataclass(frozen=True)
class _Outcome:
    """A level that was solved: pulls by quantity, overlay error as expected and as it is, px RMS."""

    pulls: dict[str, float]
    expected_px: float
    true_px: float


def run(*, quick: bool = False, progress: Progress | None = None) -> list[Row]:
    """Rows per kind of level, then all pooled, then each quantity on its own."""
    count = QUICK_LENSES if quick else LENSES
    rows: list[Row] = []
    every: list[_Outcome] = []
    for index, kind in enumerate(KINDS):
        solved: list[_Outcome] = []
        for number in range(count):
            outcome = _solve(kind, np.random.default_rng((index, number)))
            if outcome is not None:
                solved.append(outcome)
            if progress is not None:
                progress((index + (number + 1) / count) / len(KINDS))
        rows.append(_row(kind, "all five", solved, QUANTITIES, refused=count - len(solved)))
        every += solved
    rows.append(_row("all", "all five", every, QUANTITIES, refused=count * len(KINDS) - len(every)))
    return rows + [_row("all", name, every, (name,)) for name in QUANTITIES]


def columns() -> list[Column]:
    """How a person reads the rows."""

    return [
        *(("case", readable), ("method", readable), ("levels", readable), ("refused", readable), ("errors", readable)),
        *(("within_1_sigma", percent(1)), ("within_1_96_sigma", percent(1)), ("pull_rms", decimals(3))),
        *(("expected_overlay_px", decimals(4)), ("true_overlay_px", decimals(4))),
    ]


def _row(kind: str, what: str, solved: Sequence[_Outcome], names: Sequence[str], *, refused: int | None = None) -> Row:
    pulls = np.array([outcome.pulls[name] for outcome in solved for name in names if name in outcome.pulls])
    row: Row = {"case": kind, "method": what, "levels": len(solved), "refused": refused, "errors": len(pulls)}
    if len(pulls):
        row["within_1_sigma"] = float(np.mean(np.abs(pulls) < 1))
        row["within_1_96_sigma"] = float(np.mean(np.abs(pulls) < 1.96))
        row["pull_rms"] = float(np.sqrt(np.mean(pulls**2)))
    if refused is not None and solved:
        row["expected_overlay_px"] = _root_mean_square([outcome.expected_px for outcome in solved])
        row["true_overlay_px"] = _root_mean_square([outcome.true_px for outcome in solved])
    return row


def _root_mean_square(values: Sequence[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values))


def _random_case(rng: np.random.Generator) -> _Case:
    while True:
        fov_x_deg = math.exp(rng.uniform(math.log(5.0), math.log(70.0)))
        half = math.tan(math.radians(fov_x_deg) / 2)
        k1_hw, k2_hw = rng.uniform(-0.12, 0.08), rng.uniform(-0.01, 0.03)
        shift_px = (float(rng.uniform(-12, 12)), float(rng.uniform(-12, 12)))
        optics = Optics.from_fov(_SIZE, fov_x_deg, k1_hw / half**2, k2_hw / half**4, shift_px)
        if not optics.folds_inside_picture:
            break
    px_deg = fov_x_deg / _SIZE[0]
    nodal_sigma_mm = 3.0
    return _Case(
        optics,
        height_m=float(rng.uniform(0.45, 0.6)) * _DISTANCE_M * _SIZE[1] / optics.f_px,
        noise=float(rng.uniform(1, 5)),
        blur_px=float(rng.uniform(0.5, 4)),
        angle_sigma_deg=float(rng.uniform(0.1, 1.0)) * px_deg,
        turn_sigma_deg=0.1,
        place_sigma_m=0.003,
        nodal_sigma_mm=nodal_sigma_mm,
        true_nodal_mm=float(rng.normal(0, nodal_sigma_mm)),
    )


def _solve(kind: str, rng: np.random.Generator) -> _Outcome | None:
    """A random lens measured from its pictures; None where it was refused."""
    case = _random_case(rng)
    nodal_sigma_mm = 0.0
    if kind == "hand-held":
        views = _hand_held(case, rng)
    else:
        exact = kind == "posed exactly"
        views = _posed(case, rng, exact)
        nodal_sigma_mm = 0.0 if exact else case.nodal_sigma_mm
    try:
        fit = solve_level(views, _SIZE, nodal_sigma_mm=nodal_sigma_mm)
        expected = predicted_overlay(fit.lens, fit.covariance)
    except CalibrationError:
        return None
    optics, lens, sigma = case.optics, fit.lens, fit.sigma
    truth = Lens(_SIZE, optics.f_px, optics.k1, optics.k2, optics.center_shift_px)
    told = {
        "fov_x_deg": (lens.fov_x_deg - truth.fov_x_deg) / fit.sigma_fov_x_deg,
        "k1": (lens.k1 - truth.k1) / sigma[1],
        "k2": (lens.k2 - truth.k2) / sigma[2],
        "center_shift_x_px": (lens.center_shift_px[0] - truth.center_shift_px[0]) / sigma[3],
        "center_shift_y_px": (lens.center_shift_px[1] - truth.center_shift_px[1]) / sigma[4],
    }
    untold = {name.removesuffix("_px") for name in fit.untold}
    pulls = {name: float(pull) for name, pull in told.items() if not any(name.startswith(u) for u in untold)}
    return _Outcome(pulls, expected.rms_px, overlay(truth, lens).rms_px)


def _posed(case: _Case, rng: np.random.Generator, exact: bool) -> list[View]:
    """A surveyed board seen from known head angles, in nine places of the frame."""

    def off(sigma: float, count: int) -> NDArray[np.float64]:
        return np.zeros(count) if exact else rng.normal(0, sigma, count)

    target = _with_pose(case, 0.0 if exact else case.place_sigma_m, 0.0 if exact else case.turn_sigma_deg)
    pivot_m = _PIVOT_M + off(case.place_sigma_m, 3)
    centre_m = _PIVOT_M + np.array([0.0, _DISTANCE_M, 0.0]) + off(case.place_sigma_m, 3)
    panel = _panel(case, centre_m, off(case.turn_sigma_deg, 3))
    views: list[View] = []
    for across, down in _PLACES:
        pan = -math.degrees(math.atan(across * rng.uniform(0.4, 0.6) * case.reach(0)))
        tilt = math.degrees(math.atan(down * rng.uniform(0.25, 0.4) * case.reach(1)))
        turn = off(case.angle_sigma_deg, 3)
        nodal_mm = 0.0 if exact else case.true_nodal_mm
        camera = Camera(case.optics, _triple(pivot_m), pan + turn[0], tilt + turn[1], turn[2], nodal_mm)
        found = _find(case, camera, panel, rng)
        if found is None:
            continue
        sigmas = (0.0, 0.0) if exact else (case.place_sigma_m, case.angle_sigma_deg)
        views.append(View(f"{len(views)}", "board", target, found, CameraPose(_PIVOT_M, pan, tilt, 0.0, *sigmas)))
    return views


def _hand_held(case: _Case, rng: np.random.Generator) -> list[View]:
    """A board held at twelve random places and turns before a camera that stands."""
    views: list[View] = []
    for _ in range(12):
        distance_m = _DISTANCE_M * rng.uniform(0.9, 1.2)
        place = rng.uniform(-0.45, 0.45, 2) * [case.reach(0), case.reach(1)] * distance_m
        centre_m = _PIVOT_M + np.array([place[0], distance_m, place[1]])
        panel = _panel(case, centre_m, rng.uniform(-40, 40, 3))
        found = _find(case, Camera(case.optics, _PIVOT_M), panel, rng)
        if found is not None:
            views.append(View(f"{len(views)}", "board", case.target, found))
    return views


def _with_pose(case: _Case, sigma_m: float, sigma_deg: float) -> Target:
    pose = TargetPose((_PIVOT_M[0], _PIVOT_M[1] + _DISTANCE_M, _PIVOT_M[2]), 0.0, 0.0, 0.0, sigma_m, sigma_deg)
    target = case.target
    return Target(target.kind, target.squares, target.square_m, colours=target.colours, pose=pose)


def _panel(case: _Case, centre_m: NDArray[np.float64], turn_deg: NDArray[np.float64]) -> Panel:
    cell_m = case.height_m / _SQUARES[1]
    yaw, pitch, roll = (float(angle) for angle in turn_deg)
    return Panel(
        "board",
        _SQUARES,
        (cell_m, cell_m),
        (_RED, _WHITE),
        _triple(centre_m),
        margin_m=0.5 * cell_m,
        yaw_deg=yaw,
        pitch_deg=pitch,
        roll_deg=roll,
    )


def _find(case: _Case, camera: Camera, panel: Panel, rng: np.random.Generator) -> Detection | None:
    """The board in a picture of it, None where the detector refuses it (cut by the border, say)."""
    coded = _drawn(camera, panel, case.blur_px)
    noisy = coded + case.noise * rng.standard_normal(coded.shape, dtype=np.float32)
    picture = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    found = find_target(picture, case.target)
    return found if isinstance(found, Detection) else None


def _drawn(camera: Camera, panel: Panel, blur_px: float) -> NDArray[np.float32]:
    """The board's picture, coded values (H, W, 3). Drawn sharp and blurred in linear light: the drawer takes a
    line's distance to first order, which under a blur of 4 px moves edges by up to 0.01 px where a lens bends."""
    sharp = render_real(camera, Room(RoomKind.BOARDS, (panel,), (), ()), min(blur_px, _SHARP_PX))
    more_px = math.sqrt(max(blur_px**2 - _SHARP_PX**2, 0.0))
    if more_px < _SHARP_PX:
        return render_real(camera, Room(RoomKind.BOARDS, (panel,), (), ()), blur_px).astype(np.float32)
    value = sharp.astype(np.float32) / 255
    light = np.where(value < 0.081, value / 4.5, ((value + 0.099) / 1.099) ** (1 / 0.45)).astype(np.float32)
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), more_px, borderType=cv2.BORDER_REPLICATE))
    return np.asarray(255 * np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099), dtype=np.float32)


def _triple(values: Sequence[float] | NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
