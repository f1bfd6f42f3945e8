"""What happens to a job, as typed events, and the broker that wakes those who listen.

The events table of the store is the truth: the runner appends an event there and then calls
:meth:`EventBroker.notify`. The broker carries no events, it only says "look again"; a listener reads what came after
the last event it has seen. So nothing is lost and nothing comes twice, and a slow listener holds up nobody.

An event is sent as one flat JSON object: ``seq``, ``at``, ``kind``, ``job_id``, ``number`` and the fields of its kind.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from datetime import datetime
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from app.errors import TooManyListeners
from app.event_data import CheckedLevelData, Count, EngineModelData, FramesData, Number, RemountData
from calibration.solve.engine_fit import LearnedEngine
from calibration.surface.recheck import Recheck, Verdict
from calibration.tables import LevelResult, PixelError
from storage.records import EventDraft, EventRecord
from storage.schemas import format_utc

Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Reason = Annotated[str, Field(min_length=1, description="one line: what, where, what to do")]


class Event(BaseModel):
    """Base of all events. Unknown fields are ignored on reading, so that a newer history can be read."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class LevelEvent(Event):
    """Base of what happens to one level."""

    ordinal: Count = Field(description="the level's place in the job's order, from 0")
    zoom: Number = Field(description="encoder value, 0 wide to 1 tele")
    focus: Number = Field(description="encoder value, 0 infinity to 1 near")


class JobQueued(Event):
    """The job is stored and waits for its engine."""

    kind: Literal["job_queued"] = "job_queued"
    job: str = Field(default="calibrate", description="what kind of job it is: calibrate, publish, recheck")
    lens: str
    camera: str
    engine: str
    method: str | None = Field(default=None, description="how levels are measured; null: the job measures none")
    levels: Count = Field(description="how many levels the job has, as far as it is known")


class JobStarted(Event):
    """The job has its engine and begins."""

    kind: Literal["job_started"] = "job_started"
    engine: str
    levels: Count = Field(description="how many levels the job has, as far as it is known")


class LevelsPlanned(Event):
    """The job has more levels than were told before."""

    kind: Literal["levels_planned"] = "levels_planned"
    levels: Count = Field(description="how many levels the job has, as far as it is known now")


class LevelStarted(LevelEvent):
    """A level begins."""

    kind: Literal["level_started"] = "level_started"
    attempt: int = Field(default=1, ge=1, description="counts from 1")


class PictureEvent(LevelEvent):
    """Base of what happens to one picture of a level."""

    step: Count = Field(description="numbers the pictures of a level from 0")


class CaptureAsked(PictureEvent):
    """A picture is being taken."""

    kind: Literal["capture"] = "capture"
    source: Literal["real", "virtual"] = Field(description="the camera's picture, or the engine's own render")
    target: str = Field(description="name of the target looked for")
    pan_deg: Number = Field(description="head angle, degrees, positive to the right")
    tilt_deg: Number = Field(description="head angle, degrees, positive up")
    pictures: Count | None = Field(default=None, description="pictures so far; null: not told")


class TargetFound(PictureEvent):
    """The target was found in a picture."""

    kind: Literal["found"] = "found"
    points: Count = Field(description="how many points of the target were found")
    blur_px: Number | None = Field(default=None, description="width of its edges, px; null: not told")


class PictureRefused(PictureEvent):
    """A picture is of no use."""

    kind: Literal["refused"] = "refused"
    reason: Reason


class LevelProgress(LevelEvent):
    """How far the level is."""

    kind: Literal["level_progress"] = "level_progress"
    progress: Share = Field(description="0 to 1, an estimate")


class PixelErrorData(BaseModel):
    """An error in px."""

    model_config = ConfigDict(frozen=True)

    rms: Number
    max: Number

    @classmethod
    def of(cls, error: PixelError | None) -> PixelErrorData | None:
        return None if error is None else cls(rms=error.rms, max=error.max)


