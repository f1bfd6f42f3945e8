"""Lens tables for the tests of export formats: the common test vector, and random tables of lenses as they are."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

from hypothesis import strategies as st

from calibration.compare import overlay
from calibration.lens import Lens
from calibration.tables import REASON_KEYS, LensTable, LevelResult, LevelStatus, Provenance

VECTOR_LENS = Lens((1920, 1080), 1339.375739, -0.191619, 0.0689969, (3.0, -2.0), nodal_offset_mm=121.3)
"""The test vector that all systems must agree on (``docs/explanations/conventions.md``)."""
VECTOR_RAY = (0.5, 0.2)
VECTOR_PX = (1598.859600, 792.043840)
CREATED = datetime(2026, 11, 21, 10, 0, 0, 123456, tzinfo=UTC)

NO_EVIDENCE = {name: "not measured" for name in REASON_KEYS if name.endswith("_px") and name != "center_shift_px"}

_NAMES = st.sampled_from(["=cmd()", "-2x", "a -- b", "a,b;c", '"', "é 𐀀 & <b>", "[{", "'", "#", "-->", "%YAML", "a: b"])
NAMES = _NAMES | st.text(min_size=1, max_size=30).filter(lambda name: name.isprintable() and bool(name.strip()))


def level_of(lens: Lens, zoom: float = 0.0, focus: float = 0.5, degraded: str | None = None) -> LevelResult:
    """A level with this lens and no evidence."""
    status = LevelStatus.DEGRADED if degraded else LevelStatus.OK
    return LevelResult.from_lens(zoom, focus, lens, status=status, reason=degraded, reasons=NO_EVIDENCE)


def table_of(
    *levels: LevelResult,
    image_size: tuple[int, int] = (1920, 1080),
    pixel_aspect: float = 1.0,
    sensor_mm: tuple[float, float] | None = (13.1868, 7.4176),
) -> LensTable:
    """A table of these levels."""
    provenance = Provenance("calibrated", "Lensmatch 0.1.0", job_id="job-1", inputs_sha256="ab" * 32)
    return LensTable(
        "XA 20x", "Cam0", 3, CREATED, image_size, "joint", levels, sensor_mm, pixel_aspect, provenance=provenance
    )


def vector_table() -> LensTable:
    """A table of the test vector alone."""
    return table_of(level_of(VECTOR_LENS))


@st.composite
def lenses(draw: st.DrawFn, image_size: tuple[int, int], pixel_aspect: float, zoom: float) -> Lens:
    """A lens as there are: 3 to 100 degrees wide (never the same at two zooms), to 15 % of distortion, unfolded."""
    shift = draw(st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)))
    lens = Lens.from_fov(
        image_size,
        draw(st.integers(3, 100)) + zoom / 10,
        center_shift_px=(shift[0] * image_size[0], shift[1] * image_size[1]),
        pixel_aspect=pixel_aspect,
        nodal_offset_mm=draw(st.floats(-300, 300)),
    )
    lens = lens.with_hw(lens.f_px, draw(st.integers(-150, 150)) / 1000, draw(st.integers(-30, 30)) / 1000)
    # Folding is a matter of the coefficients alone: half of them never fold.
    while lens.folds_inside():
        lens = replace(lens, k1=lens.k1 / 2, k2=lens.k2 / 2)
    return lens


@st.composite
def lens_tables(
    draw: st.DrawFn,
    *,
    one_focus: bool = False,
    square: bool = False,
    sizes: tuple[tuple[int, int], ...] = ((1920, 1080), (3840, 2160), (720, 576), (1080, 1920), (641, 479)),
    most: int = 4,
) -> LensTable:
    """A table of one to ``most`` levels, some of them degraded, without one or another quantity, or failed."""
    image_size = draw(st.sampled_from(sizes))
    aspect = 1.0 if square else draw(st.sampled_from([1.0, 1.0, 0.9375, 1.0667]))
    focuses = st.just(0.25) if one_focus else st.floats(0, 1)
    # Apart by more than a key of six decimals.
    zooms = [step / 1000 for step in draw(st.lists(st.integers(0, 1000), min_size=1, max_size=most, unique=True))]
    levels = []
    for number, zoom in enumerate(zooms):
        focus = draw(focuses)
        if number and draw(st.integers(0, 5)) == 0:
            levels.append(LevelResult.failed(zoom, focus, "no board"))
            continue
        lens = draw(lenses(image_size, aspect, zoom))
        untold = draw(st.sets(st.sampled_from(["k2", "center_shift_px", "nodal_offset_mm"]), max_size=1))
        degraded = draw(st.none() | st.text(min_size=1, max_size=300))
        level = level_of(lens, zoom, focus, degraded)
        if untold == {"k2"}:
            lens = replace(lens, k1=max(lens.k1, 0.0), k2=0.0)
            level = level_of(lens, zoom, focus, degraded)
            level = replace(level, k2=None, k2_hw=None, reasons={**NO_EVIDENCE, "k2": "too small"})
        elif untold:
            (name,) = untold
            level = replace(level, reasons={**NO_EVIDENCE, name: "not seen"}, **{name: None})
            if level.lens(image_size, aspect).folds_inside():
                level = level_of(lens, zoom, focus, degraded)
        levels.append(level)
    table = table_of(*levels, image_size=image_size, pixel_aspect=aspect)
    return replace(table, lens=draw(NAMES), camera=draw(NAMES), method=draw(NAMES))


def assert_carried(table: LensTable, back: LensTable, *, most_px: float = 0.01) -> None:
    """``back`` is what a format of coefficients carries of ``table``: every lens, to ``most_px``, and what it is of."""
    told = [level for level in table.levels if level.fov_x_deg is not None]
    found = {(level.zoom, level.focus): level for level in back.levels}
    assert found.keys() == {(level.zoom, level.focus) for level in told}
    for name in ("lens", "camera", "version", "created", "image_size", "method", "sensor_mm", "pixel_aspect"):
        assert getattr(back, name) == getattr(table, name), name
    assert back.provenance is not None
    assert back.provenance.source == "imported"
    for level in told:
        again = found[level.zoom, level.focus]
        lens, lens_again = (part.lens(table.image_size, table.pixel_aspect) for part in (level, again))
        assert overlay(lens, lens_again).max_px <= most_px
        assert abs(lens_again.f_px - lens.f_px) <= 1e-9 * lens.f_px
        for name in ("k1", "k2", "center_shift_px", "nodal_offset_mm"):
            assert (getattr(again, name) is None) == (getattr(level, name) is None), name
        assert lens_again.nodal_offset_mm == lens.nodal_offset_mm
        assert again.status == level.status
