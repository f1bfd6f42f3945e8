"""In which order the levels of a job are measured, and what a level starts from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

from app.documents import JobRequest
from calibration.lens import Lens
from calibration.solve.engine_model import IDENTITY, EngineModel
from calibration.solve.search import LevelTask
from calibration.surface import LensSurface
from calibration.surface.plan import in_order
from calibration.tables import LevelResult, LevelStatus

_NODAL_CHANGE_MM = 100.0
# How much the pupil of a zoom lens moves between neighbouring levels, generously.


class LevelPlan(Protocol):
    """Which levels a job measures, and in which order: an ask/tell object, called in threads, one call at a time.

    ``reason``: why it is done, None while it is not or where there is nothing to say.
    """

    reason: str | None

    def ask(self) -> list[tuple[float, float]]:
        """The levels (zoom, focus) to measure next, in this order; empty: the plan is done.

        Asked for again only when every level given before was told, failed ones too. The first answer has at least
        one level.
        """
        ...

    def tell(self, result: LevelResult) -> None:
        """What came of a level that was asked for."""
        ...


class SweepPlan:
    """Every level that was listed, in the order of :func:`calibration.surface.plan.in_order`."""

    def __init__(self, levels: Sequence[tuple[float, float]]) -> None:
        self._left = in_order(levels)
        self.reason: str | None = None

    def ask(self) -> list[tuple[float, float]]:
        """All of them, once."""
        asked, self._left = self._left, []
        return asked

    def tell(self, result: LevelResult) -> None:
        """Changes nothing: the levels were given."""


def guess_from(done: Iterable[LevelResult], zoom: float, request: JobRequest) -> Lens | None:
    """The lens of a finished level at the same zoom: focus changes the view by a few percent only.

    Levels at another zoom are no guess: nothing is known yet of how far the view changes between them.
    """
    for result in done:
        if result.zoom == zoom and result.status is not LevelStatus.FAILED and result.fov_x_deg is not None:
            return result.lens(request.image_size, request.pixel_aspect)
    return None


def last_measured(done: Sequence[LevelResult], request: JobRequest) -> Lens | None:
    """The lens of the level measured last, or None."""
    measured = [result for result in done if result.fov_x_deg is not None]
    return measured[-1].lens(request.image_size, request.pixel_aspect) if measured else None


def level_task(
    request: JobRequest,
    zoom: float,
    focus: float,
    done: Sequence[LevelResult],
    engine: EngineModel = IDENTITY,
    prior: LensSurface | None = None,
) -> LevelTask:
    """What a method must know of one level of a job, after the levels ``done``, on an engine that draws so.

    Once a level has shown that the pupil is not where the job says, no later one may take it to be there: the nodal
    offset then starts from the level measured last, as a prior. ``prior``: the lens as another table has it; it is the
    guess where no level of the job is a better one, and its nodal offset stands where the job states none.
    """
    nodal = [result.nodal_offset_mm for result in done if result.nodal_offset_mm is not None]
    guess, stated_mm = guess_from(done, zoom, request), request.nodal_offset_mm
    if prior is not None:
        known = prior.at(zoom, focus)
        guess = guess or known.lens
        if known.nodal_told and stated_mm == 0 and request.nodal_sigma_mm == 0:
            stated_mm = known.lens.nodal_offset_mm
    return LevelTask(
        zoom=zoom,
        focus=focus,
        image_size=request.image_size,
        targets={name: model.to_target() for name, model in request.targets.items()},
        pivot_m=request.pivot_m,
        pixel_aspect=request.pixel_aspect,
        pivot_sigma_m=request.pivot_sigma_m,
        angle_sigma_deg=request.angle_sigma_deg,
        roll_sigma_deg=request.roll_sigma_deg,
        priors=request.priors.to_priors(),
        nodal_offset_mm=nodal[-1] if nodal else stated_mm,
        nodal_sigma_mm=max(_NODAL_CHANGE_MM, request.nodal_sigma_mm) if nodal else request.nodal_sigma_mm,
        guess=guess,
        neighbour=last_measured(done, request),
        engine=engine,
    )
