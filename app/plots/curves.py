"""The lens over its zoom range: a line for each focus, the band that holds 95 %, and the levels as measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from numpy.typing import NDArray

from app.plots.sheet import (
    FAILED,
    FOCUS,
    FOV,
    K1,
    K2,
    MOST_LINES,
    SOFT,
    ZOOM,
    Sheet,
    alone,
    fit_of,
    line_colours,
    log_ticks,
    named,
)
from calibration.surface import LensSurface, SurfaceFit
from calibration.surface.quantities import LevelData
from calibration.tables import LensTable, LevelResult
from calibration.types import FloatArray

BAND_SIGMAS = 1.96
"""Half the width of bands and error bars, in sigmas: they hold 95 %."""
_STEPS = 161
_SAME = 1e-6
_CROSS_ROOM = 0.25


@dataclass(frozen=True, slots=True)
class Quantity:
    """What one panel shows. ``column``: of the surface's quantities, None for the nodal offset; ``told``, ``stated``:
    whether a level has it, and states its sigma."""

    title: str
    label: str
    column: int | None
    told: Callable[[LevelResult], bool]
    stated: Callable[[LevelResult], bool]


_FOV = Quantity("Field of view", FOV, 0, lambda r: True, lambda r: r.sigma.fov_x_deg is not None)
_K1 = Quantity("Distortion k1", K1, 1, lambda r: r.k1 is not None, lambda r: r.sigma.k1 is not None)
_K2 = Quantity("Distortion k2", K2, 2, lambda r: r.k2 is not None, lambda r: r.sigma.k2 is not None)
_SHIFT_X, _SHIFT_Y = (
    Quantity(
        f"Centre shift, {axis}",
        f"{axis}, px ({way} positive)",
        column,
        lambda r: r.center_shift_px is not None,
        lambda r: r.sigma.center_shift_px is not None,
    )
    for axis, way, column in (("x", "right", 3), ("y", "down", 4))
)
_NODAL = Quantity(
    "Nodal offset",
    "pivot to entrance pupil, mm",
    None,
    lambda r: r.nodal_offset_mm is not None,
    lambda r: r.sigma.nodal_offset_mm is not None,
)
LENS = (_FOV, _K1, _K2)
ALL = (*LENS, _SHIFT_X, _SHIFT_Y, _NODAL)


def curves(table: LensTable) -> Sheet:
    """Every quantity over zoom."""
    fit = fit_of(table)
    sheet = Sheet(f"The lens over its zoom: {named(table)}", _remark(fit), 7.4)
    panels = sheet.axes(2, 3)
    lines(sheet, panels, table, fit, ALL, over_focus=False)
    return sheet


def lines(
    sheet: Sheet,
    panels: list[Axes],
    table: LensTable,
    fit: SurfaceFit,
    quantities: tuple[Quantity, ...],
    *,
    over_focus: bool,
) -> None:
    """A panel for each quantity over zoom, or over focus, and their common legend under them."""
    points = _Points.of(table, fit, over_focus)
    shown: dict[str, Artist] = {}
    for axes, quantity in zip(panels, quantities, strict=True):
        axes.set_title(quantity.title)
        axes.set_xlabel(FOCUS if over_focus else ZOOM)
        axes.set_ylabel(quantity.label)
        axes.margins(x=0.03)
        if quantity.column is None and not fit.surface.nodal_told:
            axes.text(0.5, 0.5, "no level tells it", transform=axes.transAxes, ha="center", color=SOFT, style="italic")
            axes.set_xticks([])
            axes.set_yticks([])
            continue
        _panel(axes, quantity, points, fit.surface)
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    sheet.figure.legend(
        list(shown.values()), list(shown), loc="outside lower left", ncols=min(len(shown), 6), handlelength=1.6
    )


@dataclass(frozen=True, slots=True)
class _Points:
    """The levels with a lens as points: coordinates, values and sigmas in the units shown, and whether each is used.
    ``failed``: where levels without a lens stand; ``fixed``: the values of the other axis that lines are drawn at."""

    levels: tuple[LevelResult, ...]
    along: FloatArray
    fixed_at: FloatArray
    values: FloatArray
    sigma: FloatArray
    used: FloatArray
    failed: tuple[float, ...]
    name: str
    over_focus: bool

    @classmethod
    def of(cls, table: LensTable, fit: SurfaceFit, over_focus: bool) -> _Points:
        data = LevelData.of(table)
        levels = tuple(table.levels[i] for i in data.index)
        fov = np.array([level.fov_x_deg for level in levels], dtype=np.float64)
        values = np.column_stack([fov, data.values[:, 1:], data.nodal_mm])
        sigma = np.sqrt(np.column_stack([np.einsum("nii->ni", data.covariance), data.nodal_variance]))
        sigma[:, 0] = fov_sigma_deg(fov, sigma[:, 0])
        along, fixed = (data.focus, data.zoom) if over_focus else (data.zoom, data.focus)
        bare = [level for level in table.levels if level.fov_x_deg is None]
        used = np.array([float(fit.checks[i].used) for i in data.index])
        failed = tuple(level.focus if over_focus else level.zoom for level in bare)
        return cls(levels, along, fixed, values, sigma, used, failed, "zoom" if over_focus else "focus", over_focus)

    def lines(self) -> list[tuple[float, float, float]]:
        """(other axis' value, from, to) of each line: where at least two levels span it."""
        found = []
        for value in np.unique(np.round(self.fixed_at / _SAME).astype(np.int64)) * _SAME:
            here = self.along[np.abs(self.fixed_at - value) <= _SAME]
            found.append((float(value), float(here.min()), float(here.max())))
        spanned = [line for line in found if line[2] > line[1] + _SAME]
        kept = spanned if spanned else found
        chosen = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST_LINES)).round().astype(int))
        return [kept[i] for i in chosen]


