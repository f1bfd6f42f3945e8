"""Pictures of lens tables: every kind for every shape of table, with their labels, and the same bytes each time."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.lens_at import surface_fit
from app.plots import PlotKind, PlotMedia, draw
from app.plots.maps import covariance_of
from calibration.compare import predicted_overlay
from calibration.errors import InvalidInput
from calibration.tables import LensTable, LevelResult
from tests.support.plot_tables import REASONS, demo_level, demo_table

TABLES = {
    "one": demo_table((0.4,), (0.3,)),
    "two": demo_table((0.0, 1.0), (0.3,)),
    "thirteen": demo_table([i / 12 for i in range(13)], (0.3,), wrong=5),
    "area": demo_table((0.0, 0.5, 1.0), (0.0, 0.5, 1.0)),
}
SVG = "{http://www.w3.org/2000/svg}"


def moved(table: LensTable, shift_px: float = 2.0) -> LensTable:
    levels = []
    for level in table.levels:
        x, y = level.center_shift_px or (0.0, 0.0)
        levels.append(replace(level, center_shift_px=(x + shift_px, y)))
    return replace(table, version=2, levels=tuple(levels))


def drawn(table: LensTable, kind: PlotKind, media: PlotMedia = PlotMedia.SVG) -> bytes:
    return draw(table, kind, media, other=moved(table) if kind is PlotKind.COMPARISON else None)


def texts(svg: bytes) -> str:
    return "\n".join("".join(element.itertext()) for element in ET.fromstring(svg).iter(f"{SVG}text"))


@pytest.mark.parametrize("kind", PlotKind)
@pytest.mark.parametrize("name", TABLES)
def test_every_kind_of_every_table(name: str, kind: PlotKind) -> None:
    svg = drawn(TABLES[name], kind)
    told = texts(svg)
    assert "Demo ENG 8x on Cam0, version 1" in told
    labels = {
        PlotKind.CURVES: ("horizontal FoV, degrees", "pivot to entrance pupil, mm", "x, px (right positive)"),
        PlotKind.SURFACES: ("Distortion k1", "zoom (encoder, 0 wide to 1 tele)"),
        PlotKind.GRID: ("u, px", "v, px", "without distortion"),
        PlotKind.UNCERTAINTY: ("expected overlay error, px", "u, px"),
        PlotKind.COMPARISON: ("distance of the same ray, px", "against Demo ENG 8x on Cam0, version 2"),
    }
    for label in labels[kind]:
        assert label in told
    assert b"<dc:date>" not in svg


@pytest.mark.parametrize("kind", PlotKind)
def test_the_same_table_gives_the_same_bytes(kind: PlotKind) -> None:
    svg = drawn(TABLES["two"], kind)
    assert drawn(TABLES["two"], kind) == svg
    png = drawn(TABLES["two"], kind, PlotMedia.PNG)
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    width, height = (int.from_bytes(png[start : start + 4], "big") for start in (16, 20))
    assert width == 1920
    assert 600 < height < 1200
    assert drawn(TABLES["two"], kind, PlotMedia.PNG) == png


def test_what_is_said_of_each_shape_of_table() -> None:
    assert "one level, zoom 0.400, focus 0.30" in texts(drawn(TABLES["one"], PlotKind.SURFACES))
    assert "all levels stand at one focus, 0.30" in texts(drawn(TABLES["two"], PlotKind.SURFACES))
    over_focus = demo_table((0.4,), (0.0, 1.0))
    assert "all levels stand at one zoom, 0.400" in texts(drawn(over_focus, PlotKind.SURFACES))
    told = texts(drawn(TABLES["thirteen"], PlotKind.CURVES))
    assert "12 of 13 levels in the fit" in told
    assert "left out of the fit" in told
    assert "focus 0.50" in texts(drawn(TABLES["area"], PlotKind.CURVES))


def lines_of(svg: bytes) -> int:
    """Solid lines of the series' colour and width."""
    return svg.count(b"stroke: #0067a8; stroke-width: 1.6")


