"""The service over a real ledger, without an engine: a runner that only keeps its jobs, and what a ledger may hold."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import httpx

from app.api import errors
from app.engines import EngineInfo, UnknownEngine
from app.errors import QueueFull
from app.events import JobCancelled, JobStarted, LevelDone, draft
from app.job_documents import AnyJob
from app.jobs.kinds import queued, subject_of
from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, PixelError
from storage.records import JobRecord, JobState, PictureKind
from storage.repository import Repository

SIZE = (1920, 1080)
JOB: dict[str, Any] = {
    "lens": "XA 20x",
    "levels": [{"zoom": 0.0, "focus": 0.0}, {"zoom": 1.0, "focus": 0.5}],
    "targets": {
        "board": {"kind": "chessboard", "squares": [8, 8], "square_m": 0.075, "pose": {"centre_m": [0.0, 6.0, 1.5]}}
    },
    "pivot_m": [0.0, 0.0, 1.5],
}
JPEG = b"\xff\xd8\xff\xe0 a picture"


class KeepingRunner:
    """Stores what it is asked to run, and runs nothing."""

    def __init__(self, ledger: Repository) -> None:
        self._ledger = ledger
        self.full = False

    async def submit(self, request: AnyJob, *, idempotency_key: str | None = None) -> JobRecord:
        if request.engine != "default":
            raise UnknownEngine(f"no engine is called {request.engine!r}; this service knows: default")
        if self.full:
            raise QueueFull(3, retry_after_s=7)
        about = await subject_of(request, self._ledger)
        body = request.model_dump(mode="json")
        event = draft(queued(request, about))
        return await self._ledger.create_job(body, about.lens, request.engine, idempotency_key, event)

    async def cancel(self, job_id: str) -> JobRecord:
        job = await self._ledger.get_job(job_id)
        if job.state is not JobState.QUEUED:
            return job
        cancelled = draft(JobCancelled())
        return await self._ledger.set_job_state(job_id, JobState.CANCELLED, expected=[JobState.QUEUED], event=cancelled)

    def engines(self) -> list[EngineInfo]:
        return [EngineInfo("default", "r3 127.0.0.1:9009", None, None), EngineInfo("b", "r3 b:9009", "a-job", "gone")]


def measured_level(zoom: float = 0.0, focus: float = 0.0) -> LevelResult:
    """A level with all its evidence but for two quantities, which say why they are missing."""
    told: dict[str, Any] = {name: PixelError(0.1, 0.3) for name in EVIDENCE_QUANTITIES if name != "held_out_px"}
    lens = Lens.from_fov(SIZE, 56.1, -0.12, 0.031, (4.31, -2.7))
    reasons = {"nodal_offset_mm": "one distance only", "held_out_px": "too few pictures"}
    return LevelResult.from_lens(zoom, focus, lens, reasons=reasons, **told)


def lens_table(lens: str = "XA 20x") -> LensTable:
    """A table of one measured and one failed level."""
    created = datetime(2026, 11, 21, 10, tzinfo=UTC)
    return LensTable(
        lens,
        "Cam0",
        1,
        created,
        SIZE,
        "joint",
        (measured_level(), LevelResult.failed(1.0, 0.5, "no board")),
        sensor_mm=(9.59, 5.39),
    )


async def stored_job(ledger: Repository, *, evidence: str | None = None) -> JobRecord:
    """A job with one level done, one failed, a picture and its table."""
    job = await ledger.create_job(JOB, "XA 20x", "default")
    running = draft(JobStarted(engine="default", levels=2))
    await ledger.set_job_state(job.id, JobState.RUNNING, expected=[JobState.QUEUED], event=running)
    await ledger.save_level(job.id, 0, measured_level(), draft(LevelDone.of(0, measured_level())), evidence=evidence)
    await ledger.save_level(job.id, 1, LevelResult.failed(1.0, 0.5, "no board"), ("level_failed", {}))
    await ledger.save_picture(job.id, 0, PictureKind.OVERLAY, "image/jpeg", JPEG)
    await ledger.save_picture(job.id, 0, PictureKind.REAL, "image/svg+xml", b"<svg onload='alert(1)'/>")
    await ledger.save_table(job.id, lens_table())
    return await ledger.get_job(job.id)


def assert_problem(answer: httpx.Response, name: str) -> dict[str, Any]:
    """The answer is the problem document of that name, whole and telling nothing it must not; returns it."""
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    problem: dict[str, Any] = answer.json()
    assert problem["type"] == f"urn:lensmatch:problem:{name}", problem
    assert problem["status"] == answer.status_code == errors.PROBLEMS[name].status
    assert problem["title"] == errors.PROBLEMS[name].title
    assert problem["detail"]
    assert "\n" not in problem["detail"]
    assert "Traceback" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"
    return problem
