"""From a fit to the level's entry in the lens table: numbers, sigmas, evidence, and reasons for what is not told."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.camera import target_points_world, world_to_camera
from calibration.compare import NEGLIGIBLE_PX, edge_effect_px, predicted_overlay
from calibration.lens import Lens
from calibration.solve.center_shift import center_shift_from_centre
from calibration.solve.engine_check import EngineAgreement
from calibration.solve.iteration import LevelFit
from calibration.solve.level import MISFIT_PX
from calibration.solve.misfit import Minimum, coverage_of, misfit_of
from calibration.solve.nodal import MEASURED_MM
from calibration.solve.problem import View
from calibration.tables import (
    EVIDENCE_QUANTITIES,
    LENS_QUANTITIES,
    EngineValues,
    LeftOut,
    LevelResult,
    LevelStatus,
    PixelError,
    Sigma,
)
from calibration.types import FloatArray

USABLE_OVERLAY_PX = 1.0
"""Expected overlay error above which a level is called degraded: a shift that a viewer begins to see."""

USELESS_OF_WIDTH = 0.25
"""Expected overlay error, as a share of the picture's width, above which a level has no numbers at all."""

ENGINE_AGREES_PX = 0.15
"""Corners of the engine's render this far from the camera's are more than detectors and noise can do."""

_OUTLIER_SHARE = 0.03
_FEWEST_OUTLIERS = 3
_ON_AXIS = 1e-4
# Tangent of the angle off the optical axis under which a thing counts as on it: half a pixel at 5,000 px.
_NODAL_HINT = 3.0
# Sigmas of the nodal offset at which a level is called degraded before it is certain enough to be used.

NO_ENGINE = "no engine's render was compared"
NODAL_NOT_MEASURED = "not measured: that takes pictures from known head angles of a surveyed target"


def pixel_error(residuals: Sequence[FloatArray]) -> PixelError | None:
    """RMS per coordinate and largest distance of residuals (N, 2) px; None when there are none."""
    given = [r for r in residuals if len(r)]
    if not given:
        return None
    stacked = np.concatenate(given)
    return PixelError(float(np.sqrt(np.mean(stacked**2))), float(np.max(np.linalg.norm(stacked, axis=1))))


def level_result(
    fit: LevelFit,
    zoom: float,
    focus: float,
    *,
    held_out: Mapping[str, FloatArray],
    engine: EngineAgreement | None = None,
    engine_shortfall_px: float = 0.0,
    engine_problem: str = "",
    left_out: Sequence[LeftOut] = (),
) -> LevelResult:
    """The level's entry. ``held_out`` as :func:`calibration.solve.level.held_out_residuals` gives it. ``engine``: how
    the engine's render agreed, None where none took part, or for ``engine_problem``; ``engine_shortfall_px``: how far
    its best picture of this lens is off by the engine's very camera.
    """
    expected = predicted_overlay(fit.lens, fit.covariance)
    every_left_out = (*left_out, *(LeftOut(name, why) for name, why in fit.dropped), *_outliers(fit))
    if why := _useless(fit, expected.max_px):
        return LevelResult.failed(zoom, focus, why, left_out=every_left_out)
    held = pixel_error(list(held_out.values()))
    reasons = {name: "the pictures do not show it; taken as 0" for name in fit.untold}
    if fit.nodal_seen_mm is None:
        reasons["nodal_offset_mm"] = NODAL_NOT_MEASURED
    elif not fit.nodal_told:
        reasons["nodal_offset_mm"] = (
            f"not told apart from {fit.lens.nodal_offset_mm:g} mm, which is taken: the pictures alone say "
            f"{fit.nodal_seen_mm[0]:.1f} ± {fit.nodal_seen_mm[1]:.1f} mm; nodal offset and field of view look alike at "
            "one distance: add a target at a clearly different one"
        )
    if held is None:
        reasons["held_out_px"] = "no picture could be spared from the fit"
    engine_overlay_px = pixel_error(engine.residuals_px) if engine is not None else None
    if engine_overlay_px is None:
        reasons["engine_overlay_px"] = engine_problem or NO_ENGINE
    trouble = _trouble(fit, expected.max_px)
    if engine_problem:
        trouble.append(engine_problem)
    if engine is not None and engine_overlay_px is not None:
        trouble += _engine_trouble(fit, expected.max_px, engine, engine_overlay_px, engine_shortfall_px)
    sigma = fit.sigma
    return LevelResult.from_lens(
        zoom,
        focus,
        fit.lens,
        status=LevelStatus.DEGRADED if trouble else LevelStatus.OK,
        reason="; ".join(trouble) or None,
        reasons=reasons,
        sigma=Sigma(
            fov_x_deg=fit.sigma_fov_x_deg,
            k1=None if "k1" in fit.untold else float(sigma[1]),
            k2=None if "k2" in fit.untold else float(sigma[2]),
            center_shift_px=None if "center_shift_px" in fit.untold else (float(sigma[3]), float(sigma[4])),
            nodal_offset_mm=None if "nodal_offset_mm" in reasons else fit.sigma_nodal_mm,
            correlation=_correlation(fit.covariance),
        ),
        residual_px=PixelError(fit.rms_px, fit.max_px),
        held_out_px=held,
        predicted_overlay_px=PixelError(expected.rms_px, expected.max_px),
        engine_overlay_px=engine_overlay_px,
        engine_values=_engine_values(fit.lens, engine),
        parallax=fit.parallax,
        scenario=1 if edge_effect_px(fit.lens)[1] <= NEGLIGIBLE_PX else 2,
        left_out=every_left_out,
    )


