"""The MockBoard's client on real sockets: good pictures, and every way an answer can go wrong."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import gzip
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest

from engine_adapters.errors import BadPicture, ProtocolError, Refused, TimedOut, Unreachable
from engine_adapters.mockboard.client import GET_IMAGE_PATH, MockBoardFrames, image_url
from engine_adapters.profile import MockBoardSettings

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8 + b"\x00\x00\x00\x00IEND\xaeB`\x82"
TEXT = base64.b64encode(PNG)

Answer = Callable[[asyncio.StreamWriter], Awaitable[None]]


class Board:
    """A web server on loopback whose every answer is a test's own."""

    def __init__(self, answer: Answer) -> None:
        self.requests: list[list[str]] = []
        self.connections = 0
        self.url = ""
        self._answer = answer
        self.handlers: set[asyncio.Task[None]] = set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        task = asyncio.current_task()
        assert task is not None
        self.handlers.add(task)
        # Only this server's end cancels a handler, and waits for it.
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            while not writer.is_closing():
                head = await reader.readuntil(b"\r\n\r\n")
                self.requests.append(head.decode().split("\r\n"))
                await self._answer(writer)
        writer.close()


@contextlib.asynccontextmanager
async def board(answer: Answer) -> AsyncIterator[Board]:
    served = Board(answer)
    server = await asyncio.start_server(served.serve, "127.0.0.1", 0)
    served.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}{GET_IMAGE_PATH}"
    try:
        yield served
    finally:
        server.close()
        for handler in served.handlers:
            handler.cancel()
        await asyncio.gather(*served.handlers, return_exceptions=True)
        await server.wait_closed()


@contextlib.asynccontextmanager
async def frames_of(url: str, **settings: Any) -> AsyncIterator[MockBoardFrames]:
    chosen: dict[str, Any] = {"url": url, "timeout_s": 5.0} | settings
    frames = MockBoardFrames(MockBoardSettings(**chosen))
    try:
        yield frames
    finally:
        await frames.close()


def sending(head: str, body: bytes = b"", *, close: bool = False) -> Answer:
    async def answer(writer: asyncio.StreamWriter) -> None:
        writer.write(f"{head}\r\n\r\n".encode() + body)
        await writer.drain()
        if close:
            writer.close()

    return answer


def picture(body: bytes = TEXT, *, status: str = "200 OK", headers: str = "") -> Answer:
    return sending(f"HTTP/1.1 {status}\r\ncontent-length: {len(body)}{headers}", body)


async def test_pictures_come_over_one_kept_connection_with_the_studys_headers() -> None:
    async with board(picture()) as served, frames_of(served.url) as frames:
        for _ in range(3):
            frame = await frames.fetch()
            assert frame.data == PNG
            assert frame.requested_at_s <= frame.received_at_s
    assert served.connections == 1
    assert served.requests[0][0] == f"GET {GET_IMAGE_PATH} HTTP/1.1"
    headers = {line.split(": ", 1)[0].lower(): line.split(": ", 1)[1] for line in served.requests[0][1:] if line}
    assert headers["host"] == served.url.split("/")[2]
    assert headers["user-agent"].startswith("Mozilla/5.0 (Windows NT 10.0; Win64; x64)")
    assert headers["sec-fetch-dest"] == "document"
    assert headers["sec-ch-ua-platform"] == '"Windows"'
    assert headers["accept-encoding"] == "gzip, deflate"


@pytest.mark.parametrize("url", ["http://localhost:1987", "http://localhost:1987/"])
def test_the_servers_address_alone_is_enough(url: str) -> None:
    assert image_url(url) == "http://localhost:1987/api/v1/MockCard/MockOutput/GetImage"
    assert image_url("http://h/other/path") == "http://h/other/path"


async def test_chunked_and_packed_answers_are_read() -> None:
    packed = gzip.compress(TEXT)
    async with (
        board(picture(packed, headers="\r\ncontent-encoding: gzip")) as served,
        frames_of(served.url) as frames,
    ):
        assert (await frames.fetch()).data == PNG
    chunks = b"".join(b"%x\r\n%s\r\n" % (len(part), part) for part in (TEXT[:7], TEXT[7:])) + b"0\r\n\r\n"
    async with (
        board(sending("HTTP/1.1 200 OK\r\ntransfer-encoding: chunked", chunks)) as served,
        frames_of(served.url) as frames,
    ):
        assert (await frames.fetch()).data == PNG


