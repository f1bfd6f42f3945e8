"""What the unit tests share: a driver that runs a level's method against lenses in memory, without pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np
import pytest

from calibration.lens import Lens
from calibration.solve.search import LevelMethod, LevelTask, Observation, Source
from calibration.synthetic import observe
from calibration.tables import LevelResult

MOST_CAPTURES = 10_000
"""More than any bounded method asks for: reaching it means that the method does not end."""


class Drive(Protocol):
    """Runs a method to its end; returns its result and how many real and virtual pictures it asked for."""

    def __call__(
        self,
        method: LevelMethod,
        true_lens: Lens,
        task: LevelTask,
        rng: np.random.Generator,
        sigma_real_px: float = 0.02,
        sigma_virtual_px: float = 0.005,
        engine: Callable[[Lens], Lens] = lambda lens: lens,
    ) -> tuple[LevelResult, int, int]: ...


@pytest.fixture(scope="session")
def drive() -> Drive:
    """A camera and an engine in memory: real pictures through ``true_lens``, virtual ones through ``engine(lens)``."""
    return _drive


def _drive(
    method: LevelMethod,
    true_lens: Lens,
    task: LevelTask,
    rng: np.random.Generator,
    sigma_real_px: float = 0.02,
    sigma_virtual_px: float = 0.005,
    engine: Callable[[Lens], Lens] = lambda lens: lens,
) -> tuple[LevelResult, int, int]:
    counts = {Source.REAL: 0, Source.VIRTUAL: 0}
    set_in_engine = Lens.from_fov(true_lens.image_size, 50.0)
    finished: deque[Observation] = deque()
    while not method.done:
        capture = method.ask()
        if capture is None:
            assert finished, "the method waits although everything it asked for was told"
            method.tell(finished.popleft())
            continue
        counts[capture.source] += 1
        assert sum(counts.values()) < MOST_CAPTURES, "the method does not end"
        pose = task.pose(capture.pan_deg, capture.tilt_deg)
        if capture.source is Source.VIRTUAL and capture.lens is not None:
            set_in_engine = capture.lens
        lens, sigma_px = (
            (true_lens, sigma_real_px) if capture.source is Source.REAL else (engine(set_in_engine), sigma_virtual_px)
        )
        result = observe(lens, pose, task.targets[capture.target], rng, sigma_px)
        finished.append(Observation(capture.step, result, pose, f"{capture.source}-{capture.step}"))
    return method.result(), counts[Source.REAL], counts[Source.VIRTUAL]
