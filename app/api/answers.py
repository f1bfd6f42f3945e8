"""Shared ways to answer: documents built off the event loop, and entity tags."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable

from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response

_TAG = re.compile(r'(?:W/)?("[^"]*")')


async def document(build: Callable[[], BaseModel]) -> Response:
    """A JSON document that is built and written in a thread: a job of 1,000 levels takes tens of milliseconds."""
    body = await asyncio.to_thread(lambda: build().model_dump_json().encode())
    return Response(body, media_type="application/json")


def unchanged(request: Request, tag: str) -> bool:
    """Whether the client already has what ``tag`` (with its quotes) stands for (RFC 9110, 13.1.2)."""
    asked = ",".join(request.headers.getlist("if-none-match"))
    return asked.strip() == "*" or tag in _TAG.findall(asked)


def tagged(request: Request, tag: str, body: bytes, media_type: str, disposition: str | None = None) -> Response:
    """``body`` with its entity tag, or 304 without it when the client has it already."""
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if unchanged(request, tag):
        return Response(status_code=304, headers=headers)
    if disposition is not None:
        headers["Content-Disposition"] = disposition
    return Response(body, media_type=media_type, headers=headers)
