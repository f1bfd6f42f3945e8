"""The simulated head's client on real sockets: what it sends, and what it refuses to believe."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator

import pytest

from engine_adapters.errors import ProtocolError, Refused, TimedOut, UnsafeText
from engine_adapters.head import SimulatedHead
from engine_adapters.ports import HeadState
from engine_adapters.profile import HeadSettings

STATE = {"pan_deg": 1.0, "tilt_deg": 2, "roll_deg": 0.0, "zoom": 0.5, "focus": 0.25}


@contextlib.asynccontextmanager
async def head_server(status: int, body: bytes | None) -> AsyncIterator[tuple[str, list[str]]]:
    """One answer to everything (None: silence), and the requests that came."""
    requests: list[str] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while True:
                head = (await reader.readuntil(b"\r\n\r\n")).decode()
                size = re.search(r"content-length: (\d+)", head, re.IGNORECASE)
                data = await reader.readexactly(int(size[1]) if size else 0)
                requests.append(head.split(" HTTP")[0] + (f" {data.decode()}" if data else ""))
                if body is not None:
                    writer.write(f"HTTP/1.1 {status} X\r\ncontent-length: {len(body)}\r\n\r\n".encode() + body)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}", requests
    # The client was closed before: each handler has read its end and ends by itself.
    await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def head_of(url: str, *, timeout_s: float = 5.0) -> AsyncIterator[SimulatedHead]:
    head = SimulatedHead(HeadSettings(kind="simulated", url=url, timeout_s=timeout_s))
    try:
        yield head
    finally:
        await head.close()


async def test_goals_are_sent_as_json_and_the_state_comes_back() -> None:
    async with head_server(200, json.dumps(STATE).encode()) as (url, requests), head_of(url) as head:
        assert await head.move_to(pan_deg=1.0, tilt_deg=2.0) == HeadState(1.0, 2.0, 0.0, 0.5, 0.25)
        await head.set_lens(zoom=0.5, focus=0.25)
        await head.read()
    assert requests == [
        'POST /head {"pan_deg":1.0,"tilt_deg":2.0,"roll_deg":0.0}',
        'POST /head {"zoom":0.5,"focus":0.25}',
        "GET /head",
    ]


async def test_the_full_address_is_taken_as_it_is() -> None:
    async with head_server(200, json.dumps(STATE).encode()) as (url, requests), head_of(f"{url}/head") as head:
        await head.read()
    assert requests == ["GET /head"]


@pytest.mark.parametrize("status", [400, 409, 500])
async def test_a_refusal_tells_the_heads_reason(status: int) -> None:
    async with head_server(status, b'{"error": "pan beyond 170 degrees"}') as (url, _), head_of(url) as head:
        with pytest.raises(Refused, match=f"HTTP {status}: pan beyond 170 degrees"):
            await head.move_to(pan_deg=500.0, tilt_deg=0.0)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"<html>",
        json.dumps(STATE | {"pan_deg": None}).encode(),
        json.dumps(STATE | {"zoom": "0.5"}).encode(),
        json.dumps(STATE | {"zoom": True}).encode(),
        json.dumps(STATE | {"tilt_deg": float("nan")}).encode(),
        b'{"pan_deg": 1.0}',
    ],
)
async def test_an_answer_that_is_no_state_is_refused(body: bytes) -> None:
    async with head_server(200, body) as (url, _), head_of(url) as head:
        with pytest.raises(ProtocolError):
            await head.read()


async def test_a_head_that_never_stands_still_ends_at_the_bound() -> None:
    async with head_server(200, None) as (url, _), head_of(url, timeout_s=0.2) as head:
        with pytest.raises(TimedOut):
            await head.move_to(pan_deg=1.0, tilt_deg=0.0)


async def test_an_impossible_goal_is_not_sent() -> None:
    async with head_server(200, json.dumps(STATE).encode()) as (url, requests), head_of(url) as head:
        with pytest.raises(UnsafeText):
            await head.move_to(pan_deg=float("nan"), tilt_deg=0.0)
        with pytest.raises(UnsafeText):
            await head.set_lens(zoom=1.01, focus=0.0)
    assert requests == []
