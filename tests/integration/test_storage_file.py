"""The database file: how it is set up, what it refuses to touch, and what happens when disk or lock fail."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sqlite3
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from sqlalchemy.exc import IntegrityError
from sqlmodel import Session

from calibration.tables import LevelResult
from storage import database, models
from storage.errors import DatabaseUnusable, StorageBusy, StorageError, StorageFull
from storage.records import JobRecord, JobState, PictureKind
from storage.repository import MAX_PICTURE_BYTES, Repository

FAILED = LevelResult.failed(0.0, 0.5, "no target found")
EVENT = ("level_failed", {"reason": "no target found"})


def now() -> datetime:
    return datetime(2026, 11, 21, 10, 0, 0, tzinfo=UTC)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lensmatch.db"


@pytest.fixture
async def ledger(path: Path) -> AsyncIterator[Repository]:
    async with await Repository.open(path, now) as opened:
        yield opened


def overwrite_last_pages(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-8 * 4096 :] = b"\x55" * (8 * 4096)
    path.write_bytes(content)


async def running_job(ledger: Repository) -> JobRecord:
    job = await ledger.create_job({"zooms": 7}, "XA 20x", "r3-a", event=("job_created", {}))
    return await ledger.set_job_state(job.id, JobState.RUNNING, expected=[JobState.QUEUED], event=("job_started", {}))


async def test_the_file_is_set_up_to_survive(ledger: Repository) -> None:
    def settings(session: Session) -> list[object]:
        names = ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        return [session.connection().exec_driver_sql(f"PRAGMA {name}").scalar() for name in names]

    assert await ledger._database.read(settings) == ["wal", 2, 1, 5000]


async def test_a_reference_to_nothing_is_refused(ledger: Repository) -> None:
    def stray(session: Session) -> None:
        session.add(models.Picture(job_id="no-such", ordinal=0, kind="real", media_type="image/png", data=b""))

    with pytest.raises(StorageError, match="FOREIGN KEY") as raised:
        await ledger._database.write(stray)
    assert isinstance(raised.value.__cause__, IntegrityError)


async def test_a_closed_store_says_so(path: Path) -> None:
    ledger = await Repository.open(path, now)
    await ledger.close()
    await ledger.close()
    with pytest.raises(StorageError, match="closed"):
        await ledger.list_jobs()


async def test_urls_and_new_folders_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder, with 100% room" / "l.db"
    async with await Repository.open(f"sqlite:///{path.as_posix()}", now) as ledger:
        assert ledger.where == str(path)
    assert path.exists()


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("postgresql://user:secret@host/db", "only SQLite files"),
        ("sqlite://", "only SQLite files"),
        ("sqlite:///:memory:", "only SQLite files"),
        ("://", "address cannot be read"),
    ],
)
async def test_other_databases_are_refused(address: str, words: str) -> None:
    with pytest.raises(DatabaseUnusable, match=words) as raised:
        await Repository.open(address, now)
    assert "secret" not in str(raised.value)


async def test_files_that_are_no_database_of_ours_are_left_alone(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("not a database, and long enough to look at" * 40)
    foreign = tmp_path / "foreign.db"
    with contextlib.closing(sqlite3.connect(foreign)) as connection, connection:
        connection.execute("CREATE TABLE recipes (name TEXT)")
    for path, words in ((text, "is not an SQLite database"), (foreign, "another program"), (tmp_path, "is a folder")):
        before = path.read_bytes() if path.is_file() else b""
        with pytest.raises(DatabaseUnusable, match=words):
            await Repository.open(path, now)
        assert not path.is_file() or path.read_bytes() == before
    with pytest.raises(DatabaseUnusable, match="cannot be opened for writing"):
        await Repository.open(text / "below.db", now)


async def test_damage_is_found(path: Path) -> None:
    async with await Repository.open(path, now) as ledger:
        job = await running_job(ledger)
        for number in range(50):
            await ledger.append_event(job.id, ("tick", {"text": "x" * 1000, "n": number}))
        await ledger.check()
    overwrite_last_pages(path)
    with pytest.raises(DatabaseUnusable, match="damaged"):
        async with await Repository.open(path, now) as ledger:
            await ledger.check()


async def test_a_full_disk_keeps_what_is_there_and_work_goes_on(ledger: Repository) -> None:
    job = await running_job(ledger)

    async def allow_pages(count: int) -> None:
        def work(session: Session) -> None:
            session.connection().exec_driver_sql(f"PRAGMA max_page_count = {count}")

        await ledger._database.read(work)

    await allow_pages(1)
    with pytest.raises(StorageFull, match="free some space"):
        await ledger.save_picture(job.id, 0, PictureKind.REAL, "image/png", bytes(100_000))
    assert (await ledger.get_job(job.id)).last_seq == 2
    await allow_pages(100_000)
    await ledger.check()
    await ledger.save_picture(job.id, 0, PictureKind.REAL, "image/png", bytes(100_000))
    assert await ledger.save_level(job.id, 0, FAILED, EVENT) == 3


async def test_a_database_held_by_another_process_is_waited_for_within_a_bound(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "BUSY_TIMEOUT_S", 0.05)
    async with await Repository.open(path, now) as ledger:
        job = await running_job(ledger)
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(StorageBusy, match=r"more than 0\.05 s"):
                await ledger.append_event(job.id, ("tick", {}))
            assert (await ledger.get_job(job.id)).last_seq == 2
            other.execute("ROLLBACK")
        assert await ledger.append_event(job.id, ("tick", {})) == 3


async def test_the_event_loop_stays_free_while_the_disk_works(ledger: Repository) -> None:
    job = await running_job(ledger)
    saving = asyncio.create_task(
        ledger.save_picture(job.id, 0, PictureKind.REAL, "image/png", bytes(MAX_PICTURE_BYTES))
    )
    turns = 0
    while not saving.done():
        await asyncio.sleep(0)
        turns += 1
    await saving
    assert turns > 10, "the loop did not turn while 32 MiB were written"


async def test_stored_json_is_plain_json(ledger: Repository, path: Path) -> None:
    job = await running_job(ledger)
    await ledger.save_level(job.id, 0, FAILED, EVENT)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        (result,) = connection.execute("SELECT result FROM levels").fetchone()
    assert json.loads(result)["reason"] == "no target found"
