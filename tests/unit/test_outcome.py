"""From a fit, or from too little for one, to the level's entry in the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.lens import Lens
from calibration.solve.outcome import shift_only_result
from calibration.solve.problem import View
from calibration.synthetic import observe
from calibration.tables import LevelStatus
from calibration.types import CameraPose, Detection, Target, TargetKind, TargetPose

LENS = Lens.from_fov((1920, 1080), 9.0, center_shift_px=(-2.6, 4.8))
LIGHT = Target(TargetKind.LIGHT, diameter_m=0.01, pose=TargetPose((0.0, 5.0, 1.6)))


def seen(pose: CameraPose, sigma_px: float, seed: int) -> View:
    found = observe(LENS, pose, LIGHT, np.random.default_rng(seed), sigma_px)
    assert isinstance(found, Detection)
    return View(f"light {seed}", "light", LIGHT, found, pose)


def test_a_light_on_the_axis_tells_the_centre_shift_and_nothing_else() -> None:
    ahead = CameraPose((0.0, 0.0, 1.6))
    result = shift_only_result([seen(ahead, 0.01, 1), seen(ahead, 1.0, 2)], LENS.image_size, 1.0, 0.25)
    assert result is not None
    assert result.status is LevelStatus.DEGRADED
    assert result.center_shift_px == pytest.approx((-2.6, 4.8), abs=0.05)  # the sharp picture counts, the other hardly
    assert result.sigma.center_shift_px == pytest.approx((0.01, 0.01), rel=0.01)
    assert result.fov_x_deg is None
    assert "beside it" in result.reasons["fov_x_deg"]


def test_a_light_beside_the_axis_tells_nothing() -> None:
    turned = CameraPose((0.0, 0.0, 1.6), pan_deg=0.2)
    assert shift_only_result([seen(turned, 0.01, 1)], LENS.image_size, 1.0, 0.25) is None
    unposed = replace(seen(CameraPose((0.0, 0.0, 1.6)), 0.01, 1), camera_pose=None)
    assert shift_only_result([unposed], LENS.image_size, 1.0, 0.25) is None
