"""Publishing a lens table to the simulated engine, over its real sockets: it holds and draws the lens, or nothing is
changed."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.cli.simulated import studio_job, studio_profile, true_lens
from app.engines import EngineError
from app.events import Published
from app.job_documents import PublishRequest
from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, EngineValues, LensTable, LevelResult
from engine_adapters.ports import LensValues
from engine_adapters.r3.client import R3Engine
from storage.errors import NotFound
from storage.records import EventRecord, JobState
from storage.schemas import table_to_document
from tests.integration.test_jobs import ENOUGH_TIME_S, LENS, Bench, bench

HERE = (0.5, 0.25)
LEVELS = [(1 / 6, 0.25), HERE, (5 / 6, 0.25)]
UNTOLD = dict.fromkeys(EVIDENCE_QUANTITIES, "made from the truth")

pytestmark = [pytest.mark.timeout(ENOUGH_TIME_S)]


def table(*changed: LevelResult) -> LensTable:
    """The true lens as a table, some levels another."""
    levels = {place: LevelResult.from_lens(*place, true_lens(LENS, *place), reasons=UNTOLD) for place in LEVELS}
    levels |= {(level.zoom, level.focus): level for level in changed}
    created = datetime(2026, 11, 21, 10, tzinfo=UTC)
    return LensTable(LENS.name, "Cam0", 1, created, LENS.image_size, "truth", tuple(levels.values()), LENS.sensor_mm)


class PublishBench(Bench):
    """A service beside a studio, with what publishing needs."""

    def request(self, lens_table: LensTable | None = None, *, room: bool = True, **changes: Any) -> PublishRequest:
        job = studio_job(self.addresses, LENS, [HERE])
        document: dict[str, Any] = {"kind": "publish", "zoom": HERE[0], "focus": HERE[1]}
        if "table_id" not in changes:
            document["table"] = table_to_document(lens_table or table())
        if room:
            dumped = job.model_dump(mode="json")
            document |= {"targets": dumped["targets"], "pivot_m": dumped["pivot_m"]}
        return PublishRequest.model_validate(document | changes)

    async def publish(self, request: PublishRequest) -> tuple[EventRecord, list[EventRecord], Published]:
        """The last event, all events and the result of a publication."""
        record = await self.service.runner.submit(request)
        last = await self.ended(record.id)
        events = list(await self.service.repository.events_after(record.id, 0))
        (published,) = [event for event in events if event.kind == "published"]
        return last, events, Published.model_validate(dict(published.data))

    def engine(self) -> R3Engine:
        return R3Engine.from_profile(studio_profile(self.addresses, LENS))

    async def lens(self) -> LensValues:
        engine = self.engine()
        try:
            return await engine.read_lens()
        finally:
            await engine.close()


@contextlib.asynccontextmanager
async def publishing(folder: Path, *options: str) -> AsyncIterator[PublishBench]:
    async with bench(folder / "jobs.db", *options) as b:
        yield PublishBench(b.service, b.addresses)


def flat(lens: Lens | LensValues) -> list[float]:
    return [lens.fov_x_deg, lens.k1, lens.k2, *lens.center_shift_px, lens.nodal_offset_mm]


async def test_a_published_lens_stays_and_everything_else_is_as_found(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        found = dict(await b.engine_values())
        last, events, result = await b.publish(b.request())
        assert last.kind == "job_done", last.data
        assert last.data["table_id"] is None
        assert (result.kept, result.compared, result.places, result.reason) == (True, True, 1, None)
        assert result.render_px is not None
        assert result.render_px.max < 0.15
        assert flat(await b.lens()) == pytest.approx(flat(true_lens(LENS, *HERE)), rel=1e-9)
        now = dict(await b.engine_values())
        assert {name for name in now if now[name] != found[name]} == {value.name for value in result.values}
        assert [value.got for value in result.values] == [now[value.name] for value in result.values]
        kinds = [event.kind for event in events]
        assert kinds.index("place_checked") < kinds.index("engine_restored") < kinds.index("published")
        (checked,) = [event.data for event in events if event.kind == "place_checked"]
        assert checked["renders"] == 3
        (queued,) = [event.data for event in events if event.kind == "job_queued"]
        assert (queued["job"], queued["method"], queued["levels"]) == ("publish", None, 1)


async def test_the_place_is_where_the_head_stands_and_the_head_goes_back(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        head_url = b.addresses["head"]["url"] + "/head"
        async with httpx.AsyncClient(trust_env=False) as client:
            stands = {"pan_deg": 3.0, "tilt_deg": -1.0, "zoom": LEVELS[2][0], "focus": LEVELS[2][1]}
            (await client.post(head_url, json=stands)).raise_for_status()
            last, _, result = await b.publish(b.request(zoom=None, focus=None))
            assert last.kind == "job_done", last.data
            assert (result.zoom, result.focus) == LEVELS[2]
            assert stands.items() <= (await client.get(head_url)).json().items()
        assert flat(await b.lens()) == pytest.approx(flat(true_lens(LENS, *LEVELS[2])), rel=1e-9)


async def test_every_level_is_checked_and_the_place_stays(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        failed = LevelResult.failed(1.0, 0.25, "the board was hidden")
        last, events, result = await b.publish(b.request(table(failed), all_levels=True))
        assert last.kind == "job_done", last.data
        places = [(e.data["zoom"], e.data["focus"]) for e in events if e.kind == "place_checked"]
        assert places == [LEVELS[0], LEVELS[2], HERE]
        assert (result.places, result.kept) == (3, True)
        assert flat(await b.lens()) == pytest.approx(flat(true_lens(LENS, *HERE)), rel=1e-9)
        assert "1 of 4 levels have no lens" in next(e.data["text"] for e in events if e.kind == "note")


async def test_a_table_of_a_job_is_compared_by_that_jobs_targets(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        repository = b.service.repository
        job = b.job(HERE)
        made = await repository.create_job(job.model_dump(mode="json", exclude={"kind"}), job.lens, job.engine)
        await repository.set_job_state(made.id, JobState.CANCELLED, expected=[JobState.QUEUED])
        stored = await repository.save_table(made.id, table())
        last, _, result = await b.publish(b.request(room=False, table_id=stored.id))
        assert last.kind == "job_done", last.data
        assert (result.kept, result.compared, result.table_id) == (True, True, stored.id)
        imported = await repository.save_table(None, table())
        last, events, result = await b.publish(b.request(room=False, table_id=imported.id))
        assert last.kind == "job_done", last.data
        assert (result.kept, result.compared, result.render_px) == (True, False, None)
        assert "no render was compared" in (result.reason or "")
        # Without a picture to take, nothing on the output is switched.
        assert not any(event.kind == "capture" for event in events)
        with pytest.raises(NotFound):
            await b.service.runner.submit(b.request(room=False, table_id=99))


@pytest.mark.slow
async def test_what_a_job_measured_on_an_engine_of_another_kind_is_published_to_it(tmp_path: Path) -> None:
    async with publishing(tmp_path, "--engine", "radius_unit=half_width") as b:
        found = dict(await b.engine_values())
        made = await b.service.runner.submit(b.job(HERE))
        assert (await b.ended(made.id)).kind == "job_done"
        assert dict(await b.engine_values()) == found
        stored = await b.service.repository.table_of_job(made.id)
        assert stored is not None
        (level,) = (await b.service.repository.get_table(stored.id)).table.levels
        assert level.engine_values is not None
        last, _, result = await b.publish(b.request(room=False, table_id=stored.id))
        assert last.kind == "job_done", last.data
        assert (result.kept, result.compared) == (True, True)
        assert result.render_px is not None
        assert result.render_px.max < 0.2
        assert (await b.lens()).k1 == pytest.approx(level.engine_values.k1, rel=1e-9)
        assert level.k1 != pytest.approx(level.engine_values.k1, rel=0.1)


@pytest.mark.parametrize("room", [True, False])
async def test_a_value_that_the_engine_clips_is_named_and_nothing_stays(tmp_path: Path, room: bool) -> None:
    async with publishing(tmp_path, "--fault", "r3:clip=0.01@*") as b:
        found = await b.engine_values()
        last, _, result = await b.publish(b.request(room=room))
        assert last.kind == "job_failed"
        asked = true_lens(LENS, *HERE).k1
        assert abs(asked) > 0.01
        assert f"lens.k1 was set to {asked:.5g}"[:-1] in last.data["reason"]
        assert f"reads {0.01 if asked > 0 else -0.01}" in last.data["reason"]
        assert not result.kept
        assert await b.engine_values() == found


@pytest.mark.slow
async def test_an_engine_that_counts_otherwise_is_seen_in_its_render(tmp_path: Path) -> None:
    async with publishing(tmp_path, "--engine", "radius_unit=half_width") as b:
        found = await b.engine_values()
        last, events, result = await b.publish(b.request())
        assert last.kind == "job_failed"
        assert "px off" in last.data["reason"] or "not found" in last.data["reason"]
        assert not result.kept
        assert await b.engine_values() == found
        (checked,) = [event.data for event in events if event.kind == "place_checked"]
        assert all(value["same"] for value in checked["values"])
        assert not checked["ok"]
        # Learned, the same engine is told what its own camera needs.
        last, events, result = await b.publish(b.request(learn_engine=True))
        assert last.kind == "job_done", last.data
        assert result.kept
        assert result.render_px is not None
        assert result.render_px.max < 0.15
        assert "engine_learned" in [event.kind for event in events]
        assert flat(await b.lens()) != pytest.approx(flat(true_lens(LENS, *HERE)), rel=1e-3)


@pytest.mark.slow
async def test_a_lens_that_the_engine_cannot_draw_is_told_with_its_pixels(tmp_path: Path) -> None:
    async with publishing(tmp_path, "--engine", "direction=reverse") as b:
        found = await b.engine_values()
        wide = LevelResult.from_lens(0.0, 0.25, true_lens(LENS, 0.0, 0.25), reasons=UNTOLD)
        place = {"zoom": 0.0, "focus": 0.25, "learn_engine": True}
        last, _, result = await b.publish(b.request(table(wide), limit_px=0.02, **place))
        assert last.kind == "job_failed"
        assert "the engine cannot draw this lens nearer than 0." in last.data["reason"]
        assert not result.kept
        assert await b.engine_values() == found
        last, _, result = await b.publish(b.request(table(wide), limit_px=1.0, **place))
        assert last.kind == "job_done", last.data
        assert result.render_px is not None
        assert 0.02 < result.render_px.max < 1.0


async def test_a_levels_engine_values_are_what_the_engine_is_told(tmp_path: Path) -> None:
    async with publishing(tmp_path, "--engine", "overscan=1.1") as b:
        lens = true_lens(LENS, *HERE)
        asked = replace(lens, f_px=lens.f_px * 1.1).with_hw(lens.f_px * 1.1, lens.k1_hw, lens.k2_hw)
        level = LevelResult.from_lens(*HERE, lens, reasons=UNTOLD, engine_values=EngineValues.of(asked))
        last, _, result = await b.publish(b.request(table(level)))
        assert last.kind == "job_done", last.data
        assert result.render_px is not None
        assert result.render_px.max < 0.15
        assert flat(await b.lens()) == pytest.approx(flat(asked), rel=1e-9)


async def test_a_cancelled_publication_leaves_the_engine_as_it_was(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        found = await b.engine_values()
        record = await b.service.runner.submit(b.request(all_levels=True))
        await b.until(record.id, "place_checked")
        await b.service.runner.cancel(record.id)
        assert (await b.ended(record.id)).kind == "job_cancelled"
        assert await b.engine_values() == found
        assert (await b.service.repository.get_job(record.id)).reason == "cancelled; nothing was published"


async def test_a_target_that_is_not_there_publishes_nothing(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        found = await b.engine_values()
        request = b.request()
        board = request.targets["board_large"]
        assert board.pose is not None
        elsewhere = board.model_copy(update={"pose": board.pose.model_copy(update={"centre_m": (9.0, 9.0, 1.6)})})
        last, _, result = await b.publish(request.model_copy(update={"targets": {"board": elsewhere}}))
        assert last.kind == "job_failed"
        assert "not found" in last.data["reason"] or "px off" in last.data["reason"]
        assert not result.kept
        assert await b.engine_values() == found


async def test_between_levels_the_surface_is_published_and_its_render_agrees(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        last, _, result = await b.publish(b.request(zoom=0.45))
        assert last.kind == "job_done", last.data
        assert result.kept
        assert result.render_px is not None
        assert result.render_px.max < 0.15


async def test_a_place_outside_the_levels_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        last, events, _ = await b.publish(b.request(focus=1.0))
        assert last.kind == "job_failed"
        assert "outside the table's levels" in last.data["reason"]
        assert "level_started" not in [event.kind for event in events]


@pytest.mark.parametrize("frames", ["0", "5"])
async def test_no_delay_of_the_output_shows_a_stale_render(tmp_path: Path, frames: str) -> None:
    async with publishing(tmp_path, "--delay-frames", frames) as b:
        last, _, result = await b.publish(b.request(all_levels=True))
        assert last.kind == "job_done", last.data
        assert result.render_px is not None
        assert result.render_px.max < 0.15


@pytest.mark.parametrize(
    "fault", ["r3:disconnect@12", "r3:garbage@20", "mockboard:stale@20..22", "mockboard:garbage@21"]
)
async def test_a_passing_fault_costs_nothing_but_time(tmp_path: Path, fault: str) -> None:
    async with publishing(tmp_path, "--fault", fault) as b:
        last, _, result = await b.publish(b.request())
        assert last.kind == "job_done", last.data
        assert result.kept
        assert flat(await b.lens()) == pytest.approx(flat(true_lens(LENS, *HERE)), rel=1e-9)


async def test_a_lease_keeps_what_it_is_told_only_where_all_went_well(tmp_path: Path) -> None:
    async with publishing(tmp_path) as b:
        engines = b.service.engines
        found = await b.engine_values()

        async def kept_in_vain(name: str) -> None:
            async with engines.lease("default", "a test") as lease:
                await lease.studio.engine.apply(LensValues(33.0))
                lease.keep([(name, "33.0")])
                raise RuntimeError

        with pytest.raises(EngineError, match=r"'lens\.k9' was not read"):
            await kept_in_vain("lens.k9")
        with pytest.raises(RuntimeError):
            await kept_in_vain("lens.fov_x")
        assert await b.engine_values() == found
        async with engines.lease("default", "a test") as lease:
            await lease.studio.engine.apply(LensValues(33.0, k1=-0.1))
            lease.keep([("lens.fov_x", "33.0")])
        assert dict(await b.engine_values()) == dict(found) | {"lens.fov_x": "33.0"}
