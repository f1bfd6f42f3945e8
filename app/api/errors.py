"""One table: which error becomes which problem (RFC 9457, ``application/problem+json``).

``type`` is stable (``urn:lensmatch:problem:`` and a name of :data:`PROBLEMS`), ``title`` says it in words, ``detail``
is one line: what, where, what to do. Nothing else of an error leaves the service.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from app import engines
from app.errors import QueueFull, TooManyListeners
from storage import errors as storage_errors

log = logging.getLogger("lensmatch.api")

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:lensmatch:problem:"
HARDENING = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
}
"""Headers of every response that does not bring its own."""
MAX_FIELD_ERRORS = 50
"""More wrong fields than a person reads; the first ones are told."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of problem: HTTP status and title. ``retry``: the same request may succeed later."""

    status: int
    title: str
    retry: bool = False


PROBLEMS: dict[str, Kind] = {
    "bad-request": Kind(400, "The request cannot be read"),
    "host-refused": Kind(400, "The service does not answer to this name"),
    "origin-refused": Kind(403, "Pages of another origin may not do this"),
    "not-found": Kind(404, "There is no such thing"),
    "method-not-allowed": Kind(405, "This cannot be done here"),
    "conflict": Kind(409, "The state of things does not allow it"),
    "engine-busy": Kind(409, "The engine is in use"),
    "body-too-large": Kind(413, "The request is too large"),
    "media-type": Kind(415, "The body is of a type not taken here"),
    "invalid": Kind(422, "The request has wrong fields"),
    "unknown-engine": Kind(422, "There is no such engine"),
    "studio-mismatch": Kind(422, "The job and the engine's studio profile disagree"),
    "idempotency-conflict": Kind(422, "The idempotency key belongs to another request"),
    "queue-full": Kind(429, "Too many jobs are waiting", retry=True),
    "internal": Kind(500, "A mistake of the service"),
    "stored-document-damaged": Kind(500, "What is stored cannot be read"),
    "not-ready": Kind(503, "The service is not ready", retry=True),
    "too-many-listeners": Kind(503, "Too many event sockets are open", retry=True),
    "storage-busy": Kind(503, "The database is held by another process", retry=True),
    "storage-unusable": Kind(503, "The database cannot be used"),
    "storage-full": Kind(507, "No space left for the database", retry=True),
}

_ERRORS: dict[type[Exception], str] = {
    engines.UnknownEngine: "unknown-engine",
    engines.EngineInUse: "engine-busy",
    engines.StudioMismatch: "studio-mismatch",
    engines.EngineError: "conflict",
    QueueFull: "queue-full",
    TooManyListeners: "too-many-listeners",
    storage_errors.NotFound: "not-found",
    storage_errors.IdempotencyConflict: "idempotency-conflict",
    storage_errors.StaleState: "conflict",
    storage_errors.EngineBusy: "engine-busy",
    storage_errors.AlreadyStored: "conflict",
    storage_errors.TooLarge: "body-too-large",
    storage_errors.BadDocument: "stored-document-damaged",
    storage_errors.StorageBusy: "storage-busy",
    storage_errors.StorageFull: "storage-full",
    storage_errors.DatabaseUnusable: "storage-unusable",
    storage_errors.StorageError: "storage-unusable",
}

_STATUS_NAMES = {404: "not-found", 405: "method-not-allowed", 413: "body-too-large", 415: "media-type"}


class FieldError(BaseModel):
    """One wrong field."""

    field: str = Field(description="where: body.levels.0.zoom, query.limit, header.idempotency-key ...")
    message: str = Field(description="what is wrong with it")


class ProblemDocument(BaseModel):
    """An error as clients get it (RFC 9457)."""

    type: str = Field(description=f"{TYPE_PREFIX}NAME, stable")
    title: str
    status: int
    detail: str = Field(description="one line: what, where, what to do")
    instance: str = Field(description="the path that was asked for")
    errors: list[FieldError] | None = Field(default=None, description="the wrong fields, where there are some")


class Problem(Exception):
    """A refusal that the routes themselves raise. ``name`` is one of :data:`PROBLEMS`."""

    def __init__(self, name: str, detail: str, *, errors: Sequence[FieldError] = ()) -> None:
        self.name = name
        self.detail = detail
        self.errors = tuple(errors)
        super().__init__(f"{name}: {detail}")


