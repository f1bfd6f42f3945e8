"""A camera head that a person moves: each movement is asked for, and the person tells what the encoders show."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable

from engine_adapters.errors import Refused, TimedOut, Unreachable, UnsafeText
from engine_adapters.ports import HeadState

AskOperator = Callable[[str], Awaitable[HeadState | None]]
"""Shows a text to the operator and gives the state that they confirm; None when they decline."""

_WHERE = "operator"


class OperatorHead:
    """The camera head port (:class:`engine_adapters.ports.CameraHead`) by way of a person."""

    def __init__(self, ask: AskOperator, *, answer_timeout_s: float) -> None:
        self._ask_operator = ask
        self._answer_timeout_s = answer_timeout_s
        self._state: HeadState | None = None
        self._closed = False

    async def move_to(self, *, pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> HeadState:
        """Ask for a movement; returns the state that the operator confirms. A cancellation withdraws the question."""
        return await self._ask(
            f"Turn the camera to pan {pan_deg:.3f}°, tilt {tilt_deg:.3f}°, roll {roll_deg:.3f}°, "
            "and wait until it stands still."
        )

    async def set_lens(self, *, zoom: float, focus: float) -> HeadState:
        """Ask for zoom and focus (0..1); returns the state that the operator confirms."""
        return await self._ask(
            f"Set the lens to zoom {zoom:.4f}, focus {focus:.4f} (0 to 1), and wait until it stands still."
        )

    async def read(self) -> HeadState:
        """The state confirmed last; asked for where there is none yet."""
        return self._state or await self._ask("Tell where the camera stands: pan, tilt, roll, zoom and focus.")

    async def close(self) -> None:
        """Ask nothing more. Safe to call twice."""
        self._closed = True

    async def _ask(self, text: str) -> HeadState:
        if self._closed:
            raise Unreachable("nobody is asked any more", where=_WHERE)
        try:
            async with asyncio.timeout(self._answer_timeout_s):
                state = await self._ask_operator(text)
        except TimeoutError as error:
            raise TimedOut(f"{text!r}", self._answer_timeout_s, where=_WHERE) from error
        if state is None:
            raise Refused("the operator declined", where=_WHERE, command=text)
        told = (state.pan_deg, state.tilt_deg, state.roll_deg, state.zoom, state.focus)
        if not all(math.isfinite(value) for value in told) or not (0 <= state.zoom <= 1 and 0 <= state.focus <= 1):
            raise UnsafeText(f"{state} is no place to stand at: angles in degrees, zoom and focus 0 to 1", where=_WHERE)
        self._state = state
        return state
