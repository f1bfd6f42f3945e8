"""``lensmatch export`` and ``lensmatch import``: a lens table in other formats, and back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import check_out, print_json, read_file, reported_errors, say, write_file, wrong_usage
from app.cli.tables import show_table
from app.documents import DocumentError
from app.jobs.provenance import imported
from app.lens_at import table_at
from calibration.tables import LensTable
from storage.errors import BadDocument, CannotExport
from storage.exports import EXPORTS, Export
from storage.exports.base import lens_levels
from storage.schemas import table_to_document

_FORMATS = ", ".join(EXPORTS)
Format = Annotated[str, typer.Option("--format", metavar="NAME", help=f"one of: {_FORMATS}")]
AsJson = Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")]


def export_table(
    table: Annotated[Path, typer.Argument(metavar="TABLE.json", help="lens table")],
    format_name: Format,
    out: Annotated[Path, typer.Option(help="file to write")],
    zoom: Annotated[float | None, typer.Option(help="only this zoom; with --focus the lens at that place")] = None,
    focus: Annotated[float | None, typer.Option(help="only this focus")] = None,
    overscan: Annotated[
        float | None,
        typer.Option(metavar="FACTOR", help="ST maps: size of the undistorted picture over the camera's, 1 to 2"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a lens table in another format. What the format cannot hold is said, not dropped in silence."""
    with reported_errors(as_json):
        export = _export(format_name)
        if overscan is not None and export.write_overscan is None:
            wrong_usage(f"--overscan is for ST maps; {export.name} has none")
        check_out(out)
        read = _part(read_table_file(table), zoom, focus)
        if overscan is not None and export.write_overscan is not None:
            write_file(out, export.write_overscan(read, overscan))
        else:
            write_file(out, export.write(read))
        advice = [export.advice(read)] if export.advice else []
        if as_json:
            told = {"out": str(out), "format": export.name, "cannot_carry": list(export.cannot_carry)}
            print_json(told | ({"advice": advice} if advice else {}))
        else:
            levels = lens_levels(read) if export.cannot_carry else read.levels
            say(f"{export.title}: {out}, {len(levels)} of {len(read.levels)} levels")
            for what in export.cannot_carry:
                say(f"not in this format: {what}")
            for line in advice:
                say(line)


def import_table(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="file to read")],
    format_name: Format,
    out: Annotated[Path | None, typer.Option(help="lens table (JSON) to write; without it, it is shown")] = None,
    fov_x: Annotated[
        float | None,
        typer.Option(metavar="DEGREES", help="field of view across, for a file that does not tell it (ST maps)"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Read a lens table from another format, check it, and show it or write it as JSON."""
    with reported_errors(as_json):
        export = _export(format_name)
        if fov_x is not None and export.read_with_fov is None:
            wrong_usage(f"--fov-x is for ST maps; {export.name} tells the field of view")
        check_out(out)
        data = read_file(path, export.max_bytes)
        table = imported(_parse(path, data, export, fov_x), data, export)
        if out is not None:
            write_file(out, EXPORTS["json"].write(table))
        if as_json:
            print_json(table_to_document(table))
        elif out is not None:
            say(f"lens table: {out}, {len(table.levels)} levels")
        else:
            show_table(table)


def _export(name: str) -> Export:
    export = EXPORTS.get(name)
    if export is None:
        wrong_usage(f"no format is called {name!r}; there are: {_FORMATS}")
    return export


def read_table_file(path: Path) -> LensTable:
    """The lens table in a JSON file. Raises :class:`app.documents.DocumentError` in one line."""
    export = EXPORTS["json"]
    return _parse(path, read_file(path, export.max_bytes), export)


def _part(table: LensTable, zoom: float | None, focus: float | None) -> LensTable:
    """The levels of this zoom and of this focus; with both, the lens at that place."""
    if zoom is not None and focus is not None:
        return table_at(table, zoom, focus)
    levels = tuple(level for level in table.levels if zoom in (None, level.zoom) and focus in (None, level.focus))
    if not levels:
        what, values = ("focus", {level.focus for level in table.levels})
        if zoom is not None:
            what, values = ("zoom", {level.zoom for level in table.levels})
        told = ", ".join(f"{value:g}" for value in sorted(values)[:20])
        raise CannotExport(f"no level has this {what}; the table has {what} {told}")
    return replace(table, levels=levels)


def _parse(path: Path, data: bytes, export: Export, fov_x_deg: float | None = None) -> LensTable:
    try:
        if fov_x_deg is not None and export.read_with_fov is not None:
            return export.read_with_fov(data, fov_x_deg)
        return export.read(data)
    except BadDocument as error:
        raise DocumentError(f"{path}: {error}") from error
