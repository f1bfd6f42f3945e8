"""The documents that people write: picture sets and jobs, checked field by field.

A mistake becomes one line: which field, what is wrong with it, what to write instead. Names, units and meanings
are those of ``docs/reference``. Fields that are not known are refused in a job; in a picture set only those that look
like a misspelt one are (other tools add their own).
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from calibration.camera import target_rotation
from calibration.errors import CalibrationError
from calibration.solve.mistakes import Priors
from calibration.surface.plan import PlanOptions
from calibration.tables import LensTable
from calibration.types import CameraPose, Role, Target, TargetKind, TargetPose
from storage.errors import BadDocument
from storage.schemas import LensTableDocument, document_to_table

_NEAREST_M = 0.01
_EDGE_ON = 0.05
# Cosine of 87 degrees: seen flatter than that, no pattern can be read.

MAX_DOCUMENT_BYTES = 16 * 1024 * 1024
"""Largest JSON document read: a set of 100,000 pictures stays below it."""

_LIKELY_MISSPELT = 0.8
# Likeness (difflib) above which an unknown field is taken for a misspelt one; others are somebody else's.


def _printable(name: str) -> str:
    if not name.strip() or not name.isprintable():
        raise ValueError("must be printable characters, not only blanks")
    return name


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Side = Annotated[int, Field(ge=16, le=32768)]
Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]
FileName = Annotated[str, Field(min_length=1, max_length=1000)]
Unit = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
TableId = Annotated[int, Field(ge=1, le=2**53)]


class DocumentError(Exception):
    """A document that cannot be used. One line: which file, which field, what is wrong."""


class _Loose(BaseModel):
    """Unknown fields are somebody else's and left alone, unless they look like a misspelt one of ours."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _no_misspelt_fields(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for name in data:
                known = cls.model_fields
                like = difflib.get_close_matches(str(name), known, n=1, cutoff=_LIKELY_MISSPELT)
                if name not in known and like:
                    raise ValueError(f"field {name!r} is not known; is {like[0]!r} meant?")
        return data


class Strict(BaseModel):
    """Base of documents in which a field that is not known is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TargetPoseModel(_Loose):
    """Where a target stands (see ``docs/explanations/conventions.md``); ``sigma_*`` missing: exact."""

    centre_m: tuple[Finite, Finite, Finite]
    yaw_deg: Finite = 0.0
    pitch_deg: Finite = 0.0
    roll_deg: Finite = 0.0
    sigma_m: NotNegative = 0.0
    sigma_deg: NotNegative = 0.0


class TargetModel(_Loose):
    """A target: ``chessboard`` (``squares``, ``square_m``), ``square`` (``size_m``) or ``light`` (``diameter_m``)."""

    kind: TargetKind
    squares: tuple[int, int] | None = None
    square_m: Positive | None = None
    size_m: tuple[Positive, Positive] | None = None
    diameter_m: Positive | None = None
    colours: tuple[str, ...] = ()
    pose: TargetPoseModel | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> TargetModel:
        try:
            self.to_target()
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self

    def to_target(self) -> Target:
        pose = None
        if self.pose is not None:
            given = self.pose
            pose = TargetPose(
                given.centre_m, given.yaw_deg, given.pitch_deg, given.roll_deg, given.sigma_m, given.sigma_deg
            )
        return Target(self.kind, self.squares, self.square_m, self.size_m, self.diameter_m, tuple(self.colours), pose)


class CameraPoseModel(_Loose):
    """Where the camera's pivot stood and how it was turned; ``sigma_*`` missing: exact."""

    pivot_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    pan_deg: Finite = 0.0
    tilt_deg: Finite = 0.0
    roll_deg: Finite = 0.0
    sigma_m: NotNegative = 0.0
    sigma_deg: NotNegative = 0.0
    roll_sigma_deg: NotNegative | None = None

    def to_pose(self) -> CameraPose:
        return CameraPose(
            self.pivot_m,
            self.pan_deg,
            self.tilt_deg,
            self.roll_deg,
            self.sigma_m,
            self.sigma_deg,
            self.roll_sigma_deg,
        )


class PriorsModel(_Loose):
    """How large the mistakes of board, head and camera may be, one sigma; 0: there is none."""

    bow_m: NotNegative | None = Field(
        default=None,
        description="how far the middle of a board may stand out of its plane; null: 1 % of a hand-held board's side",
    )
    pan_scale: NotNegative = Field(default=0.0, description="relative error of the pan encoder")
    tilt_scale: NotNegative = Field(default=0.0, description="relative error of the tilt encoder")
    pan_offset_deg: NotNegative = Field(default=0.0, description="error of its zero")
    tilt_offset_deg: NotNegative = Field(default=0.0, description="error of its zero")
    roll_offset_deg: NotNegative = Field(default=0.0, description="of the head's roll, or of the sensor in the camera")
    off_axis_mm: NotNegative = Field(default=0.0, description="the pupil beside the pivot's axis, right and down")

    def to_priors(self) -> Priors:
        return Priors(**self.model_dump())


