"""Publishing a stored lens table to an engine."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path
from starlette.responses import Response

from app.api.context import Context
from app.api.errors import responses
from app.api.jobs import LOCATION, IdempotencyKey, require_json, submitted
from app.api.models import JobView
from app.job_documents import PublishOptions, PublishRequest

router = APIRouter(tags=["lenses"])


@router.post(
    "/tables/{table_id}/publish",
    status_code=201,
    response_model=JobView,
    dependencies=[Depends(require_json)],
    responses={
        **LOCATION,
        **responses(
            "origin-refused",
            "not-found",
            "body-too-large",
            "media-type",
            "invalid",
            "unknown-engine",
            "studio-mismatch",
            "idempotency-conflict",
            "queue-full",
        ),
        **responses("storage-full"),
    },
)
async def publish_table(
    table_id: Annotated[int, Path(ge=1, le=2**53)],
    options: PublishOptions,
    context: Context,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Queue a job that writes a table's lens to an engine, reads it back and compares renders; its events tell more."""
    job = PublishRequest(kind="publish", table_id=table_id, **dict(options))
    return await submitted(job, context, response, idempotency_key)
