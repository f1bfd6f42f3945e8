"""``lensmatch plot``: pictures of a lens table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import WorkFailed, check_out, print_json, reported_errors, say, write_file, wrong_usage
from app.cli.exports import read_table_file
from app.plots import PlotKind, PlotMedia, check, draw
from calibration.errors import CalibrationError, InvalidInput

_MEDIA = {f".{media.value}": media for media in PlotMedia}


def plot(
    table: Annotated[Path, typer.Argument(metavar="TABLE.json", help="lens table")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="file to write, .svg or .png")],
    kind: Annotated[PlotKind, typer.Option(help="what it shows")] = PlotKind.CURVES,
    zoom: Annotated[
        float | None, typer.Option(help="grid, uncertainty: the zoom; without it the wide end of the levels")
    ] = None,
    focus: Annotated[
        float | None, typer.Option(help="grid, uncertainty: the focus; without it the far end of the levels")
    ] = None,
    other: Annotated[
        Path | None, typer.Option("--with", metavar="OTHER.json", help="comparison: the second lens table")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
) -> None:
    """Draw a lens table as SVG or PNG.

    curves: every quantity over zoom, one line for each focus, with the measured levels. surfaces: field of view and
    distortion over zoom and focus. grid: the distortion at one place. uncertainty: the overlay error to expect, over
    the picture and over zoom and focus. comparison: how far a second table is from this one.
    """
    with reported_errors(as_json):
        media = _MEDIA.get(out.suffix.lower())
        if media is None:
            wrong_usage(f"--out {out.name!r} must end in {' or '.join(_MEDIA)}")
        try:
            check(kind, zoom, focus, other is not None)
        except InvalidInput as error:
            wrong_usage(str(error))
        check_out(out)
        first = read_table_file(table)
        second = None if other is None else read_table_file(other)
        try:
            picture = draw(first, kind, media, zoom=zoom, focus=focus, other=second)
        except CalibrationError as error:
            raise WorkFailed(f"{table}: {error}") from error
        write_file(out, picture)
        if as_json:
            print_json({"out": str(out), "kind": kind.value})
        else:
            say(f"{kind.value}: {out}")
