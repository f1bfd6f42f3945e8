"""The charts of a report: the lens over its zoom range, and how exact it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from app.report.charts import Chart, Series, draw, legend_mark
from app.report.model import LevelReport, RunReport
from app.report.numbers import encoder
from app.report.svg import Svg
from calibration.lens import Lens

_TRUTH_STEPS = 80
_LOG_FROM_RATIO = 30.0

_ZOOM = "zoom (encoder, 0 wide to 1 tele)"

Point = tuple[float, float]
Groups = Sequence[Sequence[LevelReport]]
Get = Callable[[LevelReport], float | None]
OfLens = Callable[[Lens], float]


@dataclass(frozen=True, slots=True)
class Figure:
    """A drawn chart with its caption; ``legend``: (mark, name) of each series."""

    title: str
    remark: str
    svg: Svg
    legend: tuple[tuple[Svg, str], ...]


def charts(report: RunReport) -> list[Figure]:
    """Every chart that says something: none for fewer than two measured levels."""
    measured = [level for level in report.levels if not level.failed]
    if len(measured) < 2:
        return []
    focuses = sorted({level.result.focus for level in measured})
    groups = [sorted((m for m in measured if m.result.focus == f), key=lambda m: m.result.zoom) for f in focuses]
    figures = [
        _over_zoom(
            report, groups, "Field of view", "horizontal FoV, degrees (log)", _fov, lambda t: t.fov_x_deg, log=True
        ),
        _over_zoom(report, groups, "Distortion k1", "k1, radius 1 at half width", _k1_hw, lambda t: t.k1_hw),
        _over_zoom(report, groups, "Distortion k2", "k2, radius 1 at half width", _k2_hw, lambda t: t.k2_hw),
        _shift_path(report, groups),
        _overlay_errors(report, groups),
        _pulls(groups) if any(level.truth for level in measured) else _residuals(groups),
    ]
    return [figure for figure in figures if figure.svg]


def _fov(level: LevelReport) -> tuple[float | None, float | None]:
    return level.result.fov_x_deg, level.result.sigma.fov_x_deg


def _k1_hw(level: LevelReport) -> tuple[float | None, float | None]:
    return level.result.k1_hw, half_width_sigma(level, 1)


def _k2_hw(level: LevelReport) -> tuple[float | None, float | None]:
    return level.result.k2_hw, half_width_sigma(level, 2)


def half_width_sigma(level: LevelReport, order: int) -> float | None:
    """Sigma of k1 (order 1) or k2 (order 2) in half-width units: h^(2 order) sigma, the focal length taken as exact."""
    result = level.result
    sigma = result.sigma.k1 if order == 1 else result.sigma.k2
    value, value_hw = (result.k1, result.k1_hw) if order == 1 else (result.k2, result.k2_hw)
    if sigma is None or not value or value_hw is None:
        return None
    return float(sigma * value_hw / value)


def _shift(index: int) -> tuple[Get, Get, OfLens]:
    def value(level: LevelReport) -> float | None:
        return None if level.result.center_shift_px is None else level.result.center_shift_px[index]

    def sigma(level: LevelReport) -> float | None:
        told = level.result.sigma.center_shift_px
        return None if told is None else told[index]

    return value, sigma, lambda truth: truth.center_shift_px[index]


_PULLS: tuple[tuple[str, Get, Get, OfLens], ...] = (
    ("FoV", lambda m: m.result.fov_x_deg, lambda m: m.result.sigma.fov_x_deg, lambda t: t.fov_x_deg),
    ("k1", lambda m: m.result.k1, lambda m: m.result.sigma.k1, lambda t: t.k1),
    ("k2", lambda m: m.result.k2, lambda m: m.result.sigma.k2, lambda t: t.k2),
    ("shift right", *_shift(0)),
    ("shift down", *_shift(1)),
)


def _over_zoom(
    report: RunReport,
    groups: Groups,
    caption: str,
    y_title: str,
    found: Callable[[LevelReport], tuple[float | None, float | None]],
    true: OfLens,
    *,
    log: bool = False,
) -> Figure:
    series = []
    for style, group in enumerate(groups):
        told = [(level.result.zoom, *found(level)) for level in group]
        points = [(zoom, value, sigma) for zoom, value, sigma in told if value is not None]
        name = f"focus {encoder(group[0].result.focus)}"
        line = report.truth_at is None
        series.append(Series(name, [(z, v) for z, v, _ in points], style, [s for _, _, s in points], line))
    faint = [[(zoom, true(lens)) for zoom, lens in curve] for curve in _truth_curves(report, groups)]
    return _figure(Chart(caption, _ZOOM, y_title, series, faint, log_y=log))


def _shift_path(report: RunReport, groups: Groups) -> Figure:
    series = []
    labels = []
    for style, group in enumerate(groups):
        told = [(r.result.zoom, r.result.center_shift_px) for r in group]
        path = [(zoom, shift) for zoom, shift in told if shift is not None]
        name = f"focus {encoder(group[0].result.focus)}"
        series.append(Series(name, [shift for _, shift in path], style, line=report.truth_at is None))
        if style == 0 and len(path) > 1:
            labels = [(*shift, f"zoom {encoder(zoom)}") for zoom, shift in (path[0], path[-1])]
    faint = [[lens.center_shift_px for _, lens in curve] for curve in _truth_curves(report, groups)]
    chart = Chart("Centre shift", "to the right, px", "down, px", series, faint, labels, equal=True)
    return _figure(chart, "the principal point's path from wide to tele")


def _overlay_errors(report: RunReport, groups: Groups) -> Figure:
    def largest(name: str) -> Get:
        def value(level: LevelReport) -> float | None:
            error = getattr(level.result, name)
            return None if error is None else float(error.max)

        return value

    series = [
        Series(
            "expected: one sigma, from the fit",
            _points(groups, largest("predicted_overlay_px")),
            0,
            line=False,
            hollow=True,
        ),
        Series(f"true: against {report.truth_name}", _points(groups, _true_max), 1, line=False),
        Series(
            "engine's render against the camera at its corners",
            _points(groups, largest("engine_overlay_px")),
            2,
            line=False,
            hollow=True,
        ),
    ]
    return _errors("Overlay error", "largest anywhere in the picture", "largest overlay error, px", series)


def _true_max(level: LevelReport) -> float | None:
    return None if level.error is None else level.error.max_px


def _pulls(groups: Groups) -> Figure:
    series = []
    for style, (name, value, sigma, true) in enumerate(_PULLS):

        def pull(level: LevelReport, value: Get = value, sigma: Get = sigma, true: OfLens = true) -> float | None:
            found, spread = value(level), sigma(level)
            return None if found is None or not spread or level.truth is None else (found - true(level.truth)) / spread

        series.append(Series(name, _points(groups, pull, (style - 2) * 0.012), style, line=False))
    chart = Chart(
        "Error in sigmas",
        _ZOOM,
        "(found − truth) / sigma",
        [s for s in series if s.points],
        bands=(-2, -1, 1, 2),
        from_zero=False,
    )
    return _figure(chart, "two in three should lie within 1")


def _residuals(groups: Groups) -> Figure:
    def rms(name: str) -> Get:
        def value(level: LevelReport) -> float | None:
            error = getattr(level.result, name)
            return None if error is None else float(error.rms)

        return value

    series = [
        Series("residual", _points(groups, rms("residual_px")), 0, line=False),
        Series("held out of the fit", _points(groups, rms("held_out_px"), 0.01), 1, line=False, hollow=True),
    ]
    return _errors("Residuals", "RMS per coordinate", "RMS per coordinate, px", series)


def _errors(title: str, remark: str, y_title: str, series: Sequence[Series]) -> Figure:
    series = [s for s in series if s.points]
    values = [y for s in series for _, y in s.points if y > 0]
    log = bool(values) and max(values) / min(values) > _LOG_FROM_RATIO
    y_title += " (log)" if log else ""
    return _figure(Chart(title, _ZOOM, y_title, series, log_y=log, from_zero=not log), remark)


def _points(groups: Groups, value: Get, aside: float = 0.0) -> list[Point]:
    """(zoom, value) of every level that tells it, the focuses of one zoom beside each other."""
    zooms = [level.result.zoom for group in groups for level in group]
    span = max(zooms) - min(zooms) or 1.0
    points = []
    for index, group in enumerate(groups):
        shift = (aside + (index - (len(groups) - 1) / 2) * min(0.03, 0.1 / len(groups))) * span
        points += [(level.result.zoom + shift, told) for level in group if (told := value(level)) is not None]
    return points


def _truth_curves(report: RunReport, groups: Groups) -> list[list[tuple[float, Lens]]]:
    curves = []
    for group in groups:
        zooms = [level.result.zoom for level in group]
        if report.truth_at is not None and len(group) > 1:
            focus, low, span = group[0].result.focus, zooms[0], zooms[-1] - zooms[0]
            steps = [low + span * i / _TRUTH_STEPS for i in range(_TRUTH_STEPS + 1)]
            curves.append([(zoom, report.truth_at(zoom, focus)) for zoom in steps])
        else:
            curves.append([(level.result.zoom, level.truth) for level in group if level.truth is not None])
    return curves


def _figure(chart: Chart, remark: str = "") -> Figure:
    legend = [(legend_mark(s.style, s.hollow, s.line), s.name) for s in chart.series]
    if any(len(line) > 1 for line in chart.faint):
        legend.append(
            (
                Svg('<svg class="mark" viewBox="0 0 24 12" aria-hidden="true"><path class="truth" d="M0 6H24"/></svg>'),
                "truth",
            )
        )
    return Figure(chart.title, remark, draw(chart), tuple(legend))
