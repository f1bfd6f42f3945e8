"""``lensmatch calibrate``: a lens table from a folder of pictures."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from app.bootstrap import utc_now
from app.cli.alternating_set import calibrate_alternating
from app.cli.console import Show, WorkFailed, check_out, print_json, progress_bar, reported_errors, say, write_file
from app.cli.tables import show_table
from app.documents import PictureSet, read_picture_set
from app.jobs.cpu import Cpu
from app.jobs.provenance import provenance_of_set, sha256_of_all
from app.picture_sets import SetLevel, calibrate_set, table_of
from app.report import picture_set_report, write_report
from app.settings import default_cpu_workers
from calibration.tables import LensTable, LevelResult, LevelStatus
from engine_adapters.errors import AdapterError
from engine_adapters.folder import FolderPictures
from storage.evidence import evidence_file, evidence_path, evidence_to_document
from storage.exports import EXPORTS
from storage.schemas import table_to_document


class Method(StrEnum):
    """How a level is solved."""

    JOINT = "joint"
    ALTERNATING = "alternating"


def calibrate(
    picture_set: Annotated[Path, typer.Argument(metavar="PICTURE_SET", help="folder with a set.json")],
    method: Annotated[
        Method,
        typer.Option(
            help="joint: all pictures of a level at once. alternating: the study's, as a baseline; it needs the four "
            "pictures center_shift, fov, k1, k2 of each level with camera and target poses"
        ),
    ] = Method.JOINT,
    out: Annotated[Path | None, typer.Option(help="lens table (JSON) to write, NAME.evidence.json beside it")] = None,
    report: Annotated[Path | None, typer.Option(help="report (HTML) to write")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the lens table as JSON on standard output")] = False,
) -> None:
    """Calibrate a lens from a folder of pictures, without an engine.

    Prints each level with its sigmas and errors. Pictures of no use are left out with their reasons; a level with too
    little left fails with its reason and the others go on.
    """
    with reported_errors(as_json):
        check_out(out, report)
        if picture_set.is_dir() and not (picture_set / "set.json").is_file():
            raise WorkFailed(f"{picture_set}: there is no set.json in this folder; write one, it says what is pictured")
        described = read_picture_set(picture_set)
        folder = picture_set if picture_set.is_dir() else picture_set.parent
        with progress_bar("calibrate") as show:
            table, levels = asyncio.run(_calibrate(described, folder, method, show))
        if out is not None:
            write_file(out, EXPORTS["json"].write(table))
            told = [evidence_to_document(level.evidence) for level in levels if level.evidence is not None]
            write_file(evidence_path(out), evidence_file(told))
        if report is not None:
            facts = [("method", table.method), ("pictures", f"{len(described.pictures)}")]
            write_report(report, picture_set_report(f"{table.lens} on {table.camera}", table, levels, facts))
        if as_json:
            print_json(table_to_document(table))
        else:
            show_table(table)
        for path in (out, report):
            if path is not None:
                say(f"written: {path}")


async def _calibrate(
    described: PictureSet, folder: Path, method: Method, show: Show
) -> tuple[LensTable, list[SetLevel]]:
    cpu = Cpu(default_cpu_workers())
    pictures_sha256 = None
    try:
        pictures = FolderPictures(folder)
        if method is Method.JOINT:
            levels = await calibrate_set(described, pictures, cpu, show)
        else:
            results = await calibrate_alternating(described, pictures, cpu, show)
            levels = [SetLevel(result, None, ()) for result in results]
        if all(level.result.evidence is None for level in levels):
            pictures_sha256 = await _pictures_sha256(described, pictures)
    finally:
        cpu.close()
    if not any(_is_measured(level.result) for level in levels):
        raise WorkFailed(_why_nothing(described, levels), [level.result for level in levels])
    table = table_of(described, levels, utc_now())
    return replace(table, method=method.value, provenance=provenance_of_set(table.levels, pictures_sha256)), levels


async def _pictures_sha256(described: PictureSet, pictures: FolderPictures) -> str:
    """Over the files of the set in its order, unreadable ones left out: for a method that keeps no evidence."""
    hashes = []
    for name in dict.fromkeys(picture.file for picture in described.pictures):
        with contextlib.suppress(AdapterError):
            hashes.append(hashlib.sha256((await pictures.read(name)).data).hexdigest())
    return sha256_of_all(hashes)


def _is_measured(result: LevelResult) -> bool:
    return result.status is not LevelStatus.FAILED


def _why_nothing(described: PictureSet, levels: list[SetLevel]) -> str:
    """The reasons of the levels, and the first pictures left out that these do not name already; each reason once."""
    told = "; ".join(dict.fromkeys(level.result.reason or "unknown" for level in levels))
    left_out = []
    for left in (left for level in levels for left in level.result.left_out):
        twice = f"{left.picture}: {left.picture}: "
        line = f"{left.picture}: {left.reason}".replace(twice, twice[len(left.picture) + 2 :])
        told = told.replace(twice, twice[len(left.picture) + 2 :])
        if line not in told and line not in left_out:
            left_out.append(line)
    more = f" (left out: {'; '.join(left_out[:3])}{' ...' if len(left_out) > 3 else ''})" if left_out else ""
    return f"{described.lens}: no level could be measured: {told}{more}"
