"""A lens table for a person: what was measured level by level, how well, and what was left out."""

from __future__ import annotations

from collections.abc import Iterable

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from app.cli.console import messages, results
from calibration.tables import LensTable, LevelResult, LevelStatus, PixelError

_WIDEST = 400

_COLOURS = {LevelStatus.OK: "green", LevelStatus.DEGRADED: "yellow", LevelStatus.FAILED: "red"}


def plain_table(title: str, names: tuple[str, ...]) -> Table:
    """An empty table in the house's look, numbers to the right."""
    table = Table(
        title=escape(title), title_style="dim", header_style="bold", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1)
    )
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def print_table(table: Table) -> None:
    """Print a table whole: where the terminal is narrower, its lines wrap instead of losing figures."""
    wide = Console(width=_WIDEST)
    natural = Measurement.get(wide, wide.options, table).maximum
    Console(file=results.file, width=max(natural, results.width), highlight=False, soft_wrap=True).print(table)


def show_table(table: LensTable) -> None:
    """Print the levels; reasons and pictures left out go to standard error, one line each."""
    grid = plain_table(
        f"{table.lens} on {table.camera}, {table.method}; each value with its sigma below; errors RMS, px",
        (
            "zoom",
            "focus",
            "",
            "FoV x deg",
            "k1",
            "k2",
            "shift x",
            "y px",
            "nodal mm",
            "residual",
            "held out",
            "expected",
            "pics",
        ),
    )
    for level in table.levels:
        _add_level(grid, level)
    print_table(grid)
    for level in table.levels:
        _tell_reasons(level)


def tell_failed(levels: Iterable[LevelResult]) -> None:
    """Each failed level with its reason, one line each on standard error."""
    for level in levels:
        if level.status is LevelStatus.FAILED:
            _tell_reason(level)


def _add_level(grid: Table, level: LevelResult) -> None:
    colour = _COLOURS[level.status]
    place = (f"{level.zoom:.3f}", f"{level.focus:.2f}", f"[{colour}]{level.status.value}[/]")
    taken = level.frames.real + level.frames.virtual
    gone = len({left.picture for left in level.left_out})
    pictures = f"{max(level.frames.real - gone, 0)}/{level.frames.real}"
    if level.frames.virtual:
        pictures = f"{level.frames.real}+{level.frames.virtual}"
    if level.status is LevelStatus.FAILED:
        grid.add_row(*place, *[""] * 9, pictures if taken else "")
        return
    shift = level.center_shift_px or (None, None)
    grid.add_row(
        *place,
        "-" if level.fov_x_deg is None else f"{level.fov_x_deg:.4f}",
        _number(level.k1, 5),
        _number(level.k2, 5),
        _number(shift[0], 3),
        _number(shift[1], 3),
        _number(level.nodal_offset_mm, 2),
        _error(level.residual_px),
        _error(level.held_out_px),
        _error(level.predicted_overlay_px),
        pictures,
    )
    sigma = level.sigma
    if sigma is None:
        return
    shift_sigma = sigma.center_shift_px or (None, None)
    values = (sigma.fov_x_deg, sigma.k1, sigma.k2, *shift_sigma, sigma.nodal_offset_mm)
    digits = (4, 5, 5, 3, 3, 2)
    told = ["" if value is None else f"{value:.{n}f}" for value, n in zip(values, digits, strict=True)]
    grid.add_row("", "", "", *told, style="dim")


def _tell_reason(level: LevelResult) -> None:
    if level.reason:
        colour = _COLOURS[level.status]
        messages.print(f"[{colour}]{_where(level)} {level.status.value}:[/] {escape(level.reason)}")


def _where(level: LevelResult) -> str:
    return f"zoom {level.zoom:.3f}, focus {level.focus:.2f}"


def _tell_reasons(level: LevelResult) -> None:
    _tell_reason(level)
    if (seen := level.parallax) is not None:
        messages.print(
            f"[dim]{_where(level)}: over a pan of {seen.pan_deg:.1f} deg a thing at {seen.near_m:.1f} m moves "
            f"{seen.as_given_px:.2f} px against one at {seen.far_m:.1f} m with the nodal offset as it was given, "
            f"{seen.sigma_px:.3f} px (one sigma) with the one found[/]"
        )
    for left in level.left_out:
        messages.print(f"[dim]{_where(level)}: left out {escape(left.picture)}: {escape(left.reason)}[/]")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:+.{digits}f}"


def _error(error: PixelError | None) -> str:
    return "-" if error is None else f"{error.rms:.3f}"
