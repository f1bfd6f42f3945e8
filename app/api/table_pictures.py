"""Pictures of a stored lens table."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Query
from starlette.requests import Request
from starlette.responses import Response

from app.api.answers import tagged, unchanged
from app.api.context import Context
from app.api.errors import FieldError, Problem, responses
from app.api.lenses import Id
from app.plots import DRAWING, PlotKind, PlotMedia, check, draw
from calibration.errors import CalibrationError, InvalidInput

router = APIRouter(tags=["lenses"])


@router.get(
    "/tables/{table_id}/picture",
    response_class=Response,
    responses={
        200: {"content": {media.media_type: {} for media in PlotMedia}, "description": "the picture"},
        304: {"description": "the client has it already"},
        **responses("not-found", "not-comparable", "invalid"),
    },
)
async def table_picture(
    table_id: Id,
    context: Context,
    request: Request,
    kind: Annotated[PlotKind, Query(description="what it shows")] = PlotKind.CURVES,
    format: Annotated[PlotMedia, Query(description="file format")] = PlotMedia.SVG,
    zoom: Annotated[
        float | None, Query(ge=0, le=1, allow_inf_nan=False, description="grid, uncertainty: encoder value; wide end")
    ] = None,
    focus: Annotated[
        float | None, Query(ge=0, le=1, allow_inf_nan=False, description="grid, uncertainty: encoder value; far end")
    ] = None,
    other_id: Annotated[
        int | None, Query(alias="with", ge=1, le=2**53, description="comparison: id of the second table")
    ] = None,
) -> Response:
    """A picture of a lens table, or of two compared. The same table gives the same picture."""
    try:
        check(kind, zoom, focus, other_id is not None)
    except InvalidInput as error:
        raise _invalid(error) from error
    record = await context.repository.get_table(table_id)
    other = None if other_id is None else await context.repository.get_table(other_id)
    parts = [record.summary.sha256, "picture", DRAWING, kind.value, format.value, zoom, focus]
    parts += [] if other is None else [other.summary.sha256]
    tag = '"' + "-".join("" if part is None else str(part) for part in parts) + '"'
    if unchanged(request, tag):  # before the work: drawing takes a second
        return tagged(request, tag, b"", format.media_type)
    second = None if other is None else other.table
    try:
        # One at a time: waiting in threads, many requests would leave none for the service's other work.
        async with request.app.state.drawing:
            body = await asyncio.to_thread(draw, record.table, kind, format, zoom=zoom, focus=focus, other=second)
    except InvalidInput as error:
        if error.what == "place":
            raise _invalid(error) from error
        raise Problem("not-comparable", str(error)) from error
    except CalibrationError as error:
        raise Problem("not-comparable", f"the table's levels make no surface: {error}") from error
    return tagged(request, tag, body, format.media_type)


def _invalid(error: InvalidInput) -> Problem:
    """What is wrong with the query, at its field."""
    field = f"query.{'zoom' if error.what == 'place' else error.what}"
    return Problem("invalid", f"{field}: {error}", errors=[FieldError(field=field, message=str(error))])
