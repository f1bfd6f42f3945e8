"""Lens tables to draw: levels of the demo lens, as a good measurement leaves them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, Sigma
from engine_adapters.sim.lens_truth import load_embedded

REASONS = {name: "not measured" for name in EVIDENCE_QUANTITIES}
SIGMA = Sigma(0.002, 2e-4, 8e-4, (0.05, 0.05), 0.4)


def demo_level(zoom: float, focus: float) -> LevelResult:
    """The demo lens at a place, with sigmas that grow towards tele where the same error of a pixel says less."""
    state = load_embedded("Demo ENG 8x").at(zoom, focus)
    optics = state.optics
    lens = Lens(
        optics.image_size,
        optics.f_px,
        optics.k1,
        optics.k2,
        optics.center_shift_px,
        optics.pixel_aspect,
        state.nodal_offset_mm,
    )
    scale = 1 / lens.half_width**2
    sigma = replace(SIGMA, k1=2e-4 * scale, k2=8e-4 * scale**2)
    return LevelResult.from_lens(zoom, focus, lens, reasons=REASONS, sigma=sigma)


def demo_table(zooms: Sequence[float], focuses: Sequence[float], wrong: int | None = None) -> LensTable:
    """A table over zooms x focuses; ``wrong``: the number of a level whose centre is 60 px off."""
    levels = [demo_level(zoom, focus) for zoom in zooms for focus in focuses]
    if wrong is not None:
        level = levels[wrong]
        shift = level.center_shift_px or (0.0, 0.0)
        levels[wrong] = replace(level, center_shift_px=(shift[0] + 60.0, shift[1]))
    image_size = load_embedded("Demo ENG 8x").image_size
    created = datetime(2026, 11, 21, 10, 0, tzinfo=UTC)
    return LensTable("Demo ENG 8x", "Cam0", 1, created, image_size, "joint", tuple(levels))
