"""What the repository gives back: frozen values, detached from the database."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any

from calibration.tables import LensTable, LevelResult, Provenance

MAX_PAGE = 1000
"""Most rows that one call gives back; a larger limit counts as this one."""

EventDraft = tuple[str, Mapping[str, Any]]
"""An event yet to be numbered and dated: its kind and its data (JSON)."""


class JobState(StrEnum):
    """Where a job stands. Which change is allowed is decided by the app's state machine, not here."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELLING = "cancelling"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


RUNNING_STATES = (JobState.RUNNING, JobState.CANCELLING)
"""In these a job holds its engine, and may commit levels."""

UNFINISHED_STATES = (JobState.QUEUED, *RUNNING_STATES)


class PictureKind(StrEnum):
    """Which picture of a level."""

    REAL = "real"
    VIRTUAL = "virtual"
    BEFORE = "before"
    """The camera's picture with the target as the engine drew it with the values found in it."""
    OVERLAY = "overlay"
    """The same with the engine's own render at the published values."""
    RESIDUALS = "residuals"
    UNCERTAINTY = "uncertainty"


@dataclass(frozen=True, slots=True)
class JobRecord:
    """A job. ``number`` counts jobs in the order of creation; ``last_seq`` is the number of its last event."""

    id: str
    number: int
    state: JobState
    engine: str
    lens: str
    request: Mapping[str, Any]
    created: datetime
    updated: datetime
    reason: str | None
    idempotency_key: str | None
    last_seq: int


@dataclass(frozen=True, slots=True)
class JobPage:
    """Some jobs, newest first; ``next_cursor`` asks for those after them, None at the end."""

    jobs: tuple[JobRecord, ...]
    next_cursor: str | None


@dataclass(frozen=True, slots=True)
class LevelRecord:
    """A committed level; ``ordinal`` is its place in the job's order of levels, ``attempt`` counts from 1."""

    job_id: str
    ordinal: int
    attempt: int
    result: LevelResult


@dataclass(frozen=True, slots=True)
class EventRecord:
    """What happened to a job. ``seq`` counts its events without gaps from 1; ``number`` orders those of all jobs."""

    number: int
    job_id: str
    seq: int
    at: datetime
    kind: str
    data: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class LensRecord:
    """A lens on a camera, the newest version of its tables, and the table that is approved (None: none yet)."""

    id: int
    name: str
    camera: str
    latest_version: int
    approved_table_id: int | None = None


class TableAction(StrEnum):
    """What was done with a stored table. A table's first action says how it came into the store."""

    CALIBRATED = "calibrated"
    """A job made it."""
    IMPORTED = "imported"
    CORRECTED = "corrected"
    """It was made from another table of the store by a correction."""
    APPROVED = "approved"
    """It is the one to use from now on."""
    ROLLED_BACK = "rolled_back"
    """The same, because the one approved after it was taken back."""
    PUBLISHED = "published"
    """It was written to an engine."""


APPROVALS = (TableAction.APPROVED, TableAction.ROLLED_BACK)
"""The table of a lens's last one of these is approved."""


@dataclass(frozen=True, slots=True)
class ActionRecord:
    """An entry of the ledger of table actions. ``number`` orders those of all tables; ``version`` is the table's;
    ``replaces_id``: the table that was approved until then; ``by``: who, as told."""

    number: int
    kind: TableAction
    lens_id: int
    table_id: int
    version: int
    replaces_id: int | None
    at: datetime
    by: str | None
    note: str | None


@dataclass(frozen=True, slots=True)
class TableSummary:
    """A stored lens table without its levels. ``sha256`` is that of its JSON export, in hexadecimal; ``approved``:
    whether it was the approved one of its lens when this was read."""

    id: int
    lens_id: int
    version: int
    created: datetime
    job_id: str | None
    sha256: str
    approved: bool = False
    provenance: Provenance | None = None


@dataclass(frozen=True, slots=True)
class TableRecord:
    """A stored lens table."""

    summary: TableSummary
    table: LensTable


@dataclass(frozen=True, slots=True)
class PictureRecord:
    """A stored picture: an encoded file."""

    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class EvidenceRecord:
    """A level's evidence: its JSON document in UTF-8, and the hash of that, hexadecimal."""

    document: bytes
    sha256: str