def _panel(axes: Axes, quantity: Quantity, points: _Points, surface: LensSurface) -> None:
    column = 5 if quantity.column is None else quantity.column
    drawn = points.lines()
    taken = np.zeros(len(points.along), dtype=bool)
    seen = []
    for (fixed, low, high), colour in zip(drawn, line_colours(len(drawn)), strict=True):
        here = np.abs(points.fixed_at - fixed) <= _SAME
        taken |= here
        label = f"{points.name} {fixed:.2f}"
        if high > low:
            along = np.linspace(low, high, _STEPS)
            at = (np.full(_STEPS, fixed), along) if points.over_focus else (along, np.full(_STEPS, fixed))
            mean, sigma = read(surface, *at)
            half = BAND_SIGMAS * sigma[:, column]
            band = (mean[:, column] - half, mean[:, column] + half)
            axes.fill_between(along, *band, color=colour, alpha=0.18, linewidth=0)
            axes.plot(along, mean[:, column], color=colour, linewidth=1.6, label=label)
            seen.append(mean[:, column])
        _dots(axes, quantity, points, column, here, colour, None if high > low else label)
    _dots(axes, quantity, points, column, ~taken, SOFT, "levels at other places")
    told = np.array([quantity.told(level) for level in points.levels])
    left_out = told & (points.used == 0)
    if left_out.any():
        _crosses(axes, points.along[left_out], points.values[left_out, column])
    if points.failed:
        axes.plot(
            points.failed,
            np.full(len(points.failed), 0.02),
            "x",
            color=FAILED,
            markersize=6,
            transform=axes.get_xaxis_transform(),
            label="level without a lens",
            clip_on=False,
        )
    alone(axes, points.along)
    if column == 0:
        log_ticks(axes, np.concatenate([points.values[:, 0], *seen]))
    elif min(axes.get_ylim()) < 0 < max(axes.get_ylim()):
        axes.axhline(0, color=SOFT, linewidth=0.8, alpha=0.6, zorder=1)


def _crosses(axes: Axes, along: FloatArray, values: FloatArray) -> None:
    """Levels left out; one far outside stands at the border with its value: it would press the others together."""
    low, high = axes.get_ylim()
    room = _CROSS_ROOM * (high - low)
    inside = np.clip(values, low - room, high + room)
    axes.plot(
        along, inside, "X", color=FAILED, markersize=9, markeredgecolor="white", label="left out of the fit", zorder=6
    )
    for x, y, value in zip(along, inside, values, strict=True):
        if y != value:
            axes.annotate(f"{value:.3g}", (x, y), (8, 0), textcoords="offset points", color=FAILED, va="center")


def _dots(
    axes: Axes,
    quantity: Quantity,
    points: _Points,
    column: int,
    here: NDArray[np.bool_],
    colour: str,
    label: str | None,
) -> None:
    """Levels as points, with a bar where their sigma is stated."""
    told = np.array([quantity.told(level) for level in points.levels]) & here & (points.used > 0)
    if not told.any():
        return
    stated = np.array([quantity.stated(level) for level in points.levels])
    bars = np.where(stated, BAND_SIGMAS * points.sigma[:, column], 0.0)[told]
    axes.errorbar(
        points.along[told],
        points.values[told, column],
        yerr=bars,
        fmt="o",
        color=colour,
        markersize=5.5,
        markeredgecolor="white",
        markeredgewidth=0.8,
        elinewidth=1.1,
        capsize=2.5,
        label=label,
        zorder=4,
    )


def read(surface: LensSurface, zoom: FloatArray, focus: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(values, sigmas) (N, 6) at places (N,): FoV (deg), k1_hw, k2_hw, shift x, y (px), nodal offset (mm)."""
    batch = surface.at_many(zoom, focus)
    values = np.column_stack(
        [batch.fov_x_deg, batch.k1_hw, batch.k2_hw, batch.center_shift_px, np.nan_to_num(batch.nodal_offset_mm)]
    )
    variance = np.einsum("nii->ni", surface.model.covariance(zoom, focus))
    nodal = surface.model.nodal_sigma(zoom, focus)
    sigma = np.column_stack([np.sqrt(np.maximum(variance, 0.0)), np.zeros(len(zoom)) if nodal is None else nodal])
    sigma[:, 0] = fov_sigma_deg(batch.fov_x_deg, sigma[:, 0])
    return values, sigma


def fov_sigma_deg(fov_deg: FloatArray, log_f_sigma: FloatArray) -> FloatArray:
    """Sigma of the field of view from that of log f: d(fov) = -sin(fov) d(log f)."""
    return np.asarray(np.degrees(np.sin(np.radians(fov_deg)) * log_f_sigma))


def _remark(fit: SurfaceFit) -> str:
    used = sum(check.used for check in fit.checks)
    parts = [f"{used} of {len(fit.checks)} levels in the fit", "bands and bars: ± 1.96 sigma (95 %)"]
    if fit.held_out_px is not None:
        parts.append(f"held-out levels: {fit.held_out_px.rms:.2f} px RMS, {fit.held_out_px.max:.2f} px at most")
    else:
        parts.append("too few levels to hold one out")
    return "  ·  ".join(parts)
