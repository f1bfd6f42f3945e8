"""JSON and CSV carry every table there and back, exactly."""

from __future__ import annotations

import csv
import io
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.lens import Lens
from calibration.tables import (
    EVIDENCE_QUANTITIES,
    REASON_KEYS,
    EngineValues,
    EvidenceSummary,
    Frames,
    Interpolation,
    LeftOut,
    LensTable,
    LevelResult,
    LevelStatus,
    PixelError,
    Sigma,
)
from storage.exports import EXPORTS, Export
from storage.exports.csv_table import read_csv, write_csv

T = TypeVar("T")
GOLDEN = Path(__file__).parents[1] / "golden"
EXACT = ("json", "csv")
"""The formats that carry everything; those of coefficients have tests of their own."""
FORMATS = pytest.mark.parametrize("export", [EXPORTS[name] for name in EXACT], ids=EXACT)

# What a spreadsheet, a CSV reader or a JSON reader could stumble over, mixed with everything else.
NASTY = st.sampled_from(
    ["=1+1", "+x", "-x", "@x", "'", "''=", "\t=", "\r\n", '"', ",", ";", "é\N{OLD PERSIAN SIGN A}", "{}", "null"]
)
TEXTS = st.one_of(NASTY, st.text(max_size=30)) | st.lists(NASTY, max_size=4).map("".join)
NAMES = st.one_of(st.sampled_from(["=cmd()", "-2x", "'quoted'", "a,b;c", '"'])) | st.text(
    min_size=1, max_size=30
).filter(lambda name: name.isprintable() and bool(name.strip()))
FINITE = st.floats(-1e6, 1e6)
NOT_NEGATIVE = st.floats(0, 1e6)
ERRORS = st.builds(PixelError, NOT_NEGATIVE, NOT_NEGATIVE)


def optional(values: st.SearchStrategy[T]) -> st.SearchStrategy[T | None]:
    return st.none() | values


SIGMAS = st.builds(
    Sigma,
    optional(NOT_NEGATIVE),
    optional(NOT_NEGATIVE),
    optional(NOT_NEGATIVE),
    optional(st.tuples(NOT_NEGATIVE, NOT_NEGATIVE)),
    optional(NOT_NEGATIVE),
)
COMMON: st.SearchStrategy[dict[str, Any]] = st.fixed_dictionaries(
    {
        "frames": st.builds(Frames, st.integers(0, 1000), st.integers(0, 1000)),
        "seconds": optional(NOT_NEGATIVE),
        "left_out": st.lists(st.builds(LeftOut, TEXTS, TEXTS), max_size=3).map(tuple),
    }
)


@st.composite
def levels(draw: st.DrawFn, zoom: float, image_size: tuple[int, int], pixel_aspect: float) -> LevelResult:
    focus = draw(FINITE)
    common = draw(COMMON)
    reason = draw(TEXTS.filter(bool))
    if draw(st.booleans()):
        return LevelResult.failed(zoom, focus, reason, **common)
    lens = Lens.from_fov(
        image_size,
        draw(st.floats(0.5, 150)),
        draw(st.floats(-50, 50)),
        draw(st.floats(-50, 50)),
        draw(st.tuples(FINITE, FINITE)),
        pixel_aspect,
        draw(FINITE),
    )
    untold = draw(st.sets(st.sampled_from(REASON_KEYS)))
    evidence: dict[str, Any] = {name: None if name in untold else draw(ERRORS) for name in EVIDENCE_QUANTITIES}
    status = draw(st.sampled_from([LevelStatus.OK, LevelStatus.DEGRADED]))
    return LevelResult.from_lens(
        zoom,
        focus,
        lens,
        status=status,
        reason=reason if status is LevelStatus.DEGRADED else None,
        reasons={name: draw(TEXTS.filter(bool)) for name in sorted(untold)},
        sigma=draw(SIGMAS),
        scenario=draw(optional(st.sampled_from([1, 2, 3]))),
        **evidence,
        **common,
    )


@st.composite
def lens_tables(draw: st.DrawFn) -> LensTable:
    image_size = draw(st.tuples(st.integers(2, 8192), st.integers(2, 8192)))
    pixel_aspect = draw(st.floats(0.5, 2))
    zooms = draw(st.lists(FINITE, min_size=1, max_size=3, unique=True))
    moment = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(microseconds=draw(st.integers(-(10**15), 10**15)))
    return LensTable(
        draw(NAMES),
        draw(NAMES),
        draw(st.integers(1, 10**6)),
        moment,
        image_size,
        draw(NAMES),
        tuple(draw(levels(zoom, image_size, pixel_aspect)) for zoom in zooms),
        draw(optional(st.tuples(st.floats(0.1, 100), st.floats(0.1, 100)))),
        pixel_aspect,
        draw(optional(st.builds(Interpolation, NAMES, optional(ERRORS)))),
    )


