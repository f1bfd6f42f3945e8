"""``lensmatch run``: one job against an engine, without the service."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from app.bootstrap import DEFAULT_PROFILE, add_engine
from app.cli.configuration import build_settings, chosen_profile, studio_profile
from app.cli.console import (
    WorkFailed,
    check_out,
    print_json,
    progress_bar,
    progress_lines,
    reported_errors,
    say,
    write_file,
)
from app.cli.jobs import FinishedJob, run_job
from app.cli.operator import TerminalOperator, has_terminal
from app.cli.tables import show_table, tell_failed
from app.documents import read_job
from app.engines import Engines
from app.report import LevelReport, RunReport, write_report
from storage.evidence import evidence_file, evidence_path
from storage.exports import EXPORTS
from storage.schemas import table_to_document


def run(
    job: Annotated[Path, typer.Argument(metavar="JOB.json", help="what to calibrate: lens, levels, targets")],
    studio: Annotated[
        Path | None,
        typer.Option(metavar="PROFILE", help="studio profile (TOML) [default: the first of LENSMATCH_PROFILES]"),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="lens table (JSON) to write, NAME.evidence.json beside it")] = None,
    report: Annotated[Path | None, typer.Option(help="report (HTML) to write")] = None,
    database: Annotated[Path | None, typer.Option(help="SQLite file that keeps the job and its levels")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the lens table as JSON on standard output")] = False,
) -> None:
    """Run one job against an engine, without the service.

    Each level is stored as it ends, in the same database as the service's. With an operator's head you are asked for
    each movement. Ctrl-C ends the job, keeps the finished levels and gives the engine its values back.
    """
    with reported_errors(as_json):
        settings = build_settings(database=database)
        check_out(out, report)
        request = read_job(job)
        profile, source = studio_profile(studio, settings)
        by_hand = profile.head.kind == "operator"
        if by_hand and not has_terminal():
            raise WorkFailed(
                f'{source}: head.kind = "operator" asks a person for each movement, and standard input is no terminal; '
                "run it in one, or name another head"
            )
        engines = Engines()
        chosen = chosen_profile(studio, settings)
        add_engine(
            engines,
            request.engine,
            profile,
            TerminalOperator().ask if by_hand else None,
            profile_name=DEFAULT_PROFILE if chosen is None else chosen.stem,
        )
        with (progress_lines if by_hand else progress_bar)("run") as show:
            finished = asyncio.run(run_job(settings, engines, request, show))
        if out is not None:
            write_file(out, EXPORTS["json"].write(finished.table))
            write_file(evidence_path(out), evidence_file(finished.evidence.values()))
        if report is not None:
            write_report(report, job_report(finished))
        if as_json:
            tell_failed(finished.table.levels)
            print_json(table_to_document(finished.table))
        else:
            show_table(finished.table)
        for path in (out, report):
            if path is not None:
                say(f"written: {path}")
        say(f"job {finished.job_id} is kept in {settings.database}")


def job_report(finished: FinishedJob) -> RunReport:
    """The report of a job whose truth nobody knows."""
    table = finished.table
    real = sum(level.frames.real for level in table.levels)
    virtual = sum(level.frames.virtual for level in table.levels)
    return RunReport(
        title=f"{table.lens} on {table.camera}",
        table=table,
        levels=[
            LevelReport(
                level,
                pictures=finished.pictures.get((level.zoom, level.focus), {}),
                evidence=finished.evidence.get((level.zoom, level.focus)),
            )
            for level in table.levels
        ],
        facts=[("method", table.method), ("pictures", f"{real} of the camera, {virtual} renders of the engine")],
    )
