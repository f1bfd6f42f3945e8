"""Levels that a zoom lens needs, a wrong level among good ones, and the price of reading the lens anywhere.

Between levels: real zoom lenses (``--lenses FILE``; without it those of the sample data, where they are at hand).
Their measured focal lengths are joined by a modified Akima curve over the logarithm of the nominal focal length, which
no part of the product uses, for log(f), k1_hw and k2_hw. ``log``: a zoom encoder even in log focal length; ``servo``:
the zoom curve of a 20x camera (Sony BRC-X400), bent to the lens's range; ``linear``: even in focal length. Each method
is told the true lens at its levels, and judged over 301 places. Uniform linear interpolates f and k1_hw, k2_hw, uniform
cubic log f and the same by a not-a-knot cubic, both over the encoder.

Wrong level: random smooth lenses with 13 levels and the noise of a good measurement, one of them wrong: the lens stood
elsewhere, the focal length, the distortion or the centre shift is off. A lens counts as caught when that level, and no
other, is left out; a good lens as rejected when any is.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import Akima1DInterpolator, CubicSpline, PchipInterpolator

from benchmarks.rows import Column, Progress, Row, decimals, percent, readable
from calibration.compare import NEGLIGIBLE_PX
from calibration.lens import fov_to_f_px, valid_radius
from calibration.surface.evaluate import LensSurface
from calibration.surface.fit import find_outliers
from calibration.surface.model import LensModel
from calibration.surface.plan import AdaptivePlan, PlanOptions
from calibration.surface.quantities import LevelData, lens_of
from calibration.tables import EVIDENCE_QUANTITIES, LevelResult
from calibration.types import FloatArray

SIZE = (1920, 1080)
MOST_LEVELS = 13
_COUNTS = (5, 7, 9, 11, 13, 15, 17, 21, 25, 31, 41)
_GOALS_PX = (1.0, 0.5)
_PLACES = 301
_RADII = 1000
_CORNER = math.hypot(1.0, SIZE[1] / SIZE[0])
_LENSES, _QUICK_LENSES = 1000, 20
_NOISE_PX = 0.03
_NO_EVIDENCE = dict.fromkeys(EVIDENCE_QUANTITIES, "a benchmark's level")
# Sony BRC-X400, zoom position over 0x4000 at which the optical ratio is 1, 2, ... 20.
_SERVO = tuple(
    position / 0x4000
    for position in (
        *(0x0000, 0x0DC1, 0x186C, 0x2015, 0x2594, 0x29B7, 0x2CFB, 0x2FB0, 0x320C, 0x342D),
        *(0x3608, 0x37AA, 0x391C, 0x3A66, 0x3B90, 0x3C9C, 0x3D91, 0x3E72, 0x3F40, 0x4000),
    )
)
_ENCODERS = ("log", "servo", "linear")

PLOTS = (("max_px", "overlay error between 13 levels, max, px"), ("levels_1px", "levels for 1 px"))

Truth = Callable[[FloatArray], FloatArray]
"""Quantities (N, 3): log f, k1_hw, k2_hw at zoom (N,)."""


@dataclass(frozen=True, slots=True)
class RealLens:
    """A measured zoom: nominal focal lengths, and log f (px), k1_hw, k2_hw at each. ``exact_px``: how far k1 and k2 can
    be from the lens itself, at best (max over its levels)."""

    name: str
    focal_mm: tuple[float, ...]
    values: FloatArray
    exact_px: float

    def truth(self, encoder: str) -> Truth:
        """The lens over an encoder 0..1."""
        nominal = np.log(np.array(self.focal_mm))
        relative = self.values - np.column_stack([nominal, np.zeros((len(nominal), 2))])
        curve = Akima1DInterpolator(nominal, relative, method="makima")
        to_log = PchipInterpolator(_SERVO, np.log(np.arange(1, 21)) / math.log(20))

        def at(zoom: FloatArray) -> FloatArray:
            share = to_log(zoom) if encoder == "servo" else zoom
            along = nominal[0] + share * (nominal[-1] - nominal[0])
            if encoder == "linear":
                along = np.log(self.focal_mm[0] + zoom * (self.focal_mm[-1] - self.focal_mm[0]))
            along = np.clip(along, nominal[0], nominal[-1])
            return np.asarray(curve(along) + np.column_stack([along, np.zeros((len(along), 2))]))

        return at


def run(*, quick: bool = False, progress: Progress | None = None, lenses: Path | None = None) -> list[Row]:
    """Rows {case, method, max_px, levels_1px, levels_0.5px, exact_px, relative errors} by lens and encoder, then
    {lenses, caught, rejected} and {us_per_call, million_per_s}. Raises :class:`ValueError` for a bad lens file."""
    show = progress or (lambda share: None)
    sample = Path(os.environ.get("LENSMATCH_SHARED") or Path(__file__).resolve().parents[2] / "shared") / "data"
    path = lenses or sample / "real_lenses.json"
    real = read_lenses(path) if lenses is not None or path.exists() else []
    encoders = _ENCODERS[:1] if quick else _ENCODERS
    rows: list[Row] = [] if real else [{"case": "real lenses", "method": "none at hand: give a file with --lenses"}]
    for number, lens in enumerate(real):
        for encoder in encoders:
            rows += _between(lens, encoder, _COUNTS[:5] if quick else _COUNTS)
        show(0.6 * (number + 1) / len(real))
    rows += _summary(rows, encoders)
    rows += _wrong_levels(_QUICK_LENSES if quick else _LENSES, lambda share: show(0.6 + 0.35 * share))
    rows.append(_price())
    show(1.0)
    return rows


def columns() -> list[Column]:
    """The table that a person reads."""
    return [
        ("case", readable),
        ("method", readable),
        ("max_px", decimals(2)),
        ("max_px_at", readable),
        ("levels_1px", readable),
        ("levels_0.5px", readable),
        ("k1_error", percent(2)),
        ("k2_error", percent(2)),
        ("exact_px", decimals(2)),
        ("lenses", readable),
        ("caught", percent(1)),
        ("rejected", percent(2)),
        ("us_per_call", decimals(1)),
        ("million_per_s", decimals(2)),
    ]


def read_lenses(path: Path) -> list[RealLens]:
    """The lenses of a file as ``real_lenses.json``. Raises :class:`ValueError` in one line."""
    try:
        document: Any = json.loads(path.read_text("utf-8"))
        return [_real_lens(raw) for raw in document["lenses"]]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (KeyError, TypeError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is no file of real lenses ({type(error).__name__}: {error})") from error


def _real_lens(raw: Mapping[str, Any]) -> RealLens:
    levels = sorted(raw["levels"], key=lambda level: float(level["focal_mm"]))
    values = []
    for level in levels:
        f_px = fov_to_f_px(float(level["fov_x_deg"]), SIZE[0])
        h2 = (SIZE[0] / (2 * f_px)) ** 2
        values.append((math.log(f_px), float(level["k1"]) * h2, float(level["k2"]) * h2**2))
    focal = tuple(float(level["focal_mm"]) for level in levels)
    exact = max(float(level.get("residual_max_px", 0.0)) for level in levels)
    return RealLens(str(raw["name"]), focal, np.array(values), exact)


def overlay_px(truth: FloatArray, found: FloatArray) -> FloatArray:
    """Largest distance (N,) px over the frame between where two lenses without shift put the same ray."""
    rho = np.linspace(0.0, 2.0, _RADII + 1)[1:]
    k1, k2 = truth[:, 1:2], truth[:, 2:3]
    drawn = rho * (1 + k1 * rho**2 + k2 * rho**4)
    folds = np.array([valid_radius(a, b) for a, b in truth[:, 1:]])
    seen = (drawn <= _CORNER) & (rho < folds[:, None])
    moved = rho * np.exp(found[:, 0] - truth[:, 0])[:, None]
    other = moved * (1 + found[:, 1:2] * moved**2 + found[:, 2:3] * moved**4)
    worst = np.max(np.where(seen, np.abs(other - drawn), 0.0), axis=1)
    return np.asarray(worst * SIZE[0] / 2, dtype=np.float64)


def _between(lens: RealLens, encoder: str, counts: Sequence[int]) -> list[Row]:
    truth = lens.truth(encoder)
    places = np.linspace(0.0, 1.0, _PLACES)
    true = truth(places)
    case = f"{lens.name}, {encoder} encoder"
    rows: list[Row] = []
    methods: dict[str, Callable[[int], FloatArray]] = {
        "uniform linear": lambda n: _uniform_linear(truth, n, places),
        "uniform cubic": lambda n: np.asarray(
            CubicSpline(np.linspace(0, 1, n), truth(np.linspace(0, 1, n)))(places), dtype=np.float64
        ),
        "adaptive": lambda n: adaptive(truth, n, None).mean(places, np.full(len(places), 0.5))[:, :3],
    }
    for method, interpolate in methods.items():
        errors = {n: overlay_px(true, interpolate(n)) for n in counts}
        worst = {n: float(error.max()) for n, error in errors.items()}
        row: Row = {"case": case, "method": method, "max_px": worst[MOST_LEVELS]}
        row["max_px_at"] = f"{MOST_LEVELS} levels"
        for goal in _GOALS_PX:
            reached = [n for n in counts if worst[n] <= goal]
            row[f"levels_{goal:g}px"] = min(reached) if reached else f"> {counts[-1]}"
        row["exact_px"] = lens.exact_px
        rows.append(row)
    model = adaptive(truth, MOST_LEVELS, None)
    at_levels = model.mean(model.data.zoom, model.data.focus)[:, :3]
    rows[-1]["k1_error"], rows[-1]["k2_error"] = (
        _relative(truth(model.data.zoom), at_levels, column) for column in (1, 2)
    )
    plan = AdaptivePlan(PlanOptions(accuracy_px=1.0, max_levels=counts[-1]), SIZE)
    stopped = _follow(plan, truth)
    found = stopped.mean(places, np.full(len(places), 0.5))[:, :3]
    rows.append(
        {
            "case": case,
            "method": "adaptive, until 1 px is expected and met",
            "max_px": float(overlay_px(true, found).max()),
            "max_px_at": f"{len(stopped.data)} levels",
        }
    )
    return rows


def _uniform_linear(truth: Truth, count: int, places: FloatArray) -> FloatArray:
    zooms = np.linspace(0, 1, count)
    levels = truth(zooms)
    levels[:, 0] = np.exp(levels[:, 0])
    found = np.stack([np.interp(places, zooms, column) for column in levels.T], axis=-1)
    found[:, 0] = np.log(found[:, 0])
    return found


def _relative(true: FloatArray, found: FloatArray, column: int) -> float | None:
    """Largest relative error of a distortion coefficient (focal-length units) at the levels themselves, where it moves
    the corner by more than a pixel."""
    effect = np.abs(true[:, column]) * _CORNER ** (2 * column + 1) * SIZE[0] / 2
    shows = effect > NEGLIGIBLE_PX
    # k1 and k2 in focal-length units: the error of the focal length is theirs too.
    if not shows.any():
        return None
    true, found = true[shows], found[shows]
    ratio = found[:, column] / true[:, column] * np.exp(2 * column * (found[:, 0] - true[:, 0]))
    return float(np.max(np.abs(ratio - 1)))


def adaptive(truth: Truth, count: int, accuracy_px: float | None) -> LensModel:
    """The surface after a plan of so many levels."""
    return _follow(AdaptivePlan(PlanOptions(accuracy_px=accuracy_px, max_levels=count), SIZE), truth)


def _follow(plan: AdaptivePlan, truth: Truth) -> LensModel:
    results: dict[tuple[float, float], LevelResult] = {}
    while asked := plan.ask():
        for zoom, focus in asked:
            row = truth(np.array([zoom]))[0]
            lens = lens_of((*row.tolist(), 0.0, 0.0), SIZE, 1.0)
            results[zoom, focus] = LevelResult.from_lens(zoom, focus, lens, reasons=_NO_EVIDENCE)
            plan.tell(results[zoom, focus])
    return LensModel.fit(LevelData.of_levels([*results.values()], SIZE))


def _summary(rows: Sequence[Row], encoders: Sequence[str]) -> list[Row]:
    found: list[Row] = []
    for encoder in encoders:
        mine = {
            (str(row["case"]), str(row["method"])): float(str(row["max_px"]))
            for row in rows
            if str(row["case"]).endswith(f"{encoder} encoder")
        }
        cases = sorted({case for case, _ in mine})
        within = sum(mine[case, "adaptive"] <= 1.0 for case in cases)
        worse = sum(mine[case, "adaptive"] > mine[case, "uniform cubic"] for case in cases)
        told = f"within 1 px: {within} of {len(cases)}; worse than uniform cubic: {worse}"
        found.append({"case": f"all lenses, {encoder} encoder", "method": told, "max_px_at": f"{MOST_LEVELS} levels"})
    return found


def _wrong_levels(lenses: int, show: Progress) -> list[Row]:
    caught: dict[str, list[bool]] = {kind: [] for kind in _FAULTS}
    rejected: list[bool] = []
    for seed in range(lenses):
        rng = np.random.default_rng([4, seed])
        data, truth = random_lens(rng)
        rejected.append(bool(find_outliers(data, None)))
        kind = tuple(_FAULTS)[seed % len(_FAULTS)]
        level = int(rng.integers(len(data)))
        values = data.values.copy()
        values[level] = _FAULTS[kind](rng, values[level], float(data.zoom[level]), truth)
        found = find_outliers(replace(data, values=values), None)
        caught[kind].append(set(found) == {level})
        show((seed + 1) / lenses)
    every = [one for each in caught.values() for one in each]
    rows: list[Row] = [
        {
            "case": "13 levels, one wrong",
            "method": kind,
            "lenses": len(each),
            "caught": float(np.mean(each)) if each else None,
        }
        for kind, each in caught.items()
    ]
    rows.append(
        {
            "case": "13 levels",
            "method": "all faults; good lenses",
            "lenses": lenses,
            "caught": float(np.mean(every)),
            "rejected": float(np.mean(rejected)),
        }
    )
    return rows


def random_lens(rng: np.random.Generator) -> tuple[LevelData, Callable[[float], FloatArray]]:
    """A smooth random zoom with 13 levels as measured, and its quantities (5,) at a zoom."""
    ratio = math.log(rng.uniform(4, 25))
    bend = rng.uniform(-0.25, 0.25)
    wide = math.log(SIZE[0] / (2 * math.tan(math.radians(rng.uniform(50, 75)) / 2)))
    k1, k1_tele, fall = rng.uniform(-0.15, -0.03), rng.uniform(0.0, 0.06), rng.uniform(3, 8)
    wave, phase = rng.uniform(0, 0.01), rng.uniform(0, 2 * math.pi)
    k2, k2_tele = rng.uniform(0.0, 0.03), rng.uniform(-0.01, 0.01)
    shift = rng.uniform(-6, 6, 4)

    def at(zoom: float) -> FloatArray:
        steep = math.exp(-fall * zoom)
        log_f = wide + ratio * (zoom + bend * zoom * (1 - zoom))
        return np.array(
            [
                log_f,
                k1_tele + (k1 - k1_tele) * steep + wave * math.sin(3 * zoom + phase),
                k2_tele + (k2 - k2_tele) * steep,
                shift[0] + shift[2] * zoom,
                shift[1] + shift[3] * zoom,
            ]
        )

    zooms = np.linspace(0, 1, MOST_LEVELS)
    levels = [
        LevelResult.from_lens(float(z), 0.5, lens_of(at(float(z)).tolist(), SIZE, 1.0), reasons=_NO_EVIDENCE)
        for z in zooms
    ]
    data = LevelData.of_levels(levels, SIZE)
    # Levels without sigmas stand for a spread of points at 0.01 px; these are measured to _NOISE_PX.
    covariance = data.covariance * (_NOISE_PX / 0.01) ** 2
    noise = np.array([rng.multivariate_normal(np.zeros(5), one, method="cholesky") for one in covariance])
    return replace(data, values=data.values + noise, covariance=covariance), at


def _elsewhere(
    rng: np.random.Generator, values: FloatArray, zoom: float, truth: Callable[[float], FloatArray]
) -> FloatArray:
    step = rng.uniform(0.03, 0.08) * (-1 if zoom > 0.5 else 1)
    return np.asarray(truth(zoom + step), dtype=np.float64)


_FAULTS: dict[str, Callable[[np.random.Generator, FloatArray, float, Callable[[float], FloatArray]], FloatArray]] = {
    "the lens stood 0.03 to 0.08 of the zoom elsewhere": _elsewhere,
    "focal length 3 to 10 % off": lambda rng, v, zoom, truth: (
        v + np.array([rng.choice([-1, 1]) * rng.uniform(0.03, 0.1), 0, 0, 0, 0])
    ),
    "distortion 30 to 100 px off at the corner": lambda rng, v, zoom, truth: (
        v + np.array([0, rng.choice([-1, 1]) * rng.uniform(30, 100) / (SIZE[0] / 2 * _CORNER**3), 0, 0, 0])
    ),
    "centre 10 to 40 px off": lambda rng, v, zoom, truth: (
        v + np.array([0, 0, 0, rng.choice([-1, 1]) * rng.uniform(10, 40), rng.uniform(-10, 10)])
    ),
}
"""What makes a level wrong, from its quantities (5,)."""


def _price() -> Row:
    """What reading a lens anywhere costs."""
    rng = np.random.default_rng(0)
    surface = LensSurface.compile(LensModel.fit(random_lens(rng)[0]))
    some = rng.random((2000, 2)).tolist()
    begun = time.perf_counter()
    for zoom, focus in some:
        surface.at(zoom, focus)
    each = (time.perf_counter() - begun) / len(some)
    many = rng.random((2, 1_000_000))
    begun = time.perf_counter()
    surface.at_many(*many)
    return {
        "case": "the lens anywhere",
        "method": "at; at_many",
        "us_per_call": 1e6 * each,
        "million_per_s": 1 / (time.perf_counter() - begun),
    }
