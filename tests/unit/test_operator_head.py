"""A head moved by a person: questions, answers, refusals."""

from __future__ import annotations

import asyncio
import math

import pytest

from engine_adapters.errors import Refused, TimedOut, Unreachable, UnsafeText
from engine_adapters.head import OperatorHead
from engine_adapters.ports import HeadState

HERE = HeadState(1.0, 2.0, 0.0, 0.5, 0.25)


async def test_the_question_names_the_goal_and_the_answer_is_the_state() -> None:
    asked: list[str] = []

    async def ask(text: str) -> HeadState | None:
        asked.append(text)
        return HERE

    head = OperatorHead(ask, answer_timeout_s=1.0)
    assert await head.read() == HERE
    assert await head.move_to(pan_deg=-14.0, tilt_deg=3.5) == HERE
    assert await head.set_lens(zoom=0.5, focus=0.25) == HERE
    assert await head.read() == HERE
    assert len(asked) == 3
    assert "pan -14.000°, tilt 3.500°, roll 0.000°" in asked[1]
    assert "zoom 0.5000, focus 0.2500" in asked[2]


async def test_a_person_may_decline() -> None:
    async def ask(text: str) -> HeadState | None:
        return None

    with pytest.raises(Refused, match="declined"):
        await OperatorHead(ask, answer_timeout_s=1.0).move_to(pan_deg=0.0, tilt_deg=0.0)


async def test_no_answer_ends_at_the_bound_and_withdraws_the_question() -> None:
    withdrawn = asyncio.Event()

    async def ask(text: str) -> HeadState | None:
        try:
            await asyncio.Event().wait()
        finally:
            withdrawn.set()
        return None

    with pytest.raises(TimedOut):
        await OperatorHead(ask, answer_timeout_s=0.02).move_to(pan_deg=0.0, tilt_deg=0.0)
    assert withdrawn.is_set()


@pytest.mark.parametrize(
    "state",
    [HeadState(math.nan, 0.0, 0.0, 0.0, 0.0), HeadState(0.0, 0.0, 0.0, 7.0, 0.0), HeadState(0.0, 0.0, 0.0, 0.0, -1.0)],
)
async def test_an_answer_that_is_no_state_is_refused(state: HeadState) -> None:
    async def ask(text: str) -> HeadState | None:
        return state

    with pytest.raises(UnsafeText, match="no place to stand at"):
        await OperatorHead(ask, answer_timeout_s=1.0).move_to(pan_deg=0.0, tilt_deg=0.0)


async def test_after_closing_nobody_is_asked() -> None:
    async def ask(text: str) -> HeadState | None:
        return HERE

    head = OperatorHead(ask, answer_timeout_s=1.0)
    await head.close()
    with pytest.raises(Unreachable):
        await head.move_to(pan_deg=0.0, tilt_deg=0.0)
