"""The commands that speak to an engine: simulate, doctor, run; on the simulated studio, as processes of their own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
import sys
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from app.cli.simulated import studio_job, studio_profile, true_lens
from app.documents import JobRequest
from calibration.compare import overlay
from engine_adapters.profile import profile_toml
from engine_adapters.r3.client import R3Engine
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded
from storage.exports import EXPORTS
from storage.records import JobState
from storage.repository import Repository

LENS = load_embedded(embedded_lens_names()[0])
FAST = ("--picture-time-ms", "4", "--head-speed", "2000")
PORTS = ("--r3-port", "0", "--mockboard-port", "0", "--head-port", "0")
LEVELS = [(0.0, 0.25), (0.0, 0.75), (0.5, 0.25), (0.5, 0.75), (1.0, 0.25)]
BOUND_S = 60.0

pytestmark = pytest.mark.timeout(120)
posix_signals = pytest.mark.skipif(sys.platform == "win32", reason="Windows sends Ctrl-C to whole consoles only")


@contextlib.asynccontextmanager
async def studio(folder: Path, *options: str) -> AsyncIterator[dict[str, Any]]:
    """A simulated studio, with its profile in ``studio.toml``."""
    async with launched_studio((*FAST, *options)) as addresses:
        write_profile(folder, addresses)
        yield addresses


def write_profile(folder: Path, addresses: dict[str, Any]) -> None:
    text = profile_toml(studio_profile(addresses, LENS.image_size))
    (folder / "studio.toml").write_text(text, "utf-8")


def write_job(folder: Path, addresses: dict[str, Any], levels: list[tuple[float, float]], **changes: Any) -> JobRequest:
    request = studio_job(addresses, LENS, levels)
    document = request.model_dump(mode="json", exclude_none=True) | changes
    (folder / "job.json").write_text(json.dumps(document), "utf-8")
    return request


def reason(done: Any, code: int = 1) -> str:
    """The one error line of a command that failed with this code and printed nothing on standard output."""
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    lines: list[str] = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    return lines[0]


def no_engine() -> dict[str, Any]:
    """Addresses at which nobody listens, and a room."""
    targets = {"board": {"kind": "chessboard", "squares": [8, 8], "square_m": 0.1, "pose": {"centre_m": [0, 5, 1.6]}}}
    return {
        "r3": {"host": "127.0.0.1", "port": 1},
        "mockboard": {"url": "http://127.0.0.1:1"},
        "head": {"url": "http://127.0.0.1:1"},
        "survey": {"targets": targets, "pivot_m": [0.0, 0.0, 1.6]},
    }


async def test_doctor_and_run_on_a_studio_that_is_in_order(lensmatch: Any) -> None:
    folder = lensmatch.folder
    async with studio(folder) as addresses:
        engine = R3Engine.from_profile(studio_profile(addresses, LENS.image_size))
        before = await engine.read_state()
        told = json.loads((await lensmatch("doctor", "--studio", "studio.toml", "--measure-delay", "--json")).stdout)
        assert told["ok"] is True, told
        names = [check["name"] for check in told["checks"]]
        assert names[-5:] == ["engine", "tracking", "mockboard", "output", "head"]
        assert all(check["detail"] for check in told["checks"])

        write_job(folder, addresses, [(0.5, 0.25)], engine="studio 1")
        words = ("run", "job.json", "--studio", "studio.toml", "--out", "table.json", "--report", "report.html")
        done = await lensmatch(*words, "--json")
        assert done.returncode == 0, done.stderr
        document = json.loads(done.stdout)
        assert document == json.loads((folder / "table.json").read_text("utf-8"))
        (level,) = EXPORTS["json"].read((folder / "table.json").read_bytes()).levels
        assert overlay(true_lens(LENS, 0.5, 0.25), level.lens(LENS.image_size)).max_px < 0.15
        assert "run 100%" in done.stderr
        assert (folder / "report.html").stat().st_size > 10_000
        assert await engine.read_state() == before
        await engine.close()


async def test_an_engine_that_dies_in_mid_job_keeps_the_finished_levels(lensmatch: Any) -> None:
    folder = lensmatch.folder
    async with contextlib.AsyncExitStack() as stack:
        addresses = await stack.enter_async_context(studio(folder))
        write_job(folder, addresses, LEVELS)
        words = ("run", "job.json", "--studio", "studio.toml", "--out", "table.json")
        async with lensmatch.started(*words) as process:
            await level_done(folder)
            await stack.aclose()
            out, err = await asyncio.wait_for(process.communicate(), BOUND_S)
        assert process.returncode == 1
        assert out == b""
        (line,) = [line for line in err.decode().splitlines() if line.startswith("error: ")]
        assert "finished levels of job" in line
        assert not (folder / "table.json").exists()
    assert await stored(folder) == (JobState.FAILED, True)


@posix_signals
async def test_ctrl_c_cancels_the_job_and_restores_the_engine(lensmatch: Any) -> None:
    folder = lensmatch.folder
    async with studio(folder) as addresses:
        engine = R3Engine.from_profile(studio_profile(addresses, LENS.image_size))
        before = await engine.read_state()
        write_job(folder, addresses, LEVELS)
        async with lensmatch.started("run", "job.json", "--studio", "studio.toml") as process:
            await level_done(folder)
            process.send_signal(signal.SIGINT)
            out, err = await asyncio.wait_for(process.communicate(), BOUND_S)
        assert process.returncode == 1
        assert out == b""
        assert "error: interrupted; what was finished is kept" in err.decode()
        assert "Traceback" not in err.decode()
        assert await engine.read_state() == before
        await engine.close()
    assert await stored(folder) == (JobState.CANCELLED, True)


async def level_done(folder: Path) -> None:
    """Wait until the job's first level is stored."""
    async with asyncio.timeout(BOUND_S):
        while not (folder / "lensmatch.db").exists():
            await asyncio.sleep(0.05)
        await asyncio.sleep(1.0)  # the database is being made; a reader must not meet it half migrated
        async with await Repository.open(folder / "lensmatch.db", lambda: datetime.now(UTC)) as repository:
            while True:
                jobs = (await repository.list_jobs()).jobs
                if jobs and await repository.list_levels(jobs[0].id):
                    return
                await asyncio.sleep(0.05)


