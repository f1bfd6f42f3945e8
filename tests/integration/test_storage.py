"""The ledger on real SQLite files: what is committed stays, what is refused leaves no trace."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import sqlite3
from collections.abc import AsyncIterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, LeftOut, LensTable, LevelResult, PixelError
from storage.errors import (
    AlreadyStored,
    EngineBusy,
    IdempotencyConflict,
    NotFound,
    StaleState,
    TooLarge,
)
from storage.exports import EXPORTS
from storage.records import JobRecord, JobState, PictureKind
from storage.repository import MAX_PICTURE_BYTES, Repository
from tests.support.clock import Clock

SIZE = (1920, 1080)
DONE = ("level_done", {"zoom": 0.0})


def level(zoom: float = 0.0, focus: float = 0.5) -> LevelResult:
    error: dict[str, Any] = {name: PixelError(0.1, 0.3) for name in EVIDENCE_QUANTITIES if name != "held_out_px"}
    lens = Lens.from_fov(SIZE, 56.1, -0.12, 0.031, (4.31, -2.7))
    reasons = {"nodal_offset_mm": "one distance only", "held_out_px": "too few pictures"}
    return LevelResult.from_lens(zoom, focus, lens, reasons=reasons, left_out=(LeftOut("a.png", "dark"),), **error)


def table(lens: str = "XA 20x", camera: str = "Cam0") -> LensTable:
    return LensTable(lens, camera, 1, datetime(2026, 11, 21, 10, tzinfo=UTC), SIZE, "joint", (level(),))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lensmatch.db"


@pytest.fixture
async def ledger(path: Path) -> AsyncIterator[Repository]:
    async with await Repository.open(path, Clock()) as opened:
        yield opened


async def running_job(ledger: Repository, engine: str = "r3-a") -> JobRecord:
    job = await ledger.create_job({"zooms": 7}, "XA 20x", engine, event=("job_created", {}))
    return await ledger.set_job_state(job.id, JobState.RUNNING, expected=[JobState.QUEUED], event=("job_started", {}))


# Jobs


async def test_a_job_comes_back_as_it_was_stored(ledger: Repository) -> None:
    request = {"lens": "XA 20x", "zooms": [0.0, 0.1], "note": "é"}
    job = await ledger.create_job(request, "XA 20x", "r3-a", "key-1", ("job_created", {"by": "operator"}))
    assert job == await ledger.get_job(job.id)
    assert (job.state, job.request, job.last_seq, job.reason) == (JobState.QUEUED, request, 1, None)
    assert job.created == datetime(2026, 11, 21, 10, 0, 1, tzinfo=UTC)


async def test_states_change_only_from_the_expected_one(ledger: Repository) -> None:
    job = await running_job(ledger)
    assert (job.state, job.last_seq) == (JobState.RUNNING, 2)
    with pytest.raises(StaleState, match="is running, not queued") as raised:
        await ledger.set_job_state(job.id, JobState.RUNNING, expected=[JobState.QUEUED], event=("again", {}))
    assert (raised.value.actual, raised.value.expected) == ("running", ("queued",))
    failed = await ledger.set_job_state(
        job.id, JobState.FAILED, expected=[JobState.RUNNING, JobState.CANCELLING], reason="the engine died"
    )
    assert (failed.state, failed.reason, failed.last_seq) == (JobState.FAILED, "the engine died", 2)
    assert failed.updated > job.updated


async def test_parallel_posts_with_one_key_make_one_job(ledger: Repository, path: Path) -> None:
    async with await Repository.open(path, Clock()) as other:
        posts = (
            (ledger if number % 2 else other).create_job({"zooms": 7}, "XA 20x", "r3-a", "key", ("job_created", {}))
            for number in range(200)
        )
        jobs = await asyncio.gather(*posts)
    assert len({job.id for job in jobs}) == 1
    async with await Repository.open(path, Clock()) as reopened:
        again = await reopened.create_job({"zooms": 7}, "XA 20x", "r3-a", "key")
        assert (again.id, again.last_seq) == (jobs[0].id, 1)
        assert len((await reopened.list_jobs()).jobs) == 1


@pytest.mark.parametrize(
    ("request_", "lens", "engine"), [({"zooms": 8}, "L", "e"), ({"zooms": 7}, "M", "e"), ({"zooms": 7}, "L", "f")]
)
async def test_the_same_key_with_another_body_is_refused(
    ledger: Repository, request_: dict[str, object], lens: str, engine: str
) -> None:
    job = await ledger.create_job({"zooms": 7, "focuses": 2}, "L", "e", "key")
    assert (await ledger.create_job({"focuses": 2, "zooms": 7}, "L", "e", "key")).id == job.id
    with pytest.raises(IdempotencyConflict) as raised:
        await ledger.create_job(request_, lens, engine, "key")
    assert raised.value.job_id == job.id
    assert (await ledger.create_job({"zooms": 7}, "L", "e")).id != job.id


async def test_one_running_job_per_engine(ledger: Repository, path: Path) -> None:
    queued = [await ledger.create_job({}, "L", "r3-a") for _ in range(6)]
    async with await Repository.open(path, Clock()) as other:
        starts = (
            (ledger if number % 2 else other).set_job_state(job.id, JobState.RUNNING, expected=[JobState.QUEUED])
            for number, job in enumerate(queued)
        )
        results = await asyncio.gather(*starts, return_exceptions=True)
    assert sum(isinstance(result, JobRecord) for result in results) == 1
    assert sum(isinstance(result, EngineBusy) for result in results) == 5
    elsewhere = await running_job(ledger, engine="r3-b")
    assert elsewhere.state is JobState.RUNNING
    winner = next(result for result in results if isinstance(result, JobRecord))
    await ledger.set_job_state(winner.id, JobState.CANCELLING, expected=[JobState.RUNNING])
    with pytest.raises(EngineBusy, match="r3-a"):
        await running_job(ledger)
    await ledger.set_job_state(winner.id, JobState.CANCELLED, expected=[JobState.CANCELLING])
    assert (await running_job(ledger)).state is JobState.RUNNING


async def test_the_database_itself_keeps_two_jobs_off_one_engine(ledger: Repository, path: Path) -> None:
    await running_job(ledger)
    second = await ledger.create_job({}, "L", "r3-a")
    with contextlib.closing(sqlite3.connect(path)) as connection, pytest.raises(sqlite3.IntegrityError):
        connection.execute("UPDATE jobs SET state = 'running' WHERE id = ?", (second.id,))


async def test_jobs_come_in_pages_newest_first(ledger: Repository) -> None:
    made = [(await ledger.create_job({"number": number}, "L", "e")).id for number in range(7)]
    seen: list[str] = []
    cursor = None
    sizes = []
    while True:
        page = await ledger.list_jobs(cursor, limit=3)
        seen += [job.id for job in page.jobs]
        sizes.append(len(page.jobs))
        if page.next_cursor is None:
            break
        cursor = page.next_cursor
        await ledger.create_job({"number": "in between"}, "L", "e")
    assert (seen, sizes) == (made[::-1], [3, 3, 1])
    for nonsense in ("x", "-1", "1" * 40, "²"):
        with pytest.raises(NotFound, match="cursor"):
            await ledger.list_jobs(nonsense)


async def test_a_restart_finds_what_is_unfinished(ledger: Repository) -> None:
    first, second = await running_job(ledger), await ledger.create_job({}, "L", "r3-a")
    third = await running_job(ledger, "r3-b")
    await ledger.set_job_state(third.id, JobState.DONE, expected=[JobState.RUNNING])
    assert [job.id for job in await ledger.unfinished_jobs()] == [first.id, second.id]


# Levels and events


async def test_a_level_and_its_event_are_stored_together(ledger: Repository) -> None:
    job = await running_job(ledger)
    assert await ledger.save_level(job.id, 0, level(), DONE) == 3
    failed = LevelResult.failed(0.5, 0.5, "no target found", seconds=0.2)
    assert await ledger.save_level(job.id, 1, failed, ("level_failed", {"reason": "no target found"})) == 4
    stored = await ledger.list_levels(job.id)
    assert [record.result for record in stored] == [level(), failed]
    assert (await ledger.find_level(job.id, 0.5, 0.5)).ordinal == 1
    events = await ledger.events_after(job.id, 0)
    assert [(event.seq, event.kind) for event in events] == [
        (1, "job_created"),
        (2, "job_started"),
        (3, "level_done"),
        (4, "level_failed"),
    ]
    assert events[3].data == {"reason": "no target found"}
    assert (await ledger.get_job(job.id)).last_seq == 4


async def test_a_committed_level_is_never_changed(ledger: Repository) -> None:
    job = await running_job(ledger)
    await ledger.save_level(job.id, 0, level(), DONE)
    with pytest.raises(AlreadyStored, match="attempt 1"):
        await ledger.save_level(job.id, 0, replace(level(), seconds=9.0), DONE)
    with pytest.raises(AlreadyStored):
        await ledger.save_level(job.id, 0, level(zoom=0.7), DONE)
    assert (await ledger.get_job(job.id)).last_seq == 3
    again = replace(level(), seconds=9.0)
    await ledger.save_level(job.id, 0, again, DONE, attempt=2)
    assert (await ledger.find_level(job.id, 0.0, 0.5)).result == again
    assert [record.attempt for record in await ledger.list_levels(job.id)] == [1, 2]


@pytest.mark.parametrize("state", [JobState.QUEUED, JobState.DONE, JobState.CANCELLED])
async def test_a_level_of_a_job_that_does_not_run_is_refused(ledger: Repository, state: JobState) -> None:
    """A worker that comes late, after its job was cancelled or finished, commits nothing."""
    job = await running_job(ledger)
    await ledger.set_job_state(job.id, state, expected=[JobState.RUNNING])
    with pytest.raises(StaleState, match=f"is {state}, not running or cancelling"):
        await ledger.save_level(job.id, 0, level(), DONE)
    assert await ledger.list_levels(job.id) == []
    assert (await ledger.get_job(job.id)).last_seq == 2


async def test_an_event_that_is_no_json_leaves_no_level(ledger: Repository) -> None:
    job = await running_job(ledger)
    with pytest.raises(ValueError, match="JSON"):
        await ledger.save_level(job.id, 0, level(), ("level_done", {"rms": float("nan")}))
    assert await ledger.list_levels(job.id) == []
    assert await ledger.save_level(job.id, 0, level(), DONE) == 3


async def test_events_of_many_writers_have_no_gaps(ledger: Repository, path: Path) -> None:
    job = await running_job(ledger)
    async with await Repository.open(path, Clock()) as other:
        appends = (
            (ledger if number % 3 else other).append_event(job.id, ("tick", {"n": number})) for number in range(60)
        )
        given = await asyncio.gather(*appends)
    assert sorted(given) == list(range(3, 63))
    assert [event.seq for event in await ledger.events_after(job.id, 0)] == list(range(1, 63))
    assert [event.seq for event in await ledger.events_after(job.id, 10, limit=4)] == [11, 12, 13, 14]
    assert await ledger.events_after(job.id, 62) == []


async def test_events_of_all_jobs_come_in_the_order_of_their_commits(ledger: Repository) -> None:
    first, second = await running_job(ledger, "r3-a"), await running_job(ledger, "r3-b")
    await ledger.append_event(first.id, ("tick", {}))
    events = await ledger.all_events_after(0)
    assert [(event.job_id, event.seq) for event in events] == [
        (first.id, 1),
        (first.id, 2),
        (second.id, 1),
        (second.id, 2),
        (first.id, 3),
    ]
    assert await ledger.all_events_after(events[2].number, limit=1) == [events[3]]


async def test_events_cannot_be_rewritten(ledger: Repository, path: Path) -> None:
    await running_job(ledger)
    with (
        contextlib.closing(sqlite3.connect(path)) as connection,
        pytest.raises(sqlite3.IntegrityError, match="append-only"),
    ):
        connection.execute("UPDATE events SET kind = 'other'")


async def test_a_cancelled_write_is_whole_or_not_at_all(ledger: Repository) -> None:
    job = await running_job(ledger)
    for ordinal in range(20):
        saving = asyncio.create_task(ledger.save_level(job.id, ordinal, level(zoom=ordinal / 20), DONE))
        for _ in range(ordinal % 4):
            await asyncio.sleep(0)
        saving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await saving
    levels = await ledger.list_levels(job.id)
    events = await ledger.events_after(job.id, 2)
    assert len(events) == len(levels)
    assert [event.seq for event in events] == list(range(3, 3 + len(levels)))


# Lens tables and pictures


async def test_versions_count_the_tables_of_a_lens_and_camera(ledger: Repository) -> None:
    job = await running_job(ledger)
    first = await ledger.save_table(job.id, table(), ("table_done", {}))
    imported = await ledger.save_table(None, replace(table(), version=17))
    other = await ledger.save_table(None, table(camera="Cam1"))
    assert [(row.version, row.job_id) for row in (first, imported, other)] == [(1, job.id), (2, None), (1, None)]
    lenses = await ledger.list_lenses()
    assert [(lens.name, lens.camera, lens.latest_version) for lens in lenses] == [
        ("XA 20x", "Cam0", 2),
        ("XA 20x", "Cam1", 1),
    ]
    assert await ledger.list_tables(lenses[0].id) == [imported, first]
    latest = await ledger.latest_table(lenses[0].id)
    assert latest.summary == imported
    assert latest.table == replace(table(), version=2)
    assert (await ledger.get_table(first.id)).table == table()


async def test_a_job_has_one_table_however_often_it_is_saved(ledger: Repository) -> None:
    job = await running_job(ledger)
    assert await ledger.table_of_job(job.id) is None
    first = await ledger.save_table(job.id, table(), ("table_done", {}))
    assert await ledger.save_table(job.id, replace(table(), method="again"), ("table_done", {})) == first
    assert await ledger.table_of_job(job.id) == first
    assert [event.kind for event in await ledger.events_after(job.id, 2)] == ["table_done"]


async def test_the_hash_is_that_of_the_json_export(ledger: Repository) -> None:
    summary = await ledger.save_table(None, table())
    stored = (await ledger.get_table(summary.id)).table
    assert hashlib.sha256(EXPORTS["json"].write(stored)).hexdigest() == summary.sha256


async def test_parallel_saves_give_each_table_its_own_version(ledger: Repository, path: Path) -> None:
    async with await Repository.open(path, Clock()) as other:
        saves = ((ledger if number % 2 else other).save_table(None, table()) for number in range(20))
        versions = [summary.version for summary in await asyncio.gather(*saves)]
    assert sorted(versions) == list(range(1, 21))


async def test_pictures_are_kept_by_level_and_kind(ledger: Repository) -> None:
    job = await running_job(ledger)
    await ledger.save_picture(job.id, 0, PictureKind.REAL, "image/png", b"one")
    await ledger.save_picture(job.id, 0, PictureKind.OVERLAY, "image/jpeg", b"two")
    await ledger.save_picture(job.id, 0, PictureKind.REAL, "image/webp", b"three")
    real = await ledger.get_picture(job.id, 0, PictureKind.REAL)
    assert (real.media_type, real.data) == ("image/webp", b"three")
    assert (await ledger.get_picture(job.id, 0, PictureKind.OVERLAY)).data == b"two"
    with pytest.raises(NotFound, match="virtual picture of level 0"):
        await ledger.get_picture(job.id, 0, PictureKind.VIRTUAL)
    with pytest.raises(TooLarge):
        await ledger.save_picture(job.id, 0, PictureKind.REAL, "image/png", bytes(MAX_PICTURE_BYTES + 1))


async def test_what_is_not_there_is_said_so(ledger: Repository) -> None:
    calls = [
        ledger.get_job("no-such"),
        ledger.set_job_state("no-such", JobState.DONE, expected=[JobState.RUNNING]),
        ledger.save_level("no-such", 0, level(), DONE),
        ledger.list_levels("no-such"),
        ledger.find_level("no-such", 0, 0),
        ledger.append_event("no-such", DONE),
        ledger.events_after("no-such", 0),
        ledger.save_picture("no-such", 0, PictureKind.REAL, "image/png", b""),
        ledger.get_picture("no-such", 0, PictureKind.REAL),
        ledger.save_table("no-such", table()),
        ledger.table_of_job("no-such"),
        ledger.get_table(99),
        ledger.list_tables(99),
        ledger.latest_table(99),
    ]
    for call in calls:
        with pytest.raises(NotFound, match="there is no "):
            await call
