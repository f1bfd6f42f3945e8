"""Charts as SVG: axes with units, series told apart by shape and dash as well as colour, truth as a faint line."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from app.report.numbers import MINUS
from app.report.svg import Svg, svg

WIDTH, HEIGHT = 460.0, 300.0
LEFT, RIGHT, TOP, BOTTOM = 80.0, 14.0, 16.0, 46.0
SHAPES = ("circle", "square", "triangle", "diamond")
SERIES_COLOURS = 4
_DASHES = ("", "7 4", "2 4", "9 3 2 3")
_LABEL_STEP_X, _LABEL_STEP_Y = 70.0, 36.0


@dataclass(frozen=True, slots=True)
class Series:
    """Points (x, y) that belong together; ``sigma`` (of y) draws error bars; ``style`` counts colours and shapes."""

    name: str
    points: Sequence[tuple[float, float]]
    style: int = 0
    sigma: Sequence[float | None] = ()
    line: bool = True
    hollow: bool = False


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart. ``faint``: lines of truth. ``labels``: words at single points (x, y, text)."""

    title: str
    x_title: str
    y_title: str
    series: Sequence[Series]
    faint: Sequence[Sequence[tuple[float, float]]] = ()
    labels: Sequence[tuple[float, float, str]] = ()
    log_y: bool = False
    from_zero: bool = False
    equal: bool = False
    """Same scale on both axes, y downwards."""
    bands: Sequence[float] = ()
    """Heights of faint lines across, for example plus and minus one sigma."""


@dataclass(frozen=True, slots=True)
class _Axis:
    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def at(self, value: float) -> float:
        low, high, value = (
            (math.log(v) for v in (self.low, self.high, value)) if self.log else (self.low, self.high, value)
        )
        return self.start + (value - low) / (high - low) * (self.end - self.start)


def draw(chart: Chart) -> Svg:
    """The chart as an ``svg`` element; empty where no point can be drawn."""
    series = [_finite(s, chart.log_y) for s in chart.series]
    faint = [[p for p in line if _drawable(p, chart.log_y)] for line in chart.faint]
    points = [p for s in series for p in s.points]
    if not points:
        return Svg("")
    everything = points + [p for line in faint for p in line]
    x, y = _axes(everything, chart)
    parts = [
        svg(
            '<svg class="chart" viewBox="0 0 {:.0f} {:.0f}" role="img" aria-label="{}">',
            WIDTH,
            HEIGHT,
            f"{chart.title}: {chart.y_title} over {chart.x_title}, {len(points)} points",
        ),
        *_grid(x, y, chart),
        *(_path([(x.low, b), (x.high, b)], x, y, "band") for b in chart.bands if y.low <= b <= y.high),
        *(_path(line, x, y, "truth") for line in faint if len(line) > 1),
        *(part for s in series for part in _series(s, x, y)),
        *_words(chart.labels, x, y, chart.log_y),
        Svg("</svg>"),
    ]
    return Svg("".join(parts))


def legend_mark(style: int, hollow: bool, line: bool) -> Svg:
    """The sign of a series, for a legend in text."""
    path = svg('<path class="line s{}" d="M0 6H24"{}/>', _colour(style), _dash(style)) if line else ""
    return svg(
        '<svg class="mark" viewBox="0 0 24 12" aria-hidden="true">{}{}</svg>', path, marker(style, 12, 6, hollow)
    )


def _finite(series: Series, log_y: bool) -> Series:
    sigma = series.sigma or [None] * len(series.points)
    kept = [(p, s) for p, s in zip(series.points, sigma, strict=True) if _drawable(p, log_y)]
    return Series(series.name, [p for p, _ in kept], series.style, [s for _, s in kept], series.line, series.hollow)


def _drawable(point: tuple[float, float], log_y: bool) -> bool:
    return math.isfinite(point[0]) and math.isfinite(point[1]) and (point[1] > 0 or not log_y)


def _axes(points: Sequence[tuple[float, float]], chart: Chart) -> tuple[_Axis, _Axis]:
    x_low, x_high = _span([p[0] for p in points])
    ys = [p[1] for p in points]
    if chart.log_y:
        low, high = min(ys), max(ys)
        pad = max((high / low) ** 0.06, 1.03)
        return _Axis(x_low, x_high, LEFT, WIDTH - RIGHT), _Axis(low / pad, high * pad, HEIGHT - BOTTOM, TOP, log=True)
    y_low, y_high = _span(ys, from_zero=chart.from_zero)
    if chart.equal:
        per_px = max((x_high - x_low) / (WIDTH - LEFT - RIGHT), (y_high - y_low) / (HEIGHT - TOP - BOTTOM))
        per_px *= 1.2  # room for the words at its ends
        x_half, y_half = per_px * (WIDTH - LEFT - RIGHT) / 2, per_px * (HEIGHT - TOP - BOTTOM) / 2
        x_mid, y_mid = (x_low + x_high) / 2, (y_low + y_high) / 2
        # Image coordinates: v grows downwards on the page as it does in the picture.
        return (
            _Axis(x_mid - x_half, x_mid + x_half, LEFT, WIDTH - RIGHT),
            _Axis(y_mid - y_half, y_mid + y_half, TOP, HEIGHT - BOTTOM),
        )
    return _Axis(x_low, x_high, LEFT, WIDTH - RIGHT), _Axis(y_low, y_high, HEIGHT - BOTTOM, TOP)


