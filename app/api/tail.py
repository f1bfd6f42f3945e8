"""The newest events in memory, read once for all event sockets.

Without it each event is read from the store once for every socket, and the runner's commits wait behind those reads:
with 50 sockets for tenths of a second. The store stays the truth: the tail only holds what was read from it.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from dataclasses import dataclass

from app.events import message
from storage.records import MAX_PAGE, EventRecord
from storage.repository import Repository

KEPT_BYTES = 4 * 1024 * 1024
"""Thousands of usual events; a socket that is further behind reads the store by itself."""


@dataclass(frozen=True, slots=True)
class Told:
    """An event, and the text in which every socket sends it."""

    record: EventRecord
    text: str

    @classmethod
    def of(cls, record: EventRecord) -> Told:
        return cls(record, dumps(message(record)))


def dumps(document: object) -> str:
    """Compact JSON."""
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


class EventTail:
    """Every event with a number in (low, high], without gaps.

    It relies on numbers being given in the order of the commits, which holds where one writer at a time commits
    (SQLite): an event that is read later never has a lower number than one read before.
    """

    def __init__(self, repository: Repository, kept_bytes: int = KEPT_BYTES) -> None:
        self._repository = repository
        self._kept_bytes = kept_bytes
        self._lock = asyncio.Lock()
        self._begun = 0
        self._finished = 0
        self._told: deque[Told] = deque()
        self._size = 0
        self._low: int | None = None
        self._high = 0

    async def after(self, job_id: str | None, number: int) -> list[Told] | None:
        """The events of a job (None: of all) with a higher number, as of now; None: the tail reaches not so far back.

        ``number`` is that of an event that the caller has seen, a recent one. Raises what the store raises.
        """
        if self._low is None:
            self._low = self._high = number
        if number < self._low:
            return None
        await self._read_on()
        if self._low is None or number < self._low:
            return None
        newer = []
        for told in reversed(self._told):
            if told.record.number <= number:
                break
            if job_id is None or told.record.job_id == job_id:
                newer.append(told)
        newer.reverse()
        return newer

    def forget(self) -> None:
        """Hold nothing. For when nobody listens: the next to listen begins anew, without what came between."""
        self._told.clear()
        self._size = 0
        self._low = None

    async def _read_on(self) -> None:
        """Read what was committed before this call; callers that wait together share one read."""
        came = self._begun
        async with self._lock:
            if self._finished > came:
                return  # a read that began after this call has finished meanwhile
            self._begun += 1
            this = self._begun
            while True:
                page = await self._repository.all_events_after(self._high, MAX_PAGE)
                for record in page:
                    self._keep(Told.of(record))
                if len(page) < MAX_PAGE:
                    break
            self._finished = this

    def _keep(self, told: Told) -> None:
        self._told.append(told)
        self._high = told.record.number
        self._size += len(told.text)
        while self._size > self._kept_bytes:
            oldest = self._told.popleft()
            self._size -= len(oldest.text)
            self._low = oldest.record.number
