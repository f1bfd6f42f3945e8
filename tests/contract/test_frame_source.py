"""What every frame source keeps, real or replayed or simulated."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from calibration.image import decode_picture
from engine_adapters.errors import AdapterError
from engine_adapters.pictures import check_whole
from engine_adapters.ports import FrameSource

RunCheck = Callable[[Callable[[Any], Awaitable[None]]], Awaitable[None]]


async def test_a_fetch_gives_a_whole_picture(on_frames: RunCheck) -> None:
    async def check(frames: FrameSource) -> None:
        frame = await frames.fetch()
        check_whole(frame.data)
        height, width, channels = decode_picture(frame.data).shape
        assert width > height > 0
        assert channels == 3
        assert frame.source

    await on_frames(check)


async def test_times_enclose_each_fetch(on_frames: RunCheck) -> None:
    async def check(frames: FrameSource) -> None:
        first, second = await frames.fetch(), await frames.fetch()
        assert first.requested_at_s <= first.received_at_s <= second.requested_at_s <= second.received_at_s

    await on_frames(check)


async def test_two_fetches_at_once_both_succeed(on_frames: RunCheck) -> None:
    async def check(frames: FrameSource) -> None:
        for frame in await asyncio.gather(frames.fetch(), frames.fetch()):
            check_whole(frame.data)

    await on_frames(check)


async def test_a_closed_source_answers_with_a_typed_error(on_frames: RunCheck) -> None:
    async def check(frames: FrameSource) -> None:
        await frames.close()
        with pytest.raises(AdapterError):
            await frames.fetch()

    await on_frames(check)