def _span(values: Sequence[float], *, from_zero: bool = False) -> tuple[float, float]:
    low, high = min(values), max(values)
    if from_zero:
        return 0.0, high * 1.08 or 1.0
    pad = 0.06 * (high - low) or max(abs(high) * 0.05, 0.05)
    return low - pad, high + pad


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round values between ``low`` and ``high``, at most ``most`` of them."""
    step = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(s * step for s in (1, 2, 2.5, 5, 10, 20) if (high - low) / (s * step) <= most)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 times powers of ten between ``low`` and ``high``; round values where these are too few."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        found = [s * 10.0**d for d in decades for s in steps if low <= s * 10.0**d <= high]
        if len(found) >= 4:
            return found
    return [t for t in ticks(low, high, 5) if t > 0]


def _tick_text(value: float, values: Sequence[float]) -> str:
    step = min((b - a for a, b in itertools.pairwise(values)), default=abs(value) or 1.0)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    if digits and abs(round(step, digits) - step) > 1e-9 * step:
        digits += 1  # steps of 2.5
    return f"{value:.{digits}f}".replace("-", MINUS) if value else "0"


def _grid(x: _Axis, y: _Axis, chart: Chart) -> Iterator[Svg]:
    across = ticks(x.low, x.high, int((WIDTH - LEFT - RIGHT) / _LABEL_STEP_X))
    up = log_ticks(y.low, y.high) if chart.log_y else ticks(y.low, y.high, int((HEIGHT - TOP - BOTTOM) / _LABEL_STEP_Y))
    for value in across:
        at = x.at(value)
        yield svg('<path class="grid" d="M{0:.1f} {1:.1f}V{2:.1f}"/>', at, TOP, HEIGHT - BOTTOM)
        yield _text(at, HEIGHT - BOTTOM + 17, _tick_text(value, across), "middle")
    for value in up:
        at = y.at(value)
        zero = " zero" if value == 0 else ""
        yield svg('<path class="grid{0}" d="M{1:.1f} {2:.1f}H{3:.1f}"/>', zero, LEFT, at, WIDTH - RIGHT)
        text = f"{value:g}" if chart.log_y else _tick_text(value, up)
        yield _text(LEFT - 8, at + 4, text, "end")
    yield svg('<path class="axis" d="M{0:.1f} {1:.1f}V{2:.1f}H{3:.1f}"/>', LEFT, TOP, HEIGHT - BOTTOM, WIDTH - RIGHT)
    yield _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, chart.x_title, "middle", "title")
    middle = (TOP + HEIGHT - BOTTOM) / 2
    yield svg(
        '<text class="title" x="14" y="{0:.1f}" text-anchor="middle" transform="rotate(-90 14 {0:.1f})">{1}</text>',
        middle,
        chart.y_title,
    )


def _text(x: float, y: float, text: str, anchor: str, kind: str = "tick") -> Svg:
    return svg('<text class="{}" x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>', kind, x, y, anchor, text)


def _path(points: Sequence[tuple[float, float]], x: _Axis, y: _Axis, kind: str, dash: str = "") -> Svg:
    steps = "L".join(f"{x.at(px):.1f} {y.at(py):.1f}" for px, py in points)
    return svg('<path class="{}" d="M{}"{}/>', kind, steps, dash)


def _colour(style: int) -> int:
    # Sixteen series differ in colour or shape; the shape moves on each time the four colours have been round.
    return style % SERIES_COLOURS


def _dash(style: int) -> Svg:
    pattern = _DASHES[(style + style // SERIES_COLOURS) % len(_DASHES)]
    return svg(' stroke-dasharray="{}"', pattern) if pattern else Svg("")


def _series(series: Series, x: _Axis, y: _Axis) -> Iterator[Svg]:
    if series.line and len(series.points) > 1:
        yield _path(series.points, x, y, f"line s{_colour(series.style)}", _dash(series.style))
    for (px, py), sigma in zip(series.points, series.sigma, strict=True):
        at_x, at_y = x.at(px), y.at(py)
        if sigma and math.isfinite(sigma):
            low, high = py - sigma, py + sigma
            if y.log and low <= 0:
                low = y.low
            ends = [min(max(y.at(v), TOP), HEIGHT - BOTTOM) for v in (low, high)]
            if abs(ends[0] - ends[1]) > 8:  # shorter ones hide behind the marker
                yield svg(
                    '<path class="bar s{0}" d="M{1:.1f} {2:.1f}V{3:.1f}"/>',
                    _colour(series.style),
                    at_x,
                    ends[0],
                    ends[1],
                )
        yield marker(series.style, at_x, at_y, series.hollow)


def marker(style: int, x: float, y: float, hollow: bool) -> Svg:
    """The mark of a series with its middle at (x, y)."""
    shape = SHAPES[(style + style // SERIES_COLOURS) % len(SHAPES)]
    kind = f"dot s{_colour(style)}" + (" hollow" if hollow else "")
    if shape == "circle":
        return svg('<circle class="{}" cx="{:.1f}" cy="{:.1f}" r="4"/>', kind, x, y)
    outline = {
        "square": "m-3.6 -3.6h7.2v7.2h-7.2z",
        "triangle": "m0 -4.8l4.6 8.2h-9.2z",
        "diamond": "m0 -5l4.4 5l-4.4 5l-4.4 -5z",
    }[shape]
    return svg('<path class="{}" d="M{:.1f} {:.1f}{}"/>', kind, x, y, outline)


def _words(labels: Sequence[tuple[float, float, str]], x: _Axis, y: _Axis, log_y: bool) -> Iterator[Svg]:
    for px, py, text in labels:
        if _drawable((px, py), log_y):
            at_x, at_y = x.at(px), y.at(py)
            above = at_y < (TOP + HEIGHT - BOTTOM) / 2
            anchor = "end" if at_x > (LEFT + WIDTH - RIGHT) / 2 else "start"
            yield _text(at_x, at_y + (-10 if above else 20), text, anchor, "word")
