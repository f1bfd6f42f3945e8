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
from app.lens_at import surface_fit
from calibration.errors import CalibrationError, InvalidInput
from calibration.surface import SurfaceFit
from storage.errors import BadDocument
from storage.exports import EXPORTS, Export
from storage.schemas import PixelErrorDocument, SigmaDocument

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


class LeftOutLevel(BaseModel):
    """A level that does not fit its neighbours, or has no lens."""

    model_config = ConfigDict(frozen=True)

    zoom: float
    focus: float
    reason: str


class LensAtView(BaseModel):
    """The lens at a place, level or not, with one sigma of each quantity."""

    model_config = ConfigDict(frozen=True)

    zoom: float = Field(description="where it was read")
    focus: float
    clamped: bool = Field(description="whether that is not where it was asked for, which lies outside the levels")
    fov_x_deg: float
    fov_y_deg: float
    f_px: float
    k1: float
    k2: float
    k1_hw: float
    k2_hw: float
    center_shift_px: tuple[float, float]
    nodal_offset_mm: float | None = Field(description="null: no level tells it")
    sigma: SigmaDocument
    predicted_overlay_px: PixelErrorDocument = Field(description="overlay error to expect there, one sigma")
    left_out: list[LeftOutLevel] = Field(description="levels that the surface does not use, and why")

    @classmethod
    def of(cls, fit: SurfaceFit, zoom: float, focus: float) -> LensAtView:
        """The lens of a surface at a place."""
        found = fit.surface.at(zoom, focus)
        lens, sigma = found.lens, found.sigma
        return cls(
            zoom=found.zoom,
            focus=found.focus,
            clamped=found.clamped,
            fov_x_deg=lens.fov_x_deg,
            fov_y_deg=lens.fov_y_deg,
            f_px=lens.f_px,
            k1=lens.k1,
            k2=lens.k2,
            k1_hw=lens.k1_hw,
            k2_hw=lens.k2_hw,
            center_shift_px=lens.center_shift_px,
            nodal_offset_mm=lens.nodal_offset_mm if found.nodal_told else None,
            sigma=SigmaDocument(
                fov_x_deg=sigma.fov_x_deg,
                k1=sigma.k1,
                k2=sigma.k2,
                center_shift_px=sigma.center_shift_px,
                nodal_offset_mm=sigma.nodal_offset_mm,
            ),
            predicted_overlay_px=PixelErrorDocument(rms=found.predicted_px.rms, max=found.predicted_px.max),
            left_out=[
                LeftOutLevel(zoom=check.zoom, focus=check.focus, reason=check.reason or "")
                for check in fit.checks
                if not check.used
            ],
        )


@router.get("/tables/{table_id}/at", response_model=LensAtView, responses=responses("not-found", "invalid"))
async def lens_at_place(
    table_id: Id,
    context: Context,
    zoom: Annotated[float, Query(ge=0, le=1, allow_inf_nan=False, description="encoder value, 0 wide to 1 tele")],
    focus: Annotated[float, Query(ge=0, le=1, allow_inf_nan=False, description="encoder value, 0 infinity to 1 near")],
) -> LensAtView:
    """The lens at any zoom and focus, by one smooth fit over all levels of the table; held outside their range."""
    record = await context.repository.get_table(table_id)
    try:
        fit = await asyncio.to_thread(surface_fit, record.table)
    except CalibrationError as error:
        raise Problem("not-comparable", f"the table's levels make no surface: {error}") from error
    return LensAtView.of(fit, zoom, focus)
