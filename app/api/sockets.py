"""Event sockets: the events after a given one, then the live ones; nothing lost, nothing twice.

Each socket reads the store by itself, woken by the broker, so that it depends on no other. A client that does not read
fills its own connection's buffer, then its socket is closed; it asks again for the events after the last it has seen.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter
from starlette.websockets import WebSocket, WebSocketDisconnect

from app.api.context import AppContext, Context
from app.api.errors import name_of, one_line
from app.errors import TooManyListeners
from app.events import TERMINAL_KINDS, Wakeups, message
from storage.errors import NotFound, StorageError
from storage.records import UNFINISHED_STATES, EventRecord
from storage.schemas import format_utc

log = logging.getLogger("lensmatch.api")

router = APIRouter()

ENDED = 1000
INTERNAL = 1011
RESTARTING = 1012
TRY_LATER = 1013
NO_SUCH_JOB = 4404
TOO_SLOW = 4408
BAD_AFTER = 4422
CLOSE_CODES: Mapping[int, str] = {
    ENDED: "the job has ended and all its events were sent",
    INTERNAL: "a mistake of the service; its log says what",
    RESTARTING: "the service stops; connect again",
    TRY_LATER: "too many event sockets, or the database is busy; connect again later",
    NO_SUCH_JOB: "there is no such job",
    TOO_SLOW: "the client did not read; connect again with after= the last event seen",
    BAD_AFTER: "after is no whole number from 0, or lies beyond the last event",
}
"""Why a socket is closed by the service."""

_MAX_AFTER_DIGITS = 16
_CLOSE_BOUND_S = 1.0
# A client that reads gets its close frame at once; one that does not, never.


class _Close(Exception):
    """Ends a socket, with a code of :data:`CLOSE_CODES`."""

    def __init__(self, code: int, reason: str) -> None:
        self.code = code
        self.reason = reason
        super().__init__(reason)


@dataclass(slots=True)
class _Cursor:
    """How far a socket is: ``read`` gives the next events, ``place`` their numbers, ``ended`` whether none follow."""

    after: int
    field: str
    read: Callable[[int], Awaitable[Sequence[EventRecord]]]
    ended: Callable[[int], Awaitable[bool]]

    def place(self, record: EventRecord) -> int:
        return record.seq if self.field == "seq" else record.number


@router.websocket("/jobs/{job_id}/events")
async def job_events(socket: WebSocket, job_id: str, context: Context) -> None:
    """The job's events with a higher seq than ``after`` (0: all), then the live ones until the job has ended."""
    repository, batch = context.repository, context.settings.event_batch

    async def read(after: int) -> Sequence[EventRecord]:
        return await repository.events_after(job_id, after, batch)

    async def ended(after: int) -> bool:
        job = await repository.get_job(job_id)
        return job.state not in UNFINISHED_STATES and after >= job.last_seq

    async def cursor() -> _Cursor:
        after, job = _after(socket), await repository.get_job(job_id)
        if after > job.last_seq:
            raise _Close(BAD_AFTER, f"after={after} lies beyond the job's last event, {job.last_seq}")
        return _Cursor(after, "seq", read, ended)

    await _serve(socket, context, job_id, cursor)


@router.websocket("/events")
async def all_events(socket: WebSocket, context: Context) -> None:
    """The events of all jobs with a higher number than ``after`` (0: all), then the live ones, without end."""

    async def read(after: int) -> Sequence[EventRecord]:
        return await context.repository.all_events_after(after, context.settings.event_batch)

    async def ended(after: int) -> bool:
        return False

    async def cursor() -> _Cursor:
        after = _after(socket)
        if after > 0 and not await context.repository.all_events_after(after - 1, 1):
            raise _Close(BAD_AFTER, f"after={after} lies beyond the last event")
        return _Cursor(after, "number", read, ended)

    await _serve(socket, context, None, cursor)


def _after(socket: WebSocket) -> int:
    given = socket.query_params.getlist("after")
    if not given:
        return 0
    text = given[0]
    if len(given) > 1 or not (text.isascii() and text.isdigit() and len(text) <= _MAX_AFTER_DIGITS):
        raise _Close(BAD_AFTER, "after must be one whole number from 0")
    return int(text)


async def _serve(
    socket: WebSocket, context: AppContext, job_id: str | None, cursor: Callable[[], Awaitable[_Cursor]]
) -> None:
    await socket.accept()
    async with asyncio.TaskGroup() as tasks:
        sending = tasks.create_task(_until_closed(socket, context, job_id, cursor))
        leaving = tasks.create_task(_until_gone(socket))
        await asyncio.wait((sending, leaving), return_when=asyncio.FIRST_COMPLETED)
        sending.cancel()
        leaving.cancel()
    if leaving.cancelled() and not sending.cancelled():
        await _close(socket, sending.result())


async def _until_gone(socket: WebSocket) -> None:
    """Return when the client has left. What it says is not listened to."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


async def _until_closed(
    socket: WebSocket, context: AppContext, job_id: str | None, cursor: Callable[[], Awaitable[_Cursor]]
) -> _Close:
    """Send until there is a reason to close."""
    try:
        with context.broker.listen(job_id) as wakeups:
            await _send_events(socket, context, await cursor(), wakeups)
        return _Close(ENDED, "the job has ended")
    except _Close as close:
        return close
    except NotFound as error:
        return _Close(NO_SUCH_JOB, str(error))
    except TooManyListeners as error:
        return _Close(TRY_LATER, str(error))
    except StorageError as error:
        log.error("event socket: %s", error)
        return _Close(TRY_LATER if name_of(error) in ("storage-busy", "storage-full") else INTERNAL, str(error))
    except WebSocketDisconnect:
        return _Close(ENDED, "the client has left")
    except Exception:
        log.exception("event socket")
        return _Close(INTERNAL, CLOSE_CODES[INTERNAL])


async def _send_events(socket: WebSocket, context: AppContext, cursor: _Cursor, wakeups: Wakeups) -> None:
    """Send events until none can follow."""
    settings = context.settings
    if await cursor.ended(cursor.after):
        return
    while True:
        # Cleared before reading: whatever is committed after the read wakes the wait below at once.
        wakeups.clear()
        records = await cursor.read(cursor.after)
        over = False
        for record in records:
            await _send(socket, message(record), settings.send_timeout_s)
            cursor.after = cursor.place(record)
            over = over or record.kind in TERMINAL_KINDS
        if over and await cursor.ended(cursor.after):
            return
        if len(records) >= settings.event_batch or await wakeups.wait(settings.heartbeat_s):
            continue
        if await cursor.ended(cursor.after):
            return
        heartbeat = {"kind": "heartbeat", "at": format_utc(context.now()), cursor.field: cursor.after}
        await _send(socket, heartbeat, settings.send_timeout_s)


async def _send(socket: WebSocket, document: Mapping[str, Any], bound_s: float) -> None:
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    try:
        async with asyncio.timeout(bound_s):
            await socket.send_text(text)
    except TimeoutError:
        raise _Close(TOO_SLOW, CLOSE_CODES[TOO_SLOW]) from None


async def _close(socket: WebSocket, close: _Close) -> None:
    try:
        async with asyncio.timeout(_CLOSE_BOUND_S):
            # A close frame has room for 123 bytes of reason.
            reason = one_line(close.reason).encode("ascii", "replace").decode()[:120]
            await socket.close(close.code, reason)
    except (TimeoutError, WebSocketDisconnect, RuntimeError):
        log.debug("event socket was gone before it could be closed (%d)", close.code)
