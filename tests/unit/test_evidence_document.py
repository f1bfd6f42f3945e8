"""The evidence as a document: valid by its own schema, and enough to solve the level again."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest

from calibration.lens import Lens
from calibration.solve.evidence import LevelInputs, level_evidence, solve_again
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.mistakes import Priors
from calibration.solve.outcome import level_result
from calibration.solve.problem import View
from calibration.synthetic import observe
from calibration.tables import LeftOut
from calibration.types import CameraPose, Detection, Target, TargetKind, TargetPose
from storage.errors import BadDocument
from storage.evidence import canonical_text, evidence_schema_text, evidence_to_document, inputs_of
from storage.schemas import level_to_document

SIZE = (1920, 1080)
LENS = Lens.from_fov(SIZE, 58.0, -0.15, 0.04, (3.4, -2.2))
BOARD = Target(TargetKind.CHESSBOARD, squares=(9, 7), square_m=0.1, pose=TargetPose((0.0, 5.0, 1.6), sigma_m=0.001))


def some_inputs() -> LevelInputs:
    rng = np.random.default_rng(5)
    views = []
    for pan, tilt in [(0, 0), (-20, 0), (20, 0), (-18, 9), (18, -9), (-18, -9), (18, 9)]:
        pose = CameraPose((0.0, 0.0, 1.6), pan, tilt)
        seen = observe(LENS, pose, BOARD, rng, 0.02)
        assert isinstance(seen, Detection)
        views.append(View(f"{pan},{tilt}", "board", BOARD, seen, replace(pose, sigma_deg=0.002, roll_sigma_deg=0.01)))
    hashes = {view.name: "ab" * 32 for view in views}
    left_out = (LeftOut("dark.png", "no target"),)
    return LevelInputs(
        0.25, 0.5, SIZE, tuple(views), 1.0, 0.0, 0.0, Priors(pan_scale=0.002), left_out, hashes, {"numpy": "2"}
    )


def test_a_level_is_solved_again_from_the_stored_document_alone() -> None:
    inputs = some_inputs()
    fit = solve_level(inputs.views, SIZE, priors=inputs.priors)
    held_out = held_out_residuals(fit, inputs.views)
    result = level_result(fit, inputs.zoom, inputs.focus, held_out=held_out, left_out=inputs.left_out)
    document = evidence_to_document(level_evidence(fit, inputs, held_out))
    text = canonical_text(document)
    jsonschema.validate(json.loads(text), json.loads(evidence_schema_text()))
    read = inputs_of(json.loads(text))
    assert read.picture_sha256 == inputs.picture_sha256
    assert read.versions == inputs.versions
    first, again = level_to_document(result), level_to_document(solve_again(read))
    assert _numbers(again) == pytest.approx(_numbers(first), rel=1e-9, abs=1e-12)
    assert again["left_out"] == first["left_out"]
    assert again["reasons"] == first["reasons"]


def test_a_damaged_document_is_one_clear_error() -> None:
    inputs = some_inputs()
    fit = solve_level(inputs.views, SIZE, priors=inputs.priors)
    document = evidence_to_document(level_evidence(fit, inputs, {}))
    document["inputs"]["pictures"][0]["points"][0][1] = "far"
    with pytest.raises(BadDocument, match=r"level evidence, inputs\.pictures\.0\.points\.0\.1"):
        inputs_of(document)


def _numbers(value: object) -> list[float]:
    if isinstance(value, dict):
        return [number for part in value.values() for number in _numbers(part)]
    if isinstance(value, list):
        return [number for part in value for number in _numbers(part)]
    return [float(value)] if isinstance(value, (int, float)) else []