def _correlation(covariance: FloatArray) -> tuple[tuple[float, ...], ...] | None:
    """Correlation of (fov_x_deg, k1, k2, sx, sy) from the covariance of (f_px, k1, k2, sx, sy): the field of view
    shrinks as the focal length grows. None where a quantity has no sigma."""
    sigma = np.sqrt(np.diag(covariance))
    if not np.all(np.isfinite(sigma)) or np.min(sigma) <= 0:
        return None
    signed = sigma * np.array([-1.0, 1.0, 1.0, 1.0, 1.0])
    correlation = np.clip(covariance / np.outer(signed, signed), -1, 1)
    np.fill_diagonal(correlation, 1.0)
    return tuple(tuple(row) for row in ((correlation + correlation.T) / 2).tolist())


def _outliers(fit: LevelFit) -> list[LeftOut]:
    by_picture: dict[str, list[float]] = {}
    for name, _, distance in fit.outliers:
        by_picture.setdefault(name, []).append(distance)
    return [
        LeftOut(name, f"{len(far)} of its points left out: up to {max(far):.2f} px from where all others put them")
        for name, far in by_picture.items()
    ]


def _useless(fit: LevelFit, expected_max_px: float) -> str | None:
    """Why the level's numbers must not be used at all, or None."""
    if not expected_max_px <= USELESS_OF_WIDTH * fit.lens.image_size[0]:
        return (
            f"the pictures do not tell the lens (expected overlay error up to {expected_max_px:.0f} px): take more, "
            "with the target in the corners, or check the poses"
        )
    share = len(fit.outliers) / max(fit.points + len(fit.outliers), 1)
    if len(fit.outliers) >= _FEWEST_OUTLIERS and share > _OUTLIER_SHARE:
        return f"{share:.0%} of the points disagree with the rest: a pose, the survey or the pictures are wrong"
    return None


