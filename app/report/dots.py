"""Dot plots as SVG: one line for each case, one mark for each method, on a common scale of the figure compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from app.report.charts import SERIES_COLOURS, legend_mark, log_ticks, marker, ticks
from app.report.svg import Svg, svg

WIDTH = 940.0
_ROW = 24.0
_TOP, _FOOT, _RIGHT = 10.0, 40.0, 18.0
_CHARACTER = 7.0
_LEAST_LABELS, _MOST_LABELS = 120.0, 380.0
_LOG_FROM_RATIO = 12.0
_STEPS_ACROSS = 8

Place = Callable[[float], float]
"""Where a figure stands across the plot."""


@dataclass(frozen=True, slots=True)
class DotPlot:
    """``values[method][case]``: the figure compared; a pair without one has no mark.

    The scale is logarithmic where all figures are positive and span more than a factor of twelve.
    """

    title: str
    x_title: str
    cases: Sequence[str]
    values: dict[str, dict[str, float]]

    @property
    def log(self) -> bool:
        """Whether the scale is logarithmic."""
        told = [value for of_case in self.values.values() for value in of_case.values()]
        return bool(told) and min(told) > 0 and max(told) / min(told) > _LOG_FROM_RATIO


def dot_legend(plot: DotPlot) -> list[tuple[Svg, str]]:
    """(mark, name) of each method."""
    return [(legend_mark(style, _hollow(style), False), name) for style, name in enumerate(plot.values)]


def draw_dots(plot: DotPlot) -> Svg:
    """The plot as an ``svg`` element; empty where nothing can be drawn."""
    told = [value for of_case in plot.values.values() for value in of_case.values()]
    if not told:
        return Svg("")
    longest = max(len(case) for case in plot.cases)
    left = min(max(longest * _CHARACTER + 14, _LEAST_LABELS), _MOST_LABELS)
    height = _TOP + _ROW * len(plot.cases) + _FOOT
    low, high = _span(told, plot.log)

    def at(value: float) -> float:
        share = math.log(value / low) / math.log(high / low) if plot.log else (value - low) / (high - low)
        return left + share * (WIDTH - left - _RIGHT)

    head = svg(
        '<svg class="chart dots" viewBox="0 0 {:.0f} {:.0f}" role="img" aria-label="{}">',
        WIDTH,
        height,
        f"{plot.title}: {plot.x_title}, {len(plot.cases)} cases, {len(plot.values)} methods",
    )
    return Svg("".join((head, *_scale(plot, low, high, at, height), *_rows(plot, left, at), Svg("</svg>"))))


def _span(values: Sequence[float], log: bool) -> tuple[float, float]:
    low, high = min(values), max(values)
    if log:
        pad = max((high / low) ** 0.04, 1.05)
        return low / pad, high * pad
    low, high = min(low, 0.0), max(high, 0.0)
    pad = 0.04 * (high - low) or 1.0
    return (low - pad if low < 0 else 0.0), high + pad


def _hollow(style: int) -> bool:
    # After four colours the marks are hollow, so that eight methods differ at a glance.
    return style // SERIES_COLOURS % 2 == 1


def _scale(plot: DotPlot, low: float, high: float, at: Place, height: float) -> Iterator[Svg]:
    values = log_ticks(low, high) if plot.log else ticks(low, high, _STEPS_ACROSS)
    bottom = height - _FOOT
    for value in values:
        x = at(value)
        yield svg('<path class="grid" d="M{:.1f} {:.1f}V{:.1f}"/>', x, _TOP, bottom)
        yield svg(
            '<text class="tick" x="{:.1f}" y="{:.1f}" text-anchor="middle">{}</text>', x, bottom + 16, f"{value:g}"
        )
    title = f"{plot.x_title} (log)" if plot.log else plot.x_title
    middle = (at(low) + at(high)) / 2
    yield svg('<text class="title" x="{:.1f}" y="{:.1f}" text-anchor="middle">{}</text>', middle, height - 6, title)


def _rows(plot: DotPlot, left: float, at: Place) -> Iterator[Svg]:
    for number, case in enumerate(plot.cases):
        y = _TOP + _ROW * (number + 0.5)
        yield svg(
            '<text class="word" x="{:.1f}" y="{:.1f}" text-anchor="end">{}</text>', left - 10, y + 4, _short(case)
        )
        yield svg('<path class="grid" d="M{:.1f} {:.1f}H{:.1f}"/>', left, y, WIDTH - _RIGHT)
        for style, (_, of_case) in enumerate(plot.values.items()):
            if case in of_case:
                yield marker(style, at(of_case[case]), y, _hollow(style))


def _short(case: str) -> str:
    most = int((_MOST_LABELS - 14) / _CHARACTER)
    return case if len(case) <= most else case[: most - 1] + "…"
