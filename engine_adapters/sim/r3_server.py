"""The simulated R3 engine's text command server (seed, 2.3.3).

One command a line (LF or CRLF, UTF-8), one reply line for each (MultiExport: one for each export, in order):

================================================================ ==================================================
``engine.takeSnapshot "name"``                                    ``OK: SNAPSHOT TAKEN``
``engine.getSnapshot "name"``                                     ``OK: <IMAGE> base64 <IMAGE>``
``engine.tracking "Cam0" get``                                    ``OK: CURRENT CAMERA PARAMETERS: {"FovX": ...}``
``scene "p/s" export "name" SetValue "v" ["name" SetValue "v"]``  ``OK: SCENE EXPORT SETVALUE - Value Set.``
``scene "p/s" export "name" getValue``                            ``OK: SCENE EXPORT GETVALUE - v``
``scene "p/s" export "name" rename "new"``                        ``OK: SCENE EXPORT RENAME - Renamed.``
================================================================ ==================================================

The study does not tell the replies of getValue and rename, nor on how many lines the tracking packet comes: those are
this simulator's own, and settings of the client. Refusals are ``ERROR: ...`` lines.
"""

from __future__ import annotations

import asyncio
import base64
import json
import math
import re
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

from engine_adapters.sim.camera_output import CameraOutput, PictureFormat, encode_picture
from engine_adapters.sim.faults import FaultKind, FaultPlan, FaultTarget
from engine_adapters.sim.studio import OutputState, Studio, StudioError
from engine_adapters.sim.wire import deliver

SNAPSHOT_TIME_S = 0.3
"""What the study measured for a snapshot on disk (seed, 5.1)."""
MAX_SNAPSHOTS = 64
"""Snapshots kept on disk; the oldest goes when one more is taken."""

_TOKEN = re.compile(r'\s*(?:"([^"]*)"|([^\s"]+))')
_SNAPSHOT_INVALID = "ERROR: SNAPSHOT \N{EN DASH} INVALID PATH"
_GET_INVALID = "ERROR: GETSNAPSHOT - INVALID PATH"
_GET_UNREADABLE = "ERROR: GETSNAPSHOT - COULD NOT READ LAST SNAPSHOT FILE"
_VALUE_SET = "OK: SCENE EXPORT SETVALUE - Value Set."
_UNKNOWN = "ERROR: UNKNOWN COMMAND"
_RESERVED_NAME = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
_UNSAFE_IN_NAME = re.compile(r'[\x00-\x1f<>:"|?*/\\]')


