"""``lensmatch demo``: the main job on a simulated studio, with the truth beside the result."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.table import Table

from app.cli.console import (
    WorkFailed,
    print_json,
    progress_bar,
    reported_errors,
    results,
    say,
    write_file,
    wrong_usage,
)
from app.cli.jobs import FinishedJob, Show, run_job
from app.cli.simulated import (
    STUDY_FOCUSES,
    STUDY_ZOOMS,
    StudioUse,
    studio_engines,
    studio_job,
    studio_profile,
    studio_use,
    study_levels,
    true_lens,
)
from app.cli.tables import tell_failed
from app.documents import PlanModel
from app.lens_at import surface_fit
from app.report import LevelReport, RunReport, write_report
from app.settings import Settings
from calibration.compare import Overlay, overlay
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import ZoomLens, embedded_lens_names, load_embedded
from storage.evidence import EVIDENCE_FILE, evidence_file
from storage.exports import EXPORTS
from storage.schemas import table_to_document

PICTURE_TIME_MS = 15.0
DELAY_FRAMES = 2
GOAL_PX = 0.15


_MOST_PLANNED = 25
_BETWEEN = 101
# Places along the zoom at which a planned table is compared with the truth.


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A level's result beside its truth."""

    result: LevelResult
    truth: Lens
    error: Overlay | None


def demo(
    lens: Annotated[str, typer.Option(help="which simulated lens; see --list-lenses")] = embedded_lens_names()[0],
    zooms: Annotated[int, typer.Option(min=1, max=100, help="zoom levels from wide to tele")] = STUDY_ZOOMS,
    focuses: Annotated[int, typer.Option(min=1, max=20, help="focus levels for each zoom")] = STUDY_FOCUSES,
    accuracy: Annotated[
        float | None,
        typer.Option(metavar="PX", help="choose the levels until so much is reached between them, instead of a grid"),
    ] = None,
    out: Annotated[Path, typer.Option(help="folder for the lens table and the report")] = Path("lensmatch-demo"),
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
    list_lenses: Annotated[bool, typer.Option(help="print the simulated lenses and stop")] = False,
) -> None:
    """Run the main job on a simulated studio and show how exact it was.

    Starts the simulated studio as a process of its own (R3 on TCP, MockBoard on HTTP, free loopback ports), calibrates
    every level through those sockets, prints the table with the truth beside it, and leaves the lens table (JSON and
    CSV) and a report with pictures in the folder.
    """
    if list_lenses:
        for name in embedded_lens_names():
            results.print(name)
        return
    with reported_errors(as_json):
        if lens not in embedded_lens_names():
            wrong_usage(f"no simulated lens is called {lens!r}; there are: {', '.join(embedded_lens_names())}")
        out.mkdir(parents=True, exist_ok=True)
        truth = load_embedded(lens)
        if accuracy is not None and not accuracy > 0:
            wrong_usage(f"--accuracy {accuracy:g}: must be more than 0 px")
        # At one focus: how far a lens breathes between two is no question of its zoom.
        plan = PlanModel(accuracy_px=accuracy, max_levels=_MOST_PLANNED) if accuracy is not None else None
        levels = study_levels(zooms, focuses) if plan is None else []
        started = time.monotonic()
        with progress_bar("demo") as show:
            job, use = asyncio.run(_run(truth, levels, plan, out, show))
        seconds = time.monotonic() - started
        judged = [_judge(result, truth, job) for result in job.table.levels]
        for name in ("json", "csv"):
            export = EXPORTS[name]
            write_file(out / f"lens-table{export.suffix}", export.write(job.table))
        write_file(out / EVIDENCE_FILE, evidence_file(job.evidence.values()))
        report = RunReport(
            title=f"{job.table.lens} on a simulated studio",
            table=job.table,
            levels=[
                LevelReport(
                    j.result,
                    j.truth,
                    j.error,
                    job.pictures.get(_key(j.result), {}),
                    evidence=job.evidence.get(_key(j.result)),
                )
                for j in judged
            ],
            facts=_facts(use, seconds),
            truth_at=partial(true_lens, truth),
        )
        write_report(out / "report.html", report)
        tell_failed(job.table.levels)
        if as_json:
            print_json(_document(job, truth, judged, use, seconds))
        else:
            _show(judged, use, seconds, out)
            if plan is not None:
                _show_between(job.table, truth)


def _key(result: LevelResult) -> tuple[float, float]:
    return result.zoom, result.focus


async def _run(
    truth: ZoomLens, levels: list[tuple[float, float]], plan: PlanModel | None, out: Path, show: Show
) -> tuple[FinishedJob, StudioUse]:
    show(0.0, "starting the simulated studio")
    settings = Settings(database=out / "lensmatch.db")
    options = [
        *("--lens", truth.name),
        *("--picture-time-ms", str(PICTURE_TIME_MS)),
        *("--delay-frames", str(DELAY_FRAMES)),
        # A tenth of the bytes of BMP, and no corner moves by more than 0.01 px.
        *("--payload-format", "jpeg"),
    ]
    async with launched_studio(options) as addresses:
        engines = studio_engines(studio_profile(addresses, truth))
        job = await run_job(settings, engines, studio_job(addresses, truth, levels, plan=plan), show)
        return job, await studio_use(addresses, PICTURE_TIME_MS / 1000, DELAY_FRAMES)


