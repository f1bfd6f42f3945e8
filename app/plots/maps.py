"""Maps: the lens over zoom and focus, its distortion over the picture, and the overlay error to expect."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.ticker import LogLocator

from app.lens_at import lens_at
from app.plots import curves
from app.plots.sheet import (
    ACCENT,
    FAILED,
    FOCUS,
    INK,
    K1,
    K2,
    SOFT,
    ZOOM,
    Sheet,
    alone,
    around_zero,
    fit_of,
    is_area,
    named,
    place,
)
from calibration.compare import grid_pixels, predicted_overlay
from calibration.lens import Lens
from calibration.surface import LensSurface, SurfaceFit
from calibration.tables import LensTable
from calibration.types import FloatArray

_ACROSS = (121, 61)
# Places over zoom and focus; a contour is smooth at that.
_CELLS = 16
# Cells of the grid over the picture's width.
_LINE_POINTS = 121
_FLAT, _SAME_SHADE = 1e-9, 0.01
# px, and the share of a value, below which a map is taken to be of one value.
_LABEL_EDGE, _LABEL_ROOM = 0.07, (0.15, 0.08)
# Shares of the axes: a label nearer to the border, or to another, is left away.


def surfaces(table: LensTable) -> Sheet:
    """Field of view and distortion over zoom and focus; over one of them where the levels span only that."""
    fit = fit_of(table)
    surface = fit.surface
    title = f"The lens over zoom and focus: {named(table)}"
    if not is_area(surface):
        over_focus = surface.focus_range[1] > surface.focus_range[0]
        sheet = Sheet(title, _one_axis(surface))
        curves.lines(sheet, sheet.axes(1, 3), table, fit, curves.LENS, over_focus=over_focus)
        return sheet
    sheet = Sheet(title, "contours of the surface through all levels; dots: the levels it rests on")
    zoom, focus = _mesh(surface)
    batch = surface.at_many(zoom.ravel(), focus.ravel())
    first, second, third = panels = sheet.axes(1, 3)
    for axes in panels:  # before the contours: where their labels go depends on the limits
        _levels(axes, fit)
    f_px = batch.f_px.reshape(zoom.shape)
    drawn = first.pcolormesh(zoom, focus, f_px, norm=LogNorm(), cmap="viridis", shading="gouraud", rasterized=True)
    contours(first, zoom, focus, batch.fov_x_deg.reshape(zoom.shape), "%.3g°", even_log=True)
    sheet.bar(drawn, first, "focal length, px (log)", LogLocator(10, (1, 1.5, 2, 3, 5, 7)))
    first.set_title("Field of view (lines), focal length")
    for axes, values, name in ((second, batch.k1_hw, K1), (third, batch.k2_hw, K2)):
        shaped = values.reshape(zoom.shape)
        cmap, norm = around_zero(shaped)
        drawn = axes.pcolormesh(zoom, focus, shaped, norm=norm, cmap=cmap, shading="gouraud", rasterized=True)
        contours(axes, zoom, focus, shaped, "%.3g")
        sheet.bar(drawn, axes, name)
        axes.set_title(f"Distortion {name[:2]}")
    return sheet


def grid(table: LensTable, zoom: float | None, focus: float | None) -> Sheet:
    """What the lens does to a square grid, and how far it moves each pixel."""
    at = _place(fit_of(table).surface, zoom, focus)
    lens = lens_at(table, *at)
    straight = Lens(lens.image_size, lens.f_px, 0.0, 0.0, lens.center_shift_px, lens.pixel_aspect)
    pixels = grid_pixels(lens.image_size)
    rays = lens.unproject(pixels)
    moved = np.linalg.norm(pixels - straight.project(rays), axis=-1)
    most = float(np.nanmax(moved))
    remark = (
        f"{place(*at)}: FoV {lens.fov_x_deg:.3f}°, k1 {lens.k1_hw:+.4f}, k2 {lens.k2_hw:+.4f} (half width = 1); "
        f"distortion moves a pixel by at most {most:.2f} px"
    )
    sheet = Sheet(f"Distortion: {named(table)}", remark, 7.4)
    (axes,) = sheet.axes(1, 1)
    picture(axes, lens.image_size)
    if most > _FLAT:
        drawn = axes.pcolormesh(
            pixels[..., 0], pixels[..., 1], moved, cmap="Purples", norm=Normalize(0, most * 1.6), shading="gouraud",
            rasterized=True,
        )  # fmt: skip
        sheet.bar(drawn, axes, "moved by distortion, px")
        drawn.colorbar.ax.set_ylim(0, most)  # type: ignore[union-attr]
    for line in _grid_lines(lens, rays):
        axes.plot(*straight.project(line).T, color=SOFT, linewidth=0.9, dashes=(4, 3))
        axes.plot(*lens.project(line).T, color=ACCENT, linewidth=1.5)
    axes.plot([], [], color=ACCENT, linewidth=1.5, label="through the lens")
    axes.plot([], [], color=SOFT, linewidth=0.9, dashes=(4, 3), label="without distortion")
    axes.plot(*lens.principal_point_px, "+", color=FAILED, markersize=13, markeredgewidth=1.8, label="principal point")
    sheet.figure.legend(loc="outside lower left", ncols=3)
    return sheet


def uncertainty(table: LensTable, zoom: float | None, focus: float | None) -> Sheet:
    """The overlay error to expect: over the picture at a place, and its largest over zoom and focus."""
    fit = fit_of(table)
    at = _place(fit.surface, zoom, focus)
    lens_at(table, *at)
    found = fit.surface.at(*at)
    expected = predicted_overlay(found.lens, covariance_of(fit.surface, *at))
    remark = (
        f"one sigma, from the fit over all levels; at {place(*at)}: {expected.rms_px:.3f} px RMS, "
        f"{expected.max_px:.3f} px at most"
    )
    sheet = Sheet(f"Overlay error to expect: {named(table)}", remark, 4.7)
    left, right = sheet.axes(1, 2, (1.15, 1))
    pixels = grid_pixels(table.image_size)
    picture(left, table.image_size)
    left.set_title(f"Over the picture, {place(*at)}")
    px_map(sheet, left, pixels, expected.map_px, "expected overlay error, px")
    _over_places(sheet, right, fit, at)
    return sheet


def px_map(sheet: Sheet, axes: Axes, pixels: FloatArray, values: FloatArray, label: str) -> None:
    """A map of px over the picture, from 0, with its contours."""
    most = float(np.nanmax(values))
    norm = Normalize(0, most if most > _FLAT else 1.0)
    drawn = axes.pcolormesh(
        pixels[..., 0], pixels[..., 1], values, norm=norm, cmap="viridis", shading="gouraud", rasterized=True
    )
    contours(axes, pixels[..., 0], pixels[..., 1], values, "%.3g")
    sheet.bar(drawn, axes, label)


def covariance_of(surface: LensSurface, zoom: float, focus: float) -> FloatArray:
    """Covariance (5, 5) of (f_px, k1, k2, sx, sy) at a place, from that of the surface's quantities: with h the half
    width, d(f) = f d(log f), k1 = k1_hw / h^2 and d(h^2) = -2 h^2 d(log f), the same for k2 with h^4."""
    lens = surface.at(zoom, focus).lens
    h2 = lens.half_width**2
    to_lens = np.diag([lens.f_px, 1 / h2, 1 / h2**2, 1.0, 1.0])
    to_lens[1, 0], to_lens[2, 0] = 2 * lens.k1, 4 * lens.k2
    covariance = surface.model.covariance(np.array([zoom]), np.array([focus]))[0]
    return np.asarray(to_lens @ covariance @ to_lens.T)


def _over_places(sheet: Sheet, axes: Axes, fit: SurfaceFit, at: tuple[float, float]) -> None:
    surface = fit.surface
    axes.set_title("Largest in the picture, over zoom and focus")
    if is_area(surface):
        zoom, focus = _mesh(surface)
        values = surface.at_many(zoom.ravel(), focus.ravel()).predicted_max_px.reshape(zoom.shape)
        norm = Normalize(0, float(values.max()) or 1.0)
        _levels(axes, fit)
        drawn = axes.pcolormesh(zoom, focus, values, norm=norm, cmap="viridis", shading="gouraud", rasterized=True)
        contours(axes, zoom, focus, values, "%.3g")
        sheet.bar(drawn, axes, "expected overlay error, px")
        axes.plot(*at, "D", markersize=8, markerfacecolor="none", markeredgecolor="white", markeredgewidth=2, zorder=7)
        axes.plot(*at, "D", markersize=9.5, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=1, zorder=7)
        return
    over_focus = surface.focus_range[1] > surface.focus_range[0]
    low, high = surface.focus_range if over_focus else surface.zoom_range
    used = [check for check in fit.checks if check.used]
    levels = np.array([[check.zoom, check.focus] for check in used])
    if high > low:
        along = np.linspace(low, high, 2 * _ACROSS[0])
        still = np.full(len(along), surface.zoom_range[0] if over_focus else surface.focus_range[0])
        zoom, focus = (still, along) if over_focus else (along, still)
        axes.plot(along, surface.at_many(zoom, focus).predicted_max_px, color=ACCENT, linewidth=1.6)
    values = surface.at_many(levels[:, 0], levels[:, 1]).predicted_max_px
    axes.plot(levels[:, 1 if over_focus else 0], values, "o", color=ACCENT, markeredgecolor="white", label="levels")
    axes.plot(
        at[1 if over_focus else 0], surface.at(*at).predicted_px.max, "D", markersize=9, markerfacecolor="none",
        markeredgecolor=INK, label="the place at the left",
    )  # fmt: skip
    axes.set_title(_one_axis(surface)[:1].upper() + _one_axis(surface)[1:].split(";")[0])
    axes.set_xlabel(FOCUS if over_focus else ZOOM)
    axes.set_ylabel("expected overlay error, px")
    axes.set_ylim(0, 1.15 * axes.dataLim.y1 or 1.0)
    alone(axes, levels[:, 1 if over_focus else 0])
    axes.legend(loc="best")


def _one_axis(surface: LensSurface) -> str:
    (zoom, tele), (focus, near) = surface.zoom_range, surface.focus_range
    if tele > zoom:
        return f"all levels stand at one focus, {focus:.2f}; over zoom"
    if near > focus:
        return f"all levels stand at one zoom, {zoom:.3f}; over focus"
    return f"one level, {place(zoom, focus)}; there is nothing to interpolate"


def _place(surface: LensSurface, zoom: float | None, focus: float | None) -> tuple[float, float]:
    return surface.zoom_range[0] if zoom is None else zoom, surface.focus_range[0] if focus is None else focus


def _mesh(surface: LensSurface) -> tuple[FloatArray, FloatArray]:
    zoom, focus = np.meshgrid(
        np.linspace(*surface.zoom_range, _ACROSS[0]), np.linspace(*surface.focus_range, _ACROSS[1])
    )
    return zoom, focus


def contours(axes: Axes, x: FloatArray, y: FloatArray, values: FloatArray, label: str, even_log: bool = False) -> None:
    """Labelled contours; none where the values are all but the same."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if high - low <= _SAME_SHADE * max(abs(low), abs(high), _FLAT):
        return
    if even_log and high > 1.5 * low > 0:
        levels = np.unique([float(f"{level:.2g}") for level in np.geomspace(low, high, 9)[1:-1]])
        lines = axes.contour(x, y, values, levels=levels, colors="white", linewidths=1.1)
    else:
        lines = axes.contour(x, y, values, levels=7, colors="white", linewidths=1.1)
    to_share = axes.transData + axes.transAxes.inverted()
    kept: list[FloatArray] = []
    for text in axes.clabel(lines, fmt=label, fontsize=9, colors=INK, inline=False):
        at = np.asarray(to_share.transform(text.get_position()))
        crowded = any(np.all(np.abs(at - other) < _LABEL_ROOM) for other in kept)
        if crowded or np.min(at) < _LABEL_EDGE or np.max(at) > 1 - _LABEL_EDGE:
            text.set_visible(False)
            continue
        kept.append(at)
        text.set_bbox({"boxstyle": "round,pad=0.18", "facecolor": "white", "edgecolor": "none", "alpha": 0.85})
        text.set(rotation=0, zorder=8)


