"""Between the levels: the surface as pictures, how far it is off at levels it has not seen, what it leaves out."""

from __future__ import annotations

import base64
from dataclasses import dataclass

from app.lens_at import surface_fit
from app.plots import PlotKind, PlotMedia, draw
from app.report.numbers import encoder, pixels
from calibration.errors import CalibrationError
from calibration.surface import SurfaceFit
from calibration.tables import LensTable

FEWEST_LEVELS = 3
"""A surface through fewer levels says nothing that the levels do not say themselves."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A picture of the table, as a data URI."""

    title: str
    text: str
    alt: str
    data_uri: str


@dataclass(frozen=True, slots=True)
class BetweenView:
    """What the page says of the places between the levels. ``left_out``: (zoom, focus, reason)."""

    sentence: str
    pictures: tuple[Drawn, ...]
    left_out: tuple[tuple[str, str, str], ...]


def between_view(table: LensTable) -> BetweenView | None:
    """None for a table of fewer than :data:`FEWEST_LEVELS` levels with a lens."""
    measured = [level for level in table.levels if level.fov_x_deg is not None]
    if len(measured) < FEWEST_LEVELS:
        return None
    try:
        fit = surface_fit(table)
        kinds = [PlotKind.CURVES]
        if len({level.focus for level in measured}) > 1:
            kinds.append(PlotKind.SURFACES)
        pictures = tuple(_drawn(table, kind) for kind in kinds)
    except CalibrationError as error:
        return BetweenView(f"The levels make no surface, so nothing is told between them: {error}.", (), ())
    left_out = tuple(
        (encoder(check.zoom), encoder(check.focus), check.reason or "") for check in fit.checks if not check.used
    )
    return BetweenView(_sentence(fit), pictures, left_out)


_TOLD = {
    PlotKind.CURVES: ("Over zoom", "lines: the surface; bands and bars: 95 %; dots: the levels as measured"),
    PlotKind.SURFACES: ("Over zoom and focus", "field of view and distortion"),
}


def _drawn(table: LensTable, kind: PlotKind) -> Drawn:
    title, text = _TOLD[kind]
    coded = base64.b64encode(draw(table, kind, PlotMedia.SVG)).decode("ascii")
    return Drawn(title, text, f"{title}: {text}", f"data:image/svg+xml;base64,{coded}")


def _sentence(fit: SurfaceFit) -> str:
    if fit.held_out_px is None:
        return "One smooth surface through all levels; there are too few to hold one out and tell how far it is off."
    return (
        "One smooth surface through all levels. At a level held out of the fit its largest overlay error is "
        f"{pixels(fit.held_out_px.rms)} px (RMS over the levels), {pixels(fit.held_out_px.max)} px at the worst."
    )
