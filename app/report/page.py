"""From a report's data to its page: what is said, in which order, and the file itself."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from app.report.between import between_view
from app.report.figures import charts
from app.report.levels import Notes, evidence_row, lens_rows, level_view
from app.report.model import LevelReport, RunReport
from app.report.numbers import encoder, pixels
from calibration.tables import LensTable, LevelStatus

METHODS = {
    "joint": "joint least squares over all pictures of a level",
    "alternating": "alternating search, one coefficient after the other",
}


def render_report(report: RunReport) -> str:
    """The report as one HTML document that loads nothing from anywhere. CPU work: run it off the event loop."""
    notes = Notes()
    opened = _opened(report.levels)
    levels = [level_view(level, report.table, level.key in opened) for level in report.levels]
    rows = [(view, lens_rows(level, report.table, notes)) for view, level in zip(levels, report.levels, strict=True)]
    evidence = [(view, evidence_row(level, notes)) for view, level in zip(levels, report.levels, strict=True)]
    return template("report.html.j2").render(
        title=report.title,
        table=report.table,
        created=f"{report.table.created:%Y-%m-%d %H:%M} UTC",
        method=METHODS.get(report.table.method, report.table.method),
        verdict=verdict(report),
        tone=_tone(report),
        facts=[*_table_facts(report.table), *report.facts],
        charts=charts(report),
        between=between_view(report.table),
        levels=levels,
        lens_rows=rows,
        evidence=evidence,
        with_truth=any(level.truth is not None for level in report.levels),
        truth_name=report.truth_name,
        notes=notes.entries,
        left_out=[(view, view.left_out) for view in levels if view.left_out],
        version=product_version(),
    )


def template(name: str) -> Template:
    """A template of this package; what is undefined in it is an error, every text is escaped."""
    return _environment().get_template(name)


def write_report(path: Path, report: RunReport) -> None:
    """Write the report, the whole file or none. Raises OSError."""
    text = render_report(report)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    try:
        beside.write_text(text, encoding="utf-8", newline="\n")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def verdict(report: RunReport) -> str:
    """The result in one sentence."""
    results = [level.result for level in report.levels]
    count = {status: sum(r.status is status for r in results) for status in LevelStatus}
    parts = [f"{count[LevelStatus.OK]} of {len(results)} levels ok"]
    for status in (LevelStatus.DEGRADED, LevelStatus.FAILED):
        if count[status]:
            parts[0] += f", {count[status]} {status.value}"
    expected = [r.predicted_overlay_px.max for r in results if r.predicted_overlay_px is not None]
    if expected:
        parts.append(f"largest expected overlay error {pixels(max(expected))} px")
    true = [level.error.max_px for level in report.levels if level.error is not None]
    if true:
        parts.append(f"against {report.truth_name} at most {pixels(max(true))} px")
    return "; ".join(parts) + "."


def product_version() -> str:
    """The installed product's version."""
    try:
        return metadata.version("lensmatch")
    except metadata.PackageNotFoundError:
        return "from its sources"


def _tone(report: RunReport) -> str:
    statuses = {level.result.status for level in report.levels}
    for status in (LevelStatus.FAILED, LevelStatus.DEGRADED):
        if status in statuses:
            return status.value
    return LevelStatus.OK.value


def _opened(levels: list[LevelReport]) -> set[tuple[float, float]]:
    """The levels shown unfolded: the first, the worst measured one, and every one that is not ok."""
    opened = {level.key for level in levels if level.result.status is not LevelStatus.OK}
    measured = [level for level in levels if not level.failed]
    if measured:
        opened.add(measured[0].key)
        opened.add(max(measured, key=LevelReport.badness_px).key)
    return opened


def _table_facts(table: LensTable) -> list[tuple[str, str]]:
    zooms = {level.zoom for level in table.levels}
    focuses = {level.focus for level in table.levels}
    width, height = table.image_size
    facts = [
        ("levels", f"{len(table.levels)} (zoom {_range(zooms)}, focus {_range(focuses)})"),
        (
            "picture",
            f"{width} × {height} px" + (f", pixel aspect {table.pixel_aspect:g}" if table.pixel_aspect != 1 else ""),
        ),
    ]
    if table.sensor_mm is not None:
        facts.append(("sensor", f"{table.sensor_mm[0]:g} × {table.sensor_mm[1]:g} mm"))
    return facts


def _range(values: set[float]) -> str:
    low, high = encoder(min(values)), encoder(max(values))
    return low if low == high else f"{low} to {high}"


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("app.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters: Mapping[str, Any] = {"px": pixels, "encoder": encoder}
    environment.filters.update(filters)
    return environment
