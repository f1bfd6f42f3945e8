"""The lens table as a JSON document: its pydantic model, its JSON Schema, and the way there and back.

Unknown fields are ignored on reading, so that a newer table can be read; NaN and infinities are refused. The rules
that tie fields together (a null has its reason, f_px agrees with fov_x_deg ...) are those of
:mod:`calibration.tables`; here every breach becomes one :class:`storage.errors.BadDocument`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, WithJsonSchema

from calibration import tables
from calibration.errors import CalibrationError
from storage.errors import BadDocument

SCHEMA_VERSION = 1

_Model = TypeVar("_Model", bound=BaseModel)

_UNTOLD = "not told: the document gives no reason"
_REPAIR = "correct it, or export the table again from its source"


def format_utc(moment: datetime) -> str:
    """An aware time as ISO 8601 in UTC with Z, to the microsecond where it has one."""
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def _parse_utc(value: object) -> datetime:
    if isinstance(value, datetime):
        moment = value
    elif isinstance(value, str):
        moment = datetime.fromisoformat(value)
    else:
        raise ValueError("must be a text such as 2026-11-21T10:00:00Z")
    if moment.tzinfo is None:
        raise ValueError("must say its time zone, for example Z for UTC")
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("must lie in the years 1 to 9999 in UTC") from error


def _number(**limits: Any) -> Any:
    return Field(strict=True, allow_inf_nan=False, **limits)


Number = Annotated[float, _number()]
Angle = Annotated[float, _number(ge=tables.MIN_FOV_DEG, lt=180)]
Positive = Annotated[float, _number(gt=0)]
NotNegative = Annotated[float, _number(ge=0)]
Count = Annotated[int, Field(strict=True, ge=0)]
Side = Annotated[int, Field(strict=True, ge=2, le=tables.MAX_PICTURE_SIDE_PX)]
Name = Annotated[str, Field(strict=True, min_length=1, max_length=tables.MAX_NAME_LENGTH)]
Text = Annotated[str, Field(strict=True)]
_Row = tuple[Number, Number, Number, Number, Number]
Correlation = tuple[_Row, _Row, _Row, _Row, _Row]
Moment = Annotated[
    datetime,
    BeforeValidator(_parse_utc),
    WithJsonSchema({"type": "string", "format": "date-time", "examples": ["2026-11-21T10:00:00Z"]}),
]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class PixelErrorDocument(_Document):
    """An error in px of the picture."""

    rms: NotNegative = Field(description="root mean square, px")
    max: NotNegative = Field(description="largest, px")


class SigmaDocument(_Document):
    """Standard deviations (1 sigma), each in its quantity's unit."""

    fov_x_deg: NotNegative | None = None
    k1: NotNegative | None = None
    k2: NotNegative | None = None
    center_shift_px: tuple[NotNegative, NotNegative] | None = None
    nodal_offset_mm: NotNegative | None = None
    correlation: Correlation | None = Field(
        default=None, description=f"of the errors of {', '.join(tables.SIGMA_PARAMETERS)}; null: not kept"
    )


class FramesDocument(_Document):
    """How many pictures a level took."""

    real: Count = Field(default=0, description="of the camera")
    virtual: Count = Field(default=0, description="of the engine's own render")


class EngineValuesDocument(_Document):
    """What the engine is to be told for a level, in these conventions, as the studio profile converts them."""

    fov_x_deg: Number
    k1: Number
    k2: Number
    center_shift_px: tuple[Number, Number]
    nodal_offset_mm: Number


class ParallaxDocument(_Document):
    """How far a near thing moves against a far one while the camera pans, px."""

    near_m: NotNegative
    far_m: NotNegative
    pan_deg: NotNegative = Field(description="the whole pan: the horizontal field of view")
    as_given_px: NotNegative = Field(description="with the nodal offset as it was given")
    sigma_px: NotNegative = Field(description="by one sigma of the nodal offset found")


class EvidenceSummaryDocument(_Document):
    """What a level's numbers rest on, in short; the level's evidence document has the rest."""

    noise_floor_px: NotNegative = Field(description="noise beyond what the detector promises")
    worst_picture: Text = Field(description="the picture whose residuals noise explains least")
    worst_picture_p: NotNegative | None = Field(default=None, description="chance of larger residuals than its")
    coverage_share: NotNegative = Field(description="share of the frame's cells with measured points")
    radius_share: NotNegative = Field(description="farthest point's distance from the centre over the corner's")
    fold_margin: NotNegative | None = Field(default=None, description="fold's radius over the corner's; null: never")
    misfit: Text | None = Field(default=None, description="the term that the lens lacks for certain; null: nothing")
    misfit_px: NotNegative | None = Field(default=None, description="how far the lens is off for it, at most")
    mistakes: tuple[Text, ...] = Field(default=(), description="of survey, board, head and camera, as shown")
    inputs_sha256: Text = Field(description="of the evidence document's inputs as canonical JSON")


