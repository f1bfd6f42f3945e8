"""What is checked before any route: the Host and Origin headers and the size of the body, for requests and sockets.

A page of a foreign origin can make a browser call a service on the operator's machine, by its address or through a
name that it points there (DNS rebinding). So the service answers only to its own names, exactly one Host header, and
takes changes and sockets from its own origin only. Programs send no Origin and are not concerned.
"""

from __future__ import annotations

import re

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from app.api.context import PREFIX
from app.api.errors import HARDENING, problem_response
from app.settings import HOST_NAME, Settings

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
_HOST = re.compile(rf"(?P<name>{HOST_NAME.pattern})(?::[0-9]{{1,5}})?")
_HTTP_SCHEMES = {"http": "http", "https": "https", "ws": "http", "wss": "https"}
TABLES_PATH = f"{PREFIX}/tables"
"""Where whole lens tables are sent to, which may be larger than other bodies."""
Refusal = tuple[str, str]
"""Name of the problem, and its detail."""


class Guard:
    """ASGI middleware: lets through what the settings allow, refuses the rest with a problem."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._hosts = frozenset(settings.allowed_hosts)
        self._origins = frozenset(settings.allowed_origins)
        self._max_body_bytes = settings.max_body_bytes
        self._max_table_bytes = settings.max_table_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal = self._refuse_host(headers) or self._refuse_origin(scope, headers)
        if scope["type"] == "websocket":
            await self._socket(refusal, scope, receive, send)
            return
        limit = self._max_table_bytes if scope["path"] == TABLES_PATH else self._max_body_bytes
        refusal = refusal or _refuse_length(headers, limit)
        if refusal is not None:
            await problem_response(*refusal, scope["path"])(scope, receive, _with_headers(send))
            return
        await self._app(scope, _bounded(receive, limit), _with_headers(send))

    async def _socket(self, refusal: Refusal | None, scope: Scope, receive: Receive, send: Send) -> None:
        if refusal is None:
            await self._app(scope, receive, send)
            return
        socket = WebSocket(scope, receive, send)
        if "websocket.http.response" in scope.get("extensions", {}):
            await socket.send_denial_response(problem_response(*refusal, scope["path"]))
        else:
            await socket.close()

    def _refuse_host(self, headers: Headers) -> Refusal | None:
        given = headers.getlist("host")
        if len(given) != 1:
            return "host-refused", f"{len(given)} Host headers; send exactly one"
        match = _HOST.fullmatch(given[0])
        if match is None or match["name"].lower() not in self._hosts:
            return "host-refused", f"not called {_shown(given[0])}; a further name is set with LENSMATCH_ALLOWED_HOSTS"
        return None

    def _refuse_origin(self, scope: Scope, headers: Headers) -> Refusal | None:
        if scope["type"] == "http" and scope["method"] in SAFE_METHODS:
            return None
        origins = headers.getlist("origin")
        if len(origins) > 1:
            return "origin-refused", f"{len(origins)} Origin headers; a browser sends one"
        if not origins:
            # Browsers that leave out Origin still say where the request comes from.
            if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
                return "origin-refused", "the page that asks is of another site"
            return None
        own = f"{_HTTP_SCHEMES.get(scope['scheme'], '')}://{headers['host'].lower()}"
        origin = origins[0].lower()
        if origin != own and origin not in self._origins:
            shown = _shown(origins[0])
            return "origin-refused", f"pages of {shown} may not do this; allow them with LENSMATCH_ALLOWED_ORIGINS"
        return None


def _refuse_length(headers: Headers, limit: int) -> Refusal | None:
    lengths = headers.getlist("content-length")
    if not lengths:
        return None
    if len(lengths) > 1 or not (lengths[0].isascii() and lengths[0].isdigit() and len(lengths[0]) < 20):
        return "bad-request", "the Content-Length header is no number; send one length in bytes"
    if int(lengths[0]) > limit:
        return "body-too-large", f"the body has {lengths[0]} bytes, at most {limit} are taken"
    return None


def _bounded(receive: Receive, limit: int) -> Receive:
    taken = 0

    async def bounded() -> Message:
        nonlocal taken
        message = await receive()
        if message["type"] == "http.request":
            taken += len(message.get("body", b""))
            if taken > limit:
                raise HTTPException(413, f"the body is larger than {limit} bytes")
        return message

    return bounded


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HARDENING.items():
                headers.setdefault(name, value)
        await send(message)

    return sending


def _shown(text: str) -> str:
    shown = ascii(text)
    return shown if len(shown) <= 80 else f"{shown[:77]}..."
