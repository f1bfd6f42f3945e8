"""The evidence of a level as a JSON document, and its inputs read back, so that a level can be solved again.

Floats are written in full (17 digits), so that what is solved from a stored document is what was solved first. The map
of expected overlay error is not stored: it follows from the lens and its covariance.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibration import tables
from calibration.errors import CalibrationError
from calibration.solve.evidence import LevelEvidence, LevelInputs
from calibration.solve.mistakes import Priors, Verdict
from calibration.solve.problem import View
from calibration.types import CameraPose, Detection, Quality, Target, TargetKind, TargetPose
from storage.errors import BadDocument

EVIDENCE_VERSION = 1
EVIDENCE_FILE = "evidence.json"
_VERDICTS = (Verdict.SHOWN, Verdict.NOT_SHOWN, Verdict.UNTOLD)

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Triple = tuple[Number, Number, Number]
Pair = tuple[Number, Number]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class TargetPoseDocument(_Document):
    """Where the target stood, as surveyed."""

    centre_m: Triple
    yaw_deg: Number
    pitch_deg: Number
    roll_deg: Number
    sigma_m: Number
    sigma_deg: Number


class CameraPoseDocument(_Document):
    """Where the camera stood, as the encoders told."""

    pivot_m: Triple
    pan_deg: Number
    tilt_deg: Number
    roll_deg: Number
    sigma_m: Number
    sigma_deg: Number
    roll_sigma_deg: Number | None = None


class PriorsDocument(_Document):
    """How large mistakes of board, encoders and camera may be, standard deviations; bow_m null: by default."""

    bow_m: Number | None = None
    pan_scale: Number = 0.0
    tilt_scale: Number = 0.0
    pan_offset_deg: Number = 0.0
    tilt_offset_deg: Number = 0.0
    roll_offset_deg: Number = 0.0
    off_axis_mm: Number = 0.0


class TargetDocument(_Document):
    """What was looked for."""

    kind: TargetKind
    squares: tuple[int, int] | None
    square_m: Number | None
    size_m: Pair | None
    diameter_m: Number | None
    pose: TargetPoseDocument | None


class PictureInputDocument(_Document):
    """A picture's measured points with their covariances, and its poses."""

    name: str
    target: str
    sha256: str | None = Field(description="of the picture's bytes as they came, hexadecimal")
    camera_pose: CameraPoseDocument | None
    points: tuple[tuple[int, Number, Number, Number, Number, Number], ...] = Field(
        description="point number, u, v (px), covariance uu, uv, vv (px^2)"
    )
    centre_px: Pair
    blur_px: Number | None


class LeftOutDocument(_Document):
    """A picture that never came to the fit, and why."""

    picture: str
    reason: str


class InputsDocument(_Document):
    """All that the level was solved from."""

    image_size: tuple[int, int]
    pixel_aspect: Number
    nodal_offset_mm: Number
    nodal_sigma_mm: Number
    priors: PriorsDocument = PriorsDocument()
    targets: dict[str, TargetDocument]
    pictures: tuple[PictureInputDocument, ...]
    left_out: tuple[LeftOutDocument, ...]
    versions: dict[str, str]


class LensDocument(_Document):
    """The fitted lens."""

    f_px: Number
    k1: Number
    k2: Number
    center_shift_px: Pair
    nodal_offset_mm: Number


class NoiseDocument(_Document):
    """RMS per coordinate that the detector promises, that the residuals have, and the floor added to the former."""

    expected_px: Number
    found_px: Number
    floor_px: Number


class ErrorDocument(_Document):
    """An error in px."""

    rms: Number
    max: Number


class PictureEvidenceDocument(_Document):
    """A picture in the fit; p_value: chance of a larger chi2."""

    name: str
    points: int
    used: int
    rms_px: Number | None
    chi2: Number
    dof: Number
    p_value: Number | None
    held_out_px: ErrorDocument | None


class OutlierDocument(_Document):
    """A point left out of the fit; null: the lens cannot draw it."""

    picture: str
    point: int
    distance_px: Number | None
    sigmas: Number | None


class CoverageDocument(_Document):
    """Points in each of 8 x 5 cells of the frame, and how far out they reach."""

    cells: tuple[tuple[int, ...], ...]
    share: Number
    radius_share: Number
    corner_px: Number | None


class TestDocument(_Document):
    """A test of the lens model; size_px: what the missing term would change at most in the frame."""

    name: str
    statistic: Number
    dof: int
    p_value: Number
    size_px: Number | None


class MisfitDocument(_Document):
    """Whether the lens model suits the pictures."""

    flagged: bool
    sentence: str
    radial_px: Number
    tangential_px: Number
    neighbours: Number
    tests: tuple[TestDocument, ...]


