"""The pictures that a level leaves: before and after, residual arrows, the map of expected error."""

from __future__ import annotations

import numpy as np
import pytest

from app.jobs.heatmap import heat_map, scale_end_px
from app.jobs.level import LevelOutcome, SeenPicture
from app.jobs.pictures import after_picture, before_picture, level_pictures, residual_picture
from calibration.compare import overlay
from calibration.image import decode_picture
from calibration.lens import Lens
from calibration.solve.search import LevelTask
from calibration.synthetic import observe
from calibration.tables import LevelResult
from calibration.types import Detection, Target, TargetKind, TargetPose
from engine_adapters.ports import LensValues
from storage.records import PictureKind

SIZE = (1280, 720)
BOARD = Target(
    TargetKind.CHESSBOARD, squares=(8, 6), square_m=0.2, colours=("red", "white"), pose=TargetPose((0.0, 6.0, 1.5))
)
TASK = LevelTask(0.0, 0.5, SIZE, {"board": BOARD}, (0.0, 0.0, 1.5))
LENS = Lens.from_fov(SIZE, 40.0, -0.1, 0.01, (3.0, -2.0))
ORANGE = (30, 120, 255)  # the engine's, BGR


def seen(lens: Lens = LENS, pan_deg: float = 4.0) -> SeenPicture:
    found = observe(lens, TASK.pose(pan_deg, 1.0), BOARD, np.random.default_rng(3), 0.01)
    assert isinstance(found, Detection)
    return SeenPicture(np.full((SIZE[1], SIZE[0], 3), 120, dtype=np.uint8), "board", found, pan_deg, 1.0)


def orange_near(picture: np.ndarray, point: np.ndarray, radius: int = 3) -> bool:
    u, v = round(float(point[0])), round(float(point[1]))
    patch = picture[max(v - radius, 0) : v + radius + 1, max(u - radius, 0) : u + radius + 1].astype(int)
    return bool((np.abs(patch - ORANGE).max(axis=-1) < 20).any())


def test_before_shows_the_target_through_the_values_as_found() -> None:
    real = seen()
    found = LensValues(50.0, 0.05, 0.0, (10.0, 5.0))
    picture = before_picture(real, TASK, found)
    assert picture is not None
    drawn = seen(Lens.from_fov(SIZE, 50.0, 0.05, 0.0, (10.0, 5.0))).detection.points_px
    camera = real.detection.points_px
    outside = camera[((camera < drawn.min(axis=0) - 12) | (camera > drawn.max(axis=0) + 12)).any(axis=1)]
    assert len(outside) > 10
    assert all(orange_near(picture, point) for point in drawn)
    assert not any(orange_near(picture, point) for point in outside)


def test_after_shows_the_engines_own_corners() -> None:
    real, virtual = seen(), seen(Lens.from_fov(SIZE, 41.0, -0.1))
    picture = after_picture(real, virtual, TASK)
    # The rings lie over the grid, so its corners show beside them.
    assert all(orange_near(picture, point, 6) for point in virtual.detection.points_px)


@pytest.mark.parametrize(
    "found", [LensValues(0.0), LensValues(200.0), LensValues(50.0, float("nan"))], ids=["zero", "beyond", "nan"]
)
def test_values_that_make_no_lens_leave_no_picture_of_before(found: LensValues) -> None:
    assert before_picture(seen(), TASK, found) is None


@pytest.mark.parametrize("found", [LensValues(0.02), LensValues(50.0, -200.0), LensValues(50.0, 1e6)])
def test_values_that_put_the_target_far_away_still_make_a_picture(found: LensValues) -> None:
    picture = before_picture(seen(), TASK, found)
    assert picture is not None
    assert picture.shape[1] == SIZE[0]


def test_kinds_of_a_measured_level() -> None:
    real, virtual = seen(), seen()
    reasons = dict.fromkeys(
        ("nodal_offset_mm", "residual_px", "held_out_px", "predicted_overlay_px", "engine_overlay_px"), "not tried"
    )
    result = LevelResult.from_lens(0.0, 0.5, LENS, reasons=reasons)
    outcome = LevelOutcome(result, real, virtual, (real,))
    files = level_pictures(outcome, TASK, 1.0, as_found=LensValues(50.0), expected=overlay(LENS, LENS))
    assert set(files) == set(PictureKind)
    for kind in (PictureKind.REAL, PictureKind.VIRTUAL):
        assert decode_picture(files[kind]).shape == (SIZE[1], SIZE[0], 3)
    without = level_pictures(outcome, TASK, 1.0)
    assert set(PictureKind) - set(without) == {PictureKind.BEFORE, PictureKind.UNCERTAINTY}


def test_a_level_without_pictures_leaves_none() -> None:
    outcome = LevelOutcome(LevelResult.failed(0.0, 0.5, "dark"), None, None, ())
    assert level_pictures(outcome, TASK, 1.0, as_found=LensValues(50.0)) == {}


def test_residual_arrows_point_from_the_picture_to_the_model() -> None:
    points = np.array([[400.0, 300.0], [800.0, 300.0]])
    picture = residual_picture([(points, np.array([[0.01, 0.0], [-0.01, 0.0]]))], SIZE)
    dark = (picture[290:310].min(axis=(0, 2)) < 100).nonzero()[0]
    assert dark.min() >= 398
    assert dark.max() <= 802
    assert 410 < dark[dark < 600].max() < 430


def test_heat_map_scales_to_the_largest_and_marks_what_cannot_be_compared() -> None:
    values = np.linspace(0, 0.0042, 36 * 64).reshape(36, 64)
    plain = heat_map(values, SIZE)
    values[0, :8] = np.nan
    values[0, 56:] = np.inf
    holes = heat_map(values, SIZE)
    changed = np.abs(plain.astype(int) - holes).max(axis=-1) > 10
    rows, columns = changed[12:552, 12:972].nonzero()
    assert rows.max() < 30  # the first row of samples reaches half way to the second
    assert columns.min() < 5
    assert columns.max() > 950


def test_heat_maps_of_one_scale_have_the_same_colours() -> None:
    weak = heat_map(np.full((36, 64), 0.001), SIZE, 0.003)
    strong = heat_map(np.full((36, 64), 0.002), SIZE, 0.003)
    assert np.abs(weak[300, 500].astype(int) - strong[300, 500]).max() > 20
    same = heat_map(np.full((36, 64), 0.001), SIZE)
    assert np.abs(weak[300, 500].astype(int) - same[300, 500]).max() > 20


@pytest.mark.parametrize(
    ("largest", "end"), [(0.0, 1e-4), (0.0042, 0.005), (0.0027, 0.003), (0.3, 0.3), (1.01, 1.5), (float("inf"), 1e-4)]
)
def test_scale_ends_at_a_round_value_not_below_the_largest(largest: float, end: float) -> None:
    assert scale_end_px(largest) == pytest.approx(end)