def _levels(axes: Axes, fit: SurfaceFit) -> None:
    """The levels on a map over zoom and focus, those left out crossed."""
    used = [(check.zoom, check.focus) for check in fit.checks if check.used]
    axes.plot(
        *zip(*used, strict=True), "o", color=INK, markersize=4.5, markeredgecolor="white", clip_on=False, zorder=5
    )
    out = [(check.zoom, check.focus) for check in fit.checks if not check.used]
    if out:
        axes.plot(*zip(*out, strict=True), "X", color=FAILED, markersize=9, markeredgecolor="white", clip_on=False,
                  zorder=6)  # fmt: skip
    axes.set_xlabel(ZOOM)
    axes.set_ylabel(FOCUS)
    axes.grid(False)
    axes.set_xlim(*fit.surface.zoom_range)
    axes.set_ylim(*fit.surface.focus_range)


def picture(axes: Axes, image_size: tuple[int, int]) -> None:
    """Axes of the picture: v down, pixels square, its border drawn."""
    width, height = image_size
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(True)
    axes.set_xlabel("u, px")
    axes.set_ylabel("v, px")


def _grid_lines(lens: Lens, rays: FloatArray) -> list[FloatArray]:
    """Straight lines (N, 2) of rays, square cells about the optical axis, that cover the picture."""
    step = lens.image_size[0] / lens.f_px / _CELLS
    low, high = np.nanmin(rays, axis=(0, 1)), np.nanmax(rays, axis=(0, 1))
    found = []
    for axis in (0, 1):
        along = np.linspace(low[1 - axis] - step, high[1 - axis] + step, _LINE_POINTS)
        for count in range(int(np.floor(low[axis] / step)), int(np.ceil(high[axis] / step)) + 1):
            line = np.empty((_LINE_POINTS, 2))
            line[:, axis] = count * step
            line[:, 1 - axis] = along
            found.append(line)
    return found