class MistakeDocument(_Document):
    """A possible mistake of survey, board, head or camera, in its unit; prior_sigma: how large it was taken to be."""

    name: str
    subject: str = Field(description="the target it belongs to; empty: the head's or the camera's")
    unit: str
    estimate: Number
    sigma: Number | None
    prior_sigma: Number
    verdict: Literal["shown", "not shown", "cannot be told"]


class ParallaxDocument(_Document):
    """The operator's no-parallax check: how far a near thing moves against a far one while the camera pans, px."""

    near_m: Number
    far_m: Number
    pan_deg: Number
    as_given_px: Number
    sigma_px: Number


class EvidenceDocument(_Document):
    """What a level's numbers rest on (version 1 of the format)."""

    model_config = ConfigDict(title="Lensmatch level evidence")

    level_evidence: Literal[1]
    zoom: Number
    focus: Number
    lens: LensDocument
    parameters: tuple[str, ...]
    covariance: tuple[tuple[Number, ...], ...]
    correlation: tuple[tuple[Number, ...], ...]
    noise: NoiseDocument
    chi2: Number
    dof: Number
    pictures: tuple[PictureEvidenceDocument, ...]
    outliers: tuple[OutlierDocument, ...]
    outlier_share: Number
    coverage: CoverageDocument
    fold_margin: Number | None = Field(description="fold radius over the frame's corner radius; null: never folds")
    misfit: MisfitDocument
    mistakes: tuple[MistakeDocument, ...] = Field(default=(), description="those shown first")
    parallax: ParallaxDocument | None = None
    inputs: InputsDocument


def evidence_schema_text() -> str:
    """The JSON Schema of a level's evidence, as it stands in ``docs/reference/level-evidence.schema.json``."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **EvidenceDocument.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def evidence_to_document(evidence: LevelEvidence) -> dict[str, Any]:
    """The JSON document of a level's evidence; what is no finite number is null."""
    lens, inputs, misfit = evidence.lens, evidence.inputs, evidence.misfit
    return {
        "level_evidence": EVIDENCE_VERSION,
        "zoom": float(inputs.zoom),
        "focus": float(inputs.focus),
        "lens": {
            "f_px": lens.f_px,
            "k1": lens.k1,
            "k2": lens.k2,
            "center_shift_px": list(lens.center_shift_px),
            "nodal_offset_mm": lens.nodal_offset_mm,
        },
        "parameters": list(evidence.parameters),
        "covariance": evidence.covariance.tolist(),
        "correlation": evidence.correlation.tolist(),
        "noise": _plain(evidence.noise, "expected_px", "found_px", "floor_px"),
        "chi2": evidence.chi2,
        "dof": evidence.dof,
        "pictures": [
            _plain(picture, "name", "points", "used", "rms_px", "chi2", "dof", "p_value")
            | {"held_out_px": None if picture.held_out_px is None else _plain(picture.held_out_px, "rms", "max")}
            for picture in evidence.pictures
        ],
        "outliers": [_plain(outlier, "picture", "point", "distance_px", "sigmas") for outlier in evidence.outliers],
        "outlier_share": evidence.outlier_share,
        "coverage": {
            "cells": evidence.coverage.cells.tolist(),
            **_plain(evidence.coverage, "share", "radius_share", "corner_px"),
        },
        "fold_margin": _finite(evidence.fold_margin),
        "misfit": {
            "flagged": misfit.flagged,
            "sentence": misfit.sentence(),
            **_plain(misfit, "radial_px", "tangential_px", "neighbours"),
            "tests": [_plain(test, "name", "statistic", "dof", "p_value", "size_px") for test in misfit.tests],
        },
        "mistakes": [
            _plain(mistake, "name", "subject", "unit", "estimate", "sigma", "prior_sigma")
            | {"verdict": mistake.verdict.value}
            for mistake in sorted(evidence.mistakes, key=lambda mistake: _VERDICTS.index(mistake.verdict))
        ],
        "parallax": None if evidence.parallax is None else asdict(evidence.parallax),
        "inputs": _inputs(inputs),
    }


def summary_of(evidence: LevelEvidence) -> tables.EvidenceSummary:
    """The evidence in short, as it stands in the lens table."""
    worst = min(evidence.pictures, key=lambda picture: math.inf if math.isnan(picture.p_value) else picture.p_value)
    missing = evidence.misfit.missing
    return tables.EvidenceSummary(
        noise_floor_px=evidence.noise.floor_px,
        worst_picture=worst.name,
        worst_picture_p=_finite(worst.p_value),
        coverage_share=evidence.coverage.share,
        radius_share=evidence.coverage.radius_share,
        fold_margin=_finite(evidence.fold_margin),
        misfit=None if missing is None else missing.name,
        misfit_px=None if missing is None else missing.size_px,
        mistakes=tuple(str(mistake) for mistake in evidence.mistakes if mistake.verdict is Verdict.SHOWN),
        inputs_sha256=hashlib.sha256(canonical_text(_inputs(evidence.inputs)).encode()).hexdigest(),
    )


