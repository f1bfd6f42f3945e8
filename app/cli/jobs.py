"""One job run by the command line itself: the same store and runner as the service, with a progress bar."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from app.bootstrap import Service, running_service
from app.cli.console import Show, WorkFailed, warn
from app.documents import JobRequest
from app.engines import EngineInfo, Engines
from app.events import TERMINAL_KINDS, message
from app.settings import Settings
from calibration.tables import LensTable, LevelResult, LevelStatus
from storage.errors import NotFound
from storage.records import JobState, PictureKind

_LOOK_AGAIN_S = 5.0
# Events wake the listener; this only bounds the wait if a wake-up were ever missed.

__all__ = ["FinishedJob", "Show", "run_job"]


@dataclass(frozen=True, slots=True, eq=False)
class FinishedJob:
    """A job that left a table; ``pictures`` by level (zoom, focus) and kind, ``evidence`` documents by level."""

    job_id: str
    table: LensTable
    pictures: dict[tuple[float, float], dict[PictureKind, bytes]]
    evidence: dict[tuple[float, float], dict[str, Any]]


async def run_job(settings: Settings, engines: Engines, request: JobRequest, show: Show) -> FinishedJob:
    """Run a job to its end. Raises WorkFailed with the job's reason.

    Interrupted, it cancels the job first: the engine gets its values back and finished levels stay in the store; the
    WorkFailed says where. An engine whose values could not be put back is told in a line of its own.
    """
    async with running_service(settings, engines) as service:
        record = await service.runner.submit(request)
        interrupted = False
        found: list[str] = []
        try:
            found = await _follow(service, record.id, len(request.levels), show)
        except asyncio.CancelledError:
            interrupted = True
            await service.runner.cancel(record.id)
            await _follow(service, record.id, len(request.levels), lambda share, doing: None)
        engine = next(info for info in engines.infos() if info.name == request.engine)
        for line in found:
            warn(line)
        if engine.dirty is not None:
            warn(by_hand(engine, engine.dirty))
        record = await service.repository.get_job(record.id)
        results = [level.result for level in await service.repository.list_levels(record.id)]
        if interrupted:
            where = f"job {record.id} in {settings.database}, {_measured(results)} of {len(request.levels)} levels"
            put_back = "has its values back" if engine.dirty is None else "does not have its values back"
            raise WorkFailed(f"interrupted; what was finished is kept: {where}; the engine {put_back}", results)
        if record.state is not JobState.DONE:
            kept = _kept(results, record.id, settings)
            raise WorkFailed(f"the job {record.state.value}: {record.reason}{kept}", results)
        summary = await service.repository.table_of_job(record.id)
        if summary is None:
            raise WorkFailed(f"job {record.id} is done but left no table; the store may have been changed meanwhile")
        table = (await service.repository.get_table(summary.id)).table
        return FinishedJob(record.id, table, await _pictures(service, record.id), await _evidence(service, record.id))


def _measured(results: Sequence[LevelResult]) -> int:
    return sum(result.status is not LevelStatus.FAILED for result in results)


def _kept(results: Sequence[LevelResult], job_id: str, settings: Settings) -> str:
    measured = _measured(results)
    return f" ({measured} finished levels of job {job_id} are kept in {settings.database})" if measured else ""


def by_hand(engine: EngineInfo, reason: str) -> str:
    """What to put back by hand: this process ends, and with it the memory of the values."""
    values = ", ".join(f"{name} = {value}" for name, value in engine.found)
    return f"the engine's values could not be put back: {reason}; set by hand what it had: {values}"


async def _follow(service: Service, job_id: str, levels: int, show: Show) -> list[str]:
    """Show a job's progress to its end; what it found to be wrong with the studio's profile, one line each."""
    found: list[str] = []
    seen, done, share, level = 0, 0, 0.0, ""
    with service.broker.listen(job_id) as wakeups:
        while True:
            wakeups.clear()
            for record in await service.repository.events_after(job_id, seen):
                seen = record.seq
                event = message(record)
                kind = event["kind"]
                if kind == "levels_planned":
                    levels = event["levels"]
                elif kind == "level_started":
                    level, share = f"zoom {event['zoom']:.3g} focus {event['focus']:.3g}", 0.0
                elif kind == "level_progress":
                    share = event["progress"]
                elif kind in ("level_done", "level_failed"):
                    done, share = done + 1, 0.0
                elif kind == "engine_learned":
                    found += event["disagreements"]
                    if not event["trusted"]:
                        found.append(f"the engine's camera was not learned: {event['reason']}")
                # A plan adds levels as it goes; before it has asked for any there are none to count.
                levels = max(levels, done + 1)
                doing = f"level {min(done + 1, levels)}/{levels}: {level}" if level else "measuring the output's delay"
                show((done + share) / levels, doing)
                if kind in TERMINAL_KINDS:
                    return found
            await wakeups.wait(_LOOK_AGAIN_S)


async def _evidence(service: Service, job_id: str) -> dict[tuple[float, float], dict[str, Any]]:
    found: dict[tuple[float, float], dict[str, Any]] = {}
    for level in await service.repository.list_levels(job_id):
        zoom, focus = level.result.zoom, level.result.focus
        with contextlib.suppress(NotFound):  # a level that failed has none
            found[zoom, focus] = json.loads((await service.repository.get_evidence(job_id, zoom, focus)).document)
    return found


async def _pictures(service: Service, job_id: str) -> dict[tuple[float, float], dict[PictureKind, bytes]]:
    found: dict[tuple[float, float], dict[PictureKind, bytes]] = {}
    for level in await service.repository.list_levels(job_id):
        kinds: dict[PictureKind, bytes] = {}
        for kind in PictureKind:
            with contextlib.suppress(NotFound):  # not every level has every kind
                kinds[kind] = (await service.repository.get_picture(job_id, level.ordinal, kind)).data
        found[(level.result.zoom, level.result.focus)] = kinds
    return found
