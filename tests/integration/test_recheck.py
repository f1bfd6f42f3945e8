"""A stored lens checked again on the simulated studio, over its real sockets: unchanged, remounted, another one."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from app.cli.commands import cli
from app.cli.simulated import studio_job, studio_profile, true_lens
from app.engines import StudioMismatch
from app.events import Rechecked
from app.job_documents import RecheckRequest
from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, LevelStatus
from engine_adapters.profile import profile_toml
from storage.errors import NotFound
from storage.exports import EXPORTS
from storage.records import EventRecord
from storage.schemas import table_to_document
from tests.integration.test_jobs import ENOUGH_TIME_S, LENS, Bench, bench, fast_studio

UNTOLD = dict.fromkeys(EVIDENCE_QUANTITIES, "made from the truth")
PLACES = [{"zoom": 0.2, "focus": 0.5}, {"zoom": 0.6, "focus": 0.5}]
TableOf = Callable[[float, float], Lens]

pytestmark = [pytest.mark.timeout(ENOUGH_TIME_S)]


def before(shift: tuple[float, float] = (0.0, 0.0), zoom: float = 0.0, bend: float = 0.0) -> TableOf:
    """The lens as it was stored before a remount moved it to the truth, or before its distortion changed."""

    def at(z: float, f: float) -> Lens:
        lens = true_lens(LENS, z + zoom, f)
        moved = (lens.center_shift_px[0] - shift[0], lens.center_shift_px[1] - shift[1])
        return replace(lens, center_shift_px=moved).with_hw(lens.f_px, lens.k1_hw + bend, lens.k2_hw)

    return at


def table(lens_at: TableOf | None = None) -> LensTable:
    lens_at = lens_at or before()
    levels = tuple(
        LevelResult.from_lens(float(zoom), focus, lens_at(float(zoom), focus), reasons=UNTOLD)
        for zoom in np.linspace(0.05, 0.95, 9)  # the truth of a slipped encoder ends at 0 and 1
        for focus in (0.25, 0.5, 0.75)
    )
    created = datetime(2026, 11, 21, 10, tzinfo=UTC)
    return LensTable(LENS.name, "Cam0", 1, created, LENS.image_size, "truth", levels, LENS.sensor_mm)


class RecheckBench(Bench):
    def request(self, **changes: Any) -> RecheckRequest:
        room = studio_job(self.addresses, LENS, [(0.5, 0.5)]).model_dump(mode="json")
        document = {"kind": "recheck", "levels": PLACES, "targets": room["targets"], "pivot_m": room["pivot_m"]}
        return RecheckRequest.model_validate(document | changes)

    async def check(self, request: RecheckRequest) -> tuple[EventRecord, list[EventRecord], Rechecked]:
        record = await self.service.runner.submit(request)
        last = await self.ended(record.id)
        events = list(await self.service.repository.events_after(record.id, 0))
        assert last.kind == "job_done", last.data
        (found,) = [event for event in events if event.kind == "rechecked"]
        return last, events, Rechecked.model_validate(dict(found.data))


@contextlib.asynccontextmanager
async def checking(folder: Path) -> AsyncIterator[RecheckBench]:
    async with bench(folder / "jobs.db") as b:
        yield RecheckBench(b.service, b.addresses)


async def test_an_unchanged_lens_holds_after_few_pictures(tmp_path: Path) -> None:
    async with checking(tmp_path) as b:
        found_in_engine = await b.engine_values()
        last, events, found = await b.check(b.request(table=table_to_document(table()), levels=[]))
        assert (found.verdict, found.remount, found.left_px) == ("holds", None, None)
        assert found.error_px < 0.5
        assert len(found.levels) == 3
        assert last.data["table_id"] is None
        kinds = [event.kind for event in events]
        assert "engine_learned" not in kinds
        assert kinds.index("engine_restored") < kinds.index("rechecked")
        assert await b.engine_values() == found_in_engine
        pictures = [event.data["frames"]["real"] for event in events if event.kind == "level_done"]
        assert len(pictures) == 3
        assert max(pictures) <= 7


async def test_a_remount_is_corrected_and_the_corrected_table_is_stored_when_asked(tmp_path: Path) -> None:
    async with checking(tmp_path) as b:
        repository = b.service.repository
        stored = await repository.save_table(None, table(before((4.0, 0.0), zoom=0.01)))
        await repository.approve_table(stored.id)
        _, _, found = await b.check(b.request(table_id=stored.id))
        assert found.verdict == "corrected"
        assert found.corrected_table_id is None
        assert len(await repository.list_tables(stored.lens_id)) == 1
        last, _, found = await b.check(b.request(table_id=stored.id, store=True))
        assert found.verdict == "corrected"
        assert found.remount is not None
        assert found.remount.center_shift_px == pytest.approx((4.0, 0.0), abs=0.3)
        # The stored place z has the lens that now stands at z + 0.01.
        assert found.remount.zoom_offset == pytest.approx(0.01, abs=1e-3)
        assert last.data["table_id"] == found.corrected_table_id is not None
        kept = await repository.get_table(found.corrected_table_id)
        assert kept.table.version == 2
        assert not kept.summary.approved
        assert kept.table.provenance is not None
        assert (kept.table.provenance.source, kept.table.provenance.parent_sha256) == ("corrected", stored.sha256)
        # The corrected table holds, and is checked in the room of the check that corrected it.
        again = RecheckRequest(kind="recheck", table_id=found.corrected_table_id)
        _, _, found = await b.check(again)
        assert (found.verdict, len(found.levels)) == ("holds", 3)


async def test_a_changed_lens_is_told_and_never_stored(tmp_path: Path) -> None:
    async with checking(tmp_path) as b:
        stored = await b.service.repository.save_table(None, table(before(bend=0.02)))
        last, _, found = await b.check(b.request(table_id=stored.id, store=True))
        assert found.verdict == "changed"
        assert found.error_px > 2
        assert (found.remount, found.corrected_table_id, last.data["table_id"]) == (None, None, None)
        assert len(await b.service.repository.list_tables(stored.lens_id)) == 1
        record = await b.service.repository.get_job(last.job_id)
        assert "calibrate the lens again" in (record.reason or "")


async def test_what_cannot_be_checked_is_one_line(tmp_path: Path) -> None:
    async with checking(tmp_path) as b:
        with pytest.raises(NotFound):
            await b.service.runner.submit(b.request(table_id=99))
        document = table_to_document(table())
        nowhere = RecheckRequest.model_validate({"kind": "recheck", "table": document})
        record = await b.service.runner.submit(nowhere)
        last = await b.ended(record.id)
        assert last.kind == "job_failed"
        assert "no targets were given" in last.data["reason"]
        record = await b.service.runner.submit(b.request(table=document, levels=[{"zoom": 0.5, "focus": 0.9}]))
        last = await b.ended(record.id)
        assert "outside the table's levels" in last.data["reason"]


async def test_a_job_starts_from_another_table(tmp_path: Path) -> None:
    async with checking(tmp_path) as b:
        stored = await b.service.repository.save_table(None, table(before((5.0, 3.0))))
        place = (0.4, 0.5)
        pictures = {}
        for start in (None, stored.id):
            record = await b.service.runner.submit(b.job(place, start_from=start))
            assert (await b.ended(record.id)).kind == "job_done"
            (level,) = await b.service.repository.list_levels(record.id)
            assert level.result.status is LevelStatus.OK
            pictures[start] = level.result.frames.real
        assert pictures[stored.id] <= pictures[None]


async def test_a_start_of_another_picture_is_refused(tmp_path: Path) -> None:
    async with checking(tmp_path) as b:
        levels = tuple(replace(level, fov_y_deg=None) for level in table().levels)
        other = replace(table(), levels=levels, pixel_aspect=1.1)
        stored = await b.service.repository.save_table(None, other)
        with pytest.raises(StudioMismatch, match="start_from: a lens of pixel aspect"):
            await b.service.runner.submit(b.job(start_from=stored.id))
        with pytest.raises(NotFound):
            await b.service.runner.submit(b.job(start_from=77))


def invoke(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


@pytest.fixture
def folder(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(repository))
    monkeypatch.setenv("LENSMATCH_DATABASE", str(tmp_path / "lensmatch.db"))
    monkeypatch.setenv("LENSMATCH_CPU_WORKERS", "1")
    return tmp_path


async def run_cli(folder: Path, stored: LensTable, *words: str) -> Result:
    async with fast_studio(folder) as addresses:
        (folder / "studio.toml").write_text(profile_toml(studio_profile(addresses, LENS)), "utf-8")
        job = studio_job(addresses, LENS, [(0.5, 0.5)]).model_dump(mode="json", exclude_none=True)
        (folder / "job.json").write_text(json.dumps(job), "utf-8")
        (folder / "table.json").write_bytes(EXPORTS["json"].write(stored))
        places = ("--at", "0.2,0.5", "--at", "0.6,0.5")
        command = ("recheck", "table.json", "--studio", "studio.toml", "--room", "job.json", *places, *words)
        return await asyncio.to_thread(invoke, *command)


async def test_the_command_writes_the_corrected_table(folder: Path) -> None:
    done = await run_cli(folder, table(before((4.0, 0.0))), "--json", "--out", "corrected.json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["verdict"] == "corrected"
    assert told["error_px"] > 3
    assert told["left_px"] < 0.5
    moved = EXPORTS["json"].read((folder / "corrected.json").read_bytes())
    level = next((v for v in moved.levels if abs(v.zoom - 0.5) < 1e-9 and v.focus == 0.5), None)
    assert level is not None
    assert level.center_shift_px == pytest.approx(true_lens(LENS, 0.5, 0.5).center_shift_px, abs=0.3)


async def test_the_command_says_one_number_and_the_verdict(folder: Path) -> None:
    done = await run_cli(folder, table(before(bend=0.02)), "--out", "corrected.json")
    assert done.exit_code == 1, done.output
    assert "changed: " in done.stdout
    assert "calibrate the lens again" in done.stderr
    assert not (folder / "corrected.json").exists()


def test_wrong_words_are_one_line(folder: Path) -> None:
    (folder / "table.json").write_bytes(EXPORTS["json"].write(table()))
    done = invoke("recheck", "table.json", "--room", "no.json")
    assert done.exit_code == 1
    assert "no such file" in done.stderr
    done = invoke("recheck", "table.json")
    assert done.exit_code == 2
