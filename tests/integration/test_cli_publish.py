"""``lensmatch publish`` on the simulated studio: what it prints, its exit codes, and what stays in the engine."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from app.cli.commands import cli
from app.cli.simulated import studio_job, studio_profile, true_lens
from engine_adapters.profile import profile_toml
from engine_adapters.r3.client import R3Engine
from storage.exports import EXPORTS
from tests.integration.test_jobs import ENOUGH_TIME_S, LENS, SURVEY, fast_studio
from tests.integration.test_publish import HERE, LEVELS, flat, table

pytestmark = [pytest.mark.timeout(ENOUGH_TIME_S)]


def invoke(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


@contextlib.asynccontextmanager
async def studio(folder: Path, *options: str) -> AsyncIterator[R3Engine]:
    """A studio with ``studio.toml``, ``job.json`` and ``table.json`` in the folder; gives an adapter to look with."""
    async with fast_studio(folder, *options) as addresses:
        write(folder, addresses)
        engine = R3Engine.from_profile(studio_profile(addresses, LENS))
        try:
            yield engine
        finally:
            await engine.close()


def write(folder: Path, addresses: dict[str, Any]) -> None:
    (folder / "studio.toml").write_text(profile_toml(studio_profile(addresses, LENS)), "utf-8")
    job = studio_job(addresses, LENS, LEVELS).model_dump(mode="json", exclude_none=True)
    (folder / "job.json").write_text(json.dumps(job), "utf-8")
    (folder / "table.json").write_bytes(EXPORTS["json"].write(table()))


@pytest.fixture
def folder(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the command works and keeps its database."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(repository))
    monkeypatch.setenv("LENSMATCH_DATABASE", str(tmp_path / "lensmatch.db"))
    monkeypatch.setenv("LENSMATCH_CPU_WORKERS", "1")
    return tmp_path


async def test_a_table_is_published_and_the_result_printed(folder: Path) -> None:
    place = ("--zoom", str(HERE[0]), "--focus", str(HERE[1]))
    words = ("publish", "table.json", "--studio", "studio.toml", *place)
    async with studio(folder) as engine:
        done = await asyncio.to_thread(invoke, *words, "--room", "job.json", "--all-levels", "--json")
        assert done.exit_code == 0, done.output
        told = json.loads(done.stdout)
        assert (told["published"], told["compared"], told["reason"]) == (True, True, None)
        assert [(at["zoom"], at["focus"]) for at in told["places"]] == [LEVELS[0], LEVELS[2], HERE]
        assert told["render_px"]["max"] == max(at["render_px"]["max"] for at in told["places"]) < 0.15
        assert {value["name"]: value["got"] for value in told["places"][-1]["values"]} == {
            name: value for name, value in (await engine.read_state()).exports if name.startswith("lens.")
        }
        done = await asyncio.to_thread(invoke, *words)
        assert done.exit_code == 0, done.output
        assert "no render was compared" in done.stderr
        assert "lens.fov_x" in done.stdout
        assert flat(await engine.read_lens()) == pytest.approx(flat(true_lens(LENS, *HERE)), rel=1e-9)


async def test_an_engine_that_clips_is_a_failure_with_the_value(folder: Path) -> None:
    async with studio(folder, "--fault", "r3:clip=0.01@*") as engine:
        before = await engine.read_state()
        place = ("--zoom", str(HERE[0]), "--focus", str(HERE[1]))
        done = await asyncio.to_thread(invoke, "publish", "table.json", "--studio", "studio.toml", *place, "--json")
        assert done.exit_code == 1
        told = json.loads(done.stdout)
        assert not told["published"]
        assert "lens.k1 was set to" in told["error"]
        assert [value["name"] for value in told["places"][0]["values"] if not value["same"]] == ["lens.k1", "lens.k2"]
        assert "error: " in done.stderr
        assert await engine.read_state() == before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends Ctrl-C to whole consoles only")
async def test_ctrl_c_gives_the_engine_back(lensmatch: Any) -> None:
    # The output's pictures come late, so that there is time to interrupt.
    async with studio(lensmatch.folder, "--delay-frames", "50") as engine:
        before = await engine.read_state()
        place = ("--zoom", str(HERE[0]), "--focus", str(HERE[1]))
        words = ("publish", "table.json", "--studio", "studio.toml", *place, "--room", "job.json", "--all-levels")
        async with lensmatch.started(*words, "--json") as process:
            async with asyncio.timeout(ENOUGH_TIME_S / 3):
                while await engine.read_state() == before:
                    pass
            process.send_signal(signal.SIGINT)
            out, err = await process.communicate()
        assert process.returncode == 1
        assert "interrupted: cancelled; nothing was published" in json.loads(out)["error"]
        assert "Traceback" not in err.decode()
        assert await engine.read_state() == before


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (("publish", "table.json", "--zoom", "0.5"), 2, "--zoom and --focus are given together"),
        (("publish", "table.json", "--zoom", "0.5", "--focus", "2"), 2, "'--focus': Input should be less"),
        (("publish", "table.json", "--learn"), 2, "--learn needs --room"),
        (("publish", "none.json"), 1, "none.json: no such file"),
        (("publish", "job.json"), 1, 'has no "lens_table" field'),
        (("publish", "table.json", "--room", "table.json"), 1, "table.json: "),
        (("publish", "table.json", "--studio", "studio.toml", "--zoom", "0.5", "--focus", "0.25"), 1, "127.0.0.1:1"),
        (("publish", "table.json", "--room", "job.json"), 1, "standard input is no terminal"),
    ],
)
def test_what_cannot_be_published_is_one_line(folder: Path, words: tuple[str, ...], code: int, told: str) -> None:
    nobody = {"host": "127.0.0.1", "port": 1}
    at = {"url": "http://127.0.0.1:1"}
    write(folder, {"r3": nobody, "mockboard": at, "head": at, "survey": SURVEY})
    done = invoke(*words)
    assert done.exit_code == code, done.output
    assert told in done.stderr
    assert sum(line.startswith("error: ") for line in done.stderr.splitlines()) == 1
