"""Start the simulated studio as a process of its own, and end it: for the demo, benchmarks and tests."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import AsyncIterator, Sequence
from typing import Any

from engine_adapters.errors import ProtocolError, TimedOut, Unreachable

READY_BOUND_S = 60.0
"""Longest wait for the first line: a cold start imports OpenCV and draws one picture on a loaded machine."""

_END_BOUND_S = 10.0
# Ctrl-C at a terminal reaches its whole process group: the studio must outlive the client that puts its values back.
_OWN_GROUP: dict[str, Any] = (
    {"creationflags": 0x200}  # CREATE_NEW_PROCESS_GROUP, a name that Python has on Windows only
    if sys.platform == "win32"
    else {"start_new_session": True}
)
_LINE_LIMIT = 1 << 20


@contextlib.asynccontextmanager
async def launched_studio(options: Sequence[str] = ()) -> AsyncIterator[dict[str, Any]]:
    """A running simulated studio; gives the addresses it printed, ends it on leaving.

    ``options`` as in ``python -m engine_adapters.sim --help``; ports default to free ones. The process also ends when
    this one dies. Raises Unreachable with the simulator's own line when it cannot start, TimedOut, ProtocolError.
    """
    ports = ("--r3-port", "0", "--mockboard-port", "0", "--head-port", "0")
    command = (sys.executable, "-m", "engine_adapters.sim", *ports, "--exit-with-parent", *options)
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        limit=_LINE_LIMIT,
        **_OWN_GROUP,
    )
    if process.stdin is None or process.stdout is None or process.stderr is None:
        raise RuntimeError("a process started with pipes has them")
    complaints = asyncio.create_task(process.stderr.read())
    try:
        yield await _ready(process, process.stdout, complaints)
    finally:
        process.stdin.close()
        try:
            async with asyncio.timeout(_END_BOUND_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()
        complaints.cancel()
        await asyncio.gather(complaints, return_exceptions=True)


async def _ready(
    process: asyncio.subprocess.Process, output: asyncio.StreamReader, complaints: asyncio.Task[bytes]
) -> dict[str, Any]:
    try:
        async with asyncio.timeout(READY_BOUND_S):
            line = await output.readline()
            if not line:
                told = (await complaints).decode(errors="replace").strip().splitlines()
                await process.wait()
                raise Unreachable(told[-1] if told else "it ended without a word", where="simulated studio")
    except TimeoutError as error:
        raise TimedOut("its first line", READY_BOUND_S, where="simulated studio") from error
    try:
        addresses: dict[str, Any] = json.loads(line)
    except ValueError as error:
        raise ProtocolError(f"its first line is not JSON: {line[:80]!r}", where="simulated studio") from error
    return addresses
