"""What every kind of job has in common: its subject, its work on a leased engine, and the tools that it works with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

from app.engines import Lease, PictureFacts, ProfileFacts
from app.errors import ServiceError
from app.events import AnyEvent, EventBroker, JobDone, draft
from app.jobs.cpu import Cpu
from storage.repository import Repository

HOME_BOUND_S = 20.0
"""Longest wait for head and lens to go back to where they stood; it is a courtesy, not part of the result."""


@dataclass(frozen=True, slots=True)
class Subject:
    """What a job is about, known before it runs. ``method``: how levels are measured, None for a job that measures
    none; ``levels``: how many are known so far (a plan may add more); ``pictures``: what it says of the engine's
    pictures, which must be what the studio profile says."""

    lens: str
    camera: str
    method: str | None
    levels: int
    pictures: PictureFacts


@dataclass(frozen=True, slots=True)
class Ending:
    """How a job that is done ended: its last event, and what in it went wrong all the same (None: nothing)."""

    event: JobDone
    reason: str | None = None


class JobWorkFailed(ServiceError):
    """A job's work came to nothing. The message is the job's reason: one line."""


@dataclass(frozen=True, slots=True)
class JobTools:
    """What a job works with besides its engine. ``profile``: the studio profile of that, None where nobody knows it."""

    job_id: str
    repository: Repository
    broker: EventBroker
    cpu: Cpu
    now: Callable[[], datetime]
    profile: ProfileFacts | None = None

    async def event(self, event: AnyEvent) -> None:
        """Store an event of the job, then tell that there is one."""
        await self.repository.append_event(self.job_id, draft(event))
        self.notify()

    def notify(self) -> None:
        """Something of the job was committed."""
        self.broker.notify(self.job_id)


class JobWork(Protocol):
    """The work of one job. Made anew for each run; the runner owns queue, states, lease and end."""

    async def run(self, lease: Lease) -> None:
        """Everything that needs the engine. The lease puts the engine's values back when this returns, raises or is
        cancelled, and nothing may be left running then.

        Raises :class:`JobWorkFailed`, or the errors of engines, adapters, calibration and store as they are.
        """
        ...

    async def finish(self) -> Ending:
        """Once the engine is given back: store what the job leaves. Raises as :meth:`run`."""
        ...

    def left(self) -> str:
        """What the job leaves when it is cancelled now, for its reason."""
        ...
