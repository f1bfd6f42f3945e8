"""The study's own alternating method (its chapters 4.1 to 4.3), as an ask/tell object: the baseline of benchmarks.

Four real pictures of a level: the target in the middle gives the centre shift, at the side the field of view, at the
edge k1, in the corner k2. A coefficient is found by trial renders: it is set in the engine, the corners of the render
are compared with those of the real picture, and it is moved down the slope of their distance. An alignment holds when
NO corner deviates by more than a threshold.

1. FoV and k1 in turn. If all holds, the corner's picture included, k2 is 0: scenario 1.
2. Else k2, FoV and k1 in turn until all holds: scenario 2.
3. If they come to a standstill before: a forced step of k1, and again: scenario 3.

It is tuned so that it does what the principle allows. Where the study is silent: the first picture's target size
starts the field of view; slopes are remembered from one search to the next; each search goes on to its lowest point
and the rounds to their standstill, because at the threshold alone four lenses of ten miss the study's goals; the
corner is looked at before k2 is called 0; and FoV takes part in the rounds with k2, because the one found without k2
is biased by it. Edge and corner lie close together, so that k1 and k2 stand in for each other and the rounds creep:
about 25 renders in scenario 1, 100 in scenario 2, up to 400 where the target spans much of the picture.
"""

from __future__ import annotations

import numpy as np

from calibration.errors import CalibrationError, InvalidInput, NotEnoughData
from calibration.solve.alternating_pictures import AlternatingSettings, Trial
from calibration.solve.alternating_stages import Procedure
from calibration.solve.search import Capture, LevelTask, Observation
from calibration.tables import LevelResult, LevelStatus, PixelError

__all__ = ["AlternatingMethod", "AlternatingSettings"]

_NO_UNCERTAINTY = "the alternating method gives no uncertainty"
_USUAL_PICTURES = 60.0


class AlternatingMethod:
    """The study's method for one level; implements :class:`calibration.solve.search.LevelMethod`.

    Asks for one picture at a time. A level that fails comes back from :meth:`result` as a failed one with its reason,
    so that the pictures left out are kept; a level whose corners stay apart by more than the threshold but are
    usable is degraded.
    """

    def __init__(self, task: LevelTask, settings: AlternatingSettings | None = None) -> None:
        self._task = task
        self._settings = settings or AlternatingSettings()
        self._procedure = Procedure(task, self._settings)
        self._stages = self._procedure.run()
        self._failure: CalibrationError | None = None
        self._done = False
        self._wanted: Capture | None = None
        self._pending: Capture | None = None
        try:
            self._wanted = next(self._stages)
        except CalibrationError as error:
            self._finish(error)

    @property
    def done(self) -> bool:
        return self._done

    @property
    def progress(self) -> float:
        """How far the level is, from the pictures taken: how many it will need cannot be known."""
        taken = self._procedure.pictures.steps
        return 1.0 if self._done else taken / (taken + _USUAL_PICTURES)

    def ask(self) -> Capture | None:
        capture, self._wanted = self._wanted, None
        if capture is not None:
            self._pending = capture
        return capture

    def tell(self, observation: Observation) -> None:
        """Raises :class:`InvalidInput` for an observation that was not asked for."""
        if self._pending is None or observation.step != self._pending.step:
            raise InvalidInput("observation step", observation.step, "is not the picture that was asked for")
        self._pending = None
        try:
            self._wanted = self._stages.send(observation)
        except StopIteration:
            self._finish(None)
        except CalibrationError as error:
            self._finish(error)

    def _finish(self, failure: CalibrationError | None) -> None:
        self._failure = failure
        self._done = True

    def result(self) -> LevelResult:
        """The level, failed ones with their reason. Raises :class:`NotEnoughData` before :attr:`done`."""
        if not self._done:
            raise NotEnoughData("the level is not finished: tell the pictures that were asked for first")
        procedure, task = self._procedure, self._task
        trials = [view.last for view in procedure.views.values() if view.last is not None]
        left_out = tuple(procedure.pictures.left_out)
        reason = str(self._failure) if self._failure is not None else procedure.apart
        furthest_px = max((trial.worst_px for trial in trials), default=float("inf"))
        if reason is not None and (self._failure is not None or furthest_px > self._settings.usable_px):
            return LevelResult.failed(task.zoom, task.focus, reason, left_out=left_out)
        apart = _pixel_error(trials)
        reasons = {"held_out_px": "every picture takes part in the search", "predicted_overlay_px": _NO_UNCERTAINTY}
        if task.nodal_offset_mm == 0:
            reasons["nodal_offset_mm"] = "the alternating method does not measure it; 0 mm was assumed"
        return LevelResult.from_lens(
            task.zoom,
            task.focus,
            procedure.lens,
            status=LevelStatus.OK if reason is None else LevelStatus.DEGRADED,
            reason=reason,
            reasons=reasons,
            residual_px=apart,
            engine_overlay_px=apart,
            scenario=procedure.scenario,
            left_out=left_out,
        )


def _pixel_error(trials: list[Trial]) -> PixelError:
    """The last renders against the real corners: RMS per coordinate, and the furthest corner's distance."""
    errors = np.concatenate([trial.errors_px[np.isfinite(trial.errors_px[:, 0])] for trial in trials])
    return PixelError(float(np.sqrt(np.mean(errors**2))), max(trial.worst_px for trial in trials))
