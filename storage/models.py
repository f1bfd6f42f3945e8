"""The database's tables (sqlmodel), and the types of their columns.

The migrations under ``storage/migrations`` make the same schema; a test compares the two. Documents are kept as JSON
text, so that what was hashed is what is read back; times as ISO 8601 text in UTC, so that they sort and can be read.
"""

from __future__ import annotations

from datetime import UTC, datetime

from sqlalchemy import CheckConstraint, Dialect, Index, Text, UniqueConstraint, text
from sqlalchemy.types import TypeDecorator
from sqlmodel import Field, SQLModel

_RUNNING = text("state IN ('running', 'cancelling')")  # storage.records.RUNNING_STATES, in SQL


class UtcText(TypeDecorator[datetime]):
    """An aware time as text of fixed width, ``2026-11-21T10:00:00.000000Z``."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> str | None:
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("a stored time must say its time zone")
        return value.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")

    def process_result_value(self, value: str | None, dialect: Dialect) -> datetime | None:
        return None if value is None else datetime.fromisoformat(value)


class Lens(SQLModel, table=True):
    """A lens on a camera: what versions of lens tables are counted for."""

    __tablename__ = "lenses"
    __table_args__ = (UniqueConstraint("name", "camera"),)

    id: int | None = Field(default=None, primary_key=True)
    name: str = Field(sa_type=Text)
    camera: str = Field(sa_type=Text)


class Job(SQLModel, table=True):
    """A calibration job. ``number`` counts them in the order of their creation."""

    __tablename__ = "jobs"
    __table_args__ = (Index("one_running_job_per_engine", "engine", unique=True, sqlite_where=_RUNNING),)

    number: int | None = Field(default=None, primary_key=True)
    id: str = Field(sa_type=Text, unique=True)
    state: str = Field(sa_type=Text, index=True)
    engine: str = Field(sa_type=Text)
    lens: str = Field(sa_type=Text)
    request: str = Field(sa_type=Text)
    created: datetime = Field(sa_type=UtcText)
    updated: datetime = Field(sa_type=UtcText)
    reason: str | None = Field(default=None, sa_type=Text)
    idempotency_key: str | None = Field(default=None, sa_type=Text, unique=True)
    body_sha256: str = Field(sa_type=Text)
    last_seq: int = Field(default=0, sa_column_kwargs={"server_default": "0"})


class Level(SQLModel, table=True):
    """A committed level; it never changes, another attempt is another row."""

    __tablename__ = "levels"
    __table_args__ = (
        UniqueConstraint("job_id", "zoom", "focus", "attempt"),
        UniqueConstraint("job_id", "ordinal", "attempt"),
        CheckConstraint("attempt >= 1", name="attempt_counts_from_1"),
    )

    id: int | None = Field(default=None, primary_key=True)
    job_id: str = Field(sa_type=Text, foreign_key="jobs.id")
    ordinal: int
    zoom: float
    focus: float
    attempt: int
    status: str = Field(sa_type=Text)
    result: str = Field(sa_type=Text)
    reason: str | None = Field(default=None, sa_type=Text)


class Evidence(SQLModel, table=True):
    """What a level's numbers rest on: its JSON document, compressed (zlib), and the hash of the text."""

    __tablename__ = "evidence"

    level_id: int = Field(primary_key=True, foreign_key="levels.id")
    document: bytes
    sha256: str = Field(sa_type=Text)


class Event(SQLModel, table=True):
    """What happened to a job, numbered without gaps. Append-only: the database itself refuses a change."""

    __tablename__ = "events"
    __table_args__ = (UniqueConstraint("job_id", "seq"),)

    number: int | None = Field(default=None, primary_key=True)
    job_id: str = Field(sa_type=Text, foreign_key="jobs.id")
    seq: int
    at: datetime = Field(sa_type=UtcText)
    kind: str = Field(sa_type=Text)
    data: str = Field(sa_type=Text)


class Table(SQLModel, table=True):
    """A lens table. A job has at most one; an imported table has no job. The database itself refuses a change."""

    __tablename__ = "tables"
    __table_args__ = (UniqueConstraint("lens_id", "version"),)

    id: int | None = Field(default=None, primary_key=True)
    lens_id: int = Field(foreign_key="lenses.id")
    version: int
    created: datetime = Field(sa_type=UtcText)
    document: str = Field(sa_type=Text)
    job_id: str | None = Field(default=None, sa_type=Text, foreign_key="jobs.id", unique=True)
    sha256: str = Field(sa_type=Text)
    provenance: str | None = Field(default=None, sa_type=Text)


class TableAction(SQLModel, table=True):
    """What was done with a lens table, by whom. Append-only: the database itself refuses a change."""

    __tablename__ = "table_actions"
    __table_args__ = (Index("actions_of_a_lens", "lens_id", "number"),)

    number: int | None = Field(default=None, primary_key=True)
    lens_id: int = Field(foreign_key="lenses.id")
    table_id: int = Field(foreign_key="tables.id")
    kind: str = Field(sa_type=Text)
    replaces_id: int | None = Field(default=None, foreign_key="tables.id")
    at: datetime = Field(sa_type=UtcText)
    who: str | None = Field(default=None, sa_type=Text)
    note: str | None = Field(default=None, sa_type=Text)


class Picture(SQLModel, table=True):
    """A picture of a level, for the operator's eye."""

    __tablename__ = "pictures"
    __table_args__ = (UniqueConstraint("job_id", "ordinal", "kind"),)

    id: int | None = Field(default=None, primary_key=True)
    job_id: str = Field(sa_type=Text, foreign_key="jobs.id")
    ordinal: int
    kind: str = Field(sa_type=Text)
    media_type: str = Field(sa_type=Text)
    data: bytes
