"""The commands that speak to an engine: simulate, doctor, run; on the simulated studio.

As processes of their own where streams, exit codes and signals are what is tested, else in this one, which is faster.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import signal
import socket
import sys
from collections.abc import AsyncIterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from app.cli.commands import cli
from app.cli.simulated import studio_job, studio_profile, true_lens
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
    text = profile_toml(studio_profile(addresses, LENS))
    (folder / "studio.toml").write_text(text, "utf-8")


def write_job(
    folder: Path, addresses: dict[str, Any], at: Sequence[tuple[float, float]] = ((0.5, 0.25),), **changes: Any
) -> Path:
    """A job for these levels, in ``job.json``."""
    document = studio_job(addresses, LENS, at).model_dump(mode="json", exclude_none=True) | changes
    path = folder / "job.json"
    path.write_text(json.dumps(document), "utf-8")
    return path


def invoke(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


@pytest.fixture
def folder(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the commands of this process work and keep their database."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(repository))  # for the simulated studio's process
    monkeypatch.setenv("LENSMATCH_DATABASE", str(tmp_path / "lensmatch.db"))
    monkeypatch.setenv("LENSMATCH_CPU_WORKERS", "1")
    return tmp_path


def reason(done: Result) -> str:
    """The one error line of a command that failed and printed nothing on standard output."""
    assert done.exit_code == 1, done.output
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


@pytest.mark.slow
async def test_doctor_and_run_on_a_studio_that_is_in_order(lensmatch: Any, folder: Path) -> None:
    async with studio(folder) as addresses:
        engine = R3Engine.from_profile(studio_profile(addresses, LENS))
        before = await engine.read_state()
        words = ("doctor", "--studio", "studio.toml", "--measure-delay", "--json")
        told = json.loads((await asyncio.to_thread(invoke, *words)).stdout)
        assert told["ok"] is True, told
        names = [check["name"] for check in told["checks"]]
        assert names[-5:] == ["engine", "tracking", "mockboard", "output", "head"]
        assert all(check["detail"] for check in told["checks"])

        write_job(folder, addresses, engine="studio 1")
        files = ("--out", "table.json", "--report", "report.html")
        done = await lensmatch("run", "job.json", "--studio", "studio.toml", *files, "--json")
        assert done.returncode == 0, done.stderr
        document = json.loads(done.stdout)
        assert document == json.loads((folder / "table.json").read_text("utf-8"))
        table = EXPORTS["json"].read((folder / "table.json").read_bytes())
        assert table.provenance is not None
        assert (table.provenance.source, table.provenance.profile) == ("calibrated", "studio")
        (level,) = table.levels
        assert overlay(true_lens(LENS, 0.5, 0.25), level.lens(LENS.image_size)).max_px < 0.15
        assert "run 100%" in done.stderr
        assert (folder / "report.html").stat().st_size > 10_000
        assert await engine.read_state() == before
        await engine.close()


@pytest.mark.slow
async def test_an_engine_that_dies_in_mid_job_keeps_the_finished_levels(lensmatch: Any) -> None:
    folder = lensmatch.folder
    async with contextlib.AsyncExitStack() as stack:
        addresses = await stack.enter_async_context(studio(folder))
        write_job(folder, addresses, LEVELS)
        words = ("run", "job.json", "--studio", "studio.toml", "--out", "table.json")
        async with lensmatch.started(*words) as process:
            await level_done(process)
            await stack.aclose()
            out, err = await asyncio.wait_for(process.communicate(), BOUND_S)
        assert process.returncode == 1
        assert out == b""
        (line,) = [line for line in err.decode().splitlines() if line.startswith("error: ")]
        assert "finished levels of job" in line
        assert not (folder / "table.json").exists()
        (warning,) = [line for line in err.decode().splitlines() if line.startswith("warning: ")]
        assert "the engine's values could not be put back" in warning
        assert "set by hand what it had: " in warning
        assert " = " in warning
    assert await stored(folder) == (JobState.FAILED, True)


@pytest.mark.slow
@posix_signals
async def test_ctrl_c_cancels_the_job_and_restores_the_engine(lensmatch: Any) -> None:
    folder = lensmatch.folder
    async with studio(folder) as addresses:
        engine = R3Engine.from_profile(studio_profile(addresses, LENS))
        before = await engine.read_state()
        write_job(folder, addresses, LEVELS)
        async with lensmatch.started("run", "job.json", "--studio", "studio.toml") as process:
            await level_done(process)
            process.send_signal(signal.SIGINT)
            out, err = await asyncio.wait_for(process.communicate(), BOUND_S)
        assert process.returncode == 1
        assert out == b""
        (line,) = [line for line in err.decode().splitlines() if line.startswith("error: ")]
        assert line.startswith("error: interrupted; what was finished is kept: job ")
        assert f" in {folder / 'lensmatch.db'}, " in line
        assert re.search(r", [1-4] of 5 levels; the engine has its values back$", line)
        assert "Traceback" not in err.decode()
        assert await engine.read_state() == before
        await engine.close()
    assert await stored(folder) == (JobState.CANCELLED, True)


async def level_done(process: asyncio.subprocess.Process) -> None:
    """Wait until the progress on standard error is past the first of five levels."""
    assert process.stderr is not None
    async with asyncio.timeout(BOUND_S):
        while line := await process.stderr.readline():
            if re.search(rb"level [2-5]/5", line):
                return
    pytest.fail("the command ended before a level was done")


async def stored(folder: Path) -> tuple[JobState, bool]:
    """The state of the one job, and whether it has levels."""
    async with await Repository.open(folder / "lensmatch.db", lambda: datetime.now(UTC)) as repository:
        (job,) = (await repository.list_jobs()).jobs
        return job.state, bool(await repository.list_levels(job.id))


def test_a_target_behind_the_camera_fails_with_its_reason(folder: Path) -> None:
    targets = no_engine()["survey"]["targets"]
    targets["board"]["pose"]["centre_m"] = [0.0, -5.0, 1.6]
    line = reason(invoke("run", write_job(folder, no_engine(), targets=targets)))
    assert "targets.board turns its back to the camera" in line


async def test_a_job_without_a_measured_level_fails_with_its_reason(folder: Path) -> None:
    async with studio(folder) as addresses:
        targets = {"board_large": addresses["survey"]["targets"]["board_large"]}
        write_job(folder, addresses, [(1.0, 0.25)], targets=targets)
        words = ("run", "job.json", "--studio", "studio.toml", "--out", "table.json", "--json")
        done = await asyncio.to_thread(invoke, *words)
    assert done.exit_code == 1
    told = json.loads(done.stdout)
    (level,) = told["levels"]
    assert (level["zoom"], level["focus"]) == (1.0, 0.25)
    assert told["error"] == f"the job failed: no level could be measured: {level['reason']}"
    assert told["error"].count("no target was found") == 1
    assert [line for line in done.stderr.splitlines() if line.startswith("error: ")] == [f"error: {told['error']}"]
    assert not (folder / "table.json").exists()


async def test_a_level_that_fails_is_told_and_kept_as_the_jobs_reason(folder: Path) -> None:
    async with studio(folder) as addresses:
        # At the tele end the large board does not fit the picture, and it is the only one surveyed.
        targets = addresses["survey"]["targets"]
        write_job(folder, addresses, [(0.0, 0.25), (1.0, 0.25)], targets={"board_large": targets["board_large"]})
        done = await asyncio.to_thread(invoke, "run", "job.json", "--studio", "studio.toml", "--json")
    assert done.exit_code == 0, done.stderr
    assert [level["status"] for level in json.loads(done.stdout)["levels"]] == ["ok", "failed"]
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("zoom 1.000, focus 0.25 failed: ")]
    async with await Repository.open(folder / "lensmatch.db", lambda: datetime.now(UTC)) as repository:
        (job,) = (await repository.list_jobs()).jobs
    assert job.state is JobState.DONE
    assert job.reason == f"1 of 2 levels failed: {line.partition(' failed: ')[2]}"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"pixel_aspect": 1.0008},
            "the job's pixel_aspect 1.0008 is not the studio profile's 1 ([picture] pixel_aspect)",
        ),
        ({"image_size": [1280, 720]}, "the job's image_size 1280x720 is not the studio profile's 1920x1080"),
    ],
)
def test_a_job_that_disagrees_with_the_profile_is_not_begun(change: dict[str, Any], told: str, folder: Path) -> None:
    write_profile(folder, no_engine())
    write_job(folder, no_engine(), **change)
    words = ("run", "job.json", "--studio", "studio.toml")
    line = reason(invoke(*words))
    assert told in line
    assert line.endswith("correct one of them")
    assert line == f"error: {json.loads(invoke(*words, '--json').stdout)['error']}"


def test_an_engine_that_is_not_there(folder: Path) -> None:
    write_profile(folder, no_engine())
    write_job(folder, no_engine())
    line = reason(invoke("run", "job.json", "--studio", "studio.toml", "--out", "table.json"))
    assert "R3 at 127.0.0.1:1" in line
    assert "start R3" in line
    assert not (folder / "table.json").exists()
    done = invoke("doctor", "--studio", "studio.toml", "--json")
    assert done.exit_code == 1
    told = json.loads(done.stdout)
    assert told["ok"] is False
    failed = {check["name"]: check for check in told["checks"] if not check["ok"]}
    assert set(failed) == {"engine", "tracking", "mockboard", "head"}
    assert all(check["detail"] and check["advice"] for check in failed.values())
    assert "start R3" in failed["engine"]["advice"]


async def test_an_engine_that_answers_nonsense(folder: Path) -> None:
    async with studio(folder, "--fault", "r3:garbage@*", "--fault", "mockboard:garbage@*") as addresses:
        write_job(folder, addresses)
        done = await asyncio.to_thread(invoke, "run", "job.json", "--studio", "studio.toml")
        assert "R3 at 127.0.0.1" in reason(done)
        done = await asyncio.to_thread(invoke, "doctor", "--studio", "studio.toml", "--json")
        failed = {check["name"] for check in json.loads(done.stdout)["checks"] if not check["ok"]}
        assert done.exit_code == 1
        assert failed == {"engine", "tracking", "mockboard"}


def test_an_operators_head_needs_a_terminal(folder: Path) -> None:
    assert "standard input is no terminal" in reason(invoke("run", write_job(folder, no_engine())))


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
def test_a_bad_job_names_the_field(change: dict[str, Any], told: str, folder: Path) -> None:
    done = invoke("run", write_job(folder, no_engine(), **change))
    assert told in reason(done)
    assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in folder.iterdir()] == ["job.json"]


def test_a_bad_profile_names_the_key(folder: Path) -> None:
    write_job(folder, no_engine())
    (folder / "studio.toml").write_text("[r3]\nprot = 9009\n", "utf-8")
    for words in (("run", "job.json"), ("doctor",)):
        assert "r3.prot: unknown key" in reason(invoke(*words, "--studio", "studio.toml"))
    assert "none.toml" in reason(invoke("doctor", "--studio", "none.toml"))


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


def test_simulate_refuses_what_it_cannot_run_with(folder: Path) -> None:
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
            done = invoke("simulate", *words)
            assert done.exit_code == 1, done.stderr
            assert done.stdout == ""
            assert told in done.stderr
            assert len(done.stderr.splitlines()) == 1
