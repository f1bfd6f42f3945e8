"""Typed events there and back, and the broker: nothing lost, nobody held up, nothing kept."""

from __future__ import annotations

import asyncio
import math
import random
from datetime import UTC, datetime
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from app import events
from app.errors import TooManyListeners
from calibration.lens import Lens
from calibration.solve.engine_fit import LearnedEngine
from calibration.solve.engine_model import EngineModel
from calibration.surface.recheck import LevelAgreement, Recheck, Remount, Verdict
from calibration.tables import Frames, LevelResult, PixelError
from storage.records import EventRecord

KINDS = get_args(get_args(events.AnyEvent)[0])
AT = datetime(2026, 11, 21, 10, tzinfo=UTC)
PLACE: dict[str, Any] = {"ordinal": 2, "zoom": 0.5, "focus": 1.0}
RESULT = LevelResult.from_lens(
    0.5,
    1.0,
    Lens.from_fov((1920, 1080), 56.0, k1=-0.12, k2=0.03, center_shift_px=(4.0, -2.5)),
    reasons={"nodal_offset_mm": "a hand-held board tells none", "held_out_px": "too few pictures"},
    residual_px=PixelError(0.02, 0.06),
    predicted_overlay_px=PixelError(0.01, 0.03),
    engine_overlay_px=PixelError(0.02, 0.05),
    frames=Frames(4, 5),
    seconds=0.6,
)
SAMPLES: list[events.AnyEvent] = [
    events.JobQueued(lens="XA 20x", camera="Cam0", engine="default", method="joint", levels=13),
    events.JobStarted(engine="default", levels=13),
    events.LevelsPlanned(levels=15),
    events.LevelStarted(**PLACE),
    events.CaptureAsked(**PLACE, step=0, source="real", target="board", pan_deg=-3.5, tilt_deg=0.0),
    events.TargetFound(**PLACE, step=0, points=49, blur_px=1.5),
    events.PictureRefused(**PLACE, step=1, reason="no board in the picture"),
    events.LevelProgress(**PLACE, progress=0.5),
    events.LevelDone.of(2, RESULT),
    events.LevelFailed(**PLACE, reason="the picture did not change"),
    events.EngineLearned.of(
        "default", LearnedEngine(EngineModel(), True, 0.004, math.inf, 0.02, 8), ("engine.direction says a, not b",)
    ),
    events.PlaceChecked(
        **PLACE,
        values=(events.ValueData(name="lens.k1", asked="-0.12", got="-0.12", same=True),),
        compared=True,
        renders=3,
        render_px=events.PixelErrorData(rms=0.02, max=0.06),
        limit_px=0.15,
        ok=True,
    ),
    events.Published(engine="default", table_id=3, zoom=0.5, focus=1.0, kept=True, compared=True, places=1),
    events.Rechecked.of(
        "default",
        3,
        Recheck(
            Verdict.CORRECTED,
            1.0,
            4.1,
            0.1,
            (LevelAgreement(0.5, 1.0, 4.1, 0.2, 0.1),),
            Remount((4.0, -1.0), (0.1, 0.1)),
            "a remount explains it",
        ),
        None,
    ),
    events.EngineRestored(engine="default"),
    events.EngineDirty(engine="default", reason="the engine is gone"),
    events.JobDone(table_id=7),
    events.JobFailed(reason="the engine is gone"),
    events.JobCancelling(),
    events.JobCancelled(),
    events.Note(text="a light was switched on"),
]


def record(event: events.AnyEvent, seq: int = 3) -> EventRecord:
    kind, data = events.draft(event)
    return EventRecord(number=9, job_id="a-job", seq=seq, at=AT, kind=kind, data=data)


def test_each_kind_has_a_sample() -> None:
    assert {type(sample) for sample in SAMPLES} == set(KINDS)


@pytest.mark.parametrize("event", SAMPLES, ids=lambda event: event.kind)
def test_events_come_back_as_they_were(event: events.AnyEvent) -> None:
    assert events.parse(record(event)) == event


@pytest.mark.parametrize("event", SAMPLES, ids=lambda event: event.kind)
def test_a_message_is_flat_and_has_its_envelope(event: events.AnyEvent) -> None:
    sent = events.message(record(event))
    assert (sent["seq"], sent["number"], sent["job_id"], sent["kind"]) == (3, 9, "a-job", event.kind)
    assert sent["at"] == "2026-11-21T10:00:00Z"
    assert list(sent)[:5] == ["seq", "at", "kind", "job_id", "number"]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_no_field_hides_the_envelope(kind: type[events.Event]) -> None:
    assert set(kind.model_fields) & set(events.EventMessage.model_fields) == {"kind"}


