"""A publish job: a lens goes to the engine, is read back and seen in a render; then it stays, or nothing does."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import ValidationError

from app.documents import JobRequest, TargetModel
from app.engines import EngineError, Lease, PictureFacts
from app.events import (
    EngineLearned,
    JobDone,
    LevelsPlanned,
    LevelStarted,
    Note,
    PixelErrorData,
    PlaceChecked,
    Published,
    ValueData,
)
from app.job_documents import PublishRequest, parse_job
from app.jobs.engine import learn
from app.jobs.taking import PictureTaker, observe
from app.jobs.work import HOME_BOUND_S, Ending, JobTools, JobWorkFailed, Subject
from app.lens_at import lens_at, level_near
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.solve.engine_model import IDENTITY, Direction, EngineModel
from calibration.solve.render_check import RenderAgreement, RenderCheck
from calibration.solve.search import LevelTask
from calibration.surface.plan import in_order
from calibration.tables import LensTable, LevelResult
from engine_adapters.errors import AdapterError
from engine_adapters.ports import HeadState, ReadBack
from storage.errors import NotFound
from storage.repository import Repository


@dataclass(frozen=True, slots=True)
class _Room:
    """What renders are compared by."""

    targets: Mapping[str, TargetModel]
    pivot_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Place:
    """A place to check: the lens that the engine is to draw, and the level that stands there, if one does."""

    zoom: float
    focus: float
    lens: Lens
    level: LevelResult | None

    def __str__(self) -> str:
        return f"zoom {self.zoom:g}, focus {self.focus:g}"


async def table_of(request: PublishRequest, repository: Repository) -> LensTable:
    """The table to publish. Raises :class:`storage.errors.NotFound`."""
    given = request.to_table()
    if given is not None:
        return given
    return (await repository.get_table(request.table_id or 0)).table


async def subject(request: PublishRequest, repository: Repository) -> Subject:
    """What a publish job is about. Raises :class:`storage.errors.NotFound`."""
    table = await table_of(request, repository)
    places = len(_usable(table)) if request.all_levels else 1
    return Subject(table.lens, table.camera, None, places, PictureFacts(table.image_size, table.pixel_aspect))


def _usable(table: LensTable) -> list[LevelResult]:
    """Levels with a lens, in the order of a sweep."""
    levels = {(level.zoom, level.focus): level for level in table.levels if level.fov_x_deg is not None}
    return [levels[place] for place in in_order(list(levels))]


class Publication:
    """The work (:class:`app.jobs.work.JobWork`) of a publish job."""

    def __init__(self, request: PublishRequest, tools: JobTools) -> None:
        self._request = request
        self._tools = tools
        self._lease: Lease | None = None
        self._place: tuple[float, float] | None = None
        self._checked: list[PlaceChecked] = []
        self._not_compared = ""

    async def run(self, lease: Lease) -> None:
        """Write, read back and compare every place; what all agreed on is kept."""
        self._lease = lease
        try:
            held = await self._publish(lease)
        except (AdapterError, CalibrationError, EngineError, JobWorkFailed) as error:
            await self._tools.event(self._published(kept=False, reason=str(error)))
            raise
        lease.keep((value.name, value.got) for value in held)

    async def finish(self) -> Ending:
        """Tell what stays in the engine."""
        lease = self._lease
        if lease is None or not lease.restored:
            told = "unknown" if lease is None or lease.problem is None else lease.problem
            reason = f"all places agree, but the engine could not be left with the lens: {told}; publish again"
            await self._tools.event(self._published(kept=False, reason=reason))
            raise JobWorkFailed(reason)
        unseen = f"no render was compared: {self._not_compared}" if self._not_compared else None
        if self._request.table_id is not None:
            zoom, focus = self._place or (0.0, 0.0)
            note = f"to engine {self._request.engine} at zoom {zoom:g}, focus {focus:g}"
            await self._tools.repository.note_published(self._request.table_id, note=note)
        await self._tools.event(self._published(kept=True, reason=unseen))
        return Ending(JobDone(table_id=None), unseen)

    def left(self) -> str:
        """What a cancelled publication leaves."""
        if self._lease is not None and self._lease.kept and self._lease.restored:
            return "the lens had been published already"
        return "nothing was published"

    def _published(self, *, kept: bool, reason: str | None) -> Published:
        zoom, focus = self._place or (None, None)
        errors = [checked.render_px for checked in self._checked if checked.render_px is not None]
        return Published(
            engine=self._request.engine,
            table_id=self._request.table_id,
            zoom=zoom,
            focus=focus,
            kept=kept,
            compared=bool(self._checked) and all(checked.compared for checked in self._checked),
            places=len(self._checked),
            values=self._checked[-1].values if kept else (),
            render_px=max(errors, key=lambda error: error.max, default=None),
            reason=reason,
        )

    async def _publish(self, lease: Lease) -> tuple[ReadBack, ...]:
        request, tools = self._request, self._tools
        table = await table_of(request, tools.repository)
        room = await self._room()
        taker = PictureTaker(lease.studio, table.image_size, tools.cpu)
        stood = await taker.read_head() if room is not None or request.place is None else None
        places = self._places(table, request.place, stood)
        if request.all_levels and (without := len(table.levels) - len(_usable(table))):
            await tools.event(Note(text=f"{without} of {len(table.levels)} levels have no lens and are passed over"))
        if room is not None:
            await taker.measure_delay()
        try:
            model = await self._model(lease, taker, table, room, places)
            if len(places) > (await subject(request, tools.repository)).levels:
                await tools.event(LevelsPlanned(levels=len(places)))
            held: tuple[ReadBack, ...] = ()
            for ordinal, place in enumerate(places):
                held = await self._check(ordinal, place, model, lease, taker, table, room)
            return held
        finally:
            if room is not None and stood is not None:
                await self._home(taker, stood)

    async def _home(self, taker: PictureTaker, stood: HeadState) -> None:
        """Turn the head back, as a courtesy; not when the job is cancelled, which is to end at once."""
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            return
        try:
            async with asyncio.timeout(HOME_BOUND_S):
                await taker.home(stood)
        except (AdapterError, TimeoutError) as error:
            await self._tools.event(Note(text=f"head and lens were not turned back: {error}"))

    async def _room(self) -> _Room | None:
        """Targets and pivot of the request, else of the job that made the table; None, and why, where nobody knows."""
        request, repository = self._request, self._tools.repository
        if request.pivot_m is not None:
            return _Room(request.targets, request.pivot_m)
        self._not_compared = "no targets were given"
        if request.table_id is None:
            return None
        self._not_compared = "no targets were given, and no job of this service that can be read made the table"
        job_id = (await repository.get_table(request.table_id)).summary.job_id
        if job_id is None:
            return None
        try:
            made_by = parse_job((await repository.get_job(job_id)).request)
        except (NotFound, ValidationError):
            return None
        if not isinstance(made_by, JobRequest):
            return None
        self._not_compared = ""
        return _Room(made_by.targets, made_by.pivot_m)

    def _places(self, table: LensTable, wanted: tuple[float, float] | None, stood: HeadState | None) -> list[_Place]:
        """The places to check, that which stays last. Raises before anything is written where there is no lens."""
        if wanted is None and stood is not None:
            wanted = (stood.zoom, stood.focus)
        if wanted is None:
            raise JobWorkFailed("no place was given and the head was not read")
        self._place = zoom, focus = wanted
        last = _Place(zoom, focus, lens_at(table, zoom, focus), level_near(table, zoom, focus))
        if not self._request.all_levels:
            return [last]
        levels = [
            _Place(level.zoom, level.focus, level.lens(table.image_size, table.pixel_aspect), level)
            for level in _usable(table)
            if level is not last.level
        ]
        return [*levels, last]

    async def _model(
        self, lease: Lease, taker: PictureTaker, table: LensTable, room: _Room | None, places: list[_Place]
    ) -> EngineModel | None:
        """How the engine draws, as learned; None: a level's engine values and the profile say what it is told."""
        between = any(place.level is None for place in places)
        if not self._request.learn_engine and not (between and any(level.engine_values for level in table.levels)):
            return None
        if room is None:
            raise JobWorkFailed(f"the engine's own camera must be learned, and {self._not_compared}")
        studio = lease.studio
        task = _task(places[0], table, room)
        known = await learn(taker, task, studio.facts, studio.transfer, self._tools.cpu)
        await self._tools.event(EngineLearned.of(self._request.engine, known.learned, known.disagreements))
        if not known.learned.trusted:
            raise JobWorkFailed(f"the engine is not understood: {known.learned.reason}")
        return known.model

    async def _check(
        self,
        ordinal: int,
        place: _Place,
        model: EngineModel | None,
        lease: Lease,
        taker: PictureTaker,
        table: LensTable,
        room: _Room | None,
    ) -> tuple[ReadBack, ...]:
        """Write one place's lens, read it back, compare a render. Raises :class:`JobWorkFailed` where they differ."""
        tools = self._tools
        await tools.event(LevelStarted(ordinal=ordinal, zoom=place.zoom, focus=place.focus))
        asked = await tools.cpu.run(_asked, place, model, Direction(lease.studio.facts.direction))
        await taker.apply(asked)
        held = await taker.read_back(asked)
        trouble = _not_held(held)
        agreement: RenderAgreement | None = None
        if not trouble and room is not None:
            agreement = await self._compare(place, asked, lease, taker, _task(place, table, room))
            trouble = agreement.trouble
            if trouble and model is not None:
                shortfall_px = await tools.cpu.run(model.shortfall_px, place.lens)
                if shortfall_px > agreement.limit_px:
                    trouble = (
                        f"the engine cannot draw this lens nearer than {shortfall_px:.2f} px everywhere, whatever it "
                        f"is told ({agreement.limit_px:.2f} px are taken): raise limit_px if that will do"
                    )
        off = agreement.off_px if agreement is not None else None
        checked = PlaceChecked(
            ordinal=ordinal,
            zoom=place.zoom,
            focus=place.focus,
            values=tuple(ValueData(name=v.name, asked=v.asked, got=v.got, same=v.same) for v in held),
            compared=off is not None,
            renders=agreement.renders if agreement is not None else 0,
            render_px=PixelErrorData.of(off),
            limit_px=agreement.limit_px if agreement is not None else None,
            reason=trouble or self._not_compared or None,
            ok=not trouble,
        )
        self._checked.append(checked)
        await tools.event(checked)
        if trouble:
            raise JobWorkFailed(f"{place}: {trouble}; nothing was published")
        return held

    async def _compare(
        self, place: _Place, asked: Lens, lease: Lease, taker: PictureTaker, task: LevelTask
    ) -> RenderAgreement:
        known_px = 0.0
        if place.level is not None and place.level.engine_values is not None:
            # Values found on the engine draw the lens as nearly as the level says.
            known_px = place.level.engine_overlay_px.max if place.level.engine_overlay_px is not None else 0.0
        check = RenderCheck(place.lens, asked, task, limit_px=self._request.limit_px, known_px=known_px)
        while not check.done:
            capture = await self._tools.cpu.run(check.ask)
            if capture is None:
                break
            taken = await taker.take(capture)
            name = f"render {capture.step} at {place}"
            check.tell(await self._tools.cpu.run(observe, taken, task, lease.studio.transfer, name))
        return await self._tools.cpu.run(check.result)