def problem_response(
    name: str,
    detail: str,
    instance: str,
    *,
    errors: Sequence[FieldError] = (),
    headers: Mapping[str, str] | None = None,
    retry_after_s: int = 30,
) -> Response:
    """The response for a problem of :data:`PROBLEMS`."""
    kind = PROBLEMS[name]
    document = ProblemDocument(
        type=TYPE_PREFIX + name,
        title=kind.title,
        status=kind.status,
        detail=one_line(detail),
        instance=instance,
        errors=list(errors) or None,
    )
    told = {**HARDENING, **(headers or {})}
    if kind.retry:
        told.setdefault("Retry-After", str(retry_after_s))
    return JSONResponse(document.model_dump(exclude_none=True), kind.status, told, MEDIA_TYPE)


def one_line(text: str) -> str:
    """Text without line breaks, bounded."""
    flat = " ".join(text.split())
    return flat if len(flat) <= 1000 else f"{flat[:997]}..."


def name_of(error: Exception) -> str | None:
    """The problem that an error of ours becomes, None for any other error."""
    if isinstance(error, Problem):
        return error.name
    return next((_ERRORS[base] for base in type(error).__mro__ if base in _ERRORS), None)


def field_errors(error: RequestValidationError) -> list[FieldError]:
    """The wrong fields, without what was sent in them."""
    told = []
    for problem in error.errors()[:MAX_FIELD_ERRORS]:
        if problem["type"] == "json_invalid":
            reason = f"not JSON, character {problem['loc'][-1]}: {problem.get('ctx', {}).get('error', '')}"
            told.append(FieldError(field="body", message=one_line(reason)))
            continue
        field = ".".join(str(part) for part in problem["loc"])
        told.append(FieldError(field=field, message=one_line(str(problem["msg"]).removeprefix("Value error, "))))
    return told


def install(app: FastAPI, retry_after_s: int) -> None:
    """Make every error of ``app`` a problem."""

    def own(request: Request, error: Exception) -> Response:
        name = name_of(error) or "internal"
        if PROBLEMS[name].status >= 500:
            log.error("%s %s: %s", request.method, request.url.path, error)
        detail = error.detail if isinstance(error, Problem) else str(error)
        errors = error.errors if isinstance(error, Problem) else ()
        wait_s = error.retry_after_s if isinstance(error, QueueFull) else retry_after_s
        return problem_response(name, detail, request.url.path, errors=errors, retry_after_s=wait_s)

    def invalid(request: Request, error: Exception) -> Response:
        errors = field_errors(error) if isinstance(error, RequestValidationError) else []
        first = f"{errors[0].field}: {errors[0].message}" if errors else "wrong fields"
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        return problem_response("invalid", first + more, request.url.path, errors=errors)

    def by_status(request: Request, error: Exception) -> Response:
        status = error.status_code if isinstance(error, HTTPException) else 500
        headers = error.headers if isinstance(error, HTTPException) else None
        name = _STATUS_NAMES.get(status, "bad-request" if status < 500 else "internal")
        return problem_response(name, _detail(request, error, name), request.url.path, headers=headers)

    def unexpected(request: Request, error: Exception) -> Response:
        # The server logs the error itself, once, with its traceback.
        detail = "something went wrong in the service; its log says what"
        return problem_response("internal", detail, request.url.path)

    own_errors: tuple[type[Exception], ...] = (Problem, *_ERRORS)
    for kind in own_errors:
        app.add_exception_handler(kind, own)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, by_status)
    app.add_exception_handler(Exception, unexpected)


def _detail(request: Request, error: Exception, name: str) -> str:
    place = f"{request.method} {request.url.path}"
    if name == "not-found":
        return f"there is no {place}; openapi.json under /api/v1 lists what there is"
    if name == "method-not-allowed":
        allowed = (error.headers or {}).get("Allow", "") if isinstance(error, HTTPException) else ""
        return f"{place} cannot be done; {f'allowed here: {allowed}' if allowed else 'see openapi.json under /api/v1'}"
    said: Any = getattr(error, "detail", "")
    return f"{place}: {said}"


def responses(*names: str) -> dict[int | str, dict[str, Any]]:
    """The problems that a route may answer with, for its OpenAPI description."""
    by_status: dict[int | str, dict[str, Any]] = {}
    for name in names:
        kind = PROBLEMS[name]
        entry = by_status.setdefault(
            kind.status,
            {"description": "", "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDocument"}}}},
        )
        entry["description"] = f"{entry['description']}; {kind.title}".removeprefix("; ")
    return by_status
