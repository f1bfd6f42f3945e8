"""The benchmarks' figures as one page: a dot plot for each figure compared, and the whole table."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from app.report.dots import DotPlot, dot_legend, draw_dots
from app.report.figures import Figure
from app.report.page import product_version, template

Row = Mapping[str, object]


@dataclass(frozen=True, slots=True)
class BenchSection:
    """One benchmark's rows. ``columns``: (name, how a value is written); ``plots``: (column, title with its unit)."""

    name: str
    title: str
    rows: Sequence[Row]
    columns: Sequence[tuple[str, Callable[[Any], str]]]
    plots: Sequence[tuple[str, str]] = ()
    figures: list[Figure] = field(default_factory=list)

    def table(self) -> list[list[str]]:
        """The rows as text, in the order of the columns."""
        return [[text(row.get(name)) for name, text in self.columns] for row in self.rows]


def dot_plot(rows: Sequence[Row], column: str, title: str) -> DotPlot:
    """How ``column`` compares: cases and methods in the order of the rows, those with a number only."""
    values: dict[str, dict[str, float]] = {}
    cases: dict[str, None] = {}
    for row in rows:
        value = row.get(column)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            continue
        cases[str(row["case"])] = None
        values.setdefault(str(row["method"]), {})[str(row["case"])] = float(value)
    return DotPlot(title, title, list(cases), values)


def bench_page(sections: Sequence[BenchSection], machine: Mapping[str, object], created: datetime) -> str:
    """The page as one HTML document that loads nothing from anywhere."""
    for section in sections:
        for column, title in section.plots:
            plot = dot_plot(section.rows, column, title)
            drawn = draw_dots(plot)
            if drawn:
                section.figures.append(Figure(title, "", drawn, tuple(dot_legend(plot))))
    return template("bench.html.j2").render(
        sections=sections, machine=machine, created=f"{created:%Y-%m-%d %H:%M} UTC", version=product_version()
    )
