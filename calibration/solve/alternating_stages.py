"""The stages of the study's alternating method (its chapters 4.2 and 4.3): one coefficient at a time, by renders.

Nothing here knows the engine's camera model: a coefficient is set, the render is looked at, and the coefficient is
moved along the slope seen between two renders.
"""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum

import numpy as np

from calibration.lens import Lens, fov_to_f_px
from calibration.solve.alternating_pictures import AlternatingSettings, Pictures, Steps, Stopped, Trial, View
from calibration.solve.search import LevelTask
from calibration.types import FloatArray, Role

_FIRST_MOVE = {"fov_x_deg": 0.002, "k1": 0.008, "k2": 0.004}
# First move of a coefficient to see its slope: FoV as a share of itself, k1 and k2 with radius 1 at half the
# picture's width. Each moves the corners at its place by 1 to 5 px at 1080p, if the engine means what we mean.
_FORCED_STEP = 0.004
# First forced step of k1 (scenario 3), in the same unit: about 1 px at its place.
_LONGEST_MOVE = 0.02
# A step moves the corners by at most this share of the picture's width, so that they stay inside its margin.
_MOVES = 12
_HALVINGS = 4
_PROBES = 8
_RELATIVE_SETTLED = 0.02
# While a view is far off for another coefficient's sake, its own need not be found closer than this share of it.
_TRUST_SLOPE = 10.0
# A slope is renewed from a step that moved the corners by this many times their noise.


_FOV_RANGE_DEG = (0.05, 170.0)
# Only a field of view that has no effect in the engine is moved as far as this.
_PLACES = (Role.FOV, Role.K1, Role.K2)


class Coefficient(StrEnum):
    """What is searched for, one at a time."""

    FOV = "fov_x_deg"
    K1 = "k1"
    K2 = "k2"


