"""The commands for versions of lens tables: compare and tables."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from app.cli.commands import cli
from app.comparison import ComparisonDocument
from calibration.tables import LensTable, LevelResult, Provenance
from storage.exports import EXPORTS
from storage.repository import Repository
from tests.support.clock import Clock
from tests.support.service import lens_table, measured_level

RUNNER = CliRunner()


def invoke(*words: str | Path) -> Result:
    return RUNNER.invoke(cli, [str(word) for word in words])


def reason(result: Result) -> str:
    """The one error line of a command that failed and printed nothing else."""
    assert result.exit_code == 1, result.output
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.stdout == ""
    return line


def moved(shift_px: float, ratio: float = 1.0, **changes: Any) -> LensTable:
    """A table whose centre lies ``shift_px`` to the right, with ``ratio`` times the focal length."""

    def level(zoom: float) -> LevelResult:
        lens = measured_level(zoom).lens((1920, 1080))
        lens = replace(lens, f_px=lens.f_px * ratio, center_shift_px=(lens.center_shift_px[0] + shift_px, -2.7))
        plain = measured_level(zoom)
        told = {name: getattr(lens, name) for name in ("fov_x_deg", "fov_y_deg", "f_px", "k1_hw", "k2_hw")}
        return replace(plain, center_shift_px=lens.center_shift_px, **told)

    levels = (level(0.0), level(0.5), LevelResult.failed(1.0, 0.5, "no board"))
    return replace(lens_table(), levels=levels, **changes)


def written(folder: Path, *tables: LensTable) -> list[Path]:
    paths = [folder / f"table-{number}.json" for number in range(len(tables))]
    for path, table in zip(paths, tables, strict=True):
        path.write_bytes(EXPORTS["json"].write(table))
    return paths


# compare


def test_tables_that_agree_are_said_to(tmp_path: Path) -> None:
    result = invoke("compare", *written(tmp_path, moved(0.0), moved(0.05, version=2)))
    assert result.exit_code == 0, result.stderr
    assert "agree within their stated sigmas (0.4 at most)" in result.stdout
    assert "at most 0.050 px apart" in result.stdout
    assert "constant" not in result.stdout, "chance needs no explanation"
    assert "version 1, against XA 20x on Cam0, version 2" in result.stdout
    rows = [line.split() for line in result.stdout.splitlines() if line.strip().startswith(("0.0", "0.5"))]
    assert [row[:5] for row in rows] == [
        ["0.000", "0.00", "both", "0.050", "0.050"],
        ["0.500", "0.00", "both", "0.050", "0.050"],
    ]


def test_tables_that_differ_are_no_failure_and_are_explained(tmp_path: Path) -> None:
    result = invoke("compare", *written(tmp_path, moved(0.0), moved(1.5)))
    assert result.exit_code == 0, result.stderr
    assert "differ by more than their stated sigmas explain" in result.stdout
    assert "A constant centre shift of +1.500, +0.000 px explains all but 0.000 px of it." in result.stdout
    both = invoke("compare", *written(tmp_path, moved(0.0), moved(1.5, 1.01)))
    assert "+1.500, +0.000 px with a ratio of focal lengths of 1.01000 explains all but 0.000 px" in both.stdout
    ratio = invoke("compare", *written(tmp_path, moved(0.0), moved(0.0, 0.99)))
    assert "A constant ratio of focal lengths of 0.99000 explains all but 0.000 px" in ratio.stdout


def test_what_a_difference_is_not_explained_by_is_not_named(tmp_path: Path) -> None:
    first = moved(0.0)
    bent = replace(first.levels[0], k2=0.09, k2_hw=None).completed(first.image_size)
    result = invoke("compare", *written(tmp_path, first, replace(first, levels=(bent, *first.levels[1:]))))
    assert "explains all but" not in result.stdout
    assert "without a constant centre shift" in result.stdout


def test_without_sigmas_nothing_is_judged(tmp_path: Path) -> None:
    first = moved(0.0)
    reasons = {**first.levels[0].reasons, "predicted_overlay_px": "unknown"}
    levels = tuple(
        replace(level, predicted_overlay_px=None, reasons=reasons) if level.fov_x_deg else level
        for level in first.levels
    )
    result = invoke("compare", *written(tmp_path, first, replace(first, levels=levels)))
    assert "they state no sigmas at a common level" in result.stdout


def test_one_json_document(tmp_path: Path) -> None:
    first = moved(0.0)
    second = replace(moved(0.2), levels=moved(0.2).levels[1:])
    result = invoke("compare", *written(tmp_path, first, second), "--json")
    assert result.exit_code == 0, result.stderr
    told = json.loads(result.stdout)
    assert ComparisonDocument.model_validate(told).model_dump(mode="json") == told
    assert [level["measured"] for level in told["levels"]] == [[True, False], [True, True]]
    assert told["levels"][0]["reason"] == "in the second table it lies outside the levels"
    assert told["difference_px"]["max"] == pytest.approx(0.2)
    shown = invoke("compare", *written(tmp_path, first, second))
    assert "zoom 0.000, focus 0.00: not compared, in the second table" in shown.stderr


def test_what_cannot_be_compared_is_one_line(tmp_path: Path) -> None:
    first, other = written(tmp_path, moved(0.0, sensor_mm=(9.59, 5.39)), moved(0.0, sensor_mm=(24.9, 14.0)))
    line = reason(invoke("compare", first, other))
    assert str(other) in line
    assert "a sensor of 9.59 x 5.39 mm there, of 24.9 x 14 mm here" in line
    assert "no such file" in reason(invoke("compare", first, tmp_path / "none.json"))
    other.write_bytes(b"{")
    assert "not JSON" in reason(invoke("compare", other, first))
    told = invoke("compare", first, other, "--json")
    assert (told.exit_code, list(json.loads(told.stdout))) == (1, ["error"])


# tables


@pytest.fixture
def database(tmp_path: Path, empty_database: bytes) -> Path:
    """A database with two versions of one lens, the first approved, and a table of another lens."""
    path = tmp_path / "lensmatch.db"
    path.write_bytes(empty_database)

    async def fill() -> None:
        async with await Repository.open(path, Clock()) as ledger:
            told = Provenance("calibrated", "lensmatch 0.1.0", note="[bold]")
            first = await ledger.save_table(None, replace(lens_table(), provenance=told))
            await ledger.save_table(None, lens_table())
            await ledger.save_table(None, lens_table("[red]Other 8x"))
            await ledger.approve_table(first.id)

    asyncio.run(fill())
    return path


def test_the_stored_tables_are_listed(database: Path) -> None:
    result = invoke("tables", "--database", database)
    assert result.exit_code == 0, result.stderr
    rows = [line for line in result.stdout.splitlines() if "Cam0" in line]
    assert ["approved" in row for row in rows] == [False, True, False]
    assert "calibrated by lensmatch 0.1.0" in result.stdout
    assert "[red]Other 8x" in result.stdout
    only = invoke("tables", "--database", database, "--lens", "XA 20x", "--json")
    listed = json.loads(only.stdout)
    assert [(one["id"], one["version"], one["approved"]) for one in listed["tables"]] == [(2, 2, False), (1, 1, True)]
    assert listed["tables"][1]["provenance"]["note"] == "[bold]"
    assert listed["database"] == str(database)


def test_no_table_and_no_database(tmp_path: Path, empty_database: bytes, database: Path) -> None:
    none = tmp_path / "none.db"
    assert "there is no database yet" in reason(invoke("tables", "--database", none))
    assert not none.exists()
    assert "no table of a lens called 'XB'" in reason(invoke("tables", "--database", database, "--lens", "XB"))
    empty = tmp_path / "empty.db"
    empty.write_bytes(empty_database)
    result = invoke("tables", "--database", empty)
    assert (result.exit_code, result.stdout) == (0, "")
    assert json.loads(invoke("tables", "--database", empty, "--json").stdout)["tables"] == []
