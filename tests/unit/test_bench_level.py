"""The level benchmark: every method has its row, with figures or with a word why not; and its way of judging."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import level, level_fits
from benchmarks.level_fits import Fitted, overlay_max_px, project, pull_rms
from calibration.compare import overlay
from calibration.lens import Lens

SIZE = (1920, 1080)
LENS = Lens.from_fov(SIZE, 58.0, -0.15, 0.04, (3.4, -2.2), pixel_aspect=1.001)
VALUES = np.array([LENS.f_px, LENS.pixel_aspect * LENS.f_px, *LENS.principal_point_px, LENS.k1, LENS.k2, 0.0, 0.0])


def test_a_quick_run_has_a_row_for_every_method() -> None:
    rows = level.run(quick=True)
    by_case: dict[str, dict[str, dict[str, object]]] = {}
    for row in rows:
        by_case.setdefault(str(row["case"]), {})[str(row["method"])] = row
    posed, bowed = by_case["20 posed views, poses exact"], by_case["20 hand-held views, board bowed 2 mm"]
    assert set(posed) == set(level.FITS)
    for name, methods in by_case.items():
        for method, row in methods.items():
            assert row["note"], (name, method)
            has_figures = row.get("rms_px") is not None and row.get("cpu_ms") is not None
            assert has_figures or row["note"] not in ("", "f, centre, k1, k2"), (name, method)
    assert float(str(posed[level.OURS]["overlay_max_px"])) < 0.1
    assert float(str(posed[level.KNOWN]["overlay_max_px"])) < 0.1
    assert int(str(posed[level.STUDY]["evaluations"])) > 100
    # A board that is not flat is where a fit without its shape goes wrong: the reason for the case.
    assert 10 * float(str(bowed[level.OURS]["overlay_max_px"])) < float(str(bowed[level.OPENCV]["overlay_max_px"]))
    mrcal = bowed[level.MRCAL]
    assert mrcal["note"] == "not installed" or float(str(mrcal["overlay_max_px"])) < 1.0


def test_where_mrcal_is_missing_its_row_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(level_fits, "MRCAL_PYTHON", str(tmp_path / "no python here"))
    case = level._hand_held(1, 0.0)
    assert case.corners is not None
    assert level_fits.mrcal(case.corners).problem == "not installed"


def test_missing_sample_data_is_said_in_the_rows(tmp_path: Path) -> None:
    rows = level._rows(level._render_set(1, tmp_path / "chess"))
    assert {row["note"] for row in rows} == {"sample data not there"}


def test_every_method_is_judged_by_one_projection() -> None:
    rays = np.random.default_rng(1).uniform(-0.4, 0.4, (50, 2))
    np.testing.assert_allclose(project(VALUES, rays), LENS.project(rays), atol=1e-9)
    other = VALUES * [1.001, 1.001, 1, 1, 1, 1, 1, 1]
    worse = Lens(SIZE, 1.001 * LENS.f_px, LENS.k1, LENS.k2, LENS.center_shift_px, LENS.pixel_aspect)
    assert overlay_max_px(LENS, other) == pytest.approx(overlay(LENS, worse).max_px)
    off = VALUES + [2.0, 0, 0.2, 0.2, 0.02, 0.02, 0, 0]
    assert pull_rms(LENS, Fitted(off, sigma=np.array([1.0, 0.1, 0.1, 0.01, 0.01]))) == pytest.approx(2.0)
