"""When to try again: each adapter's classifier, and the bounded loop."""

from __future__ import annotations

import asyncio

import pytest

from engine_adapters.errors import AdapterError, BadPicture, ProtocolError, Refused, TimedOut, Unreachable, UnsafeText
from engine_adapters.retry import Verdict, classify_head, classify_mockboard, classify_r3, retry

LOST = [Unreachable("x"), TimedOut("x", 1.0), ProtocolError("x")]
NO_FILE = Refused("ERROR: GETSNAPSHOT - COULD NOT READ LAST SNAPSHOT FILE")


@pytest.mark.parametrize("classify", [classify_r3, classify_mockboard, classify_head])
def test_a_lost_connection_is_reopened_and_an_unsafe_text_given_up(classify: type) -> None:
    assert [classify(error) for error in LOST] == [Verdict.REOPEN] * 3
    assert classify(UnsafeText("x")) is Verdict.GIVE_UP
    assert classify(AdapterError("x")) is Verdict.GIVE_UP


def test_refusals_are_told_apart() -> None:
    assert classify_r3(NO_FILE) is Verdict.RETRY
    assert classify_r3(Refused("ERROR: SNAPSHOT – INVALID PATH")) is Verdict.GIVE_UP
    assert classify_mockboard(Refused("HTTP 503")) is Verdict.RETRY
    assert classify_mockboard(Refused("HTTP 404")) is Verdict.GIVE_UP
    assert classify_head(Refused("HTTP 409: moving")) is Verdict.GIVE_UP
    assert classify_r3(BadPicture("x")) is classify_mockboard(BadPicture("x")) is Verdict.RETRY


class Goal:
    """Fails with each error in turn, then succeeds."""

    def __init__(self, *errors: BaseException) -> None:
        self.errors = list(errors)
        self.stated = 0

    async def __call__(self) -> str:
        self.stated += 1
        if self.errors:
            raise self.errors.pop(0)
        return "done"


async def test_a_goal_is_stated_again_with_growing_pauses() -> None:
    pauses: list[float] = []
    told: list[tuple[int, Verdict]] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    goal = Goal(Unreachable("x"), NO_FILE)
    answer = await retry(
        goal,
        classify=classify_r3,
        pause_s=0.5,
        sleep=sleep,
        on_retry=lambda attempt, error, verdict: told.append((attempt, verdict)),
    )
    assert answer == "done"
    assert pauses == [0.5, 1.0]
    assert told == [(1, Verdict.REOPEN), (2, Verdict.RETRY)]


async def test_attempts_are_bounded_and_the_last_error_is_raised_as_it_came() -> None:
    last = TimedOut("x", 1.0)
    goal = Goal(Unreachable("x"), Unreachable("y"), last)
    with pytest.raises(TimedOut) as caught:
        await retry(goal, classify=classify_r3, attempts=3, pause_s=0.0)
    assert caught.value is last
    assert goal.stated == 3


@pytest.mark.parametrize("error", [UnsafeText("x"), ValueError("x"), asyncio.CancelledError()])
async def test_what_will_not_pass_is_raised_at_once(error: BaseException) -> None:
    goal = Goal(error)
    with pytest.raises(type(error)):
        await retry(goal, classify=classify_r3, pause_s=0.0)
    assert goal.stated == 1


async def test_at_least_one_attempt_is_made() -> None:
    with pytest.raises(ValueError, match="attempts = 0"):
        await retry(Goal(), classify=classify_r3, attempts=0)
