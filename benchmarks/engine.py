"""Renders that a level costs until the engine draws what the camera's lens does, by method and kind of engine.

Random lenses; corners with noise instead of pictures. The engine is that of the simulated studio, which nothing here
fits with. A trial of the methods that do not learn is one render at each of two opposite corners. A method ends when
every corner stands within ``AGREES_PX`` of its place (it then claims to be done) or when it gives up; it has failed
where the picture is then more than ``GOAL_PX`` RMS off over the frame, beyond what the engine's own polynomial can do,
and failed silently where it claimed otherwise. The learned engine claims what the lens table would say: a level that is
``ok``. Every fourth lens learns the engine anew, and those after it use what was learned, as the levels of a job do;
below that, jobs on the simulated studio over its sockets.
"""

from __future__ import annotations

import asyncio
import math
import tempfile
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.cli.jobs import run_job
from app.cli.simulated import studio_engines, studio_job, studio_profile, true_lens
from app.engines import EngineFacts
from app.settings import Settings
from benchmarks.engine_corners import SENSOR_MM, SIZE, CornerEngine, Level, level_of, random_lens
from benchmarks.rows import Column, Progress, Row, readable
from calibration.camera import project_target
from calibration.compare import overlay
from calibration.errors import CalibrationError, NotEnoughData
from calibration.lens import Lens
from calibration.solve.engine_check import EngineAgreement, EngineCheck
from calibration.solve.engine_fit import LearnedEngine
from calibration.solve.engine_learning import EngineLearning
from calibration.solve.engine_model import Direction, EngineModel
from calibration.solve.outcome import level_result
from calibration.solve.problem import View
from calibration.solve.search import Observation
from calibration.tables import LevelStatus
from calibration.types import CameraPose, Refusal
from engine_adapters.sim.engine_camera import EngineCamera
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded

GOAL_PX = 0.1
AGREES_PX = 0.1
LENSES, QUICK_LENSES = 60, 3
MOST_TRIALS = 2000

PLOTS = (
    ("renders_median", "renders for a level, the median"),
    ("renders_max", "renders for a level, the most"),
    ("failures", "levels that were not matched"),
    ("silent_failures", "levels that were not matched and claimed to be"),
)

