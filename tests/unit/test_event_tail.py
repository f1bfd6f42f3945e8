"""The tail of newest events: shared reads, no gap, nothing twice, whoever is cancelled or fails in between."""

from __future__ import annotations

import asyncio
import random
from datetime import UTC, datetime
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.api.tail import EventTail, Told
from storage.errors import StorageBusy
from storage.records import EventRecord
from storage.repository import Repository

AT = datetime(2026, 11, 21, 10, tzinfo=UTC)


class Ledger:
    """Only what the tail asks of a repository: the events of all jobs, after a moment."""

    def __init__(self, turns: int = 1) -> None:
        self.events: list[EventRecord] = []
        self.reads = 0
        self.failing = False
        self._turns = turns

    def commit(self, job_id: str = "a", text: str = "") -> int:
        number = len(self.events) + 1
        self.events.append(EventRecord(number, job_id, number, AT, "note", {"text": text}))
        return number

    async def all_events_after(self, number: int, limit: int) -> list[EventRecord]:
        self.reads += 1
        found = self.events[number : number + limit]
        for _ in range(self._turns):
            await asyncio.sleep(0)
        if self.failing:
            raise StorageBusy("x.db", 5.0)
        return found


def tail_of(ledger: Ledger, **options: Any) -> EventTail:
    return EventTail(cast(Repository, ledger), **options)


def numbers(told: list[Told] | None) -> list[int] | None:
    return None if told is None else [one.record.number for one in told]


async def test_events_of_one_job_or_of_all() -> None:
    ledger = Ledger()
    tail = tail_of(ledger)
    for job in ("a", "b", "a", "b"):
        ledger.commit(job)
    assert numbers(await tail.after("a", 0)) == [1, 3]
    assert numbers(await tail.after(None, 1)) == [2, 3, 4]
    assert numbers(await tail.after("b", 4)) == []


async def test_many_share_one_read() -> None:
    ledger = Ledger(turns=3)
    tail = tail_of(ledger)
    ledger.commit()
    await tail.after("a", 0)
    ledger.reads = 0
    ledger.commit()
    assert await asyncio.gather(*(tail.after("a", 1) for _ in range(50))) == [await tail.after("a", 1)] * 50
    assert ledger.reads <= 3


async def test_a_read_under_way_is_not_taken_for_a_new_one() -> None:
    """What was committed after a read had begun, and before the next caller came, must be in that caller's answer."""
    ledger = Ledger(turns=5)
    tail = tail_of(ledger)
    ledger.commit()
    early = asyncio.create_task(tail.after("a", 0))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert ledger.reads == 1
    ledger.commit()
    assert numbers(await tail.after("a", 0)) == [1, 2]
    await early


async def test_a_cancelled_reader_leaves_the_others_their_events() -> None:
    ledger = Ledger(turns=5)
    tail = tail_of(ledger)
    ledger.commit()
    reader = asyncio.create_task(tail.after("a", 0))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    others = [asyncio.create_task(tail.after("a", 0)) for _ in range(3)]
    await asyncio.sleep(0)
    reader.cancel()
    assert [numbers(told) for told in await asyncio.gather(*others)] == [[1]] * 3
    assert (await asyncio.gather(reader, return_exceptions=True))[0].__class__ is asyncio.CancelledError


async def test_a_read_that_fails_is_tried_again() -> None:
    ledger = Ledger()
    tail = tail_of(ledger)
    ledger.commit()
    ledger.failing = True
    with pytest.raises(StorageBusy):
        await tail.after("a", 0)
    ledger.failing = False
    assert numbers(await tail.after("a", 0)) == [1]


async def test_the_tail_is_bounded_and_says_where_it_ends() -> None:
    ledger = Ledger()
    tail = tail_of(ledger, kept_bytes=2000)
    await tail.after(None, 0)
    for _ in range(100):
        ledger.commit(text="x" * 100)
    assert await tail.after("a", 0) is None
    kept = numbers(await tail.after("a", 95))
    assert kept == [96, 97, 98, 99, 100]


async def test_a_forgotten_tail_begins_where_it_is_asked() -> None:
    ledger = Ledger()
    tail = tail_of(ledger)
    for _ in range(5000):
        ledger.commit()
    assert numbers(await tail.after("a", 4990)) == list(range(4991, 5001))
    assert await tail.after("a", 10) is None
    tail.forget()
    for _ in range(5000):
        ledger.commit()
    ledger.reads = 0
    assert numbers(await tail.after("a", 9999)) == [10_000]
    assert ledger.reads == 1


async def test_a_long_gap_is_read_in_pages() -> None:
    ledger = Ledger()
    tail = tail_of(ledger)
    await tail.after("a", 0)
    for _ in range(2500):
        ledger.commit()
    assert numbers(await tail.after("a", 0)) == list(range(1, 2501))


@given(seed=st.integers(0, 2**32), readers=st.integers(1, 5), kept=st.integers(200, 3000))
def test_any_interleaving_gives_each_reader_everything_once(seed: int, readers: int, kept: int) -> None:
    rng = random.Random(seed)

    async def scenario() -> None:
        ledger = Ledger(turns=rng.randrange(4))
        tail = tail_of(ledger, kept_bytes=kept)
        total = 30

        async def write() -> None:
            for _ in range(total):
                for _ in range(rng.randrange(4)):
                    await asyncio.sleep(0)
                ledger.commit(rng.choice("ab"))

        async def read(job_id: str | None, writing: asyncio.Task[None]) -> list[int]:
            seen: list[int] = []
            at = 0
            while True:
                over = writing.done()
                told = await tail.after(job_id, at)
                if told is None:
                    records = [e for e in ledger.events[at:] if job_id in (None, e.job_id)]
                else:
                    records = [one.record for one in told]
                seen += [record.number for record in records]
                at = max(seen, default=at)
                if over and not records:
                    return seen
                await asyncio.sleep(0)

        writing = asyncio.create_task(write())
        jobs = [rng.choice(["a", "b", None]) for _ in range(readers)]
        for job_id, seen in zip(jobs, await asyncio.gather(*(read(job, writing) for job in jobs)), strict=True):
            assert seen == [event.number for event in ledger.events if job_id in (None, event.job_id)]

    asyncio.run(scenario())