def _judge(result: LevelResult, truth: ZoomLens, job: FinishedJob) -> Judged:
    real = true_lens(truth, result.zoom, result.focus)
    error = None
    if result.fov_x_deg is not None:
        error = overlay(real, result.lens(job.table.image_size, job.table.pixel_aspect))
    return Judged(result, real, error)


def _facts(use: StudioUse, seconds: float) -> list[tuple[str, str]]:
    return [
        ("pictures fetched", f"{use.pictures}"),
        ("time", f"{seconds:.1f} s in all"),
        (
            "engine-bound time",
            f"{use.engine_bound_s:.1f} s (pictures, the engine's delay after changes, movements of head and lens)",
        ),
    ]


def _document(
    job: FinishedJob, truth: ZoomLens, judged: list[Judged], use: StudioUse, seconds: float
) -> dict[str, Any]:
    errors = [j.error for j in judged if j.error is not None]
    if not errors:
        raise WorkFailed("no level was measured")
    return {
        "table": table_to_document(job.table),
        "truth": truth.truth(),
        "overlay_px": {
            "rms": (sum(e.rms_px**2 for e in errors) / len(errors)) ** 0.5,
            "max": max(e.max_px for e in errors),
        },
        "pictures": sum(j.result.frames.real + j.result.frames.virtual for j in judged),
        "seconds": seconds,
        "pictures_fetched": use.pictures,
        "engine_bound_s": use.engine_bound_s,
    }


def _show(judged: list[Judged], use: StudioUse, seconds: float, out: Path) -> None:
    table = Table(
        title="found, and below it the truth; k1, k2 with radius 1 at half the picture's width",
        title_style="dim",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        show_edge=False,
        padding=(0, 0, 0, 1),
    )
    for name in ("zoom", "focus", "FoV deg", "k1_hw", "k2_hw", "shift x", "y px", "pics", "off px"):
        table.add_column(name, justify="right", no_wrap=True)
    for j in judged:
        _add_rows(table, j)
    results.print(table)
    errors = [j.error for j in judged if j.error is not None]
    pictures = [j.result.frames.real + j.result.frames.virtual for j in judged]
    worst = max((e.max_px for e in errors), default=float("nan"))
    results.print(
        f"{len(errors)} of {len(judged)} levels   overlay error at most [bold]{worst:.3f} px[/] anywhere   "
        f"{sum(pictures)} pictures (at most {max(pictures)} a level)"
    )
    ratio = seconds / use.engine_bound_s
    results.print(
        f"{seconds:.1f} s in all, {ratio:.2f} x the engine-bound {use.engine_bound_s:.1f} s "
        f"({use.pictures} pictures, {use.changes} values set, {use.movements} movements of {use.movements_s:.1f} s)"
    )
    say(f"lens table: {out / 'lens-table.json'} and .csv   report: {out / 'report.html'}")


def _show_between(table: LensTable, truth: ZoomLens) -> None:
    """How far the lens is off between the levels: the truth is looked at here, after everything was measured."""
    fit = surface_fit(table)
    (wide, tele), focus = fit.surface.zoom_range, fit.surface.focus_range[0]
    places = [wide + (tele - wide) * i / (_BETWEEN - 1) for i in range(_BETWEEN)]
    read = [fit.surface.at(zoom, focus) for zoom in places]
    errors = [
        overlay(true_lens(truth, zoom, focus), found.lens).max_px for zoom, found in zip(places, read, strict=True)
    ]
    results.print(
        f"between the levels at most [bold]{max(errors):.3f} px[/] off, at {_BETWEEN} places; "
        f"{max(found.predicted_px.max for found in read):.3f} px were expected"
    )


def _add_rows(table: Table, j: Judged) -> None:
    r, t = j.result, j.truth
    place = (f"{r.zoom:.3f}", f"{r.focus:.2f}")
    if r.fov_x_deg is None or j.error is None:
        table.add_row(*place, "[red]failed[/]")
        return
    shift = r.center_shift_px or (None, None)
    colour = "green" if j.error.max_px <= GOAL_PX else "yellow"
    table.add_row(
        *place,
        f"{r.fov_x_deg:.4f}",
        _number(r.k1_hw, 5),
        _number(r.k2_hw, 5),
        _number(shift[0], 3),
        _number(shift[1], 3),
        f"{r.frames.real}+{r.frames.virtual}",
        f"[{colour}]{j.error.max_px:.3f}[/]",
    )
    table.add_row(
        "",
        "",
        f"{t.fov_x_deg:.4f}",
        _number(t.k1_hw, 5),
        _number(t.k2_hw, 5),
        _number(t.center_shift_px[0], 3),
        _number(t.center_shift_px[1], 3),
        "",
        "",
        style="dim",
    )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:+.{digits}f}"
