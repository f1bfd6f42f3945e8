"""Event sockets on a real server: everything once and in order, whoever is slow, cut off, or not welcome."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import socket
import tomllib
from collections.abc import AsyncIterator, Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from fastapi import FastAPI
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from app.api import sockets
from app.api.context import AppContext
from app.documents import JobRequest
from app.engines import EngineInfo
from app.events import EventBroker, JobDone, JobQueued, JobStarted, Note, draft
from app.main import create_app, server_config
from app.settings import Settings
from storage.errors import StorageBusy
from storage.records import JobRecord, JobState
from storage.repository import Repository

BOUND_S = 20.0
"""Far longer than anything here takes: reaching it means that something hangs."""


class NoRunner:
    """These tests write the ledger themselves."""

    async def submit(self, request: JobRequest, *, idempotency_key: str | None = None) -> JobRecord:
        raise AssertionError("watching a job must not submit one")

    async def cancel(self, job_id: str) -> JobRecord:
        raise AssertionError("watching a job must not cancel one")

    def engines(self) -> Sequence[EngineInfo]:
        return ()


class Studio:
    """A service on a real port, and a hand that writes its ledger."""

    def __init__(self, context: AppContext, port: int, server: uvicorn.Server) -> None:
        self.context = context
        self.repository = context.repository
        self.port = port
        self.server = server

    async def job(self) -> str:
        queued = JobQueued(lens="XA 20x", camera="Cam0", engine="default", method="joint", levels=1)
        job = await self.repository.create_job({"levels": [1]}, "XA 20x", "default", event=draft(queued))
        self.context.broker.notify(job.id)
        return job.id

    async def start(self, job_id: str) -> None:
        started = draft(JobStarted(engine="default", levels=1))
        await self.repository.set_job_state(job_id, JobState.RUNNING, expected=[JobState.QUEUED], event=started)
        self.context.broker.notify(job_id)

    async def note(self, job_id: str, text: str = "note") -> None:
        await self.repository.append_event(job_id, draft(Note(text=text)))
        self.context.broker.notify(job_id)

    async def end(self, job_id: str) -> None:
        done = draft(JobDone(table_id=1))
        await self.repository.set_job_state(job_id, JobState.DONE, expected=[JobState.RUNNING], event=done)
        self.context.broker.notify(job_id)

    def connect(self, path: str, **options: Any) -> connect:
        return connect(f"ws://127.0.0.1:{self.port}/api/v1{path}", compression=None, **options)


@contextlib.asynccontextmanager
async def serving(folder: Path, **changes: Any) -> AsyncIterator[Studio]:
    options = {"heartbeat_s": 30.0, "event_batch": 7, "port": 0, "shutdown_timeout_s": 2}
    settings = Settings(database=folder / "lensmatch.db", **{**options, **changes})
    left = asyncio.Event()

    @contextlib.asynccontextmanager
    async def part() -> AsyncIterator[None]:
        yield
        left.set()

    async with await Repository.open(settings.database, lambda: datetime.now(UTC)) as repository:
        broker = EventBroker(settings.event_listeners)
        context = AppContext(settings, repository, NoRunner(), broker, lambda: datetime.now(UTC))
        server = uvicorn.Server(server_config(create_app(context, [part()]), settings))
        with socket.create_server(("127.0.0.1", 0)) as listening:
            task = asyncio.create_task(server.serve([listening]))
            try:
                while not server.started:
                    assert not task.done(), "the server did not start"
                    await asyncio.sleep(0.005)
                yield Studio(context, listening.getsockname()[1], server)
            finally:
                server.should_exit = True
                async with asyncio.timeout(BOUND_S):
                    await task
                assert left.is_set(), "what runs with the service was not left"
                assert broker.listeners == 0, "a listener was kept"


@pytest.fixture(autouse=True)
def _keep_signals(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test run keeps its own signal handlers."""
    monkeypatch.setattr(uvicorn.Server, "capture_signals", lambda self: contextlib.nullcontext())


@pytest.fixture
async def studio(tmp_path: Path) -> AsyncIterator[Studio]:
    async with serving(tmp_path) as opened:
        yield opened


