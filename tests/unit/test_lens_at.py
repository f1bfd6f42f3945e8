"""The lens of a table at any place, and a table that was completed from another lens's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.lens_at import completed_from, lens_at, surface_fit, table_at
from calibration.compare import overlay
from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult
from engine_adapters.sim.lens_truth import load_embedded
from tests.support.surfaces import table_of_levels

SIZE = (1920, 1080)
DEMO = load_embedded("Demo ENG 8x")
NO_EVIDENCE = dict.fromkeys(EVIDENCE_QUANTITIES, "not tried")


def true_lens(zoom: float, longer: float = 1.0) -> Lens:
    optics = DEMO.at(zoom, 0.5).optics
    shift = (float(optics.center_shift_px[0]), float(optics.center_shift_px[1]))
    return Lens(SIZE, optics.f_px * longer, optics.k1, optics.k2, shift)


def table(zooms: list[float], longer: float = 1.0) -> LensTable:
    levels = [LevelResult.from_lens(z, 0.5, true_lens(z, longer), reasons=NO_EVIDENCE) for z in zooms]
    return table_of_levels(levels)


FULL = table(np.linspace(0, 1, 13).tolist())


def test_a_level_is_itself_and_between_levels_the_surface_answers() -> None:
    assert lens_at(FULL, 0.0, 0.5) == FULL.levels[0].lens(SIZE, 1.0)
    assert table_at(FULL, 0.0, 0.5).levels == FULL.levels[:1]
    assert overlay(true_lens(0.21), lens_at(FULL, 0.21, 0.5)).max_px < 0.2
    (found,) = table_at(FULL, 0.21, 0.5).levels
    assert found.predicted_overlay_px is not None
    assert "interpolated" in found.reasons["residual_px"]
    with pytest.raises(InvalidInput, match="outside the table"):
        lens_at(FULL, 0.21, 0.9)


def test_a_table_of_few_levels_is_completed_from_a_lens_of_its_type() -> None:
    few = table([0.0, 0.5, 1.0], longer=1.004)
    whole = completed_from(few, FULL)
    assert len(whole.levels) == 13
    assert [level for level in whole.levels if level.zoom in (0.0, 0.5, 1.0)] == list(few.levels)
    assert "not measured" in whole.levels[1].reasons["residual_px"]
    surface = surface_fit(whole).surface
    worst = max(overlay(true_lens(z, 1.004), surface.at(z, 0.5).lens).max_px for z in np.linspace(0, 1, 21).tolist())
    assert worst < 1.0
    assert worst < 0.05 * max(
        overlay(true_lens(z, 1.004), surface_fit(few).surface.at(z, 0.5).lens).max_px
        for z in np.linspace(0, 1, 21).tolist()
    )
    other = replace(
        FULL,
        image_size=(1280, 720),
        levels=(LevelResult.from_lens(0.0, 0.5, Lens((1280, 720), 900.0), reasons=NO_EVIDENCE),),
    )
    with pytest.raises(InvalidInput, match="prior"):
        completed_from(few, other)
