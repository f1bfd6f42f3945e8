"""What the routes give back, as JSON documents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from app.engines import EngineInfo
from app.events import EventMessage
from app.job_documents import kind_of
from storage.records import ActionRecord, JobRecord, JobState, LensRecord, LevelRecord, TableAction, TableSummary
from storage.schemas import LevelDocument, ProvenanceDocument, level_to_document


class _View(BaseModel):
    model_config = ConfigDict(frozen=True)


class JobView(_View):
    """A job without its levels."""

    id: str
    number: int = Field(description="counts jobs in the order of their creation")
    kind: str = Field(description="what it does: calibrate, publish, recheck")
    state: JobState
    reason: str | None = Field(description="why it failed or was cancelled")
    lens: str
    engine: str
    levels: int = Field(description="how many levels it has to measure, as far as it is known; 0: none")
    created: datetime
    updated: datetime
    last_seq: int = Field(description="seq of its last event")

    @classmethod
    def of(cls, job: JobRecord) -> Self:
        return cls(**_job_fields(job))


class LevelView(_View):
    """A level that has been measured and stored."""

    ordinal: int = Field(description="its place in the job's order of levels, from 0")
    attempt: int = Field(description="counts from 1")
    result: LevelDocument

    @classmethod
    def of(cls, level: LevelRecord) -> Self:
        result = LevelDocument.model_validate(level_to_document(level.result))
        return cls(ordinal=level.ordinal, attempt=level.attempt, result=result)


class JobDetail(JobView):
    """A job with what was asked for and what has come of it so far."""

    request: Mapping[str, Any] = Field(description="the job as it was submitted, defaults filled in")
    results: list[LevelView] = Field(description="the levels stored so far, in the job's order")
    table_id: int | None = Field(description="its lens table, null while it has none")

    @classmethod
    def build(cls, job: JobRecord, levels: Sequence[LevelRecord], table: TableSummary | None) -> Self:
        fields = _job_fields(job)
        planned = len({(level.result.zoom, level.result.focus) for level in levels})
        return cls(
            **{**fields, "levels": max(fields["levels"], planned)},
            request=job.request,
            results=[LevelView.of(level) for level in levels],
            table_id=None if table is None else table.id,
        )


def _job_fields(job: JobRecord) -> dict[str, Any]:
    return {
        "id": job.id,
        "number": job.number,
        "kind": kind_of(job.request),
        "state": job.state,
        "reason": job.reason,
        "lens": job.lens,
        "engine": job.engine,
        "levels": len(job.request.get("levels", ())),
        "created": job.created,
        "updated": job.updated,
        "last_seq": job.last_seq,
    }


class JobsPage(_View):
    """Some jobs, newest first."""

    jobs: list[JobView]
    next_cursor: str | None = Field(description="asks for the jobs after these; null at the end")


class EventList(_View):
    """Some events of a job, oldest first."""

    events: list[EventMessage]
    last_seq: int = Field(description="seq of the last one here; ask for more with after=last_seq")
    more: bool = Field(description="whether there were more when this was read")

    @classmethod
    def build(cls, messages: Sequence[Mapping[str, Any]], after: int, more: bool) -> Self:
        events = [EventMessage.model_validate(message) for message in messages]
        return cls(events=events, last_seq=events[-1].seq if events else after, more=more)


class LensView(_View):
    """A lens on a camera."""

    id: int
    lens: str
    camera: str
    latest_version: int = Field(description="newest version of its tables")
    approved_table_id: int | None = Field(description="the table that is approved; null: none yet")

    @classmethod
    def of(cls, lens: LensRecord) -> Self:
        return cls(
            id=lens.id,
            lens=lens.name,
            camera=lens.camera,
            latest_version=lens.latest_version,
            approved_table_id=lens.approved_table_id,
        )


class LensList(_View):
    """Every lens that has a table."""

    lenses: list[LensView]


class TableView(_View):
    """A stored lens table without its levels."""

    id: int
    lens_id: int
    version: int
    created: datetime
    job_id: str | None = Field(description="the job that made it; null: imported")
    sha256: str = Field(description="of its JSON document, hexadecimal")
    approved: bool = Field(description="whether it is the approved one of its lens; at most one is")
    provenance: ProvenanceDocument | None = Field(description="where it comes from; null: not kept")

    @classmethod
    def of(cls, table: TableSummary) -> Self:
        return cls(
            id=table.id,
            lens_id=table.lens_id,
            version=table.version,
            created=table.created,
            job_id=table.job_id,
            sha256=table.sha256,
            approved=table.approved,
            provenance=None if table.provenance is None else ProvenanceDocument(**asdict(table.provenance)),
        )


class TableList(_View):
    """The tables of a lens, newest first."""

    tables: list[TableView]


class ActionView(_View):
    """Something that was done with a stored table."""

    number: int = Field(description="orders the actions on all tables")
    kind: TableAction
    table_id: int
    version: int = Field(description="of that table")
    replaces_id: int | None = Field(description="the table that was approved until then")
    at: datetime
    by: str | None = Field(description="who, as told")
    note: str | None

    @classmethod
    def of(cls, action: ActionRecord) -> Self:
        return cls(
            number=action.number,
            kind=action.kind,
            table_id=action.table_id,
            version=action.version,
            replaces_id=action.replaces_id,
            at=action.at,
            by=action.by,
            note=action.note,
        )


class ActionList(_View):
    """The history of a table, newest first."""

    actions: list[ActionView]


class EngineView(_View):
    """An engine of this service."""

    name: str
    address: str
    job_id: str | None = Field(description="the job that has it; null: it is free")
    dirty: str | None = Field(description="why its values may not be as they were found; null: they are")

    @classmethod
    def of(cls, engine: EngineInfo) -> Self:
        return cls(name=engine.name, address=engine.address, job_id=engine.job_id, dirty=engine.dirty)


class EngineList(_View):
    """The engines of this service."""

    engines: list[EngineView]


class Health(_View):
    """The service is alive."""

    status: Literal["alive"] = "alive"


class Check(_View):
    """One thing that the service needs."""

    name: str
    detail: str


class Readiness(_View):
    """The service is ready for work."""

    status: Literal["ready"] = "ready"
    checks: list[Check]
