"""The simulated MockBoard: ``GET /api/v1/MockCard/MockOutput/GetImage`` gives the output picture as a base64 string."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace

from engine_adapters.sim.camera_output import CameraOutput, PayloadStyle, PictureFormat
from engine_adapters.sim.faults import Fault, FaultKind, FaultPlan, FaultTarget
from engine_adapters.sim.studio import OutputState, Studio
from engine_adapters.sim.wire import Request, Response

IMAGE_PATH = "/api/v1/MockCard/MockOutput/GetImage"


class MockBoard:
    """Answers picture requests: each takes one picture time and shows the frame that is current when it is answered."""

    def __init__(
        self,
        studio: Studio,
        output: CameraOutput,
        *,
        style: PayloadStyle,
        picture_format: PictureFormat,
        faults: FaultPlan,
        worker: Executor,
        clock: Callable[[], float],
    ) -> None:
        self._studio = studio
        self._output = output
        self._style = style
        self._format = picture_format
        self._faults = faults
        self._worker = worker
        self._clock = clock
        self._last: bytes | None = None

    async def answer(self, request: Request) -> Response:
        """One HTTP exchange."""
        if request.path != IMAGE_PATH:
            return Response.error(404, f"nothing here; pictures are at {IMAGE_PATH}")
        if request.method != "GET":
            return Response.error(405, "pictures are read with GET")
        fault = self._faults.next(FaultTarget.MOCKBOARD)
        if fault is not None and fault.kind is FaultKind.STATUS:
            return Response.error(int(fault.value), "a fault asked for")
        previous = self._last
        body = await self._picture()
        self._studio.statistics.pictures += 1
        self._last = body
        if fault is not None and fault.kind is FaultKind.STALE and previous is not None:
            body = self._last = previous
        return self._spoilt(Response(200, body, self._content_type), fault)

    @property
    def _content_type(self) -> str:
        return "application/json" if self._style is PayloadStyle.JSON else "text/plain; charset=us-ascii"

    def _spoilt(self, response: Response, fault: Fault | None) -> Response:
        if fault is None:
            return response
        if fault.kind is FaultKind.GARBAGE:
            # Nonsense in a whole HTTP answer: the layer above HTTP has to notice it.
            return replace(response, body=b"!! not a picture \xff\x00 !!")
        return replace(response, fault=fault)

    async def _picture(self) -> bytes:
        answered_s = self._clock() + self._studio.setup.picture_time_s
        frame = self._studio.frame_at(answered_s)
        # With a delay the frame is mostly settled already: draw it while its time passes.
        expected = self._studio.output(frame)
        body = await self._draw(expected)
        await asyncio.sleep(max(0.0, answered_s - self._clock()))
        shown = self._studio.output(frame)
        return body if shown == expected else await self._draw(shown)

    async def _draw(self, state: OutputState) -> bytes:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._worker, self._output.payload, state, self._style, self._format)