class LevelDone(LevelEvent):
    """A level is measured and stored. null: not told, the stored level has the reason."""

    kind: Literal["level_done"] = "level_done"
    attempt: int = Field(default=1, ge=1, description="counts from 1")
    status: Literal["ok", "degraded"]
    reason: str | None = Field(default=None, description="why it is degraded")
    fov_x_deg: Number | None = Field(default=None, description="horizontal field of view of the pinhole, degrees")
    k1: Number | None = None
    k2: Number | None = None
    center_shift_px: tuple[Number, Number] | None = Field(default=None, description="px, right and down")
    nodal_offset_mm: Number | None = Field(default=None, description="mm, positive towards the scene")
    residual_px: PixelErrorData | None = Field(default=None, description="real corners against the fitted model, px")
    held_out_px: PixelErrorData | None = Field(default=None, description="the same on pictures left out of the fit, px")
    predicted_overlay_px: PixelErrorData | None = Field(default=None, description="expected from the covariance, px")
    engine_overlay_px: PixelErrorData | None = Field(default=None, description="against the engine's last render, px")
    frames: FramesData
    seconds: Number | None = Field(default=None, description="how long the level took, s")

    @classmethod
    def of(cls, ordinal: int, result: LevelResult, attempt: int = 1) -> LevelDone:
        """The event of a level that ended ``ok`` or ``degraded`` (ValueError for a failed one)."""
        return cls(
            ordinal=ordinal,
            zoom=result.zoom,
            focus=result.focus,
            attempt=attempt,
            status=result.status.value,  # type: ignore[arg-type]
            reason=result.reason,
            fov_x_deg=result.fov_x_deg,
            k1=result.k1,
            k2=result.k2,
            center_shift_px=result.center_shift_px,
            nodal_offset_mm=result.nodal_offset_mm,
            residual_px=PixelErrorData.of(result.residual_px),
            held_out_px=PixelErrorData.of(result.held_out_px),
            predicted_overlay_px=PixelErrorData.of(result.predicted_overlay_px),
            engine_overlay_px=PixelErrorData.of(result.engine_overlay_px),
            frames=FramesData(real=result.frames.real, virtual=result.frames.virtual),
            seconds=result.seconds,
        )


class LevelFailed(LevelEvent):
    """A level could not be measured; it is stored with its reason, and the job goes on."""

    kind: Literal["level_failed"] = "level_failed"
    attempt: int = Field(default=1, ge=1, description="counts from 1")
    reason: Reason


class EngineLearned(Event):
    """How the engine draws was learned from renders at known values, before the first level."""

    kind: Literal["engine_learned"] = "engine_learned"
    engine: str
    trusted: bool = Field(description="the model explains the renders, and no other does")
    reason: str | None = Field(default=None, description="why it is not trusted")
    renders: Count
    rms_px: Number | None = Field(default=None, description="left between model and renders, per coordinate, px")
    next_rms_px: Number | None = Field(default=None, description="the same for the best model of another kind, px")
    noise_px: Number | None = Field(default=None, description="how exactly the renders' corners are known, px")
    model: EngineModelData
    disagreements: tuple[str, ...] = Field(default=(), description="profile settings that the engine contradicts")

    @classmethod
    def of(cls, engine: str, learned: LearnedEngine, disagreements: tuple[str, ...]) -> EngineLearned:
        """The event of what was learned."""

        def told(value: float) -> float | None:
            return value if math.isfinite(value) else None

        return cls(
            engine=engine,
            trusted=learned.trusted,
            reason=learned.reason or None,
            renders=learned.renders,
            rms_px=told(learned.rms_px),
            next_rms_px=told(learned.next_rms_px),
            noise_px=told(learned.noise_px),
            model=EngineModelData(**asdict(learned.model)),
            disagreements=disagreements,
        )


class ValueData(BaseModel):
    """A value of the lens in the engine, in the engine's own units."""

    model_config = ConfigDict(frozen=True)

    name: str = Field(description="of the scene's export")
    asked: str = Field(description="the text that was set")
    got: str = Field(description="the text that the engine gave back")
    same: bool = Field(description="whether they are one value, within the digits that the engine writes")