class R3Engine:
    """Answers R3 commands; ``projects`` is the folder that snapshots are written to."""

    def __init__(
        self,
        studio: Studio,
        output: CameraOutput,
        *,
        projects: Path,
        faults: FaultPlan,
        worker: Executor,
        clock: Callable[[], float],
        snapshot_time_s: float = SNAPSHOT_TIME_S,
    ) -> None:
        self._studio = studio
        self._output = output
        self._projects = projects.resolve()
        self._faults = faults
        self._worker = worker
        self._clock = clock
        self._snapshot_time_s = snapshot_time_s
        self._snapshots: list[Path] = []

    async def connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One client, until it goes or a fault or an endless line cuts it off."""
        while True:
            try:
                line = await reader.readuntil(b"\n")
            except asyncio.LimitOverrunError:
                await deliver(writer, b"ERROR: COMMAND TOO LONG\n", None)
                return
            command = line.rstrip(b"\r\n")
            if not command:
                continue
            fault = self._faults.next(FaultTarget.R3)
            clip = fault.value if fault is not None and fault.kind is FaultKind.CLIP else math.inf
            replies = await self.answer(command, clip)
            if not await deliver(writer, "".join(reply + "\n" for reply in replies).encode(), fault):
                return

    async def answer(self, command: bytes, clip: float = math.inf) -> list[str]:
        """The reply lines to one command line (without its line ending). ``clip``: k1 and k2 are kept within it."""
        try:
            words = _words(command.decode("utf-8"))
        except UnicodeDecodeError:
            return ["ERROR: INVALID ENCODING"]
        match words:
            case [("engine.takeSnapshot", False), (name, True)]:
                return [await self._take_snapshot(name)]
            case [("engine.getSnapshot", False), (name, True)]:
                return [await self._get_snapshot(name)]
            case [("engine.tracking", False), (camera, True), ("get", False)]:
                return [self._tracking(camera)]
            case [("scene", False), (scene, True), ("export", False), *rest]:
                return self._export(scene, rest, clip)
        return [_UNKNOWN]

    def _tracking(self, camera: str) -> str:
        try:
            return "OK: CURRENT CAMERA PARAMETERS: " + json.dumps(self._studio.tracking(camera))
        except StudioError as error:
            return f"ERROR: TRACKING - {error}"

    def _export(self, scene: str, words: list[tuple[str, bool]], clip: float) -> list[str]:
        match words:
            case [(name, True), ("getValue", False)]:
                try:
                    return [f"OK: SCENE EXPORT GETVALUE - {self._studio.get_value(scene, name)}"]
                except StudioError as error:
                    return [f"ERROR: SCENE EXPORT GETVALUE - {error}"]
            case [(name, True), ("rename", False), (new_name, True)]:
                try:
                    self._studio.rename(scene, name, new_name)
                except StudioError as error:
                    return [f"ERROR: SCENE EXPORT RENAME - {error}"]
                return ["OK: SCENE EXPORT RENAME - Renamed."]
        settings = [words[start : start + 3] for start in range(0, len(words), 3)]
        replies = []
        for setting in settings:
            match setting:
                case [(name, True), ("SetValue", False), (value, True)]:
                    replies.append((name, value))
                case _:
                    return [_UNKNOWN]
        return [self._set_value(scene, name, value, clip) for name, value in replies] or [_UNKNOWN]

    def _set_value(self, scene: str, name: str, value: str, clip: float) -> str:
        names = self._studio.setup.names
        try:
            if clip < math.inf and name in (names.k1, names.k2):
                value = _clipped(value, clip)
            self._studio.set_value(scene, name, value)
        except StudioError as error:
            return f"ERROR: SCENE EXPORT SETVALUE - {error}"
        return _VALUE_SET

    async def _take_snapshot(self, name: str) -> str:
        path = self._snapshot_path(name)
        if path is None:
            return _SNAPSHOT_INVALID
        answered_s = self._clock() + self._snapshot_time_s
        state = self._studio.output(self._studio.frame_at(self._clock()))
        loop = asyncio.get_running_loop()
        if not await loop.run_in_executor(self._worker, self._write, state, path):
            return _SNAPSHOT_INVALID
        self._studio.statistics.pictures += 1
        await asyncio.sleep(max(0.0, answered_s - self._clock()))
        return "OK: SNAPSHOT TAKEN"

    def _write(self, state: OutputState, path: Path) -> bool:
        data = encode_picture(self._output.picture(state), PictureFormat.PNG)
        try:
            path.write_bytes(data)
        except OSError:
            return False
        if path in self._snapshots:
            self._snapshots.remove(path)
        self._snapshots.append(path)
        while len(self._snapshots) > MAX_SNAPSHOTS:
            self._snapshots.pop(0).unlink(missing_ok=True)
        return True

    async def _get_snapshot(self, name: str) -> str:
        path = self._snapshot_path(name)
        if path is None:
            return _GET_INVALID
        loop = asyncio.get_running_loop()
        try:
            data = await loop.run_in_executor(self._worker, path.read_bytes)
        except OSError:
            return _GET_UNREADABLE
        return f"OK: <IMAGE> {base64.b64encode(data).decode('ascii')} <IMAGE>"

    def _snapshot_path(self, name: str) -> Path | None:
        """Where a snapshot of that name lies; None unless that is directly in the projects folder.

        An absolute path into that folder is taken too; any other path, drive, stream or device name is not.
        """
        inside = str(self._projects)
        for separator in ("/", "\\"):
            prefix = inside.replace("\\", separator).replace("/", separator) + separator
            if name.startswith(prefix):
                name = name[len(prefix) :]
                break
        if not name.strip(" .") or len(name) > 100 or _UNSAFE_IN_NAME.search(name) or _RESERVED_NAME.fullmatch(name):
            return None
        path = self._projects / (name if name.lower().endswith(".png") else f"{name}.png")
        return path if path.parent == self._projects else None


def _clipped(value: str, limit: float) -> str:
    """A number's text within -limit and limit; what is no number is left for the studio to refuse."""
    try:
        number = float(value)
    except ValueError:
        return value
    return value if abs(number) <= limit else f"{math.copysign(limit, number):.12g}"


def _words(line: str) -> list[tuple[str, bool]]:
    """The words of a command, each with whether it stood in double quotes; empty for a line that has none."""
    words = []
    position = 0
    line = line.rstrip()
    while position < len(line):
        match = _TOKEN.match(line, position)
        if match is None:
            return []
        words.append((match[2], False) if match[2] is not None else (match[1], True))
        position = match.end()
    return words
