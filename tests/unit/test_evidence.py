"""The evidence of a level: solved again from itself, true p-values, and a misfit that is found where there is one."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.compare import grid_pixels
from calibration.lens import Lens
from calibration.solve.evidence import LevelEvidence, LevelInputs, level_evidence, solve_again
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.outcome import level_result
from calibration.solve.problem import View
from calibration.tables import LevelResult, LevelStatus, PixelError, Sigma
from calibration.types import CameraPose, Detection, Quality, Target, TargetKind, TargetPose

SIZE = (1920, 1080)
WIDE = Lens.from_fov(SIZE, 58.0, -0.15, 0.04, (3.4, -2.2))
BOARD = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((0.0, 5.0, 1.6)))
ANGLES = [(0, 0), (-20, 0), (20, 0), (-18, 9), (18, -9), (-18, -9), (18, 9), (0, 10), (0, -10)]


def views_of(
    seed: int,
    *,
    lens: Lens = WIDE,
    k3: float = 0.0,
    p1: float = 0.0,
    wave_px: float = 0.0,
    sigma_px: float = 0.02,
    said_px: float | None = None,
    angles: list[tuple[int, int]] = ANGLES,
) -> list[View]:
    """Posed pictures through a lens that may have more terms than the model; truth is written out here on its own."""
    rng = np.random.default_rng(seed)
    views = []
    for pan, tilt in angles:
        pose = CameraPose((0.0, 0.0, 1.6), pan, tilt)
        assert BOARD.pose is not None
        rays = rays_of(world_to_camera(pose, 0.0, target_points_world(BOARD.pose, BOARD.points_m())))
        x, y = rays.T
        r2 = x * x + y * y
        gain = 1 + lens.k1 * r2 + lens.k2 * r2**2 + k3 * r2**3
        u = lens.f_px * (x * gain + 2 * p1 * x * y) + 959.5 + lens.center_shift_px[0]
        v = lens.f_px * (y * gain + p1 * (r2 + 2 * y * y)) + 539.5 + lens.center_shift_px[1]
        pixels = np.column_stack([u, v])
        pixels[:, 0] += wave_px * np.sin(BOARD.points_m()[:, 0] * 12)
        inside = ((pixels > 0) & (pixels < [1919, 1079])).all(axis=1)
        noisy = (pixels + rng.normal(0, sigma_px, pixels.shape))[inside]
        covariance = np.tile(np.eye(2) * (said_px or sigma_px) ** 2, (len(noisy), 1, 1))
        ids = np.flatnonzero(inside).astype(np.int64)
        found = Detection(TargetKind.CHESSBOARD, noisy, ids, covariance, noisy.mean(0), 0.8, Quality(1.0))
        views.append(View(f"{pan},{tilt}", "board", BOARD, found, pose))
    return views


def evidence_of(views: list[View], *, hold_out: bool = False) -> tuple[LevelEvidence, LevelResult]:
    fit = solve_level(views, SIZE)
    held_out = held_out_residuals(fit, views) if hold_out else {}
    inputs = LevelInputs(0.0, 0.5, SIZE, tuple(views))
    return level_evidence(fit, inputs, held_out), level_result(fit, 0.0, 0.5, held_out=held_out)


def p_of(evidence: LevelEvidence, name: str) -> float:
    return next(test.p_value for test in evidence.misfit.tests if name in test.name)


def test_a_level_solved_again_from_its_evidence_is_the_same() -> None:
    views = views_of(1)
    points = views[2].detection.points_px.copy()
    points[4] += 2.0
    views[2] = replace(views[2], detection=replace(views[2].detection, points_px=points))
    evidence, result = evidence_of(views, hold_out=True)
    assert all(picture.held_out_px is not None for picture in evidence.pictures)
    again = solve_again(evidence.inputs)
    for item in fields(LevelResult):
        first, second = getattr(result, item.name), getattr(again, item.name)
        if isinstance(first, float):
            assert second == pytest.approx(first, rel=1e-9, abs=1e-12), item.name
        elif isinstance(first, (PixelError, Sigma)):
            for part in type(first).__dataclass_fields__:
                told = getattr(first, part)
                if told is None:
                    assert getattr(second, part) is None, (item.name, part)
                else:  # a correlation of 1e-6 has digits of 1e-9 of the sigmas, not of itself
                    tolerance = 1e-9 if part == "correlation" else 0.0
                    np.testing.assert_allclose(getattr(second, part), told, rtol=1e-9, atol=tolerance, err_msg=part)
        elif item.name == "center_shift_px":
            assert second == pytest.approx(first, rel=1e-9)
        else:
            assert second == first, item.name


def test_nothing_speaks_against_a_lens_of_the_model() -> None:
    """p-values of true models are uniform: their mean over 24 seeds, and none below one in 24 times 1000."""
    found = [evidence_of(views_of(seed))[0] for seed in range(24)]
    for name in ("k3", "decentred", "outwards", "turn about", "neighbouring"):
        p_values = np.array([p_of(evidence, name) for evidence in found])
        assert 0.28 < p_values.mean() < 0.72, name  # 0.5 +- 3.7 standard deviations of 24 uniform numbers
        assert p_values.min() > 4e-5, name
    pictures = np.array([picture.p_value for evidence in found for picture in evidence.pictures])
    assert 0.42 < pictures.mean() < 0.58
    assert np.mean(pictures < 0.05) < 0.12


@pytest.mark.parametrize(
    ("extra", "name"),
    [({"k3": 0.05}, "k3"), ({"p1": 2e-4}, "decentred"), ({"wave_px": 0.06}, "neighbouring")],
)
def test_a_misfit_is_found_and_named(extra: dict[str, float], name: str) -> None:
    evidence, _ = evidence_of(views_of(3, **extra))  # type: ignore[arg-type]
    assert p_of(evidence, name) < 1e-3
    assert evidence.misfit.flagged
    assert name in evidence.misfit.sentence()


def test_the_size_of_a_missing_term_is_what_the_lens_is_off_by() -> None:
    """Not k3 r^7 at the corner, most of which k1 and k2 take over, but what is left of it."""
    views = views_of(4, k3=0.005, sigma_px=0.001)
    evidence, _ = evidence_of(views)
    lens = evidence.lens
    pixels = grid_pixels(SIZE).reshape(-1, 2)
    rays = lens.unproject(pixels)
    r2 = np.sum(rays**2, axis=1, keepdims=True)
    truth = WIDE.f_px * rays * (1 + WIDE.k1 * r2 + WIDE.k2 * r2**2 + 0.005 * r2**3) + [959.5 + 3.4, 539.5 - 2.2]
    off = float(np.max(np.linalg.norm(truth - pixels, axis=1)))
    size = evidence.misfit.tests[0].size_px
    assert size is not None
    assert size == pytest.approx(off, rel=0.15)


def test_noise_coverage_and_outliers_are_told() -> None:
    views = views_of(5, sigma_px=0.05, said_px=0.02)
    points = views[0].detection.points_px.copy()
    points[7] += [1.5, 0.0]
    views[0] = replace(views[0], detection=replace(views[0].detection, points_px=points))
    evidence, _ = evidence_of(views)
    assert evidence.noise.expected_px == pytest.approx(0.02)
    assert evidence.noise.found_px == pytest.approx(0.05, rel=0.1)
    assert evidence.noise.floor_px == pytest.approx(np.sqrt(0.05**2 - 0.02**2), rel=0.15)
    assert [(outlier.picture, outlier.point) for outlier in evidence.outliers] == [("0,0", 7)]
    assert evidence.outliers[0].sigmas > 5
    assert evidence.outliers[0].distance_px == pytest.approx(1.5, abs=0.3)
    assert int(evidence.coverage.cells.sum()) == sum(picture.used for picture in evidence.pictures)
    assert evidence.fold_margin > 1
    middle, _ = evidence_of(views_of(5, angles=[(0, 0), (-4, 0), (4, 0), (0, 3)]))
    assert middle.coverage.radius_share < 0.6 < evidence.coverage.radius_share
    assert middle.coverage.corner_px > 3 * evidence.coverage.corner_px
    assert middle.coverage.share < evidence.coverage.share


def test_the_correlations_are_those_of_the_covariance() -> None:
    evidence, result = evidence_of(views_of(6))
    assert evidence.parameters[:5] == ("f_px", "k1", "k2", "center_shift_x_px", "center_shift_y_px")
    assert np.allclose(np.diag(evidence.correlation), 1)
    assert evidence.correlation[1, 2] < -0.8  # k1 and k2 pull against each other
    assert result.predicted_overlay_px is not None
    assert evidence.expected().max_px == pytest.approx(result.predicted_overlay_px.max)
    assert result.status is LevelStatus.OK


@pytest.mark.slow
def test_intervals_cover_what_they_say_over_many_lenses() -> None:
    """Wide to tele, barrel to pincushion, few and many points, true and flattering detector sigmas."""
    rng = np.random.default_rng(11)
    pulls: list[float] = []
    for case in range(200):
        lens = Lens.from_fov(SIZE, float(rng.uniform(45, 70)), center_shift_px=tuple(rng.uniform(-8, 8, 2)))
        lens = lens.with_hw(lens.f_px, float(rng.uniform(-0.12, 0.06)), float(rng.uniform(0.0, 0.02)))
        sigma = float(rng.uniform(0.01, 0.1))
        said = sigma * (1.0 if case % 2 else 0.5)
        count = int(rng.integers(4, 10))
        views = views_of(1000 + case, lens=lens, sigma_px=sigma, said_px=said, angles=ANGLES[-count:])
        fit = solve_level(views, SIZE, guess=lens)
        error = np.array([fit.lens.f_px, fit.lens.k1, fit.lens.k2, *fit.lens.center_shift_px])
        pulls += list((error - [lens.f_px, lens.k1, lens.k2, *lens.center_shift_px]) / fit.sigma)
    inside = np.abs(pulls)
    assert 0.63 < np.mean(inside < 1) < 0.73
    assert 0.92 < np.mean(inside < 1.96) < 0.98
