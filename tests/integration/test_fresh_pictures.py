"""Two traps of a running job: a picture that still shows the old value, and numerics on the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import random
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from app.engines import Studio
from app.jobs import taking
from app.jobs.cpu import Cpu
from app.jobs.freshness import OutputDoesNotFollow
from app.jobs.level import LevelRun
from app.jobs.taking import PictureTaker
from calibration.image import Transfer
from calibration.solve.search import Capture, LevelTask, Observation, Source
from calibration.tables import LevelResult
from calibration.types import Target, TargetKind, TargetPose
from engine_adapters.ports import EncodedFrame, EngineState, HeadState, LensValues, ReadBack, Shown, TrackedCamera

SIZE = (128, 72)
PICTURE_S = 0.002
OUTSIDE_DEG = 12


class DelayedStudio:
    """All three ports in one: an output that shows each change ``delay_s`` late, and says in the picture what it shows.

    The level of the upper half is the pan angle, that of the lower half tells whether background and object are on.
    """

    def __init__(self, delay_s: float) -> None:
        self.delay_s = delay_s
        self.frozen = False
        self._head = HeadState(0.0, 0.0, 0.0, 0.0, 0.0)
        self._shown = Shown.NOTHING
        self._history = [(0.0, self._level())]

    def _level(self) -> tuple[int, int]:
        return 100 + 8 * round(self._head.pan_deg), 60 * list(Shown).index(self._shown)

    def _changed(self) -> None:
        if not self.frozen:
            self._history.append((time.monotonic(), self._level()))

    async def move_to(self, *, pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> HeadState:
        self._head = HeadState(pan_deg, tilt_deg, roll_deg, 0.0, 0.0)
        self._changed()
        return self._head

    async def set_lens(self, *, zoom: float, focus: float) -> HeadState:
        return self._head

    async def read(self) -> HeadState:
        return self._head

    async def show(self, shown: Shown) -> None:
        self._shown = shown
        self._changed()

    async def apply(self, values: LensValues) -> None:
        pass

    async def read_lens(self) -> LensValues:
        return LensValues(50.0)

    async def read_back(self, values: LensValues) -> tuple[ReadBack, ...]:
        raise AssertionError("taking a picture must not read values back")

    async def read_state(self) -> EngineState:
        return EngineState(())

    async def restore(self, state: EngineState) -> None:
        pass

    async def tracking(self) -> TrackedCamera:
        raise AssertionError("taking a picture must not ask for tracking")

    async def fetch(self) -> EncodedFrame:
        asked_s = time.monotonic()
        visible = [level for since_s, level in self._history if since_s <= asked_s - self.delay_s]
        pan, shown = visible[-1] if visible else self._history[0][1]
        picture = np.full((SIZE[1], SIZE[0], 3), pan, np.uint8)
        picture[SIZE[1] // 2 :] = shown
        await asyncio.sleep(PICTURE_S)
        return EncodedFrame(cv2.imencode(".png", picture)[1].tobytes(), asked_s, time.monotonic(), "the test's output")

    async def close(self) -> None:
        pass

    def shows(self, taken: taking.Taken) -> bool:
        """Whether the picture is of what was asked for."""
        pan, shown = int(taken.picture[0, 0, 0]), int(taken.picture[-1, 0, 0])
        source = Shown.REAL if taken.capture.source is Source.REAL else Shown.VIRTUAL
        return (pan, shown) == (100 + 8 * round(taken.capture.pan_deg), 60 * list(Shown).index(source))


class NotingMethod:
    """Asks for three pictures, and notes in which threads it works."""

    def __init__(self) -> None:
        self.threads: set[str] = set()
        self._left = list(captures(3))
        self._waiting = 0

    def _note(self) -> None:
        self.threads.add(threading.current_thread().name)

    @property
    def done(self) -> bool:
        return not self._left and not self._waiting

    @property
    def progress(self) -> float:
        return 0.0

    def ask(self) -> Capture | None:
        self._note()
        if not self._left:
            return None
        self._waiting += 1
        return self._left.pop(0)

    def tell(self, observation: Observation) -> None:
        self._note()
        self._waiting -= 1

    def result(self) -> LevelResult:
        self._note()
        return LevelResult.failed(0.5, 0.5, "nothing was solved")


@contextlib.contextmanager
def using(studio: DelayedStudio) -> Iterator[tuple[PictureTaker, Cpu]]:
    cpu = Cpu(2)
    try:
        yield PictureTaker(Studio(studio, studio, studio), SIZE, cpu), cpu
    finally:
        cpu.close()


def captures(count: int) -> Iterator[Capture]:
    rng = random.Random(20261122)
    pan_deg = 0
    for step in range(count):
        pan_deg = rng.choice([pan for pan in range(-OUTSIDE_DEG, OUTSIDE_DEG + 1, 2) if pan != pan_deg])
        yield Capture(step, rng.choice(list(Source)), "board", float(pan_deg), 0.0)


@pytest.mark.parametrize("delay_s", [0.0, 0.004, 0.02])
async def test_trap_2_no_picture_is_taken_that_shows_the_value_before(delay_s: float) -> None:
    studio = DelayedStudio(delay_s)
    with using(studio) as (taker, _):
        await taker.measure_delay()
        assert taker.delay.delay_s >= delay_s - PICTURE_S
        for capture in captures(60):
            taken = await taker.take(capture)
            assert not taken.frozen
            assert studio.shows(taken), capture


async def test_trap_2_an_output_that_grows_slower_is_noticed_and_waited_for() -> None:
    studio = DelayedStudio(0.004)
    with using(studio) as (taker, _):
        await taker.measure_delay()
        measured_s = taker.delay.delay_s
        studio.delay_s = measured_s + 0.02
        await asyncio.sleep(studio.delay_s)  # an output that grows slower repeats pictures, it does not go back
        for capture in captures(20):
            taken = await taker.take(capture)
            assert taken.frozen or studio.shows(taken), capture
        assert taker.delay.delay_s > measured_s
        assert not taken.frozen


async def test_trap_2_an_output_that_stands_still_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    studio = DelayedStudio(0.0)
    with using(studio) as (taker, _):
        await taker.measure_delay()
        studio.frozen = True
        first, second = captures(2)
        assert (await taker.take(first)).frozen
        assert (await taker.take(second)).frozen
        monkeypatch.setattr(taking, "_DELAY_BOUND_S", 0.3)
        with pytest.raises(OutputDoesNotFollow, match="did not follow within"):
            await taker.measure_delay()


async def test_trap_6_pictures_are_decoded_and_searched_and_levels_solved_off_the_event_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    threads: dict[str, set[str]] = {}

    def noted(name: str) -> None:
        plain: Callable[..., Any] = getattr(taking, name)

        def work(*given: Any, **named: Any) -> Any:
            threads.setdefault(name, set()).add(threading.current_thread().name)
            return plain(*given, **named)

        monkeypatch.setattr(taking, name, work)

    for name in ("decode_picture", "thumbnail", "find_target"):
        noted(name)
    method = NotingMethod()
    board = Target(TargetKind.CHESSBOARD, (5, 4), 0.1, colours=("black", "white"), pose=TargetPose((0.0, 5.0, 1.6)))
    task = LevelTask(0.5, 0.5, SIZE, {"board": board}, (0.0, 0.0, 1.6))
    told: list[str] = []
    studio = DelayedStudio(0.0)
    with using(studio) as (taker, cpu):
        await taker.measure_delay()
        run = LevelRun(method, task, taker, cpu, Transfer.BT709, lambda kind, data: told.append(kind))
        outcome = await run.run()
    assert outcome.result.reason == "nothing was solved"
    assert told.count("refused") == 3
    assert threads.keys() == {"decode_picture", "thumbnail", "find_target"}
    everywhere = method.threads.union(*threads.values())
    assert all(name.startswith("lensmatch-cpu") for name in everywhere), everywhere