class PlaceChecked(LevelEvent):
    """A lens was written to the engine for one place, read back, and seen in the engine's own render."""

    kind: Literal["place_checked"] = "place_checked"
    values: tuple[ValueData, ...]
    compared: bool = Field(description="whether a render was compared with what the lens predicts")
    renders: Count = Field(default=0, description="how many renders were measured")
    render_px: PixelErrorData | None = Field(
        default=None, description="the target's points in the render against the prediction, px; rms per coordinate"
    )
    limit_px: Number | None = Field(default=None, description="largest of them that is taken, px")
    reason: str | None = Field(default=None, description="what is wrong, or why no render was compared")
    ok: bool


class Published(Event):
    """How a publication ended, after the engine was given back."""

    kind: Literal["published"] = "published"
    engine: str
    table_id: int | None = Field(default=None, description="the stored table; null: it came with the job")
    zoom: Number | None = Field(default=None, description="of the place whose lens was to stay; null: not known yet")
    focus: Number | None = None
    kept: bool = Field(description="true: the engine keeps the lens of that place; false: it has its own values back")
    compared: bool = Field(description="whether renders were compared; false: values were only written and read back")
    places: Count = Field(description="how many places were checked")
    values: tuple[ValueData, ...] = Field(default=(), description="what the engine holds for the place")
    render_px: PixelErrorData | None = Field(default=None, description="worst of all places, px; null: not compared")
    reason: str | None = Field(default=None, description="why it failed, or what was not checked")


class Rechecked(Event):
    """How a stored lens stands after a re-check."""

    kind: Literal["rechecked"] = "rechecked"
    engine: str
    table_id: int | None = Field(default=None, description="the stored table; null: it came with the job")
    verdict: Verdict = Field(description="holds; corrected: a remount explains the change; changed: nothing does")
    goal_px: Number
    error_px: Number = Field(description="of the stored lens at the worst level, px")
    left_px: Number | None = Field(default=None, description="the same after the correction, px; null: none")
    remount: RemountData | None = Field(default=None, description="the correction; null: none")
    levels: tuple[CheckedLevelData, ...]
    corrected_table_id: int | None = Field(default=None, description="the corrected table where it was stored")
    reason: Reason

    @classmethod
    def of(cls, engine: str, table_id: int | None, found: Recheck, corrected_table_id: int | None) -> Rechecked:
        """The event of what was found."""
        return cls(
            engine=engine,
            table_id=table_id,
            verdict=found.verdict,
            goal_px=found.goal_px,
            error_px=found.error_px,
            left_px=found.left_px,
            remount=None if found.remount is None else RemountData(**asdict(found.remount)),
            levels=tuple(CheckedLevelData(**asdict(level)) for level in found.levels),
            corrected_table_id=corrected_table_id,
            reason=found.reason,
        )


class EngineRestored(Event):
    """The engine has its values back as they were found, but for those that the job leaves in it on purpose."""

    kind: Literal["engine_restored"] = "engine_restored"
    engine: str


class EngineDirty(Event):
    """The engine's values could not be put back; the next job does so first."""

    kind: Literal["engine_dirty"] = "engine_dirty"
    engine: str
    reason: Reason


class JobDone(Event):
    """The job is done and what it makes is stored. The job's last event."""

    kind: Literal["job_done"] = "job_done"
    table_id: int | None = Field(description="the table's id, as in GET /api/v1/tables/{id}; null: it makes none")


class JobFailed(Event):
    """The job came to nothing. The job's last event."""

    kind: Literal["job_failed"] = "job_failed"
    reason: Reason


class JobCancelling(Event):
    """Somebody cancelled the job; its engine is being given back."""

    kind: Literal["job_cancelling"] = "job_cancelling"


class JobCancelled(Event):
    """The job was cancelled; what it finished before is kept. The job's last event."""

    kind: Literal["job_cancelled"] = "job_cancelled"


class Note(Event):
    """Something worth knowing that changes nothing."""

    kind: Literal["note"] = "note"
    text: Reason


