"""The evidence of a level as text to be stored, with the versions of what made it."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

from calibration.errors import CalibrationError
from calibration.solve.evidence import LevelEvidence, LevelInputs, level_evidence
from calibration.solve.iteration import LevelFit
from calibration.solve.level import held_out_residuals
from calibration.solve.problem import View
from calibration.solve.search import LevelTask
from calibration.tables import LeftOut, LevelResult

log = logging.getLogger("lensmatch.jobs")

_MADE_BY = ("lensmatch", "numpy", "scipy", "opencv-python-headless")


@functools.cache
def versions() -> Mapping[str, str]:
    """Versions of the product and of the libraries that a level's numbers depend on."""
    found = {}
    for name in _MADE_BY:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "from its sources"
    return found


def evidence_of_level(
    fit: LevelFit, views: Sequence[View], task: LevelTask, left_out: Sequence[LeftOut], hashes: Mapping[str, str]
) -> LevelEvidence:
    """The evidence of a level that was solved in front of an engine."""
    inputs = LevelInputs(
        task.zoom,
        task.focus,
        task.image_size,
        tuple(views),
        task.pixel_aspect,
        task.nodal_offset_mm,
        task.nodal_sigma_mm,
        task.priors,
        tuple(left_out),
        dict(hashes),
        versions(),
    )
    return level_evidence(fit, inputs, held_out_residuals(fit, views))


def never_seen(result: LevelResult, views: Sequence[View]) -> tuple[LeftOut, ...]:
    """Of what a result left out, the pictures that never came to the fit."""
    names = {view.name for view in views}
    return tuple(left for left in result.left_out if left.picture not in names)


def evidence_or_none(
    fit: LevelFit | None, views: Sequence[View], task: LevelTask, result: LevelResult, hashes: Mapping[str, str]
) -> LevelEvidence | None:
    """The same, None without a fit; a mistake in it must not cost a measured level."""
    if fit is None:
        return None
    try:
        return evidence_of_level(fit, views, task, never_seen(result, views), hashes)
    except CalibrationError as error:
        log.warning("level zoom %g, focus %g has no evidence: %s", task.zoom, task.focus, error)
        return None