VARIANTS: dict[str, tuple[str, ...]] = {
    "like our model": (),
    "half width, overscan": ("radius_unit=half_width", "overscan=1.1"),
    "reverse, flipped sign": ("direction=reverse", "center_shift_sign_x=-1"),
    "absolute pixel, fov_y": ("center_shift=absolute_pixel", "pixel_centres=half", "fov_axis=y"),
}
_STEPS = np.array([1e-3, 2e-3, 2e-3, 2.0, 2.0])
_MAPPINGS = 12
_OF_TEN = 10
# The coordinate search takes so many trials that every tenth lens must do for it.
_PAIR = 2
_LEVELS_OF_A_JOB = 4

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The best parameters, and their residuals (N, 2) px."""

    parameters: Array
    residual_px: Array

    @property
    def max_px(self) -> float:
        return float(np.max(np.linalg.norm(self.residual_px, axis=-1)))


Trial = Generator[Array, Array | None, Found]


@dataclass(slots=True)
class _Count:
    """What became of one level. ``beyond_px``: RMS over the frame beyond what the engine can do."""

    renders: int
    beyond_px: float
    claimed: bool


def run(*, quick: bool = False, progress: Progress | None = None) -> list[Row]:
    """A row for each kind of engine and method, then one for each job over sockets."""
    show = progress or (lambda share: None)
    rng = np.random.default_rng(20)
    levels = [level_of(random_lens(rng), rng) for _ in range(QUICK_LENSES if quick else LENSES)]
    show(0.1)
    rows: list[Row] = []
    for index, (name, settings) in enumerate(VARIANTS.items()):
        camera = EngineCamera.parse(settings)
        for method, search in _BASELINES.items():
            share = levels[::_OF_TEN] if search is _coordinates else levels
            rows.append(_row(name, method, [_baseline(search, camera, level, i) for i, level in enumerate(share)]))
        rows.append(_learned(name, camera, levels))
        show(0.1 + 0.75 * (index + 1) / len(VARIANTS))
    chosen = list(VARIANTS.items())[1:2] if quick else list(VARIANTS.items())[1:3]
    for name, settings in chosen:
        rows.append(asyncio.run(_job(name, settings)))
    show(1.0)
    return rows


def _row(name: str, method: str, counts: Sequence[_Count]) -> Row:
    failed = [not count.beyond_px <= GOAL_PX for count in counts]
    good = [count.renders for count, bad in zip(counts, failed, strict=True) if not bad]
    return {
        "case": name,
        "method": method,
        "levels": len(counts),
        "renders_mean": float(np.mean(good)) if good else None,
        "renders_median": float(np.median(good)) if good else None,
        "renders_max": max(good) if good else None,
        "failures": sum(failed),
        "silent_failures": sum(bad and count.claimed for bad, count in zip(failed, counts, strict=True)),
        "not_claimed": sum(not count.claimed for count in counts),
    }


def _beyond(engine: CornerEngine, camera: EngineCamera, asked: Lens, lens: Lens) -> float:
    """RMS per coordinate over the frame beyond the least that this engine can leave; the engine's settings are known
    here, for judging, and nowhere else."""
    error, least = (_rms(engine.off_px(told, lens)) for told in (asked, right_model(camera).asking_for(lens)))
    return math.sqrt(max(error**2 - least**2, 0.0)) if math.isfinite(error) else math.inf


def right_model(camera: EngineCamera) -> EngineModel:
    """The model that describes the engine, worked out from its settings."""
    width, height = SIZE
    axis = height / width if camera.fov_axis.value == "y" else 1.0
    focal = axis / camera.overscan
    power, gain = EngineFacts(SIZE, 1.0, SENSOR_MM[0]).unit_gain(camera.radius_unit.value, focal)
    origin = camera.shift_origin(SIZE)
    signs = camera.center_shift_sign_x, camera.center_shift_sign_y
    return EngineModel(
        Direction(camera.direction.value),
        power,
        focal,
        camera.distortion_sign * gain,
        camera.distortion_sign * gain**2,
        (float(signs[0]), float(signs[1])),
        (-signs[0] * origin[0], -signs[1] * origin[1]),
    )


def _rms(off_px: Array) -> float:
    return float(np.sqrt(np.mean(off_px**2)))


# --- ours ---


def _learned(name: str, camera: EngineCamera, levels: Sequence[Level]) -> Row:
    counts, learning, trusted, model = [], [], [], EngineModel()
    for index, level in enumerate(levels):
        engine = CornerEngine(camera, np.random.default_rng(index))
        if index % _LEVELS_OF_A_JOB == 0:
            learned = learn(level, engine)
            learning.append(engine.renders)
            trusted.append(learned.trusted)
            model = learned.model if learned.trusted else EngineModel()
            engine.renders = 0
        counts.append(_checked(level, engine, camera, model))
    return _row(name, "learned, then checked", counts) | {
        "learning_median": float(np.median(learning)),
        "learning_max": max(learning),
        "trusted": f"{sum(trusted)}/{len(trusted)}",
    }


def learn(level: Level, engine: CornerEngine) -> LearnedEngine:
    """What learning makes of an engine at a level."""
    learning = EngineLearning(level.task)
    while (capture := learning.ask()) is not None and capture.lens is not None:
        pose = level.task.pose(capture.pan_deg, capture.tilt_deg)
        seen = engine.render(capture.lens, pose, level.task.targets[capture.target])
        learning.tell(Observation(capture.step, seen, pose))
    return learning.result()


def check(level: Level, engine: CornerEngine, model: EngineModel) -> tuple[EngineCheck, EngineAgreement | None]:
    """The check of a level in front of an engine, and how it ended; None where the target was never found."""
    checking = EngineCheck(level.fit.lens, level.views[::-1], model)
    while (wanted := checking.ask()) is not None:
        checking.tell(engine.render(wanted.asked, _pose(wanted.view), wanted.view.target))
    try:
        return checking, checking.result()
    except NotEnoughData:
        return checking, None


def _checked(level: Level, engine: CornerEngine, camera: EngineCamera, model: EngineModel) -> _Count:
    checking, agreement = check(level, engine, model)
    if agreement is None:
        return _Count(checking.renders, math.inf, False)
    lens = level.fit.lens
    try:
        shortfall = model.shortfall_px(lens)
    except CalibrationError:
        shortfall = math.inf
    result = level_result(level.fit, 0.0, 0.0, held_out={}, engine=agreement, engine_shortfall_px=shortfall)
    beyond = _beyond(engine, camera, agreement.asked, lens)
    return _Count(checking.renders, beyond, result.status is LevelStatus.OK)


# --- the methods that do not learn ---


def _baseline(search: Callable[[Level], Trial], camera: EngineCamera, level: Level, seed: int) -> _Count:
    """A method that takes the engine at its profile's word and starts from a straight lens whose focal length is a few
    percent off; space mapping starts from the camera's own fit."""
    engine = CornerEngine(camera, np.random.default_rng(seed), beyond=1.0)
    lens = level.fit.lens

    def corners(at: Array) -> Array | None:
        parts = []
        try:
            asked = _moved(lens, at)
            for view in _pair(level):
                seen = engine.render(asked, _pose(view), view.target)
                if isinstance(seen, Refusal):
                    return None
                parts.append(seen.points_px - project_target(lens, _pose(view), view.target))
        except (CalibrationError, OverflowError):
            return None
        return np.concatenate(parts)

    plan = search(level)
    found: Found | None = None
    try:
        wanted = next(plan)
        while engine.renders < _PAIR * MOST_TRIALS:
            wanted = plan.send(corners(wanted))
    except StopIteration as end:
        found = end.value
    if found is None:
        return _Count(engine.renders, math.inf, False)
    renders = engine.renders
    beyond = _beyond(engine, camera, _moved(lens, found.parameters), lens)
    return _Count(renders, beyond, found.max_px <= AGREES_PX)