async def received(client: ClientConnection, until: Callable[[dict[str, Any]], bool] | None = None) -> list[Any]:
    """What the socket tells, up to and with the first message that ``until`` names, or to its end."""
    told = []
    async with asyncio.timeout(BOUND_S):
        with contextlib.suppress(ConnectionClosed):
            while True:
                told.append(json.loads(await client.recv()))
                if until is not None and until(told[-1]):
                    break
    return told


def seqs(events: list[Any]) -> list[int]:
    return [event["seq"] for event in events if event["kind"] != "heartbeat"]


def test_trap_5_the_server_has_what_it_needs_to_accept_sockets(repository: Path, tmp_path: Path) -> None:
    """``uvicorn`` by itself answers a socket's request with 404: the package that it needs is a dependency of ours."""
    dependencies = tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))["project"]["dependencies"]
    assert any(dependency.startswith("websockets>=") for dependency in dependencies)
    settings = Settings(database=tmp_path / "lensmatch.db")
    config = server_config(FastAPI(), settings)
    config.load()
    assert config.ws_protocol_class is not None


async def test_replay_then_live_then_a_normal_end(studio: Studio) -> None:
    job = await studio.job()
    for _ in range(20):
        await studio.note(job)
    async with studio.connect(f"/jobs/{job}/events") as client:
        early = await received(client, lambda event: event["seq"] == 21)
        await studio.start(job)
        await studio.note(job)
        await studio.end(job)
        late = await received(client)
    assert seqs(early + late) == list(range(1, 25))
    assert [event["kind"] for event in late] == ["job_started", "note", "job_done"]
    assert all(event["job_id"] == job and event["at"].endswith("Z") for event in early + late)
    assert (client.close_code, client.close_reason) == (sockets.ENDED, "the job has ended")


async def test_an_ended_job_is_told_and_closed(studio: Studio) -> None:
    job = await studio.job()
    await studio.start(job)
    await studio.note(job)
    await studio.end(job)
    for after in (0, 2, 4):
        async with studio.connect(f"/jobs/{job}/events?after={after}") as client:
            told = await received(client)
        assert [event["seq"] for event in told] == list(range(after + 1, 5))
        assert client.close_code == sockets.ENDED


async def test_what_comes_after_the_last_event_is_told_too(studio: Studio) -> None:
    job = await studio.job()
    await studio.start(job)
    for _ in range(4):
        await studio.note(job)
    await studio.end(job)  # the seventh event, the last of the first page
    await studio.note(job, "published later")
    async with studio.connect(f"/jobs/{job}/events") as client:
        assert seqs(await received(client)) == list(range(1, 9))


