"""When to try again: one pure classifier for each adapter, and a small bounded loop.

Only goals that can be repeated are retried (set this value, turn there, give me a picture), never steps.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from enum import StrEnum
from typing import TypeVar

from engine_adapters.errors import AdapterError, BadPicture, ProtocolError, Refused, TimedOut, Unreachable

T = TypeVar("T")


class Verdict(StrEnum):
    """What to do about an error."""

    RETRY = "retry"
    """State the goal again on the same connection."""
    REOPEN = "reopen"
    """The connection is gone or cannot be trusted: state the goal again on a new one (the adapters open it)."""
    GIVE_UP = "give_up"
    """Trying again would give the same."""


def classify_r3(error: AdapterError) -> Verdict:
    """Errors of the R3 socket."""
    if isinstance(error, (Unreachable, TimedOut, ProtocolError)):
        return Verdict.REOPEN
    # The snapshot's file is still being written, or held by a virus scanner.
    if isinstance(error, Refused) and "COULD NOT READ" in error.answer.upper():
        return Verdict.RETRY
    return Verdict.RETRY if isinstance(error, BadPicture) else Verdict.GIVE_UP


def classify_mockboard(error: AdapterError) -> Verdict:
    """Errors of the MockBoard: it has no state, so all but a client error may pass."""
    if isinstance(error, (Unreachable, TimedOut, ProtocolError)):
        return Verdict.REOPEN
    if isinstance(error, Refused):
        return Verdict.RETRY if error.answer.startswith("HTTP 5") else Verdict.GIVE_UP
    return Verdict.RETRY if isinstance(error, BadPicture) else Verdict.GIVE_UP


def classify_head(error: AdapterError) -> Verdict:
    """Errors of a camera head: a lost answer may be asked for again, since positions are goals."""
    return Verdict.REOPEN if isinstance(error, (Unreachable, TimedOut, ProtocolError)) else Verdict.GIVE_UP


async def retry(
    goal: Callable[[], Awaitable[T]],
    *,
    classify: Callable[[AdapterError], Verdict],
    attempts: int = 3,
    pause_s: float = 0.2,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    on_retry: Callable[[int, AdapterError, Verdict], None] | None = None,
) -> T:
    """State a repeatable goal up to ``attempts`` times; the pause doubles each time.

    ``on_retry(attempt, error, verdict)`` is told before each further attempt. The last error is raised as it came;
    other exceptions and cancellations go straight through.
    """
    if attempts < 1:
        raise ValueError(f"attempts = {attempts}: must be at least 1")
    attempt = 1
    while True:
        try:
            return await goal()
        except AdapterError as error:
            verdict = classify(error)
            if verdict is Verdict.GIVE_UP or attempt >= attempts:
                raise
            if on_retry is not None:
                on_retry(attempt, error, verdict)
        await sleep(pause_s * 2 ** (attempt - 1))
        attempt += 1
