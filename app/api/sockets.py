"""Event sockets: the events after a given one, then the live ones; nothing lost, nothing twice.

Each socket keeps its own place, woken by the broker, so that it depends on no other. A client that does not read fills
its own connection's buffer, then its socket is closed; it asks again for the events after the last it has seen.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence

from fastapi import APIRouter
from starlette.websockets import WebSocket, WebSocketDisconnect

from app.api.context import AppContext, Context
from app.api.errors import name_of, one_line
from app.api.tail import EventTail, Told, dumps
from app.errors import TooManyListeners
from app.events import TERMINAL_KINDS, Wakeups
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


class _Follower:
    """How far one socket is: behind, it reads pages from the store by itself; caught up, it shares the tail."""

    def __init__(self, context: AppContext, tail: EventTail, job_id: str | None, after: int) -> None:
        self.after = after
        self.caught_up = False
        self._repository = context.repository
        self._batch = context.settings.event_batch
        self._tail = tail
        self._job_id = job_id
        self._number = after if job_id is None else None

    @property
    def field(self) -> str:
        """By what a client asks for the events after one."""
        return "number" if self._job_id is None else "seq"

    async def check(self) -> None:
        """Refuse what lies beyond the last event: it was never told, so another database must have told it."""
        if self._job_id is not None:
            last = (await self._repository.get_job(self._job_id)).last_seq
            beyond = self.after > last
        else:
            beyond = self.after > 0 and not await self._repository.all_events_after(self.after - 1, 1)
        if beyond:
            raise _Close(BAD_AFTER, f"after={self.after} lies beyond the last event")

    async def newer(self) -> Sequence[Told]:
        """The next events; all there are when ``caught_up`` is true afterwards."""
        if self.caught_up and self._number is not None:
            told = await self._tail.after(self._job_id, self._number)
            if told is not None:
                return told
        if self._job_id is None:
            records = await self._repository.all_events_after(self.after, self._batch)
        else:
            records = await self._repository.events_after(self._job_id, self.after, self._batch)
        self.caught_up = len(records) < self._batch
        return [Told.of(record) for record in records]

    def went_past(self, record: EventRecord) -> None:
        """This event was sent."""
        self.after = record.number if self._job_id is None else record.seq
        self._number = record.number

    async def ended(self) -> bool:
        """Whether no event can follow: the job has ended and everything was sent."""
        if self._job_id is None:
            return False
        job = await self._repository.get_job(self._job_id)
        return job.state not in UNFINISHED_STATES and self.after >= job.last_seq


@router.websocket("/jobs/{job_id}/events")
async def job_events(socket: WebSocket, job_id: str, context: Context) -> None:
    """The job's events with a higher seq than ``after`` (0: all), then the live ones until the job has ended."""
    await _serve(socket, context, job_id)


@router.websocket("/events")
async def all_events(socket: WebSocket, context: Context) -> None:
    """The events of all jobs with a higher number than ``after`` (0: all), then the live ones, without end."""
    await _serve(socket, context, None)


def _after(socket: WebSocket) -> int:
    given = socket.query_params.getlist("after")
    if not given:
        return 0
    text = given[0]
    if len(given) > 1 or not (text.isascii() and text.isdigit() and len(text) <= _MAX_AFTER_DIGITS):
        raise _Close(BAD_AFTER, "after must be one whole number from 0")
    return int(text)


async def _serve(socket: WebSocket, context: AppContext, job_id: str | None) -> None:
    await socket.accept()
    async with asyncio.TaskGroup() as tasks:
        sending = tasks.create_task(_until_closed(socket, context, job_id))
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


async def _until_closed(socket: WebSocket, context: AppContext, job_id: str | None) -> _Close:
    """Send until there is a reason to close."""
    tail: EventTail = socket.app.state.tail
    try:
        with context.broker.listen(job_id) as wakeups:
            follower = _Follower(context, tail, job_id, _after(socket))
            await follower.check()
            await _send_events(socket, context, follower, wakeups)
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
    finally:
        if context.broker.listeners == 0:
            tail.forget()


async def _send_events(socket: WebSocket, context: AppContext, follower: _Follower, wakeups: Wakeups) -> None:
    """Send events until none can follow."""
    settings = context.settings
    if await follower.ended():
        return
    over = False
    while True:
        # Cleared before reading: whatever is committed after the read wakes the wait below at once.
        wakeups.clear()
        for told in await follower.newer():
            await _send(socket, told.text, settings.send_timeout_s)
            follower.went_past(told.record)
            over = over or told.record.kind in TERMINAL_KINDS
        if over and await follower.ended():
            return
        if not follower.caught_up or await wakeups.wait(settings.heartbeat_s):
            continue
        if await follower.ended():
            return
        heartbeat = {"kind": "heartbeat", "at": format_utc(context.now()), follower.field: follower.after}
        await _send(socket, dumps(heartbeat), settings.send_timeout_s)


async def _send(socket: WebSocket, text: str, bound_s: float) -> None:
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
