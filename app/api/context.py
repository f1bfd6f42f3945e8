"""What the routes work with: handed to :func:`app.main.create_app`, reached by a dependency, never global."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Protocol

from fastapi import Depends
from starlette.requests import HTTPConnection

from app.engines import EngineInfo
from app.events import EventBroker
from app.job_documents import AnyJob
from app.settings import Settings
from storage.records import JobRecord
from storage.repository import Repository

PREFIX = "/api/v1"


class Runner(Protocol):
    """Runs jobs. The ledger has what became of them; a call that was cancelled may still have taken effect."""

    async def submit(self, request: AnyJob, *, idempotency_key: str | None = None) -> JobRecord:
        """Store a job and queue it; the same key and request again give the job made before.

        Raises :class:`app.engines.UnknownEngine`, :class:`app.errors.QueueFull`,
        :class:`storage.errors.IdempotencyConflict`, :class:`storage.errors.NotFound` for a table that it names.
        """
        ...

    async def cancel(self, job_id: str) -> JobRecord:
        """End a job at once; one that has ended is left as it is. Raises :class:`storage.errors.NotFound`."""
        ...

    def engines(self) -> Sequence[EngineInfo]:
        """The engines, and who has them."""
        ...


@dataclass(frozen=True, slots=True)
class AppContext:
    """The parts of the service. ``now`` gives the current time, aware."""

    settings: Settings
    repository: Repository
    runner: Runner
    broker: EventBroker
    now: Callable[[], datetime]


def context_of(connection: HTTPConnection) -> AppContext:
    """The context of the app that answers this request or socket."""
    context: AppContext = connection.app.state.context
    return context


Context = Annotated[AppContext, Depends(context_of)]