def test_there_is_no_line_where_there_is_nothing_between() -> None:
    """One level is a point; two levels at different focuses have nothing between them at either."""
    assert lines_of(drawn(TABLES["one"], PlotKind.CURVES)) == 0
    across = replace(TABLES["one"], levels=(demo_level(0.0, 0.0), demo_level(1.0, 1.0)))
    assert lines_of(drawn(across, PlotKind.CURVES)) == 0
    assert lines_of(drawn(TABLES["two"], PlotKind.CURVES)) > 0


def test_what_is_not_told_is_not_drawn() -> None:
    untold = {"nodal_offset_mm": "one distance", "k2": "too long a lens"}
    levels = tuple(
        replace(level, nodal_offset_mm=None, k2=None, k2_hw=None, reasons={**REASONS, **untold})
        for level in TABLES["two"].levels
    )
    bad = LevelResult.failed(0.5, 0.3, "no board")
    told = texts(drawn(replace(TABLES["two"], levels=(levels[0], bad, levels[1])), PlotKind.CURVES))
    assert "no level tells it" in told
    assert "level without a lens" in told


@pytest.mark.parametrize("name", ["$a_b$ $", "<&> \"x\" 'y'", "カメラ 𐀀 é", "n" * 200])
def test_a_lens_may_be_called_anything(name: str) -> None:
    svg = drawn(replace(TABLES["one"], lens=name), PlotKind.GRID)
    ET.fromstring(svg)
    drawn(replace(TABLES["one"], lens=name), PlotKind.GRID, PlotMedia.PNG)
    if name.isascii() and len(name) < 50:
        assert f"Distortion: {name} on Cam0" in texts(svg)


def test_a_place_outside_the_levels_and_arguments_that_do_not_fit() -> None:
    table = demo_table((0.2, 0.8), (0.3,))
    for kind in (PlotKind.GRID, PlotKind.UNCERTAINTY):
        with pytest.raises(InvalidInput, match="lies outside the table's levels"):
            draw(table, kind, PlotMedia.SVG, zoom=0.9, focus=0.3)
    with pytest.raises(InvalidInput, match="curves shows the whole table"):
        draw(table, PlotKind.CURVES, PlotMedia.SVG, zoom=0.3)
    with pytest.raises(InvalidInput, match="needs a second table"):
        draw(table, PlotKind.COMPARISON, PlotMedia.SVG)
    with pytest.raises(InvalidInput, match="shows one table"):
        draw(table, PlotKind.GRID, PlotMedia.SVG, other=table)
    with pytest.raises(InvalidInput, match="none of them has a field of view"):
        draw(replace(table, levels=(LevelResult.failed(0, 0, "no board"),)), PlotKind.GRID, PlotMedia.SVG)


def test_two_equal_tables_can_be_compared() -> None:
    assert "at most 0.000 px apart" in texts(
        draw(TABLES["two"], PlotKind.COMPARISON, PlotMedia.SVG, other=TABLES["two"])
    )


@pytest.mark.parametrize("place", [(0.1, 0.2), (0.5, 0.5), (0.9, 0.8)])
def test_the_map_over_the_picture_agrees_with_the_surface(place: tuple[float, float]) -> None:
    """The surface predicts at coarser places, in other coordinates."""
    surface = surface_fit(TABLES["area"]).surface
    expected = predicted_overlay(surface.at(*place).lens, covariance_of(surface, *place))
    _, largest = surface.model.predicted_px(*(np.array([value]) for value in place))
    assert expected.max_px == pytest.approx(float(largest[0]), rel=0.03)
    assert np.isfinite(expected.map_px).all()


def test_the_command_and_the_service_start_without_matplotlib(repository: Path) -> None:
    code = "import sys, app.cli.commands, app.main; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=repository, check=False).returncode == 0