def _task(place: _Place, table: LensTable, room: _Room) -> LevelTask:
    return LevelTask(
        zoom=place.zoom,
        focus=place.focus,
        image_size=table.image_size,
        targets={name: model.to_target() for name, model in room.targets.items()},
        pivot_m=room.pivot_m,
        pixel_aspect=table.pixel_aspect,
    )


def _asked(place: _Place, model: EngineModel | None, direction: Direction) -> Lens:
    """What the engine is told, so that it draws the place's lens."""
    if model is None and place.level is not None and place.level.engine_values is not None:
        values = place.level.engine_values
        return Lens.from_fov(
            place.lens.image_size,
            values.fov_x_deg,
            k1=values.k1,
            k2=values.k2,
            center_shift_px=values.center_shift_px,
            pixel_aspect=place.lens.pixel_aspect,
            nodal_offset_mm=values.nodal_offset_mm,
        )
    model = model or EngineModel(direction=direction)
    # Straight through where nothing is converted, so that no digit is lost.
    return place.lens if model == IDENTITY else model.asking_for(place.lens)


def _not_held(held: tuple[ReadBack, ...]) -> str:
    """The first value that the engine does not hold; empty where it holds all."""
    wrong = [value for value in held if not value.same]
    if not wrong:
        return ""
    more = f" (and {len(wrong) - 1} more values)" if len(wrong) > 1 else ""
    return (
        f"the engine does not hold what it was told: {wrong[0].name} was set to {wrong[0].asked} and reads "
        f"{wrong[0].got}{more}; does it clip the value, or does somebody else set it?"
    )