AnyEvent = Annotated[
    JobQueued
    | JobStarted
    | LevelsPlanned
    | LevelStarted
    | CaptureAsked
    | TargetFound
    | PictureRefused
    | LevelProgress
    | LevelDone
    | LevelFailed
    | EngineLearned
    | PlaceChecked
    | Published
    | Rechecked
    | EngineRestored
    | EngineDirty
    | JobDone
    | JobFailed
    | JobCancelling
    | JobCancelled
    | Note,
    Field(discriminator="kind"),
]

EVENTS: TypeAdapter[AnyEvent] = TypeAdapter(AnyEvent)

TERMINAL_KINDS = frozenset({"job_done", "job_failed", "job_cancelled"})
"""After one of these nothing more happens to the job."""


class EventMessage(BaseModel):
    """An event as clients get it: these fields and those of its kind (``docs/reference/events.md``)."""

    model_config = ConfigDict(frozen=True, extra="allow")

    seq: int = Field(description="counts the job's events without gaps from 1")
    at: datetime
    kind: str
    job_id: str
    number: int = Field(description="orders the events of all jobs")


def make(kind: str, **data: Any) -> AnyEvent:
    """The event of ``kind`` with these fields. Raises :class:`pydantic.ValidationError`."""
    return EVENTS.validate_python({"kind": kind, **data})


def draft(event: AnyEvent) -> EventDraft:
    """The event as the store takes it."""
    return event.kind, event.model_dump(mode="json", exclude={"kind"})


def parse(record: EventRecord) -> AnyEvent:
    """The stored event, typed. Raises :class:`pydantic.ValidationError` for a kind that this version does not know."""
    return EVENTS.validate_python({**record.data, "kind": record.kind})


def message(record: EventRecord) -> dict[str, Any]:
    """The stored event as clients get it; kinds that this version does not know pass through."""
    envelope = {
        "seq": record.seq,
        "at": format_utc(record.at),
        "kind": record.kind,
        "job_id": record.job_id,
        "number": record.number,
    }
    return {**envelope, **record.data, **envelope}  # it comes first, and no field of a kind replaces it


def schema_text() -> str:
    """``docs/reference/events.schema.json``: what clients get, the common fields and those of each kind."""
    schema = EVENTS.json_schema(mode="serialization")
    envelope: dict[str, Any] = EventMessage.model_json_schema()["properties"]
    envelope.pop("kind")
    for kind in get_args(get_args(AnyEvent)[0]):
        definition = schema["$defs"][kind.__name__]
        definition["properties"] |= envelope
        definition["required"] = sorted({*envelope, *definition.get("required", ()), "kind"})
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "An event of a Lensmatch job"}
    return json.dumps({**head, **schema}, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


class Wakeups:
    """One listener's flag. Clear it, then read the store, then wait: what comes in between wakes at once."""

    def __init__(self) -> None:
        self._flag = asyncio.Event()

    def clear(self) -> None:
        self._flag.clear()

    def set(self) -> None:
        self._flag.set()

    async def wait(self, timeout_s: float) -> bool:
        """Wait until something may have happened; False when ``timeout_s`` passed first."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._flag.wait()
        except TimeoutError:
            return False
        return True


class EventBroker:
    """Wakes listeners of one job or of all jobs. For the event loop's thread only; holds nothing once they left."""

    def __init__(self, limit: int = 200) -> None:
        self._limit = limit
        self._listeners: dict[str | None, set[Wakeups]] = {}
        self._count = 0

    @property
    def listeners(self) -> int:
        """How many listen now."""
        return self._count

    def notify(self, job_id: str) -> None:
        """Something of this job was committed. Never blocks, never fails."""
        for key in (job_id, None):
            for listener in self._listeners.get(key, ()):
                listener.set()

    @contextlib.contextmanager
    def listen(self, job_id: str | None) -> Iterator[Wakeups]:
        """Listen to one job, or to all (None). Raises :class:`TooManyListeners`."""
        if self._count >= self._limit:
            raise TooManyListeners(self._limit)
        wakeups = Wakeups()
        self._listeners.setdefault(job_id, set()).add(wakeups)
        self._count += 1
        try:
            yield wakeups
        finally:
            self._count -= 1
            of_job = self._listeners[job_id]
            of_job.discard(wakeups)
            if not of_job:
                del self._listeners[job_id]