class LeftOutDocument(_Document):
    """A picture that the fit did not use, and why."""

    picture: Text
    reason: Text


class InterpolationDocument(_Document):
    """How values between the levels are found."""

    kind: Name
    held_out_px: PixelErrorDocument | None = Field(default=None, description="at levels left out of it, px")


class ProvenanceDocument(_Document):
    """Where a table comes from."""

    source: Name = Field(description="calibrated, imported, corrected, rolled back, ...")
    software: Name = Field(description="name and version of what made it")
    job_id: Text | None = None
    profile: Text | None = Field(default=None, description="the studio profile of its engine")
    profile_sha256: Text | None = None
    inputs_sha256: Text | None = Field(default=None, description="over all levels' inputs, or of the imported file")
    parent_sha256: Text | None = Field(default=None, description="of the table that it was made from")
    note: Text | None = None


class LevelDocument(_Document):
    """One level: a pair of encoder values and what was measured there. null: not told, see reasons."""

    zoom: Number = Field(description="encoder value, 0 wide to 1 tele")
    focus: Number = Field(description="encoder value, 0 infinity to 1 near")
    status: Literal["ok", "degraded", "failed"] = Field(
        description="degraded: usable, with its reason; failed: no numbers, with its reason"
    )
    fov_x_deg: Angle | None = Field(default=None, description="horizontal field of view of the pinhole, degrees")
    fov_y_deg: Annotated[float, _number(gt=0, lt=180)] | None = Field(
        default=None, description="vertical field of view of the pinhole, degrees"
    )
    f_px: Positive | None = Field(default=None, description="horizontal focal length, px")
    k1: Number | None = Field(default=None, description="radius in focal lengths, undistorted to distorted")
    k2: Number | None = Field(default=None, description="radius in focal lengths, undistorted to distorted")
    k1_hw: Number | None = Field(default=None, description="k1 with radius 1 at half the picture's width")
    k2_hw: Number | None = Field(default=None, description="k2 with radius 1 at half the picture's width")
    center_shift_px: tuple[Number, Number] | None = Field(
        default=None, description="principal point minus picture centre, px, right and down"
    )
    nodal_offset_mm: Number | None = Field(
        default=None, description="rotation pivot to entrance pupil, mm, positive towards the scene"
    )
    sigma: SigmaDocument | None = None
    residual_px: PixelErrorDocument | None = Field(default=None, description="real corners against the fitted model")
    held_out_px: PixelErrorDocument | None = Field(default=None, description="the same on pictures left out of the fit")
    predicted_overlay_px: PixelErrorDocument | None = Field(default=None, description="expected from the covariance")
    engine_overlay_px: PixelErrorDocument | None = Field(
        default=None, description="corners of the engine's own last render at the coefficients as published"
    )
    engine_values: EngineValuesDocument | None = Field(
        default=None, description="what the engine is to be told to draw this lens; null: the lens itself"
    )
    parallax: ParallaxDocument | None = Field(
        default=None, description="the operator's no-parallax check, where the nodal offset was measured"
    )
    evidence: EvidenceSummaryDocument | None = Field(
        default=None, description="what the numbers rest on; null: it was not kept"
    )
    scenario: Literal[1, 2, 3] | None = Field(default=None, description="as in the study, chapter 4.3")
    frames: FramesDocument | None = None
    seconds: NotNegative | None = Field(default=None, description="how long the level took")
    left_out: tuple[LeftOutDocument, ...] = ()
    reason: Text | None = Field(default=None, description="why the level is degraded or failed")
    reasons: dict[str, Text] = Field(default={}, description="for each quantity that is null, why")


class LensTableDocument(_Document):
    """A calibrated lens, level by level (version 1 of the format)."""

    model_config = ConfigDict(title="Lensmatch lens table")

    lens_table: Literal[1] = Field(description="version of this format")
    lens: Name
    camera: Name
    version: Annotated[int, Field(strict=True, ge=1)] = Field(description="counts the tables of this lens and camera")
    created: Moment
    image_size: tuple[Side, Side] = Field(description="width, height in px")
    sensor_mm: tuple[Positive, Positive] | None = Field(default=None, description="width, height in mm")
    pixel_aspect: Positive = Field(default=1.0, description="vertical over horizontal focal length in px")
    method: Name = Field(description="how the levels were solved: joint, alternating, ...")
    levels: tuple[LevelDocument, ...] = Field(min_length=1)
    interpolation: InterpolationDocument | None = None
    provenance: ProvenanceDocument | None = Field(default=None, description="null: not kept")


