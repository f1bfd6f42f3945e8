"""Versions of lens tables: storing one from a file, approving, rolling back, their history, comparing two."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Body, Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import Response

from app.api.answers import document
from app.api.context import PREFIX, Context
from app.api.errors import FieldError, Problem, responses
from app.api.lenses import Id, export_of
from app.api.models import ActionList, ActionView, TableView
from app.comparison import ComparisonDocument, compared
from app.documents import Name
from app.jobs.provenance import imported
from calibration.errors import CalibrationError, InvalidInput
from storage.errors import BadDocument
from storage.exports import EXPORTS, Export

router = APIRouter(tags=["lenses"])

RAW = "application/octet-stream"
"""A file of any format may come as this."""

Note = Annotated[str, Field(min_length=1, max_length=1000)]


class ActionRequest(BaseModel):
    """Who does it, and why; the service knows no users, it keeps what it is told."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    by: Name | None = Field(default=None, description="who")
    note: Note | None = Field(default=None, description="why, or whatever a reader of the history should know")


OptionalAction = Annotated[ActionRequest | None, Body(description="who and why; may be left out")]


@router.post(
    "/tables",
    status_code=201,
    response_model=TableView,
    responses={
        200: {"model": TableView, "description": "the same file was stored before: that version"},
        201: {"headers": {"Location": {"description": "the table", "schema": {"type": "string"}}}},
        **responses("origin-refused", "body-too-large", "media-type", "invalid", "name-clash", "storage-full"),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {kind: {} for kind in [*dict.fromkeys(export.media_type for export in EXPORTS.values()), RAW]},
        }
    },
)
async def import_table(
    context: Context,
    request: Request,
    response: Response,
    format: Annotated[str, Query(json_schema_extra={"enum": [*EXPORTS]}, description="format of the body")] = "json",
    lens: Annotated[Name | None, Query(description="store it as this lens instead of the one it names")] = None,
    camera: Annotated[Name | None, Query(description="store it for this camera instead of the one it names")] = None,
    other_picture: Annotated[
        bool, Query(description="also where the lens has tables of another picture size, pixel aspect or sensor")
    ] = False,
    by: Annotated[Name | None, Query(description="who")] = None,
    note: Annotated[Note | None, Query(description="why")] = None,
) -> TableView:
    """Store a lens table from a file, whichever export format it is in, as the next version of its lens and camera."""
    export = export_of(format)
    _require_media_type(request, export)
    data = await request.body()
    try:
        read = await asyncio.to_thread(lambda: imported(export.read(data), data, export))
        table = replace(read, lens=lens or read.lens, camera=camera or read.camera)
    except (BadDocument, CalibrationError) as error:
        raise Problem("invalid", str(error), errors=[FieldError(field="body", message=str(error))]) from error
    summary, is_new = await context.repository.import_table(table, by=by, note=note, other_picture_too=other_picture)
    response.headers["Location"] = f"{PREFIX}/tables/{summary.id}"
    if not is_new:
        response.status_code = 200
    return TableView.of(summary)


@router.post(
    "/tables/{table_id}/approve",
    response_model=TableView,
    responses=responses("origin-refused", "not-found", "invalid"),
)
async def approve_table(table_id: Id, context: Context, action: OptionalAction = None) -> TableView:
    """Make a table the approved one of its lens, instead of the one before. Approving it again changes nothing."""
    told = action or ActionRequest()
    return TableView.of(await context.repository.approve_table(table_id, by=told.by, note=told.note))


@router.post(
    "/tables/{table_id}/rollback",
    response_model=TableView,
    responses=responses("origin-refused", "not-found", "conflict", "invalid"),
)
async def roll_back_table(table_id: Id, context: Context, action: OptionalAction = None) -> TableView:
    """Take the approval of the approved table back: the one approved before it is approved again, and answered."""
    told = action or ActionRequest()
    return TableView.of(await context.repository.roll_back_table(table_id, by=told.by, note=told.note))


@router.get("/tables/{table_id}/history", response_model=ActionList, responses=responses("not-found", "invalid"))
async def table_history(
    table_id: Id,
    context: Context,
    limit: Annotated[int, Query(ge=1, le=1000, description="most actions")] = 200,
) -> ActionList:
    """What was done with a table, and what took its approval, newest first."""
    history = await context.repository.table_history(table_id, limit)
    return ActionList(actions=[ActionView.of(action) for action in history])


@router.get(
    "/tables/{table_id}/compare",
    response_model=ComparisonDocument,
    responses=responses("not-found", "not-comparable", "invalid"),
)
async def compare_with(
    table_id: Id,
    context: Context,
    other_id: Annotated[int, Query(alias="with", ge=1, le=2**53, description="id of the second table")],
) -> Response:
    """How far another table is from this one, in px of overlay: at each level, over zoom and focus, and why."""
    first = (await context.repository.get_table(table_id)).table
    second = (await context.repository.get_table(other_id)).table
    try:
        return await document(lambda: compared(first, second))
    except InvalidInput as error:
        raise Problem("not-comparable", str(error)) from error


def _require_media_type(request: Request, export: Export) -> None:
    """Refuse a body that does not say it is a file of this format; a form of a foreign page never does."""
    given = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if given not in (export.media_type, RAW):
        told = f"send a {export.name} file as {export.media_type} or {RAW}"
        raise Problem("media-type", f"Content-Type is {given[:80]!r}; {told}")
