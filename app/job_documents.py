"""Jobs of every kind as documents: what is posted, stored and run. ``kind`` tells them apart.

A document without ``kind`` is a calibration, as all were before there were kinds. A further kind is a further model
here, in :data:`AnyJob` and :data:`KINDS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, PlainValidator, TypeAdapter, model_validator

from app.documents import (
    Finite,
    JobRequest,
    LevelModel,
    Name,
    NotNegative,
    Positive,
    PriorsModel,
    Strict,
    TableId,
    TargetModel,
    Unit,
    check_room,
    read_table,
)
from calibration.surface.recheck import GOAL_PX
from calibration.tables import LensTable
from storage.schemas import LensTableDocument

CALIBRATE = "calibrate"
"""The kind of a document that names none."""


class PublishOptions(Strict):
    """How a lens table goes to an engine: for which place, and what its render is compared with."""

    engine: Name = Field(default="default", description="name of the studio profile's engine; one job at a time on it")
    zoom: Unit | None = Field(
        default=None, description="place whose lens stays in the engine; null: where the head's encoders stand"
    )
    focus: Unit | None = Field(default=None, description="given together with zoom")
    all_levels: bool = Field(
        default=False, description="first write, read back and compare every level of the table, then the place"
    )
    targets: dict[Name, TargetModel] = Field(
        default_factory=dict,
        description="surveyed targets that renders are compared by; none: those of the job that made the table, and "
        "without those no render is compared",
    )
    pivot_m: tuple[Finite, Finite, Finite] | None = Field(
        default=None, description="where the camera's pivot stands; given together with targets"
    )
    learn_engine: bool = Field(
        default=False,
        description="learn how the engine draws first and ask it for what its camera needs; false: a level's "
        "engine_values, else the lens itself as the studio profile converts it",
    )
    limit_px: Positive | None = Field(
        default=None, description="largest distance between render and prediction; null: what detection explains"
    )

    @model_validator(mode="after")
    def _belongs_together(self) -> PublishOptions:
        if (self.zoom is None) != (self.focus is None):
            raise ValueError("zoom and focus are given together, or neither")
        if bool(self.targets) != (self.pivot_m is not None):
            raise ValueError("targets and pivot_m are given together, or neither")
        if self.pivot_m is not None:
            check_room(self.targets, self.pivot_m)
        return self

    @property
    def place(self) -> tuple[float, float] | None:
        """(zoom, focus) as asked for, None: where the head stands."""
        return None if self.zoom is None or self.focus is None else (self.zoom, self.focus)


class _OfTable(Strict):
    """Base of jobs about one lens table: a stored one, or one that comes along."""

    table_id: TableId | None = Field(default=None, description="a stored lens table")
    table: LensTableDocument | None = Field(default=None, description="the lens table itself, instead of table_id")

    @model_validator(mode="after")
    def _has_a_table(self) -> Self:
        if (self.table_id is None) == (self.table is None):
            raise ValueError("give either table_id or table")
        self.to_table()
        return self

    def to_table(self) -> LensTable | None:
        """The table that came with the job, None for a stored one. Raises ValueError for one that is no lens table."""
        return None if self.table is None else read_table(self.table, "table")


class PublishRequest(PublishOptions, _OfTable):
    """A job that writes a lens table to an engine, reads it back and compares a render with it."""

    job: Literal[1] = 1
    kind: Literal["publish"]


class RecheckRequest(_OfTable):
    """A job that measures a stored lens again at a few places and says whether it still holds."""

    job: Literal[1] = 1
    kind: Literal["recheck"]
    engine: Name = Field(default="default", description="name of the studio profile's engine; one job at a time on it")
    levels: list[LevelModel] = Field(
        default_factory=list,
        max_length=20,
        description="places to measure, two or three are enough; none: near both ends of the zoom and where the table "
        "is known least between, at the middle focus",
    )
    targets: dict[Name, TargetModel] = Field(
        default_factory=dict, description="surveyed targets; none: those of the job that made the table, with its room"
    )
    pivot_m: tuple[Finite, Finite, Finite] | None = Field(
        default=None, description="where the camera's pivot stands; given together with targets"
    )
    pivot_sigma_m: NotNegative = 0.0
    angle_sigma_deg: NotNegative = Field(default=0.0, description="the head's encoders, one sigma")
    roll_sigma_deg: NotNegative | None = Field(
        default=None, description="the head's roll from picture to picture, one sigma; null: as the other angles"
    )
    priors: PriorsModel = PriorsModel()
    goal_px: Positive = Field(default=GOAL_PX, description="overlay error up to which the stored lens holds")
    max_views: Annotated[int, Field(ge=2, le=100)] = 6
    store: bool = Field(
        default=False, description="store a corrected table as a new version, not approved; needs table_id"
    )

    @model_validator(mode="after")
    def _can_be_checked(self) -> Self:
        if bool(self.targets) != (self.pivot_m is not None):
            raise ValueError("targets and pivot_m are given together, or neither")
        if self.pivot_m is not None:
            check_room(self.targets, self.pivot_m)
        else:
            alone = [name for name in _ROOM if getattr(self, name) != type(self).model_fields[name].default]
            if alone:
                raise ValueError(f"{alone[0]} is given together with targets and pivot_m")
        if self.store and self.table_id is None:
            raise ValueError("store needs table_id: a corrected table is stored as a version of a stored one")
        places = [(level.zoom, level.focus) for level in self.levels]
        for index, place in enumerate(places):
            if place in places[:index]:
                raise ValueError(f"levels[{index}] (zoom {place[0]:g}, focus {place[1]:g}) is listed twice")
        return self


_ROOM = ("pivot_sigma_m", "angle_sigma_deg", "roll_sigma_deg", "priors")

KINDS: Mapping[str, type[JobRequest] | type[PublishRequest] | type[RecheckRequest]] = {
    CALIBRATE: JobRequest,
    "publish": PublishRequest,
    "recheck": RecheckRequest,
}
"""The model of each kind of job."""


def _by_kind(document: Any) -> Any:
    if isinstance(document, (JobRequest, PublishRequest, RecheckRequest)):
        return document
    if not isinstance(document, Mapping):
        raise ValueError("a job is a JSON object")
    kind = document.get("kind", CALIBRATE)
    model = KINDS.get(kind) if isinstance(kind, str) else None
    if model is None:
        raise ValueError(f"kind {str(kind)[:40]!r} is not known; there are {', '.join(KINDS)}")
    # Its errors keep the names of their fields.
    return model.model_validate(document)


AnyJob = Annotated[
    JobRequest | PublishRequest | RecheckRequest,
    PlainValidator(_by_kind, json_schema_input_type=JobRequest | PublishRequest | RecheckRequest),
]
"""A job of any kind, validated by the model of its kind."""


_JOBS: TypeAdapter[JobRequest | PublishRequest | RecheckRequest] = TypeAdapter(AnyJob)


def parse_job(document: Mapping[str, Any]) -> JobRequest | PublishRequest | RecheckRequest:
    """A job as it was stored. Raises :class:`pydantic.ValidationError`."""
    return _JOBS.validate_python(dict(document))


def kind_of(document: Mapping[str, Any]) -> str:
    """The kind of a stored job."""
    return str(document.get("kind", CALIBRATE))