def lens_table_schema_text() -> str:
    """The JSON Schema of the lens table, as it stands in ``docs/reference/lens-table.schema.json``."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **LensTableDocument.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def table_to_document(table: tables.LensTable) -> dict[str, Any]:
    """The JSON document of a table: plain dicts, lists, text and numbers, in the contract's order."""
    document: dict[str, Any] = {
        "lens_table": SCHEMA_VERSION,
        "lens": table.lens,
        "camera": table.camera,
        "version": int(table.version),
        "created": format_utc(table.created),
        "image_size": [int(side) for side in table.image_size],
        "sensor_mm": _pair(table.sensor_mm),
        "pixel_aspect": float(table.pixel_aspect),
        "method": table.method,
        "levels": [level_to_document(level) for level in table.levels],
        "interpolation": None,
    }
    if table.interpolation is not None:
        document["interpolation"] = {
            "kind": table.interpolation.kind,
            "held_out_px": _pixel_error(table.interpolation.held_out_px),
        }
    if table.provenance is not None:
        document["provenance"] = asdict(table.provenance)
    return document


def level_to_document(level: tables.LevelResult) -> dict[str, Any]:
    """The JSON object of one level."""
    sigma = level.sigma
    return {
        "zoom": float(level.zoom),
        "focus": float(level.focus),
        "status": level.status.value,
        "fov_x_deg": _optional(level.fov_x_deg),
        "fov_y_deg": _optional(level.fov_y_deg),
        "f_px": _optional(level.f_px),
        "k1": _optional(level.k1),
        "k2": _optional(level.k2),
        "k1_hw": _optional(level.k1_hw),
        "k2_hw": _optional(level.k2_hw),
        "center_shift_px": _pair(level.center_shift_px),
        "nodal_offset_mm": _optional(level.nodal_offset_mm),
        "sigma": {
            "fov_x_deg": _optional(sigma.fov_x_deg),
            "k1": _optional(sigma.k1),
            "k2": _optional(sigma.k2),
            "center_shift_px": _pair(sigma.center_shift_px),
            "nodal_offset_mm": _optional(sigma.nodal_offset_mm),
            **({} if sigma.correlation is None else {"correlation": [list(row) for row in sigma.correlation]}),
        },
        "residual_px": _pixel_error(level.residual_px),
        "held_out_px": _pixel_error(level.held_out_px),
        "predicted_overlay_px": _pixel_error(level.predicted_overlay_px),
        "engine_overlay_px": _pixel_error(level.engine_overlay_px),
        **({} if level.engine_values is None else {"engine_values": _engine_values(level.engine_values)}),
        **({} if level.parallax is None else {"parallax": asdict(level.parallax)}),
        **({} if level.evidence is None else {"evidence": _evidence(level.evidence)}),
        "scenario": None if level.scenario is None else int(level.scenario),
        "frames": {"real": int(level.frames.real), "virtual": int(level.frames.virtual)},
        "seconds": _optional(level.seconds),
        "left_out": [{"picture": left.picture, "reason": left.reason} for left in level.left_out],
        "reason": level.reason,
        "reasons": dict(level.reasons),
    }


def document_to_table(document: object) -> tables.LensTable:
    """The table of a JSON document (as parsed). Raises :class:`BadDocument` naming the field and what to do.

    What a document leaves out although it follows from the rest (``f_px``, ``fov_y_deg``, ``k1_hw``, ``k2_hw``) is
    filled in; a null without a reason gets one that says so.
    """
    if not isinstance(document, Mapping):
        raise BadDocument("", f"is a {type(document).__name__}, not a JSON object", "is this a lens table file?")
    if "lens_table" not in document:
        raise BadDocument("", 'has no "lens_table" field', "is this a lens table file, of the format named?")
    if document["lens_table"] != SCHEMA_VERSION:
        found = str(document["lens_table"])[:20]
        raise BadDocument(
            "lens_table", f"is version {found}, this program reads {SCHEMA_VERSION}", "use a newer version of it"
        )
    read = validated(LensTableDocument, document)
    levels = tuple(
        _level(level, read.image_size, read.pixel_aspect, f"levels[{index}]") for index, level in enumerate(read.levels)
    )
    interpolation = None
    if read.interpolation is not None:
        held_out_px = _read_pixel_error(read.interpolation.held_out_px)
        interpolation = tables.Interpolation(read.interpolation.kind, held_out_px)
    try:
        return tables.LensTable(
            lens=read.lens,
            camera=read.camera,
            version=read.version,
            created=read.created,
            image_size=read.image_size,
            method=read.method,
            levels=levels,
            sensor_mm=read.sensor_mm,
            pixel_aspect=read.pixel_aspect,
            interpolation=interpolation,
            provenance=tables.Provenance(**read.provenance.model_dump()) if read.provenance else None,
        )
    except CalibrationError as error:
        raise BadDocument("", str(error), _REPAIR) from error


