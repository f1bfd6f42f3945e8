"""What the simulated servers share: connections that end with the server, and answers that go wrong on demand.

The HTTP side is written out here, and not an ASGI application, because the faults are faults of the connection: an
answer cut in half, in pieces, or never given cannot be asked of an HTTP library.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from engine_adapters.sim.faults import Fault, FaultKind

MAX_HEAD_BYTES = 32 * 1024
"""Longest request line and headers (or R3 command) that is read."""
MAX_BODY_BYTES = 64 * 1024
"""Longest request body that is read: a head position is 100 bytes."""
_CLOSE_BOUND_S = 1.0
_PIECES = 64
_GARBAGE = b"\x00\xff\xfe nonsense \x80\x81 \x07\r\n"
_REASONS = {200: "OK", 400: "Bad Request", 404: "Not Found", 405: "Method Not Allowed", 413: "Content Too Large"}

Connection = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class TcpServer:
    """A listening socket and the connections it has accepted; :meth:`aclose` ends them all."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self, host: str, port: int) -> tuple[str, int]:
        """Listen; returns the address. Raises :class:`OSError` where the port is taken."""
        self._server = await asyncio.start_server(self._accept, host, port, limit=MAX_HEAD_BYTES)
        address = self._server.sockets[0].getsockname()
        return str(address[0]), int(address[1])

    async def aclose(self) -> None:
        """Stop listening and end every connection."""
        if self._server is None:
            return
        self._server.close()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._server.wait_closed()
        self._server = None

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.get_running_loop().create_task(self._serve(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            # The other side may go at any moment: that ends its connection and nothing else.
            with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
                await self._connection(reader, writer)
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError, TimeoutError):
                await asyncio.wait_for(writer.wait_closed(), _CLOSE_BOUND_S)


async def deliver(writer: asyncio.StreamWriter, answer: bytes, fault: Fault | None, *, head: bytes = b"") -> bool:
    """Send an answer after its head, spoilt by the fault; False when the connection is to be closed after it."""
    if fault is None:
        # Apart, because joining them would copy megabytes.
        writer.write(head)
        writer.write(answer)
        await writer.drain()
        return True
    kind, answer = fault.kind, head + answer
    if kind is FaultKind.DROP:
        return True
    if kind is FaultKind.LATE:
        await asyncio.sleep(fault.value)
    if kind is FaultKind.GARBAGE:
        answer = _GARBAGE
    if kind is FaultKind.DISCONNECT:
        writer.write(answer[: len(answer) // 2])
        await writer.drain()
        return False
    if kind is FaultKind.SPLIT:
        size = max(1, len(answer) // _PIECES)
        for start in range(0, len(answer), size):
            writer.write(answer[start : start + size])
            await writer.drain()
            # Let the piece leave before the next one joins it in the buffer.
            await asyncio.sleep(0.001)
        return True
    writer.write(answer)
    await writer.drain()
    return True


@dataclass(frozen=True, slots=True)
class Request:
    """An HTTP request: method, path without its query, body."""

    method: str
    path: str
    body: bytes


@dataclass(frozen=True, slots=True)
class Response:
    """An HTTP answer, and the fault it is delivered with."""

    status: int
    body: bytes
    content_type: str = "application/json"
    fault: Fault | None = None

    @classmethod
    def of_json(cls, content: object, status: int = 200) -> Response:
        """A JSON answer."""
        return cls(status, json.dumps(content).encode())

    @classmethod
    def error(cls, status: int, reason: str) -> Response:
        """``{"error": reason}``."""
        return cls.of_json({"error": reason}, status)


class BadRequest(Exception):
    """A request that cannot be read; ``status`` is the HTTP answer to it."""

    def __init__(self, status: int, reason: str) -> None:
        self.status = status
        super().__init__(reason)


def http_connection(handler: Callable[[Request], Awaitable[Response]]) -> Connection:
    """A connection that answers HTTP/1.1 requests one after another, kept open as long as the client likes."""

    async def connection(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        going_on = True
        while going_on:
            try:
                received = await _read_request(reader)
            except BadRequest as error:
                refusal = Response.error(error.status, str(error))
                await deliver(writer, refusal.body, None, head=_head(refusal, keep=False))
                return
            if received is None:
                return
            request, keep = received
            response = await handler(request)
            going_on = await deliver(writer, response.body, response.fault, head=_head(response, keep=keep)) and keep

    return connection


async def _read_request(reader: asyncio.StreamReader) -> tuple[Request, bool] | None:
    """The next request and whether the connection is kept; None at the end of the connection."""
    try:
        head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError as error:
        raise BadRequest(413, f"request head over {MAX_HEAD_BYTES} bytes") from error
    except asyncio.IncompleteReadError:
        return None
    first, *lines = head[:-4].decode("latin-1").split("\r\n")
    parts = first.split(" ")
    if len(parts) != 3 or not parts[2].startswith("HTTP/1."):
        raise BadRequest(400, "not an HTTP/1.1 request")
    method, target, version = parts
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if not colon:
            raise BadRequest(400, "a header without a colon")
        headers[name.strip().lower()] = value.strip()
    if "transfer-encoding" in headers:
        raise BadRequest(400, "send the body with a Content-Length")
    length = headers.get("content-length", "0")
    if not (length.isascii() and length.isdigit()):
        raise BadRequest(400, "Content-Length is not a number")
    if len(length) > 9 or int(length) > MAX_BODY_BYTES:
        raise BadRequest(413, f"request body over {MAX_BODY_BYTES} bytes")
    body = await reader.readexactly(int(length))
    asked = headers.get("connection", "").lower()
    keep = asked != "close" and (version != "HTTP/1.0" or asked == "keep-alive")
    return Request(method, target.partition("?")[0], body), keep


def _head(response: Response, *, keep: bool) -> bytes:
    reason = _REASONS.get(response.status, "Error")
    head = (
        f"HTTP/1.1 {response.status} {reason}\r\n"
        f"Content-Type: {response.content_type}\r\n"
        f"Content-Length: {len(response.body)}\r\n"
        "Cache-Control: no-store\r\n"
        f"Connection: {'keep-alive' if keep else 'close'}\r\n\r\n"
    )
    return head.encode("latin-1")