class Procedure:
    """One level by the study's procedure; :meth:`run` is the whole of it, the attributes are what came of it.

    ``lens`` is the lens so far, ``views`` the pictures, ``scenario`` the study's, ``apart`` None or why the corners
    stayed apart.
    """

    def __init__(self, task: LevelTask, settings: AlternatingSettings) -> None:
        self._task = task
        self._settings = settings
        self.pictures = Pictures(task, settings)
        self.lens = Lens(task.image_size, float(task.image_size[0]))
        self.views: dict[Role, View] = {}
        self.scenario: int | None = None
        self.apart: str | None = None
        self._units: dict[Coefficient, float] = {}
        self._best: Lens | None = None

    def run(self) -> Steps[None]:
        """The level from its first picture to its last. Raises :class:`CalibrationError` when it fails."""
        self.lens = yield from self.pictures.centre()
        self._set_units()
        try:
            yield from self._coefficients()
        except Stopped as stopped:
            self.apart = str(stopped)
            if len(self.views) < len(_PLACES):
                raise
            yield from self._last_look()

    def _last_look(self) -> Steps[None]:
        """After a search that could not go on: the views with the best lens so far, so that its worth is known."""
        if self._best is not None:
            self.lens = self._best
        self.pictures.max_trials += len(self.views)
        for view in self.views.values():
            if (yield from self.pictures.trial(view, self.lens)) is None:
                raise Stopped(f"{self.apart}, and the render lost the target")

    def _set_units(self) -> None:
        half_width = self.lens.half_width
        self._units = {
            Coefficient.FOV: self.lens.fov_x_deg,
            Coefficient.K1: 1 / half_width**2,
            Coefficient.K2: 1 / half_width**4,
        }
        if self._task.guess is not None:
            self.lens = replace(self.lens, k1=self._task.guess.k1_hw * self._units[Coefficient.K1])

    def _coefficients(self) -> Steps[None]:
        side = yield from self._take(Role.FOV)
        yield from self._search(Coefficient.FOV, side)
        edge = yield from self._take(Role.K1)
        yield from self._settle(((Coefficient.K1, edge), (Coefficient.FOV, side)))
        yield from self._take(Role.K2)
        if (yield from self._all_hold()):
            self.scenario = 1
            return
        self.scenario = 2
        yield from self._with_k2()

    def _take(self, role: Role) -> Steps[View]:
        view = yield from self.pictures.view(role, self.lens)
        self.views[role] = view
        return view

    # --- rounds --------------------------------------------------------------------------------------------------

    def _settle(self, turns: tuple[tuple[Coefficient, View], ...]) -> Steps[float]:
        """The coefficients in turn until a round moves the corners no more; returns how far k1 went in the last round
        that moved it."""
        k1_move = 0.0
        while True:
            k1_before = self.lens.k1
            moved_px = 0.0
            for coefficient, view in turns:
                moved_px += yield from self._search(coefficient, view)
            k1_move = self.lens.k1 - k1_before or k1_move
            if moved_px < self._settings.standstill_px:
                return k1_move

    def _with_k2(self) -> Steps[None]:
        """k2 and k1 in turn, with FoV, until all hold; where they stand still before, a forced step of k1 and again."""
        turns = (
            (Coefficient.K2, self.views[Role.K2]),
            (Coefficient.FOV, self.views[Role.FOV]),
            (Coefficient.K1, self.views[Role.K1]),
        )
        k1_move = yield from self._settle(turns)
        if (yield from self._all_hold()):
            return
        self.scenario = 3
        best_px, best = self._furthest_px(), self.lens
        self._best = best
        step = float(np.copysign(_FORCED_STEP * self._units[Coefficient.K1], k1_move))
        for _ in range(self._settings.max_forced_steps):
            self.lens = replace(best, k1=best.k1 + step)
            seen = yield from self._all_seen()
            if seen:
                yield from self._settle(turns)
                if (yield from self._all_hold()):
                    return
            if seen and (reached_px := self._furthest_px()) < best_px:
                best_px, best = reached_px, self.lens
                self._best = best
                step *= 2
            else:
                step *= -0.7
        self.lens = best
        yield from self._all_hold()
        forced = self._settings.max_forced_steps
        self.apart = f"a corner stays {self._furthest_px():.2f} px apart after {forced} forced steps of k1"

    def _all_seen(self) -> Steps[bool]:
        for view in self.views.values():
            if (yield from self.pictures.trial(view, self.lens)) is None:
                return False
        return True

    def _holds(self, trial: Trial) -> bool:
        return trial.worst_px <= max(self._settings.threshold_px, self._settings.noise_factor * trial.sigma_px)

    def _all_hold(self) -> Steps[bool]:
        """Whether, with the lens as it stands, no corner of any view deviates by more than the threshold."""
        trials = []
        for view in self.views.values():
            trials.append((yield from self.pictures.trial(view, self.lens)))
        return all(trial is not None and self._holds(trial) for trial in trials)

    def _furthest_px(self) -> float:
        return max(view.last.worst_px for view in self.views.values() if view.last is not None)

    # --- one coefficient -----------------------------------------------------------------------------------------

    def _search(self, coefficient: Coefficient, view: View) -> Steps[float]:
        """Moves one coefficient to where its view's corners lie best; returns how far the furthest corner went, px.

        Descent on the mean squared corner distance: the slope is that between two renders, a step goes to the lowest
        point it promises and is halved while the render is not better. Raises :class:`Stopped` when the render
        shows no target any more.
        """
        here = yield from self.pictures.trial(view, self.lens)
        if here is None:
            raise Stopped(f"the render lost the target in the search for {coefficient.value}")
        start = here
        slope = view.slopes.get(coefficient)
        if slope is None:
            slope, there = yield from self._first_slope(coefficient, view, here)
            if there.rms_px < here.rms_px:
                here, self.lens = there, there.lens
        for _ in range(_MOVES):
            slope_rms = float(np.sqrt(np.nanmean(slope**2)))
            step = -float(np.nansum(slope * here.errors_px) / np.nansum(slope[np.isfinite(here.errors_px)] ** 2))
            longest = _LONGEST_MOVE * self._task.image_size[0] / slope_rms
            step = min(max(step, -longest), longest)
            if abs(step) * slope_rms < max(self._settings.settled_px, _RELATIVE_SETTLED * here.rms_px):
                break
            better = yield from self._step(coefficient, view, here, step)
            if better is None:
                break
            taken = self._value(better.lens, coefficient) - self._value(here.lens, coefficient)
            if abs(taken) * slope_rms > _TRUST_SLOPE * here.sigma_px:
                slope = (better.errors_px - here.errors_px) / taken
            here, self.lens = better, better.lens
        view.slopes[coefficient] = slope
        return float(np.sqrt(np.nanmax(np.sum((here.errors_px - start.errors_px) ** 2, axis=1))))

    def _step(self, coefficient: Coefficient, view: View, here: Trial, step: float) -> Steps[Trial | None]:
        """The step, or the first of its halves that makes the render better; None when none does."""
        for _ in range(_HALVINGS):
            there = yield from self.pictures.trial(view, self._moved(here.lens, coefficient, step))
            if there is not None and there.rms_px < here.rms_px:
                return there
            step /= 2
        return None

    def _first_slope(self, coefficient: Coefficient, view: View, here: Trial) -> Steps[tuple[FloatArray, Trial]]:
        """d(errors_px)/d(coefficient) from a first move, made smaller when it loses the target, larger when it is lost
        in the noise; and the render after it."""
        move = _FIRST_MOVE[coefficient.value] * self._units[coefficient]
        for _ in range(_PROBES):
            there = yield from self.pictures.trial(view, self._moved(here.lens, coefficient, move))
            if there is None:
                move /= -4
                continue
            difference = there.errors_px - here.errors_px
            if float(np.sqrt(np.nanmean(difference**2))) > _TRUST_SLOPE * here.sigma_px:
                return difference / move, there
            move *= 4
        raise Stopped(
            f"{coefficient.value} cannot be found: no move of it, up to {abs(move):.3g}, changes the engine's render "
            "visibly; check the export's name in the studio profile"
        )

    def _value(self, lens: Lens, coefficient: Coefficient) -> float:
        return float(getattr(lens, coefficient.value))

    def _moved(self, lens: Lens, coefficient: Coefficient, by: float) -> Lens:
        if coefficient is Coefficient.K1:
            return replace(lens, k1=lens.k1 + by)
        if coefficient is Coefficient.K2:
            return replace(lens, k2=lens.k2 + by)
        low, high = _FOV_RANGE_DEG
        fov_x_deg = min(max(lens.fov_x_deg + by, low), high)
        return replace(lens, f_px=fov_to_f_px(fov_x_deg, lens.image_size[0]))
