"""World, camera and target frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.camera import (
    camera_angles_deg,
    camera_rotation,
    inside_picture,
    project_points,
    project_target,
    pupil_m,
)
from calibration.errors import GeometryError
from calibration.lens import Lens
from calibration.types import CameraPose, Target, TargetKind, TargetPose

LENS = Lens((1920, 1080), 1000.0)


@pytest.mark.parametrize(
    ("pose", "moves"),
    [
        (CameraPose(pan_deg=5), (-1, 0)),  # pan right: the world moves left
        (CameraPose(tilt_deg=5), (0, 1)),  # tilt up: the world moves down
    ],
)
def test_signs_of_pan_and_tilt(pose: CameraPose, moves: tuple[int, int]) -> None:
    u, v = project_points(LENS, pose, np.array([[0.0, 5.0, 0.0]]))[0]
    assert np.sign(round(u - 959.5, 6)) == moves[0]
    assert np.sign(round(v - 539.5, 6)) == moves[1]


def test_positive_roll_is_clockwise_seen_from_behind() -> None:
    # The camera turned clockwise sees the world turned anticlockwise: what was above is now on the left.
    u, _ = project_points(LENS, CameraPose(roll_deg=10), np.array([[0.0, 5.0, 1.0]]))[0]
    assert u < 959.5


@given(pan=st.floats(-170, 170), tilt=st.floats(-80, 80), roll=st.floats(-170, 170))
def test_angles_invert_the_rotation(pan: float, tilt: float, roll: float) -> None:
    assert camera_angles_deg(camera_rotation(pan, tilt, roll)) == pytest.approx((pan, tilt, roll), abs=1e-9)


def test_nodal_offset_moves_the_pupil_along_the_optical_axis() -> None:
    np.testing.assert_allclose(pupil_m(CameraPose(pan_deg=90), 100.0), [0.1, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pupil_m(CameraPose((0, 0, 1.6), tilt_deg=90), 100.0), [0, 0, 1.7], atol=1e-12)


def test_a_target_behind_the_camera_is_an_error() -> None:
    target = Target(TargetKind.SQUARE, size_m=(1, 1), pose=TargetPose((0, -3, 0)))
    with pytest.raises(GeometryError, match="behind the camera"):
        project_target(LENS, CameraPose(), target)
    with pytest.raises(GeometryError, match="no pose"):
        project_target(LENS, CameraPose(), Target(TargetKind.SQUARE, size_m=(1, 1)))


def test_rows_run_downwards_and_columns_to_the_right() -> None:
    target = Target(TargetKind.SQUARE, size_m=(2, 1), pose=TargetPose((0, 10, 0)))
    pixels = project_target(LENS, CameraPose(), target)
    np.testing.assert_allclose(pixels - [959.5, 539.5], [[-100, -50], [100, -50], [-100, 50], [100, 50]], atol=1e-9)
    assert inside_picture(pixels, (1920, 1080))
    assert not inside_picture(pixels + [0, 1000], (1920, 1080))
    assert not inside_picture(pixels * np.nan, (1920, 1080))


@pytest.mark.parametrize("name", ["chess_Z0F0", "chess_Z3F1", "square_Z0F0", "nodal_B"])
def test_independent_renders_agree_with_the_conventions(shared_data: Path, name: str) -> None:
    """Corners told by another renderer (Blender) are where the conventions' camera puts them."""
    folder = shared_data / "renders" / name
    described = json.loads((folder / "set.json").read_text())
    truth = json.loads((folder / "truth.json").read_text())
    level = truth["levels"][0]
    lens = Lens(
        tuple(truth["image_size"]),
        level["f_px"],
        level["k1"],
        level["k2"],
        tuple(level["center_shift_px"]),
        truth["pixel_aspect"],
        level["nodal_offset_mm"],
    )
    compared = 0
    for picture in described["pictures"]:
        board = described["targets"][picture["target"]]
        pose = board["pose"]
        target = Target(
            TargetKind(board["kind"]),
            squares=tuple(board["squares"]) if "squares" in board else None,
            square_m=board.get("square_m"),
            size_m=tuple(board["size_m"]) if "size_m" in board else None,
            pose=TargetPose(tuple(pose["centre_m"]), pose["yaw_deg"], pose["pitch_deg"], pose["roll_deg"]),
        )
        camera = picture["camera_pose"]
        seen = project_target(
            lens,
            CameraPose(tuple(camera["pivot_m"]), camera["pan_deg"], camera["tilt_deg"], camera["roll_deg"]),
            target,
        )
        told = next(t for t in truth["pictures"][picture["file"]] if t["target"] == picture["target"])
        if target.kind is TargetKind.CHESSBOARD:
            expected = np.array(told["inner_corners"])
        else:
            expected = np.array(told["outer_corners_tl_tr_br_bl"])[[0, 1, 3, 2]]
        np.testing.assert_allclose(seen, expected, atol=2e-3)
        compared += 1
    assert compared >= 3
