"""Mistakes of the real world, each put into pictures that are drawn here from the conventions alone.

The projection below is written out from ``docs/explanations/conventions.md`` and shares nothing with the fit. Each
mistake, given a prior, must be shown with its value and leave the lens as good as the fit says; ignored, it must
cost the lens dearly; and where there is none, none may be shown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from calibration.compare import overlay, predicted_overlay
from calibration.lens import Lens
from calibration.solve.iteration import LevelFit
from calibration.solve.level import solve_level
from calibration.solve.mistakes import Mistake, Priors, Verdict
from calibration.solve.problem import View
from calibration.types import CameraPose, Detection, FloatArray, Quality, Target, TargetKind, TargetPose

SIZE = (1920, 1080)
TRUE = Lens.from_fov(SIZE, 58.0, -0.15, 0.04, (3.4, -2.2))
SIGMA_PX = 0.02
PIVOT = (0.0, 0.0, 1.6)
COLUMNS, ROWS, SQUARE_M = 8, 6, 0.1  # inner corners
BOARDS = {"board": (-0.5, 4.0, 1.6), "far board": (0.6, 7.0, 1.8)}
HEAD = [(p, t) for p in (-20.0, -7.0, 6.0, 19.0) for t in (-10.0, 0.5, 9.0)]


@dataclass(frozen=True)
class World:
    """What is really so: mistakes by their names in :class:`Priors`, and of survey and board.

    ``place_m``, ``turn_deg`` (yaw, pitch, roll) of the first board beside its survey; ``bow_m`` its middle out of its
    corners' plane, along columns and rows, away from the camera; ``roll_deg`` the scatter of single pictures.
    """

    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bow_m: tuple[float, float] = (0.0, 0.0)
    pan_scale: float = 0.0
    tilt_scale: float = 0.0
    pan_offset_deg: float = 0.0
    tilt_offset_deg: float = 0.0
    roll_offset_deg: float = 0.0
    roll_scatter_deg: float = 0.0
    pupil_mm: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Told:
    """What the fit is told: the priors, and the sigmas of survey and single rolls."""

    priors: Priors = field(default_factory=Priors)
    sigma_m: float = 0.0
    sigma_deg: float = 0.0
    roll_sigma_deg: float = 0.0


def axis_turn(axis: FloatArray, angle_deg: float, vector: FloatArray) -> FloatArray:
    """Rodrigues' rotation of a vector about a unit axis, right-handed."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.asarray(vector * c + np.cross(axis, vector) * s + axis * float(axis @ vector) * (1 - c))


