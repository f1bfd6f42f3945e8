"""The composition root: settings and studio profiles to adapters, store and runner. Only here are they put together."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from app.engines import EngineFacts, Engines, PictureFacts, ProfileFacts, Studio
from app.events import EventBroker
from app.jobs.cpu import Cpu
from app.jobs.runner import JobRunner
from app.settings import Settings
from engine_adapters.head.operator import AskOperator, OperatorHead
from engine_adapters.head.simulated import SimulatedHead
from engine_adapters.mockboard.client import MockBoardFrames
from engine_adapters.ports import CameraHead, FrameSource, HeadState
from engine_adapters.profile import StudioProfile, load_profile, profile_sha256, require_available
from engine_adapters.r3.client import R3Engine, R3Snapshots
from storage.repository import Repository

DEFAULT_ENGINE = "default"
DEFAULT_PROFILE = "defaults"
"""Name of the profile of an engine that was given none: every key has its default."""

THREAD_SWITCH_S = 0.001
"""How long a thread of the numerics may hold the interpreter against the event loop. With Python's own 5 ms the loop's
lag had a 99th percentile of 24 ms during a job, with this one of 11."""


@dataclass(frozen=True, slots=True)
class Service:
    """Everything that runs, put together."""

    settings: Settings
    repository: Repository
    engines: Engines
    broker: EventBroker
    runner: JobRunner


def utc_now() -> datetime:
    """The clock of the service."""
    return datetime.now(UTC)


async def _nobody(text: str) -> HeadState | None:
    """No person is at hand to turn the camera."""
    return None


def make_studio(profile: StudioProfile, ask: AskOperator | None = None, *, slow_pictures: bool = False) -> Studio:
    """The adapters that a profile names. ``slow_pictures``: snapshots on the engine's disk, the study's first way.

    Raises :class:`engine_adapters.profile.ProfileError` for what is not available yet.
    """
    require_available(profile)
    head: CameraHead
    if profile.head.kind == "simulated":
        head = SimulatedHead.from_profile(profile)
    else:
        head = OperatorHead(ask or _nobody, answer_timeout_s=profile.head.answer_timeout_s)
    frames: FrameSource = R3Snapshots.from_profile(profile) if slow_pictures else MockBoardFrames.from_profile(profile)
    return Studio(R3Engine.from_profile(profile), frames, head, profile.picture.transfer, engine_facts(profile))


def engine_facts(profile: StudioProfile) -> EngineFacts:
    """What a profile says of how its engine counts."""
    engine, picture = profile.engine, profile.picture
    return EngineFacts(
        image_size=picture.image_size,
        pixel_aspect=picture.pixel_aspect,
        sensor_width_mm=picture.sensor_mm[0],
        radius_unit=engine.radius_unit,
        direction=engine.direction,
        center_shift=engine.center_shift,
        pixel_centres=engine.pixel_centres,
        center_shift_signs=(engine.center_shift_sign_x, engine.center_shift_sign_y),
        fov_axis=engine.fov_axis,
        nodal_sign=engine.nodal_sign,
    )


def add_engine(
    engines: Engines,
    name: str,
    profile: StudioProfile,
    ask: AskOperator | None = None,
    *,
    slow_pictures: bool = False,
    profile_name: str = DEFAULT_PROFILE,
) -> None:
    """Make a profile's engine known under ``name``. ``profile_name``: that of its file, for what a table came from."""
    require_available(profile)
    address = f"r3 {profile.r3.host}:{profile.r3.port}, pictures {profile.mockboard.url}"
    pictures = PictureFacts(profile.picture.image_size, profile.picture.pixel_aspect)
    known = ProfileFacts(profile_name, profile_sha256(profile))
    engines.add(name, address, lambda: make_studio(profile, ask, slow_pictures=slow_pictures), pictures, known)


def load_engines(paths: Sequence[Path]) -> Engines:
    """The engines of these profiles: the first is called ``default``, each further one by its file's name.

    Without a profile, the default engine is one with all defaults, on this host. Raises
    :class:`engine_adapters.profile.ProfileError`.
    """
    engines = Engines()
    if not paths:
        add_engine(engines, DEFAULT_ENGINE, StudioProfile())
    for index, path in enumerate(paths):
        name = DEFAULT_ENGINE if index == 0 else path.stem
        add_engine(engines, name, load_profile(path), profile_name=path.stem)
    return engines


@asynccontextmanager
async def running_service(settings: Settings, engines: Engines) -> AsyncIterator[Service]:
    """Store and runner, open and running; closed on leaving, with every engine restored."""
    settings.database.parent.mkdir(parents=True, exist_ok=True)
    cpu = Cpu(settings.cpu_workers)
    switch_s = sys.getswitchinterval()
    sys.setswitchinterval(THREAD_SWITCH_S)
    try:
        async with await Repository.open(settings.database, utc_now) as repository:
            broker = EventBroker(settings.event_listeners)
            runner = JobRunner(
                repository,
                engines,
                broker,
                cpu,
                utc_now,
                queue_limit=settings.queue_limit,
                retry_after_s=settings.retry_after_s,
            )
            async with runner:
                yield Service(settings, repository, engines, broker, runner)
    finally:
        sys.setswitchinterval(switch_s)
        cpu.close()
