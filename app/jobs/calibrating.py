"""A calibration job: level by level, each committed as it ends, and the lens table that they make."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from app.documents import JobRequest
from app.engines import EngineError, Lease, PictureFacts, Studio
from app.events import (
    AnyEvent,
    EngineLearned,
    JobDone,
    LevelDone,
    LevelFailed,
    LevelsPlanned,
    LevelStarted,
    Note,
    draft,
    make,
)
from app.jobs.engine import learn
from app.jobs.evidence import evidence_or_none
from app.jobs.level import LevelOutcome, LevelRun
from app.jobs.pictures import level_pictures
from app.jobs.prior import prior_surface, require_prior
from app.jobs.provenance import provenance_of_job
from app.jobs.sweep import LevelPlan, SweepPlan, level_task
from app.jobs.taking import PictureTaker
from app.jobs.work import HOME_BOUND_S, Ending, JobTools, JobWorkFailed, Subject
from app.lens_at import SURFACE_KIND, completed_from, surface_fit
from calibration.compare import Overlay, predicted_overlay
from calibration.errors import CalibrationError
from calibration.solve.alternating import AlternatingMethod
from calibration.solve.engine_model import Direction, EngineModel
from calibration.solve.joint import JointMethod, JointOptions
from calibration.solve.search import LevelMethod, LevelTask
from calibration.surface import LensSurface
from calibration.surface.plan import AdaptivePlan
from calibration.tables import Interpolation, LensTable, LevelResult, LevelStatus
from calibration.types import TargetKind
from engine_adapters.errors import AdapterError
from engine_adapters.ports import LensValues, RenderEngine
from storage.evidence import canonical_text, evidence_to_document, summary_of
from storage.records import PictureKind

log = logging.getLogger("lensmatch.jobs")

_STUDIO_FAILURES = 2
# Levels in a row that the studio failed (engine gone, output dead) before the job gives up: the rest would fail too.


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


def subject(request: JobRequest) -> Subject:
    """What a calibration job is about."""
    pictures = PictureFacts(request.image_size, request.pixel_aspect)
    return Subject(request.lens, request.camera, request.method, len(request.levels), pictures)


def make_plan(request: JobRequest, prior: LensSurface | None = None) -> LevelPlan:
    """The plan that a job asks for: which levels, in which order."""
    if request.plan is None:
        return SweepPlan([(level.zoom, level.focus) for level in request.levels])
    known = None if prior is None else prior.quantities
    return AdaptivePlan(request.plan.to_options(), request.image_size, request.pixel_aspect, known)


def _held_out(table: LensTable) -> tuple[LensTable, list[str]]:
    """The table with how far its surface is off at levels left out of it, and what is odd about single levels."""
    try:
        fit = surface_fit(table)
    except CalibrationError as error:
        return table, [f"the levels make no surface: {error}"]
    told = [f"zoom {c.zoom:g}, focus {c.focus:g} does not fit its neighbours: {c.reason}" for c in fit.left_out]
    return replace(table, interpolation=Interpolation(SURFACE_KIND, fit.held_out_px)), told


class Calibration:
    """The work (:class:`app.jobs.work.JobWork`) of a calibration job."""

    def __init__(self, request: JobRequest, tools: JobTools, prior: LensSurface | None = None) -> None:
        """``prior``: the lens that levels start from, None: as the request says."""
        self._request = request
        self._tools = tools
        self._prior = prior
        self._results: list[LevelResult] = []
        self._attempts: dict[tuple[float, float], int] = {}
        self._drawing = _Background()

    @property
    def results(self) -> tuple[LevelResult, ...]:
        """The levels measured so far, failed ones too."""
        return tuple(self._results)

    async def run(self, lease: Lease) -> None:
        """Measure the levels that the plan asks for."""
        try:
            await self._measure(lease)
            await self._drawing.finish()
        finally:
            await self._drawing.cancel()

    async def _measure(self, lease: Lease) -> None:
        request, tools = self._request, self._tools
        if self._prior is None:
            self._prior = await prior_surface(request, tools.repository)
        as_found = await _lens_as_found(lease.studio.engine)
        taker = PictureTaker(lease.studio, request.image_size, tools.cpu)
        stood = await taker.read_head()
        await taker.measure_delay()
        delay_ms, picture_ms = taker.delay.delay_s * 1e3, taker.delay.picture_s * 1e3
        text = f"the output follows a change after at most {delay_ms:.0f} ms; a picture takes {picture_ms:.0f} ms"
        await tools.event(Note(text=text))
        plan = make_plan(request, self._prior)
        asked = await tools.cpu.run(plan.ask)
        model = await self._learn(lease.studio, taker, asked[0])
        told, failures = len(request.levels), 0
        problem: AdapterError | None = None
        while asked:
            known = len(self._results) + len([place for place in asked if place not in self._attempts])
            if known > told:
                told = known
                await tools.event(LevelsPlanned(levels=known))
            for zoom, focus in asked:
                if failures >= _STUDIO_FAILURES:
                    left = known - len(self._results)
                    raise EngineError(f"{problem} ({failures} levels in a row failed so; {left} levels were not tried)")
                result, problem = await self._one(zoom, focus, model, taker, lease, as_found)
                if self._prior is not None and problem is None and result.status is LevelStatus.FAILED:
                    # Perhaps it is another lens than the table's: once more, without it.
                    result, problem = await self._one(zoom, focus, model, taker, lease, as_found)
                failures = failures + 1 if problem is not None else 0
                await tools.cpu.run(plan.tell, result)
            asked = await tools.cpu.run(plan.ask)
        if plan.reason is not None:
            await tools.event(Note(text=f"the plan ends: {plan.reason}"))
        try:
            async with asyncio.timeout(HOME_BOUND_S):
                await taker.home(stood)
        except (AdapterError, TimeoutError) as error:
            await tools.event(Note(text=f"head and lens were not turned back: {error}"))

    async def _one(
        self,
        zoom: float,
        focus: float,
        model: EngineModel,
        taker: PictureTaker,
        lease: Lease,
        as_found: LensValues | None,
    ) -> tuple[LevelResult, AdapterError | None]:
        """Measure and commit a level, a further attempt at one that was measured before in its place; gives what was
        wrong with the studio, if that is why it failed."""
        request = self._request
        attempt = self._attempts[zoom, focus] = self._attempts.get((zoom, focus), 0) + 1
        places = [(result.zoom, result.focus) for result in self._results]
        ordinal = places.index((zoom, focus)) if attempt > 1 else len(self._results)
        await self._tools.event(LevelStarted(ordinal=ordinal, zoom=zoom, focus=focus, attempt=attempt))
        others = [result for result in self._results if (result.zoom, result.focus) != (zoom, focus)]
        task = level_task(request, zoom, focus, others, model, self._prior if attempt == 1 else None)
        method = make_method(request, task)
        outcome, problem = await self._level(ordinal, method, task, taker, lease)
        outcome, evidence = await self._tools.cpu.run(_with_evidence, outcome, method, task)
        if attempt == 1:
            self._results.append(outcome.result)
        elif outcome.result.status is not LevelStatus.FAILED:
            self._results[ordinal] = outcome.result
        pictures = partial(_pictures, outcome, method, task, request.pixel_aspect, as_found)
        await self._commit(ordinal, outcome.result, evidence, attempt)
        # Drawn while the next level is measured; one level's pictures at a time are held in memory.
        await self._drawing.finish()
        self._drawing.begin(self._draw(ordinal, pictures))
        return outcome.result, problem

    async def _learn(self, studio: Studio, taker: PictureTaker, first: tuple[float, float]) -> EngineModel:
        """How the engine draws; what of it contradicts the studio profile is told, never silently followed."""
        request = self._request
        believed = EngineModel(direction=Direction(studio.facts.direction))
        task = level_task(request, *first, [], believed)
        if not request.learn_engine or all(t.kind is TargetKind.LIGHT for t in task.targets.values()):
            return believed
        known = await learn(taker, task, studio.facts, studio.transfer, self._tools.cpu)
        await self._tools.event(EngineLearned.of(request.engine, known.learned, known.disagreements))
        told = list(known.disagreements)
        if told:
            told.append("the engine is told what its own camera needs; correct the studio profile")
        if not known.learned.trusted:
            told.append(f"the engine is not understood: {known.learned.reason}; each level's values are searched on it")
        for text in told:
            await self._tools.event(Note(text=text))
        if told and request.method == "alternating":
            raise EngineError(f"the alternating method takes the engine at its profile's word: {told[0]}")
        return known.model

    async def _level(
        self, ordinal: int, method: LevelMethod, task: LevelTask, taker: PictureTaker, lease: Lease
    ) -> tuple[LevelOutcome, AdapterError | None]:
        # Each event is a synced commit; they are written beside the pictures, not between them.
        told: asyncio.Queue[AnyEvent | None] = asyncio.Queue()

        def report(kind: str, data: Mapping[str, Any]) -> None:
            told.put_nowait(make(kind, ordinal=ordinal, zoom=task.zoom, focus=task.focus, **data))

        async def write() -> None:
            while (event := await told.get()) is not None:
                await self._tools.event(event)

        run = LevelRun(method, task, taker, self._tools.cpu, lease.studio.transfer, report)
        writer = asyncio.create_task(write(), name=f"events of job {self._tools.job_id}")
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
            log.exception("a level of job %s failed by a mistake of ours", self._tools.job_id)
            reason = f"internal error ({type(error).__name__}); the log has the details"
            return LevelOutcome(LevelResult.failed(task.zoom, task.focus, reason), None, None, ()), None

    async def _commit(self, ordinal: int, result: LevelResult, evidence: str | None, attempt: int) -> None:
        event: AnyEvent
        if result.status is LevelStatus.FAILED:
            reason = result.reason or "unknown"
            event = LevelFailed(ordinal=ordinal, zoom=result.zoom, focus=result.focus, reason=reason, attempt=attempt)
        else:
            event = LevelDone.of(ordinal, result, attempt)
        await self._tools.repository.save_level(
            self._tools.job_id, ordinal, result, draft(event), evidence=evidence, attempt=attempt
        )
        self._tools.notify()

    async def _draw(self, ordinal: int, pictures: Callable[[], dict[PictureKind, bytes]]) -> None:
        """A level's pictures for people: a courtesy, which never fails a measured level."""
        try:
            for kind, data in (await self._tools.cpu.run(pictures)).items():
                await self._tools.repository.save_picture(self._tools.job_id, ordinal, kind, "image/jpeg", data)
        except Exception:
            log.exception("the pictures of level %d of job %s could not be stored", ordinal, self._tools.job_id)

    async def finish(self) -> Ending:
        """Store the table that the levels make. Raises :class:`app.jobs.work.JobWorkFailed` where none was measured."""
        request, results = self._request, self._results
        failed = [result for result in results if result.status is LevelStatus.FAILED]
        if len(failed) == len(results):
            reasons = sorted({result.reason or "" for result in results})
            raise JobWorkFailed(f"no level could be measured: {reasons[0]}")
        reason = f"{len(failed)} of {len(results)} levels failed: {failed[0].reason}" if failed else None
        levels = tuple(sorted(results, key=lambda r: (r.zoom, r.focus)))
        table = LensTable(
            lens=request.lens,
            camera=request.camera,
            version=1,
            created=self._tools.now(),
            image_size=request.image_size,
            method=request.method,
            levels=levels,
            sensor_mm=request.sensor_mm,
            pixel_aspect=request.pixel_aspect,
            provenance=provenance_of_job(self._tools.job_id, levels, self._tools.profile),
        )
        if request.plan is not None and (prior := await require_prior(request, self._tools.repository)) is not None:
            try:
                table = await self._tools.cpu.run(completed_from, table, prior)
            except CalibrationError as error:
                await self._tools.event(Note(text=f"nothing was taken over from the table started from: {error}"))
        table, told = await self._tools.cpu.run(_held_out, table)
        for text in told:
            await self._tools.event(Note(text=text))
        summary = await self._tools.repository.save_table(self._tools.job_id, table)
        return Ending(JobDone(table_id=summary.id), reason)

    def left(self) -> str:
        """What a cancelled calibration leaves."""
        return "finished levels are kept"
