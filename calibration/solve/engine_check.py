"""The last step of a level in front of an engine: does its render at the values to be published lie on the camera's?

With a learned engine (:mod:`calibration.solve.engine_model`) the values to ask for follow from the lens, and one render
is enough to see that they are right. Where it does not agree, the values are searched on the engine itself: Broyden's
rank-one updates from the model's own derivatives (Broyden 1965), and, where these do not get there, Gauss-Newton with
derivatives by finite differences of renders. The number of renders is bounded, and what is left is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.errors import CalibrationError, NotEnoughData
from calibration.lens import Lens
from calibration.solve.engine_model import EngineModel
from calibration.solve.problem import View
from calibration.types import Detection, DetectionResult, FloatArray, Refusal

AGREES_PX = 0.05
"""RMS per coordinate between the engine's corners and those that its model draws, below which the model is right."""
MOST_RENDERS = 60
_SIGMAS = 4.0
_BROYDEN_STEPS = 7
_NEWTON_STEPS = 6
_MOST_FAILURES = 3
_SEARCH_VIEWS, _ENOUGH_VIEWS = 3, 2
_STARTS = ((1.0, 0.0), (0.3, 0.0), (0.0, 0.0), (0.0, 0.3))
# Where a search begins: share of k1 and k2, log of how much wider.
_STEPS = np.array([2e-3, 4e-3, 4e-3, 2.0, 2.0])
# Finite differences: some px at the picture's edge, far above the corners' noise, far below the model's bends.
_SHARES = (1.0, -1.0, 0.03, -0.03)
# Of those steps: an engine with another unit of the radius may bend the target out of the picture.
_GAIN = 0.9
# A round that leaves more than this share has gained nothing.
_LARGEST = np.array([0.15, 0.1, 0.1, 200.0, 200.0])


@dataclass(frozen=True, slots=True)
class RenderWanted:
    """A render to take: at the pose of ``view``, with ``asked`` set in the engine."""

    view: View
    asked: Lens


@dataclass(frozen=True, slots=True, eq=False)
class EngineAgreement:
    """How the check ended. ``asked``: what the engine is to be told. ``residuals_px``: engine's minus camera's corners
    (N, 2) px of the best renders, one array a pose; ``sigma_px`` how well the engine's corners were found.
    ``trouble``: why the engine's picture is not as near as it should be, empty where it is. ``renders`` taken;
    ``searched``: how the values were found, ``model``, ``Broyden`` or ``finite differences``."""

    asked: Lens
    residuals_px: tuple[FloatArray, ...]
    sigma_px: float
    trouble: str
    renders: int
    searched: str


Program = Generator[RenderWanted, DetectionResult, None]
CornersWanted = Callable[[Lens, View], FloatArray]
"""Where a view's corners (N, 2) px should be when a lens is asked for."""


