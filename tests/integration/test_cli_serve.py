"""``lensmatch serve`` as a process: its address, a port that is taken, and how it stops."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from app.api.sockets import RESTARTING
from app.cli.commands import cli
from tests.support.service import JOB, assert_problem

BOUND_S = 60.0
STOP_BOUND_S = 15.0
# Longest stop of a service without a job: its grace for open connections, and the store.
pytestmark = pytest.mark.timeout(120)
posix_signals = pytest.mark.skipif(sys.platform == "win32", reason="Windows sends Ctrl-C to whole consoles only")


async def first_document(process: asyncio.subprocess.Process) -> dict[str, Any]:
    """The JSON document that the service prints when it listens."""
    assert process.stdout is not None
    text = b""
    async with asyncio.timeout(BOUND_S):
        while not text.rstrip().endswith(b"}"):
            line = await process.stdout.readline()
            assert line, "the service ended before it listened"
            text += line
    document: dict[str, Any] = json.loads(text)
    return document


@posix_signals
async def test_it_listens_where_it_says_and_stops_on_sigterm_with_an_open_socket(lensmatch: Any) -> None:
    async with lensmatch.started("serve", "--port", "0", "--json") as process:
        told = await first_document(process)
        assert told["pid"] == process.pid
        assert await asyncio.to_thread(Path(told["database"]).is_file)
        async with httpx.AsyncClient(base_url=told["url"], trust_env=False, timeout=10) as client:
            assert (await client.get("/api/v1/healthz")).status_code == 200
            assert (await client.get("/api/v1/readyz")).status_code == 200
            engines = (await client.get("/api/v1/engines")).json()["engines"]
            assert [engine["name"] for engine in engines] == ["default"]
            refused = await client.post("/api/v1/jobs", json=JOB | {"pixel_aspect": 1.0008})
            assert_problem(refused, "studio-mismatch")
            assert "the studio profile's 1 ([picture] pixel_aspect)" in refused.json()["detail"]
            address = told["url"].replace("http://", "ws://") + "/api/v1/events"
            async with connect(address, proxy=None) as events:
                await (await events.ping())
                process.send_signal(signal.SIGTERM)
                with pytest.raises(ConnectionClosed):
                    await asyncio.wait_for(events.recv(), STOP_BOUND_S)
                assert events.close_code == RESTARTING == 1012
                out, err = await asyncio.wait_for(process.communicate(), STOP_BOUND_S)
    assert process.returncode == 0, err.decode()
    assert out == b""
    assert b"Traceback" not in err


@posix_signals
async def test_ctrl_c_stops_it_too_and_the_address_is_said_to_a_person(lensmatch: Any) -> None:
    async with lensmatch.started("serve", "--port", "0") as process:
        line = await asyncio.wait_for(process.stdout.readline(), BOUND_S)
        assert line.startswith(b"Lensmatch listens on http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        _, err = await asyncio.wait_for(process.communicate(), BOUND_S)
    assert process.returncode == 0, err.decode()
    assert b"Traceback" not in err


def test_a_port_already_taken_is_one_line_and_leaves_no_database(tmp_path: Path) -> None:
    database = tmp_path / "new" / "lensmatch.db"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = CliRunner().invoke(cli, ["serve", "--port", str(port), "--database", str(database)])
    assert done.exit_code == 1
    assert done.stdout == ""
    assert done.stderr.startswith(f"error: 127.0.0.1:{port}: cannot listen")
    assert len(done.stderr.splitlines()) == 1
    assert not database.parent.exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--host", "no.such.host.invalid"], "no.such.host.invalid"),
        (["--profile", "none.toml"], "none.toml"),
    ],
)
def test_what_it_cannot_start_with_is_one_line(words: list[str], told: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["serve", "--port", "0", "--database", str(tmp_path / "x.db"), *words])
    assert done.exit_code == 1, done.output
    assert told in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_file_that_is_no_database_is_one_line(tmp_path: Path) -> None:
    database = tmp_path / "lensmatch.db"
    database.write_text("this is no database, but long enough to be looked at as one\n" * 100)
    done = CliRunner().invoke(cli, ["serve", "--port", "0", "--database", str(database)])
    assert done.exit_code == 1, done.output
    assert str(database) in done.stderr
    assert len(done.stderr.splitlines()) == 1
