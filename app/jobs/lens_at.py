"""The lens of a table at any place: the one spot where publishing asks what lies between the levels."""

from __future__ import annotations

from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult

SAME_PLACE = 1e-6
"""Encoder values closer than this are one place: a head's protocol rounds them, a lens stands no more exactly."""


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
    """The lens at a place; for now only where a level stands.

    Raises :class:`InvalidInput` where there is none, or one without numbers.
    """
    level = level_near(table, zoom, focus)
    if level is None:
        nearest = min(table.levels, key=lambda other: abs(other.zoom - zoom) + abs(other.focus - focus))
        raise InvalidInput(
            "place",
            f"zoom {zoom:g}, focus {focus:g}",
            f"is no level of this table (the nearest is zoom {nearest.zoom:g}, focus {nearest.focus:g}): drive the "
            "lens there, or name a level",
        )
    return level.lens(table.image_size, table.pixel_aspect)
