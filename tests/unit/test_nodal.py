"""The nodal point: told at two distances, refused at one, planned for in a job; the parallax an operator would see."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calibration.lens import Lens
from calibration.solve.joint import JointMethod
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.nodal import parallax, two_distances
from calibration.solve.outcome import level_result
from calibration.solve.problem import View
from calibration.solve.search import LevelTask, Observation, Source
from calibration.synthetic import observe
from calibration.tables import LevelStatus
from calibration.types import CameraPose, Detection, Role, Target, TargetKind, TargetPose
from engine_adapters.sim.optics import Optics
from engine_adapters.sim.optics import View as SimulatedView

SIZE = (1920, 1080)
PIVOT_M = (0.0, 0.0, 1.6)


def lens_of(fov_deg: float, nodal_mm: float) -> Lens:
    straight = Lens.from_fov(SIZE, fov_deg, center_shift_px=(4.0, -3.0), nodal_offset_mm=nodal_mm)
    return straight.with_hw(straight.f_px, -0.05, 0.01)


def pictures(lens: Lens, distances_m: tuple[float, ...], seed: int, sigma_px: float = 0.05) -> list[View]:
    """A board at each distance, seen under pans over most of the field; each fills the same share of the picture."""
    rng = np.random.default_rng(seed)
    views = []
    for distance in distances_m:
        square_m = 0.35 * SIZE[1] / lens.f_px * distance / 7
        board = Target(
            TargetKind.CHESSBOARD, squares=(9, 7), square_m=square_m, pose=TargetPose((0.0, distance, PIVOT_M[2]))
        )
        for pan in np.linspace(-0.3, 0.3, 7) * lens.fov_x_deg:
            pose = CameraPose(PIVOT_M, float(pan), 0.05 * lens.fov_x_deg)
            seen = observe(lens, pose, board, rng, sigma_px)
            if isinstance(seen, Detection):
                views.append(View(f"{distance} m, {pan:.2f}", f"board at {distance}", board, seen, pose))
    return views


@pytest.mark.parametrize("fov_deg", [65.0, 18.0, 4.6])
def test_two_distances_tell_the_nodal_offset_from_wide_to_tele(fov_deg: float) -> None:
    lens = lens_of(fov_deg, 85.0)
    fit = solve_level(pictures(lens, (2.0, 4.0), 1), SIZE)
    assert fit.nodal_told
    assert fit.sigma_nodal_mm is not None
    assert fit.sigma_nodal_mm < 0.1
    assert abs(fit.lens.nodal_offset_mm - 85.0) < min(0.3, 4 * fit.sigma_nodal_mm)
    assert abs(fit.lens.f_px / lens.f_px - 1) < 4 * fit.sigma[0] / lens.f_px


def test_an_offset_of_none_is_measured_too_where_it_can_be() -> None:
    fit = solve_level(pictures(lens_of(36.0, 0.0), (2.0, 4.0), 2), SIZE)
    assert fit.nodal_told, "0 is a measurement here, not a guess that nothing contradicts"
    assert fit.parallax is not None
    assert fit.parallax.sigma_px < 0.1


@pytest.mark.parametrize("fov_deg", [18.0, 4.6])
def test_one_distance_is_refused_with_the_reason(fov_deg: float) -> None:
    views = pictures(lens_of(fov_deg, 20.0), (4.0,), 3)
    assert not two_distances(views)
    fit = solve_level(views, SIZE)
    result = level_result(fit, 0.0, 0.5, held_out=held_out_residuals(fit, views))
    assert result.nodal_offset_mm is None
    assert "look alike at one distance" in result.reasons["nodal_offset_mm"]
    assert result.parallax is None


def test_the_parallax_is_what_a_pan_past_two_things_shows() -> None:
    """Worked out by panning the simulated camera, once with the pupil where it is and once where it is said to be."""
    lens = replace(lens_of(40.0, 30.0), k1=0.0, k2=0.0)
    views = pictures(lens, (2.0, 4.0), 4)
    told = parallax(lens, 0.0, 1.0, views)
    optics = Optics(SIZE, lens.f_px)
    near, far = np.array([[0.0, told.near_m, 1.6]]), np.array([[0.0, told.far_m, 1.6]])

    def apart(pan_deg: float, nodal_mm: float) -> float:
        camera = SimulatedView(optics, PIVOT_M, pan_deg, nodal_offset_mm=nodal_mm)
        # The angle, not the pixel: near the picture's edge a pixel is a smaller angle.
        directions = [camera.to_camera(thing)[0] for thing in (near, far)]
        return lens.f_px * float(np.subtract(*(math.atan2(d[0], d[2]) for d in directions)))

    half = told.pan_deg / 2
    moved = [apart(half, mm) - apart(-half, mm) for mm in (30.0, 0.0)]
    assert told.as_given_px == pytest.approx(abs(moved[0] - moved[1]), rel=0.03)
    assert told.sigma_px == pytest.approx(told.as_given_px / 30.0)


def test_a_job_looks_at_a_second_target_for_the_nodal_offset() -> None:
    truth = lens_of(40.0, 60.0)
    targets = {
        "far": Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((-0.6, 5.0, 1.6))),
        "near": Target(TargetKind.CHESSBOARD, squares=(10, 8), square_m=0.04, pose=TargetPose((0.75, 2.2, 1.6))),
    }
    task = LevelTask(0.5, 0.25, SIZE, targets, PIVOT_M)
    method, rng, looked = JointMethod(task), np.random.default_rng(5), []
    waiting = []
    while not method.done:
        capture = method.ask()
        if capture is not None:
            waiting.append(capture)
            continue
        if method.done:
            break
        told = waiting.pop(0)
        looked.append((told.target, told.role, told.source))
        pose = task.pose(told.pan_deg, told.tilt_deg)
        seen_through = truth if told.source is Source.REAL else told.lens
        assert seen_through is not None
        result = observe(seen_through, pose, targets[told.target], rng, 0.01)
        method.tell(Observation(told.step, result, pose, f"picture {told.step}"))
    result = method.result()
    assert result.status is LevelStatus.OK, result.reason
    assert result.nodal_offset_mm == pytest.approx(60.0, abs=0.3)
    assert {target for target, role, _ in looked if role is Role.NODAL}
    assert len({target for target, _, source in looked if source is Source.REAL}) == 2
    assert len(looked) <= 10