class EngineCheck:
    """Ask/tell: :meth:`ask` gives the next render wanted, None when done; :meth:`tell` its detection."""

    def __init__(self, lens: Lens, views: Sequence[View], model: EngineModel, *, first_views: int = 1) -> None:
        """``views``: pictures of the camera with known poses, the one to look at first first."""
        self._lens = lens
        self._views = [view for view in views if view.camera_pose is not None and view.target.pose is not None]
        if not self._views:
            raise NotEnoughData("no picture with a known pose is left to compare the engine's render with")
        self._model = model
        self._first_views = self._views[: max(first_views, 1)]
        self._search_views = _spread(self._views)
        self._renders = 0
        self._sigma_px = 0.0
        self._seen: dict[str, Detection] = {}
        self._refused = ""
        self._trouble = ""
        self._searched = "model"
        try:
            self._asked = model.asking_for(lens)
        except CalibrationError as error:
            self._asked, self._trouble = lens, str(error)
        self._program = self._run()
        self._wanted: RenderWanted | None = next(self._program, None)

    @property
    def done(self) -> bool:
        """Whether :meth:`result` can be read."""
        return self._wanted is None

    @property
    def renders(self) -> int:
        """Renders told so far."""
        return self._renders

    def ask(self) -> RenderWanted | None:
        """The render wanted next; the same until it is told."""
        return self._wanted

    def tell(self, seen: DetectionResult) -> None:
        """What was found in the render wanted."""
        self._renders += 1
        try:
            self._wanted = self._program.send(seen)
        except StopIteration:
            self._wanted = None

    def result(self) -> EngineAgreement:
        """How it ended. Raises :class:`NotEnoughData` where the target was found in no render."""
        if not self._seen:
            raise NotEnoughData(f"the target was not found in the engine's render: {self._refused}")
        residuals = tuple(
            matched_px(view.detection, self._seen[view.name]) for view in self._views if view.name in self._seen
        )
        return EngineAgreement(self._asked, residuals, self._sigma_px, self._trouble, self._renders, self._searched)

    def _run(self) -> Program:
        off = yield from self._look(self._asked, self._first_views, self._drawn_by_model)
        if off is None or not self._agrees(off):
            yield from self._search()

    def _look(
        self, asked: Lens, views: Sequence[View], wanted: CornersWanted
    ) -> Generator[RenderWanted, DetectionResult, FloatArray | None]:
        """Engine's corners minus the wanted ones at these poses, (M,) px; None where a target was not found."""
        parts: list[FloatArray] = []
        seen: dict[str, Detection] = {}
        for view in views:
            result = yield RenderWanted(view, asked)
            if isinstance(result, Refusal):
                self._refused = result.reason
                return None
            seen[view.name] = result
            self._sigma_px = max(self._sigma_px, sigma_px(result))
            off = result.points_px - wanted(asked, view)[result.point_ids]
            if not np.isfinite(off).all():
                return None
            parts.append(off.ravel())
        self._seen = seen
        return np.concatenate(parts)

    def _drawn_by_model(self, asked: Lens, view: View) -> FloatArray:
        drawn = self._model.drawn(asked)
        return np.asarray(drawn.project(_rays(view, drawn.lens.nodal_offset_mm)))

    def _wanted_px(self, asked: Lens, view: View) -> FloatArray:
        return np.asarray(self._lens.project(_rays(view, self._lens.nodal_offset_mm)))

    def _agrees(self, off_px: FloatArray) -> bool:
        return rms(off_px) <= max(AGREES_PX, _SIGMAS * self._sigma_px)

    def _search(self) -> Program:
        """From the model's values to ones at which the engine's corners are where the lens puts them."""
        self._searched = "Broyden"
        x, off = yield from self._started(_vector(self._asked))
        if off is None:
            self._seen = {}
            return
        jacobian = self._model_jacobian(x)
        x, off = yield from self._descend(x, off, jacobian, _BROYDEN_STEPS)
        while not self._agrees(off) and self._room_for(len(_STEPS) + 1):
            self._searched = "finite differences"
            before = rms(off)
            slopes = yield from self._slopes(x, off)
            x, off = yield from self._descend(x, off, slopes, _NEWTON_STEPS)
            if rms(off) > _GAIN * before:
                break
        self._asked = self._lens_of(x)
        searched = {view.name for view in self._search_views}
        best = dict(self._seen)
        for view in self._first_views:
            # Values found at some poses must hold at the one that did not agree.
            if view.name not in searched:
                last = yield from self._look(self._asked, [view], self._wanted_px)
                if last is None:
                    self._trouble = f"the target was not found in the engine's render: {self._refused}"
                else:
                    off = np.concatenate([off, last])
                    best |= self._seen
        self._seen = best
        if not self._agrees(off):
            self._trouble = (
                f"the engine's picture could not be brought nearer than {rms(off):.2f} px (RMS) to the camera's in "
                f"{self._renders} renders: its camera bends in a way that its k1 and k2 cannot follow"
            )

    def _started(
        self, asked: FloatArray
    ) -> Generator[RenderWanted, DetectionResult, tuple[FloatArray, FloatArray | None]]:
        """Values to begin with, and how far the engine's corners are off there at the poses where the target is found.

        Where the engine bends the target out of its picture: less of the bend, then a wider view as well. That with the
        most poses is taken: values that suit one place alone may be far from any lens.
        """
        best_x, best_off, best_seen = asked, None, dict[str, Detection]()
        for less_bent, wider in _STARTS:
            x = asked * np.array([1.0, less_bent, less_bent, 1.0, 1.0]) - np.array([wider, 0.0, 0.0, 0.0, 0.0])
            parts: list[FloatArray] = []
            seen: dict[str, Detection] = {}
            for view in self._search_views:
                off = yield from self._look(self._lens_of(x), [view], self._wanted_px)
                if off is not None:
                    parts.append(off)
                    seen |= self._seen
            if len(seen) > len(best_seen):
                best_x, best_off, best_seen = x, np.concatenate(parts), seen
            if len(seen) >= min(_ENOUGH_VIEWS, len(self._search_views)):
                break
        self._seen = best_seen
        self._search_views = [view for view in self._search_views if view.name in best_seen]
        return best_x, best_off

    def _descend(
        self, x: FloatArray, off: FloatArray, jacobian: FloatArray, steps: int
    ) -> Generator[RenderWanted, DetectionResult, tuple[FloatArray, FloatArray]]:
        """Gauss-Newton steps, the derivatives corrected by each render (Broyden's rank-one update); a step after which
        the engine draws nothing that can be measured is taken again at a third of its length."""
        best, share, failures = dict(self._seen), 1.0, 0
        for _ in range(steps):
            if self._agrees(off) or failures > _MOST_FAILURES or not self._room_for(1):
                break
            step = share * _solved(jacobian, off)
            trial = yield from self._look(self._lens_of(x + step), self._search_views, self._wanted_px)
            if trial is None or trial.shape != off.shape:
                share, failures = share / 3, failures + 1
                continue
            change = trial - off - jacobian @ step
            jacobian = jacobian + np.outer(change, step / _STEPS**2) / float(np.sum((step / _STEPS) ** 2))
            if rms(trial) < rms(off):
                x, off, best, share = x + step, trial, dict(self._seen), 1.0
            else:
                failures += 1
        self._seen = best
        return x, off

    def _slopes(self, x: FloatArray, off: FloatArray) -> Generator[RenderWanted, DetectionResult, FloatArray]:
        """Derivatives (M, 5) of the engine's corners by finite differences; 0 where no render can be measured."""
        best = dict(self._seen)
        columns: list[FloatArray] = []
        for index in range(len(_STEPS)):
            column = np.zeros(len(off))
            for share in _SHARES:
                step = np.zeros(len(_STEPS))
                step[index] = share * _STEPS[index]
                moved = yield from self._look(self._lens_of(x + step), self._search_views, self._wanted_px)
                if moved is not None and moved.shape == off.shape:
                    column = (moved - off) / step[index]
                    break
            columns.append(column)
        self._seen = best
        return np.column_stack(columns)

    def _room_for(self, looks: int) -> bool:
        return self._renders + looks * len(self._search_views) <= MOST_RENDERS

    def _model_jacobian(self, x: FloatArray) -> FloatArray:
        def drawn(at: FloatArray) -> FloatArray:
            asked = self._lens_of(at)
            points = [self._drawn_by_model(asked, v)[self._seen[v.name].point_ids] for v in self._search_views]
            return np.concatenate(points).ravel()

        here = drawn(x)
        columns = []
        for index in range(len(_STEPS)):
            step = np.zeros(len(_STEPS))
            step[index] = 0.1 * _STEPS[index]
            columns.append((drawn(x + step) - here) / step[index])
        return np.asarray(np.nan_to_num(np.column_stack(columns)))

    def _lens_of(self, x: FloatArray) -> Lens:
        shifted = replace(self._asked, center_shift_px=(float(x[3]), float(x[4])))
        return shifted.with_hw(float(np.exp(x[0])), float(x[1]), float(x[2]))


