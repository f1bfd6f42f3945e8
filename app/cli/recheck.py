"""``lensmatch recheck``: does a stored lens still hold, without the service."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from app.bootstrap import DEFAULT_ENGINE, Service, add_engine, running_service
from app.cli.configuration import build_settings, studio_profile
from app.cli.console import (
    Show,
    WorkFailed,
    check_out,
    print_json,
    progress_bar,
    progress_lines,
    read_file,
    reported_errors,
    results,
    say,
    warn,
    write_file,
)
from app.cli.jobs import by_hand
from app.cli.operator import TerminalOperator, has_terminal
from app.documents import DocumentError, LevelModel, read_job
from app.engines import Engines
from app.events import TERMINAL_KINDS, JobQueued, LevelDone, LevelFailed, LevelsPlanned, Rechecked, parse
from app.job_documents import RecheckRequest
from app.jobs.rechecking import corrected, judge
from app.settings import Settings
from calibration.surface.recheck import GOAL_PX, Verdict
from calibration.tables import LensTable, LevelResult
from storage.errors import BadDocument
from storage.exports import EXPORTS
from storage.exports.base import MAX_DOCUMENT_BYTES
from storage.records import JobState
from storage.schemas import LensTableDocument, table_to_document

_LOOK_AGAIN_S = 5.0
# Events wake the listener; this only bounds the wait if a wake-up were ever missed.


@dataclass(frozen=True, slots=True, eq=False)
class CheckedLens:
    """A re-check that came to its end: what it found, and the levels that it measured."""

    job_id: str
    found: Rechecked
    levels: tuple[LevelResult, ...]


def recheck(
    table: Annotated[Path, typer.Argument(metavar="TABLE.json", help="lens table")],
    room: Annotated[Path, typer.Option(metavar="JOB.json", help="job whose targets and pivot stand in the room")],
    studio: Annotated[
        Path | None,
        typer.Option(metavar="PROFILE", help="studio profile (TOML) [default: the first of LENSMATCH_PROFILES]"),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(metavar="ZOOM,FOCUS", help="place to measure, may be repeated [default: three by the table]"),
    ] = None,
    goal_px: Annotated[float, typer.Option(min=0.01, help="px up to which the stored lens holds")] = GOAL_PX,
    out: Annotated[
        Path | None,
        typer.Option(metavar="CORRECTED.json", dir_okay=False, help="write the corrected table, if there is one"),
    ] = None,
    database: Annotated[Path | None, typer.Option(help="SQLite file that keeps the job")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
) -> None:
    """Measure a stored lens again at a few places, and say whether it holds, by how many px it is off, and why.

    Exit code 0: it holds, or a remount (centre shift, encoder offsets) explains the change. 1: the lens has changed.
    """
    with reported_errors(as_json):
        check_out(out)
        settings = build_settings(database=database)
        stored = _read(table)
        survey = read_job(room)
        profile, source = studio_profile(studio, settings)
        asks = profile.head.kind == "operator"
        if asks and not has_terminal():
            raise WorkFailed(
                f'{source}: head.kind = "operator" asks a person where the camera stands, and standard input is no '
                "terminal; run it in one, or name another head"
            )
        request = RecheckRequest(
            kind="recheck",
            engine=DEFAULT_ENGINE,
            table=LensTableDocument.model_validate(table_to_document(stored)),
            levels=[_place(text) for text in at or []],
            targets=survey.targets,
            pivot_m=survey.pivot_m,
            pivot_sigma_m=survey.pivot_sigma_m,
            angle_sigma_deg=survey.angle_sigma_deg,
            roll_sigma_deg=survey.roll_sigma_deg,
            priors=survey.priors,
            goal_px=goal_px,
        )
        engines = Engines()
        add_engine(engines, DEFAULT_ENGINE, profile, TerminalOperator().ask if asks else None)
        with (progress_lines if asks else progress_bar)("recheck") as show:
            ended = asyncio.run(run_recheck(settings, engines, request, show))
        if as_json:
            print_json(
                {**ended.found.model_dump(mode="json", exclude={"kind", "table_id", "engine"}), "job": ended.job_id}
            )
        else:
            _show(ended.found)
        if ended.found.verdict is Verdict.CORRECTED and out is not None:
            moved = corrected(stored, judge(stored, ended.levels, goal_px), ended.job_id)
            write_file(out, EXPORTS["json"].write(moved))
            say(f"corrected table: {out}")
        elif out is not None:
            say(f"{out} is not written: nothing was corrected")
        say(f"job {ended.job_id} is kept in {settings.database}")
        if ended.found.verdict is Verdict.CHANGED:
            raise typer.Exit(1)


async def run_recheck(settings: Settings, engines: Engines, request: RecheckRequest, show: Show) -> CheckedLens:
    """Run a recheck job to its end. Raises WorkFailed with its reason; interrupted, it cancels the job first."""
    async with running_service(settings, engines) as service:
        record = await service.runner.submit(request)
        interrupted = False
        found: Rechecked | None = None
        try:
            found = await _follow(service, record.id, show)
        except asyncio.CancelledError:
            interrupted = True
            await service.runner.cancel(record.id)
            found = await _follow(service, record.id, lambda share, doing: None)
        engine = next(info for info in engines.infos() if info.name == request.engine)
        if engine.dirty is not None:
            warn(by_hand(engine, engine.dirty))
        record = await service.repository.get_job(record.id)
        if record.state is not JobState.DONE or found is None:
            why = "interrupted" if interrupted else f"the job {record.state.value}"
            raise WorkFailed(f"{why}: {record.reason}")
        levels = await service.repository.list_levels(record.id)
        return CheckedLens(record.id, found, tuple(level.result for level in levels))


async def _follow(service: Service, job_id: str, show: Show) -> Rechecked | None:
    """Show a re-check's progress to its end; what it found."""
    found: Rechecked | None = None
    seen, done, levels = 0, 0, 1
    with service.broker.listen(job_id) as wakeups:
        while True:
            wakeups.clear()
            for stored in await service.repository.events_after(job_id, seen):
                seen = stored.seq
                event = parse(stored)
                if isinstance(event, (JobQueued, LevelsPlanned)):
                    levels = max(event.levels, 1)
                elif isinstance(event, (LevelDone, LevelFailed)):
                    done += 1
                elif isinstance(event, Rechecked):
                    found = event
                elif event.kind in TERMINAL_KINDS:
                    return found
                show(min(done / levels, 1.0), f"place {min(done + 1, levels)}/{levels}")
            await wakeups.wait(_LOOK_AGAIN_S)


def _place(text: str) -> LevelModel:
    try:
        zoom, focus = (float(part) for part in text.split(","))
        return LevelModel(zoom=zoom, focus=focus)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is no place: give ZOOM,FOCUS, each 0 to 1", param_hint="--at") from error


def _read(path: Path) -> LensTable:
    try:
        return EXPORTS["json"].read(read_file(path, MAX_DOCUMENT_BYTES))
    except BadDocument as error:
        raise DocumentError(f"{path}: {error}") from error


def _show(found: Rechecked) -> None:
    grid = Table()
    corrected = found.left_px is not None
    for heading in ("zoom", "focus", "off by px", "sigma px", *(("left px",) if corrected else ())):
        grid.add_column(heading, justify="right")
    for level in found.levels:
        numbers = [level.error_px, level.expected_px, *(() if level.left_px is None else (level.left_px,))]
        grid.add_row(f"{level.zoom:g}", f"{level.focus:g}", *(f"{number:.2f}" for number in numbers))
    results.print(grid)
    results.print(f"{found.verdict.value}: {found.error_px:.2f} px")
    (warn if found.verdict is Verdict.CHANGED else say)(found.reason)