@pytest.mark.parametrize("name", ["events_after", "all_events_after"])
async def test_an_event_committed_while_a_socket_reads_comes_at_once(
    studio: Studio, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    job = await studio.job()
    plain, late = getattr(Repository, name), True

    async def read(*given: Any) -> Any:
        nonlocal late
        found = await plain(*given)
        if late:
            late = False
            await studio.note(job, "committed after the read, before its answer came")
        return found

    monkeypatch.setattr(Repository, name, read)
    async with studio.connect(f"/jobs/{job}/events") as client:
        await received(client, lambda event: event["seq"] == 1)
        await studio.note(job)
        assert seqs(await received(client, lambda event: event["seq"] == 3)) == [2, 3]


async def test_a_socket_is_idle_while_nothing_happens(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    job = await studio.job()
    reads = 0
    plain = Repository.all_events_after

    async def counted(*given: Any) -> Any:
        nonlocal reads
        reads += 1
        return await plain(*given)

    monkeypatch.setattr(Repository, "all_events_after", counted)
    async with studio.connect(f"/jobs/{job}/events") as client:
        await studio.note(job)
        await received(client, lambda event: event["seq"] == 2)
        await asyncio.sleep(0.1)
    assert reads <= 3


async def test_a_client_cut_off_at_random_points_misses_nothing(studio: Studio) -> None:
    rng = random.Random(20261121)
    job = await studio.job()
    await studio.start(job)

    async def write() -> None:
        for _ in range(60):
            await studio.note(job)
        await studio.end(job)

    async def follow() -> tuple[list[int], int]:
        seen: list[int] = []
        cuts = 0
        while True:
            async with studio.connect(f"/jobs/{job}/events?after={seen[-1] if seen else 0}") as client:
                stop = len(seen) + rng.randrange(1, 8) if cuts < 10 else 10**6
                told = await received(client, lambda event, stop=stop: event["seq"] >= stop)  # type: ignore[misc]
                seen += seqs(told)
                if told and told[-1]["kind"] == "job_done":
                    return seen, cuts
                cuts += 1
                client.transport.abort()

    async with asyncio.timeout(BOUND_S), asyncio.TaskGroup() as tasks:
        tasks.create_task(write())
        following = [tasks.create_task(follow()) for _ in range(3)]
    for task in following:
        seen, cuts = task.result()
        assert cuts > 0
        assert seen == list(range(1, 64))


async def test_events_of_all_jobs_in_one_socket(studio: Studio) -> None:
    first, second = await studio.job(), await studio.job()
    async with studio.connect("/events") as client:
        await studio.note(second, "of the second")
        await studio.note(first, "of the first")
        told = await received(client, lambda event: event["number"] == 4)
    assert [(event["job_id"], event["seq"]) for event in told] == [(first, 1), (second, 1), (second, 2), (first, 2)]
    async with studio.connect("/events?after=3") as client:
        assert [event["number"] for event in await received(client, lambda event: True)] == [4]


async def test_silence_is_filled_with_heartbeats(tmp_path: Path) -> None:
    async with serving(tmp_path, heartbeat_s=0.05) as studio:
        job = await studio.job()
        async with studio.connect(f"/jobs/{job}/events") as client:
            told = [json.loads(await client.recv()) for _ in range(3)]
        assert [event["kind"] for event in told] == ["job_queued", "heartbeat", "heartbeat"]
        assert told[1]["seq"] == 1


async def test_an_event_committed_by_another_process_comes_with_the_heartbeat(tmp_path: Path) -> None:
    async with serving(tmp_path, heartbeat_s=0.05) as studio:
        job = await studio.job()
        async with studio.connect(f"/jobs/{job}/events?after=1") as client:
            await studio.repository.append_event(job, draft(Note(text="nobody notified")))
            told = await received(client, lambda event: event["kind"] == "note")
        assert told[-1]["seq"] == 2


async def test_a_client_that_does_not_read_holds_up_nobody(tmp_path: Path) -> None:
    async with serving(tmp_path, send_timeout_s=0.3) as studio:
        job = await studio.job()
        await studio.start(job)
        big = "x" * 150_000
        raw = socket.create_connection(("127.0.0.1", studio.port))
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with raw:
            raw.setblocking(False)
            request = (
                f"GET /api/v1/jobs/{job}/events HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
                "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
            )
            await asyncio.get_running_loop().sock_sendall(raw, request.encode())
            async with studio.connect(f"/jobs/{job}/events", max_size=None) as client:
                reading = asyncio.create_task(received(client))
                for _ in range(100):  # 15 MB, more than a kernel buffers here
                    await studio.note(job, big)
                async with asyncio.timeout(BOUND_S):
                    while studio.context.broker.listeners > 1:  # noqa: ASYNC110 the broker tells nobody who leaves
                        await asyncio.sleep(0.02)
                await studio.end(job)
                assert seqs(await reading) == list(range(1, 104))


async def test_many_sockets_do_not_read_the_store_many_times(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    reads = 0
    for name in ("events_after", "all_events_after"):
        plain = getattr(Repository, name)

        async def counted(*given: Any, plain: Any = plain) -> Any:
            nonlocal reads
            reads += 1
            return await plain(*given)

        monkeypatch.setattr(Repository, name, counted)
    job = await studio.job()
    await studio.start(job)
    async with contextlib.AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(studio.connect(f"/jobs/{job}/events")) for _ in range(20)]
        for client in clients:
            await received(client, lambda event: event["seq"] == 2)
        before = reads
        for _ in range(10):
            await studio.note(job)
        await studio.end(job)
        for client in clients:
            assert seqs(await received(client)) == list(range(3, 14))
    assert reads - before <= 3 * 11


async def test_sockets_are_bounded(tmp_path: Path) -> None:
    async with serving(tmp_path, event_listeners=2) as studio:
        job = await studio.job()
        path = f"/jobs/{job}/events"
        async with studio.connect(path) as one, studio.connect(path) as two:
            await asyncio.gather(one.recv(), two.recv())
            async with studio.connect(path) as third:
                assert await received(third) == []
            assert third.close_code == sockets.TRY_LATER


NONSENSE = (
    ("/jobs/none/events", sockets.NO_SUCH_JOB),
    ("/jobs/JOB/events?after=-1", sockets.BAD_AFTER),
    ("/jobs/JOB/events?after=x", sockets.BAD_AFTER),
    ("/jobs/JOB/events?after=", sockets.BAD_AFTER),
    ("/jobs/JOB/events?after=1&after=0", sockets.BAD_AFTER),
    ("/jobs/JOB/events?after=99999999999999999999", sockets.BAD_AFTER),
    ("/jobs/JOB/events?after=2", sockets.BAD_AFTER),
    ("/events?after=2", sockets.BAD_AFTER),
    ("/events?after=one", sockets.BAD_AFTER),
)


async def test_sockets_that_make_no_sense_are_closed_with_their_reason(studio: Studio) -> None:
    job = await studio.job()
    for path, code in NONSENSE:
        async with studio.connect(path.replace("JOB", job)) as client:
            assert await received(client) == []
        assert client.close_code == code, path
        assert client.close_reason


async def test_foreign_pages_and_names_get_no_socket(studio: Studio) -> None:
    job = await studio.job()
    own = f"http://127.0.0.1:{studio.port}"
    foreign = [
        "https://evil.example",
        "null",
        f"https://127.0.0.1:{studio.port}",
        "http://127.0.0.1",
        f"{own}.evil.example",
    ]
    for path in (f"/jobs/{job}/events", "/events"):
        for origin in foreign:
            with pytest.raises(InvalidStatus) as refused:
                await studio.connect(path, additional_headers={"Origin": origin})
            assert refused.value.response.status_code == 403
            assert json.loads(refused.value.response.body)["type"] == "urn:lensmatch:problem:origin-refused"
    async with studio.connect("/events", additional_headers={"Origin": own}) as client:
        assert json.loads(await client.recv())["kind"] == "job_queued"
    with pytest.raises(InvalidStatus) as refused:
        await connect(f"ws://evil.example:{studio.port}/api/v1/events", host="127.0.0.1")
    assert refused.value.response.status_code == 400


async def test_what_a_client_says_is_not_listened_to(studio: Studio) -> None:
    job = await studio.job()
    async with studio.connect(f"/jobs/{job}/events") as client:
        for _ in range(50):
            await client.send("x" * 4000)
        await studio.note(job)
        assert seqs(await received(client, lambda event: event["seq"] == 2)) == [1, 2]
        await client.send("x" * 5000)
        await received(client)
    assert client.close_code == 1009


async def test_trouble_with_the_store_closes_the_socket(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    job = await studio.job()

    async def busy(*_: object) -> None:
        raise StorageBusy("x.db", 5.0)

    async def broken(*_: object) -> None:
        raise RuntimeError("the secret")

    for failing, code in ((busy, sockets.TRY_LATER), (broken, sockets.INTERNAL)):
        monkeypatch.setattr(Repository, "events_after", failing)
        async with studio.connect(f"/jobs/{job}/events") as client:
            assert await received(client) == []
        assert client.close_code == code
        assert "secret" not in (client.close_reason or "")


async def test_a_stopping_service_closes_its_sockets(tmp_path: Path) -> None:
    async with serving(tmp_path) as studio:
        job = await studio.job()
        async with studio.connect(f"/jobs/{job}/events") as client:
            await client.recv()
            studio.server.should_exit = True
            assert await received(client) == []
        assert client.close_code == sockets.RESTARTING


async def test_plain_routes_and_sockets_share_their_path(studio: Studio) -> None:
    job = await studio.job()
    async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{studio.port}") as client:
        answer = await client.get(f"/api/v1/jobs/{job}/events")
        assert answer.json()["last_seq"] == 1
        assert "server" not in answer.headers
