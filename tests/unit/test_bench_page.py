"""The benchmarks' page: every figure in its table, one mark for each figure compared, texts escaped."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from app.report.bench import BenchSection, bench_page, dot_plot
from app.report.dots import draw_dots
from benchmarks.rows import readable

ROWS: list[dict[str, object]] = [
    {"case": "sharp", "method": "ours", "rmse_px": 0.002, "found": True},
    {"case": "sharp", "method": "theirs <&>", "rmse_px": 0.2, "found": True},
    {"case": "blurred", "method": "ours", "rmse_px": 0.01, "found": True},
    {"case": "blurred", "method": "theirs <&>", "rmse_px": math.nan, "found": False},
    {"case": "skipped", "method": "ours", "rmse_px": None, "found": None},
]


def page() -> str:
    columns = [(name, readable) for name in ROWS[0]]
    section = BenchSection("detect", "finding a board", ROWS, columns, (("rmse_px", "error, px"), ("found", "found")))
    return bench_page([section], {"cores": 2}, datetime(2026, 11, 25, tzinfo=UTC))


def test_the_page_has_every_figure_and_loads_nothing() -> None:
    html = page()
    for text in ("0.002", "0.2", "0.01", "blurred", "theirs &lt;&amp;&gt;", "cores", "2026-11-25"):
        assert text in html
    assert "theirs <&>" not in html
    assert "http" not in html.replace("http-equiv", "")


def test_a_mark_stands_for_each_number_and_for_nothing_else() -> None:
    plot = dot_plot(ROWS, "rmse_px", "error, px")
    assert plot.cases == ["sharp", "blurred"]
    assert plot.log, "the figures span a factor of a hundred"
    assert draw_dots(plot).count('class="dot') == 3


def test_a_column_without_numbers_is_not_drawn() -> None:
    assert not draw_dots(dot_plot(ROWS, "found", "found"))
    assert page().count('<svg class="chart') == 1


def test_the_scale_of_a_plot_grows_to_the_right() -> None:
    drawn = draw_dots(dot_plot([ROWS[0], ROWS[2]], "rmse_px", "error, px"))
    places = [float(part.split('"')[0]) for part in drawn.split('cx="')[1:]]
    assert places[0] < places[1]
