"""The job runner: queued jobs run one after another on each engine. Queue, states, leases and ends; not the work."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime

from pydantic import ValidationError

from app.documents import one_line
from app.engines import EngineError, EngineInfo, Engines, Lease
from app.errors import QueueFull
from app.events import (
    AnyEvent,
    EngineDirty,
    EngineRestored,
    EventBroker,
    JobCancelled,
    JobCancelling,
    JobFailed,
    JobStarted,
    draft,
)
from app.job_documents import CALIBRATE, AnyJob, kind_of, parse_job
from app.jobs.cpu import Cpu
from app.jobs.kinds import STOPPED, queued, subject_of, work_of
from app.jobs.state import sources
from app.jobs.work import JobTools, JobWork, JobWorkFailed
from calibration.errors import CalibrationError
from engine_adapters.errors import AdapterError
from storage.errors import StaleState, StorageError
from storage.records import JobRecord, JobState
from storage.repository import Repository

log = logging.getLogger("lensmatch.jobs")


@dataclass(slots=True)
class _Worker:
    queue: asyncio.Queue[str] = field(default_factory=asyncio.Queue)
    loop: asyncio.Task[None] | None = None
    job_id: str | None = None
    job: asyncio.Task[None] | None = None


def _stopped(job: JobRecord) -> str:
    return f"the service stopped while the job ran; {STOPPED.get(kind_of(job.request), STOPPED[CALIBRATE])}"


class JobRunner:
    """Owns one worker task per engine. Start it with ``async with``; leaving ends what runs and keeps what is done."""

    def __init__(
        self,
        repository: Repository,
        engines: Engines,
        broker: EventBroker,
        cpu: Cpu,
        now: Callable[[], datetime],
        *,
        queue_limit: int = 100,
        retry_after_s: int = 30,
    ) -> None:
        self._repository = repository
        self._engines = engines
        self._broker = broker
        self._cpu = cpu
        self._now = now
        self._queue_limit = queue_limit
        self._retry_after_s = retry_after_s
        self._workers: dict[str, _Worker] = {}

    async def start(self) -> None:
        """Take up what an earlier run left: queued jobs wait again, running ones are failed with their levels kept."""
        for name in self._engines.names():
            worker = _Worker()
            worker.loop = asyncio.create_task(self._work(worker), name=f"jobs of engine {name}")
            self._workers[name] = worker
        for job in await self._repository.unfinished_jobs():
            if job.state is JobState.QUEUED and job.engine in self._workers:
                self._workers[job.engine].queue.put_nowait(job.id)
            else:
                await self._fail(job.id, _stopped(job))

    async def close(self) -> None:
        """End the running jobs (engine restored, finished levels kept) and the workers."""
        for worker in self._workers.values():
            if worker.loop is not None:
                worker.loop.cancel()
        loops = [w.loop for w in self._workers.values() if w.loop is not None]
        await asyncio.gather(*loops, return_exceptions=True)
        self._workers.clear()

    async def __aenter__(self) -> JobRunner:
        await self.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    def engines(self) -> list[EngineInfo]:
        """The engines as clients see them."""
        return self._engines.infos()

    async def submit(self, request: AnyJob, *, idempotency_key: str | None = None) -> JobRecord:
        """Store a job and queue it.

        Raises UnknownEngine, StudioMismatch, QueueFull, IdempotencyConflict, NotFound (for a table that it names).
        """
        self._engines.require(request.engine)
        about = await subject_of(request, self._repository)
        self._engines.require_pictures(request.engine, about.pictures)
        worker = self._workers[request.engine]
        if sum(w.queue.qsize() for w in self._workers.values()) >= self._queue_limit:
            raise QueueFull(self._queue_limit, self._retry_after_s)
        body = request.model_dump(mode="json")
        event = queued(request, about)
        record = await self._repository.create_job(body, about.lens, request.engine, idempotency_key, draft(event))
        if record.state is JobState.QUEUED and record.last_seq == 1:
            worker.queue.put_nowait(record.id)
        self._broker.notify(record.id)
        return record

    async def cancel(self, job_id: str) -> JobRecord:
        """End a job at once; a job that has ended is left as it is. Raises NotFound."""
        while True:
            try:
                return await self._cancel(job_id)
            except StaleState:
                # It began or ended between the look and the change; each state is left once, so this ends.
                continue

    async def _cancel(self, job_id: str) -> JobRecord:
        record = await self._repository.get_job(job_id)
        if record.state is JobState.QUEUED:
            return await self._change(job_id, JobState.CANCELLED, "cancelled before it began", JobCancelled())
        if record.state is not JobState.RUNNING:
            return record
        record = await self._change(job_id, JobState.CANCELLING, None, JobCancelling())
        for worker in self._workers.values():
            if worker.job_id == job_id and worker.job is not None:
                worker.job.cancel()
        return record

    async def _work(self, worker: _Worker) -> None:
        while True:
            job_id = await worker.queue.get()
            worker.job_id = job_id
            worker.job = asyncio.create_task(self._run(job_id), name=f"job {job_id}")
            try:
                await asyncio.wait([worker.job])
            finally:
                if not worker.job.done():
                    worker.job.cancel()
                    await asyncio.wait([worker.job])
                worker.job_id = worker.job = None

    async def _run(self, job_id: str) -> None:
        """One job from queued to its end; every way out leaves a terminal state and its event."""
        work: JobWork | None = None
        try:
            record = await self._repository.get_job(job_id)
            if record.state is not JobState.QUEUED:
                return  # cancelled while it waited
            try:
                request = parse_job(record.request)
            except ValidationError as error:
                # Queued under rules that another version has made stricter.
                await self._fail(job_id, f"the stored job is refused: {one_line(error)}; correct it and send it again")
                return
            # Asked again: it may have waited through a restart, and the profile may have been changed meanwhile.
            about = await subject_of(request, self._repository)
            self._engines.require_pictures(request.engine, about.pictures)
            started = JobStarted(engine=request.engine, levels=about.levels)
            await self._change(job_id, JobState.RUNNING, None, started)
            tools = JobTools(
                job_id, self._repository, self._broker, self._cpu, self._now, self._engines.profile(request.engine)
            )
            work = work_of(request, tools)
            await self._on_engine(request.engine, work, tools)
            ending = await work.finish()
            await self._change(job_id, JobState.DONE, ending.reason, ending.event)
        except asyncio.CancelledError:
            await self._end_cancelled(job_id, work)
            raise
        except (AdapterError, EngineError, JobWorkFailed, CalibrationError) as error:
            await self._fail(job_id, str(error))
        except StorageError as error:
            log.error("job %s: the store failed: %s", job_id, error)
            await self._fail(job_id, f"the store failed: {error}")
        except Exception:
            log.exception("job %s failed by a mistake of ours", job_id)
            await self._fail(job_id, "internal error; the service's log has the details")

    async def _on_engine(self, engine: str, work: JobWork, tools: JobTools) -> None:
        lease: Lease | None = None
        try:
            async with self._engines.lease(engine, tools.job_id) as lease:
                await work.run(lease)
        finally:
            if lease is not None and lease.restored:
                await tools.event(EngineRestored(engine=engine))
            elif lease is not None:
                await tools.event(EngineDirty(engine=engine, reason=lease.problem or "unknown"))

    async def _end_cancelled(self, job_id: str, work: JobWork | None) -> None:
        """A cancelled task: the operator's cancel, or the service ending."""
        try:
            record = await self._repository.get_job(job_id)
            if record.state is JobState.CANCELLING:
                left = "nothing was begun" if work is None else work.left()
                await self._change(job_id, JobState.CANCELLED, f"cancelled; {left}", JobCancelled())
            elif record.state is JobState.RUNNING:
                await self._fail(job_id, _stopped(record))
        except StorageError as error:
            log.error("the end of job %s could not be stored: %s", job_id, error)

    async def _fail(self, job_id: str, reason: str) -> None:
        try:
            await self._change(job_id, JobState.FAILED, reason, JobFailed(reason=reason))
        except StorageError as error:
            log.error("job %s could not be marked as failed (%s): %s", job_id, reason, error)

    async def _change(self, job_id: str, state: JobState, reason: str | None, event: AnyEvent) -> JobRecord:
        record = await self._repository.set_job_state(
            job_id, state, expected=sources(state), reason=reason, event=draft(event)
        )
        self._broker.notify(job_id)
        return record
