"""Record the calls through any port, and replay them later without the studio.

A transcript is a folder: ``transcript.jsonl`` with one line for each call (port, method, arguments, answer or error, in
the order in which the calls were made) and the pictures as files beside it. Replay answers the same calls in the same
order for each port, and raises :class:`ReplayMismatch` as soon as a call differs.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from engine_adapters.errors import (
    AdapterError,
    BadPicture,
    ProtocolError,
    Refused,
    TimedOut,
    Unreachable,
    UnsafeText,
)
from engine_adapters.pictures import picture_format
from engine_adapters.ports import (
    CameraHead,
    EncodedFrame,
    EngineState,
    FrameSource,
    HeadState,
    LensValues,
    ReadBack,
    RenderEngine,
    Shown,
    TrackedCamera,
)

T = TypeVar("T")

TRANSCRIPT_NAME = "transcript.jsonl"

_ERRORS: dict[str, type[AdapterError]] = {
    kind.__name__: kind for kind in (AdapterError, Unreachable, ProtocolError, UnsafeText, BadPicture)
}


class ReplayMismatch(AdapterError):
    """A call that the transcript does not hold at this place: the run went another way than the recorded one."""


@dataclass(frozen=True, slots=True)
class _Call:
    port: str
    method: str
    arguments: dict[str, Any]
    answer: Any
    error: dict[str, Any] | None


class Recorder:
    """Writes a transcript; wraps ports so that their calls go through and are noted."""

    def __init__(self, folder: str | Path) -> None:
        """``folder`` is made; a transcript that is already there is refused (``FileExistsError``)."""
        self._folder = Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        self._file = (self._folder / TRANSCRIPT_NAME).open("x", encoding="utf-8", newline="\n")
        self._lock = threading.Lock()
        self._next = 0

    def engine(self, port: RenderEngine) -> RenderEngine:
        """A render engine whose calls are noted."""
        return _RecordingEngine(self, port)

    def frames(self, port: FrameSource) -> FrameSource:
        """A frame source whose pictures are kept."""
        return _RecordingFrames(self, port)

    def head(self, port: CameraHead) -> CameraHead:
        """A camera head whose calls are noted."""
        return _RecordingHead(self, port)

    def close(self) -> None:
        """End the transcript. Safe to call twice."""
        self._file.close()

    async def note(self, port: str, method: str, arguments: dict[str, Any], call: Awaitable[T]) -> T:
        """Await a call and write it down with its answer or error. Cancelled calls are left out."""
        number = self._next
        self._next += 1
        entry = {"call": number, "port": port, "method": method, "arguments": arguments}
        try:
            answer = await call
        except AdapterError as error:
            await asyncio.to_thread(self._write, entry | {"error": _error_to_json(error)})
            raise
        await asyncio.to_thread(self._write_answer, entry, answer)
        return answer

    def _write_answer(self, entry: dict[str, Any], answer: Any) -> None:
        if isinstance(answer, EncodedFrame):
            name = f"{entry['call']:06d}.{picture_format(answer.data).value}"
            (self._folder / name).write_bytes(answer.data)
            told: Any = {
                "picture": name,
                "requested_at_s": answer.requested_at_s,
                "received_at_s": answer.received_at_s,
                "source": answer.source,
            }
        else:
            told = [asdict(part) for part in answer] if isinstance(answer, tuple) else answer and asdict(answer)
        self._write(entry | {"answer": told})

    def _write(self, entry: dict[str, Any]) -> None:
        with self._lock:
            self._file.write(json.dumps(entry, ensure_ascii=False) + "\n")
            self._file.flush()


class Replay:
    """Reads a transcript; its ports answer as the recorded ones did."""

    def __init__(self, folder: str | Path) -> None:
        """Raises ``ReplayMismatch`` for a folder that holds no transcript."""
        self._folder = Path(folder)
        self._calls: dict[str, deque[_Call]] = {}
        path = self._folder / TRANSCRIPT_NAME
        try:
            text = path.read_text(encoding="utf-8")
            entries = sorted((json.loads(line) for line in text.splitlines()), key=lambda entry: int(entry["call"]))
            for entry in entries:
                call = _Call(
                    entry["port"], entry["method"], entry["arguments"], entry.get("answer"), entry.get("error")
                )
                self._calls.setdefault(call.port, deque()).append(call)
        except OSError as error:
            raise ReplayMismatch(f"cannot be read ({error.strerror or error})", where=str(path)) from error
        except (ValueError, KeyError, TypeError) as error:
            raise ReplayMismatch(f"is no transcript ({error})", where=str(path)) from error

    def engine(self) -> RenderEngine:
        """The recorded render engine."""
        return _ReplayEngine(partial(self.answer, "engine"))

    def frames(self) -> FrameSource:
        """The recorded frame source."""
        return _ReplayFrames(partial(self.answer, "frames"), self._folder)

    def head(self) -> CameraHead:
        """The recorded camera head."""
        return _ReplayHead(partial(self.answer, "head"))

    @property
    def left(self) -> int:
        """Number of calls not yet replayed."""
        return sum(len(calls) for calls in self._calls.values())

    def answer(self, port: str, method: str, arguments: dict[str, Any]) -> Any:
        """The recorded answer to the next call. Raises the recorded error, or ``ReplayMismatch``."""
        calls = self._calls.get(port)
        where = str(self._folder)
        if not calls:
            raise ReplayMismatch(f"{port}.{method}: the transcript has no further call of this port", where=where)
        call = calls[0]
        if (call.method, call.arguments) != (method, arguments):
            raise ReplayMismatch(
                f"{port}.{method}({arguments}) was called, the transcript has {call.method}({call.arguments})",
                where=where,
            )
        calls.popleft()
        if call.error is not None:
            raise _error_from_json(call.error)
        return call.answer


class _RecordingEngine:
    def __init__(self, recorder: Recorder, port: RenderEngine) -> None:
        self._recorder = recorder
        self._port = port

    async def read_state(self) -> EngineState:
        return await self._recorder.note("engine", "read_state", {}, self._port.read_state())

    async def restore(self, state: EngineState) -> None:
        await self._recorder.note("engine", "restore", _state_arguments(state), self._port.restore(state))

    async def apply(self, values: LensValues) -> None:
        await self._recorder.note("engine", "apply", _lens_arguments(values), self._port.apply(values))

    async def read_lens(self) -> LensValues:
        return await self._recorder.note("engine", "read_lens", {}, self._port.read_lens())

    async def read_back(self, values: LensValues) -> tuple[ReadBack, ...]:
        return await self._recorder.note("engine", "read_back", _lens_arguments(values), self._port.read_back(values))

    async def show(self, shown: Shown) -> None:
        await self._recorder.note("engine", "show", {"shown": shown.value}, self._port.show(shown))

    async def tracking(self) -> TrackedCamera:
        return await self._recorder.note("engine", "tracking", {}, self._port.tracking())

    async def close(self) -> None:
        await self._port.close()


class _RecordingFrames:
    def __init__(self, recorder: Recorder, port: FrameSource) -> None:
        self._recorder = recorder
        self._port = port

    async def fetch(self) -> EncodedFrame:
        return await self._recorder.note("frames", "fetch", {}, self._port.fetch())

    async def close(self) -> None:
        await self._port.close()


class _RecordingHead:
    def __init__(self, recorder: Recorder, port: CameraHead) -> None:
        self._recorder = recorder
        self._port = port

    async def move_to(self, *, pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> HeadState:
        goal = {"pan_deg": pan_deg, "tilt_deg": tilt_deg, "roll_deg": roll_deg}
        return await self._recorder.note("head", "move_to", dict(goal), self._port.move_to(**goal))

    async def set_lens(self, *, zoom: float, focus: float) -> HeadState:
        goal = {"zoom": zoom, "focus": focus}
        return await self._recorder.note("head", "set_lens", dict(goal), self._port.set_lens(**goal))

    async def read(self) -> HeadState:
        return await self._recorder.note("head", "read", {}, self._port.read())

    async def close(self) -> None:
        await self._port.close()


_Answer = Callable[[str, dict[str, Any]], Any]


class _ReplayEngine:
    def __init__(self, answer: _Answer) -> None:
        self._answer = answer

    async def read_state(self) -> EngineState:
        told = self._answer("read_state", {})
        return EngineState(exports=tuple((name, value) for name, value in told["exports"]))

    async def restore(self, state: EngineState) -> None:
        self._answer("restore", _state_arguments(state))

    async def apply(self, values: LensValues) -> None:
        self._answer("apply", _lens_arguments(values))

    async def read_lens(self) -> LensValues:
        told = self._answer("read_lens", {})
        x_px, y_px = told["center_shift_px"]
        return LensValues(**(told | {"center_shift_px": (x_px, y_px)}))

    async def read_back(self, values: LensValues) -> tuple[ReadBack, ...]:
        told = self._answer("read_back", _lens_arguments(values))
        return tuple(ReadBack(**held) for held in told)

    async def show(self, shown: Shown) -> None:
        self._answer("show", {"shown": shown.value})

    async def tracking(self) -> TrackedCamera:
        told = self._answer("tracking", {})
        right_m, forward_m, up_m = told["pivot_m"]
        return TrackedCamera(**(told | {"pivot_m": (right_m, forward_m, up_m)}))

    async def close(self) -> None:
        """Nothing is held."""


class _ReplayFrames:
    def __init__(self, answer: _Answer, folder: Path) -> None:
        self._answer = answer
        self._folder = folder

    async def fetch(self) -> EncodedFrame:
        told = self._answer("fetch", {})
        path = self._folder / Path(told["picture"]).name
        try:
            data = await asyncio.to_thread(path.read_bytes)
        except OSError as error:
            raise ReplayMismatch(f"the picture cannot be read ({error.strerror or error})", where=str(path)) from error
        return EncodedFrame(data, told["requested_at_s"], told["received_at_s"], told["source"])

    async def close(self) -> None:
        """Nothing is held."""


class _ReplayHead:
    def __init__(self, answer: _Answer) -> None:
        self._answer = answer

    async def move_to(self, *, pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> HeadState:
        goal = {"pan_deg": pan_deg, "tilt_deg": tilt_deg, "roll_deg": roll_deg}
        return HeadState(**self._answer("move_to", goal))

    async def set_lens(self, *, zoom: float, focus: float) -> HeadState:
        return HeadState(**self._answer("set_lens", {"zoom": zoom, "focus": focus}))

    async def read(self) -> HeadState:
        return HeadState(**self._answer("read", {}))

    async def close(self) -> None:
        """Nothing is held."""


def _lens_arguments(values: LensValues) -> dict[str, Any]:
    return asdict(values) | {"center_shift_px": list(values.center_shift_px)}


def _state_arguments(state: EngineState) -> dict[str, Any]:
    return {"exports": [list(pair) for pair in state.exports]}


def _error_to_json(error: AdapterError) -> dict[str, Any]:
    told: dict[str, Any] = {"type": type(error).__name__, "where": error.where}
    if isinstance(error, Refused):
        return told | {"answer": error.answer, "command": error.command}
    if isinstance(error, TimedOut):
        return told | {"what": error.what, "bound_s": error.bound_s}
    return told | {"message": str(error).removeprefix(f"{error.where}: ")}


def _error_from_json(told: dict[str, Any]) -> AdapterError:
    where = told["where"]
    if told["type"] == Refused.__name__:
        return Refused(told["answer"], where=where, command=told["command"])
    if told["type"] == TimedOut.__name__:
        return TimedOut(told["what"], told["bound_s"], where=where)
    # An error of a later version keeps its text.
    return _ERRORS.get(told["type"], AdapterError)(told["message"], where=where)