def _inputs(inputs: LevelInputs) -> dict[str, Any]:
    return {
        "image_size": list(inputs.image_size),
        **_plain(inputs, "pixel_aspect", "nodal_offset_mm", "nodal_sigma_mm"),
        "priors": asdict(inputs.priors),
        "targets": {view.target_name: _target(view.target) for view in inputs.views},
        "pictures": [_picture(view, inputs.picture_sha256.get(view.name)) for view in inputs.views],
        "left_out": [{"picture": left.picture, "reason": left.reason} for left in inputs.left_out],
        "versions": dict(inputs.versions),
    }


def _target(target: Target) -> dict[str, Any]:
    pose = target.pose
    angles = ("yaw_deg", "pitch_deg", "roll_deg", "sigma_m", "sigma_deg")
    return {
        "kind": target.kind.value,
        "squares": _list(target.squares),
        "square_m": target.square_m,
        "size_m": _list(target.size_m),
        "diameter_m": target.diameter_m,
        "pose": None if pose is None else {"centre_m": list(pose.centre_m), **_plain(pose, *angles)},
    }


def _picture(view: View, sha256: str | None) -> dict[str, Any]:
    found, pose = view.detection, view.camera_pose
    angles = ("pan_deg", "tilt_deg", "roll_deg", "sigma_m", "sigma_deg", "roll_sigma_deg")
    return {
        "name": view.name,
        "target": view.target_name,
        "sha256": sha256,
        "camera_pose": None if pose is None else {"pivot_m": list(pose.pivot_m), **_plain(pose, *angles)},
        "points": [
            [int(number), float(u), float(v), float(C[0, 0]), float(C[0, 1]), float(C[1, 1])]
            for number, (u, v), C in zip(found.point_ids, found.points_px, found.covariance_px2, strict=True)
        ],
        "centre_px": [float(value) for value in found.centre_px],
        "blur_px": _finite(found.blur_px),
    }


def inputs_of(document: object) -> LevelInputs:
    """What a stored level was solved from. Raises :class:`BadDocument`."""
    try:
        read = EvidenceDocument.model_validate(document)
        return _read_inputs(read)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise BadDocument(
            f"level evidence, {place}", first["msg"], "put back the document as it was written"
        ) from error
    except CalibrationError as error:
        raise BadDocument("level evidence", str(error), "put back the document as it was written") from error


def _read_inputs(read: EvidenceDocument) -> LevelInputs:
    given = read.inputs
    targets = {name: _read_target(target) for name, target in given.targets.items()}
    views = []
    for picture in given.pictures:
        if picture.target not in targets:
            raise BadDocument(f"level evidence, {picture.name}", f"no target {picture.target!r}", "put it back")
        table = np.array(picture.points, dtype=np.float64).reshape(-1, 6)
        covariance = table[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
        target = targets[picture.target]
        blur_px = math.nan if picture.blur_px is None else picture.blur_px
        found = Detection(
            target.kind,
            table[:, 1:3].copy(),
            table[:, 0].astype(np.int64),
            covariance,
            np.array(picture.centre_px),
            blur_px,
            Quality(1.0),
        )
        pose = None if picture.camera_pose is None else CameraPose(**picture.camera_pose.model_dump())
        views.append(View(picture.name, picture.target, target, found, pose))
    return LevelInputs(
        read.zoom,
        read.focus,
        given.image_size,
        tuple(views),
        given.pixel_aspect,
        given.nodal_offset_mm,
        given.nodal_sigma_mm,
        Priors(**given.priors.model_dump()),
        tuple(tables.LeftOut(left.picture, left.reason) for left in given.left_out),
        {picture.name: picture.sha256 for picture in given.pictures if picture.sha256 is not None},
        given.versions,
    )


def _read_target(read: TargetDocument) -> Target:
    pose = None if read.pose is None else TargetPose(**read.pose.model_dump())
    return Target(read.kind, read.squares, read.square_m, read.size_m, read.diameter_m, pose=pose)


def _plain(value: object, *names: str) -> dict[str, Any]:
    return {name: _finite(getattr(value, name)) for name in names}


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _list(value: tuple[Any, ...] | None) -> list[Any] | None:
    return None if value is None else list(value)


def evidence_path(table: Path) -> Path:
    """Where a lens table's evidence lies: ``NAME.evidence.json`` beside ``NAME.json``."""
    return table.with_name(f"{table.stem}.{EVIDENCE_FILE}")


def evidence_file(levels: Iterable[Mapping[str, Any]]) -> bytes:
    """The file that lies beside a lens table: ``{"evidence": 1, "levels": [...]}``, each as the schema says."""
    return canonical_text({"evidence": EVIDENCE_VERSION, "levels": list(levels)}).encode() + b"\n"


def canonical_text(document: Mapping[str, Any]) -> str:
    """The document as compact text, floats in full, no NaN (ValueError)."""
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
