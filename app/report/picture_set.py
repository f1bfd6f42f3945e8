"""The report of a set of pictures that was calibrated without an engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from app.jobs.pictures import jpeg, residual_picture
from app.picture_sets import SetLevel
from app.report.model import LevelReport, RunReport
from calibration.solve.iteration import LevelFit
from calibration.tables import LensTable
from storage.evidence import evidence_to_document
from storage.records import PictureKind


def picture_set_report(
    title: str, table: LensTable, levels: Sequence[SetLevel], facts: Sequence[tuple[str, str]] = ()
) -> RunReport:
    """A report from what :func:`app.picture_sets.calibrate_set` gives; CPU work of a few ms a level (arrows)."""
    shown = [
        LevelReport(
            level.result,
            pictures=_pictures(level.fit, table.image_size),
            fit=level.fit,
            evidence=None if level.evidence is None else evidence_to_document(level.evidence),
        )
        for level in levels
    ]
    return RunReport(title, table, shown, list(facts))


def _pictures(fit: LevelFit | None, image_size: tuple[int, int]) -> Mapping[PictureKind, bytes]:
    if fit is None:
        return {}
    pairs = [(view.points_px[view.used], view.residual_px[view.used]) for view in fit.views if view.used.any()]
    return {PictureKind.RESIDUALS: jpeg(residual_picture(pairs, image_size))} if pairs else {}
