"""The ledger: jobs, their levels and events, pictures, and the lens tables of :mod:`storage.table_store`.

What it holds is the truth.

Each method is one transaction. A level and its event are committed together; a committed level or event never
changes. Every method may raise :class:`storage.errors.StorageBusy` (may be tried again), ``StorageFull``,
``DatabaseUnusable``; what else it raises, it says. A cancelled call may still be committed, wholly or not at all.
"""

from __future__ import annotations

import hashlib
import os
import uuid
import zlib
from collections.abc import Callable, Collection, Mapping
from datetime import datetime
from types import TracebackType
from typing import Any

from sqlmodel import Session, col, select

from calibration.tables import LevelResult
from storage import models
from storage.database import Database
from storage.errors import AlreadyStored, EngineBusy, IdempotencyConflict, NotFound, TooLarge
from storage.records import (
    MAX_PAGE,
    RUNNING_STATES,
    UNFINISHED_STATES,
    EventDraft,
    EventRecord,
    EvidenceRecord,
    JobPage,
    JobRecord,
    JobState,
    LevelRecord,
    PictureKind,
    PictureRecord,
)
from storage.rows import (
    append_event,
    event_record,
    find_job,
    find_picture,
    job_record,
    level_record,
    page_limit,
    require_state,
    stored,
    to_json,
)
from storage.schemas import level_to_document
from storage.table_store import TableStore

MAX_PICTURE_BYTES = 32 * 1024 * 1024
"""A lossless 8K picture of noise stays below it."""

MAX_EVIDENCE_BYTES = 32 * 1024 * 1024
"""Packed; a level of 100 pictures with 1,000 points each stays below 8 MiB."""


