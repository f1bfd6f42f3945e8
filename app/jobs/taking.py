"""Taking one picture: turn the head, set the lens, show the right layer, wait until it is visible, fetch, decode."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from app.engines import Studio
from app.jobs.cpu import Cpu
from app.jobs.freshness import OutputDelay, OutputDoesNotFollow, changed, thumbnail
from calibration.detect.prediction import Prediction
from calibration.detect.target import find_target
from calibration.errors import InvalidInput
from calibration.image import Transfer, decode_picture
from calibration.lens import Lens
from calibration.solve.search import Capture, LevelTask, Observation, Source
from calibration.types import DetectionResult, Picture, Refusal
from engine_adapters.errors import AdapterError, BadPicture
from engine_adapters.ports import EncodedFrame, HeadState, LensValues, ReadBack, Shown
from engine_adapters.retry import Verdict, classify_head, classify_mockboard, classify_r3, retry

T = TypeVar("T")

_SHOWN = {Source.REAL: Shown.REAL, Source.VIRTUAL: Shown.VIRTUAL}
_REFETCHES = 8
# Pictures taken once more because the output had not changed yet; then it is frozen, and that is said.
_DELAY_ROUNDS = 2
_DAMAGED_BOUND = 2
# Damaged pictures in a row of them that are passed over while the delay is measured.
_DELAY_BOUND_S = 3.0
# Longest delay of an output that is believed: a chain of frame stores stays far below.


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """A fresh picture and the pose that the head's encoders told. ``frozen``: it did not change though it had to.
    ``sha256``: of the picture file's bytes as they came."""

    capture: Capture
    picture: Picture
    head: HeadState
    frozen: bool = False
    sha256: str = ""


@dataclass(slots=True)
class Counters:
    """What a job took, for its report: counts have no noise."""

    real: int = 0
    virtual: int = 0
    changes: int = 0
    moves: int = 0
    move_s: float = 0.0
    retries: int = 0

    @property
    def pictures(self) -> int:
        """All pictures of levels; those that measured the delay are not counted."""
        return self.real + self.virtual


