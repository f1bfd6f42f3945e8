"""The lens table's own rules: what it refuses, and what it derives."""

from __future__ import annotations

import pickle
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import pytest

from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.tables import (
    EVIDENCE_QUANTITIES,
    LENS_QUANTITIES,
    Frames,
    Interpolation,
    LeftOut,
    LensTable,
    LevelResult,
    LevelStatus,
    PixelError,
    Sigma,
)

SIZE = (1920, 1080)
NO_EVIDENCE = dict.fromkeys(EVIDENCE_QUANTITIES, "not tried")

# The conventions' test vector: f_px, k1, k2 and what follows from them.
VECTOR = Lens(SIZE, 1339.375739, -0.191619, 0.0689969, (3.0, -2.0), nodal_offset_mm=12.5)


def level(zoom: float = 0.0, focus: float = 0.5, **changes: Any) -> LevelResult:
    return replace(LevelResult.from_lens(zoom, focus, VECTOR, reasons=NO_EVIDENCE), **changes)


def table(*levels: LevelResult, **changes: Any) -> LensTable:
    plain = LensTable("XA 20x", "Cam0", 1, datetime(2026, 11, 21, 10, tzinfo=UTC), SIZE, "joint", levels or (level(),))
    return replace(plain, **changes)


def test_a_level_of_the_conventions_vector_has_its_figures() -> None:
    result = level()
    assert result.fov_x_deg == pytest.approx(71.262261, abs=1e-6)
    # The vector's own 43.916047 was made from the rounded sensor height; square pixels give this.
    assert result.fov_y_deg == pytest.approx(43.915913, abs=1e-6)
    assert result.k1_hw == pytest.approx(-0.0984410368, abs=1e-9)
    assert result.k2_hw == pytest.approx(0.0182097842, abs=1e-9)
    assert (result.f_px, result.center_shift_px, result.nodal_offset_mm) == (1339.375739, (3.0, -2.0), 12.5)


def test_completed_fills_in_what_is_missing_and_nothing_else() -> None:
    bare = level(fov_y_deg=None, f_px=None, k1_hw=None, k2_hw=None)
    filled = bare.completed(SIZE)
    assert filled.f_px == pytest.approx(1339.375739)
    assert filled.k1_hw == pytest.approx(-0.0984410368)
    rounded = level(f_px=1339.4)
    assert rounded.completed(SIZE) is rounded


def test_completed_counts_the_pixel_aspect() -> None:
    bare = level(fov_y_deg=None)
    wide, tall = bare.completed(SIZE, 1.0), bare.completed(SIZE, 1.1)
    assert wide.fov_y_deg is not None
    assert tall.fov_y_deg is not None
    assert tall.fov_y_deg < wide.fov_y_deg


def test_completed_leaves_the_unknown_unknown() -> None:
    reasons = {**NO_EVIDENCE, "k2": "its effect is below 0.1 px", "nodal_offset_mm": "one distance only"}
    bare = replace(LevelResult.from_lens(0, 0, VECTOR, reasons=reasons), k1_hw=None)
    filled = bare.completed(SIZE)
    assert filled.k1_hw is not None
    assert (filled.k2, filled.k2_hw, filled.nodal_offset_mm) == (None, None, None)


@pytest.mark.parametrize("name", LENS_QUANTITIES)
def test_what_is_named_in_the_reasons_is_not_told(name: str) -> None:
    result = LevelResult.from_lens(0, 0, VECTOR, reasons={**NO_EVIDENCE, name: "cannot be told"})
    assert getattr(result, name) is None
    if name == "fov_x_deg":
        assert (result.f_px, result.fov_y_deg, result.k1_hw, result.k2_hw) == (None, None, None, None)


@pytest.mark.parametrize("name", [*LENS_QUANTITIES, *EVIDENCE_QUANTITIES])
def test_a_null_needs_its_reason(name: str) -> None:
    error = {"rms": 0.1, "max": 0.2}
    evidence: dict[str, Any] = {quantity: PixelError(**error) for quantity in EVIDENCE_QUANTITIES}
    told = level(reasons={}, **evidence)
    bare: dict[str, Any] = {"f_px": None, "fov_y_deg": None, "k1_hw": None, "k2_hw": None, name: None}
    with pytest.raises(InvalidInput, match=f"{name} of level zoom 0, focus 0.5 = None.*reason"):
        replace(told, **bare)
    assert getattr(replace(told, **bare, reasons={name: "no second distance"}), name) is None


def test_a_value_and_a_reason_contradict_each_other() -> None:
    with pytest.raises(InvalidInput, match="has a value and a reason"):
        level(reasons={**NO_EVIDENCE, "k1": "not seen"})
    with pytest.raises(InvalidInput, match="is none of"):
        level(reasons={**NO_EVIDENCE, "k3": "not in the model"})