def turned_axes(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """World X, Y, Z as turned about Z, then the new X, then the new Y."""
    x, y, z = np.eye(3)
    x, y = axis_turn(z, yaw_deg, x), axis_turn(z, yaw_deg, y)
    y, z = axis_turn(x, pitch_deg, y), axis_turn(x, pitch_deg, z)
    return axis_turn(y, roll_deg, x), y, axis_turn(y, roll_deg, z)


def board_in_world(name: str, world: World) -> FloatArray:
    """A board's inner corners, row by row from the top left, (N, 3) metres."""
    first = name == "board"
    right, away, up = turned_axes(*(world.turn_deg if first else (0.0, 0.0, 0.0)))
    place = np.array(BOARDS[name]) + (np.array(world.place_m) if first else 0.0)
    corners = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            x, y = 2 * column / (COLUMNS - 1) - 1, 2 * row / (ROWS - 1) - 1
            out = (world.bow_m[0] * (1 - x * x) + world.bow_m[1] * (1 - y * y)) if first else 0.0
            across, down = x * (COLUMNS - 1) / 2 * SQUARE_M, y * (ROWS - 1) / 2 * SQUARE_M
            corners.append(place + across * right - down * up + out * away)
    return np.array(corners)


def seen(points: FloatArray, pan_deg: float, tilt_deg: float, roll_deg: float, world: World) -> FloatArray:
    """World points in the picture, (N, 2) px."""
    pan = pan_deg * (1 + world.pan_scale) + world.pan_offset_deg
    tilt = tilt_deg * (1 + world.tilt_scale) + world.tilt_offset_deg
    right, forward, up = turned_axes(-pan, tilt, roll_deg + world.roll_offset_deg)
    off_right, off_down = (0.001 * mm for mm in world.pupil_mm)
    from_pupil = points - (np.array(PIVOT) + off_right * right - off_down * up)
    x, y = (from_pupil @ right) / (from_pupil @ forward), -(from_pupil @ up) / (from_pupil @ forward)
    r2 = x * x + y * y
    gain = 1 + TRUE.k1 * r2 + TRUE.k2 * r2 * r2
    u = TRUE.f_px * x * gain + (SIZE[0] - 1) / 2 + TRUE.center_shift_px[0]
    v = TRUE.f_px * y * gain + (SIZE[1] - 1) / 2 + TRUE.center_shift_px[1]
    return np.column_stack([u, v])


def pictures(world: World, told: Told, seed: int, angles: Sequence[tuple[float, float]] = HEAD) -> list[View]:
    """Both boards from every angle of the head from which all of one is in the picture."""
    rng = np.random.default_rng(seed)
    views = []
    for pan, tilt in angles:
        roll = float(rng.normal(0, world.roll_scatter_deg)) if world.roll_scatter_deg else 0.0
        for name in BOARDS:
            points = seen(board_in_world(name, world), pan, tilt, roll, world)
            if not ((points > 5) & (points < np.array(SIZE) - 6)).all():
                continue
            noisy = points + rng.normal(0, SIGMA_PX, points.shape)
            covariance = np.tile(np.eye(2) * SIGMA_PX**2, (len(noisy), 1, 1))
            ids = np.arange(len(noisy))
            found = Detection(TargetKind.CHESSBOARD, noisy, ids, covariance, noisy.mean(axis=0), 0.5, Quality(1.0))
            sure = name != "board"
            pose = TargetPose(
                BOARDS[name], sigma_m=0.0 if sure else told.sigma_m, sigma_deg=0.0 if sure else told.sigma_deg
            )
            board = Target(TargetKind.CHESSBOARD, squares=(COLUMNS + 1, ROWS + 1), square_m=SQUARE_M, pose=pose)
            camera = CameraPose(PIVOT, pan, tilt, roll_sigma_deg=told.roll_sigma_deg)
            views.append(View(f"{name} {pan} {tilt}", name, board, found, camera))
    return views


def fitted(world: World, told: Told, seed: int = 1) -> LevelFit:
    return solve_level(pictures(world, told, seed), SIZE, priors=told.priors)


MISTAKES: dict[str, tuple[World, Told, dict[str, float]]] = {
    "survey's place": (
        World(place_m=(0.004, -0.006, 0.003)),
        Told(sigma_m=0.005),
        {"place across of board": 4.0, "place in depth of board": -6.0, "height of board": 3.0},
    ),
    "survey's turn": (
        World(turn_deg=(0.4, -0.3, 0.2)),
        Told(sigma_deg=0.3),
        # About the board's own axes: columns run right, rows down, and the third goes into the board.
        {
            "turn about its columns of board": -0.3,
            "turn about its rows of board": -0.4,
            "turn in its plane of board": 0.2,
        },
    ),
    "bow": (
        World(bow_m=(0.006, -0.005)),
        Told(Priors(bow_m=0.005)),
        {"bow along columns of board": 6.0, "bow along rows of board": -5.0},
    ),
    "pan scale": (World(pan_scale=0.002), Told(Priors(pan_scale=0.002)), {"pan scale": 0.002}),
    "tilt scale": (World(tilt_scale=-0.003), Told(Priors(tilt_scale=0.003)), {"tilt scale": -0.003}),
    "pan offset": (World(pan_offset_deg=0.05), Told(Priors(pan_offset_deg=0.05)), {"pan offset": 0.05}),
    "tilt offset": (World(tilt_offset_deg=-0.04), Told(Priors(tilt_offset_deg=0.05)), {"tilt offset": -0.04}),
    "roll offset": (World(roll_offset_deg=0.2), Told(Priors(roll_offset_deg=0.2)), {"roll offset": 0.2}),
    "pupil off axis": (
        World(pupil_mm=(6.0, -4.0)),
        Told(Priors(off_axis_mm=5.0)),
        {"pupil off axis, right": 6.0, "pupil off axis, down": -4.0},
    ),
    "roll of single pictures": (World(roll_scatter_deg=0.05), Told(roll_sigma_deg=0.05), {}),
}
"""By name: what is so, what the fit is told, and the mistakes that it must show with their values."""


def of_name(fit: LevelFit) -> dict[str, Mistake]:
    return {f"{m.name} of {m.subject}" if m.subject else m.name: m for m in fit.mistakes}


def overlay_in_sigmas(fit: LevelFit) -> float:
    return overlay(TRUE, fit.lens).rms_px / predicted_overlay(fit.lens, fit.covariance).rms_px


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_with_a_prior_is_shown_and_spares_the_lens(name: str) -> None:
    world, told, values = MISTAKES[name]
    fit = fitted(world, told)
    found = of_name(fit)
    for mistake, value in values.items():
        told_of_it = found[mistake]
        assert told_of_it.verdict is Verdict.SHOWN, str(told_of_it)
        assert abs(told_of_it.estimate - value) < 4 * told_of_it.sigma, str(told_of_it)
    assert overlay_in_sigmas(fit) < 3
    assert fit.rms_px == pytest.approx(SIGMA_PX, rel=0.15)
    assert not fit.outliers
    assert not fit.dropped


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_that_is_ignored_costs_the_lens(name: str) -> None:
    world, told, _ = MISTAKES[name]
    with_prior = overlay(TRUE, fitted(world, told).lens).max_px
    views = pictures(world, Told(), 1)
    ignored = overlay(TRUE, solve_level(views, SIZE).lens).max_px
    assert ignored > 3 * with_prior, f"{name}: {with_prior:.3f} px with its prior, {ignored:.3f} px ignored"


ALL = Told(Priors(0.002, 0.002, 0.002, 0.05, 0.05, 0.1, 5.0), sigma_m=0.005, sigma_deg=0.3, roll_sigma_deg=0.02)


def test_no_mistake_is_shown_where_there_is_none() -> None:
    """Every prior at once, nothing wrong: over 40 draws at most 3 % of the mistakes are shown, and sigmas are true."""
    shown, told, squares = 0, 0, []
    for seed in range(40):
        fit = solve_level(pictures(World(), ALL, 100 + seed, HEAD[::2]), SIZE, priors=ALL.priors)
        assert len(fit.mistakes) == 17
        verdicts = [mistake.verdict for mistake in fit.mistakes]
        shown += verdicts.count(Verdict.SHOWN)
        told += len(verdicts) - verdicts.count(Verdict.UNTOLD)
        squares.append(overlay_in_sigmas(fit) ** 2)
    print(f"false alarms: {shown} of {told} that are told; overlay over predicted {np.mean(squares) ** 0.5:.2f} (RMS)")
    assert told > 200
    assert shown <= 0.03 * told
    assert 0.5 < np.mean(squares) < 1.5


def test_all_mistakes_at_once_leave_the_lens_as_good_as_the_fit_says() -> None:
    world = World(
        place_m=(0.004, -0.006, 0.003),
        turn_deg=(0.3, -0.2, 0.2),
        bow_m=(0.002, -0.002),
        pan_scale=0.002,
        tilt_scale=-0.002,
        pan_offset_deg=0.04,
        tilt_offset_deg=-0.04,
        roll_offset_deg=0.1,
        roll_scatter_deg=0.02,
        pupil_mm=(5.0, -4.0),
    )
    together = fitted(world, ALL)
    assert overlay_in_sigmas(together) < 3
    assert together.rms_px == pytest.approx(SIGMA_PX, rel=0.15)
    ignored = overlay(TRUE, solve_level(pictures(world, Told(), 1), SIZE).lens).max_px
    assert ignored > 5 * overlay(TRUE, together.lens).max_px


def test_what_the_pictures_cannot_tell_is_said_to_be_untold() -> None:
    """A head's zero and the place of everything it looks at turn together: the pictures show neither alone."""
    views = []
    for view in pictures(World(), Told(), 3):
        pose = view.target.pose
        if view.target_name == "board" and pose is not None:
            views.append(replace(view, target=replace(view.target, pose=replace(pose, sigma_m=0.005, sigma_deg=0.3))))
    fit = solve_level(views, SIZE, priors=Priors(pan_offset_deg=0.05))
    assert of_name(fit)["pan offset"].verdict is Verdict.UNTOLD
