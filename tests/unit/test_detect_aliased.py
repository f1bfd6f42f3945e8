"""Targets in pictures sharper than their pixels (one sample a pixel, no noise): found, and the covariance owns up."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.detect.aliasing import edge_variance, unsmoothed_share
from calibration.detect.target import find_target
from calibration.image import Transfer
from calibration.types import Detection, FloatArray, Picture, Target, TargetKind

WIDTH, HEIGHT = 640, 480
CODES = {"red": (30, 25, 200), "white": (230, 230, 230), "black": (8, 8, 8)}
SQUARES = (9, 7)


def on_plane(u: FloatArray, v: FloatArray, matrix: FloatArray, k1: float) -> tuple[FloatArray, FloatArray]:
    """Pixels taken back through one radial term (about the picture's centre, over its width) and a homography."""
    x, y = (u - WIDTH / 2) / WIDTH, (v - HEIGHT / 2) / WIDTH
    distorted_x, distorted_y = x, y
    for _ in range(25 if k1 else 0):
        scale = 1 + k1 * (x * x + y * y)
        x, y = distorted_x / scale, distorted_y / scale
    plane = np.linalg.inv(matrix) @ np.stack([x * WIDTH + WIDTH / 2, y * WIDTH + HEIGHT / 2, np.ones_like(x)]).reshape(
        3, -1
    )
    return (plane[0] / plane[2]).reshape(u.shape), (plane[1] / plane[2]).reshape(u.shape)


def in_picture(plane: FloatArray, matrix: FloatArray, k1: float) -> FloatArray:
    seen = np.column_stack([plane, np.ones(len(plane))]) @ matrix.T
    q = (seen[:, :2] / seen[:, 2:] - [WIDTH / 2, HEIGHT / 2]) / WIDTH
    return np.asarray(WIDTH * q * (1 + k1 * (q**2).sum(axis=1, keepdims=True)) + [WIDTH / 2, HEIGHT / 2])


def pose(side: float, centre: FloatArray, roll_deg: float = 0.0, lean: float = 0.0) -> FloatArray:
    """From squares, the board's middle the origin, to pixels."""
    cos, sin = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    turn = np.array([[side * cos, -side * sin, centre[0]], [side * sin, side * cos, centre[1]], [0, 0, 1.0]])
    return np.asarray(turn @ np.array([[1, 0, 0], [0, 1, 0], [lean / 9, lean / 12, 1.0]]))


def draw_board(
    matrix: FloatArray, colours: tuple[str, str], border: float, back: str, k1: float
) -> tuple[Picture, FloatArray]:
    """The board with the light of one point for each pixel; and its inner corners (N, 2)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    x, y = on_plane(u, v, matrix, k1)
    half = np.array(SQUARES) / 2
    picture = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    picture[:] = CODES[back]
    sheet = CODES["black"] if colours[1] == "black" else CODES["white"]
    picture[(np.abs(x) < half[0] + border) & (np.abs(y) < half[1] + border)] = sheet
    first = (np.floor(x + half[0]) + np.floor(y + half[1])) % 2 == 0
    board = (np.abs(x) < half[0]) & (np.abs(y) < half[1])
    picture[board & first], picture[board & ~first] = CODES[colours[0]], CODES[colours[1]]
    inner = np.array([(c, r) for r in range(1, SQUARES[1]) for c in range(1, SQUARES[0])]) - half
    return picture, in_picture(inner, matrix, k1)


def found(picture: Picture, target: Target) -> Detection:
    result = find_target(picture, target, transfer=Transfer.SRGB)
    assert isinstance(result, Detection), result
    return result


def board(colours: tuple[str, str]) -> Target:
    return Target(TargetKind.CHESSBOARD, squares=SQUARES, square_m=0.05, colours=colours)


def normalised(error: FloatArray, covariance: FloatArray) -> float:
    return float(np.mean([e @ np.linalg.solve(c, e) / 2 for e, c in zip(error, covariance, strict=True)]))


@pytest.mark.parametrize("half_pixel", [(0.0, 0.0), (0.5, 0.5), (0.5, 0.0), (0.3, 0.2)])
@pytest.mark.parametrize("side", [8.0, 13.0, 30.0, 60.0])
def test_axis_parallel_whole_pixel_boards_are_found_once(side: float, half_pixel: tuple[float, float]) -> None:
    centre = np.array([320.0, 240.0]) + half_pixel
    picture, corners = draw_board(pose(side, centre), ("black", "white"), 50 / 30, "white", 0.0)
    result = found(picture, board(("black", "white")))
    error = result.points_px - corners
    assert np.abs(error).max() < 0.55
    assert np.sqrt(np.einsum("nii->n", result.covariance_px2) / 2) == pytest.approx(1 / np.sqrt(12), rel=0.1)


@pytest.mark.parametrize(("roll_deg", "lean", "k1"), [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (4.0, 0.0, 0.0),
                                                      (30.0, 0.3, 0.0), (3.0, 0.1, -0.25)])  # fmt: skip
def test_every_pose_is_found_and_errs_as_it_says(roll_deg: float, lean: float, k1: float) -> None:
    rng = np.random.default_rng(12)
    errors, normal = [], []
    for number in range(8):
        colours = [("red", "white"), ("red", "black"), ("black", "white")][number % 3]
        side = float(np.exp(rng.uniform(np.log(9), np.log(40))))
        matrix = pose(side, np.array([320.0, 240.0]) + rng.uniform(-9, 9, 2), rng.uniform(-1, 1) * roll_deg, lean)
        border, back = float(rng.choice([0.0, 1.0])), str(rng.choice(["black", "white"]))
        picture, corners = draw_board(matrix, colours, border, back, k1)
        result = found(picture, board(colours))
        error = result.points_px - corners[result.point_ids]
        errors.append(float(np.sqrt((error**2).mean())))
        normal.append(normalised(error, result.covariance_px2))
    assert max(errors) < 0.5
    assert 0.4 < np.mean(normal) < 1.8


def test_slanted_edges_say_far_less_than_a_quarter_pixel() -> None:
    picture, corners = draw_board(pose(40.0, np.array([321.3, 239.1]), 7.0), ("black", "white"), 1.0, "black", 0.0)
    result = found(picture, board(("black", "white")))
    assert np.sqrt(((result.points_px - corners) ** 2).mean()) < 0.04
    assert np.sqrt(np.einsum("nii->n", result.covariance_px2).max() / 2) < 0.06


@pytest.mark.parametrize(("roll_deg", "lean"), [(0.0, 0.0), (0.5, 0.0), (5.0, 0.0), (30.0, 1.0)])
def test_red_squares_are_found_and_err_as_they_say(roll_deg: float, lean: float) -> None:
    rng = np.random.default_rng(31)
    target = Target(TargetKind.SQUARE, size_m=(0.6, 0.6), colours=("red",))
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    unit = np.array([(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)])
    normal = []
    for number in range(12):
        side = float(np.exp(rng.uniform(np.log(20), np.log(250))))
        side = round(side) if number % 3 == 0 else side
        centre = np.array([320.0, 240.0]) + (rng.integers(-20, 20, 2) / 2 if number % 3 == 0 else rng.uniform(-9, 9, 2))
        matrix = pose(side, centre, rng.uniform(-1, 1) * roll_deg, lean)
        x, y = on_plane(u, v, matrix, 0.0)
        picture = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        picture[(np.abs(x) < 0.5) & (np.abs(y) < 0.5)] = CODES["red"]
        result = found(picture, target)
        error = result.points_px - in_picture(unit, matrix, 0.0)
        assert np.abs(error).max() < 1.2
        normal.append(normalised(error, result.covariance_px2))
    assert 0.3 < np.mean(normal) < 2.5


def test_the_variance_of_a_cut_edge_against_a_count() -> None:
    """Straight lines, each pixel's cut taken, the mean of the cuts' errors over many offsets."""
    rng = np.random.default_rng(2)
    for slope, pixels in ((0.0, 30), (0.012, 30), (0.1, 30), (0.5, 40), (1.0, 20)):
        lengths = pixels * rng.uniform(0.9, 1.1, 4000)
        x = np.arange(40)
        offset = rng.uniform(0, 1, (4000, 1))
        place = slope * (x - 15) + offset
        seen = x < lengths[:, None]
        means = ((np.floor(place) + 0.5 - place) * seen).sum(axis=1) / seen.sum(axis=1)
        angle = np.arctan(slope)
        said = float(edge_variance(np.array(angle), np.array(pixels / np.cos(angle))))
        assert said == pytest.approx(means.var() * np.cos(angle) ** 2, rel=0.35), slope


def test_what_is_smoothed_is_spared() -> None:
    assert unsmoothed_share(0.0, 0.0) == 1.0
    assert unsmoothed_share(0.5, 0.0) < 0.12
    assert unsmoothed_share(0.5, 0.3**2) < 0.002
    assert unsmoothed_share(0.8, 1.0) < 1e-9
