"""The figures to reach on the sample data: real photographs, and renders of another renderer with exact truth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from app.documents import PictureSet, read_picture_set
from app.jobs.cpu import Cpu
from app.picture_sets import SetLevel, calibrate_set
from calibration.compare import overlay
from calibration.lens import Lens
from calibration.tables import LevelStatus
from calibration.types import FloatArray
from engine_adapters.folder import FolderPictures

CORNERS = (9, 6)


async def calibrated(folder: Path) -> tuple[PictureSet, SetLevel]:
    """The one level of a picture set."""
    described = read_picture_set(folder)
    cpu = Cpu()
    try:
        (level,) = await calibrate_set(described, FolderPictures(folder), cpu)
    finally:
        cpu.close()
    return described, level


def by_opencv(paths: list[Path]) -> tuple[FloatArray, FloatArray]:
    """(f, k1, k2, cx, cy) and their sigmas by OpenCV's own detector and least squares, with the same model."""
    grid = np.zeros((CORNERS[0] * CORNERS[1], 3), np.float32)
    grid[:, :2] = np.mgrid[: CORNERS[0], : CORNERS[1]].T.reshape(-1, 2) * 0.03
    points, size = [], (0, 0)
    for path in paths:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCornersSB(grey, CORNERS)
        assert found, path.name
        points.append(corners)
        size = (grey.shape[1], grey.shape[0])
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_ASPECT_RATIO
    _, matrix, distortion, _, _, sigmas, _, _ = cv2.calibrateCameraExtended(
        [grid] * len(points), points, size, np.eye(3), np.zeros(5), flags=flags
    )
    k, s = distortion.ravel(), sigmas.ravel()
    # The order of the sigmas: fx, fy, cx, cy, k1, k2; with one focal length it stands at fy.
    return np.array([matrix[0, 0], k[0], k[1], matrix[0, 2], matrix[1, 2]]), s[[1, 4, 5, 2, 3]]


async def test_real_photographs_reach_the_asked_residual_and_agree_with_opencv(shared_data: Path) -> None:
    folder = shared_data / "photos_chessboard"
    described, level = await calibrated(folder)
    assert level.result.status is not LevelStatus.FAILED, level.result.reason
    assert level.fit is not None
    assert level.fit.rms_px <= 0.57, "RMS per coordinate"

    left_out = {out.picture: out.reason for out in level.result.left_out}
    assert set(left_out) == {"board_01.jpg", "board_15.jpg"}
    assert "cut by the frame" in left_out["board_01.jpg"]
    assert "1281x721" in left_out["board_15.jpg"]
    used = [folder / picture.file for picture in described.pictures if picture.file not in left_out]
    assert len(used) == 9

    theirs, their_sigmas = by_opencv(used)
    lens, sigmas = level.fit.lens, level.fit.sigma
    centre = (np.array(lens.image_size) - 1) / 2 + lens.center_shift_px
    ours = np.array([lens.f_px, lens.k1, lens.k2, *centre])
    away = np.abs(ours - theirs) / np.hypot(sigmas, their_sigmas)
    assert (away[[1, 3, 4]] < 3).all(), f"k1, cx, cy are {away[[1, 3, 4]]} sigma from OpenCV's"


@pytest.mark.parametrize("name", ["chess_Z0F0", "chess_Z1F0", "square_Z0F0"])
async def test_sharp_renders_of_another_renderer_reach_a_third_of_a_pixel(name: str, shared_data: Path) -> None:
    folder = shared_data / "renders" / name
    described, level = await calibrated(folder)
    assert level.result.status is not LevelStatus.FAILED, level.result.reason
    (true,) = json.loads((folder / "truth.json").read_text("utf-8"))["levels"]
    truth = Lens.from_fov(
        described.image_size,
        true["fov_x_deg"],
        true["k1"],
        true["k2"],
        tuple(true["center_shift_px"]),
        described.pixel_aspect,
    )
    found = level.result.lens(described.image_size, described.pixel_aspect)
    assert overlay(truth, found).max_px <= 0.3
