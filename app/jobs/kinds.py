"""Every kind of job with its work. A further kind is a case more in each function here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import assert_never

from app.documents import JobRequest
from app.events import JobQueued
from app.job_documents import AnyJob, PublishRequest, RecheckRequest
from app.jobs import calibrating, publishing, rechecking
from app.jobs.prior import require_prior
from app.jobs.work import JobTools, JobWork, Subject
from storage.repository import Repository

STOPPED: Mapping[str, str] = {
    "calibrate": "its finished levels are kept",
    "publish": "see what the engine holds, and publish again",
    "recheck": "its finished levels are kept; check again",
}
"""What is left of a job of each kind that ran when the service stopped."""


async def subject_of(job: AnyJob, repository: Repository) -> Subject:
    """What a job is about. Raises :class:`storage.errors.NotFound` for a table that it names and nobody has,
    :class:`app.engines.StudioMismatch` for one of another picture to start from."""
    match job:
        case JobRequest():
            await require_prior(job, repository)
            return calibrating.subject(job)
        case PublishRequest():
            return await publishing.subject(job, repository)
        case RecheckRequest():
            return await rechecking.subject(job, repository)
        case _:
            assert_never(job)


def work_of(job: AnyJob, tools: JobTools) -> JobWork:
    """The work of one run of a job."""
    match job:
        case JobRequest():
            return calibrating.Calibration(job, tools)
        case PublishRequest():
            return publishing.Publication(job, tools)
        case RecheckRequest():
            return rechecking.Rechecking(job, tools)
        case _:
            assert_never(job)


def queued(job: AnyJob, about: Subject) -> JobQueued:
    """The first event of a job."""
    return JobQueued(
        job=job.kind,
        lens=about.lens,
        camera=about.camera,
        engine=job.engine,
        method=about.method,
        levels=about.levels,
    )
