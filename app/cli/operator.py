"""The operator at the terminal: asked to turn the camera, tells where it stands."""

from __future__ import annotations

import asyncio
import os
import re
import sys
import threading
from collections.abc import Callable

from app.cli.console import say
from engine_adapters.ports import HeadState

_NAMES = ("pan", "tilt", "roll", "zoom", "focus")
_GOAL = re.compile(rf"\b({'|'.join(_NAMES)}) (-?[0-9]+(?:\.[0-9]+)?)")
_SET = re.compile(rf"({'|'.join(_NAMES)})=(-?[0-9]+(?:\.[0-9]+)?)")
_NUMBER = re.compile(r"-?[0-9]+(?:\.[0-9]+)?")
_HOW = "Enter: it stands there. Else what the encoders show, as pan=1.25 tilt=-0.5 or all five numbers; q: decline."


class TerminalOperator:
    """Asks on the terminal; give its :meth:`ask` to the operator's head."""

    def __init__(self, read_line: Callable[[], str] | None = None) -> None:
        self._read_line = read_line or _read_terminal_line
        self._last: dict[str, float] = {}

    async def ask(self, text: str) -> HeadState | None:
        """Show the question and give the state that the operator confirms; None when they decline or input ends.

        A cancellation withdraws the question; the thread that waits for the line ends with the process.
        """
        say(text)
        say(_HOW)
        while True:
            line = await self._line()
            if line == "" or line.strip().lower() in ("q", "quit"):
                return None
            told = answered(line.strip(), text, self._last)
            if isinstance(told, dict):
                self._last = told
                return HeadState(*(told[f] for f in _NAMES))
            say(told)

    async def _line(self) -> str:
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[str] = loop.create_future()

        def deliver(line: str) -> None:
            if not answer.done():
                answer.set_result(line)

        def wait() -> None:
            line = self._read_line()
            if not loop.is_closed():
                loop.call_soon_threadsafe(deliver, line)

        # A daemon: nothing can wake a thread that waits for a key, and the process must end without one.
        threading.Thread(target=wait, daemon=True, name="operator").start()
        return await answer


def answered(line: str, question: str, last: dict[str, float]) -> dict[str, float] | str:
    """The state that an answer tells, or what is wrong with the answer.

    What the question asks for (``pan 1.250``) and what was told last fill in what the answer leaves out.
    """
    known = last | {name: float(value) for name, value in _GOAL.findall(question)}
    words = line.replace(",", " ").split()
    given = [_SET.fullmatch(word) for word in words]
    if all(given):
        known |= {match[1]: float(match[2]) for match in given if match is not None}
    elif len(words) == len(_NAMES) and all(_NUMBER.fullmatch(word) for word in words):
        known = dict(zip(_NAMES, map(float, words), strict=True))
    else:
        return f"{line!r} is not understood. {_HOW}"
    missing = [name for name in _NAMES if name not in known]
    return (
        known if not missing else f"{', '.join(missing)} not known yet: give all five numbers once: {' '.join(_NAMES)}"
    )


def has_terminal() -> bool:
    """Whether somebody can answer."""
    return sys.stdin is not None and sys.stdin.isatty()


def _read_terminal_line() -> str:
    """A line with its end, '' at the end of input."""
    # os.read, not sys.stdin: a thread that sits in sys.stdin's lock would abort the interpreter's exit.
    line = b""
    while not line.endswith(b"\n"):
        try:
            some = os.read(0, 1024)
        except OSError:
            return ""
        if not some:
            return ""
        line += some
    return line.decode(errors="replace")
