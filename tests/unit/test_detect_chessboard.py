"""Chessboards drawn here (and the sample pictures): found, ordered, measured, or refused with the right reason."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.special import erf

from calibration.detect.prediction import Prediction
from calibration.detect.target import find_target
from calibration.errors import InvalidInput
from calibration.image import Transfer, decode_picture
from calibration.types import Detection, FloatArray, Picture, Refusal, Target, TargetKind

WIDTH, HEIGHT = 640, 480
COLOURS = {"red": (0.02, 0.02, 0.45), "white": (0.7, 0.7, 0.7), "black": (0.01, 0.01, 0.01)}


@dataclass
class Drawn:
    """Linear light so far, (H, W, 3), and the corners of the last board drawn, (N, 2) row by row."""

    light: FloatArray
    corners: FloatArray


def empty(level: float = 0.15) -> Drawn:
    return Drawn(np.full((HEIGHT, WIDTH, 3), level) * np.array([0.5, 1.0, 0.6]), np.zeros((0, 2)))


def homography(
    side: float, centre: tuple[float, float], roll_deg: float, squares: tuple[int, int], lean: float
) -> FloatArray:
    """From squares to pixels: turned by ``roll_deg``, with a perspective ``lean`` (change of scale over the board)."""
    cos, sin = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    turn = np.array([[side * cos, -side * sin, centre[0]], [side * sin, side * cos, centre[1]], [0, 0, 1.0]])
    tilt = np.array([[1, 0, 0], [0, 1, 0], [lean / squares[0], lean / 2 / squares[1], 1]])
    centre_first = np.array([[1, 0, -squares[0] / 2], [0, 1, -squares[1] / 2], [0, 0, 1.0]])
    return np.asarray(turn @ tilt @ centre_first, dtype=np.float64)


def add_board(
    drawn: Drawn,
    squares: tuple[int, int],
    colours: tuple[str, str],
    *,
    side: float,
    centre: tuple[float, float] = (WIDTH / 2, HEIGHT / 2),
    roll_deg: float = 4.0,
    blur: float = 0.8,
    lean: float = 0.15,
    margin: bool = True,
) -> None:
    matrix = homography(side, centre, roll_deg, squares, lean)
    outline = np.array([(c, r, 1.0) for c in (-1, squares[0] + 1) for r in (-1, squares[1] + 1)]) @ matrix.T
    reach = 6 * blur + 2
    left, top = np.clip((outline[:, :2] / outline[:, 2:]).min(axis=0) - reach, 0, None).astype(int)
    right, bottom = np.clip((outline[:, :2] / outline[:, 2:]).max(axis=0) + reach, 0, (WIDTH, HEIGHT)).astype(int)
    part = drawn.light[top:bottom, left:right]
    v, u = np.mgrid[top:bottom, left:right].astype(np.float64)
    plane = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(matrix).T
    sigma = np.sqrt(blur**2 + 1 / 12)
    checks, boxes, sheets = [], [], []
    for axis in (0, 1):
        way = plane[..., axis] / plane[..., 2]
        slope = np.hypot(*np.gradient(way))
        step = [erf((way - line) / (slope * sigma * np.sqrt(2))) for line in range(squares[axis] + 1)]
        checks.append(sum((-1) ** k * (step[k] - step[k + 1]) for k in range(squares[axis])) / 2)
        boxes.append((step[0] - step[-1]) / 2)
        wide = [erf((way - line) / (slope * sigma * np.sqrt(2))) for line in (-0.6, squares[axis] + 0.6)]
        sheets.append((wide[0] - wide[1]) / 2)
    whole = (boxes[0] * boxes[1])[..., None]
    first = (boxes[0] * boxes[1] + checks[0] * checks[1])[..., None] / 2
    if margin:
        sheet = (sheets[0] * sheets[1])[..., None]
        part[...] = part * (1 - sheet) + sheet * np.array(COLOURS["white"])
    ink = first * np.array(COLOURS[colours[0]]) + (whole - first) * np.array(COLOURS[colours[1]])
    part[...] = part * (1 - whole) + ink
    inner = np.array([(c, r, 1.0) for r in range(1, squares[1]) for c in range(1, squares[0])]) @ matrix.T
    drawn.corners = inner[:, :2] / inner[:, 2:]


def finished(drawn: Drawn, noise: float = 2.0, seed: int = 1) -> Picture:
    """BT.709 coded, with noise, 8 bits."""
    light = np.clip(drawn.light, 0, 1)
    coded = 255 * np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    noisy = coded + np.random.default_rng(seed).normal(0, noise, coded.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def board(squares: tuple[int, int], colours: tuple[str, ...] = ("red", "white")) -> Target:
    return Target(TargetKind.CHESSBOARD, squares=squares, square_m=0.05, colours=colours)


def found(picture: Picture, target: Target, prediction: Prediction | None = None) -> Detection:
    result = find_target(picture, target, prediction=prediction)
    assert isinstance(result, Detection), result
    return result


def refused(picture: Picture, target: Target, prediction: Prediction | None = None) -> str:
    result = find_target(picture, target, prediction=prediction)
    assert isinstance(result, Refusal)
    assert "\n" not in result.reason
    return result.reason


def rms(result: Detection, corners: FloatArray) -> float:
    return float(np.sqrt(((result.points_px - corners[result.point_ids]) ** 2).mean()))


@pytest.mark.parametrize("colours", [("red", "white"), ("red", "black"), ("black", "white")])
@pytest.mark.parametrize("margin", [True, False])
def test_each_colouring_to_a_hundredth_of_a_pixel(colours: tuple[str, str], margin: bool) -> None:
    drawn = empty()
    add_board(drawn, (9, 7), colours, side=38, margin=margin)
    result = found(finished(drawn), board((9, 7), colours))
    assert result.point_ids.tolist() == list(range(48))
    assert rms(result, drawn.corners) < 0.01
    assert result.blur_px == pytest.approx(0.8, abs=0.05)
    assert 0.7 < result.quality.fit_chi2 < 1.5
    error = result.points_px - drawn.corners
    nees = np.mean([e @ np.linalg.solve(c, e) / 2 for e, c in zip(error, result.covariance_px2, strict=True)])
    assert 0.6 < nees < 1.6


@pytest.mark.parametrize("roll", [-44.0, -20.0, 0.0, 30.0, 44.0])
@pytest.mark.parametrize("squares", [(8, 8), (10, 7), (6, 9)])
def test_rolled_boards_are_read_upright(roll: float, squares: tuple[int, int]) -> None:
    drawn = empty()
    add_board(drawn, squares, ("red", "black"), side=28, roll_deg=roll)
    assert rms(found(finished(drawn), board(squares, ("red", "black"))), drawn.corners) < 0.02


def test_portrait_board_keeps_its_long_side_along_columns() -> None:
    drawn = empty()
    add_board(drawn, (10, 7), ("black", "white"), side=28, roll_deg=80.0)
    assert rms(found(finished(drawn), board((10, 7), ("black", "white"))), drawn.corners) < 0.02


@pytest.mark.parametrize(("side", "blur"), [(11.0, 0.6), (14.0, 1.0), (55.0, 0.5), (50.0, 6.0)])
def test_small_large_and_blurred_boards(side: float, blur: float) -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=side, blur=blur, lean=0.05)
    result = found(finished(drawn), board((9, 7)))
    assert len(result.point_ids) == 48
    assert rms(result, drawn.corners) < 0.025


def test_noise_low_light_and_uneven_light() -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=36)
    falling = np.linspace(0.25, 1.0, WIDTH)[None, :, None]
    uneven = Drawn(drawn.light * falling, drawn.corners)
    assert rms(found(finished(uneven, noise=5.0), board((9, 7))), drawn.corners) < 0.04
    dim = Drawn(drawn.light * 0.04, drawn.corners)
    assert rms(found(finished(dim, noise=3.0), board((9, 7))), drawn.corners) < 0.06


def test_two_boards_of_different_size_are_told_apart() -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=26, centre=(170, 240))
    large = drawn.corners
    add_board(drawn, (8, 6), ("red", "white"), side=26, centre=(470, 240))
    picture = finished(drawn)
    assert rms(found(picture, board((9, 7))), large) < 0.02
    assert rms(found(picture, board((8, 6))), drawn.corners) < 0.02
    assert "found 8x6 of 6x6" in refused(picture, board((7, 7)))


def test_two_equal_boards_are_ambiguous_unless_one_is_expected() -> None:
    drawn = empty()
    add_board(drawn, (7, 6), ("red", "white"), side=28, centre=(160, 240))
    left = drawn.corners
    add_board(drawn, (7, 6), ("red", "white"), side=28, centre=(480, 240))
    picture = finished(drawn)
    assert "ambiguous" in refused(picture, board((7, 6)))
    assert rms(found(picture, board((7, 6)), Prediction(left + 4.0, 5.0)), left) < 0.02
    assert rms(found(picture, board((7, 6)), Prediction(drawn.corners - 4.0, 5.0)), drawn.corners) < 0.02


def test_a_board_of_another_size_is_not_taken() -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=36)
    picture = finished(drawn)
    for asked in ((8, 7), (9, 6), (8, 6), (10, 7), (9, 8)):
        assert "found 8x6 of" in refused(picture, board(asked))


@pytest.mark.parametrize(("roll", "expected"), [(0.0, False), (3.0, False), (0.0, True)])
@pytest.mark.parametrize("side_out", ["left", "right", "top", "bottom"])
def test_a_board_cut_at_one_side_keeps_its_corners_ids(side_out: str, roll: float, expected: bool) -> None:
    drawn = empty()
    centre = {
        "left": (110.0, HEIGHT / 2),
        "right": (WIDTH - 110.0, HEIGHT / 2),
        "top": (WIDTH / 2, 70.0),
        "bottom": (WIDTH / 2, HEIGHT - 70.0),
    }[side_out]
    add_board(drawn, (9, 7), ("red", "white"), side=40, centre=centre, lean=0.0, roll_deg=roll)
    prediction = Prediction(drawn.corners + 2.0, 3.0) if expected else None
    result = found(finished(drawn), board((9, 7)), prediction)
    assert 24 <= len(result.point_ids) < 48
    assert rms(result, drawn.corners) < 0.02


def test_a_board_cut_at_both_ends_is_refused() -> None:
    drawn = empty()
    add_board(drawn, (12, 5), ("red", "white"), side=66, lean=0.0, roll_deg=0.0)
    reason = refused(finished(drawn), board((12, 5)))
    assert "cut by the frame" in reason
    assert "both ends" in reason


def test_a_larger_board_cut_at_a_corner_is_not_taken_for_a_smaller_one() -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=50, centre=(WIDTH - 130, HEIGHT - 100), lean=0.0, roll_deg=0.0)
    seen = drawn.corners[(drawn.corners < [WIDTH - 1, HEIGHT - 1]).all(axis=1)]
    columns, rows = len(np.unique(seen[:, 0].round())), len(np.unique(seen[:, 1].round()))
    reason = refused(finished(drawn), board((columns + 1, rows + 1)))
    assert "cut by the frame" in reason


def test_a_hidden_corner_is_left_out_and_the_others_keep_their_ids() -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=36)
    u, v = np.rint(drawn.corners[20]).astype(int)
    drawn.light[v - 20 : v + 20, u - 20 : u + 20] = np.array([0.1, 0.3, 0.1])
    result = found(finished(drawn), board((9, 7)))
    assert 20 not in result.point_ids
    assert len(result.point_ids) >= 43
    assert rms(result, drawn.corners) < 0.02


def test_nothing_board_like() -> None:
    assert "no chessboard pattern" in refused(finished(empty()), board((9, 7)))
    rng = np.random.default_rng(4)
    noise = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    refused(noise, board((9, 7)))
    refused(np.zeros((16, 16, 3), dtype=np.uint8), board((9, 7)))
    v, u = np.mgrid[0:300, 0:300]
    for side in (2, 5, 7):
        endless = np.repeat((((u // side + v // side) % 2) * 255).astype(np.uint8)[:, :, None], 3, axis=2)
        refused(endless, board((9, 7)))


def test_hopeless_blur_is_refused() -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=24, blur=11.0)
    refused(finished(drawn), board((9, 7)))


def test_prediction_looks_only_where_it_says() -> None:
    drawn = empty()
    add_board(drawn, (9, 7), ("red", "white"), side=26, centre=(170, 200))
    picture = finished(drawn)
    near = found(picture, board((9, 7)), Prediction(drawn.corners + 3.0, 4.0))
    assert rms(near, drawn.corners) < 0.015
    assert "expected" in refused(picture, board((9, 7)), Prediction(drawn.corners + np.array([280.0, 0.0]), 4.0))
    assert "outside" in refused(picture, board((9, 7)), Prediction(drawn.corners + 5000.0, 4.0))


def test_prediction_settles_how_a_square_board_is_read() -> None:
    drawn = empty()
    add_board(drawn, (7, 7), ("red", "white"), side=30, roll_deg=75.0)
    picture = finished(drawn)
    assert rms(found(picture, board((7, 7)), Prediction(drawn.corners + 3.0, 4.0)), drawn.corners) < 0.015
    upright = found(picture, board((7, 7))).points_px.reshape(6, 6, 2)
    assert (np.diff(upright[..., 0], axis=1) > 0).all()
    assert (np.diff(upright[..., 1], axis=0) > 0).all()


def test_centre_is_the_crossing_of_the_diagonals() -> None:
    for squares in ((9, 7), (8, 7), (8, 8)):
        drawn = empty()
        add_board(drawn, squares, ("red", "white"), side=36)
        matrix = homography(36, (WIDTH / 2, HEIGHT / 2), 4.0, squares, 0.15)
        middle = matrix @ np.array([squares[0] / 2, squares[1] / 2, 1.0])
        result = found(finished(drawn), board(squares))
        assert np.abs(result.centre_px - middle[:2] / middle[2]).max() < 0.02


def test_smallest_board() -> None:
    drawn = empty()
    add_board(drawn, (3, 3), ("black", "white"), side=60)
    assert rms(found(finished(drawn), board((3, 3), ("black", "white"))), drawn.corners) < 0.02


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((100, 100), dtype=np.uint8),
        np.zeros((100, 100, 4), dtype=np.uint8),
        np.zeros((100, 100, 3), dtype=np.float64),
        np.zeros((8, 100, 3), dtype=np.uint8),
        np.zeros((0, 0, 3), dtype=np.uint8),
        None,
    ],
)
def test_what_is_not_a_picture_is_invalid_input(picture: Picture) -> None:
    with pytest.raises(InvalidInput):
        find_target(picture, board((9, 7)))


def test_bad_predictions_are_invalid_input() -> None:
    picture = finished(empty())
    with pytest.raises(InvalidInput):
        find_target(picture, board((9, 7)), prediction=Prediction(np.zeros((5, 2)), 1.0))
    with pytest.raises(InvalidInput):
        Prediction(np.full((4, 2), np.nan), 1.0)
    with pytest.raises(InvalidInput):
        Prediction(np.zeros((4, 2)), 0.0)


def _sets(folder: Path) -> list[tuple[Path, Target, FloatArray]]:
    result = []
    for name in (
        "chess_Z0F0",
        "chess_Z1F0",
        "chess_Z3F1",
        "nodal_B",
        "hard_blur_chess_coc04",
        "hard_lowlight_chess_4ev_gain12",
    ):
        described = json.loads((folder / name / "set.json").read_text())
        truth = json.loads((folder / name / "truth.json").read_text())["pictures"]
        for entry in described["pictures"]:
            target = described["targets"][entry["target"]]
            if target["kind"] == "chessboard":
                corners = next(one["inner_corners"] for one in truth[entry["file"]] if one["target"] == entry["target"])
                asked = Target(
                    TargetKind.CHESSBOARD,
                    tuple(target["squares"]),
                    target["square_m"],
                    None,
                    None,
                    tuple(target["colours"]),
                )
                result.append((folder / name / entry["file"], asked, np.array(corners).reshape(-1, 2)))
    return result


def test_renders_by_another_renderer(shared_data: Path) -> None:
    for path, target, corners in _sets(shared_data / "renders"):
        result = found(decode_picture(path.read_bytes()), target)
        assert len(result.point_ids) == len(corners), path.name
        assert rms(result, corners) < (0.02 if path.name[:2] in ("Z0", "Z1") else 0.04), path.name


def test_real_photographs(shared_data: Path) -> None:
    target = board((10, 7), ("black", "white"))
    for path in sorted((shared_data / "photos_chessboard").glob("*.jpg")):
        result = find_target(decode_picture(path.read_bytes()), target, transfer=Transfer.SRGB)
        if path.stem == "board_01":
            # Both its ends are at the frame: which of the six lines is cut off cannot be told from where it stands.
            assert isinstance(result, Refusal)
            assert "cut by the frame" in result.reason
            assert "both ends" in result.reason
        else:
            assert isinstance(result, Detection), (path.name, result)
            assert len(result.point_ids) == 54
