"""The traps of pictures: blur that shifts a detector, half a pixel of centre, and sampling in coarse steps.

The traps of the R3 socket (1, 3, 4) stand in ``integration/test_r3_traps.py``, those of a running job (2, 6) in
``integration/test_fresh_pictures.py``, that of the event sockets (5) in ``integration/test_api_websocket.py``.
"""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.pictures import draw_board, random_view
from calibration.detect.target import find_target
from calibration.lens import Lens
from calibration.types import Detection, FloatArray, Picture, Target, TargetKind

SQUARES = (9, 7)
BOARD = Target(TargetKind.CHESSBOARD, SQUARES, 0.1, colours=("black", "white"))


def corners_in(picture: Picture) -> FloatArray:
    found = find_target(picture, BOARD)
    assert isinstance(found, Detection), found
    assert len(found.point_ids) == (SQUARES[0] - 1) * (SQUARES[1] - 1)
    return found.points_px


@pytest.mark.parametrize("blur_px", [2.0, 4.0])
def test_trap_7_a_blurred_picture_has_its_corners_where_the_sharp_one_has(blur_px: float) -> None:
    """A bias of the blurred camera picture against the sharp render would go into the centre shift as a whole."""
    rng = np.random.default_rng(20261122)
    view = random_view(SQUARES, rng, size=(960, 540))
    errors = []
    for blur in (0.6, blur_px):
        drawn = draw_board(SQUARES, view, blur, 1.0, rng)
        errors.append((corners_in(drawn.picture) - drawn.corners).mean(axis=0))
    assert np.abs(errors[1] - errors[0]).max() < 0.01


@pytest.mark.parametrize("side_px", [40, 41])
def test_trap_8_the_middle_of_a_symmetric_picture_is_no_centre_shift(side_px: int) -> None:
    """A picture that equals itself turned by half a turn has its middle at ((W-1)/2, (H-1)/2), whoever drew it."""
    squares = np.indices(SQUARES[::-1]).sum(axis=0) % 2
    sharp = np.pad(np.kron(squares, np.ones((side_px, side_px))) * 180 + 38, 50, constant_values=218)
    picture = np.repeat(np.rint(gaussian_filter(sharp, 0.8)).astype(np.uint8)[:, :, None], 3, axis=2)
    assert np.array_equal(picture, picture[::-1, ::-1])
    height, width = picture.shape[:2]
    middle_px = ((width - 1) / 2, (height - 1) / 2)
    assert corners_in(picture).mean(axis=0) == pytest.approx(middle_px, abs=0.005)
    straight_ahead_px = Lens.from_fov((width, height), 40.0).project(np.zeros((1, 2)))[0]
    assert straight_ahead_px == pytest.approx(middle_px, abs=1e-9)


def test_trap_9_no_renderer_samples_a_picture_through_a_coarse_map(repository: Path) -> None:
    """OpenCV's warps step by 1/32 px; what is to be exact to 0.01 px is computed at each pixel's ray."""
    renderers = [
        *(repository / "engine_adapters" / "sim").rglob("*.py"),
        repository / "calibration" / "synthetic.py",
        repository / "benchmarks" / "pictures.py",
    ]
    coarse = {"remap", "warpPerspective", "warpAffine", "getRectSubPix", "undistort"}
    assert len(renderers) > 10
    for path in renderers:
        used = {node.attr for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Attribute)}
        assert not used & coarse, path.name
