"""The job runner: queued jobs run one after another on each engine, level by level, each level committed as it ends."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from typing import Any

from pydantic import ValidationError

from app.documents import JobRequest, one_line
from app.engines import EngineError, EngineInfo, Engines, Lease, PictureFacts, Studio
from app.errors import QueueFull
from app.events import (
    AnyEvent,
    EngineDirty,
    EngineLearned,
    EngineRestored,
    EventBroker,
    JobCancelled,
    JobCancelling,
    JobDone,
    JobFailed,
    JobQueued,
    JobStarted,
    LevelDone,
    LevelFailed,
    LevelStarted,
    Note,
    draft,
    make,
)
from app.jobs.cpu import Cpu
from app.jobs.engine import learn
from app.jobs.evidence import evidence_or_none
from app.jobs.level import LevelOutcome, LevelRun
from app.jobs.pictures import level_pictures
from app.jobs.provenance import provenance_of_job
from app.jobs.state import sources
from app.jobs.sweep import level_task, order
from app.jobs.taking import PictureTaker
from calibration.compare import Overlay, predicted_overlay
from calibration.errors import CalibrationError
from calibration.solve.alternating import AlternatingMethod
from calibration.solve.engine_model import Direction, EngineModel
from calibration.solve.joint import JointMethod, JointOptions
from calibration.solve.search import LevelMethod, LevelTask
from calibration.tables import LensTable, LevelResult, LevelStatus
from calibration.types import TargetKind
from engine_adapters.errors import AdapterError
from engine_adapters.ports import LensValues, RenderEngine
from storage.errors import StaleState, StorageError
from storage.evidence import canonical_text, evidence_to_document, summary_of
from storage.records import JobRecord, JobState, PictureKind
from storage.repository import Repository

log = logging.getLogger("lensmatch.jobs")

_STUDIO_FAILURES = 2
# Levels in a row that the studio failed (engine gone, output dead) before the job gives up: the rest would fail too.
_HOME_BOUND_S = 20.0
# Longest wait for head and lens to go back to where they stood; it is a courtesy, not part of the result.


@dataclass(slots=True)
class _Worker:
    queue: asyncio.Queue[str] = field(default_factory=asyncio.Queue)
    loop: asyncio.Task[None] | None = None
    job_id: str | None = None
    job: asyncio.Task[None] | None = None


class _Background:
    """At most one task beside the work; always waited for or cancelled."""

    def __init__(self) -> None:
        self._task: asyncio.Task[None] | None = None

    def begin(self, work: Coroutine[Any, Any, None]) -> None:
        self._task = asyncio.create_task(work)

    async def finish(self) -> None:
        if self._task is not None:
            await self._task
            self._task = None

    async def cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
            self._task = None


def _pictures_of(request: JobRequest) -> PictureFacts:
    return PictureFacts(request.image_size, request.pixel_aspect)


def make_method(request: JobRequest, task: LevelTask) -> LevelMethod:
    """The method that a job asks for."""
    if request.method == "alternating":
        return AlternatingMethod(task)
    options = JointOptions(goal_px=request.goal_px, max_views=request.max_views)
    return JointMethod(task, options)


def _pictures(
    outcome: LevelOutcome, method: LevelMethod, task: LevelTask, pixel_aspect: float, as_found: LensValues | None
) -> dict[PictureKind, bytes]:
    expected: Overlay | None = None
    if outcome.result.status is not LevelStatus.FAILED and isinstance(method, JointMethod) and method.fit is not None:
        expected = predicted_overlay(method.fit.lens, method.fit.covariance)
    return level_pictures(outcome, task, pixel_aspect, as_found=as_found, expected=expected)


def _with_evidence(outcome: LevelOutcome, method: LevelMethod, task: LevelTask) -> tuple[LevelOutcome, str | None]:
    """The level with its evidence in short, and that as its document; None without a fit, or of a method that has
    none."""
    if not isinstance(method, JointMethod):
        return outcome, None
    evidence = evidence_or_none(method.fit, method.views, task, outcome.result, outcome.hashes)
    if evidence is None:
        return outcome, None
    result = replace(outcome.result, evidence=summary_of(evidence))
    return replace(outcome, result=result), canonical_text(evidence_to_document(evidence))


async def _lens_as_found(engine: RenderEngine) -> LensValues | None:
    """The engine's lens before the job changes it, for the picture of before; nothing else depends on it."""
    try:
        return await engine.read_lens()
    except AdapterError as error:
        log.warning("the engine's lens as found is not known: %s", error)
        return None


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
                await self._fail(job.id, "the service stopped while the job ran; its finished levels are kept")

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

    async def submit(self, request: JobRequest, *, idempotency_key: str | None = None) -> JobRecord:
        """Store a job and queue it. Raises UnknownEngine, StudioMismatch, QueueFull, IdempotencyConflict."""
        self._engines.require_pictures(request.engine, _pictures_of(request))
        worker = self._workers[request.engine]
        if sum(w.queue.qsize() for w in self._workers.values()) >= self._queue_limit:
            raise QueueFull(self._queue_limit, self._retry_after_s)
        body = request.model_dump(mode="json")
        event = JobQueued(
            lens=request.lens,
            camera=request.camera,
            engine=request.engine,
            method=request.method,
            levels=len(request.levels),
        )
        record = await self._repository.create_job(body, request.lens, request.engine, idempotency_key, draft(event))
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
        try:
            record = await self._repository.get_job(job_id)
            if record.state is not JobState.QUEUED:
                return  # cancelled while it waited
            try:
                request = JobRequest.model_validate(dict(record.request))
            except ValidationError as error:
                # Queued under rules that another version has made stricter.
                await self._fail(job_id, f"the stored job is refused: {one_line(error)}; correct it and send it again")
                return
            # Asked again: it may have waited through a restart, and the profile may have been changed meanwhile.
            self._engines.require_pictures(request.engine, _pictures_of(request))
            await self._change(
                job_id, JobState.RUNNING, None, JobStarted(engine=request.engine, levels=len(request.levels))
            )
            results = await self._run_on_engine(job_id, request)
            await self._finish(job_id, request, results)
        except asyncio.CancelledError:
            await self._end_cancelled(job_id)
            raise
        except (AdapterError, EngineError, CalibrationError) as error:
            await self._fail(job_id, str(error))
        except StorageError as error:
            log.error("job %s: the store failed: %s", job_id, error)
            await self._fail(job_id, f"the store failed: {error}")
        except Exception:
            log.exception("job %s failed by a mistake of ours", job_id)
            await self._fail(job_id, "internal error; the service's log has the details")

    async def _run_on_engine(self, job_id: str, request: JobRequest) -> list[LevelResult]:
        lease: Lease | None = None
        try:
            async with self._engines.lease(request.engine, job_id) as lease:
                return await self._levels(job_id, request, lease)
        finally:
            if lease is not None and lease.restored:
                await self._event(job_id, EngineRestored(engine=request.engine))
            elif lease is not None:
                await self._event(job_id, EngineDirty(engine=request.engine, reason=lease.problem or "unknown"))

    async def _levels(self, job_id: str, request: JobRequest, lease: Lease) -> list[LevelResult]:
        drawing = _Background()
        try:
            results = await self._measure(job_id, request, lease, drawing)
            await drawing.finish()
            return results
        finally:
            await drawing.cancel()

    async def _measure(self, job_id: str, request: JobRequest, lease: Lease, drawing: _Background) -> list[LevelResult]:
        as_found = await _lens_as_found(lease.studio.engine)
        taker = PictureTaker(lease.studio, request.image_size, self._cpu)
        stood = await taker.read_head()
        await taker.measure_delay()
        delay_ms, picture_ms = taker.delay.delay_s * 1e3, taker.delay.picture_s * 1e3
        text = f"the output follows a change after at most {delay_ms:.0f} ms; a picture takes {picture_ms:.0f} ms"
        await self._event(job_id, Note(text=text))
        ordered = order([(level.zoom, level.focus) for level in request.levels])
        model = await self._learn(job_id, request, lease.studio, taker, ordered[0])
        results: list[LevelResult] = []
        failures = 0
        for ordinal, (zoom, focus) in enumerate(ordered):
            await self._event(job_id, LevelStarted(ordinal=ordinal, zoom=zoom, focus=focus))
            task = level_task(request, zoom, focus, results, model)
            method = make_method(request, task)
            outcome, problem = await self._level(job_id, ordinal, method, task, taker, lease)
            outcome, evidence = await self._cpu.run(_with_evidence, outcome, method, task)
            results.append(outcome.result)
            pictures = partial(_pictures, outcome, method, task, request.pixel_aspect, as_found)
            await self._commit(job_id, ordinal, outcome.result, evidence)
            # Drawn while the next level is measured; one level's pictures at a time are held in memory.
            await drawing.finish()
            drawing.begin(self._draw(job_id, ordinal, pictures))
            failures = failures + 1 if problem is not None else 0
            if problem is not None and failures >= _STUDIO_FAILURES and ordinal + 1 < len(ordered):
                left = len(ordered) - ordinal - 1
                raise EngineError(f"{problem} ({failures} levels in a row failed so; {left} levels were not tried)")
        try:
            async with asyncio.timeout(_HOME_BOUND_S):
                await taker.home(stood)
        except (AdapterError, TimeoutError) as error:
            await self._event(job_id, Note(text=f"head and lens were not turned back: {error}"))
        return results

    async def _learn(
        self, job_id: str, request: JobRequest, studio: Studio, taker: PictureTaker, first: tuple[float, float]
    ) -> EngineModel:
        """How the engine draws; what of it contradicts the studio profile is told, never silently followed."""
        believed = EngineModel(direction=Direction(studio.facts.direction))
        task = level_task(request, *first, [], believed)
        if not request.learn_engine or all(t.kind is TargetKind.LIGHT for t in task.targets.values()):
            return believed
        known = await learn(taker, task, studio.facts, studio.transfer, self._cpu)
        await self._event(job_id, EngineLearned.of(request.engine, known.learned, known.disagreements))
        told = list(known.disagreements)
        if told:
            told.append("the engine is told what its own camera needs; correct the studio profile")
        if not known.learned.trusted:
            told.append(f"the engine is not understood: {known.learned.reason}; each level's values are searched on it")
        for text in told:
            await self._event(job_id, Note(text=text))
        if told and request.method == "alternating":
            raise EngineError(f"the alternating method takes the engine at its profile's word: {told[0]}")
        return known.model

    async def _level(
        self, job_id: str, ordinal: int, method: LevelMethod, task: LevelTask, taker: PictureTaker, lease: Lease
    ) -> tuple[LevelOutcome, AdapterError | None]:
        # Each event is a synced commit; they are written beside the pictures, not between them.
        told: asyncio.Queue[AnyEvent | None] = asyncio.Queue()

        def report(kind: str, data: Mapping[str, Any]) -> None:
            told.put_nowait(make(kind, ordinal=ordinal, zoom=task.zoom, focus=task.focus, **data))

        async def write() -> None:
            while (event := await told.get()) is not None:
                await self._event(job_id, event)

        run = LevelRun(method, task, taker, self._cpu, lease.studio.transfer, report)
        writer = asyncio.create_task(write(), name=f"events of job {job_id}")
        try:
            try:
                return await run.run(), None
            finally:
                told.put_nowait(None)
                await writer
        except AdapterError as error:
            failed = LevelResult.failed(task.zoom, task.focus, str(error))
            return LevelOutcome(failed, None, None, ()), error
        except Exception as error:
            # A mistake of ours costs its level, not the job.
            log.exception("a level of job %s failed by a mistake of ours", job_id)
            reason = f"internal error ({type(error).__name__}); the log has the details"
            return LevelOutcome(LevelResult.failed(task.zoom, task.focus, reason), None, None, ()), None

    async def _commit(self, job_id: str, ordinal: int, result: LevelResult, evidence: str | None) -> None:
        event: AnyEvent
        if result.status is LevelStatus.FAILED:
            reason = result.reason or "unknown"
            event = LevelFailed(ordinal=ordinal, zoom=result.zoom, focus=result.focus, reason=reason)
        else:
            event = LevelDone.of(ordinal, result)
        await self._repository.save_level(job_id, ordinal, result, draft(event), evidence=evidence)
        self._broker.notify(job_id)

    async def _draw(self, job_id: str, ordinal: int, pictures: Callable[[], dict[PictureKind, bytes]]) -> None:
        """A level's pictures for people: a courtesy, which never fails a measured level."""
        try:
            for kind, data in (await self._cpu.run(pictures)).items():
                await self._repository.save_picture(job_id, ordinal, kind, "image/jpeg", data)
        except Exception:
            log.exception("the pictures of level %d of job %s could not be stored", ordinal, job_id)

    async def _finish(self, job_id: str, request: JobRequest, results: list[LevelResult]) -> None:
        failed = [result for result in results if result.status is LevelStatus.FAILED]
        if len(failed) == len(results):
            reasons = sorted({result.reason or "" for result in results})
            await self._fail(job_id, f"no level could be measured: {reasons[0]}")
            return
        reason = f"{len(failed)} of {len(results)} levels failed: {failed[0].reason}" if failed else None
        levels = tuple(sorted(results, key=lambda r: (r.zoom, r.focus)))
        table = LensTable(
            lens=request.lens,
            camera=request.camera,
            version=1,
            created=self._now(),
            image_size=request.image_size,
            method=request.method,
            levels=levels,
            sensor_mm=request.sensor_mm,
            pixel_aspect=request.pixel_aspect,
            provenance=provenance_of_job(job_id, levels, self._engines.profile(request.engine)),
        )
        summary = await self._repository.save_table(job_id, table)
        await self._change(
            job_id,
            JobState.DONE,
            reason,
            JobDone(table_id=summary.id),
        )

    async def _end_cancelled(self, job_id: str) -> None:
        """A cancelled task: the operator's cancel, or the service ending."""
        try:
            record = await self._repository.get_job(job_id)
            if record.state is JobState.CANCELLING:
                await self._change(job_id, JobState.CANCELLED, "cancelled; finished levels are kept", JobCancelled())
            elif record.state is JobState.RUNNING:
                await self._fail(job_id, "the service stopped while the job ran; its finished levels are kept")
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

    async def _event(self, job_id: str, event: AnyEvent) -> None:
        await self._repository.append_event(job_id, draft(event))
        self._broker.notify(job_id)
