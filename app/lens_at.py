"""The lens of a table at any place: a level where one stands, else the surface over all levels."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.surface import LensSurface, SurfaceFit, fit_surface
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, LevelStatus

SAME_PLACE = 1e-6
"""Encoder values closer than this are one place: a head's protocol rounds them, a lens stands no more exactly."""

SURFACE_KIND = "Gaussian process over zoom and focus"
"""How a table's ``interpolation.kind`` names the surface."""

_NEAR = 0.02
# Encoder steps from a measured level within which another lens's level has nothing to add.
_KEPT_FITS = 8
# A client that follows a zoom asks for the same table again and again; a surface takes about 4 MB.


@functools.lru_cache(maxsize=_KEPT_FITS)
def surface_fit(table: LensTable) -> SurfaceFit:
    """The surface over a table's levels; the last few are kept. Raises :class:`calibration.errors.CalibrationError`."""
    return fit_surface(table)


def level_near(table: LensTable, zoom: float, focus: float) -> LevelResult | None:
    """The level that stands at this place, None where none does."""
    return next(
        (
            level
            for level in table.levels
            if abs(level.zoom - zoom) <= SAME_PLACE and abs(level.focus - focus) <= SAME_PLACE
        ),
        None,
    )


def lens_at(table: LensTable, zoom: float, focus: float) -> Lens:
    """The lens at a place within the levels' range. Raises :class:`InvalidInput` outside it, or where there is none."""
    level = level_near(table, zoom, focus)
    if level is not None and level.fov_x_deg is not None:
        return level.lens(table.image_size, table.pixel_aspect)
    return _inside(surface_fit(table).surface, zoom, focus)


def between_levels(table: LensTable) -> Callable[[float, float], Lens]:
    """The table's lens as a function of zoom and focus."""

    return lambda zoom, focus: surface_fit(table).surface.at(zoom, focus).lens


def table_at(table: LensTable, zoom: float, focus: float) -> LensTable:
    """The table of one level, the lens at this place. Raises :class:`InvalidInput` as :func:`lens_at`."""
    level = level_near(table, zoom, focus)
    if level is not None and level.fov_x_deg is not None:
        return replace(table, levels=(level,))
    surface = surface_fit(table).surface
    _inside(surface, zoom, focus)
    return replace(table, levels=(_interpolated(surface, zoom, focus, "between levels: interpolated, not measured"),))


def completed_from(table: LensTable, prior: LensTable) -> LensTable:
    """The table with a level more at each place of ``prior``, a lens of the same type, that it has none near: the
    prior's lens, corrected by the difference that the measured levels show. They say that they were not measured.

    So a table of few levels carries what it was made from. Raises :class:`calibration.errors.CalibrationError`.
    """
    surface = fit_surface(table, prior=surface_fit(prior).surface).surface
    why = "not measured: from another lens's table, corrected by the levels that were"
    (wide, tele), (far, near) = surface.zoom_range, surface.focus_range
    added = [
        _interpolated(surface, level.zoom, level.focus, why)
        for level in prior.levels
        if level.fov_x_deg is not None
        and wide <= level.zoom <= tele
        and far <= level.focus <= near
        and all(abs(level.zoom - own.zoom) > _NEAR or abs(level.focus - own.focus) > _NEAR for own in table.levels)
    ]
    levels = sorted((*table.levels, *added), key=lambda level: (level.zoom, level.focus))
    return replace(table, levels=tuple(levels))


def _interpolated(surface: LensSurface, zoom: float, focus: float, why: str) -> LevelResult:
    found = surface.at(zoom, focus)
    reasons = {name: why for name in EVIDENCE_QUANTITIES if name != "predicted_overlay_px"}
    if not found.nodal_told:
        reasons["nodal_offset_mm"] = "no level of the table tells it"
    return LevelResult.from_lens(
        zoom,
        focus,
        found.lens,
        status=LevelStatus.OK,
        reasons=reasons,
        sigma=found.sigma,
        predicted_overlay_px=found.predicted_px,
    )


def _inside(surface: LensSurface, zoom: float, focus: float) -> Lens:
    found = surface.at(zoom, focus)
    if found.clamped:
        (wide, tele), (far, near) = surface.zoom_range, surface.focus_range
        raise InvalidInput(
            "place",
            f"zoom {zoom:g}, focus {focus:g}",
            f"lies outside the table's levels (zoom {wide:g} to {tele:g}, focus {far:g} to {near:g}): drive the lens "
            "there, or name a place inside",
        )
    return found.lens
