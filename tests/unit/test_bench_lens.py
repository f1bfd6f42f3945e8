"""The benchmark of whole lenses: its truth, its measure in px, and the lens files that it takes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from app.cli.commands import cli
from benchmarks.lens import RealLens, overlay_px, random_lens, read_lenses
from calibration.compare import overlay
from calibration.surface.fit import find_outliers
from calibration.surface.quantities import lens_of

LEVELS = [
    {"focal_mm": 8.8, "fov_x_deg": 71.2623, "k1": -0.191619, "k2": 0.0689969, "residual_max_px": 0.5},
    {"focal_mm": 20.0, "fov_x_deg": 36.0, "k1": 0.1, "k2": 0.0, "residual_max_px": 0.2},
    {"focal_mm": 60.0, "fov_x_deg": 12.5, "k1": 1.5, "k2": 0.0},
]


def lens_file(folder: Path, **changes: object) -> Path:
    path = folder / "lenses.json"
    path.write_text(json.dumps({"lenses": [{"name": "a lens", "levels": LEVELS} | changes]}), "utf-8")
    return path


@pytest.mark.parametrize("encoder", ["log", "servo", "linear"])
def test_the_truth_goes_through_the_measured_levels(tmp_path: Path, encoder: str) -> None:
    (lens,) = read_lenses(lens_file(tmp_path))
    assert lens.exact_px == 0.5
    truth = lens.truth(encoder)
    ends = truth(np.array([0.0, 1.0]))
    np.testing.assert_allclose(ends, lens.values[[0, -1]], atol=1e-12)
    if encoder == "linear":
        middle = (20.0 - 8.8) / (60.0 - 8.8)
        np.testing.assert_allclose(truth(np.array([middle]))[0], lens.values[1], atol=1e-12)
    focal = truth(np.linspace(0, 1, 50))[:, 0]
    assert np.all(np.diff(focal) > 0)


def test_the_measure_is_the_overlay_error() -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        true = np.array([math.log(rng.uniform(1200, 9000)), rng.uniform(-0.12, 0.08), rng.uniform(0, 0.02)])
        found = true + np.array([1e-3, 1e-3, 1e-3]) * rng.normal(size=3)
        lenses = [lens_of((*row.tolist(), 0.0, 0.0), (1920, 1080), 1.0) for row in (true, found)]
        exact = overlay(*lenses).max_px
        # The grid of the one are pixels, that of the other radii.
        assert overlay_px(true[None], found[None])[0] == pytest.approx(exact, rel=0.08)


def test_a_random_lens_has_no_wrong_level_and_one_that_is_made_wrong_is_found() -> None:
    data, truth = random_lens(np.random.default_rng(5))
    assert find_outliers(data, None) == {}
    data.values[6] = truth(float(data.zoom[6]) + 0.06)
    assert set(find_outliers(data, None)) == {6}


@pytest.mark.parametrize("text", ["", "{}", '{"lenses": [{"name": "x", "levels": [{"focal_mm": 1}]}]}', "[1, 2]"])
def test_a_bad_lens_file_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text, "utf-8")
    with pytest.raises(ValueError, match=r"bad\.json: is no file of real lenses"):
        read_lenses(path)
    result = CliRunner().invoke(cli, ["bench", "lens", "--lenses", str(path), "--quick"])
    assert result.exit_code == 1
    assert "is no file of real lenses" in result.stderr


def test_a_lens_file_is_for_the_benchmark_that_takes_one(tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["bench", "loop", "--lenses", str(lens_file(tmp_path))])
    assert result.exit_code == 2
    assert "--lenses is for the benchmark lens" in result.stderr


def test_the_real_lenses_can_be_read(shared_data: Path) -> None:
    lenses: list[RealLens] = read_lenses(shared_data / "real_lenses.json")
    assert len(lenses) == 6
    assert all(5 <= len(lens.focal_mm) <= 13 for lens in lenses)
