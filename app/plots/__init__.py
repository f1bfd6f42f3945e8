"""Pictures of a lens table: its curves, its surfaces, its distortion, its uncertainty, and two tables compared.

matplotlib is imported by what draws, not by this module: commands and the service start without it.
"""

from __future__ import annotations

import threading
from enum import StrEnum

from calibration.errors import InvalidInput
from calibration.tables import LensTable

DRAWING = 1
"""Counts the changes of how tables are drawn: part of a picture's entity tag, raised with each."""

_ONE_AT_A_TIME = threading.Lock()
# matplotlib's settings and font engine belong to the process.


class PlotKind(StrEnum):
    """What a picture shows."""

    CURVES = "curves"
    """The lens over zoom, one line for each focus, with the band that holds 95 % and the measured levels."""
    SURFACES = "surfaces"
    """Field of view and distortion over zoom and focus."""
    GRID = "grid"
    """What the lens does to a square grid, at one place."""
    UNCERTAINTY = "uncertainty"
    """Overlay error to expect: over the picture at one place, and over zoom and focus."""
    COMPARISON = "comparison"
    """How far another table is from this one."""


AT_A_PLACE = (PlotKind.GRID, PlotKind.UNCERTAINTY)
"""Kinds that are drawn at one zoom and focus."""


class PlotMedia(StrEnum):
    """The file format of a picture."""

    SVG = "svg"
    PNG = "png"

    @property
    def media_type(self) -> str:
        """The MIME type."""
        return "image/svg+xml" if self is PlotMedia.SVG else "image/png"


def draw(
    table: LensTable,
    kind: PlotKind,
    media: PlotMedia,
    *,
    zoom: float | None = None,
    focus: float | None = None,
    other: LensTable | None = None,
) -> bytes:
    """The picture as the bytes of a file, the same for the same table. ``zoom``, ``focus`` (encoder values): the place
    of :data:`AT_A_PLACE`, the wide end and the farthest focus where not said; ``other``: the second table of a
    comparison. CPU work of up to seconds.

    Raises :class:`calibration.errors.InvalidInput` for a place outside the levels, an argument that the kind does not
    take or lacks, and :class:`calibration.errors.CalibrationError` where the levels make no surface.
    """
    check(kind, zoom, focus, other is not None)
    with _ONE_AT_A_TIME:
        from app.plots import curves, maps, pair
        from app.plots.sheet import styled

        with styled():
            if kind is PlotKind.COMPARISON and other is not None:
                sheet = pair.comparison(table, other)
            elif kind is PlotKind.CURVES:
                sheet = curves.curves(table)
            elif kind is PlotKind.SURFACES:
                sheet = maps.surfaces(table)
            elif kind is PlotKind.GRID:
                sheet = maps.grid(table, zoom, focus)
            else:
                sheet = maps.uncertainty(table, zoom, focus)
            return sheet.saved(media.value)


def check(kind: PlotKind, zoom: float | None, focus: float | None, with_other: bool) -> None:
    """Raise :class:`InvalidInput` for an argument that the kind does not take, or lacks."""
    for name, value in (("zoom", zoom), ("focus", focus)):
        if value is not None and kind not in AT_A_PLACE:
            raise InvalidInput(name, value, f"{kind.value} shows the whole table; {_names(AT_A_PLACE)} take a place")
    if with_other != (kind is PlotKind.COMPARISON):
        why = "needs a second table (with)" if not with_other else "shows one table; comparison takes a second one"
        raise InvalidInput("kind", kind.value, why)


def _names(kinds: tuple[PlotKind, ...]) -> str:
    return " and ".join(kind.value for kind in kinds)