async def stored(folder: Path) -> tuple[JobState, bool]:
    """The state of the one job, and whether it has levels."""
    async with await Repository.open(folder / "lensmatch.db", lambda: datetime.now(UTC)) as repository:
        (job,) = (await repository.list_jobs()).jobs
        return job.state, bool(await repository.list_levels(job.id))


async def test_a_target_behind_the_camera_fails_with_its_reason(lensmatch: Any) -> None:
    folder = lensmatch.folder
    async with studio(folder) as addresses:
        write_job(folder, addresses, [(0.5, 0.25)], targets=no_engine()["survey"]["targets"])
        document = json.loads((folder / "job.json").read_text("utf-8"))
        document["targets"]["board"]["pose"]["centre_m"] = [0.0, -5.0, 1.6]
        (folder / "job.json").write_text(json.dumps(document), "utf-8")
        line = reason(await lensmatch("run", "job.json", "--studio", "studio.toml", "--out", "table.json"))
        assert "no level could be measured" in line
        assert not (folder / "table.json").exists()


async def test_an_engine_that_is_not_there(lensmatch: Any) -> None:
    folder = lensmatch.folder
    write_profile(folder, no_engine())
    write_job(folder, no_engine(), [(0.5, 0.25)])
    line = reason(await lensmatch("run", "job.json", "--studio", "studio.toml", "--out", "table.json"))
    assert "R3 at 127.0.0.1:1" in line
    assert "start R3" in line
    assert not (folder / "table.json").exists()
    done = await lensmatch("doctor", "--studio", "studio.toml", "--json")
    assert done.returncode == 1
    told = json.loads(done.stdout)
    assert told["ok"] is False
    failed = {check["name"]: check for check in told["checks"] if not check["ok"]}
    assert set(failed) == {"engine", "tracking", "mockboard", "head"}
    assert all(check["detail"] and check["advice"] for check in failed.values())
    assert "start R3" in failed["engine"]["advice"]