class PictureModel(_Loose):
    """One picture of a set, and what is known of it."""

    file: FileName
    zoom: Unit = 0.0
    focus: Unit = 0.0
    target: Name
    role: Role = Role.FREE
    camera_pose: CameraPoseModel | None = None


class PictureSet(_Loose):
    """``set.json`` of a folder of pictures."""

    picture_set: Literal[1]
    lens: Name = "unnamed lens"
    camera: Name = "unnamed camera"
    image_size: tuple[Side, Side]
    sensor_mm: tuple[Positive, Positive] | None = None
    pixel_aspect: Positive = 1.0
    transfer: Literal["bt709", "srgb", "linear"] | None = None
    targets: dict[Name, TargetModel] = Field(min_length=1)
    priors: PriorsModel = PriorsModel()
    pictures: list[PictureModel] = Field(min_length=1)

    @model_validator(mode="after")
    def _targets_exist(self) -> PictureSet:
        for index, picture in enumerate(self.pictures):
            if picture.target not in self.targets:
                known = ", ".join(sorted(self.targets))
                raise ValueError(f"pictures[{index}].target {picture.target!r} is not in targets ({known})")
        seen: set[tuple[str, str]] = set()
        for index, picture in enumerate(self.pictures):
            if (picture.file, picture.target) in seen:
                raise ValueError(
                    f"pictures[{index}] lists {picture.file!r} with target {picture.target!r} a second time; remove it"
                )
            seen.add((picture.file, picture.target))
        return self


class LevelModel(Strict):
    """One level: encoder values 0..1 (zoom 0 wide, 1 tele; focus 0 infinity, 1 near)."""

    zoom: Unit
    focus: Unit


def _check_faces(name: str, pose: TargetPoseModel, pivot_m: tuple[float, float, float]) -> None:
    """Refuse a target that the camera, wherever it is turned, sees from behind or edge-on, or that it stands in."""
    to_camera = np.asarray(pivot_m) - np.asarray(pose.centre_m)
    distance_m = float(np.linalg.norm(to_camera))
    into_board = target_rotation(pose.yaw_deg, pose.pitch_deg, pose.roll_deg)[:, 2]
    if distance_m < _NEAREST_M:
        raise ValueError(f"targets.{name}.pose.centre_m {pose.centre_m} is where the camera stands ({pivot_m})")
    if float(-into_board @ to_camera) < _EDGE_ON * distance_m:
        raise ValueError(
            f"targets.{name} turns its back to the camera: it is behind it, or its yaw is wrong (at yaw 0 a target "
            "faces -Y, towards a camera at smaller Y)"
        )


def check_room(targets: Mapping[str, TargetModel], pivot_m: tuple[float, float, float]) -> None:
    """Refuse targets that an engine cannot draw where they stand, or the camera never sees. Raises ValueError."""
    for name, target in targets.items():
        if target.pose is None:
            raise ValueError(f"targets.{name}.pose is missing: an engine's target needs its surveyed place")
        _check_faces(name, target.pose, pivot_m)


def read_table(document: LensTableDocument, field: str) -> LensTable:
    """The lens table that stands in a job. Raises ValueError for one that is no lens table."""
    try:
        return document_to_table(document.model_dump(mode="json"))
    except BadDocument as error:
        raise ValueError(f"{field}: {error}") from error


class PlanModel(Strict):
    """Levels chosen where the overlay error between them is expected to be worst, until it is small enough."""

    accuracy_px: Positive | None = Field(
        default=1.0, description="largest overlay error wanted between levels; null: as good as the levels allow"
    )
    max_levels: Annotated[int, Field(ge=2, le=200)] = 13
    max_minutes: Positive | None = Field(default=None, description="of measuring; null: no limit")
    zoom_range: tuple[Unit, Unit] = (0.0, 1.0)
    focus_range: tuple[Unit, Unit] = Field(default=(0.5, 0.5), description="lowest and highest; equal: one focus")

    def to_options(self) -> PlanOptions:
        """For the planner. Raises :class:`calibration.errors.InvalidInput`."""
        return PlanOptions(
            self.accuracy_px,
            self.max_levels,
            None if self.max_minutes is None else 60 * self.max_minutes,
            self.zoom_range,
            self.focus_range,
        )

    @model_validator(mode="after")
    def _can_be_planned(self) -> PlanModel:
        try:
            self.to_options()
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self


