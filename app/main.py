"""The service as an ASGI app: routes, checks, errors, and what runs while it runs. No globals."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from typing import Any

import uvicorn
from fastapi import FastAPI
from starlette.types import Lifespan

from app.api import errors, jobs, lenses, publishing, service, sockets, table_pictures, tables
from app.api.context import PREFIX, AppContext
from app.api.guard import Guard
from app.api.tail import EventTail
from app.settings import Settings

API_VERSION = "1"

MAX_SOCKET_MESSAGE_BYTES = 4096
"""Clients of event sockets have nothing to say."""


def create_app(context: AppContext, running: Sequence[AbstractAsyncContextManager[object]] = ()) -> FastAPI:
    """The service over ``context``; each of ``running`` is entered at its start and left, in reverse, at its end."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        # Made once, in a thread: it takes tenths of a second, which the first client to ask would cost all others.
        await asyncio.to_thread(app.openapi)
        async with AsyncExitStack() as stack:
            for part in running:
                await stack.enter_async_context(part)
            yield

    app = _routes(lifespan)
    app.state.context = context
    app.state.tail = EventTail(context.repository)
    app.state.drawing = asyncio.Lock()
    errors.install(app, context.settings.retry_after_s)
    app.add_middleware(Guard, settings=context.settings)
    return app


def server_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """How the service is served: bounded, quiet, stopping within its bound."""
    return uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        lifespan="on",
        log_config=None,
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=settings.shutdown_timeout_s,
        ws_max_size=MAX_SOCKET_MESSAGE_BYTES,
    )


def openapi_text() -> str:
    """``docs/reference/openapi.json``: the service's description of itself."""
    return json.dumps(_routes(None).openapi(), indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def _routes(lifespan: Lifespan[FastAPI] | None) -> FastAPI:
    app = _App(
        title="Lensmatch",
        summary="Lens calibration for broadcast and virtual production",
        version=API_VERSION,
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,  # these pages would load their scripts from a CDN
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
        responses=errors.responses("internal", "storage-busy"),
    )
    for part in (jobs, lenses, tables, table_pictures, publishing, service, sockets):
        app.include_router(part.router, prefix=PREFIX)
    return app


class _App(FastAPI):
    def openapi(self) -> dict[str, Any]:
        """The description with the problem document, which no route returns by itself."""
        if self.openapi_schema is None:
            schema = super().openapi()
            problem = errors.ProblemDocument.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas = schema.setdefault("components", {}).setdefault("schemas", {})
            schemas.update(problem.pop("$defs", {}), ProblemDocument=problem)
        return self.openapi_schema or {}
