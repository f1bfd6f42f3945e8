"""The joint fit: known, rough and unknown poses; true uncertainties; wrong points and wrong pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.camera import camera_rotation, rays_of
from calibration.compare import overlay, predicted_overlay
from calibration.errors import FoldedLens, InvalidInput, NotEnoughData
from calibration.lens import Lens
from calibration.solve.iteration import LevelFit
from calibration.solve.level import held_out_residuals, residual_of, solve_level
from calibration.solve.mistakes import Priors
from calibration.solve.problem import Problem, State, Step, View
from calibration.solve.start import start
from calibration.synthetic import observe
from calibration.types import CameraPose, Detection, Quality, Target, TargetKind, TargetPose

SIZE = (1920, 1080)
WIDE = Lens.from_fov(SIZE, 58.0, -0.15, 0.04, (3.4, -2.2))
BOARD = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((0.0, 5.0, 1.6)))
ANGLES = [(0, 0), (-20, 0), (20, 0), (-18, 9), (18, -9), (-18, -9), (18, 9), (0, 10), (0, -10)]


def posed_views(
    lens: Lens, rng: np.random.Generator, *, sigma_px: float = 0.02, camera: CameraPose | None = None
) -> list[View]:
    base = camera or CameraPose((0.0, 0.0, 1.6))
    views = []
    for pan, tilt in ANGLES:
        pose = replace(base, pan_deg=pan, tilt_deg=tilt)
        seen = observe(lens, replace(pose, sigma_deg=0, sigma_m=0), BOARD, rng, sigma_px)
        assert isinstance(seen, Detection)
        views.append(View(f"{pan},{tilt}", "board", BOARD, seen, pose))
    return views


def hand_held_views(lens: Lens, rng: np.random.Generator, count: int, sigma_px: float = 0.05) -> list[View]:
    free = Target(TargetKind.CHESSBOARD, squares=(10, 7), square_m=0.03)
    views: list[View] = []
    plane = free.points_m()
    while len(views) < count:
        R = camera_rotation(*rng.uniform(-35, 35, 3))
        R_ct = R @ camera_rotation(0, 0, 0).T
        t = np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.25, 0.45)])
        pixels = lens.project(rays_of(np.column_stack([plane, np.zeros(len(plane))]) @ R_ct.T + t))
        if not ((pixels > 5) & (pixels < np.array(lens.image_size) - 6)).all():
            continue
        noisy = pixels + rng.normal(0, sigma_px, pixels.shape)
        covariance = np.tile(np.eye(2) * sigma_px**2, (len(noisy), 1, 1))
        ids = np.arange(len(noisy))
        found = Detection(TargetKind.CHESSBOARD, noisy, ids, covariance, noisy.mean(0), 0.5, Quality(1.0))
        views.append(View(f"hand {len(views)}", "board", free, found))
    return views


def assert_as_predicted(fit: LevelFit) -> None:
    """The overlay error is within 4 sigma of what the fit itself expects."""
    assert overlay(WIDE, fit.lens).max_px < 4 * predicted_overlay(fit.lens, fit.covariance).max_px < 0.4


def test_posed_pictures_give_the_lens_within_its_own_prediction() -> None:
    fit = solve_level(posed_views(WIDE, np.random.default_rng(1)), SIZE)
    assert_as_predicted(fit)
    assert overlay(WIDE, fit.lens).max_px < 0.1
    assert fit.rms_px == pytest.approx(0.02, rel=0.15)
    assert not fit.outliers
    assert not fit.untold


def test_uncertainty_is_true_over_many_fits() -> None:
    """Normalised estimation error squared of the five lens parameters: chi2 with 5 degrees of freedom."""
    rng = np.random.default_rng(2)
    normalised = []
    for _ in range(40):
        fit = solve_level(posed_views(WIDE, rng), SIZE, guess=WIDE)
        error = np.array([fit.lens.f_px, fit.lens.k1, fit.lens.k2, *fit.lens.center_shift_px])
        error -= [WIDE.f_px, WIDE.k1, WIDE.k2, *WIDE.center_shift_px]
        normalised.append(error @ np.linalg.solve(fit.covariance, error))
    # The mean of 40 chi2(5) lies in 5 +- 1.5 with 99.7 %.
    assert 3.5 < np.mean(normalised) < 6.5


def test_rough_pan_angles_are_parameters_with_priors() -> None:
    """Encoders 0.05 degrees off move the board by two pixels: with priors that costs little."""
    rng = np.random.default_rng(3)
    rough = []
    for view in posed_views(WIDE, rng):
        assert view.camera_pose is not None
        off = rng.normal(0, 0.05, 3)
        pose = replace(
            view.camera_pose,
            pan_deg=view.camera_pose.pan_deg + off[0],
            tilt_deg=view.camera_pose.tilt_deg + off[1],
            roll_deg=off[2],
            sigma_deg=0.05,
        )
        rough.append(replace(view, camera_pose=pose))
    fit = solve_level(rough, SIZE)
    exact = [replace(v, camera_pose=replace(v.camera_pose, sigma_deg=0.0)) for v in rough if v.camera_pose]
    believed = solve_level(exact, SIZE)
    assert fit.rms_px < 0.03
    assert believed.rms_px > 0.3
    error = overlay(WIDE, fit.lens)
    assert error.rms_px < 3 * predicted_overlay(fit.lens, fit.covariance).rms_px


def test_a_target_surveyed_a_little_wrong_is_found_out() -> None:
    rng = np.random.default_rng(4)
    wrong = replace(BOARD, pose=TargetPose((0.004, 5.003, 1.598), yaw_deg=0.4, sigma_m=0.005, sigma_deg=0.5))
    views = [replace(v, target=wrong) for v in posed_views(WIDE, rng)]
    fit = solve_level(views, SIZE)
    assert fit.rms_px < 0.03
    assert overlay(WIDE, fit.lens).rms_px < 4 * predicted_overlay(fit.lens, fit.covariance).rms_px


def test_a_hand_held_board_needs_no_pose() -> None:
    lens = Lens((1280, 720), 1168.0, -0.2445, -0.02, (33.9, 28.6))
    fit = solve_level(hand_held_views(lens, np.random.default_rng(5), 10), (1280, 720))
    assert fit.rms_px == pytest.approx(0.05, rel=0.15)
    sigma = fit.sigma
    assert abs(fit.lens.f_px - lens.f_px) < 4 * sigma[0]
    assert abs(fit.lens.k1 - lens.k1) < 4 * sigma[1]
    assert abs(fit.lens.center_shift_px[0] - 33.9) < 4 * sigma[3]
    held = held_out_residuals(fit, hand_held_views(lens, np.random.default_rng(5), 10))
    assert len(held) == 10
    assert max(float(np.sqrt(np.mean(r**2))) for r in held.values()) < 0.08


@pytest.mark.parametrize("fov", [75.0, 40.0, 12.0, 5.0])
def test_every_focal_length_converges_from_nothing(fov: float) -> None:
    straight = Lens.from_fov(SIZE, fov, center_shift_px=(-4, 6))
    lens = straight.with_hw(straight.f_px, -0.05, 0.01)
    scale = np.tan(np.radians(fov / 2)) / np.tan(np.radians(58 / 2))
    rng = np.random.default_rng(6)
    target = replace(BOARD, square_m=0.1 * scale)
    views = []
    for pan, tilt in ANGLES:
        pose = CameraPose((0.0, 0.0, 1.6), pan * scale, tilt * scale)
        seen = observe(lens, pose, target, rng, 0.02)
        if isinstance(seen, Detection):
            views.append(View(f"{pan} {tilt}", "board", target, seen, pose))
    assert len(views) >= 5
    assert overlay(lens, solve_level(views, SIZE).lens).max_px < 0.1


def test_wrong_points_are_left_out_and_named() -> None:
    views = posed_views(WIDE, np.random.default_rng(7))
    points = views[3].detection.points_px.copy()
    points[5] += [3.0, -2.0]
    views[3] = replace(views[3], detection=replace(views[3].detection, points_px=points))
    fit = solve_level(views, SIZE)
    assert [(name, point) for name, point, _ in fit.outliers] == [(views[3].name, 5)]
    assert_as_predicted(fit)


def test_a_picture_read_wrongly_as_a_whole_is_dropped_with_its_reason() -> None:
    views = posed_views(WIDE, np.random.default_rng(8))
    stale = replace(views[4], detection=views[1].detection)  # the picture still showed the pose before
    fit = solve_level([*views[:4], stale, *views[5:]], SIZE)
    assert [name for name, _ in fit.dropped] == [views[4].name]
    assert "disagree" in fit.dropped[0][1]
    assert_as_predicted(fit)


def test_what_the_pictures_do_not_show_is_not_told() -> None:
    small = replace(BOARD, square_m=0.01)
    seen = observe(WIDE, CameraPose((0.0, 0.0, 1.6)), small, np.random.default_rng(9), 0.05)
    assert isinstance(seen, Detection)
    fit = solve_level([View("only", "board", small, seen, CameraPose((0.0, 0.0, 1.6)))], SIZE)
    assert {"k1", "k2"} <= set(fit.untold)
    assert fit.lens.k2 == pytest.approx(0, abs=1e-6)
    assert predicted_overlay(fit.lens, fit.covariance).max_px > 5


def test_the_problem_jacobian_agrees_with_a_numeric_one() -> None:
    rng = np.random.default_rng(10)
    rough = CameraPose((0.0, 0.0, 1.6), sigma_m=0.01, sigma_deg=0.1)
    target = replace(BOARD, pose=TargetPose((0.1, 5.0, 1.5), 3.0, -2.0, 1.0, sigma_m=0.01, sigma_deg=0.2))
    views = [replace(v, target=target) for v in posed_views(WIDE, rng, camera=rough)[:3]]
    views += [replace(v, name="free" + v.name, camera_pose=None) for v in posed_views(WIDE, rng)[:2]]
    lens, poses = start(views, SIZE, 1.001, 30.0, WIDE)
    priors = Priors(0.002, 0.01, 0.01, 0.1, 0.1, 0.1, 5.0)
    problem = Problem(views, replace(lens, nodal_offset_mm=30.0, pixel_aspect=1.001), poses, priors=priors)
    assert len(problem.extras.names) == 17
    own = (np.arange(6) < problem.own_count[:, None]).astype(float)
    shared_count, size = problem.shared_count, 1e-6

    def moved(state: State, column: int, by: float) -> State:
        step = Step(np.zeros(shared_count), np.zeros_like(own))
        if column < shared_count:
            step.shared[column] = by
        else:
            step.own[:, column - shared_count] = by * own[:, column - shared_count]
        return problem.stepped(state, step)

    first = Step(rng.normal(0, 1e-3, shared_count), rng.normal(0, 1e-3, own.shape) * own)
    state = problem.stepped(problem.state, first)
    analytic = problem.evaluate(state)
    np.testing.assert_allclose(problem.residuals(state), analytic.residual_px, atol=1e-12)
    for column in range(shared_count + 6):
        up, down = (problem.evaluate(moved(state, column, by)) for by in (size, -size))
        numeric = (up.residual_px - down.residual_px) / (2 * size)
        mine = column - shared_count
        jacobian = analytic.shared[..., column] if mine < 0 else analytic.own[..., mine]
        np.testing.assert_allclose(jacobian, numeric, rtol=2e-5, atol=2e-3)
        if mine < 0:
            prior = (up.prior_residual - down.prior_residual) / (2 * size)
            np.testing.assert_allclose(analytic.prior_shared[:, column], prior, rtol=1e-5, atol=1e-3)
        elif mine < 3:
            prior = (up.own_prior_residual - down.own_prior_residual) / (2 * size)
            np.testing.assert_allclose(analytic.own_prior[..., mine], prior, rtol=1e-5, atol=1e-3)


def test_bad_input_is_one_clear_error() -> None:
    with pytest.raises(NotEnoughData, match="no picture"):
        solve_level([], SIZE)
    views = posed_views(WIDE, np.random.default_rng(11))
    with pytest.raises(InvalidInput, match="name of its own"):
        solve_level([views[0], views[0]], SIZE)
    behind = replace(BOARD, pose=TargetPose((0.0, -5.0, 1.6)))
    with pytest.raises(NotEnoughData, match="behind the camera"):
        solve_level([replace(v, target=behind) for v in views], SIZE)
    flipped = [
        replace(v, camera_pose=CameraPose((0, 0, 1.6), pan_deg=-a[0])) for v, a in zip(views, ANGLES, strict=True)
    ]
    with pytest.raises((NotEnoughData, FoldedLens)):
        solve_level([v for v, a in zip(flipped, ANGLES, strict=True) if a[0] and not a[1]], SIZE)
    hand = hand_held_views(Lens((1280, 720), 1168.0), np.random.default_rng(12), 1)
    with pytest.raises(NotEnoughData, match="at least two"):
        solve_level(hand, (1280, 720))


def test_a_folded_lens_is_refused() -> None:
    # Points all lie before the fold, the picture's corner beyond it.
    lens = Lens.from_fov(SIZE, 70.0, -0.35, 0.0)
    assert lens.folds_inside()
    views = []
    for pan in (-8, -4, 0, 4, 8):
        pose = CameraPose((0.0, 0.0, 1.6), pan)
        seen = observe(lens, pose, BOARD, np.random.default_rng(13), 0.001)
        assert isinstance(seen, Detection)
        views.append(View(f"{pan}", "board", BOARD, seen, pose))
    with pytest.raises(FoldedLens):
        solve_level(views, SIZE)


def test_residual_of_a_picture_not_in_the_fit() -> None:
    views = posed_views(WIDE, np.random.default_rng(14))
    residual = residual_of(views[0], WIDE)
    assert residual is not None
    assert float(np.sqrt(np.mean(residual**2))) == pytest.approx(0.02, rel=0.3)


def test_a_pupil_off_the_pivot_is_measured_where_the_pictures_contradict_the_given_one() -> None:
    lens = replace(WIDE, nodal_offset_mm=120.0)
    fit = solve_level(posed_views(lens, np.random.default_rng(15)), SIZE)
    assert fit.nodal_told
    assert fit.sigma_nodal_mm is not None
    assert abs(fit.lens.nodal_offset_mm - 120.0) < 4 * fit.sigma_nodal_mm
    assert overlay(lens, fit.lens).max_px < 4 * predicted_overlay(fit.lens, fit.covariance).max_px
    given = solve_level(posed_views(lens, np.random.default_rng(15)), SIZE, nodal_offset_mm=120.0)
    assert not given.nodal_told
    assert given.lens.nodal_offset_mm == 120.0
    assert predicted_overlay(given.lens, given.covariance).max_px < predicted_overlay(fit.lens, fit.covariance).max_px


def test_one_wrong_pose_among_few_pictures_is_found_out() -> None:
    """Four pictures, one pan angle 0.3 degrees off but said to be exact: the lens bends to suit it."""
    views = [v for v, angle in zip(posed_views(WIDE, np.random.default_rng(16)), ANGLES, strict=True) if angle[0]][:4]
    assert views[1].camera_pose is not None
    wrong = replace(views[1].camera_pose, pan_deg=views[1].camera_pose.pan_deg + 0.3)
    fit = solve_level([views[0], replace(views[1], camera_pose=wrong), *views[2:]], SIZE)
    assert [name for name, _ in fit.dropped] == [views[1].name]
    assert "contradicts the other pictures" in fit.dropped[0][1]


def test_boards_that_all_face_the_camera_do_not_tell_a_lens() -> None:
    rng = np.random.default_rng(17)
    flat = []
    for x, z in ((-1.5, 0.9), (1.5, 2.2)):
        board = replace(BOARD, square_m=0.05, pose=TargetPose((x, 5.0, z)))
        seen = observe(WIDE, CameraPose((0.0, 0.0, 1.6)), board, rng, 0.05)
        assert isinstance(seen, Detection)
        flat.append(View(f"{x}", "board", replace(board, pose=None), seen))
    with pytest.raises(NotEnoughData, match="different angles"):
        solve_level(flat, SIZE)