def test_a_failed_level_has_a_reason_and_no_numbers() -> None:
    failed = LevelResult.failed(0.2, 1, "no target found", frames=Frames(4, 0), left_out=(LeftOut("a.png", "dark"),))
    assert failed.status is LevelStatus.FAILED
    assert failed.fov_x_deg is None
    with pytest.raises(InvalidInput, match="needs its reason"):
        LevelResult.failed(0.2, 1, "")
    with pytest.raises(InvalidInput, match="a failed level has no numbers"):
        level(status=LevelStatus.FAILED, reason="it broke", reasons={})
    with pytest.raises(InvalidInput, match="needs its reason"):
        level(status=LevelStatus.DEGRADED)
    assert level(status="degraded", reason="few pictures").status is LevelStatus.DEGRADED


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("zoom", float("nan")),
        ("focus", float("inf")),
        ("fov_x_deg", 0.0),
        ("fov_x_deg", 180.0),
        ("fov_x_deg", float("nan")),
        ("fov_y_deg", -1.0),
        ("f_px", 0.0),
        ("k1", float("nan")),
        ("k2_hw", float("inf")),
        ("center_shift_px", (0.0, float("nan"))),
        ("nodal_offset_mm", float("-inf")),
        ("seconds", -1.0),
        ("scenario", 4),
    ],
)
def test_impossible_values_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(InvalidInput, match=name):
        level(**{name: value})


def test_impossible_parts_are_refused() -> None:
    with pytest.raises(InvalidInput, match="rms"):
        PixelError(float("nan"), 1.0)
    with pytest.raises(InvalidInput, match="max"):
        PixelError(0.1, -1.0)
    with pytest.raises(InvalidInput, match="sigma k2"):
        Sigma(k2=-0.1)
    with pytest.raises(InvalidInput, match="sigma center_shift_px"):
        Sigma(center_shift_px=(0.1, float("inf")))
    with pytest.raises(InvalidInput, match="frames"):
        Frames(real=-1)
    with pytest.raises(InvalidInput, match="interpolation kind"):
        Interpolation("")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lens", ""),
        ("camera", "a\nb"),
        ("method", " "),
        ("version", 0),
        ("created", datetime(2026, 1, 1)),
        ("image_size", (0, 1080)),
        ("image_size", (1920, 1_000_000)),
        ("sensor_mm", (9.6, 0.0)),
        ("pixel_aspect", 0.0),
        ("levels", ()),
    ],
)
def test_impossible_tables_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(InvalidInput, match=name):
        table(**{name: value})


def test_two_results_for_one_level_are_refused() -> None:
    with pytest.raises(InvalidInput, match="twice"):
        table(level(), level())
    both = table(level(), level(zoom=0.25))
    assert both.level_at(0.25, 0.5) is both.levels[1]
    assert both.level_at(0.3, 0.5) is None


def test_another_radius_unit_or_picture_width_is_noticed_and_rounding_is_not() -> None:
    table(level(f_px=1340.0, fov_y_deg=43.9, k1_hw=-0.098, k2_hw=0.018))
    wrongs: list[dict[str, Any]] = [
        {"f_px": 13.19},
        {"f_px": 1339.375739 / 2},
        {"fov_y_deg": 71.26},
        {"k1_hw": -0.191619},
    ]
    for wrong in wrongs:
        with pytest.raises(InvalidInput, match=f"{next(iter(wrong))} of level .* contradicts"):
            table(level(**wrong))
    with pytest.raises(InvalidInput, match="contradicts"):
        table(level(), image_size=(960, 540))


def test_times_are_kept_in_utc() -> None:
    local = datetime(2026, 11, 21, 12, tzinfo=timezone(timedelta(hours=2)))
    assert table(created=local).created.isoformat() == "2026-11-21T10:00:00+00:00"


def test_the_lens_of_a_level_is_what_an_engine_shows() -> None:
    lens = level().lens(SIZE)
    assert lens.f_px == pytest.approx(VECTOR.f_px)
    assert lens.k1 == VECTOR.k1
    without = LevelResult.from_lens(0, 0, VECTOR, reasons={**NO_EVIDENCE, "k2": "x", "center_shift_px": "x"})
    assert (without.lens(SIZE).k2, without.lens(SIZE).center_shift_px) == (0.0, (0.0, 0.0))
    with pytest.raises(InvalidInput, match="no target found"):
        LevelResult.failed(0, 0, "no target found").lens(SIZE)


def test_a_table_goes_through_a_process_pool() -> None:
    plain = table()
    assert pickle.loads(pickle.dumps(plain)) == plain


def test_file_names_that_are_no_unicode_can_be_stored() -> None:
    left = LeftOut("caf\udce9.png", "broken\0name")
    assert left.picture.encode() == rb"caf\udce9.png"
    assert "\0" not in left.reason