class PictureTaker:
    """The I/O of captures on one leased studio. Goals are stated again when a connection fails (at most twice)."""

    def __init__(self, studio: Studio, image_size: tuple[int, int], cpu: Cpu) -> None:
        self._studio = studio
        self._image_size = image_size
        self._cpu = cpu
        self.delay = OutputDelay()
        self.counters = Counters()
        self._head: HeadState | None = None
        self._lens: LensValues | None = None
        self._shown: Shown | None = None
        self._last: NDArray[np.float32] | None = None
        self._must_change = False
        self._sha256 = ""

    async def set_level(self, zoom: float, focus: float) -> None:
        """Drive the camera's lens to a level."""
        before = time.monotonic()
        self._head = await self._again(lambda: self._studio.head.set_lens(zoom=zoom, focus=focus), classify_head)
        self._moved(before)

    async def home(self, state: HeadState) -> None:
        """Turn head and lens back to where they were."""
        await self._studio.head.move_to(pan_deg=state.pan_deg, tilt_deg=state.tilt_deg, roll_deg=state.roll_deg)
        await self._studio.head.set_lens(zoom=state.zoom, focus=state.focus)

    async def read_head(self) -> HeadState:
        """Where head and lens stand."""
        self._head = await self._again(self._studio.head.read, classify_head)
        return self._head

    async def measure_delay(self) -> None:
        """Switch the background off and on and see after how long the output follows.

        Raises :class:`OutputDoesNotFollow` when it does not: then the pictures do not come from this engine.
        """
        await self._show(Shown.REAL)
        base = await self._steady()
        longest = 0.0
        for shown in (Shown.NOTHING, Shown.REAL) * _DELAY_ROUNDS:
            await self._show(shown)
            acknowledged = time.monotonic()
            requested, base = await self._next_change(base, acknowledged, shown)
            longest = max(longest, requested - acknowledged)
        # A request made this long after a change was seen to answer it; one picture more for the clock's grain.
        self.delay.delay_s = longest + self.delay.picture_s
        self._last, self._must_change = base, False

    async def _next_change(
        self, base: NDArray[np.float32], acknowledged_s: float, shown: Shown
    ) -> tuple[float, NDArray[np.float32]]:
        """The first picture that differs from ``base``: when it was asked for, and its thumbnail.

        Each picture is decoded while the next is fetched, so that decoding does not coarsen the clock.
        """
        damaged = 0
        fetching = asyncio.create_task(self._again(self._studio.frames.fetch, classify_mockboard))
        try:
            while True:
                frame = await fetching
                fetching = asyncio.create_task(self._again(self._studio.frames.fetch, classify_mockboard))
                try:
                    seen = await self._cpu.run(thumbnail, await self._decoded(frame))
                except BadPicture:
                    damaged += 1
                    if damaged > _DAMAGED_BOUND:
                        raise
                    continue
                self.delay.picture_s = frame.received_at_s - frame.requested_at_s
                if changed(base, seen):
                    return frame.requested_at_s, seen
                if frame.requested_at_s - acknowledged_s > _DELAY_BOUND_S:
                    raise OutputDoesNotFollow(
                        f"the output did not follow within {_DELAY_BOUND_S:g} s when the background was switched "
                        f"{'off' if shown is Shown.NOTHING else 'on'}: does the MockBoard show this engine's output, "
                        "and are the profile's scene and export names right?"
                    )
        except BaseException:
            fetching.cancel()
            raise
        finally:
            # The one asked for too many ends by itself: cut off, it would cost its connection.
            await asyncio.gather(fetching, return_exceptions=True)

    async def take(self, capture: Capture) -> Taken:
        """One fresh picture of what ``capture`` wants."""
        await self._prepare(capture)
        await self.delay.settle()
        picture = await self._fetch()
        self._count(capture.source)
        seen = await self._cpu.run(thumbnail, picture)
        frozen = False
        measured_s = self.delay.delay_s
        for attempt in range(_REFETCHES + 1):
            frozen = self._must_change and self._last is not None and not changed(self._last, seen)
            if not frozen or attempt == _REFETCHES:
                break
            self.delay.came_too_early()
            picture = await self._fetch()
            self._count(capture.source)
            seen = await self._cpu.run(thumbnail, picture)
        if frozen:
            self.delay.delay_s = measured_s  # waiting longer has not helped: it is not the delay
        self._last, self._must_change = seen, False
        if self._head is None:
            self._head = await self.read_head()
        return Taken(capture, picture, self._head, frozen, self._sha256)

    async def _prepare(self, capture: Capture) -> None:
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._turn(capture.pan_deg, capture.tilt_deg))
                group.create_task(self._set(capture))
        except ExceptionGroup as errors:
            raise errors.exceptions[0] from errors

    async def _turn(self, pan_deg: float, tilt_deg: float) -> None:
        here = self._head
        if here is not None and max(abs(here.pan_deg - pan_deg), abs(here.tilt_deg - tilt_deg)) < 1e-9:
            return
        before = time.monotonic()
        move = self._studio.head.move_to
        self._head = await self._again(lambda: move(pan_deg=pan_deg, tilt_deg=tilt_deg), classify_head)
        self._moved(before)

    def _moved(self, before_s: float) -> None:
        self.counters.moves += 1
        self.counters.move_s += time.monotonic() - before_s
        self.delay.change_made()
        self._must_change = True

    async def apply(self, lens: Lens) -> None:
        """Set the lens in the engine, if it is not the one set last."""
        values = lens_values(lens)
        if values != self._lens:
            await self._again(lambda: self._studio.engine.apply(values), classify_r3)
            self._lens = values
            self.counters.changes += 1
            self.delay.change_made()

    async def read_back(self, lens: Lens) -> tuple[ReadBack, ...]:
        """What the engine holds of a lens that was applied."""
        values = lens_values(lens)
        return await self._again(lambda: self._studio.engine.read_back(values), classify_r3)

    async def _set(self, capture: Capture) -> None:
        if capture.lens is not None:
            await self.apply(capture.lens)
        await self._show(_SHOWN[capture.source])

    async def _show(self, shown: Shown) -> None:
        if shown is self._shown:
            return
        await self._again(lambda: self._studio.engine.show(shown), classify_r3)
        self._shown = shown
        self.counters.changes += 1
        self.delay.change_made()
        self._must_change = True

    async def _steady(self) -> NDArray[np.float32]:
        """A thumbnail once two in a row are alike: what was set before has arrived."""
        before = await self._fetch_small()
        deadline = time.monotonic() + _DELAY_BOUND_S
        calm_since = time.monotonic()
        while time.monotonic() < deadline:
            seen = await self._fetch_small()
            if changed(before, seen):
                calm_since = time.monotonic()
            elif time.monotonic() - calm_since > 0.25:
                return seen
            before = seen
        raise OutputDoesNotFollow("the output keeps changing by itself: is the camera moving, or a video playing?")

    async def _fetch_small(self) -> NDArray[np.float32]:
        return await self._cpu.run(thumbnail, await self._fetch())

    async def _decoded(self, frame: EncodedFrame) -> Picture:
        try:
            return await self._cpu.run(decode_picture, frame.data, expected_size=self._image_size)
        except InvalidInput as error:
            raise BadPicture(str(error), where=frame.source) from error

    async def _fetch(self) -> Picture:
        async def goal() -> Picture:
            frame = await self._studio.frames.fetch()
            picture = await self._decoded(frame)
            self._sha256 = await self._cpu.run(_sha256, frame.data)
            return picture

        return await self._again(goal, classify_mockboard)

    async def _again(self, goal: Callable[[], Awaitable[T]], classify: Callable[[AdapterError], Verdict]) -> T:
        def count(attempt: int, error: AdapterError, verdict: Verdict) -> None:
            self.counters.retries += 1

        return await retry(goal, classify=classify, on_retry=count)

    def _count(self, source: Source) -> None:
        if source is Source.REAL:
            self.counters.real += 1
        else:
            self.counters.virtual += 1


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def lens_values(lens: Lens) -> LensValues:
    """A lens as the engine port takes it."""
    return LensValues(lens.fov_x_deg, lens.k1, lens.k2, lens.center_shift_px, lens.nodal_offset_mm)


def observe(taken: Taken, task: LevelTask, transfer: Transfer, name: str) -> Observation:
    """Find the target in a picture (CPU work). With a prediction that fails, the whole picture is searched."""
    capture, head = taken.capture, taken.head
    pose = replace(task.pose(head.pan_deg, head.tilt_deg), roll_deg=head.roll_deg)
    if taken.frozen:
        reason = "the output still shows the picture from before the change: it is frozen or delayed beyond measure"
        return Observation(capture.step, Refusal(reason), pose, name)
    target = task.targets[capture.target]
    result: DetectionResult = Refusal("")
    if capture.expected_px is not None:
        near = Prediction(capture.expected_px, capture.expected_sigma_px)
        result = find_target(taken.picture, target, transfer=transfer, prediction=near)
    if isinstance(result, Refusal):
        result = find_target(taken.picture, target, transfer=transfer)
    return Observation(capture.step, result, pose, name)
