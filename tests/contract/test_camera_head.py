"""What every camera head keeps: real, replayed, simulated, or a person."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from engine_adapters.errors import AdapterError
from engine_adapters.ports import CameraHead

RunCheck = Callable[[Callable[[Any], Awaitable[None]]], Awaitable[None]]

ENCODER_DEG = 0.1
"""How far an encoder may be from the goal and the head still be called there."""


async def test_the_head_stands_where_it_was_sent(on_head: RunCheck) -> None:
    async def check(head: CameraHead) -> None:
        for pan_deg, tilt_deg, roll_deg in ((-14.0, 5.0, 0.0), (0.0, 0.0, 0.0)):
            state = await head.move_to(pan_deg=pan_deg, tilt_deg=tilt_deg, roll_deg=roll_deg)
            told = [state.pan_deg, state.tilt_deg, state.roll_deg]
            assert told == pytest.approx([pan_deg, tilt_deg, roll_deg], abs=ENCODER_DEG)

    await on_head(check)


async def test_the_lens_stands_where_it_was_sent_and_the_head_stays(on_head: RunCheck) -> None:
    async def check(head: CameraHead) -> None:
        before = await head.move_to(pan_deg=3.0, tilt_deg=-2.0)
        after = await head.set_lens(zoom=0.5, focus=0.25)
        assert [after.zoom, after.focus] == pytest.approx([0.5, 0.25], abs=1e-3)
        assert [after.pan_deg, after.tilt_deg] == pytest.approx([before.pan_deg, before.tilt_deg], abs=ENCODER_DEG)

    await on_head(check)


async def test_reading_tells_the_last_state(on_head: RunCheck) -> None:
    async def check(head: CameraHead) -> None:
        moved = await head.move_to(pan_deg=1.0, tilt_deg=2.0)
        read = await head.read()
        assert [read.pan_deg, read.tilt_deg] == pytest.approx([moved.pan_deg, moved.tilt_deg], abs=ENCODER_DEG)
        assert [read.zoom, read.focus] == pytest.approx([moved.zoom, moved.focus], abs=1e-3)

    await on_head(check)


@pytest.mark.parametrize(("zoom", "focus"), [(-0.1, 0.5), (0.5, 1.1), (float("inf"), 0.5)])
async def test_a_lens_beyond_its_range_is_refused(on_head: RunCheck, zoom: float, focus: float) -> None:
    async def check(head: CameraHead) -> None:
        before = await head.set_lens(zoom=0.25, focus=0.75)
        with pytest.raises(AdapterError):
            await head.set_lens(zoom=zoom, focus=focus)
        after = await head.read()
        assert [after.zoom, after.focus] == pytest.approx([before.zoom, before.focus], abs=1e-3)

    await on_head(check)


async def test_a_closed_head_answers_with_a_typed_error(on_head: RunCheck) -> None:
    async def check(head: CameraHead) -> None:
        await head.close()
        with pytest.raises(AdapterError):
            await head.move_to(pan_deg=0.0, tilt_deg=0.0)

    await on_head(check)