class Repository(TableStore):
    """The store as the app sees it. ``now`` gives the current time, aware; the repository reads no clock itself."""

    @classmethod
    async def open(cls, url_or_path: str | os.PathLike[str], now: Callable[[], datetime]) -> Repository:
        """Open or make the database; see :meth:`storage.database.Database.open`."""
        return cls(await Database.open(url_or_path, now), now)

    async def close(self) -> None:
        """Release the database. Safe to call twice."""
        await self._database.close()

    async def __aenter__(self) -> Repository:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    @property
    def where(self) -> str:
        """The database file, for messages."""
        return self._database.where

    async def check(self) -> None:
        """Check the whole file (slow on a large one). Raises :class:`storage.errors.DatabaseUnusable` if damaged."""
        await self._database.check()

    # Jobs

    async def create_job(
        self,
        request: Mapping[str, Any],
        lens: str,
        engine: str,
        idempotency_key: str | None = None,
        event: EventDraft | None = None,
    ) -> JobRecord:
        """Store a new job, queued, with its first event. The same key and request again give the job made before.

        Raises :class:`IdempotencyConflict` for the same key with another request.
        """
        body = to_json({"request": dict(request), "lens": lens, "engine": engine})
        digest = hashlib.sha256(body.encode()).hexdigest()
        now = self._now()

        def work(session: Session) -> JobRecord:
            if idempotency_key is not None:
                earlier = session.exec(
                    select(models.Job).where(models.Job.idempotency_key == idempotency_key)
                ).one_or_none()
                if earlier is not None:
                    if earlier.body_sha256 != digest:
                        raise IdempotencyConflict(idempotency_key, earlier.id)
                    return job_record(earlier)
            job = models.Job(
                id=str(uuid.uuid4()),
                state=JobState.QUEUED.value,
                engine=engine,
                lens=lens,
                request=to_json(dict(request)),
                created=now,
                updated=now,
                idempotency_key=idempotency_key,
                body_sha256=digest,
                last_seq=0,
            )
            session.add(job)
            session.flush()
            if event is not None:
                append_event(session, job, event, now)
            return job_record(job)

        return await self._database.write(work)

    async def set_job_state(
        self,
        job_id: str,
        new_state: JobState,
        *,
        expected: Collection[JobState],
        reason: str | None = None,
        event: EventDraft | None = None,
    ) -> JobRecord:
        """Change a job's state if it is one of ``expected``, with its event; ``reason`` None keeps the reason it has.

        Raises :class:`StaleState` when it is in another state, :class:`EngineBusy` when the new state would hold an
        engine that another job holds, :class:`NotFound`.
        """
        now = self._now()

        def work(session: Session) -> JobRecord:
            job = find_job(session, job_id)
            require_state(job, expected)
            if new_state in RUNNING_STATES:
                others = (
                    select(models.Job.id)
                    .where(models.Job.engine == job.engine, models.Job.id != job.id)
                    .where(col(models.Job.state).in_([state.value for state in RUNNING_STATES]))
                )
                if session.exec(others).first() is not None:
                    raise EngineBusy(job.engine)
            job.state = new_state.value
            job.updated = now
            if reason is not None:
                job.reason = reason
            if event is not None:
                append_event(session, job, event, now)
            return job_record(job)

        return await self._database.write(work)

    async def get_job(self, job_id: str) -> JobRecord:
        """One job. Raises :class:`NotFound`."""
        return await self._database.read(lambda session: job_record(find_job(session, job_id)))

    async def list_jobs(self, cursor: str | None = None, limit: int = 50) -> JobPage:
        """Jobs, newest first. ``cursor``: the ``next_cursor`` of the page before. Raises :class:`NotFound` for a cursor
        that was never given out."""
        limit = page_limit(limit)

        def work(session: Session) -> JobPage:
            query = select(models.Job).order_by(col(models.Job.number).desc()).limit(limit + 1)
            if cursor is not None:
                if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
                    raise NotFound("page of jobs with cursor", cursor)
                query = query.where(col(models.Job.number) < int(cursor))
            jobs = [job_record(job) for job in session.exec(query)]
            more = len(jobs) > limit
            return JobPage(tuple(jobs[:limit]), str(jobs[limit - 1].number) if more else None)

        return await self._database.read(work)

    async def unfinished_jobs(self) -> list[JobRecord]:
        """Every job that is queued, running or cancelling, oldest first: what a restart has to take up."""

        def work(session: Session) -> list[JobRecord]:
            states = [state.value for state in UNFINISHED_STATES]
            query = select(models.Job).where(col(models.Job.state).in_(states)).order_by(col(models.Job.number))
            return [job_record(job) for job in session.exec(query)]

        return await self._database.read(work)

    # Levels

    async def save_level(
        self,
        job_id: str,
        ordinal: int,
        result: LevelResult,
        event: EventDraft,
        *,
        attempt: int = 1,
        evidence: str | None = None,
    ) -> int:
        """Commit a level, its event and its evidence (JSON text) in one transaction; gives the event's seq.

        ``ordinal`` is the level's place in the job's order, from 0; ``attempt`` counts from 1. Raises
        :class:`StaleState` when the job is not running (or cancelling), :class:`AlreadyStored`, :class:`TooLarge`,
        :class:`NotFound`.
        """
        now = self._now()
        zoom, focus = float(result.zoom), float(result.focus)
        document = to_json(level_to_document(result))
        packed = None if evidence is None else zlib.compress(evidence.encode())
        sha256 = hashlib.sha256((evidence or "").encode()).hexdigest()
        if packed is not None and len(packed) > MAX_EVIDENCE_BYTES:
            raise TooLarge("the level's evidence", len(packed), MAX_EVIDENCE_BYTES)

        def work(session: Session) -> int:
            job = find_job(session, job_id)
            require_state(job, RUNNING_STATES)
            same_place = (models.Level.zoom == zoom) & (models.Level.focus == focus)
            same = select(models.Level.id).where(
                models.Level.job_id == job_id,
                models.Level.attempt == attempt,
                same_place | (models.Level.ordinal == ordinal),
            )
            if session.exec(same).first() is not None:
                raise AlreadyStored(job_id, zoom, focus, attempt)
            level = models.Level(
                job_id=job_id,
                ordinal=ordinal,
                zoom=zoom,
                focus=focus,
                attempt=attempt,
                status=result.status.value,
                result=document,
                reason=result.reason,
            )
            session.add(level)
            if packed is not None:
                session.flush()
                session.add(models.Evidence(level_id=stored(level.id), document=packed, sha256=sha256))
            job.updated = now
            return append_event(session, job, event, now)

        return await self._database.write(work)

    async def list_levels(self, job_id: str) -> list[LevelRecord]:
        """Every committed level and attempt of a job, in the job's order. Raises :class:`NotFound`."""

        def work(session: Session) -> list[LevelRecord]:
            find_job(session, job_id)
            query = select(models.Level).where(models.Level.job_id == job_id)
            ordered = query.order_by(col(models.Level.ordinal), col(models.Level.attempt))
            return [level_record(level) for level in session.exec(ordered)]

        return await self._database.read(work)

    async def find_level(self, job_id: str, zoom: float, focus: float) -> LevelRecord:
        """The last attempt of the level with exactly these encoder values. Raises :class:`NotFound`."""

        def work(session: Session) -> LevelRecord:
            query = select(models.Level).where(
                models.Level.job_id == job_id, models.Level.zoom == zoom, models.Level.focus == focus
            )
            level = session.exec(query.order_by(col(models.Level.attempt).desc())).first()
            if level is None:
                raise NotFound(f"committed level zoom {zoom:g}, focus {focus:g} in job", job_id)
            return level_record(level)

        return await self._database.read(work)

    async def get_evidence(self, job_id: str, zoom: float, focus: float) -> EvidenceRecord:
        """The evidence of the last attempt of a level. Raises :class:`NotFound`."""

        def work(session: Session) -> EvidenceRecord:
            query = (
                select(models.Evidence)
                .join(models.Level, col(models.Level.id) == col(models.Evidence.level_id))
                .where(models.Level.job_id == job_id, models.Level.zoom == zoom, models.Level.focus == focus)
            )
            row = session.exec(query.order_by(col(models.Level.attempt).desc())).first()
            if row is None:
                raise NotFound(f"evidence of level zoom {zoom:g}, focus {focus:g} in job", job_id)
            return EvidenceRecord(zlib.decompress(row.document), row.sha256)

        return await self._database.read(work)

    # Events

    async def append_event(self, job_id: str, event: EventDraft) -> int:
        """Append an event to a job in whatever state; gives its seq. Raises :class:`NotFound`."""
        now = self._now()
        return await self._database.write(lambda session: append_event(session, find_job(session, job_id), event, now))

    async def events_after(self, job_id: str, seq: int, limit: int = MAX_PAGE) -> list[EventRecord]:
        """The job's events with a higher seq than ``seq`` (0: from the first), in order. Raises :class:`NotFound`."""
        limit = page_limit(limit)

        def work(session: Session) -> list[EventRecord]:
            find_job(session, job_id)
            query = select(models.Event).where(models.Event.job_id == job_id, models.Event.seq > seq)
            return [event_record(event) for event in session.exec(query.order_by(col(models.Event.seq)).limit(limit))]

        return await self._database.read(work)

    async def all_events_after(self, number: int, limit: int = MAX_PAGE) -> list[EventRecord]:
        """Events of all jobs with a higher ``number`` (0: from the first), in the order they were committed."""
        limit = page_limit(limit)

        def work(session: Session) -> list[EventRecord]:
            query = select(models.Event).where(col(models.Event.number) > number)
            found = session.exec(query.order_by(col(models.Event.number)).limit(limit))
            return [event_record(event) for event in found]

        return await self._database.read(work)

    # Pictures

    async def save_picture(self, job_id: str, ordinal: int, kind: PictureKind, media_type: str, data: bytes) -> None:
        """Store a picture of a level (an encoded file), in place of an earlier one of the same kind.

        Raises :class:`TooLarge`, :class:`NotFound`.
        """
        if len(data) > MAX_PICTURE_BYTES:
            raise TooLarge(f"the {kind} picture", len(data), MAX_PICTURE_BYTES)

        def work(session: Session) -> None:
            find_job(session, job_id)
            picture = find_picture(session, job_id, ordinal, kind)
            if picture is None:
                picture = models.Picture(
                    job_id=job_id, ordinal=ordinal, kind=PictureKind(kind).value, media_type=media_type, data=data
                )
            else:
                picture.media_type, picture.data = media_type, data
            session.add(picture)

        await self._database.write(work)

    async def get_picture(self, job_id: str, ordinal: int, kind: PictureKind) -> PictureRecord:
        """A picture of a level. Raises :class:`NotFound`."""

        def work(session: Session) -> PictureRecord:
            picture = find_picture(session, job_id, ordinal, kind)
            if picture is None:
                raise NotFound(f"{kind} picture of level {ordinal} in job", job_id)
            return PictureRecord(picture.media_type, picture.data)

        return await self._database.read(work)
