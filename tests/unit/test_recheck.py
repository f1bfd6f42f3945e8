"""The stored lens checked again: it holds, a remount explains what changed, or it is another lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from calibration.compare import overlay
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.surface import LensSurface, fit_surface
from calibration.surface.quantities import LevelData, frame_rays, lens_of, picture_jacobian, values_of
from calibration.surface.recheck import (
    MOST_ZOOM,
    Recheck,
    Remount,
    Verdict,
    check_places,
    corrected_table,
    recheck,
)
from calibration.tables import EVIDENCE_QUANTITIES, EngineValues, LensTable, LevelResult, Sigma
from calibration.types import FloatArray
from engine_adapters.sim.lens_truth import ZoomLens, load_embedded

TRUTH = load_embedded("Demo ENG 8x")
OTHER = load_embedded("Demo box 4x")
NOISE_PX = 0.1
SEEDS, FEW = 200, 20
FOCUSES = (0.25, 0.5, 0.75)
# The truth is one line over this range and held outside, as a stop of the lens holds it.
UNTOLD = dict.fromkeys(EVIDENCE_QUANTITIES, "simulated")
TableOf = Callable[[float, float], Lens]


def true_lens(zoom: float, focus: float, lens: ZoomLens = TRUTH) -> Lens:
    state = lens.at(zoom, focus)
    optics = state.optics
    return Lens(lens.image_size, optics.f_px, optics.k1, optics.k2, optics.center_shift_px, nodal_offset_mm=10.0)


def remounted(shift: tuple[float, float] = (0.0, 0.0), zoom: float = 0.0, focus: float = 0.0) -> TableOf:
    def at(z: float, f: float) -> Lens:
        lens = true_lens(z - zoom, f - focus)
        return replace(lens, center_shift_px=(lens.center_shift_px[0] + shift[0], lens.center_shift_px[1] + shift[1]))

    return at


def noise_covariance(lens: Lens) -> FloatArray:
    """Of quantities fitted to 100 points all over the frame, each known to :data:`NOISE_PX`."""
    rays = frame_rays(lens)
    jacobian = picture_jacobian(np.array([lens.k1_hw]), np.array([lens.k2_hw]), rays, lens.image_size)[0]
    gram = np.einsum("nij,nik->jk", jacobian, jacobian) * (100 / len(rays))
    return np.asarray(np.linalg.inv(gram) * NOISE_PX**2)


def measured(
    lens_at: TableOf, places: list[tuple[float, float]], rng: np.random.Generator, noise: float = 1.0
) -> LevelData:
    lenses = [lens_at(zoom, focus) for zoom, focus in places]
    covariances = np.array([noise_covariance(lens) * noise**2 for lens in lenses])
    rows = [rng.multivariate_normal(values_of(v), c) for v, c in zip(lenses, covariances, strict=True)]
    untold = np.full(len(places), np.nan)
    zoom, focus = np.array(places).T
    return LevelData(
        TRUTH.image_size, 1.0, tuple(range(len(places))), zoom, focus, np.array(rows), covariances, untold, untold
    )


def stored_table() -> LensTable:
    rng = np.random.default_rng(1)
    levels = []
    for zoom in np.linspace(0, 1, 9):
        for focus in FOCUSES:
            lens = true_lens(float(zoom), focus)
            values = rng.multivariate_normal(values_of(lens), noise_covariance(lens))
            noisy = lens_of(values.tolist(), TRUTH.image_size, 1.0, 10.0)
            levels.append(LevelResult.from_lens(float(zoom), focus, noisy, reasons=UNTOLD))
    created = datetime(2026, 11, 25, tzinfo=UTC)
    return LensTable(TRUTH.name, "Cam0", 1, created, TRUTH.image_size, "joint", tuple(levels), TRUTH.sensor_mm)


TABLE = stored_table()


@pytest.fixture(scope="module")
def surface() -> LensSurface:
    return fit_surface(TABLE).surface


def verdicts(
    surface: LensSurface, lens_at: TableOf, places: list[tuple[float, float]] | None = None, seeds: int = SEEDS
) -> list[Recheck]:
    places = places or list(check_places(surface))
    return [recheck(surface, measured(lens_at, places, np.random.default_rng(seed))) for seed in range(seeds)]


def count(found: list[Recheck], verdict: Verdict) -> int:
    return sum(one.verdict is verdict for one in found)


def test_an_unchanged_lens_holds(surface: LensSurface) -> None:
    found = verdicts(surface, true_lens)
    assert count(found, Verdict.HOLDS) == SEEDS
    assert all(one.remount is None and one.left_px is None and len(one.levels) == 3 for one in found)
    assert max(one.error_px for one in found) < 1.0


def test_noise_beyond_the_goal_is_no_change(surface: LensSurface) -> None:
    places = list(check_places(surface))
    held = 0
    for seed in range(40):
        levels = measured(true_lens, places, np.random.default_rng(seed), noise=20.0)
        found = recheck(surface, levels)
        assert found.verdict is not Verdict.CORRECTED
        held += found.verdict is Verdict.HOLDS and found.error_px > 1.0
    assert held > 20


def corrections(found: list[Recheck]) -> list[Remount]:
    remounts = [one.remount for one in found if one.verdict is Verdict.CORRECTED and one.remount is not None]
    assert len(remounts) >= 0.99 * len(found)
    return remounts


def test_a_shifted_axis_is_corrected_to_within_noise(surface: LensSurface) -> None:
    found = verdicts(surface, remounted((4.0, -1.0)), seeds=FEW)
    remounts = corrections(found)
    assert all(one.zoom_offset is None and one.focus_offset is None for one in remounts)
    shift = np.array([one.center_shift_px for one in remounts])
    sigma = np.array([one.center_shift_sigma_px for one in remounts])
    z = (shift - (4.0, -1.0)) / sigma
    assert np.abs(z).max() < 4.5
    assert np.mean(z**2) < 2.0
    assert sigma.max() < 0.2
    assert max(one.left_px or 0.0 for one in found) < 0.5 < 3.9 < min(one.error_px for one in found)


def test_a_slipped_zoom_encoder_is_corrected_to_within_noise(surface: LensSurface) -> None:
    remounts = corrections(verdicts(surface, remounted(zoom=0.01), seeds=FEW))
    assert all(one.center_shift_px is None and one.focus_offset is None for one in remounts)
    offsets = np.array([one.zoom_offset for one in remounts], dtype=float)
    sigmas = np.array([one.zoom_offset_sigma for one in remounts], dtype=float)
    assert np.abs(offsets - 0.01).max() < 5e-4
    assert np.mean(((offsets - 0.01) / sigmas) ** 2) < 2.0


def test_both_are_found_together_and_no_more_than_both(surface: LensSurface) -> None:
    for one in corrections(verdicts(surface, remounted((4.0, 0.0), zoom=-0.01), seeds=FEW)):
        assert one.focus_offset is None
        assert one.center_shift_px == pytest.approx((4.0, 0.0), abs=0.4)
        assert one.zoom_offset == pytest.approx(-0.01, abs=5e-4)


def test_a_slipped_focus_encoder_is_told_where_focuses_tell_it(surface: LensSurface) -> None:
    places = [(0.03, 0.5), (0.5, 0.45), (0.5, 0.7), (0.97, 0.5)]
    for one in corrections(verdicts(surface, remounted(focus=0.1), places, seeds=FEW)):
        assert one.focus_offset == pytest.approx(0.1, abs=0.02)
        assert one.zoom_offset is None


@pytest.mark.parametrize(
    "lens_at",
    [
        lambda zoom, focus: true_lens(zoom, focus, OTHER),
        lambda zoom, focus: bent(true_lens(zoom, focus), 0.01),
        lambda zoom, focus: bent(true_lens(zoom, focus), -0.004),
        lambda zoom, focus: bent(remounted((4.0, 0.0), 0.01)(zoom, focus), 0.004),
        lambda zoom, focus: remounted((3.0 if zoom < 0.5 else -3.0, 0.0))(zoom, focus),
        lambda zoom, focus: remounted(zoom=0.01 if zoom < 0.5 else -0.01)(zoom, focus),
        remounted(zoom=MOST_ZOOM * 1.5),
        remounted((120.0, 0.0)),
    ],
    ids=["another lens", "k1", "k1 a little", "k1 besides", "tilted", "stretched", "too far", "shifted too far"],
)
def test_what_no_remount_explains_is_never_corrected(surface: LensSurface, lens_at: TableOf) -> None:
    found = verdicts(surface, lens_at, seeds=FEW)
    assert count(found, Verdict.CHANGED) == len(found)
    assert all(one.remount is None and "calibrate the lens again" in one.reason for one in found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens_at", "verdict", "fewest"),
    [
        (remounted((4.0, -1.0)), Verdict.CORRECTED, 198),
        (remounted(zoom=0.01), Verdict.CORRECTED, 198),
        (lambda zoom, focus: true_lens(zoom, focus, OTHER), Verdict.CHANGED, 200),
        (lambda zoom, focus: bent(true_lens(zoom, focus), 0.004), Verdict.CHANGED, 200),
    ],
    ids=["shift", "zoom", "another lens", "k1"],
)
def test_over_many_seeds(surface: LensSurface, lens_at: TableOf, verdict: Verdict, fewest: int) -> None:
    assert count(verdicts(surface, lens_at), verdict) >= fewest


def bent(lens: Lens, by: float) -> Lens:
    return lens.with_hw(lens.f_px, lens.k1_hw + by, lens.k2_hw)


def test_the_goal_is_the_askers(surface: LensSurface) -> None:
    levels = measured(remounted((0.5, 0.0)), list(check_places(surface)), np.random.default_rng(0))
    assert recheck(surface, levels).verdict is Verdict.HOLDS
    strict = recheck(surface, levels, goal_px=0.3)
    assert strict.verdict is Verdict.CORRECTED
    assert "centre shift +0.49" in strict.reason
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InvalidInput, match="goal_px"):
            recheck(surface, levels, goal_px=wrong)
    with pytest.raises(InvalidInput, match="other pictures"):
        recheck(surface, replace(levels, image_size=(960, 540)))
    with pytest.raises(InvalidInput, match="other pictures"):
        recheck(surface, replace(levels, pixel_aspect=1.2))


def test_checked_places_stay_off_the_ends_and_inside(surface: LensSurface) -> None:
    places = check_places(surface)
    zooms = [zoom for zoom, _ in places]
    assert zooms == sorted(zooms)
    assert 0 < zooms[0] < 0.1 < 0.25 <= zooms[1] <= 0.75 < 0.9 < zooms[2] < 1
    assert {focus for _, focus in places} == {0.5}
    prime = replace(TABLE, levels=tuple(level for level in TABLE.levels if level.zoom == 0.5))
    assert [zoom for zoom, _ in check_places(fit_surface(prime).surface)] == [0.5, 0.5]
    single = replace(TABLE, levels=prime.levels[:1])
    assert check_places(fit_surface(single).surface) == ((0.5, 0.25),)


@pytest.mark.parametrize("zoom", [0.01, -0.01])
def test_the_corrected_table_is_the_remounted_lens(surface: LensSurface, zoom: float) -> None:
    now = remounted((4.0, -1.0), zoom)
    found = recheck(surface, measured(now, list(check_places(surface)), np.random.default_rng(3)))
    table = corrected_table(TABLE, surface, found, software="lensmatch test", parent_sha256="ab" * 32, job_id="j")
    assert table.provenance is not None
    assert (table.provenance.source, table.provenance.parent_sha256) == ("corrected", "ab" * 32)
    assert "centre shift +3.99" in (table.provenance.note or "")
    assert all(0 <= level.zoom <= 1 and 0 <= level.focus <= 1 for level in table.levels)
    # Three levels went over the border, and the lens at the border stands there instead.
    assert len(table.levels) == len(TABLE.levels)
    corrected = fit_surface(table, reject=False).surface
    for place in [(0.02, 0.5), (0.3, 0.3), (0.77, 0.7), (0.98, 0.5)]:
        assert overlay(now(*place), corrected.at(*place).lens).max_px < 0.5
    border = table.level_at(1.0 if zoom > 0 else 0.0, 0.5)
    assert border is not None
    assert "not measured" in border.reasons["residual_px"]


def test_what_the_levels_say_of_themselves_moves_along(surface: LensSurface) -> None:
    lens = true_lens(0.5, 0.5)
    level = LevelResult.from_lens(
        0.5, 0.5, lens, reasons=UNTOLD, sigma=Sigma(0.01, 0.001, 0.001, (0.3, 0.3)), engine_values=EngineValues.of(lens)
    )
    table = replace(TABLE, levels=(level, LevelResult.failed(0.6, 0.5, "hidden"), LevelResult.failed(1.0, 0.5, "gone")))
    remount = Remount((4.0, -1.0), (0.4, 0.0), 0.25, 0.001)
    found = Recheck(Verdict.CORRECTED, 1.0, 4.1, 0.1, (), remount, "told")
    moved, failed = corrected_table(table, surface, found, software="x", parent_sha256="cd", job_id=None).levels
    shift = (lens.center_shift_px[0] + 4.0, lens.center_shift_px[1] - 1.0)
    assert (moved.zoom, moved.focus, moved.center_shift_px) == (0.75, 0.5, shift)
    assert moved.sigma.center_shift_px == pytest.approx((0.5, 0.3))
    assert moved.engine_values is not None
    assert moved.engine_values.center_shift_px == shift
    assert (failed.zoom, failed.reason) == (0.85, "hidden")
    with pytest.raises(InvalidInput, match="no correction"):
        corrected_table(table, surface, replace(found, remount=None), software="x", parent_sha256="cd", job_id=None)