def _moved(lens: Lens, delta: Array) -> Lens:
    log_f, k1, k2, x, y = (float(value) for value in delta)
    bent = lens.with_hw(lens.f_px * math.exp(log_f), lens.k1_hw + k1, lens.k2_hw + k2)
    return replace(bent, center_shift_px=(lens.center_shift_px[0] + x, lens.center_shift_px[1] + y))


def _pose(view: View) -> CameraPose:
    if view.camera_pose is None:
        raise ValueError(view.name)
    return view.camera_pose


def _pair(level: Level) -> list[View]:
    """Two opposite corners."""
    return level.views[1:3]


def _lost(start: Array) -> Found:
    return Found(start, np.full((1, 2), np.inf))


def _start(level: Level) -> Array:
    """Nothing bent, nothing shifted, the focal length 3 % too long."""
    lens = level.fit.lens
    return np.array([0.03, -lens.k1_hw, -lens.k2_hw, -lens.center_shift_px[0], -lens.center_shift_px[1]])


def _difference(at: Array, here: Array) -> Generator[Array, Array | None, Array]:
    """The Jacobian (2N, 5) by one trial more for each parameter, each as long as the target is still seen."""
    columns = []
    for index, size in enumerate(_STEPS):
        column = np.zeros(here.size)
        for share in (1.0, -1.0, 0.03, -0.03):
            away = np.zeros(len(_STEPS))
            away[index] = share * size
            seen = yield at + away
            if seen is not None:
                column = (seen - here).ravel() / (share * size)
                break
        columns.append(column)
    return np.stack(columns, axis=-1)


def _broyden(level: Level) -> Trial:
    """Broyden's good method (1965); each step as short as it must be for the target to be seen."""
    at = _start(level)
    r = yield at
    if r is None:
        return _lost(at)
    slopes = yield from _difference(at, r)
    idle = 0
    for _ in range(20):
        if Found(at, r).max_px <= AGREES_PX or idle >= _PAIR:
            break
        step = np.linalg.lstsq(slopes, -r.ravel(), rcond=1e-12)[0]
        new = yield at + step
        for _ in range(2):
            if new is not None:
                break
            step = 0.3 * step
            new = yield at + step
        if new is None:
            break
        slopes = slopes + np.outer(new.ravel() - r.ravel() - slopes @ step, step) / max(float(step @ step), 1e-300)
        idle = 0 if _rms(new) < 0.98 * _rms(r) else idle + 1
        if _rms(new) < _rms(r):
            at, r = at + step, new
    return Found(at, r)


def _gauss_newton(level: Level) -> Trial:
    """Levenberg-Marquardt with a Jacobian by finite differences, renewed each round."""
    at = _start(level)
    r = yield at
    if r is None:
        return _lost(at)
    for _ in range(8):
        if Found(at, r).max_px <= AGREES_PX:
            break
        slopes = yield from _difference(at, r)
        scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
        small, before = slopes / scale, _rms(r)
        for damping in (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0):
            step = np.linalg.lstsq(small.T @ small + damping * np.eye(len(at)), -small.T @ r.ravel(), rcond=None)[0]
            new = yield at + step / scale
            if new is not None and _rms(new) < before:
                at, r = at + step / scale, new
                break
        if _rms(r) > 0.98 * before:
            break
    return Found(at, r)


def _coordinates(level: Level) -> Trial:
    """One value after the other, each by steps that are halved: field of view, k1, k2, centre, and round again."""
    at = _start(level)
    r = yield at
    if r is None:
        return _lost(at)
    sizes = 20 * _STEPS
    while Found(at, r).max_px > AGREES_PX and sizes[0] > 1e-8:
        moved = False
        for index in range(len(sizes)):
            for way in (1.0, -1.0):
                while True:
                    trial = at.copy()
                    trial[index] += way * sizes[index]
                    seen = yield trial
                    if seen is None or float(np.mean(seen**2)) >= float(np.mean(r**2)):
                        break
                    at, r, moved = trial, seen, True
        if not moved:
            sizes = sizes / 2
    return Found(at, r)


