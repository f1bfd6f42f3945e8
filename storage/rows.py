"""Rows to records and back: what the repository's transactions are made of. Each function runs inside one."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from datetime import datetime
from typing import Any

from sqlalchemy.orm import defer
from sqlmodel import Session, col, select
from sqlmodel.sql.expression import SelectOfScalar

from calibration.tables import Provenance
from storage import models
from storage.errors import NotFound, StaleState
from storage.exports.json_table import read_json
from storage.records import (
    APPROVALS,
    MAX_PAGE,
    ActionRecord,
    EventDraft,
    EventRecord,
    JobRecord,
    JobState,
    LevelRecord,
    PictureKind,
    TableAction,
    TableRecord,
    TableSummary,
)
from storage.schemas import ProvenanceDocument, document_to_level


def page_limit(limit: int) -> int:
    """How many rows a call gives back that was asked for ``limit``."""
    return max(1, min(limit, MAX_PAGE))


def to_json(value: Mapping[str, Any]) -> str:
    """Canonical JSON: sorted, compact, no NaN (ValueError)."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def find_job(session: Session, job_id: str) -> models.Job:
    """The job's row. Raises :class:`NotFound`."""
    job = session.exec(select(models.Job).where(models.Job.id == job_id)).one_or_none()
    if job is None:
        raise NotFound("job", job_id)
    return job


def require_state(job: models.Job, expected: Collection[JobState]) -> None:
    """Raise :class:`StaleState` unless the job is in one of ``expected``."""
    if JobState(job.state) not in expected:
        raise StaleState(job.id, tuple(state.value for state in expected), job.state)


def append_event(session: Session, job: models.Job, event: EventDraft, at: datetime) -> int:
    """Number an event and add it; gives its seq. The write lock is held, so that no number is given twice."""
    kind, data = event
    job.last_seq += 1
    session.add(models.Event(job_id=job.id, seq=job.last_seq, at=at, kind=kind, data=to_json(dict(data))))
    session.flush()
    return job.last_seq


def find_picture(session: Session, job_id: str, ordinal: int, kind: PictureKind) -> models.Picture | None:
    """The picture's row, None where there is none."""
    query = select(models.Picture).where(
        models.Picture.job_id == job_id, models.Picture.ordinal == ordinal, models.Picture.kind == kind.value
    )
    return session.exec(query).one_or_none()


def lens_id_of(session: Session, name: str, camera: str) -> int:
    """The id of a lens on a camera, made where it is new."""
    lens = session.exec(select(models.Lens).where(models.Lens.name == name, models.Lens.camera == camera)).one_or_none()
    if lens is None:
        lens = models.Lens(name=name, camera=camera)
        session.add(lens)
        session.flush()
    return stored(lens.id)


def require_lens(session: Session, lens_id: int) -> None:
    """Raise :class:`NotFound` unless there is such a lens."""
    if session.get(models.Lens, lens_id) is None:
        raise NotFound("lens", lens_id)


def table_rows() -> SelectOfScalar[models.Table]:
    """A query of tables that leaves their documents in the database."""
    return select(models.Table).options(defer(models.Table.document))  # type: ignore[arg-type]


def stored(number: int | None) -> int:
    """A key that the database has given: never None once a row is flushed."""
    if number is None:
        raise RuntimeError("a row was read before it was flushed")
    return number


def job_record(job: models.Job) -> JobRecord:
    """A job's row as a record."""
    return JobRecord(
        id=job.id,
        number=stored(job.number),
        state=JobState(job.state),
        engine=job.engine,
        lens=job.lens,
        request=json.loads(job.request),
        created=job.created,
        updated=job.updated,
        reason=job.reason,
        idempotency_key=job.idempotency_key,
        last_seq=job.last_seq,
    )


def level_record(level: models.Level) -> LevelRecord:
    """A level's row as a record."""
    return LevelRecord(level.job_id, level.ordinal, level.attempt, document_to_level(json.loads(level.result)))


def event_record(event: models.Event) -> EventRecord:
    """An event's row as a record."""
    return EventRecord(stored(event.number), event.job_id, event.seq, event.at, event.kind, json.loads(event.data))


def approved_table_id(session: Session, lens_id: int) -> int | None:
    """The table of a lens that is approved: that of its last approval or roll back; None before the first."""
    query = select(models.TableAction.table_id).where(
        models.TableAction.lens_id == lens_id, col(models.TableAction.kind).in_([kind.value for kind in APPROVALS])
    )
    return session.exec(query.order_by(col(models.TableAction.number).desc())).first()


def table_summary(row: models.Table, approved_id: int | None) -> TableSummary:
    """A table's row as a summary; ``approved_id``: the approved table of its lens."""
    provenance = None
    if row.provenance is not None:
        provenance = Provenance(**ProvenanceDocument.model_validate_json(row.provenance).model_dump())
    table_id = stored(row.id)
    return TableSummary(
        table_id, row.lens_id, row.version, row.created, row.job_id, row.sha256, table_id == approved_id, provenance
    )


def table_record(row: models.Table, approved_id: int | None) -> TableRecord:
    """A table's row as a record."""
    return TableRecord(table_summary(row, approved_id), read_json(row.document.encode()))


def action_record(row: models.TableAction, version: int) -> ActionRecord:
    """An action's row as a record; ``version``: of its table."""
    return ActionRecord(
        number=stored(row.number),
        kind=TableAction(row.kind),
        lens_id=row.lens_id,
        table_id=row.table_id,
        version=version,
        replaces_id=row.replaces_id,
        at=row.at,
        by=row.who,
        note=row.note,
    )
