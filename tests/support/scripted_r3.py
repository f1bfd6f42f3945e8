"""An R3 on a real socket whose every answer is the test's own, and a client of it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from engine_adapters.profile import R3Settings
from engine_adapters.r3.client import R3Client

VALUE_SET = "OK: SCENE EXPORT SETVALUE - Value Set."
SCENE = "Lensmatch/Calibration"
PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 40 + b"\x00\x00\x00\x00IEND\xaeB`\x82"

Answer = Callable[[str, asyncio.StreamWriter], Awaitable[None]]


class ScriptedEngine:
    """A text server on loopback whose every answer is a test's own."""

    def __init__(self, answer: Answer) -> None:
        self.lines: list[str] = []
        self.connections = 0
        self.port = 0
        self._answer = answer
        self._writers: set[asyncio.StreamWriter] = set()
        self._handlers: set[asyncio.Task[None]] = set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._writers.add(writer)
        if (handler := asyncio.current_task()) is not None:
            self._handlers.add(handler)
        # Only this server's end cancels a handler, and waits for it.
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while line := await reader.readline():
                self.lines.append(line.decode().rstrip("\r\n"))
                await self._answer(self.lines[-1], writer)
        writer.close()

    def drop_all(self) -> None:
        for writer in self._writers:
            writer.close()

    async def end(self) -> None:
        self.drop_all()
        for handler in self._handlers:
            handler.cancel()
        await asyncio.gather(*self._handlers, return_exceptions=True)


@contextlib.asynccontextmanager
async def scripted(answer: Answer) -> AsyncIterator[ScriptedEngine]:
    """The server while it runs, on a free port."""
    engine = ScriptedEngine(answer)
    server = await asyncio.start_server(engine.serve, "127.0.0.1", 0)
    engine.port = server.sockets[0].getsockname()[1]
    try:
        yield engine
    finally:
        server.close()
        await engine.end()
        await server.wait_closed()


def settings_for(port: int, *, timeout_s: float = 5.0, **changes: Any) -> R3Settings:
    """Settings whose every bound is ``timeout_s``."""
    return R3Settings(
        port=port,
        connect_timeout_s=timeout_s,
        command_timeout_s=timeout_s,
        snapshot_timeout_s=timeout_s,
        picture_timeout_s=timeout_s,
        **changes,
    )


@contextlib.asynccontextmanager
async def client_of(engine: ScriptedEngine, **changes: Any) -> AsyncIterator[R3Client]:
    """A client of that server; closed on leaving."""
    client = R3Client(settings_for(engine.port, **changes))
    try:
        yield client
    finally:
        await client.close()


async def dropped(client: R3Client) -> None:
    """Returns when the client has seen what happened to its connection between two commands."""
    async with asyncio.timeout(5.0):
        while client.connected:  # noqa: ASYNC110  (the client has no event to wait for)
            await asyncio.sleep(0.001)


def replying(*replies: bytes) -> Answer:
    """Answers with one reply after the other, whatever is asked."""
    left = list(replies)

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        writer.write(left.pop(0))

    return answer


def value_reply(value: str) -> bytes:
    return f"OK: SCENE EXPORT GETVALUE - {value}\n".encode()


async def echo_value(line: str, writer: asyncio.StreamWriter) -> None:
    """Answers getValue with the export's own name, so that a shifted reply shows."""
    writer.write(value_reply(line.split('"')[3]))
