"""``lensmatch bench``: its table, its JSON, and the registry; with a benchmark that takes no time."""

from __future__ import annotations

import importlib
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner, Result

from app.cli import bench as bench_command
from app.cli.commands import cli
from benchmarks.registry import BENCHMARKS, Benchmark

ROWS: list[dict[str, object]] = [
    {"case": "first", "method": "ours", "rmse_px": 0.0123456, "pictures": 3},
    {"case": "first", "method": "theirs", "rmse_px": math.nan, "pictures": None},
]


def invoke(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


@pytest.fixture(autouse=True)
def _quick_benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("benchmark_of_the_test")

    def run(*, quick: bool, progress: Callable[[float], None] | None = None) -> list[dict[str, object]]:
        if progress is not None:
            progress(1.0)
        return [row | {"quick": quick} for row in ROWS]

    module.run = run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    fakes = {name: Benchmark(name, "nothing", module.__name__) for name in ("one", "two")}
    monkeypatch.setattr(bench_command, "BENCHMARKS", fakes)


def test_it_prints_a_table_with_every_figure() -> None:
    result = invoke("bench", "one")
    assert result.exit_code == 0, result.stderr
    for text in ("case", "rmse_px", "ours", "theirs", "0.01235"):
        assert text in result.stdout


def test_json_goes_to_standard_output_alone() -> None:
    result = invoke("bench", "one", "--quick", "--json", "-")
    document = json.loads(result.stdout)
    assert document["name"] == "one"
    assert document["machine"]["cores"]
    assert document["rows"][0] == ROWS[0] | {"quick": True}
    assert document["rows"][1]["rmse_px"] is None


def test_json_goes_to_a_file_for_several(tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    result = invoke("bench", "--json", out)
    assert result.exit_code == 0, result.stderr
    assert [document["name"] for document in json.loads(out.read_text("utf-8"))] == ["one", "two"]
    assert "there is no folder" in invoke("bench", "--json", tmp_path / "no" / "f.json").stderr


@pytest.mark.parametrize("name", BENCHMARKS)
def test_each_registered_benchmark_is_there(name: str) -> None:
    assert callable(importlib.import_module(BENCHMARKS[name].module).run)


def test_the_report_is_one_page_with_every_benchmark(tmp_path: Path) -> None:
    out = tmp_path / "bench.html"
    result = invoke("bench", "one", "two", "--report", out)
    assert result.exit_code == 0, result.stderr
    page = out.read_text("utf-8")
    assert all(f'id="{name}"' in page for name in ("one", "two"))
    assert page.count("theirs") == 2
    assert "there is no folder" in invoke("bench", "--report", tmp_path / "no" / "b.html").stderr
