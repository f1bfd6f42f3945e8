"""``lensmatch publish``: a lens table to an engine, read back and compared, without the service."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from app.bootstrap import DEFAULT_ENGINE, Service, add_engine, running_service
from app.cli.configuration import build_settings, studio_profile
from app.cli.console import (
    Show,
    WorkFailed,
    print_json,
    progress_bar,
    progress_lines,
    read_file,
    reported_errors,
    results,
    say,
    warn,
    wrong_usage,
)
from app.cli.jobs import by_hand
from app.cli.operator import TerminalOperator, has_terminal
from app.documents import DocumentError, read_job
from app.engines import Engines
from app.events import TERMINAL_KINDS, JobQueued, LevelsPlanned, PlaceChecked, Published, parse
from app.job_documents import PublishRequest
from app.settings import Settings
from calibration.tables import LensTable
from storage.errors import BadDocument
from storage.exports import EXPORTS
from storage.exports.base import MAX_DOCUMENT_BYTES
from storage.records import JobState
from storage.schemas import LensTableDocument, table_to_document

_LOOK_AGAIN_S = 5.0
# Events wake the listener; this only bounds the wait if a wake-up were ever missed.


@dataclass(frozen=True, slots=True)
class Publication:
    """How a publication ended. ``result``: None where it ended before it began; ``problem``: why it failed, None where
    the lens stays in the engine."""

    job_id: str
    places: Sequence[PlaceChecked]
    result: Published | None
    problem: str | None


def publish(
    table: Annotated[Path, typer.Argument(metavar="TABLE.json", help="lens table")],
    studio: Annotated[
        Path | None,
        typer.Option(metavar="PROFILE", help="studio profile (TOML) [default: the first of LENSMATCH_PROFILES]"),
    ] = None,
    zoom: Annotated[
        float | None, typer.Option(min=0, max=1, help="place whose lens stays [default: where the head stands]")
    ] = None,
    focus: Annotated[float | None, typer.Option(min=0, max=1, help="given together with --zoom")] = None,
    all_levels: Annotated[bool, typer.Option("--all-levels", help="check every level of the table first")] = False,
    room: Annotated[
        Path | None,
        typer.Option(
            metavar="JOB.json", help="job whose targets and pivot renders are compared by; without: no render"
        ),
    ] = None,
    learn: Annotated[
        bool, typer.Option("--learn", help="learn how the engine draws first, and ask for what its camera needs")
    ] = False,
    limit_px: Annotated[
        float | None, typer.Option(min=0.001, help="largest px between render and prediction [default: about 0.15]")
    ] = None,
    database: Annotated[Path | None, typer.Option(help="SQLite file that keeps the job")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
) -> None:
    """Write a lens to an engine, read it back, and compare the engine's render with what the lens predicts.

    If every value and every render agrees, the lens stays in the engine; if not, or at Ctrl-C, the engine gets back
    what it had. The table must have a level at the place.
    """
    with reported_errors(as_json):
        if (zoom is None) != (focus is None):
            wrong_usage("--zoom and --focus are given together, or neither")
        if learn and room is None:
            wrong_usage("--learn needs --room: an engine is learned from renders of a surveyed target")
        settings = build_settings(database=database)
        document = table_to_document(_read(table))
        survey = read_job(room) if room is not None else None
        profile, source = studio_profile(studio, settings)
        asks = profile.head.kind == "operator" and (survey is not None or zoom is None)
        if asks and not has_terminal():
            raise WorkFailed(
                f'{source}: head.kind = "operator" asks a person where the camera stands, and standard input is no '
                "terminal; run it in one, name another head, or give --zoom and --focus and no --room"
            )
        request = PublishRequest(
            kind="publish",
            engine=DEFAULT_ENGINE,
            table=LensTableDocument.model_validate(document),
            zoom=zoom,
            focus=focus,
            all_levels=all_levels,
            targets=survey.targets if survey is not None else {},
            pivot_m=survey.pivot_m if survey is not None else None,
            learn_engine=learn,
            limit_px=limit_px,
        )
        engines = Engines()
        add_engine(engines, DEFAULT_ENGINE, profile, TerminalOperator().ask if asks else None)
        with (progress_lines if asks else progress_bar)("publish") as show:
            ended = asyncio.run(run_publication(settings, engines, request, show))
        if as_json:
            print_json(_document(ended))
        else:
            _show(ended)
        if ended.problem is not None:
            raise WorkFailed(ended.problem)
        say(f"published; job {ended.job_id} is kept in {settings.database}")


async def run_publication(settings: Settings, engines: Engines, request: PublishRequest, show: Show) -> Publication:
    """Run a publish job to its end. Interrupted, it cancels the job: the engine gets its values back."""
    async with running_service(settings, engines) as service:
        record = await service.runner.submit(request)
        interrupted = False
        try:
            places, result = await _follow(service, record.id, show)
        except asyncio.CancelledError:
            interrupted = True
            await service.runner.cancel(record.id)
            places, result = await _follow(service, record.id, lambda share, doing: None)
        record = await service.repository.get_job(record.id)
        engine = next(info for info in engines.infos() if info.name == request.engine)
        if engine.dirty is not None:
            warn(by_hand(engine, engine.dirty))
        if record.state is JobState.DONE:
            return Publication(record.id, places, result, None)
        why = "interrupted" if interrupted else f"the job {record.state.value}"
        return Publication(record.id, places, result, f"{why}: {record.reason}")


async def _follow(service: Service, job_id: str, show: Show) -> tuple[list[PlaceChecked], Published | None]:
    """Show a publication's progress to its end; what was checked, and its result."""
    places: list[PlaceChecked] = []
    result: Published | None = None
    seen, levels = 0, 1
    with service.broker.listen(job_id) as wakeups:
        while True:
            wakeups.clear()
            for stored in await service.repository.events_after(job_id, seen):
                seen = stored.seq
                event = parse(stored)
                if isinstance(event, (JobQueued, LevelsPlanned)):
                    levels = max(event.levels, 1)
                elif isinstance(event, PlaceChecked):
                    places.append(event)
                elif isinstance(event, Published):
                    result = event
                elif event.kind in TERMINAL_KINDS:
                    return places, result
                show(min(len(places) / levels, 1.0), f"place {min(len(places) + 1, levels)}/{levels}")
            await wakeups.wait(_LOOK_AGAIN_S)


