"""Jobs: submitting, listing, cancelling, their events as a list, and the pictures of their levels."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query
from starlette.requests import Request
from starlette.responses import Response

from app.api.answers import document, tagged
from app.api.context import PREFIX, AppContext, Context
from app.api.errors import Problem, responses
from app.api.models import EventList, JobDetail, JobsPage, JobView
from app.events import message
from app.job_documents import AnyJob
from storage.records import PictureKind

router = APIRouter(tags=["jobs"])

MAX_SEQ = 2**53
"""Numbers beyond it are not exact in every client, and no job has so many events."""

SHOWN_MEDIA_TYPES = frozenset({"image/jpeg", "image/png"})
"""What a browser only ever shows as a picture."""

JobId = Annotated[str, Path(min_length=1, max_length=64, description="the job's id")]
Encoder = Annotated[float, Path(ge=0, le=1, allow_inf_nan=False, description="encoder value, 0 to 1")]


IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=200,
        pattern=r"^[\x21-\x7e]+$",
        description="the same key and job again give the job made before, also after a restart",
    ),
]
LOCATION: dict[int | str, dict[str, Any]] = {
    201: {"headers": {"Location": {"description": "the job", "schema": {"type": "string"}}}}
}
"""What a route that submits a job answers with."""


def require_json(request: Request) -> None:
    """Refuse a body that does not say it is JSON; a form of a foreign page never does."""
    given = request.headers.get("content-type", "")
    kind = given.partition(";")[0].strip().lower()
    if kind != "application/json" and not (kind.startswith("application/") and kind.endswith("+json")):
        raise Problem("media-type", f"Content-Type is {given[:80]!r}; send the job as application/json")


@router.post(
    "/jobs",
    status_code=201,
    response_model=JobView,
    dependencies=[Depends(require_json)],
    responses={
        **LOCATION,
        **responses(
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
async def submit_job(
    job: AnyJob,
    context: Context,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Store a job of any kind and queue it."""
    return await submitted(job, context, response, idempotency_key)


async def submitted(job: AnyJob, context: AppContext, response: Response, idempotency_key: str | None) -> JobView:
    """Submit a job, and say in the response where it is."""
    record = await context.runner.submit(job, idempotency_key=idempotency_key)
    response.headers["Location"] = f"{PREFIX}/jobs/{record.id}"
    return JobView.of(record)


@router.get("/jobs", response_model=JobsPage, responses=responses("invalid"))
async def list_jobs(
    context: Context,
    cursor: Annotated[str | None, Query(pattern=r"^[0-9]{1,18}$", description="next_cursor of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=200, description="most jobs on a page")] = 50,
) -> JobsPage:
    """Jobs in pages, newest first."""
    page = await context.repository.list_jobs(cursor, limit)
    return JobsPage(jobs=[JobView.of(job) for job in page.jobs], next_cursor=page.next_cursor)


@router.get("/jobs/{job_id}", response_model=JobDetail, responses=responses("not-found", "invalid"))
async def get_job(job_id: JobId, context: Context) -> Response:
    """One job, with the levels stored so far."""
    job = await context.repository.get_job(job_id)
    levels = await context.repository.list_levels(job_id)
    table = await context.repository.table_of_job(job_id)
    return await document(lambda: JobDetail.build(job, levels, table))


@router.post(
    "/jobs/{job_id}/cancel",
    status_code=202,
    response_model=JobView,
    responses=responses("origin-refused", "not-found", "conflict", "invalid"),
)
async def cancel_job(job_id: JobId, context: Context) -> JobView:
    """End a job at once. Its engine gets its values back, its finished levels are kept; an ended job stays as it is."""
    return JobView.of(await context.runner.cancel(job_id))


@router.get("/jobs/{job_id}/events", response_model=EventList, responses=responses("not-found", "invalid"))
async def list_events(
    job_id: JobId,
    context: Context,
    after: Annotated[int, Query(ge=0, le=MAX_SEQ, description="seq of the last event that is known")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000, description="most events")] = 500,
) -> Response:
    """Events of a job after ``after``, oldest first. The same path as a WebSocket goes on with the live ones."""
    records = await context.repository.events_after(job_id, after, limit)
    last = records[-1].seq if records else after
    more = len(records) == limit and (await context.repository.get_job(job_id)).last_seq > last
    return await document(lambda: EventList.build([message(record) for record in records], after, more))


@router.get(
    "/jobs/{job_id}/levels/{zoom}/{focus}/picture",
    response_class=Response,
    responses={
        200: {"content": {kind: {} for kind in sorted(SHOWN_MEDIA_TYPES)}, "description": "the picture"},
        304: {"description": "the client has it already"},
        **responses("not-found", "invalid"),
    },
)
async def get_picture(
    job_id: JobId,
    zoom: Encoder,
    focus: Encoder,
    context: Context,
    request: Request,
    kind: Annotated[PictureKind, Query(description="which picture")] = PictureKind.OVERLAY,
) -> Response:
    """A picture of a level that has been stored."""
    level = await context.repository.find_level(job_id, zoom, focus)
    picture = await context.repository.get_picture(job_id, level.ordinal, kind)
    media_type = picture.media_type if picture.media_type in SHOWN_MEDIA_TYPES else "application/octet-stream"
    return tagged(request, f'"{hashlib.sha256(picture.data).hexdigest()}"', picture.data, media_type)


@router.get(
    "/jobs/{job_id}/levels/{zoom}/{focus}/evidence",
    response_class=Response,
    responses={
        200: {"content": {"application/json": {}}, "description": "docs/reference/level-evidence.schema.json"},
        304: {"description": "the client has it already"},
        **responses("not-found", "invalid"),
    },
)
async def get_evidence(job_id: JobId, zoom: Encoder, focus: Encoder, context: Context, request: Request) -> Response:
    """What a stored level's numbers rest on, and all that is needed to solve it again."""
    evidence = await context.repository.get_evidence(job_id, zoom, focus)
    return tagged(request, f'"{evidence.sha256}"', evidence.document, "application/json")
