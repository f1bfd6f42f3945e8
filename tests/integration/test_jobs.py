"""Jobs on the simulated studio, over its real sockets and a real SQLite file."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from app.bootstrap import Service, running_service
from app.cli.simulated import studio_engines, studio_job, studio_profile, true_lens
from app.documents import JobRequest, PlanModel
from app.engines import StudioMismatch, UnknownEngine
from app.errors import QueueFull
from app.events import TERMINAL_KINDS, JobQueued, draft
from app.jobs import calibrating
from app.jobs.provenance import inputs_sha256
from app.lens_at import surface_fit
from app.settings import Settings
from calibration.compare import overlay
from calibration.tables import LevelResult, LevelStatus
from engine_adapters.profile import profile_sha256
from engine_adapters.r3.client import R3Engine
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded, parse_lens
from storage.records import EventRecord, JobState, PictureKind

FULL = load_embedded(embedded_lens_names()[0]).truth()
SMALL_TRUTH = FULL | {
    "image_size": [960, 540],  # a quarter of the pixels: these tests are of jobs, not of exactness
    "levels": [
        level | {"center_shift_px": [shift / 2 for shift in level["center_shift_px"]]} for level in FULL["levels"]
    ],
}
LENS = parse_lens(SMALL_TRUTH)
FAST = ("--picture-time-ms", "4", "--head-speed", "2000", "--payload-format", "jpeg")
SURVEY = {
    "targets": {"board": {"kind": "chessboard", "squares": [8, 8], "square_m": 0.1, "pose": {"centre_m": [0, 5, 1.6]}}},
    "pivot_m": [0.0, 0.0, 1.6],
}
BOUND_S = 60.0
ENOUGH_TIME_S = 90


class Bench:
    """A service beside a running simulated studio."""

    def __init__(self, service: Service, addresses: dict[str, Any]) -> None:
        self.service = service
        self.addresses = addresses

    def job(self, *levels: tuple[float, float], **changes: Any) -> JobRequest:
        request = studio_job(self.addresses, LENS, levels or [(0.5, 0.25)])
        return request.model_copy(update=changes)

    async def until(self, job_id: str, *kinds: str) -> EventRecord:
        """Wait for the first event of one of these kinds."""
        async with asyncio.timeout(BOUND_S):
            with self.service.broker.listen(job_id) as wakeups:
                seen = 0
                while True:
                    wakeups.clear()
                    for event in await self.service.repository.events_after(job_id, seen):
                        seen = event.seq
                        if event.kind in kinds:
                            return event
                        assert event.kind not in TERMINAL_KINDS, f"ended early: {event.kind} {dict(event.data)}"
                    await wakeups.wait(1.0)

    async def ended(self, job_id: str) -> EventRecord:
        return await self.until(job_id, *TERMINAL_KINDS)

    async def engine_values(self) -> tuple[tuple[str, str], ...]:
        engine = R3Engine.from_profile(studio_profile(self.addresses, LENS))
        try:
            return (await engine.read_state()).exports
        finally:
            await engine.close()


def fast_studio(folder: Path, *options: str) -> contextlib.AbstractAsyncContextManager[dict[str, Any]]:
    truth = folder / "truth.json"
    truth.write_text(json.dumps(SMALL_TRUTH))
    return launched_studio(("--lens-file", str(truth), *FAST, *options))


@contextlib.asynccontextmanager
async def bench(database: Path, *options: str, queue_limit: int = 100) -> AsyncIterator[Bench]:
    async with fast_studio(database.parent, *options) as addresses:
        engines = studio_engines(studio_profile(addresses, LENS))
        settings = Settings(database=database, queue_limit=queue_limit)
        async with running_service(settings, engines) as service:
            yield Bench(service, addresses)


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_job_measures_its_levels_and_leaves_the_engine_as_it_was(tmp_path: Path) -> None:
    async with bench(tmp_path / "jobs.db") as b:
        before = await b.engine_values()
        levels = [(1 / 6, 0.75), (1 / 6, 0.25)]
        record = await b.service.runner.submit(b.job(*levels))
        assert (await b.ended(record.id)).kind == "job_done"
        summary = await b.service.repository.table_of_job(record.id)
        assert summary is not None
        table = (await b.service.repository.get_table(summary.id)).table
        assert summary.provenance == table.provenance is not None
        assert (table.provenance.source, table.provenance.job_id) == ("calibrated", record.id)
        assert table.provenance.software.startswith("lensmatch ")
        assert table.provenance.profile == "simulated studio"
        assert table.provenance.profile_sha256 == profile_sha256(studio_profile(b.addresses, LENS))
        assert table.provenance.inputs_sha256 == inputs_sha256(table.levels) is not None
        assert [(level.zoom, level.focus) for level in table.levels] == sorted(levels)
        for level in table.levels:
            assert level.status is LevelStatus.OK
            truth = true_lens(LENS, level.zoom, level.focus)
            assert overlay(truth, level.lens(table.image_size)).max_px < 0.15
            assert level.frames.real + level.frames.virtual <= 16
        for kind in (PictureKind.REAL, PictureKind.VIRTUAL, PictureKind.OVERLAY, PictureKind.RESIDUALS):
            picture = await b.service.repository.get_picture(record.id, 0, kind)
            assert picture.data.startswith(b"\xff\xd8\xff")
        assert await b.engine_values() == before
        events = await b.service.repository.events_after(record.id, 0)
        assert [event.seq for event in events] == list(range(1, len(events) + 1))
        kinds = [event.kind for event in events]
        assert kinds.index("engine_restored") < kinds.index("job_done") == len(kinds) - 1


class GrowingPlan:
    """One level, then another that nobody listed."""

    reason: str | None = None

    def __init__(self) -> None:
        self.left = [[(0.5, 0.25)], [(0.5, 0.75)]]
        self.told: list[LevelResult] = []

    def ask(self) -> list[tuple[float, float]]:
        return self.left.pop(0) if self.left else []

    def tell(self, result: LevelResult) -> None:
        self.told.append(result)


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_plan_may_ask_for_more_levels_than_the_job_lists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = GrowingPlan()
    monkeypatch.setattr(calibrating, "make_plan", lambda *arguments: plan)
    async with bench(tmp_path / "jobs.db") as b:
        record = await b.service.runner.submit(b.job((0.5, 0.25)))
        planned = await b.until(record.id, "levels_planned")
        assert planned.data["levels"] == 2
        assert (await b.ended(record.id)).kind == "job_done"
        levels = await b.service.repository.list_levels(record.id)
        assert [(level.result.zoom, level.result.focus) for level in levels] == [(0.5, 0.25), (0.5, 0.75)]
        assert [(told.zoom, told.focus, told.status) for told in plan.told] == [
            (level.result.zoom, level.result.focus, LevelStatus.OK) for level in levels
        ]


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_cancel_works_at_once_and_restores_the_engine(tmp_path: Path) -> None:
    async with bench(tmp_path / "jobs.db") as b:
        before = await b.engine_values()
        record = await b.service.runner.submit(b.job((0.0, 0.25), (0.5, 0.25), (1.0, 0.25)))
        await b.until(record.id, "level_done")
        await b.service.runner.cancel(record.id)
        assert (await b.ended(record.id)).kind == "job_cancelled"
        assert await b.engine_values() == before
        assert (await b.service.repository.get_job(record.id)).state is JobState.CANCELLED
        assert len(await b.service.repository.list_levels(record.id)) >= 1
        again = await b.service.runner.submit(b.job((0.5, 0.25)))
        assert (await b.ended(again.id)).kind == "job_done"


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_queued_job_is_cancelled_before_it_begins(tmp_path: Path) -> None:
    async with bench(tmp_path / "jobs.db", queue_limit=2) as b:
        first = await b.service.runner.submit(b.job((0.0, 0.25)))
        await b.until(first.id, "job_started")
        second = await b.service.runner.submit(b.job((0.5, 0.25)))
        third = await b.service.runner.submit(b.job((0.5, 0.75)))
        with pytest.raises(QueueFull, match="2 jobs are waiting"):
            await b.service.runner.submit(b.job((1.0, 0.25)))
        assert (await b.service.runner.cancel(second.id)).state is JobState.CANCELLED
        await b.service.runner.cancel(third.id)
        assert (await b.ended(first.id)).kind == "job_done"
        assert (await b.service.repository.get_job(second.id)).state is JobState.CANCELLED


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_level_that_fails_is_kept_with_its_reason_and_the_rest_goes_on(tmp_path: Path) -> None:
    async with bench(tmp_path / "jobs.db") as b:
        # At the tele end the large board does not fit the picture, and it is the only one surveyed.
        job = b.job((0.0, 0.25), (1.0, 0.25))
        only = {"board_large": job.targets["board_large"]}
        record = await b.service.runner.submit(job.model_copy(update={"targets": only}))
        assert (await b.ended(record.id)).kind == "job_done"
        wide, tele = (level.result for level in await b.service.repository.list_levels(record.id))
        assert wide.status is LevelStatus.OK
        assert tele.status is LevelStatus.FAILED
        assert "no target was found" in (tele.reason or "")
        assert (await b.service.repository.get_job(record.id)).reason == f"1 of 2 levels failed: {tele.reason}"


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_stored_job_with_a_target_behind_the_camera_is_one_clear_reason(tmp_path: Path) -> None:
    async with bench(tmp_path / "jobs.db") as b:
        job = b.job((0.5, 0.25))
        board = job.targets["board_large"]
        assert board.pose is not None
        behind = board.model_copy(update={"pose": board.pose.model_copy(update={"centre_m": (0.0, -5.0, 1.6)})})
        record = await b.service.runner.submit(job.model_copy(update={"targets": {"board_large": behind}}))
        ended = await b.ended(record.id)
        assert ended.kind == "job_failed"
        assert "the stored job is refused: targets.board_large turns its back to the camera" in ended.data["reason"]


@pytest.mark.timeout(ENOUGH_TIME_S)
@pytest.mark.parametrize(
    "fault",
    ["mockboard:stale@40..42", "mockboard:garbage@41", "mockboard:status=500@41", "r3:disconnect@30", "r3:garbage@33"],
)
async def test_a_passing_fault_costs_nothing_but_time(tmp_path: Path, fault: str) -> None:
    async with bench(tmp_path / "jobs.db", "--fault", fault) as b:
        record = await b.service.runner.submit(b.job((1 / 3, 0.25)))
        assert (await b.ended(record.id)).kind == "job_done"
        (level,) = await b.service.repository.list_levels(record.id)
        truth = true_lens(LENS, level.result.zoom, level.result.focus)
        assert overlay(truth, level.result.lens(LENS.image_size)).max_px < 0.15


@pytest.mark.timeout(ENOUGH_TIME_S)
@pytest.mark.parametrize("frames", ["0", "1", "5"])
async def test_no_delay_of_the_output_leads_to_a_stale_picture(tmp_path: Path, frames: str) -> None:
    async with bench(tmp_path / "jobs.db", "--delay-frames", frames) as b:
        record = await b.service.runner.submit(b.job((1 / 3, 0.25)))
        assert (await b.ended(record.id)).kind == "job_done"
        (level,) = await b.service.repository.list_levels(record.id)
        assert not level.result.left_out
        truth = true_lens(LENS, level.result.zoom, level.result.focus)
        assert overlay(truth, level.result.lens(LENS.image_size)).max_px < 0.15


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_an_engine_that_is_not_there_fails_the_job_with_its_address(tmp_path: Path) -> None:
    async with bench(tmp_path / "jobs.db") as b:
        addresses = {**b.addresses, "r3": {"host": "127.0.0.1", "port": 1}}
        engines = studio_engines(studio_profile(addresses, LENS))
        async with running_service(Settings(database=tmp_path / "other.db"), engines) as service:
            other = Bench(service, b.addresses)
            record = await service.runner.submit(other.job())
            ended = await other.ended(record.id)
            assert ended.kind == "job_failed"
            assert "127.0.0.1:1" in ended.data["reason"]
            with pytest.raises(UnknownEngine, match="knows: default"):
                await service.runner.submit(other.job(engine="studio 2"))


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_job_that_disagrees_with_the_profile_is_refused_and_fails_if_it_waited(tmp_path: Path) -> None:
    addresses = {
        "r3": {"host": "127.0.0.1", "port": 1},
        "mockboard": {"url": "http://127.0.0.1:1"},
        "head": {"url": "http://127.0.0.1:1"},
        "survey": SURVEY,
    }
    changed = parse_lens(SMALL_TRUTH | {"pixel_aspect": 1.0008})
    settings = Settings(database=tmp_path / "jobs.db")
    async with running_service(settings, studio_engines(studio_profile(addresses, LENS))) as service:
        b = Bench(service, addresses)
        with pytest.raises(StudioMismatch, match=r"pixel_aspect 1.0008 is not .* 1 \(\[picture\] pixel_aspect\)"):
            await service.runner.submit(b.job(pixel_aspect=1.0008))
        with pytest.raises(StudioMismatch, match=r"image_size 960x544 is not .* 960x540 \(\[picture\] image_size\)"):
            await service.runner.submit(b.job(image_size=(960, 544)))
        assert not (await service.repository.list_jobs()).jobs
        body = b.job().model_dump(mode="json")
        queued = JobQueued(lens="L", camera="Cam0", engine="default", method="joint", levels=1)
        waiting = await service.repository.create_job(body, "L", "default", None, draft(queued))
    async with running_service(settings, studio_engines(studio_profile(addresses, changed))) as service:
        ended = await Bench(service, addresses).ended(waiting.id)
        assert ended.kind == "job_failed"
        assert "the job's pixel_aspect 1 is not the studio profile's 1.0008" in ended.data["reason"]


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_an_engine_that_dies_in_mid_job_keeps_the_finished_levels(tmp_path: Path) -> None:
    async with contextlib.AsyncExitStack() as stack:
        studio = await stack.enter_async_context(contextlib.AsyncExitStack())
        addresses = await studio.enter_async_context(fast_studio(tmp_path))
        engines = studio_engines(studio_profile(addresses, LENS))
        service = await stack.enter_async_context(running_service(Settings(database=tmp_path / "jobs.db"), engines))
        b = Bench(service, addresses)
        record = await service.runner.submit(b.job((0.0, 0.25), (0.0, 0.75), (0.5, 0.25), (0.5, 0.75), (1.0, 0.25)))
        await b.until(record.id, "level_done")
        await studio.aclose()
        ended = await b.ended(record.id)
        assert ended.kind == "job_failed"
        assert "levels in a row failed" in ended.data["reason"]
        levels = await service.repository.list_levels(record.id)
        assert levels[0].result.status is LevelStatus.OK
        (info,) = service.runner.engines()
        assert info.dirty is not None


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_restart_takes_up_what_was_queued_and_ends_what_ran(tmp_path: Path) -> None:
    async with fast_studio(tmp_path) as addresses:
        engines = studio_engines(studio_profile(addresses, LENS))
        settings = Settings(database=tmp_path / "jobs.db")
        async with running_service(settings, engines) as service:
            b = Bench(service, addresses)
            first = await service.runner.submit(b.job((0.0, 0.25), (0.5, 0.25), (1.0, 0.25)))
            second = await service.runner.submit(b.job((0.5, 0.25)))
            await b.until(first.id, "level_done")
        async with running_service(settings, engines) as service:
            b = Bench(service, addresses)
            stopped = await service.repository.get_job(first.id)
            assert stopped.state is JobState.FAILED
            assert "finished levels are kept" in (stopped.reason or "")
            assert (await b.ended(second.id)).kind == "job_done"


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_plan_chooses_the_levels_and_says_why_it_ends(tmp_path: Path) -> None:
    async with bench(tmp_path / "jobs.db") as b:
        plan = PlanModel(accuracy_px=1e-3, max_levels=6, zoom_range=(0.0, 0.5), focus_range=(0.25, 0.25))
        record = await b.service.runner.submit(studio_job(b.addresses, LENS, [], plan=plan))
        assert (await b.ended(record.id)).kind == "job_done"
        events = await b.service.repository.events_after(record.id, 0)
        planned = [event.data["levels"] for event in events if event.kind == "levels_planned"]
        assert planned == [5, 6]
        notes = [event.data["text"] for event in events if event.kind == "note"]
        assert any("the plan ends: 6 levels are measured" in note for note in notes)
        summary = await b.service.repository.table_of_job(record.id)
        assert summary is not None
        table = (await b.service.repository.get_table(summary.id)).table
        assert len(table.levels) == 6
        assert (table.levels[0].zoom, table.levels[-1].zoom) == (0.0, 0.5)
        assert table.interpolation is not None
        assert table.interpolation.held_out_px is not None
        between = surface_fit(table).surface.at(0.3, 0.25)
        assert overlay(true_lens(LENS, 0.3, 0.25), between.lens).max_px < 1.0


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_a_level_that_is_asked_for_again_is_a_further_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Twice:
        reason: str | None = "asked twice"

        def __init__(self) -> None:
            self.left = [[(0.5, 0.25)], [(0.5, 0.25)]]

        def ask(self) -> list[tuple[float, float]]:
            return self.left.pop(0) if self.left else []

        def tell(self, result: LevelResult) -> None:
            pass

    monkeypatch.setattr(calibrating, "make_plan", lambda *arguments: Twice())
    async with bench(tmp_path / "jobs.db") as b:
        record = await b.service.runner.submit(b.job((0.5, 0.25)))
        assert (await b.ended(record.id)).kind == "job_done"
        stored = await b.service.repository.list_levels(record.id)
        assert [(level.ordinal, level.attempt) for level in stored] == [(0, 1), (0, 2)]
        summary = await b.service.repository.table_of_job(record.id)
        assert summary is not None
        table = (await b.service.repository.get_table(summary.id)).table
        assert table.levels == (stored[1].result,)
