"""A killed process loses nothing that it had acknowledged, and leaves nothing half-written."""

from __future__ import annotations

import asyncio
import json
import random
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from storage.records import JobState
from storage.repository import Repository

LEVELS = 40
KILLS = 2

WORKER = """
import asyncio, sys
from datetime import UTC, datetime
from calibration.tables import LevelResult
from storage.records import JobState
from storage.repository import Repository

async def main(path, levels):
    repository = await Repository.open(path, lambda: datetime.now(UTC))
    job = (await repository.unfinished_jobs())[0]
    if job.state is JobState.QUEUED:
        await repository.set_job_state(
            job.id, JobState.RUNNING, expected=[JobState.QUEUED], event=("job_started", {})
        )
    there = {record.ordinal for record in await repository.list_levels(job.id)}
    for ordinal in sorted(set(range(levels)) - there):
        result = LevelResult.failed(ordinal / levels, 0.5, "x" * 3000)
        seq = await repository.save_level(job.id, ordinal, result, ("level_failed", {"ordinal": ordinal}))
        print(ordinal, seq, flush=True)
    await repository.close()

asyncio.run(main(sys.argv[1], int(sys.argv[2])))
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lensmatch.db"


def run_and_kill(path: Path, repository: Path, after: int) -> Iterator[tuple[int, int]]:
    """What a worker acknowledges until it is killed, ``after`` acknowledgements later: pairs of ordinal and seq."""
    command = [sys.executable, "-c", WORKER, str(path), str(LEVELS)]
    with subprocess.Popen(command, cwd=repository, stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        for number, line in enumerate(worker.stdout, start=1):
            ordinal, seq = line.split()
            yield int(ordinal), int(seq)
            if number == after:
                worker.kill()  # SIGKILL, or TerminateProcess on Windows: no handler runs


async def test_kill_9_loses_no_acknowledged_level_and_doubles_none(path: Path, repository: Path) -> None:
    seed = 20261121
    print("seed", seed)  # pytest shows it when the test fails
    kills = random.Random(seed)
    async with await Repository.open(path, lambda: datetime.now(UTC)) as ledger:
        job = await ledger.create_job({}, "XA 20x", "r3-a", event=("job_created", {}))
    acknowledged: dict[int, int] = {}
    for _ in range(KILLS):
        said = await asyncio.to_thread(lambda: list(run_and_kill(path, repository, kills.randint(1, 15))))
        for ordinal, seq in said:
            assert ordinal not in acknowledged, "a committed level was measured again"
            acknowledged[ordinal] = seq
        async with await Repository.open(path, lambda: datetime.now(UTC)) as ledger:
            await ledger.check()
            stored = {record.ordinal for record in await ledger.list_levels(job.id)}
            events = await ledger.events_after(job.id, 0)
            assert acknowledged.keys() <= stored
            assert [event.seq for event in events] == list(range(1, len(events) + 1))
            assert len(events) == 2 + len(stored), "a level without its event, or an event without its level"
            seq_of = {event.data["ordinal"]: event.seq for event in events[2:]}
            assert all(seq_of[ordinal] == seq for ordinal, seq in acknowledged.items())
            assert [open_job.state for open_job in await ledger.unfinished_jobs()] == [JobState.RUNNING]
    assert acknowledged, "no worker came as far as its first level"
    assert len(acknowledged) < LEVELS, "the kills came too late to prove anything"
    # A last worker is left to finish.
    await asyncio.to_thread(lambda: list(run_and_kill(path, repository, after=-1)))
    async with await Repository.open(path, lambda: datetime.now(UTC)) as ledger:
        levels = await ledger.list_levels(job.id)
    assert [record.ordinal for record in levels] == list(range(LEVELS))
    assert json.dumps([record.result.zoom for record in levels]) == json.dumps([n / LEVELS for n in range(LEVELS)])