@pytest.mark.parametrize(
    ("answer", "error", "told"),
    [
        (picture(b"no", status="404 Not Found"), Refused, "HTTP 404"),
        (picture(b"no", status="500 Oops"), Refused, "HTTP 500"),
        (picture(b"", status="302 Found", headers="\r\nlocation: http://127.0.0.1:1/"), Refused, "not followed"),
        (picture(b"<html>"), BadPicture, "not base64"),
        (picture(b""), BadPicture, "empty"),
        (picture(base64.b64encode(PNG[:-20])), BadPicture, "cut off"),
        (picture(b"x" * 200_000), ProtocolError, "larger than its limit"),
        (picture(gzip.compress(bytes(5_000_000)), headers="\r\ncontent-encoding: gzip"), ProtocolError, "larger than"),
        (picture(b"not gzip", headers="\r\ncontent-encoding: gzip"), ProtocolError, "unpacked"),
        (sending("HTTP/1.1 200 OK\r\ncontent-length: 5000", TEXT[:100], close=True), Unreachable, "lost"),
        (sending("", close=True), ProtocolError, "not HTTP"),
        (sending("OK: SNAPSHOT TAKEN", close=True), ProtocolError, "not HTTP"),
        (sending("HTTP/1.1 200 OK\r\ncontent-length: -1"), ProtocolError, "not HTTP"),
    ],
)
async def test_each_wrong_answer_is_a_typed_error_with_the_address(
    answer: Answer, error: type[Exception], told: str
) -> None:
    async with board(answer) as served, frames_of(served.url, max_picture_mib=0.1) as frames:
        with pytest.raises(error, match=told) as caught:
            await frames.fetch()
        assert served.url in str(caught.value)


async def test_a_connection_dropped_before_the_answer_is_unreachable() -> None:
    async def drop(writer: asyncio.StreamWriter) -> None:
        writer.close()

    async with board(drop) as served, frames_of(served.url) as frames:
        with pytest.raises(Unreachable, match="lost"):
            await frames.fetch()


async def test_nobody_listening_is_unreachable_and_says_what_to_do(unused_tcp_port: int) -> None:
    async with frames_of(f"http://127.0.0.1:{unused_tcp_port}/x") as frames:
        with pytest.raises(Unreachable, match="start R3 with the MockBoard"):
            await frames.fetch()


async def test_silence_and_a_trickle_end_within_the_bound() -> None:
    async def silent(writer: asyncio.StreamWriter) -> None:
        pass

    async def trickle(writer: asyncio.StreamWriter) -> None:
        writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 100000\r\n\r\n")
        while not writer.is_closing():
            writer.write(b"A")
            await asyncio.sleep(0.02)

    for answer in (silent, trickle):
        async with board(answer) as served, frames_of(served.url, timeout_s=0.2) as frames:
            start = time.monotonic()
            with pytest.raises(TimedOut) as caught:
                await frames.fetch()
            assert time.monotonic() - start < 0.7
            assert caught.value.bound_s == 0.2


async def test_a_late_answer_is_not_the_next_fetches() -> None:
    answers = iter([b"late", TEXT])
    release = asyncio.Event()

    async def answer(writer: asyncio.StreamWriter) -> None:
        body = next(answers)
        if body == b"late":
            await release.wait()
        writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%s" % (len(body), body))

    async with board(answer) as served, frames_of(served.url, timeout_s=0.5) as frames:
        with pytest.raises(TimedOut):
            await frames.fetch()
        release.set()
        assert (await frames.fetch()).data == PNG
        assert served.connections == 2


async def test_a_cancelled_fetch_leaves_the_source_usable() -> None:
    asked = asyncio.Event()
    hold = True

    async def answer(writer: asyncio.StreamWriter) -> None:
        asked.set()
        if not hold:
            await picture()(writer)

    async with board(answer) as served, frames_of(served.url) as frames:
        task = asyncio.create_task(frames.fetch())
        await asked.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        hold = False
        assert (await frames.fetch()).data == PNG


async def test_a_proxy_in_the_environment_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
    async with board(picture()) as served, frames_of(served.url) as frames:
        assert (await frames.fetch()).data == PNG
