"""The lens table: what a calibration leaves behind, level by level.

Frozen values only; how a table becomes JSON, CSV or a database row is the business of ``storage``. The fields are
those of ``docs/reference/lens-table.schema.json``. A quantity that could not be told from the pictures is ``None``
with its reason in ``LevelResult.reasons``, never a guess.

The lens itself is ``fov_x_deg``, ``k1``, ``k2`` (focal-length units), ``center_shift_px`` and ``nodal_offset_mm``;
``fov_y_deg``, ``f_px``, ``k1_hw`` and ``k2_hw`` say the same in other units (:class:`calibration.lens.Lens`) and are
checked against them, loosely enough for a table that a person has rounded.
"""

from __future__ import annotations

from calibration.tables.checks import MAX_NAME_LENGTH
from calibration.tables.level import EVIDENCE_QUANTITIES, LENS_QUANTITIES, MIN_FOV_DEG, REASON_KEYS, LevelResult
from calibration.tables.parts import (
    SIGMA_PARAMETERS,
    EngineValues,
    EvidenceSummary,
    Frames,
    Interpolation,
    LeftOut,
    LevelStatus,
    Parallax,
    PixelError,
    Provenance,
    Sigma,
)
from calibration.tables.table import MAX_PICTURE_SIDE_PX, LensTable, other_picture

__all__ = [
    "EVIDENCE_QUANTITIES",
    "LENS_QUANTITIES",
    "MAX_NAME_LENGTH",
    "MAX_PICTURE_SIDE_PX",
    "MIN_FOV_DEG",
    "REASON_KEYS",
    "SIGMA_PARAMETERS",
    "EngineValues",
    "EvidenceSummary",
    "Frames",
    "Interpolation",
    "LeftOut",
    "LensTable",
    "LevelResult",
    "LevelStatus",
    "Parallax",
    "PixelError",
    "Provenance",
    "Sigma",
    "other_picture",
]
