"""The simulated studio as a process of its own: all its servers on one event loop, drawing in one worker thread."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine_adapters.sim.camera_output import CameraOutput, PayloadStyle, PictureFormat
from engine_adapters.sim.engine_camera import EngineCamera
from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.faults import FaultPlan, parse_fault
from engine_adapters.sim.head_server import Head
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded, load_lens
from engine_adapters.sim.mockboard_server import MockBoard
from engine_adapters.sim.r3_server import SNAPSHOT_TIME_S, R3Engine
from engine_adapters.sim.room import RoomKind, build_room
from engine_adapters.sim.studio import Studio, StudioSetup
from engine_adapters.sim.wire import TcpServer, http_connection

HOST = "127.0.0.1"
"""Loopback only: like the engine it imitates, it trusts every client."""


@dataclass(frozen=True, slots=True)
class SimulatorOptions:
    """How to run the simulated studio. Port 0: any free one. ``lens_file`` goes before the embedded ``lens``."""

    lens_file: Path | None = None
    lens: str = embedded_lens_names()[0]
    r3_port: int = 9009
    mockboard_port: int = 1987
    head_port: int = 9010
    room: RoomKind = RoomKind.BOARDS
    delay_frames: int = 2
    picture_time_ms: float = 15.0
    payload: PayloadStyle = PayloadStyle.BARE
    payload_format: PictureFormat = PictureFormat.BMP
    head_speed_deg_s: float = 120.0
    snapshot_time_s: float = SNAPSHOT_TIME_S
    seed: int = 1
    faults: tuple[str, ...] = ()
    engine: tuple[str, ...] = ()
    exit_with_parent: bool = False


async def serve(options: SimulatorOptions, *, ready: Callable[[dict[str, Any]], None], stop: asyncio.Event) -> None:
    """Run every server until ``stop``; ``ready`` gets the addresses once all of them listen.

    ``ready`` is called with ``{"r3": {"host", "port"}, "mockboard": {"url"}, "head": {"url"}, "pid", "lens", "room"}``.
    Raises :class:`SimulatorError` for a lens, fault, port or option it cannot run with.
    """
    async with simulated_studio(options) as addresses:
        ready(addresses)
        await stop.wait()


@contextlib.asynccontextmanager
async def simulated_studio(options: SimulatorOptions) -> AsyncIterator[dict[str, Any]]:
    """The running studio's addresses (as in :func:`serve`); all its servers end with the block."""
    faults = FaultPlan(parse_fault(spec) for spec in options.faults)
    lens = load_lens(options.lens_file) if options.lens_file is not None else load_embedded(options.lens)
    room = build_room(options.room)
    setup = StudioSetup(
        delay_frames=options.delay_frames,
        picture_time_s=options.picture_time_ms / 1000.0,
        head_speed_deg_s=options.head_speed_deg_s,
        camera=EngineCamera.parse(options.engine),
    )
    clock = time.monotonic
    studio = Studio(lens, room, setup, clock=clock)
    output = CameraOutput(room, lens.image_size, seed=options.seed, statistics=studio.statistics)
    async with contextlib.AsyncExitStack() as stack:
        projects = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lensmatch-projects-")))
        worker = stack.enter_context(ThreadPoolExecutor(max_workers=1, thread_name_prefix="studio"))
        engine = R3Engine(
            studio,
            output,
            projects=projects,
            faults=faults,
            worker=worker,
            clock=clock,
            snapshot_time_s=options.snapshot_time_s,
        )
        board = MockBoard(
            studio,
            output,
            style=options.payload,
            picture_format=options.payload_format,
            faults=faults,
            worker=worker,
            clock=clock,
        )
        head = Head(studio, output, worker)
        r3_host, r3_port = await _listen(stack, TcpServer(engine.connection), options.r3_port, "R3")
        _, board_port = await _listen(
            stack, TcpServer(http_connection(board.answer)), options.mockboard_port, "MockBoard"
        )
        _, head_port = await _listen(stack, TcpServer(http_connection(head.answer)), options.head_port, "head")
        # The first picture should not wait for tables and fonts of pixels that later ones find ready.
        await asyncio.get_running_loop().run_in_executor(worker, output.prepare, studio.standing())
        yield {
            "r3": {"host": r3_host, "port": r3_port},
            "mockboard": {"url": f"http://{HOST}:{board_port}"},
            "head": {"url": f"http://{HOST}:{head_port}"},
            "pid": os.getpid(),
            "lens": lens.name,
            "room": room.kind.value,
            "projects": str(projects),
            "survey": room.survey(),
        }


async def _listen(stack: contextlib.AsyncExitStack, server: TcpServer, port: int, name: str) -> tuple[str, int]:
    if not 0 <= port <= 65535:
        raise SimulatorError(f"{port} is no port: give 0 (any free one) to 65535", where=name)
    try:
        address = await server.start(HOST, port)
    except OSError as error:
        reason = error.strerror or str(error)
        raise SimulatorError(
            f"cannot listen ({reason}); is another program using the port? Give another one, or 0 for a free one",
            where=f"{name}, {HOST}:{port}",
        ) from error
    stack.push_async_callback(server.aclose)
    return address


def main(options: SimulatorOptions) -> int:
    """Run until a signal or the parent's end; one JSON line on standard output when ready. Returns the exit code."""
    try:
        asyncio.run(_run(options))
    except SimulatorError as error:
        print(f"lensmatch simulate: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0
    return 0


async def _run(options: SimulatorOptions) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            loop.add_signal_handler(number, stop.set)
        except NotImplementedError:  # Windows' event loop has no signal handlers of its own
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(stop.set))
    if options.exit_with_parent:
        threading.Thread(target=_wait_for_parent, args=(loop, stop), daemon=True, name="parent").start()
    await serve(options, ready=lambda addresses: print(json.dumps(addresses), flush=True), stop=stop)


def _wait_for_parent(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    """Reads standard input to its end, which comes when the parent closes it or dies."""
    # os.read, not sys.stdin: a thread that sits in sys.stdin's lock would abort the interpreter's exit.
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(stop.set)
