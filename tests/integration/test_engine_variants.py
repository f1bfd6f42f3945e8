"""Jobs over real sockets on engines that do not count as the studio profile says."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from app.bootstrap import running_service
from app.cli.jobs import run_job
from app.cli.simulated import studio_engines, studio_job, studio_profile, true_lens
from app.documents import JobRequest
from app.events import TERMINAL_KINDS
from app.settings import Settings
from calibration.compare import overlay
from calibration.tables import LensTable, LevelStatus
from engine_adapters.sim.launch import launched_studio
from storage.records import EventRecord
from tests.integration.test_jobs import FAST, LENS, SMALL_TRUTH

ENOUGH_TIME_S = 90
LEVELS = [(0.5, 0.25), (0.5, 0.75)]


@dataclass(frozen=True)
class Outcome:
    """What a job left: its events, and its table where it made one."""

    events: list[EventRecord]
    table: LensTable | None

    def of_kind(self, kind: str) -> list[EventRecord]:
        return [event for event in self.events if event.kind == kind]

    @property
    def disagreements(self) -> list[str]:
        (learned,) = self.of_kind("engine_learned")
        return list(learned.data["disagreements"])

    def truth_px(self) -> list[float]:
        assert self.table is not None
        truths = [true_lens(LENS, level.zoom, level.focus) for level in self.table.levels]
        found = [level.lens(self.table.image_size) for level in self.table.levels]
        return [overlay(truth, lens).max_px for truth, lens in zip(truths, found, strict=True)]

    def engine_px(self) -> list[float]:
        assert self.table is not None
        seen = [level.engine_overlay_px.max for level in self.table.levels if level.engine_overlay_px is not None]
        assert len(seen) == len(self.table.levels)
        return seen


async def calibrate(
    folder: Path, *options: str, levels: list[tuple[float, float]] = LEVELS, **changes: object
) -> Outcome:
    truth = folder / "truth.json"
    truth.write_text(json.dumps(SMALL_TRUTH))
    async with launched_studio(("--lens-file", str(truth), *FAST, *options)) as addresses:
        engines = studio_engines(studio_profile(addresses, LENS))
        request: JobRequest = studio_job(addresses, LENS, levels).model_copy(update=changes)
        async with running_service(Settings(database=folder / "jobs.db"), engines) as service:
            record = await service.runner.submit(request)
            with service.broker.listen(record.id) as wakeups:
                while True:
                    wakeups.clear()
                    events = await service.repository.events_after(record.id, 0)
                    if events[-1].kind in TERMINAL_KINDS:
                        break
                    await wakeups.wait(1.0)
            summary = await service.repository.table_of_job(record.id)
            table = (await service.repository.get_table(summary.id)).table if summary is not None else None
    return Outcome(list(events), table)


@pytest.mark.timeout(ENOUGH_TIME_S)
@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("radius_unit=half_width", "engine.radius_unit says focal_length, the engine behaves as half_width"),
        ("direction=reverse", "engine.direction says undistorted_to_distorted, the engine behaves as reverse"),
        ("center_shift_sign_x=-1", "engine.center_shift_sign_x says 1, the engine behaves as -1"),
        ("center_shift=absolute_pixel", "engine.center_shift says offset, the engine behaves as absolute_pixel"),
        ("overscan=1.15", "the engine draws a field 1.15 times as wide as asked"),
    ],
)
async def test_an_engine_of_another_kind_is_told_and_matched(tmp_path: Path, option: str, said: str) -> None:
    found = await calibrate(tmp_path, "--engine", option)
    assert found.table is not None, found.events[-1].data
    assert all(level.status is LevelStatus.OK for level in found.table.levels), found.table.levels
    assert max(found.truth_px()) <= 0.05
    assert max(found.engine_px()) <= 0.1
    assert len(found.disagreements) == 1
    assert found.disagreements[0].startswith(said)
    notes = [event.data["text"] for event in found.of_kind("note")]
    assert found.disagreements[0] in notes
    # One render a level once the engine is known.
    assert [level.frames.virtual for level in found.table.levels] == [1, 1]


@pytest.mark.timeout(ENOUGH_TIME_S)
@pytest.mark.parametrize("frames", ["0", "5"])
async def test_no_delay_of_the_output_is_taken_for_an_engine_of_another_kind(tmp_path: Path, frames: str) -> None:
    found = await calibrate(tmp_path, "--delay-frames", frames)
    assert found.table is not None
    assert max(found.truth_px()) <= 0.05
    assert max(found.engine_px()) <= 0.1
    assert found.disagreements == []


@pytest.mark.timeout(ENOUGH_TIME_S)
@pytest.mark.parametrize("option", ["radius_unit=half_width", "center_shift_sign_x=-1", "overscan=1.15"])
async def test_a_wrong_profile_that_is_not_learned_is_searched_and_never_silently_wrong(
    tmp_path: Path, option: str
) -> None:
    found = await calibrate(tmp_path, "--engine", option, levels=LEVELS[:1], learn_engine=False)
    assert found.of_kind("engine_learned") == []
    assert found.table is not None
    (level,) = found.table.levels
    # The camera's own lens is measured from its pictures alone.
    assert max(found.truth_px()) <= 0.05
    assert level.frames.virtual > 3
    if level.status is LevelStatus.OK:
        assert max(found.engine_px()) <= 0.3
        assert level.engine_values is not None
    else:
        assert level.reason


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_the_alternating_method_on_a_wrong_profile_fails_with_the_reason(tmp_path: Path) -> None:
    found = await calibrate(tmp_path, "--engine", "radius_unit=half_width", levels=LEVELS[:1], method="alternating")
    assert found.table is None
    assert found.events[-1].kind == "job_failed"
    assert "engine.radius_unit says focal_length" in str(found.events[-1].data)


@pytest.mark.timeout(ENOUGH_TIME_S)
async def test_the_command_line_warns_of_a_wrong_profile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps(SMALL_TRUTH))
    options = ("--lens-file", str(truth), *FAST, "--engine", "radius_unit=half_width")
    async with launched_studio(options) as addresses:
        engines = studio_engines(studio_profile(addresses, LENS))
        settings = Settings(database=tmp_path / "jobs.db")
        await run_job(settings, engines, studio_job(addresses, LENS, LEVELS[:1]), lambda share, doing: None)
    printed = capsys.readouterr()
    assert "engine.radius_unit says focal_length, the engine behaves as half_width" in printed.err
    assert printed.out == ""
