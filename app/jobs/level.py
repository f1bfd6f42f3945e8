"""One level: the method decides, this does the I/O between; moving, fetching and finding overlap."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from app.jobs.cpu import Cpu
from app.jobs.taking import PictureTaker, Taken, observe
from calibration.errors import CalibrationError
from calibration.image import Transfer
from calibration.solve.search import Capture, LevelMethod, LevelTask, Observation, Source
from calibration.tables import Frames, LevelResult
from calibration.types import Detection, Picture

Report = Callable[[str, Mapping[str, Any]], None]
"""Tells what happened: event kind and data."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenPicture:
    """A picture of the level with what was found in it, kept for the report."""

    picture: Picture
    target: str
    detection: Detection
    pan_deg: float
    tilt_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class LevelOutcome:
    """What a level leaves: its result, its last render with the camera's picture at the same pose (or None), and
    every target seen by the camera. ``hashes``: SHA-256 of each picture file by the picture's name."""

    result: LevelResult
    real: SeenPicture | None
    virtual: SeenPicture | None
    seen: tuple[SeenPicture, ...]
    hashes: Mapping[str, str] = field(default_factory=dict)


class LevelRun:
    """Drives one method over one level on one studio."""

    def __init__(
        self, method: LevelMethod, task: LevelTask, taker: PictureTaker, cpu: Cpu, transfer: Transfer, report: Report
    ) -> None:
        self._method = method
        self._task = task
        self._taker = taker
        self._cpu = cpu
        self._transfer = transfer
        self._report = report
        self._pending: dict[asyncio.Task[Observation], Taken] = {}
        self._real: dict[tuple[str, float, float], SeenPicture] = {}
        self._virtual: SeenPicture | None = None
        self._hashes: dict[str, str] = {}

    async def run(self) -> LevelOutcome:
        """Run the level to its end.

        A level that the method cannot solve comes back failed with its reason; errors of the studio
        (:class:`engine_adapters.errors.AdapterError`) are the caller's, with nothing left running.
        """
        started = time.monotonic()
        before = replace(self._taker.counters)
        try:
            await self._taker.set_level(self._task.zoom, self._task.focus)
            await self._drive()
            result = await self._cpu.run(self._method.result)
        except CalibrationError as error:
            result = LevelResult.failed(self._task.zoom, self._task.focus, str(error))
        finally:
            for pending in self._pending:
                pending.cancel()
            await asyncio.gather(*self._pending, return_exceptions=True)
        now = self._taker.counters
        frames = Frames(now.real - before.real, now.virtual - before.virtual)
        result = replace(result, frames=frames, seconds=time.monotonic() - started)
        real = None
        if self._virtual is not None:
            real = self._real.get((self._virtual.target, self._virtual.pan_deg, self._virtual.tilt_deg))
        elif self._real:
            real = list(self._real.values())[-1]
        return LevelOutcome(result, real, self._virtual, tuple(self._real.values()), self._hashes)

    async def _drive(self) -> None:
        while not self._method.done:
            capture = await self._cpu.run(self._method.ask)
            if capture is None:
                if self._method.done:
                    return
                if not self._pending:
                    raise CalibrationError("the method asks for nothing and is not done")  # a method's mistake
                await self._tell_next()
                continue
            self._report(
                "capture",
                {
                    "step": capture.step,
                    "source": capture.source.value,
                    "target": capture.target,
                    "pan_deg": round(capture.pan_deg, 4),
                    "tilt_deg": round(capture.tilt_deg, 4),
                    "pictures": self._taker.counters.pictures,
                },
            )
            taken = await self._taker.take(capture)
            work = self._cpu.run(observe, taken, self._task, self._transfer, _name(capture))
            self._pending[asyncio.create_task(work)] = taken

    async def _tell_next(self) -> None:
        done, _ = await asyncio.wait(self._pending, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            taken = self._pending.pop(task)
            observation = task.result()
            self._hashes[observation.picture] = taken.sha256
            self._keep(taken, observation)
            await self._cpu.run(self._method.tell, observation)
            self._report_found(observation)

    def _keep(self, taken: Taken, observation: Observation) -> None:
        if not isinstance(observation.result, Detection):
            return
        capture = taken.capture
        seen = SeenPicture(taken.picture, capture.target, observation.result, taken.head.pan_deg, taken.head.tilt_deg)
        if capture.source is Source.VIRTUAL:
            self._virtual = seen
        else:
            self._real[(seen.target, seen.pan_deg, seen.tilt_deg)] = seen

    def _report_found(self, observation: Observation) -> None:
        found = observation.result
        where = {"step": observation.step}
        if isinstance(found, Detection):
            data = {
                "points": len(found.points_px),
                "blur_px": None if math.isnan(found.blur_px) else round(found.blur_px, 3),
            }
            self._report("found", {**where, **data})
            self._report("level_progress", {"progress": round(self._method.progress, 3)})
        else:
            self._report("refused", {**where, "reason": found.reason})


def _name(capture: Capture) -> str:
    where = f"pan {capture.pan_deg:.2f}, tilt {capture.tilt_deg:.2f}"
    return f"{capture.source.value} {capture.step} ({capture.target}, {where})"
