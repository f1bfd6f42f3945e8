"""The centre shift of the study's chapter 4.1: read from a light or a board, beside the axis, and between zooms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.errors import InvalidInput, NotEnoughData
from calibration.lens import Lens
from calibration.solve.center_shift import (
    CenterShift,
    center_shift_from_centre,
    center_shift_from_points,
    interpolate_center_shift,
    log_focal_weight,
)
from calibration.synthetic import observe
from calibration.types import CameraPose, Detection, FloatArray, Quality, Target, TargetKind, TargetPose

SIZE = (1920, 1080)
LENS = Lens.from_fov(SIZE, 60.0, k1=-0.15, k2=0.02, center_shift_px=(3.2, -2.1))
BOARD = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((-0.6, 5.0, 1.6)))
AIMED = CameraPose((0.0, 0.0, 1.6), pan_deg=math.degrees(math.atan2(-0.6, 5.0)))


def light_at(pixel: tuple[float, float], sigma_px: float = 0.05) -> Detection:
    points = np.array([pixel])
    return Detection(
        TargetKind.LIGHT, points, np.array([0]), np.eye(2)[None] * sigma_px**2, points[0], 1.0, Quality(1.0)
    )


def board_rays(pose: CameraPose = AIMED, target: Target = BOARD) -> FloatArray:
    assert target.pose is not None
    return rays_of(world_to_camera(pose, 0.0, target_points_world(target.pose, target.points_m())))


def test_a_light_on_the_axis_shows_the_shift_itself() -> None:
    found = center_shift_from_centre(light_at((962.7, 537.4)), SIZE)
    assert found.shift_px == pytest.approx((3.2, -2.1), abs=1e-9)
    np.testing.assert_allclose(found.covariance_px2, np.eye(2) * 0.0025)


def test_the_picture_centre_is_at_half_of_size_minus_one() -> None:
    assert center_shift_from_centre(light_at((959.5, 539.5)), SIZE).shift_px == (0.0, 0.0)


def test_a_light_beside_the_axis_needs_its_ray_and_the_focal_length() -> None:
    ray = (0.01, -0.02)
    seen = Lens(SIZE, 1500.0, center_shift_px=(3.0, -2.0), pixel_aspect=1.02).project(np.array([ray]))[0]
    light = light_at((float(seen[0]), float(seen[1])))
    assert center_shift_from_centre(light, SIZE, ray, 1500.0, 1.02).shift_px == pytest.approx((3.0, -2.0), abs=1e-9)
    with pytest.raises(InvalidInput, match="focal length"):
        center_shift_from_centre(light, SIZE, ray)


def test_a_centre_that_is_no_number_is_refused() -> None:
    with pytest.raises(InvalidInput, match="finite"):
        center_shift_from_centre(light_at((math.nan, 5.0)), SIZE)


def test_a_board_seen_askew_is_read_through_its_rays_not_its_mean() -> None:
    seen = observe(LENS, AIMED, BOARD, np.random.default_rng(0), 0.0)
    assert isinstance(seen, Detection)
    f_px, found = center_shift_from_points(seen, board_rays(), SIZE)
    by_mean = center_shift_from_centre(seen, SIZE)
    assert math.dist(by_mean.shift_px, LENS.center_shift_px) > 0.2
    assert math.dist(found.shift_px, LENS.center_shift_px) < 0.02
    assert f_px == pytest.approx(LENS.f_px, rel=0.005)


def test_the_board_s_covariance_is_that_of_many_tries() -> None:
    rng = np.random.default_rng(1)
    straight = Lens.from_fov(SIZE, 60.0, center_shift_px=(3.2, -2.1))
    shifts, told = [], np.zeros((2, 2))
    for _ in range(400):
        seen = observe(straight, AIMED, BOARD, rng, 0.1)
        assert isinstance(seen, Detection)
        _, found = center_shift_from_points(seen, board_rays(), SIZE)
        shifts.append(found.shift_px)
        told = found.covariance_px2
    np.testing.assert_allclose(np.mean(shifts, axis=0), (3.2, -2.1), atol=0.003)
    np.testing.assert_allclose(np.var(shifts, axis=0), np.diag(told), rtol=0.25)


def test_a_spot_a_mirrored_board_and_a_wrong_shape_are_refused() -> None:
    with pytest.raises(NotEnoughData, match="single spot"):
        center_shift_from_points(light_at((960.0, 540.0)), np.zeros((1, 2)), SIZE)
    seen = observe(LENS, AIMED, BOARD, np.random.default_rng(0), 0.0)
    assert isinstance(seen, Detection)
    with pytest.raises(NotEnoughData, match="mirrored"):
        center_shift_from_points(seen, -board_rays(), SIZE)
    with pytest.raises(InvalidInput, match="shape"):
        center_shift_from_points(seen, board_rays()[:5], SIZE)


def test_between_the_ends_of_the_zoom_the_shift_is_linear() -> None:
    wide = CenterShift((2.0, -1.0), np.eye(2) * 0.01)
    tele = CenterShift((6.0, 3.0), np.eye(2) * 0.04)
    middle = interpolate_center_shift(wide, tele, log_focal_weight(4000.0, 1000.0, 16000.0))
    assert middle.shift_px == pytest.approx((4.0, 1.0))
    np.testing.assert_allclose(middle.covariance_px2, np.eye(2) * 0.0125)
    assert interpolate_center_shift(wide, tele, 0.0).shift_px == wide.shift_px
    assert interpolate_center_shift(wide, tele, 1.0).shift_px == tele.shift_px


@pytest.mark.parametrize("weight", [-0.01, 1.01, math.nan])
def test_nothing_is_extrapolated(weight: float) -> None:
    end = CenterShift((0.0, 0.0), np.eye(2))
    with pytest.raises(InvalidInput, match="between 0"):
        interpolate_center_shift(end, end, weight)


@pytest.mark.parametrize("focals", [(0.0, 1.0, 2.0), (1.0, -1.0, 2.0), (1.0, 2.0, math.inf), (1.0, 2.0, 2.0)])
def test_impossible_focal_lengths_are_refused(focals: tuple[float, float, float]) -> None:
    with pytest.raises(InvalidInput, match="f_"):
        log_focal_weight(*focals)