def test_level_done_tells_the_level() -> None:
    done = events.LevelDone.of(2, RESULT)
    assert (done.k1, done.center_shift_px, done.nodal_offset_mm) == (-0.12, (4.0, -2.5), None)
    assert done.predicted_overlay_px == events.PixelErrorData(rms=0.01, max=0.03)
    assert (done.frames.real, done.frames.virtual, done.held_out_px) == (4, 5, None)


def test_level_done_refuses_a_failed_level() -> None:
    with pytest.raises(ValidationError):
        events.LevelDone.of(0, LevelResult.failed(0.0, 0.0, "nothing found"))


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("job_exploded", {}),
        ("level_progress", {**PLACE, "progress": 1.5}),
        ("level_progress", {**PLACE, "progress": float("nan")}),
        ("refused", {**PLACE, "step": 0, "reason": ""}),
        ("capture", {**PLACE, "step": 0, "source": "painted", "target": "board", "pan_deg": 0, "tilt_deg": 0}),
        ("job_done", {}),
    ],
)
def test_a_wrong_event_is_refused(kind: str, data: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        events.make(kind, **data)


def test_events_of_a_newer_version_pass_through_to_clients() -> None:
    newer = EventRecord(1, "a-job", 1, AT, "lens_polished", {"cloth": "soft"})
    assert events.message(newer)["cloth"] == "soft"
    imitating = EventRecord(1, "a-job", 1, AT, "lens_polished", {"seq": 99, "job_id": "another"})
    assert (events.message(imitating)["seq"], events.message(imitating)["job_id"]) == (1, "a-job")
    with pytest.raises(ValidationError):
        events.parse(newer)


async def test_a_notification_before_the_wait_is_not_lost() -> None:
    broker = events.EventBroker()
    with broker.listen("a") as wakeups:
        wakeups.clear()
        broker.notify("a")
        assert await wakeups.wait(0.0) or await wakeups.wait(1.0)


async def test_only_the_jobs_own_listeners_and_those_of_all_wake() -> None:
    broker = events.EventBroker()
    with broker.listen("a") as of_a, broker.listen("b") as of_b, broker.listen(None) as of_all:
        broker.notify("a")
        assert await of_a.wait(1.0)
        assert await of_all.wait(1.0)
        assert not await of_b.wait(0.01)


async def test_nothing_is_kept_when_listeners_leave() -> None:
    broker = events.EventBroker()
    for job in ("a", "b", None):
        with broker.listen(job):
            assert broker.listeners == 1
    assert broker.listeners == 0
    assert broker._listeners == {}


async def test_listeners_are_bounded() -> None:
    broker = events.EventBroker(limit=2)
    with (
        broker.listen("a"),
        broker.listen("a"),
        pytest.raises(TooManyListeners, match="2 event sockets"),
        broker.listen("b"),
    ):
        pass
    with broker.listen("b"):
        assert broker.listeners == 1


@given(seed=st.integers(0, 2**32), writers=st.integers(1, 4), readers=st.integers(1, 4))
def test_any_interleaving_gives_each_reader_everything_once(seed: int, writers: int, readers: int) -> None:
    """Writers append and notify, readers follow clear, read, wait: in whatever order the loop runs them."""
    rng = random.Random(seed)

    async def scenario() -> None:
        broker, ledger, total = events.EventBroker(), list[int](), writers * 10

        async def pause() -> None:
            for _ in range(rng.randrange(4)):
                await asyncio.sleep(0)

        async def write() -> None:
            for _ in range(10):
                await pause()
                ledger.append(len(ledger))
                await pause()
                broker.notify("job")

        async def read() -> list[int]:
            seen: list[int] = []
            with broker.listen("job") as wakeups:
                while len(seen) < total:
                    wakeups.clear()
                    await pause()
                    new = ledger[len(seen) :]
                    await pause()
                    seen += new
                    if len(seen) < total:
                        assert await wakeups.wait(5.0), "a wake-up was lost"
            return seen

        reading = [asyncio.create_task(read()) for _ in range(readers)]
        await asyncio.gather(*(write() for _ in range(writers)))
        for seen in await asyncio.gather(*reading):
            assert seen == list(range(total))

    asyncio.run(scenario())
