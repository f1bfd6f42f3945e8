"""Two tables in one picture: how many pixels they are apart over zoom and focus, and how, where it is worst."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from app.comparison import verdict
from app.lens_at import between_levels, lens_at
from app.plots.maps import contours, picture, px_map
from app.plots.sheet import FAILED, FOCUS, INK, LINES, SOFT, ZOOM, Sheet, alone, named, place
from calibration.compare import grid_pixels
from calibration.compare_tables import DifferenceMap, PlaceDifference, TableComparison, compare_tables
from calibration.tables import LensTable

_ARROWS = 4
# Every so many pixels of the comparison grid one arrow.


def comparison(first: LensTable, second: LensTable) -> Sheet:
    """Raises :class:`calibration.errors.InvalidInput` where the two cannot be compared."""
    found = compare_tables(first, second, between_levels(first), between_levels(second))
    sheet = Sheet(f"{named(first)}, against {named(second)}", verdict(found), 4.7)
    left, right = sheet.axes(1, 2, (1, 1.15))
    _places(sheet, left, found)
    _worst(sheet, right, first, second, found)
    return sheet


def _places(sheet: Sheet, axes: Axes, found: TableComparison) -> None:
    axes.set_title("Farthest apart in the picture, over zoom and focus")
    grid = found.grid
    if grid is not None and len(set(grid.zooms)) > 1 and len(set(grid.focuses)) > 1:
        _map(sheet, axes, grid, found)
        return
    told = [one for one in found.levels if one.difference_px is not None]
    over_focus = len({one.zoom for one in told}) == 1 and len({one.focus for one in told}) > 1
    between = [one for one in (grid.places if grid is not None else ()) if one.difference_px is not None]
    axes.set_title(f"Farthest apart in the picture, over {'focus' if over_focus else 'zoom'}")
    if len(between) > 1:
        axes.plot(*_along(between, over_focus, "max"), color=LINES[0], linewidth=1.6, label="largest")
        axes.plot(*_along(between, over_focus, "rms"), color=LINES[1], linewidth=1.6, label="RMS")
    axes.plot(*_along(told, over_focus, "max"), "o", color=LINES[0], markeredgecolor="white", label="levels, largest")
    axes.plot(*_along(told, over_focus, "rms"), "o", color=LINES[1], markeredgecolor="white", label="levels, RMS")
    axes.plot(
        *_along([found.worst], over_focus, "max"), "*", color=FAILED, markersize=14, markeredgecolor="white",
        label="worst place", zorder=6,
    )  # fmt: skip
    axes.set_xlabel(FOCUS if over_focus else ZOOM)
    axes.set_ylabel("distance of the same ray, px")
    axes.set_ylim(0, 1.15 * found.difference_px.max or 1.0)
    alone(axes, np.array([one.focus if over_focus else one.zoom for one in told or [found.worst]]))
    axes.legend(loc="best")


def _map(sheet: Sheet, axes: Axes, grid: DifferenceMap, found: TableComparison) -> None:
    shape = (len(grid.focuses), len(grid.zooms))
    values = np.array([np.nan if one.difference_px is None else one.difference_px.max for one in grid.places])
    values = values.reshape(shape)
    zoom, focus = np.meshgrid(grid.zooms, grid.focuses)
    axes.set_xlim(grid.zooms[0], grid.zooms[-1])
    axes.set_ylim(grid.focuses[0], grid.focuses[-1])
    most = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    if np.isfinite(values).all():
        drawn = axes.pcolormesh(
            zoom, focus, values, norm=Normalize(0, most or 1.0), cmap="viridis", shading="gouraud", rasterized=True
        )
        contours(axes, zoom, focus, values, "%.3g")
    else:  # what is not told stays white
        drawn = axes.pcolormesh(
            zoom, focus, np.ma.masked_invalid(values), norm=Normalize(0, most or 1.0), cmap="viridis",
            shading="nearest", rasterized=True,
        )  # fmt: skip
    sheet.bar(drawn, axes, "distance of the same ray, px")
    levels = [(one.zoom, one.focus) for one in found.levels if one.difference_px is not None]
    if levels:
        axes.plot(
            *zip(*levels, strict=True), "o", color=INK, markersize=4.5, markeredgecolor="white", clip_on=False,
            label="levels",
        )  # fmt: skip
    axes.plot(
        found.worst.zoom, found.worst.focus, "*", color=FAILED, markersize=15, markeredgecolor="white", clip_on=False,
        zorder=6,
    )  # fmt: skip
    axes.set_xlabel(ZOOM)
    axes.set_ylabel(FOCUS)
    axes.grid(False)


def _worst(sheet: Sheet, axes: Axes, first: LensTable, second: LensTable, found: TableComparison) -> None:
    """The picture at the worst place: distance, and the way from the first table's pixel to the second's."""
    at = (found.worst.zoom, found.worst.focus)
    lenses = [lens_at(table, *at) for table in (first, second)]
    pixels = grid_pixels(first.image_size)
    way = lenses[1].project(lenses[0].unproject(pixels)) - pixels
    picture(axes, first.image_size)
    axes.set_title(f"Over the picture where it is worst, {place(*at)}")
    distance = np.linalg.norm(way, axis=-1)
    px_map(sheet, axes, pixels, distance, "distance of the same ray, px")
    if float(np.nanmax(distance)) > 0:
        some = (slice(_ARROWS // 2, None, _ARROWS), slice(_ARROWS // 2, None, _ARROWS))
        axes.quiver(
            pixels[..., 0][some], pixels[..., 1][some], way[..., 0][some], way[..., 1][some], color="white",
            angles="xy", width=0.0022, alpha=0.9,
        )  # fmt: skip
    if found.worst.worst_px is not None:
        axes.plot(
            *found.worst.worst_px, "*", color=FAILED, markersize=15, markeredgecolor="white", clip_on=False, zorder=6
        )
    note = "★ the farthest apart; arrows: from this table's pixel to the other's, not to scale"
    axes.annotate(
        note, (0, -0.2), xycoords="axes fraction",
        fontsize=8.5, color=SOFT,
    )  # fmt: skip


def _along(places: list[PlaceDifference], over_focus: bool, which: str) -> tuple[list[float], list[float]]:
    told = [(one.focus if over_focus else one.zoom, one.difference_px) for one in places]
    return [at for at, _ in told], [getattr(error, which) for _, error in told]
