"""``lensmatch compare`` and ``lensmatch tables``: two lens tables side by side, and the versions that are stored."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from app.bootstrap import utc_now
from app.cli.configuration import build_settings
from app.cli.console import WorkFailed, messages, print_json, reported_errors, results, say
from app.cli.exports import read_table_file
from app.cli.tables import plain_table, print_table
from app.comparison import ComparisonDocument, PlaceView, compared, in_words
from calibration.compare_tables import AGREEING_SIGMAS
from calibration.errors import InvalidInput
from storage.records import LensRecord, TableSummary
from storage.repository import Repository
from storage.schemas import format_utc


def compare(
    first: Annotated[Path, typer.Argument(metavar="FIRST.json", help="lens table")],
    second: Annotated[Path, typer.Argument(metavar="SECOND.json", help="lens table to compare with it")],
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
) -> None:
    """Compare two lens tables: how many pixels apart they put the same ray, level by level, and why.

    Says whether they agree within the sigmas that both state, where they are farthest apart, and what a constant centre
    shift or ratio of focal lengths explains of it. Tables of another picture size, pixel aspect or sensor are refused.
    """
    with reported_errors(as_json):
        tables = [read_table_file(path) for path in (first, second)]
        try:
            document = compared(*tables)
        except InvalidInput as error:
            raise WorkFailed(f"{second}: {error}") from error
        if as_json:
            print_json(document.model_dump(mode="json"))
        else:
            _show(document)


def _show(document: ComparisonDocument) -> None:
    one, other = document.first, document.second
    grid = plain_table(
        f"{one.lens} on {one.camera}, version {one.version}, against {other.lens} on {other.camera}, "
        f"version {other.version}; distance of the same ray, px",
        ("zoom", "focus", "level of", "rms", "max", "at u", "v", "sigmas", "shift x", "y px", "f ratio"),
    )
    for place in document.levels:
        if place.difference_px is not None:
            grid.add_row(*_row(place))
    print_table(grid)
    for place in document.levels:
        if place.reason is not None:
            where = f"zoom {place.zoom:.3f}, focus {place.focus:.2f}"
            messages.print(f"[dim]{where}: not compared, {escape(place.reason)}[/]")
    for found in () if document.agree else document.explanations:
        left = found.left_px
        results.print(f"without {in_words(found)}: {left.rms:.3f} px RMS, {left.max:.3f} px at most")
    results.print(escape(document.verdict))


def _row(place: PlaceView) -> tuple[str, ...]:
    difference, worst, shift = place.difference_px, place.worst_px, place.center_shift_px
    if difference is None or worst is None or shift is None or place.f_ratio is None:
        return (f"{place.zoom:.3f}", f"{place.focus:.2f}")
    level_of = {(True, True): "both", (True, False): "first", (False, True): "second"}[place.measured]
    sigmas = "-" if place.sigmas is None else f"{place.sigmas:.1f}"
    if place.sigmas is not None and place.sigmas > AGREEING_SIGMAS:
        sigmas = f"[yellow]{sigmas}[/]"
    return (
        f"{place.zoom:.3f}",
        f"{place.focus:.2f}",
        level_of,
        f"{difference.rms:.3f}",
        f"{difference.max:.3f}",
        f"{worst[0]:.0f}",
        f"{worst[1]:.0f}",
        sigmas,
        f"{shift[0]:+.3f}",
        f"{shift[1]:+.3f}",
        f"{place.f_ratio:.5f}",
    )


def tables(
    lens: Annotated[str | None, typer.Option(metavar="NAME", help="only the tables of this lens")] = None,
    database: Annotated[Path | None, typer.Option(help="SQLite file with jobs and lens tables")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
) -> None:
    """List the stored lens tables: every version, which one is approved, and where it comes from."""
    with reported_errors(as_json):
        settings = build_settings(database=database)
        if not settings.database.is_file():
            raise WorkFailed(f"{settings.database}: there is no database yet; a job or the service makes it")
        found = asyncio.run(_list(settings.database, lens))
        if lens is not None and not found:
            raise WorkFailed(f"{settings.database}: no table of a lens called {lens!r}; without --lens all are listed")
        if as_json:
            listed = [_entry(record, table) for record, table in found]
            print_json({"database": str(settings.database), "tables": listed})
        elif not found:
            say(f"{settings.database}: no lens table yet")
        else:
            _show_list(found)


async def _list(database: Path, lens: str | None) -> list[tuple[LensRecord, TableSummary]]:
    async with await Repository.open(database, utc_now) as ledger:
        lenses = [record for record in await ledger.list_lenses() if lens in (None, record.name)]
        return [(record, table) for record in lenses for table in await ledger.list_tables(record.id)]


def _entry(lens: LensRecord, table: TableSummary) -> dict[str, Any]:
    return {
        "id": table.id,
        "lens": lens.name,
        "camera": lens.camera,
        "version": table.version,
        "approved": table.approved,
        "created": format_utc(table.created),
        "job_id": table.job_id,
        "sha256": table.sha256,
        "provenance": None if table.provenance is None else asdict(table.provenance),
    }


def _show_list(found: list[tuple[LensRecord, TableSummary]]) -> None:
    grid = plain_table("lens tables, newest first", ("id", "lens", "camera", "version", "", "created", "from"))
    for lens, table in found:
        source = "" if table.provenance is None else f"{table.provenance.source} by {table.provenance.software}"
        grid.add_row(
            str(table.id),
            escape(lens.name),
            escape(lens.camera),
            str(table.version),
            "[green]approved[/]" if table.approved else "",
            f"{table.created:%Y-%m-%d %H:%M}",
            escape(source),
        )
    print_table(grid)
