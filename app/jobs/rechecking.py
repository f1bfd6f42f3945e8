"""A recheck job: a stored lens is measured again at a few places, and judged against what was stored."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

from pydantic import ValidationError

from app.documents import JobRequest, LevelModel
from app.engines import Lease, PictureFacts
from app.events import JobDone, Rechecked
from app.job_documents import RecheckRequest, parse_job
from app.jobs.calibrating import Calibration
from app.jobs.provenance import software
from app.jobs.work import Ending, JobTools, JobWorkFailed, Subject
from app.lens_at import SAME_PLACE, surface_fit
from calibration.surface import LensSurface
from calibration.surface.quantities import LevelData
from calibration.surface.recheck import Recheck, Verdict, check_places, corrected_table, recheck
from calibration.tables import LensTable, LevelResult, LevelStatus
from storage.errors import NotFound
from storage.exports.json_table import write_json
from storage.repository import Repository

_MEASURED_TO = 0.1
# Share of the goal to which the expected error of a level measured again is brought.
_MOST_PARENTS = 20
# Tables corrected one after another, through which the room's survey is sought.


async def table_of(request: RecheckRequest, repository: Repository) -> LensTable:
    """The table to check. Raises :class:`storage.errors.NotFound`."""
    given = request.to_table()
    return given if given is not None else (await repository.get_table(request.table_id or 0)).table


async def subject(request: RecheckRequest, repository: Repository) -> Subject:
    """What a recheck job is about. Raises :class:`storage.errors.NotFound`."""
    table = await table_of(request, repository)
    pictures = PictureFacts(table.image_size, table.pixel_aspect)
    return Subject(table.lens, table.camera, "joint", len(request.levels), pictures)


def judge(table: LensTable, results: Sequence[LevelResult], goal_px: float) -> Recheck:
    """Levels measured again against the table. Raises :class:`JobWorkFailed` where none was measured."""
    failed = [result for result in results if result.status is LevelStatus.FAILED]
    if len(failed) == len(results):
        told = failed[0].reason if failed else "none was asked for"
        raise JobWorkFailed(f"no level could be measured: {told}")
    levels = LevelData.of(replace(table, levels=tuple(results), interpolation=None))
    found = recheck(surface_fit(table).surface, levels, goal_px=goal_px)
    if not failed:
        return found
    unseen = f"{len(failed)} of {len(results)} levels could not be measured: {failed[0].reason}"
    return replace(found, reason=f"{found.reason}; {unseen}")


def corrected(table: LensTable, found: Recheck, job_id: str) -> LensTable:
    """The table as the remount makes it, with where it comes from. Raises :class:`InvalidInput` without a remount."""
    parent = hashlib.sha256(write_json(table)).hexdigest()
    surface = surface_fit(table).surface
    return corrected_table(table, surface, found, software=software(), parent_sha256=parent, job_id=job_id)


class Rechecking:
    """The work (:class:`app.jobs.work.JobWork`) of a recheck job."""

    def __init__(self, request: RecheckRequest, tools: JobTools) -> None:
        self._request = request
        self._tools = tools
        self._measuring: Calibration | None = None

    async def run(self, lease: Lease) -> None:
        """Measure the places, each starting from the stored lens."""
        table = await table_of(self._request, self._tools.repository)
        surface = (await self._tools.cpu.run(surface_fit, table)).surface
        job = await self._job(table, surface)
        self._measuring = Calibration(job, self._tools, surface)
        await self._measuring.run(lease)

    async def finish(self) -> Ending:
        """Judge the stored lens, and store the corrected one where that was asked for."""
        request, tools = self._request, self._tools
        results = self._measuring.results if self._measuring is not None else ()
        table = await table_of(request, tools.repository)
        found = await tools.cpu.run(judge, table, results, request.goal_px)
        stored: int | None = None
        if request.store and found.verdict is Verdict.CORRECTED:
            moved = await tools.cpu.run(corrected, table, found, tools.job_id)
            moved = replace(moved, created=tools.now())
            note = moved.provenance.note if moved.provenance is not None else None
            stored = (await tools.repository.save_table(None, moved, note=note)).id
        await tools.event(Rechecked.of(request.engine, request.table_id, found, stored))
        return Ending(JobDone(table_id=stored), found.reason if found.verdict is Verdict.CHANGED else None)

    def left(self) -> str:
        """What a cancelled re-check leaves."""
        return "finished levels are kept, the stored lens was not judged"

    async def _job(self, table: LensTable, surface: LensSurface) -> JobRequest:
        """The calibration that measures the places."""
        request = self._request
        room = request if request.pivot_m is not None else await self._room(table)
        places = [(level.zoom, level.focus) for level in request.levels] or list(check_places(surface))
        _require_inside(surface, places)
        return JobRequest(
            lens=table.lens,
            camera=table.camera,
            engine=request.engine,
            image_size=table.image_size,
            sensor_mm=table.sensor_mm,
            pixel_aspect=table.pixel_aspect,
            levels=[LevelModel(zoom=zoom, focus=focus) for zoom, focus in places],
            targets=room.targets,
            pivot_m=room.pivot_m or (0.0, 0.0, 0.0),
            pivot_sigma_m=room.pivot_sigma_m,
            angle_sigma_deg=room.angle_sigma_deg,
            roll_sigma_deg=room.roll_sigma_deg,
            priors=room.priors,
            # The camera's pictures alone tell the lens; how the engine draws is the publication's matter.
            learn_engine=False,
            goal_px=_MEASURED_TO * request.goal_px,
            max_views=request.max_views,
        )

    async def _room(self, table: LensTable) -> JobRequest | RecheckRequest:
        """The job whose room this is: that which made the table, or the one that it was corrected from."""
        repository, table_id = self._tools.repository, self._request.table_id
        for _ in range(_MOST_PARENTS):
            job_id = None if table.provenance is None else table.provenance.job_id
            if table_id is not None:
                job_id = (await repository.get_table(table_id)).summary.job_id or job_id
            if job_id is None:
                break
            try:
                made_by = parse_job((await repository.get_job(job_id)).request)
                if isinstance(made_by, JobRequest):
                    return made_by
                if not isinstance(made_by, RecheckRequest):
                    break
                if made_by.pivot_m is not None:
                    return made_by
                table, table_id = await table_of(made_by, repository), made_by.table_id
            except (NotFound, ValidationError):
                break
        raise JobWorkFailed(
            "no targets were given, and no job that this service can read made the table: give targets and pivot_m"
        )


def _require_inside(surface: LensSurface, places: Sequence[tuple[float, float]]) -> None:
    (wide, tele), (far, near) = surface.zoom_range, surface.focus_range
    for zoom, focus in places:
        outside = zoom < wide - SAME_PLACE or zoom > tele + SAME_PLACE
        if outside or focus < far - SAME_PLACE or focus > near + SAME_PLACE:
            raise JobWorkFailed(
                f"zoom {zoom:g}, focus {focus:g} lies outside the table's levels (zoom {wide:g} to {tele:g}, focus "
                f"{far:g} to {near:g}), where nothing was stored to be checked"
            )