def golden_table() -> LensTable:
    """Written out in full, so that the golden files do not hang on a computer's last digit."""
    first = LevelResult(
        zoom=0.0,
        focus=0.5,
        status=LevelStatus.OK,
        fov_x_deg=71.262261,
        fov_y_deg=43.916047,
        f_px=1339.375739,
        k1=-0.191619,
        k2=0.0689969,
        k1_hw=-0.0984410368,
        k2_hw=0.0182097842,
        center_shift_px=(3.0, -2.0),
        nodal_offset_mm=121.3,
        sigma=Sigma(0.0008, 0.0002, 0.0011, (0.01, 0.012), 0.2),
        residual_px=PixelError(0.021, 0.06),
        held_out_px=PixelError(0.03, 0.07),
        predicted_overlay_px=PixelError(0.02, 0.05),
        engine_overlay_px=PixelError(0.03, 0.08),
        engine_values=EngineValues(71.5, -0.2, 0.07, (962.5, 537.5), 121.0),
        evidence=EvidenceSummary(
            0.012,
            'z0_f5/left, "1".png',
            0.02,
            0.875,
            0.97,
            None,
            "a k3 term is missing",
            0.12,
            ("place in depth of board: 3.1 ± 0.4 mm (shown)",),
            "ab" * 32,
        ),
        scenario=1,
        frames=Frames(4, 5),
        seconds=0.6,
    )
    second = LevelResult(
        zoom=0.5,
        focus=0.5,
        status=LevelStatus.DEGRADED,
        fov_x_deg=20.0,
        fov_y_deg=11.324224,
        f_px=5444.430579,
        center_shift_px=(0.1, 0.30000000000000004),
        sigma=Sigma(fov_x_deg=1e-300),
        residual_px=PixelError(0.2, 0.9),
        frames=Frames(2, 0),
        left_out=(LeftOut("z5_f5/corner, left.png", 'no "board"'), LeftOut("bühne.png", "1280 x 721 px")),
        reason="=two pictures only",
        reasons={
            "k1": "its effect is below the noise",
            "k2": "its effect is below the noise",
            "nodal_offset_mm": "one distance only",
            "held_out_px": "too few pictures",
            "predicted_overlay_px": "no covariance",
            "engine_overlay_px": "no engine",
        },
    )
    third = LevelResult.failed(1.0, 0.5, "no target found\nin 4 pictures", frames=Frames(4, 0), seconds=1.25)
    created = datetime(2026, 11, 21, 10, 0, 0, tzinfo=UTC)
    interpolation = Interpolation("cubic in log f", PixelError(0.1, 0.3))
    return LensTable(
        "XA 20x", "-Cam0", 3, created, (1920, 1080), "joint", (first, second, third), (9.59, 5.39), 1.0, interpolation
    )


@FORMATS
@settings(max_examples=30)
@given(table=lens_tables())
def test_there_and_back(export: Export, table: LensTable) -> None:
    data = export.write(table)
    assert export.read(data) == table
    assert export.write(export.read(data)) == data


@FORMATS
def test_the_format_has_not_changed(export: Export) -> None:
    golden = (GOLDEN / f"lens_table{export.suffix}").read_bytes()
    assert export.write(golden_table()) == golden
    assert export.read(golden) == golden_table()


@FORMATS
def test_a_byte_order_mark_does_no_harm(export: Export) -> None:
    assert export.read(b"\xef\xbb\xbf" + export.write(golden_table())) == golden_table()


@pytest.mark.parametrize("export", EXPORTS.values(), ids=EXPORTS.keys())
def test_the_registry_tells_all(export: Export) -> None:
    assert EXPORTS[export.name] is export
    assert export.suffix.startswith(".")
    assert "/" in export.media_type
    assert (export.cannot_carry == ()) == (export.name in EXACT)


@settings(max_examples=30)
@given(table=lens_tables())
def test_no_csv_cell_is_a_formula(table: LensTable) -> None:
    for row in csv.reader(io.StringIO(write_csv(table).decode(), newline="")):
        for cell in row:
            if cell.startswith(("=", "+", "-", "@", "\t", "\r")):
                float(cell)  # a number may have its sign; anything else raises


def test_csv_columns_may_be_moved_and_added() -> None:
    rows = list(csv.reader(io.StringIO(write_csv(golden_table()).decode(), newline="")))
    out = io.StringIO(newline="")
    csv.writer(out, lineterminator="\n").writerows([[*reversed(row), "a note"] for row in rows])
    text = out.getvalue().replace("a note", "note", 1)
    assert read_csv(text.encode()) == golden_table()


def test_csv_takes_a_long_list_of_left_out_pictures() -> None:
    many = tuple(LeftOut(f"picture_{number:06d}.png", "no target found in it") for number in range(5000))
    failed = LevelResult.failed(0, 0, "no picture is left", left_out=many)
    table = LensTable("a", "b", 1, datetime(2026, 1, 1, tzinfo=UTC), (1920, 1080), "joint", (failed,))
    assert read_csv(write_csv(table)) == table
