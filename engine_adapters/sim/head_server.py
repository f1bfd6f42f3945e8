"""The simulated camera head and lens drive over HTTP.

- ``GET /head``: ``{"pan_deg", "tilt_deg", "roll_deg", "zoom", "focus"}`` as they stand now;
- ``POST /head`` with any of them: drives there and answers the same object when all stands still; 422 with
  ``{"error": ...}`` for a value out of range;
- ``GET /stats``: what clients have asked of the studio so far.
"""

from __future__ import annotations

import asyncio
import json
from concurrent.futures import Executor
from dataclasses import asdict

from engine_adapters.sim.camera_output import CameraOutput
from engine_adapters.sim.studio import HeadPose, Studio, StudioError
from engine_adapters.sim.wire import Request, Response

_NAMES = HeadPose.__slots__


class Head:
    """Answers the head's requests. Movements asked for at the same time are made one after another."""

    def __init__(self, studio: Studio, output: CameraOutput, worker: Executor) -> None:
        self._studio = studio
        self._output = output
        self._worker = worker
        self._moving = asyncio.Lock()

    async def answer(self, request: Request) -> Response:
        """One HTTP exchange."""
        if request.path == "/stats" and request.method == "GET":
            return Response.of_json(self._studio.stats())
        if request.path != "/head":
            return Response.error(404, "nothing here; there are /head and /stats")
        if request.method == "GET":
            return self._state()
        if request.method != "POST":
            return Response.error(405, "the head is read with GET and driven with POST")
        wanted = _wanted(request.body)
        if isinstance(wanted, Response):
            return wanted
        async with self._moving:
            try:
                stands_in_s = self._studio.move(**wanted)
            except StudioError as error:
                return Response.error(422, str(error))
            # While it turns the picture of its goal can be drawn: a real camera needs no time for that either.
            loop = asyncio.get_running_loop()
            await asyncio.gather(
                asyncio.sleep(stands_in_s),
                loop.run_in_executor(self._worker, self._output.prepare, self._studio.standing()),
            )
        return self._state()

    def _state(self) -> Response:
        return Response.of_json(asdict(self._studio.head()))


def _wanted(body: bytes) -> dict[str, float] | Response:
    try:
        content = json.loads(body)
    except (ValueError, RecursionError):
        return Response.error(400, "the body is not JSON")
    if not isinstance(content, dict) or not content:
        return Response.error(422, f"send an object with any of {', '.join(_NAMES)}")
    wanted: dict[str, float] = {}
    for name, value in content.items():
        if name not in _NAMES:
            return Response.error(422, f"{str(name)[:40]!r} is unknown; there are {', '.join(_NAMES)}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            return Response.error(422, f"{name} is not a number")
        try:
            wanted[name] = float(value)
        except OverflowError:
            return Response.error(422, f"{name} is out of range")
    return wanted