class JobRequest(Strict):
    """A calibration job for an engine: which lens, which levels, what stands in the room."""

    job: Literal[1] = 1
    kind: Literal["calibrate"] = "calibrate"
    lens: Name
    camera: Name = "Cam0"
    engine: Name = Field(default="default", description="name of the studio profile's engine; one job at a time on it")
    method: Literal["joint", "alternating"] = "joint"
    image_size: tuple[Side, Side] = (1920, 1080)
    sensor_mm: tuple[Positive, Positive] | None = None
    pixel_aspect: Positive = 1.0
    levels: list[LevelModel] = Field(
        default_factory=list, max_length=1000, description="a fixed grid of levels; none: plan chooses them"
    )
    plan: PlanModel | None = Field(
        default=None, description="chooses the levels as it goes, instead of levels; null: the levels are listed"
    )
    start_from: TableId | LensTableDocument | None = Field(
        default=None,
        description="lens table that levels start from, of this lens or one of its type and of the same picture: the "
        "id of a stored one, or the table itself",
    )
    targets: dict[Name, TargetModel] = Field(min_length=1, description="surveyed targets: each needs its pose")
    pivot_m: tuple[Finite, Finite, Finite] = Field(description="where the camera's pivot stands")
    pivot_sigma_m: NotNegative = 0.0
    angle_sigma_deg: NotNegative = Field(default=0.0, description="the head's encoders, one sigma")
    roll_sigma_deg: NotNegative | None = Field(
        default=None, description="the head's roll from picture to picture, one sigma; null: as the other angles"
    )
    priors: PriorsModel = PriorsModel()
    nodal_offset_mm: Finite = Field(default=0.0, description="pivot to entrance pupil; stands unless contradicted")
    nodal_sigma_mm: NotNegative = Field(default=0.0, description="how well it is known; more than 0: only a prior")
    learn_engine: bool = Field(
        default=True,
        description="learn how the engine draws from about eight renders before the first level; false: the studio "
        "profile is taken at its word, and each level's render alone tells whether it is right",
    )
    goal_px: Positive = Field(default=0.03, description="largest expected overlay error at which pictures stop")
    max_views: Annotated[int, Field(ge=2, le=100)] = 12

    @model_validator(mode="after")
    def _can_be_measured(self) -> JobRequest:
        check_room(self.targets, self.pivot_m)
        if bool(self.levels) == (self.plan is not None):
            raise ValueError("give either levels or plan: one of them says what is measured")
        seen: set[tuple[float, float]] = set()
        for index, level in enumerate(self.levels):
            if (level.zoom, level.focus) in seen:
                raise ValueError(f"levels[{index}] (zoom {level.zoom:g}, focus {level.focus:g}) is listed twice")
            seen.add((level.zoom, level.focus))
        if isinstance(self.start_from, LensTableDocument):
            read_table(self.start_from, "start_from")
        return self


def schema_text(model: type[BaseModel]) -> str:
    """A document's JSON Schema as it stands in ``docs/reference``."""
    return json.dumps(model.model_json_schema(), indent=1, sort_keys=True) + "\n"


def one_line(error: ValidationError) -> str:
    """The first thing wrong with a document, as ``field: what``, and how many more there are."""
    problems = error.errors(include_url=False)
    first = problems[0]
    field = ".".join(str(part) if str(part).isprintable() else repr(part) for part in first["loc"])
    message = str(first["msg"]).removeprefix("Value error, ")
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{field}: {message}{more}" if field else f"{message}{more}"


def _read_json(path: Path) -> object:
    try:
        if path.stat().st_size > MAX_DOCUMENT_BYTES:
            raise DocumentError(
                f"{path}: larger than {MAX_DOCUMENT_BYTES // 2**20} MiB; this is not a document of ours"
            )
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DocumentError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise DocumentError(f"{path}: is a folder, not a file") from error
    except UnicodeDecodeError as error:
        raise DocumentError(f"{path}: not a UTF-8 text file") from error
    except OSError as error:
        raise DocumentError(f"{path}: cannot be read ({error.strerror or error})") from error
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise DocumentError(f"{path}: not JSON, line {error.lineno} column {error.colno}: {error.msg}") from error
    except RecursionError as error:
        raise DocumentError(f"{path}: nested too deeply; this is not a document of ours") from error


def read_picture_set(folder: Path) -> PictureSet:
    """The picture set in ``folder`` (or the ``set.json`` itself). Raises :class:`DocumentError`."""
    if folder.is_dir() and not (folder / "set.json").exists():
        raise DocumentError(f"{folder}: has no set.json; a picture set is a folder with one, see the how-to")
    if not folder.exists() and folder.suffix != ".json":
        raise DocumentError(f"{folder}: no such folder; a picture set is a folder with a set.json")
    path = folder / "set.json" if folder.is_dir() else folder
    try:
        return PictureSet.model_validate(_read_json(path))
    except ValidationError as error:
        raise DocumentError(f"{path}: {one_line(error)}") from error


def read_job(path: Path) -> JobRequest:
    """The job in ``path``. Raises :class:`DocumentError`."""
    try:
        return JobRequest.model_validate(_read_json(path))
    except ValidationError as error:
        raise DocumentError(f"{path}: {one_line(error)}") from error
