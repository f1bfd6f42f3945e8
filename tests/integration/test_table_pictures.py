"""Pictures of stored tables by the service, and of table files by the command."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner, Result

from app.cli.commands import cli
from calibration.tables import LensTable
from storage.exports import EXPORTS
from storage.repository import Repository
from tests.support.plot_tables import demo_table
from tests.support.service import assert_problem, lens_table

PNG = b"\x89PNG\r\n\x1a\n"
TABLE = demo_table((0.2, 0.8), (0.3,))


def moved(table: LensTable) -> LensTable:
    levels = []
    for level in table.levels:
        x, y = level.center_shift_px or (0.0, 0.0)
        levels.append(replace(level, center_shift_px=(x + 2.0, y)))
    return replace(table, version=2, levels=tuple(levels))


# The service


@pytest.mark.parametrize("kind", ["curves", "surfaces", "grid", "uncertainty"])
async def test_a_stored_table_is_drawn(client: httpx.AsyncClient, ledger: Repository, kind: str) -> None:
    await ledger.save_table(None, TABLE)
    answer = await client.get("/api/v1/tables/1/picture", params={"kind": kind})
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("image/svg+xml")
    ET.fromstring(answer.content)
    picture = await client.get("/api/v1/tables/1/picture", params={"kind": kind, "format": "png"})
    assert picture.headers["content-type"] == "image/png"
    assert picture.content.startswith(PNG)
    assert picture.headers["etag"] != answer.headers["etag"]


async def test_a_picture_the_client_has_is_not_sent_again(client: httpx.AsyncClient, ledger: Repository) -> None:
    await ledger.save_table(None, TABLE)
    path = "/api/v1/tables/1/picture?kind=grid&zoom=0.5&focus=0.3"
    first = await client.get(path)
    tag = first.headers["etag"]
    assert (await client.get(path)).content == first.content
    again = await client.get(path, headers={"If-None-Match": tag})
    assert (again.status_code, again.content) == (304, b"")
    other = await client.get(path.replace("0.5", "0.6"), headers={"If-None-Match": tag})
    assert other.status_code == 200


async def test_two_stored_tables_are_compared_in_a_picture(client: httpx.AsyncClient, ledger: Repository) -> None:
    for table in (TABLE, moved(TABLE)):
        await ledger.save_table(None, table)
    answer = await client.get("/api/v1/tables/1/picture", params={"kind": "comparison", "with": 2})
    assert answer.status_code == 200
    assert "at most 2.000 px apart" in answer.text


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("kind=portrait", "query.kind"),
        ("format=gif", "query.format"),
        ("kind=grid&zoom=2", "query.zoom"),
        ("kind=grid&zoom=nan", "query.zoom"),
        ("kind=grid&zoom=0.9&focus=0.3", "query.zoom"),
        ("kind=curves&focus=0.3", "query.focus"),
        ("kind=comparison", "query.kind"),
        ("kind=grid&with=1", "query.kind"),
        ("kind=comparison&with=0", "query.with"),
    ],
)
async def test_bad_queries(client: httpx.AsyncClient, ledger: Repository, query: str, field: str) -> None:
    await ledger.save_table(None, TABLE)
    problem = assert_problem(await client.get(f"/api/v1/tables/1/picture?{query}"), "invalid")
    assert [error["field"] for error in problem["errors"]] == [field]


async def test_tables_that_cannot_be_drawn(client: httpx.AsyncClient, ledger: Repository) -> None:
    await ledger.save_table(None, replace(lens_table(), sensor_mm=(9.59, 5.39)))
    await ledger.save_table(None, replace(lens_table(), sensor_mm=(24.9, 14.0)))
    assert_problem(await client.get("/api/v1/tables/1/picture?kind=comparison&with=2"), "not-comparable")
    assert_problem(await client.get("/api/v1/tables/9/picture"), "not-found")
    assert_problem(await client.get("/api/v1/tables/1/picture?kind=comparison&with=9"), "not-found")


# The command


def plot(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, ["plot", *(str(word) for word in words)])


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    paths = (tmp_path / "first.json", tmp_path / "second.json")
    for path, table in zip(paths, (TABLE, moved(TABLE)), strict=True):
        path.write_bytes(EXPORTS["json"].write(table))
    return paths


def test_plot_writes_svg_and_png(files: tuple[Path, Path], tmp_path: Path) -> None:
    done = plot(files[0], "--out", tmp_path / "curves.svg")
    assert done.exit_code == 0, done.output
    ET.fromstring((tmp_path / "curves.svg").read_bytes())
    words = ("--kind", "comparison", "--with", files[1], "--out", tmp_path / "apart.PNG", "--json")
    done = plot(files[0], *words)
    assert json.loads(done.stdout) == {"out": str(tmp_path / "apart.PNG"), "kind": "comparison"}
    assert (tmp_path / "apart.PNG").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (("--out", "a.pdf"), 2, "must end in .svg or .png"),
        (("--out", "a.svg", "--zoom", "0.5"), 2, "curves shows the whole table"),
        (("--out", "a.svg", "--kind", "comparison"), 2, "needs a second table"),
        (("--out", "a.svg", "--kind", "grid", "--zoom", "0.9"), 1, "lies outside the table's levels"),
    ],
)
def test_plot_says_what_is_wrong(
    files: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    code: int,
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    done = plot(files[0], *words)
    assert done.exit_code == code
    assert told in done.stderr
    assert not Path(words[1]).exists()
