"""The twins that every contract test runs on.

``scripted``: the real adapters on a minimal studio in this process, on real sockets. ``replay``: the same, recorded,
then replayed without it. ``simulator``: the real adapters on the simulated studio, a process of its own.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import json
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import pytest

from engine_adapters.head import OperatorHead, SimulatedHead
from engine_adapters.mockboard.client import MockBoardFrames
from engine_adapters.ports import FrameSource, HeadState
from engine_adapters.profile import HeadSettings, MockBoardSettings, R3Settings, StudioProfile
from engine_adapters.r3.client import R3Engine, R3Snapshots
from engine_adapters.transcript import Recorder, Replay


def small_picture() -> bytes:
    """A PNG of 64 x 36 pixels."""
    rng = np.random.default_rng(7)
    done, data = cv2.imencode(".png", rng.integers(0, 256, (36, 64, 3), dtype=np.uint8))
    assert done
    return bytes(data)


@dataclass
class MinimalStudio:
    """Just enough of R3, MockBoard and head to answer as the seed tells."""

    exports: dict[str, str] = field(
        default_factory=lambda: {
            "lens.center_shift_x": "1.5",
            "lens.center_shift_y": "-0.25",
            "lens.fov_x": "60",
            "lens.k1": "-0.1",
            "lens.k2": "0.01",
            "lens.nodal_offset": "120",
            "background.visible": "1",
            "object.visible": "0",
        }
    )
    head: dict[str, float] = field(
        default_factory=lambda: {"pan_deg": 0.0, "tilt_deg": 0.0, "roll_deg": 0.0, "zoom": 0.0, "focus": 0.5}
    )
    picture: bytes = field(default_factory=small_picture)
    snapshots: dict[str, bytes] = field(default_factory=dict)
    handlers: set[asyncio.Task[None]] = field(default_factory=set)

    def answer(self, line: str) -> list[str]:
        parts = line.split('"')
        if line.startswith("engine.takeSnapshot"):
            self.snapshots[parts[1]] = self.picture
            return ["OK: SNAPSHOT TAKEN"]
        if line.startswith("engine.getSnapshot"):
            if parts[1] not in self.snapshots:
                return ["ERROR: GETSNAPSHOT - COULD NOT READ LAST SNAPSHOT FILE"]
            return [f"OK: <IMAGE> {base64.b64encode(self.snapshots[parts[1]]).decode()} <IMAGE>"]
        if line.startswith("engine.tracking"):
            return [
                "OK: CURRENT CAMERA PARAMETERS:",
                '{"FovX": 60.0, "FovY": 36.0, "AspectRatio": 1.7778,',
                ' "PosX": 0.0, "PosY": 0.0, "PosZ": 1.5, "RotX": 0.0, "RotY": 0.0, "RotZ": 0.0,',
                ' "ViewMatrix": [[1, 0], [0, 1]], "SensorSize": [9.59, 5.39]}',
            ]
        if line.endswith("getValue"):
            known = parts[3] in self.exports
            return [f"OK: SCENE EXPORT GETVALUE - {self.exports[parts[3]]}" if known else "ERROR: NOT FOUND"]
        answers = []
        for name, value in zip(parts[3::4], parts[5::4], strict=True):
            answers.append("OK: SCENE EXPORT SETVALUE - Value Set." if name in self.exports else "ERROR: NOT FOUND")
            if name in self.exports:
                self.exports[name] = value
        return answers

    async def serve_r3(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._handling(writer):
            while line := await reader.readline():
                writer.write("".join(f"{reply}\n" for reply in self.answer(line.decode().rstrip())).encode())

    async def serve_http(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._handling(writer):
            while request := await reader.readline():
                method, path, _ = request.decode().split(" ", 2)
                size = 0
                while (header := (await reader.readline()).decode().strip().lower()) != "":
                    size = int(header.removeprefix("content-length:")) if header.startswith("content-length:") else size
                status, body = self.answer_http(method, path, await reader.readexactly(size))
                writer.write(f"HTTP/1.1 {status} X\r\ncontent-length: {len(body)}\r\n\r\n".encode() + body)

    def answer_http(self, method: str, path: str, body: bytes) -> tuple[int, bytes]:
        if path.endswith("/GetImage"):
            return 200, base64.b64encode(self.picture)
        if method == "POST":
            self.head |= json.loads(body)
        return 200, json.dumps(self.head).encode()

    @contextlib.contextmanager
    def _handling(self, writer: asyncio.StreamWriter) -> Iterator[None]:
        task = asyncio.current_task()
        assert task is not None
        self.handlers.add(task)
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            yield
        writer.close()


@dataclass(frozen=True)
class Addresses:
    """Where a studio listens."""

    r3_host: str
    r3_port: int
    mockboard_url: str
    head_url: str

    def profile(self) -> StudioProfile:
        return StudioProfile(
            r3=R3Settings(host=self.r3_host, port=self.r3_port),
            mockboard=MockBoardSettings(url=self.mockboard_url),
            head=HeadSettings(kind="simulated", url=self.head_url),
        )


@contextlib.asynccontextmanager
async def minimal_studio() -> AsyncIterator[Addresses]:
    studio = MinimalStudio()
    r3 = await asyncio.start_server(studio.serve_r3, "127.0.0.1", 0)
    http = await asyncio.start_server(studio.serve_http, "127.0.0.1", 0)
    base = f"http://127.0.0.1:{http.sockets[0].getsockname()[1]}"
    try:
        yield Addresses("127.0.0.1", r3.sockets[0].getsockname()[1], base, base)
    finally:
        for server in (r3, http):
            server.close()
        for handler in studio.handlers:
            handler.cancel()
        await asyncio.gather(*studio.handlers, return_exceptions=True)
        for server in (r3, http):
            await server.wait_closed()


@pytest.fixture(scope="session", autouse=True)
def simulator() -> Iterator[Addresses]:
    """The simulated studio's addresses; its process ends with the session.

    Started before the first test, so that no test seems to leave a process behind.
    """
    command = [
        sys.executable,
        "-m",
        "engine_adapters.sim",
        "--r3-port",
        "0",
        "--mockboard-port",
        "0",
        "--head-port",
        "0",
    ]
    repository = Path(__file__).resolve().parents[2]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=repository) as process:
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            assert line, "the simulated studio ended before it told its addresses; its error stands above"
            told = json.loads(line)
            yield Addresses(told["r3"]["host"], told["r3"]["port"], told["mockboard"]["url"], told["head"]["url"])
        finally:
            process.terminate()
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()


class Port(Protocol):
    async def close(self) -> None: ...


Check = Callable[[Any], Awaitable[None]]
RunCheck = Callable[[Check], Awaitable[None]]


def _runner(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    build: Callable[[StudioProfile], Port],
    record: Callable[[Recorder, Any], Port],
    replay: Callable[[Replay], Port],
) -> RunCheck:
    """Runs a check on the twin that ``request.param`` names."""

    async def on_port(port: Port, check: Check) -> None:
        try:
            await check(port)
        finally:
            await port.close()
            await port.close()  # closing twice is part of every contract

    async def run(check: Check) -> None:
        if request.param == "simulator":
            addresses = request.getfixturevalue("simulator")
            await on_port(build(addresses.profile()), check)
            return
        async with minimal_studio() as addresses:
            if request.param == "scripted":
                await on_port(build(addresses.profile()), check)
                return
            recorder = Recorder(tmp_path)
            await on_port(record(recorder, build(addresses.profile())), check)
            recorder.close()
        transcript = Replay(tmp_path)
        await on_port(replay(transcript), check)
        assert transcript.left == 0

    return run


TWINS = ("scripted", "replay", "simulator")


@pytest.fixture(params=TWINS)
def on_engine(request: pytest.FixtureRequest, tmp_path: Path) -> RunCheck:
    """Runs a check on each twin of the render engine."""
    return _runner(request, tmp_path, R3Engine.from_profile, Recorder.engine, Replay.engine)


FRAME_SOURCES: dict[str, Callable[[StudioProfile], FrameSource]] = {
    "mockboard": MockBoardFrames.from_profile,
    "snapshots": R3Snapshots.from_profile,
}


@pytest.fixture(params=FRAME_SOURCES)
def frame_source(request: pytest.FixtureRequest) -> Callable[[StudioProfile], FrameSource]:
    """How a frame source is built."""
    return FRAME_SOURCES[request.param]


@pytest.fixture(params=TWINS)
def on_frames(
    request: pytest.FixtureRequest, tmp_path: Path, frame_source: Callable[[StudioProfile], FrameSource]
) -> RunCheck:
    """Runs a check on each twin of each frame source."""
    return _runner(request, tmp_path, frame_source, Recorder.frames, Replay.frames)


class ReadingOperator:
    """A person who does what the text says and tells where the camera stands."""

    def __init__(self) -> None:
        self.state = HeadState(0.0, 0.0, 0.0, 0.0, 0.5)

    async def __call__(self, text: str) -> HeadState:
        told = {name: value for name, word in itertools.pairwise(text.split()) if (value := _number(word)) is not None}
        now = self.state
        self.state = HeadState(
            told.get("pan", now.pan_deg),
            told.get("tilt", now.tilt_deg),
            told.get("roll", now.roll_deg),
            told.get("zoom", now.zoom),
            told.get("focus", now.focus),
        )
        return self.state


def _number(word: str) -> float | None:
    try:
        return float(word.strip("°,"))
    except ValueError:
        return None


@pytest.fixture(params=(*TWINS, "operator"))
def on_head(request: pytest.FixtureRequest, tmp_path: Path) -> RunCheck:
    """Runs a check on each twin of the camera head."""
    if request.param != "operator":
        return _runner(request, tmp_path, SimulatedHead.from_profile, Recorder.head, Replay.head)

    async def run(check: Check) -> None:
        head = OperatorHead(ReadingOperator(), answer_timeout_s=5.0)
        await check(head)
        await head.close()

    return run
