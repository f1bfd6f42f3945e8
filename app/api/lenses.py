"""Lenses and their tables, as JSON and in every export format."""

from __future__ import annotations

import asyncio
import re
from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Path, Query
from starlette.requests import Request
from starlette.responses import Response

from app.api.answers import tagged, unchanged
from app.api.context import Context
from app.api.errors import FieldError, Problem, responses
from app.api.models import LensList, LensView, TableList, TableView
from calibration.tables import LensTable
from storage.errors import CannotExport
from storage.exports import EXPORTS
from storage.schemas import LensTableDocument

router = APIRouter(tags=["lenses"])

Id = Annotated[int, Path(ge=1, le=2**53)]


@router.get("/lenses", response_model=LensList)
async def list_lenses(context: Context) -> LensList:
    """Every lens and camera that has a table, by name."""
    return LensList(lenses=[LensView.of(lens) for lens in await context.repository.list_lenses()])


@router.get("/lenses/{lens_id}/tables", response_model=TableList, responses=responses("not-found", "invalid"))
async def list_tables(lens_id: Id, context: Context) -> TableList:
    """The tables of a lens, newest first."""
    return TableList(tables=[TableView.of(table) for table in await context.repository.list_tables(lens_id)])


@router.get(
    "/tables/{table_id}",
    response_model=LensTableDocument,
    responses={
        200: {"content": {export.media_type: {} for export in EXPORTS.values()}, "description": "the lens table"},
        304: {"description": "the client has it already"},
        **responses("not-found", "invalid"),
    },
)
async def get_table(
    table_id: Id,
    context: Context,
    request: Request,
    format: Annotated[
        str | None,
        Query(json_schema_extra={"enum": [*EXPORTS]}, description="export format; given, it comes as a file to save"),
    ] = None,
) -> Response:
    """A lens table: JSON, or one of the export formats. A stored table never changes."""
    export = EXPORTS.get(format or "json")
    if export is None:
        why = f"there is no format {format[:40] if format else ''!r}; there are {', '.join(EXPORTS)}"
        raise Problem("invalid", f"query.format: {why}", errors=[FieldError(field="query.format", message=why)])
    record = await context.repository.get_table(table_id)
    tag = f'"{record.summary.sha256}"' if export.name == "json" else f'"{record.summary.sha256}-{export.name}"'
    if unchanged(request, tag):  # before the work: ST maps take seconds
        return tagged(request, tag, b"", export.media_type)
    try:
        body = await asyncio.to_thread(export.write, record.table)
    except CannotExport as error:
        raise Problem(
            "invalid", f"query.format: {error}", errors=[FieldError(field="query.format", message=str(error))]
        ) from error
    disposition = None if format is None else attachment(record.table, export.suffix)
    return tagged(request, tag, body, export.media_type, disposition)


def attachment(table: LensTable, suffix: str) -> str:
    """The Content-Disposition of a table to save: a plain name, and the true one for clients that know RFC 6266."""
    name = f"{table.lens} {table.camera} v{table.version}"
    plain = re.sub(r"[^A-Za-z0-9.-]+", "_", name).strip("._") or "lens_table"
    shown = re.sub(r'[\x00-\x1f\x7f"*/:<>?\\|]+', "_", name)
    return f"attachment; filename=\"{plain}{suffix}\"; filename*=UTF-8''{quote(shown + suffix, safe='')}"