def document_to_level(
    document: object, image_size: tuple[int, int] | None = None, pixel_aspect: float = 1.0
) -> tables.LevelResult:
    """One level of its JSON object; without ``image_size`` nothing that is left out is filled in."""
    return _level(validated(LevelDocument, document), image_size, pixel_aspect, "level")


def _level(
    read: LevelDocument, image_size: tuple[int, int] | None, pixel_aspect: float, place: str
) -> tables.LevelResult:
    values: dict[str, Any] = {name: getattr(read, name) for name in _PLAIN_FIELDS}
    failed = read.status == "failed"
    reasons = {name: why for name, why in read.reasons.items() if name in tables.REASON_KEYS}
    if not failed:
        for name in tables.REASON_KEYS:
            if getattr(read, name) is None:
                reasons[name] = reasons.get(name) or _UNTOLD
    reason = read.reason or (None if read.status == "ok" else _UNTOLD)
    values |= {name: _read_pixel_error(getattr(read, name)) for name in tables.EVIDENCE_QUANTITIES}
    try:
        level = tables.LevelResult(
            status=tables.LevelStatus(read.status),
            sigma=tables.Sigma(**read.sigma.model_dump()) if read.sigma else tables.Sigma(),
            frames=tables.Frames(**read.frames.model_dump()) if read.frames else tables.Frames(),
            parallax=tables.Parallax(**read.parallax.model_dump()) if read.parallax else None,
            evidence=tables.EvidenceSummary(**read.evidence.model_dump()) if read.evidence else None,
            engine_values=tables.EngineValues(**read.engine_values.model_dump()) if read.engine_values else None,
            left_out=tuple(tables.LeftOut(left.picture, left.reason) for left in read.left_out),
            reason=reason,
            reasons=reasons,
            **values,
        )
        return level if image_size is None else level.completed(image_size, pixel_aspect)
    except CalibrationError as error:
        raise BadDocument(place, str(error), _REPAIR) from error


_PLAIN_FIELDS = (
    *("zoom", "focus", "fov_x_deg", "fov_y_deg", "f_px", "k1", "k2", "k1_hw", "k2_hw"),
    *("center_shift_px", "nodal_offset_mm", "scenario", "seconds"),
)


def validated(model: type[_Model], document: object, place: str = "") -> _Model:
    """A part of a document, checked; ``place``: where it stands. Raises :class:`BadDocument`, naming the field."""
    try:
        return model.model_validate(document)
    except ValidationError as error:
        errors = error.errors(include_url=False, include_context=False)
        first = errors[0]
        # A bad level also makes the tuple of levels "too short": that is no error of its own.
        others = sum(other["type"] != "too_short" for other in errors[1:])
        more = f" (and {others} more)" if others else ""
        why = first["msg"][:1].lower() + first["msg"][1:]
        if first["type"] != "missing":
            why += f", not {_shown(first['input'])}"
        raise BadDocument(_place(first["loc"], place), why + more, _REPAIR) from error


def _place(location: Iterable[int | str], place: str = "") -> str:
    for part in location:
        place += f"[{part}]" if isinstance(part, int) else f".{part}" if place else part
    return place


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _optional(value: float | None) -> float | None:
    return None if value is None else float(value)


def _pair(value: tuple[float, float] | None) -> list[float] | None:
    return None if value is None else [float(value[0]), float(value[1])]


def _pixel_error(value: tables.PixelError | None) -> dict[str, float] | None:
    return None if value is None else {"rms": float(value.rms), "max": float(value.max)}


def _evidence(summary: tables.EvidenceSummary) -> dict[str, Any]:
    return asdict(summary) | {"mistakes": list(summary.mistakes)}


def _engine_values(values: tables.EngineValues) -> dict[str, Any]:
    return {
        "fov_x_deg": float(values.fov_x_deg),
        "k1": float(values.k1),
        "k2": float(values.k2),
        "center_shift_px": _pair(values.center_shift_px),
        "nodal_offset_mm": float(values.nodal_offset_mm),
    }


def _read_pixel_error(read: PixelErrorDocument | None) -> tables.PixelError | None:
    return None if read is None else tables.PixelError(read.rms, read.max)