def _read(path: Path) -> LensTable:
    try:
        return EXPORTS["json"].read(read_file(path, MAX_DOCUMENT_BYTES))
    except BadDocument as error:
        raise DocumentError(f"{path}: {error}") from error


def _document(ended: Publication) -> dict[str, Any]:
    """What ``--json`` prints."""
    result = ended.result
    document: dict[str, Any] = {"published": ended.problem is None}
    if result is not None:
        document |= result.model_dump(mode="json", include={"zoom", "focus", "compared", "render_px"})
    document["reason"] = result.reason if result is not None else None
    document["places"] = [place.model_dump(mode="json", exclude={"kind", "ordinal"}) for place in ended.places]
    document["job"] = ended.job_id
    return document if ended.problem is None else document | {"error": ended.problem}


def _show(ended: Publication) -> None:
    for place in ended.places:
        grid = Table(title=f"zoom {place.zoom:g}, focus {place.focus:g}", title_justify="left")
        for heading in ("export", "set to", "reads"):
            grid.add_column(heading, justify="left" if heading == "export" else "right")
        for value in place.values:
            grid.add_row(value.name, value.asked, value.got, style=None if value.same else "red")
        results.print(grid)
        if place.render_px is not None:
            results.print(
                f"render against prediction: {place.render_px.rms:.3f} px RMS, {place.render_px.max:.3f} px at most, "
                f"{place.renders} renders"
            )
    if ended.problem is None and ended.result is not None and ended.result.reason:
        warn(ended.result.reason)