def _space_mapping(level: Level) -> Trial:
    """Fit our own lens model to the engine's picture, and move the values by how far it is from the camera's lens."""
    lens, at = level.fit.lens, np.zeros(len(_STEPS))
    best: Found | None = None
    for _ in range(_MAPPINGS):
        r = yield at
        if r is None:
            break
        if best is None or Found(at, r).max_px < best.max_px:
            best = Found(at, r)
        if best.max_px <= AGREES_PX:
            break
        shown = _fitted(level, r)
        if shown is None:
            break
        drawn = lens.k1_hw + float(shown[1]), lens.k2_hw + float(shown[2])
        if 0.0 in drawn:
            break
        following = at - shown
        # Coefficients by their ratio: another unit of the radius is a factor.
        following[1] = (lens.k1_hw + at[1]) * lens.k1_hw / drawn[0] - lens.k1_hw
        following[2] = (lens.k2_hw + at[2]) * lens.k2_hw / drawn[1] - lens.k2_hw
        at = following
    return best if best is not None else _lost(at)


def _fitted(level: Level, residual: Array) -> Array | None:
    """By how much our model's lens must be moved from the camera's to draw what the engine did."""
    lens = level.fit.lens
    goal = np.concatenate([project_target(lens, _pose(view), view.target) for view in _pair(level)])

    def drawn(at: Array) -> Array:
        moved = _moved(lens, at)
        seen = [project_target(moved, _pose(view), view.target) for view in _pair(level)]
        return np.asarray(np.concatenate(seen) - goal)

    delta: Array = np.zeros(len(_STEPS))
    for _ in range(8):
        try:
            here = drawn(delta)
            slopes = [(drawn(delta + step) - here).ravel() / float(step.sum()) for step in np.diag(_STEPS)]
        except (CalibrationError, OverflowError):
            return None
        jacobian = np.column_stack(slopes)
        if not np.isfinite(jacobian).all():
            return None
        step = np.asarray(np.linalg.lstsq(jacobian, (residual - here).ravel(), rcond=1e-12)[0], dtype=np.float64)
        delta = delta + step
        if float(np.max(np.abs(step / _STEPS))) < 1e-4:
            break
    return np.asarray(delta)


_BASELINES: dict[str, Callable[[Level], Trial]] = {
    "coordinate search": _coordinates,
    "Gauss-Newton, finite differences": _gauss_newton,
    "Broyden": _broyden,
    "space mapping": _space_mapping,
}


# --- over sockets ---


async def _job(name: str, settings: tuple[str, ...]) -> Row:
    """A job of two levels. Here a level has failed where the lens table is off, by more than ``GOAL_PX`` anywhere."""
    lens = load_embedded(embedded_lens_names()[0])
    options = [part for setting in settings for part in ("--engine", setting)]
    async with launched_studio(("--lens", lens.name, "--payload-format", "jpeg", *options)) as addresses:
        engines = studio_engines(studio_profile(addresses, lens))
        with tempfile.TemporaryDirectory(prefix="lensmatch-bench-") as folder:
            request = studio_job(addresses, lens, [(1 / 3, 0.25), (0.5, 0.25)])
            job = await run_job(Settings(database=Path(folder) / "b.db"), engines, request, lambda share, doing: None)
    counts, seen = [], []
    for level in job.table.levels:
        found = None if level.fov_x_deg is None else level.lens(job.table.image_size, job.table.pixel_aspect)
        error = math.inf if found is None else overlay(true_lens(lens, level.zoom, level.focus), found).max_px
        counts.append(_Count(level.frames.virtual, error, level.status is LevelStatus.OK))
        if level.engine_overlay_px is not None:
            seen.append(level.engine_overlay_px.max)
    row = _row(f"{name}, over sockets", "learned, then checked", counts)
    return row | {"engine_overlay_px": max(seen) if seen else None}


def columns() -> list[Column]:
    """How a person reads the rows: column and format."""

    return [
        ("case", readable),
        ("method", readable),
        ("levels", readable),
        ("renders_median", readable),
        ("renders_mean", readable),
        ("renders_max", readable),
        ("failures", readable),
        ("silent_failures", readable),
        ("not_claimed", readable),
        ("learning_median", readable),
        ("learning_max", readable),
        ("trusted", readable),
        ("engine_overlay_px", readable),
    ]
