"""``lensmatch export`` and ``lensmatch import``: a lens table in other formats, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import check_out, print_json, read_file, reported_errors, say, write_file, wrong_usage
from app.cli.tables import show_table
from app.documents import DocumentError
from calibration.tables import LensTable
from storage.errors import BadDocument
from storage.exports import EXPORTS, Export
from storage.exports.base import MAX_DOCUMENT_BYTES
from storage.schemas import table_to_document

_FORMATS = ", ".join(EXPORTS)
Format = Annotated[str, typer.Option("--format", metavar="NAME", help=f"one of: {_FORMATS}")]
AsJson = Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")]


def export_table(
    table: Annotated[Path, typer.Argument(metavar="TABLE.json", help="lens table")],
    format_name: Format,
    out: Annotated[Path, typer.Option(help="file to write")],
    as_json: AsJson = False,
) -> None:
    """Write a lens table in another format. What the format cannot hold is said, not dropped in silence."""
    with reported_errors(as_json):
        export = _export(format_name)
        check_out(out)
        read = _read(table, EXPORTS["json"])
        write_file(out, export.write(read))
        remarks = export.remarks(read) if export.remarks is not None else ()
        if as_json:
            lost = list(export.cannot_carry)
            print_json({"out": str(out), "format": export.name, "cannot_carry": lost, "remarks": list(remarks)})
        else:
            say(f"{export.title}: {out}, {len(read.levels)} levels")
            for remark in remarks:
                say(remark)
            for what in export.cannot_carry:
                say(f"not in this format: {what}")


def import_table(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="file to read")],
    format_name: Format,
    out: Annotated[Path | None, typer.Option(help="lens table (JSON) to write; without it, it is shown")] = None,
    as_json: AsJson = False,
) -> None:
    """Read a lens table from another format, check it, and show it or write it as JSON."""
    with reported_errors(as_json):
        export = _export(format_name)
        check_out(out)
        table = _read(path, export)
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


def _read(path: Path, export: Export) -> LensTable:
    data = read_file(path, MAX_DOCUMENT_BYTES)
    try:
        return export.read(data)
    except BadDocument as error:
        raise DocumentError(f"{path}: {error}") from error
