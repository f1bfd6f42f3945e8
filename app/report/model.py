"""What a report is made from."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from calibration.compare import Overlay, predicted_overlay
from calibration.lens import Lens
from calibration.solve.iteration import LevelFit
from calibration.tables import LensTable, LevelResult, LevelStatus
from storage.records import PictureKind


@dataclass(frozen=True, slots=True, eq=False)
class LevelReport:
    """A level's result and what there is to show beside it.

    ``truth`` and ``error`` (overlay error of the result against it) where the truth is known, as in a simulated
    studio. ``pictures``: encoded JPEG or PNG files. ``fit``: the fit itself where the caller has it.
    ``evidence``: its evidence as a document (:mod:`storage.evidence`).
    """

    result: LevelResult
    truth: Lens | None = None
    error: Overlay | None = None
    pictures: Mapping[PictureKind, bytes] = field(default_factory=dict)
    fit: LevelFit | None = None
    evidence: Mapping[str, Any] | None = None

    @property
    def key(self) -> tuple[float, float]:
        """(zoom, focus)."""
        return self.result.zoom, self.result.focus

    @property
    def failed(self) -> bool:
        return self.result.status is LevelStatus.FAILED

    def expected(self) -> Overlay | None:
        """The map of expected overlay error, where the fit is known and says it."""
        if self.fit is None or self.failed:
            return None
        return predicted_overlay(self.fit.lens, self.fit.covariance)

    def badness_px(self) -> float:
        """For finding the worst level: the true overlay error, else the expected one, else infinity."""
        if self.failed:
            return math.inf
        if self.error is not None:
            return self.error.max_px
        predicted = self.result.predicted_overlay_px
        return predicted.max if predicted is not None else math.inf


@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    """A lens table with its levels' evidence.

    ``facts``: (what, value) lines for the head of the report. ``truth_at``: the true lens between the levels, for the
    faint lines of the charts. ``truth_name``: what the truth is called in sentences.
    """

    title: str
    table: LensTable
    levels: list[LevelReport]
    facts: list[tuple[str, str]]
    truth_at: Callable[[float, float], Lens] | None = None
    truth_name: str = "the simulated truth"
