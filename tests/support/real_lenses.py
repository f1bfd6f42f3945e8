"""Lens tables for the tests of the formats of coefficients: the conventions' test vector, and random realistic ones."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np
from hypothesis import strategies as st

from calibration.compare import overlay
from calibration.lens import Lens, invert_radius
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, LevelStatus

SIZE = (1920, 1080)
SENSOR_MM = (13.1868, 7.4176)
VECTOR = Lens(SIZE, 1339.375739, -0.191619, 0.0689969, (3.0, -2.0), nodal_offset_mm=121.3)
CREATED = datetime(2026, 11, 21, 10, tzinfo=UTC)

_STEEPEST = 0.25
"""Slope of the distorted radius at the farthest corner: a lens that squeezes its corner more is no lens to be met; the
strongest barrel of the real zooms has more than twice that."""


def level_of(lens: Lens, zoom: float = 0.0, focus: float = 0.5, *, untold: tuple[str, ...] = ()) -> LevelResult:
    """A level of a lens; ``untold`` quantities have a reason instead."""
    reasons = {name: "not measured" for name in (*EVIDENCE_QUANTITIES, *untold)}
    return LevelResult.from_lens(zoom, focus, lens, status=LevelStatus.OK, reasons=reasons)


def table_of(*levels: LevelResult, pixel_aspect: float = 1.0, image_size: tuple[int, int] = SIZE) -> LensTable:
    """A table of levels on the test vector's sensor."""
    return LensTable("XA 20x", "Cam0", 3, CREATED, image_size, "joint", levels, SENSOR_MM, pixel_aspect)


def vector_table() -> LensTable:
    """The test vector as a table of one level."""
    return table_of(level_of(VECTOR))


def corner_slope(lens: Lens) -> float:
    """d r_d / d r_u at the picture's farthest corner; 0 or less where the lens folds before it."""
    if lens.folds_inside():
        return 0.0
    r2 = float(invert_radius(np.array([lens.corner_radius()]), lens.k1, lens.k2)[0]) ** 2
    return 1 + 3 * lens.k1 * r2 + 5 * lens.k2 * r2 * r2


@st.composite
def real_lenses(draw: st.DrawFn, image_size: tuple[int, int] = SIZE, pixel_aspect: float = 1.0) -> Lens:
    """Lenses within what six real zooms have: k1, k2 with radius 1 at half the diagonal, unfolded with a margin."""
    fov_x_deg = math.exp(draw(st.floats(math.log(0.7), math.log(100))))
    shift_px = draw(st.tuples(st.floats(-20, 20), st.floats(-20, 20)))
    nodal_mm = draw(st.floats(-500, 500))
    frame = Lens.from_fov(image_size, fov_x_deg, 0.0, 0.0, shift_px, pixel_aspect, nodal_mm)
    diagonal = math.hypot(image_size[0], image_size[1] / pixel_aspect) / image_size[0]
    k1_hd, k2_hd = (draw(st.integers(*millionths)) / 1e6 for millionths in ((-213_000, 152_000), (-57_000, 87_000)))
    lens = frame.with_hw(frame.f_px, k1_hd / diagonal**2, k2_hd / diagonal**4)
    while corner_slope(lens) < _STEEPEST:  # weaker, until it is one
        lens = lens.with_hw(lens.f_px, 0.8 * lens.k1_hw, 0.8 * lens.k2_hw)
    return lens


@st.composite
def real_tables(draw: st.DrawFn) -> LensTable:
    """Tables of up to three realistic levels, some of which do not tell everything."""
    image_size = draw(st.sampled_from([SIZE, (3840, 2160), (720, 576)]))
    pixel_aspect = draw(st.sampled_from([1.0, 1.0008, 0.9375]))
    places = draw(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), min_size=1, max_size=3, unique=True))
    quantities = st.sampled_from(["k1", "k2", "center_shift_px", "nodal_offset_mm"])
    levels = [
        level_of(draw(real_lenses(image_size, pixel_aspect)), zoom, focus, untold=tuple(draw(st.sets(quantities))))
        for zoom, focus in places
    ]
    return table_of(*levels, pixel_aspect=pixel_aspect, image_size=image_size)


def assert_same_lenses(table: LensTable, back: LensTable, most_px: float) -> None:
    """All that a format of coefficients carries is the same in both, the lenses to within ``most_px`` of overlay."""
    for name in ("lens", "camera", "version", "created", "image_size", "method", "sensor_mm", "pixel_aspect"):
        assert getattr(back, name) == getattr(table, name), name
    assert len(back.levels) == len(table.levels)
    for level, read in zip(table.levels, back.levels, strict=True):
        assert (read.zoom, read.focus, read.status) == (level.zoom, level.focus, level.status)
        for name in ("k1", "k2", "center_shift_px", "nodal_offset_mm"):
            assert (getattr(read, name) is None) == (getattr(level, name) is None), name
        if level.nodal_offset_mm is not None and read.nodal_offset_mm is not None:
            assert math.isclose(read.nodal_offset_mm, level.nodal_offset_mm, rel_tol=1e-12, abs_tol=1e-12)
        lens, found = (of.lens(table.image_size, table.pixel_aspect) for of in (level, read))
        assert overlay(lens, found).max_px <= most_px