async def test_an_engine_that_answers_nonsense(lensmatch: Any) -> None:
    folder = lensmatch.folder
    async with studio(folder, "--fault", "r3:garbage@*", "--fault", "mockboard:garbage@*") as addresses:
        write_job(folder, addresses, [(0.5, 0.25)])
        assert "R3 at 127.0.0.1" in reason(await lensmatch("run", "job.json", "--studio", "studio.toml"))
        done = await lensmatch("doctor", "--studio", "studio.toml", "--json")
        failed = {check["name"] for check in json.loads(done.stdout)["checks"] if not check["ok"]}
        assert done.returncode == 1
        assert failed == {"engine", "tracking", "mockboard"}


async def test_an_operators_head_needs_a_terminal(lensmatch: Any) -> None:
    write_job(lensmatch.folder, no_engine(), [(0.5, 0.25)])
    assert "standard input is no terminal" in reason(await lensmatch("run", "job.json"))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"colour": "red"}, "colour"),
        ({"levels": []}, "levels"),
        ({"levels": [{"zoom": 2.0, "focus": 0.0}]}, "levels.0.zoom"),
        ({"levels": [{"zoom": 0.0, "focus": 0.0}] * 2}, "listed twice"),
        ({"pivot_m": [0.0, float("nan"), 0.0]}, "pivot_m"),
        ({"goal_px": float("inf")}, "goal_px"),
        ({"image_size": [0, 1080]}, "image_size"),
        ({"method": "magic"}, "method"),
        ({"job": 2}, "job"),
    ],
)
def test_a_bad_job_names_the_field(change: dict[str, Any], told: str, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from app.cli.commands import cli

    write_job(tmp_path, no_engine(), [(0.5, 0.25)], **change)
    done = CliRunner().invoke(cli, ["run", str(tmp_path / "job.json"), "--database", str(tmp_path / "x.db")])
    assert done.exit_code == 1
    assert told in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "x.db").exists()


async def test_a_bad_profile_names_the_key(lensmatch: Any) -> None:
    write_job(lensmatch.folder, no_engine(), [(0.5, 0.25)])
    (lensmatch.folder / "studio.toml").write_text("[r3]\nprot = 9009\n", "utf-8")
    for words in (("run", "job.json"), ("doctor",)):
        assert "r3.prot: unknown key" in reason(await lensmatch(*words, "--studio", "studio.toml"))
    assert "none.toml" in reason(await lensmatch("doctor", "--studio", "none.toml"))


@posix_signals
async def test_simulate_prints_its_addresses_and_ends_with_ctrl_c(lensmatch: Any) -> None:
    async with lensmatch.started("simulate", *PORTS) as process:
        line = await asyncio.wait_for(process.stdout.readline(), BOUND_S)
        addresses = json.loads(line)
        assert {"r3", "mockboard", "head", "pid", "lens", "room", "survey"} <= addresses.keys()
        _, writer = await asyncio.open_connection(addresses["r3"]["host"], addresses["r3"]["port"])
        writer.close()
        await writer.wait_closed()
        process.send_signal(signal.SIGINT)
        out, err = await asyncio.wait_for(process.communicate(), BOUND_S)
    assert (process.returncode, out, err) == (0, b"", b"")


async def test_simulate_refuses_what_it_cannot_run_with(lensmatch: Any) -> None:
    folder = lensmatch.folder
    truth = LENS.truth()
    (folder / "folded.json").write_text(json.dumps(truth | {"levels": [{**truth["levels"][0], "k1": -3.0}]}), "utf-8")
    (folder / "broken.json").write_text("{", "utf-8")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for words, told in (
            (("--lens-file", "folded.json", *PORTS), "fold"),
            (("--lens-file", "broken.json", *PORTS), "broken.json"),
            (("--lens-file", "none.json", *PORTS), "none.json"),
            ((*PORTS, "--r3-port", str(port)), f"127.0.0.1:{port}"),
        ):
            done = await lensmatch("simulate", *words)
            assert done.returncode == 1, done.stderr
            assert done.stdout == ""
            assert told in done.stderr
            assert len(done.stderr.splitlines()) == 1
