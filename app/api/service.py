"""The service itself: its engines, whether it is alive, whether it is ready."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path

from fastapi import APIRouter

from app.api.context import Context
from app.api.errors import Problem, responses
from app.api.models import Check, EngineList, EngineView, Health, Readiness

router = APIRouter(tags=["service"])


@router.get("/engines", response_model=EngineList)
async def list_engines(context: Context) -> EngineList:
    """The engines, and who has them."""
    return EngineList(engines=[EngineView.of(engine) for engine in context.runner.engines()])


@router.get("/healthz", response_model=Health)
async def healthz() -> Health:
    """Whether the process answers; touches nothing else."""
    return Health()


@router.get("/readyz", response_model=Readiness, responses=responses("not-ready"))
async def readyz(context: Context) -> Readiness:
    """Whether work can be done: the database answers, and its disk has room."""
    settings = context.settings
    try:
        async with asyncio.timeout(settings.ready_timeout_s):
            await context.repository.list_jobs(limit=1)
    except TimeoutError as error:
        why = f"the database did not answer within {settings.ready_timeout_s:g} s; is its disk slow or full?"
        raise Problem("not-ready", why) from error
    folder = Path(context.repository.where).parent
    try:
        free = (await asyncio.to_thread(shutil.disk_usage, folder)).free
    except OSError as error:
        raise Problem("not-ready", f"{folder}: its disk cannot be asked ({error.strerror or error})") from error
    mib = 1024 * 1024
    if free < settings.min_free_disk_bytes:
        need = settings.min_free_disk_bytes // mib
        raise Problem("not-ready", f"{folder}: {free // mib} MiB free, {need} MiB are needed; free some space")
    return Readiness(
        checks=[Check(name="database", detail="answers"), Check(name="disk", detail=f"{free // mib} MiB free")]
    )