def _trouble(fit: LevelFit, expected_max_px: float) -> list[str]:
    trouble: list[str] = []
    if not math.isfinite(expected_max_px) or expected_max_px > USABLE_OVERLAY_PX:
        advice = "take more pictures, the target nearer the corners"
        coverage = coverage_of(fit)
        if coverage.radius_share < 1 and coverage.corner_px > USABLE_OVERLAY_PX:
            advice = (
                f"the frame's corners are extrapolated, points reach {coverage.radius_share:.0%} of the way to them: "
                f"{advice}"
            )
        trouble.append(f"expected overlay error up to {expected_max_px:.1f} px: {advice}")
    if fit.nodal_told and fit.sigma_nodal_mm is not None and fit.sigma_nodal_mm > MEASURED_MM:
        trouble.append(
            f"the nodal offset is known to {fit.sigma_nodal_mm:.1f} mm only and shows as field of view: add a target "
            "at another distance"
        )
    if fit.floor_px > MISFIT_PX:
        worst = max(fit.views, key=lambda view: view.rms_px)
        trouble.append(
            f"residuals of {fit.rms_px:.1f} px are far above what the pictures' noise explains (most in {worst.name}): "
            "a pose, the survey or the target's size is wrong"
        )
    missing = misfit_of(fit, Minimum.of(fit)).missing if fit.solved is not None else None
    if missing is not None and missing.size_px is not None and missing.size_px > ENGINE_AGREES_PX:
        trouble.append(
            f"{missing.name} (p = {missing.p_value:.1g}): k1 and k2 do not describe this lens, it is off by up to "
            f"{missing.size_px:.2f} px in the frame"
        )
    if fit.untold:
        trouble.append(f"not told by the pictures: {', '.join(fit.untold)}")
    if fit.nodal_seen_mm is not None and not fit.nodal_told:
        seen_mm, sigma_mm = fit.nodal_seen_mm
        if abs(seen_mm - fit.lens.nodal_offset_mm) > _NODAL_HINT * sigma_mm:
            trouble.append(
                f"the pictures hint at a nodal offset of {seen_mm:.0f} ± {sigma_mm:.0f} mm, not "
                f"{fit.lens.nodal_offset_mm:g} mm; if so the field of view is off: add a target at another distance"
            )
    return trouble


def _engine_trouble(
    fit: LevelFit, expected_max_px: float, engine: EngineAgreement, overlay: PixelError, shortfall_px: float
) -> list[str]:
    agrees_px = max(ENGINE_AGREES_PX, 5 * expected_max_px, 6 * fit.rms_px, 5 * engine.sigma_px)
    trouble = [engine.trouble] if engine.trouble else []
    if shortfall_px > ENGINE_AGREES_PX:
        trouble.append(
            f"the engine cannot draw this lens nearer than {shortfall_px:.2f} px everywhere: its polynomial goes the "
            "other way"
        )
    if not trouble and overlay.max > agrees_px:
        trouble.append(
            f"the engine's render is up to {overlay.max:.1f} px off at these values: its lens model is not the "
            "profile's (check the radius unit of k1 and k2, the centre shift's sign and origin, the FoV's axis)"
        )
    return trouble


def _engine_values(lens: Lens, engine: EngineAgreement | None) -> EngineValues | None:
    """What the engine was told, where that was not the lens itself."""
    return None if engine is None or engine.asked == lens else EngineValues.of(engine.asked)


def shift_only_result(
    views: Sequence[View], image_size: tuple[int, int], zoom: float, focus: float, left_out: Sequence[LeftOut] = ()
) -> LevelResult | None:
    """A level of which nothing but the centre shift can be told: a light or target on the optical axis.

    None when no picture shows such a thing. The mean of all of them, weighted with their covariances.
    """
    shifts = [center_shift_from_centre(v.detection, image_size) for v in views if _on_axis(v)]
    if not shifts:
        return None
    weights = [np.linalg.inv(shift.covariance_px2) for shift in shifts]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    mean = covariance @ np.sum([w @ np.asarray(s.shift_px) for w, s in zip(weights, shifts, strict=True)], axis=0)
    why = "not told: the pictures show only where the optical axis is; add pictures of a target beside it"
    quantities = (*LENS_QUANTITIES, *EVIDENCE_QUANTITIES)
    return LevelResult(
        zoom,
        focus,
        LevelStatus.DEGRADED,
        center_shift_px=(float(mean[0]), float(mean[1])),
        sigma=Sigma(center_shift_px=(math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1]))),
        left_out=tuple(left_out),
        reason="only the centre shift is told",
        reasons={name: why for name in quantities if name != "center_shift_px"},
    )


def _on_axis(view: View) -> bool:
    """Whether the target's centre lies on the optical axis, as surveyed: within a ten-thousandth of its distance."""
    if view.camera_pose is None or view.target.pose is None:
        return False
    centre = target_points_world(view.target.pose, np.zeros((1, 2)))
    x, y, z = world_to_camera(view.camera_pose, 0.0, centre)[0]
    return bool(z > 0 and math.hypot(x, y) < _ON_AXIS * z)
