"""The lease: what an engine is left with however a job ends."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from app.engines import Engines, Lease, Studio
from engine_adapters.errors import Unreachable
from engine_adapters.ports import EngineState

FOUND = (("lens.k1", "0"), ("background.visible", "1"))
KEPT = (("lens.k1", "-0.12"), ("background.visible", "1"))


@dataclass
class MemoryEngine:
    """Exports in memory. ``failures``: how many of the next restores fail; ``hold``: restores wait for it."""

    values: dict[str, str] = field(default_factory=lambda: dict(FOUND))
    failures: int = 0
    hold: asyncio.Event | None = None
    begun: asyncio.Event = field(default_factory=asyncio.Event)
    restored: list[tuple[tuple[str, str], ...]] = field(default_factory=list)

    async def read_state(self) -> EngineState:
        return EngineState(tuple(self.values.items()))

    async def restore(self, state: EngineState) -> None:
        if self.failures:
            self.failures -= 1
            raise Unreachable("the engine is gone")
        if self.hold is not None:
            self.begun.set()
            await self.hold.wait()
        self.restored.append(state.exports)
        self.values |= dict(state.exports)

    async def close(self) -> None:
        pass


def engines_with(engine: MemoryEngine) -> Engines:
    engines = Engines()
    port = cast(Any, engine)
    engines.add("default", "in memory", lambda: Studio(port, port, port))
    return engines


async def work(engines: Engines, engine: MemoryEngine) -> Lease:
    """A job that sets and hides something, and keeps what it set."""
    async with engines.lease("default", "a job") as lease:
        engine.values |= {"lens.k1": "-0.12", "background.visible": "0"}
        lease.keep([("lens.k1", "-0.12")])
    return lease


async def test_kept_values_stay_and_all_others_go_back() -> None:
    engine = MemoryEngine()
    lease = await work(engines_with(engine), engine)
    assert lease.restored
    assert tuple(engine.values.items()) == KEPT


async def test_a_restore_that_fails_once_is_done_again_with_the_kept_values() -> None:
    engine = MemoryEngine(failures=1)
    lease = await work(engines_with(engine), engine)
    assert (lease.restored, lease.problem) == (True, None)
    assert tuple(engine.values.items()) == KEPT


async def test_an_engine_that_is_gone_gets_the_kept_values_from_the_next_lease() -> None:
    engine = MemoryEngine(failures=2)
    engines = engines_with(engine)
    lease = await work(engines, engine)
    assert not lease.restored
    (info,) = engines.infos()
    assert info.dirty is not None
    assert info.found == KEPT
    async with engines.lease("default", "the next job") as following:
        assert following.found.exports == KEPT
    assert engines.infos()[0].dirty is None


async def test_a_job_cancelled_while_its_end_is_written_keeps_nothing() -> None:
    engine = MemoryEngine(hold=asyncio.Event())
    engines = engines_with(engine)
    job = asyncio.create_task(work(engines, engine))
    await engine.begun.wait()
    job.cancel()
    await asyncio.sleep(0)
    assert engine.hold is not None
    engine.hold.set()
    with pytest.raises(asyncio.CancelledError):
        await job
    assert engine.restored[-1] == FOUND
    assert tuple(engine.values.items()) == FOUND
    assert engines.infos()[0].dirty is None