def rms(off_px: FloatArray) -> float:
    """Root mean square, per coordinate."""
    return float(np.sqrt(np.mean(off_px**2)))


def sigma_px(detection: Detection) -> float:
    """The least certain coordinate of a detection, one sigma."""
    return float(np.sqrt(np.max(np.diagonal(detection.covariance_px2, axis1=1, axis2=2))))


def matched_px(real: Detection, virtual: Detection) -> FloatArray:
    """Virtual minus real corners (N, 2) px for the points found in both."""
    _, first, second = np.intersect1d(real.point_ids, virtual.point_ids, return_indices=True)
    return np.asarray(virtual.points_px[second] - real.points_px[first])


def _rays(view: View, nodal_offset_mm: float) -> FloatArray:
    if view.camera_pose is None or view.target.pose is None:
        raise NotEnoughData("a view without a pose cannot be compared with the engine")
    world = target_points_world(view.target.pose, view.target.points_m())
    return rays_of(world_to_camera(view.camera_pose, nodal_offset_mm, world))


def _vector(lens: Lens) -> FloatArray:
    return np.array([np.log(lens.f_px), lens.k1_hw, lens.k2_hw, *lens.center_shift_px])


def _solved(jacobian: FloatArray, off: FloatArray) -> FloatArray:
    """The least-squares step, columns scaled to like size, no longer than is believed."""
    scaled = jacobian * _STEPS
    step = -np.linalg.lstsq(scaled, off, rcond=1e-6)[0] * _STEPS
    return np.asarray(step / max(1.0, float(np.max(np.abs(step) / _LARGEST))))


def _spread(views: Sequence[View]) -> list[View]:
    """A few views whose targets stand far apart in the picture: that nearest its middle, which a wrongly drawn target
    leaves last, then each farthest from those before."""
    middle = np.mean([view.detection.centre_px for view in views], axis=0)
    chosen = [min(views, key=lambda v: float(np.linalg.norm(v.detection.centre_px - middle)))]
    while len(chosen) < min(_SEARCH_VIEWS, len(views)):
        left = [view for view in views if all(view is not other for other in chosen)]
        chosen.append(
            max(
                left,
                key=lambda v: min(float(np.linalg.norm(v.detection.centre_px - c.detection.centre_px)) for c in chosen),
            )
        )
    return chosen
