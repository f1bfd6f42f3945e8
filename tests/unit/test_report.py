"""The report: complete, honest about what failed, safe against hostile names, and alone: it loads nothing."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from app.jobs.pictures import jpeg
from app.picture_sets import SetLevel
from app.report import LevelReport, RunReport, picture_set_report, render_report, write_report
from app.report.charts import log_ticks, ticks
from app.report.numbers import digits_for, encoder, number, pixels
from app.report.page import verdict
from calibration.compare import overlay
from calibration.lens import Lens
from calibration.solve.evidence import LevelInputs, level_evidence
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.mistakes import Mistake
from calibration.solve.outcome import level_result
from calibration.solve.problem import View
from calibration.synthetic import observe
from calibration.tables import LeftOut, LensTable, LevelResult, LevelStatus, Parallax, PixelError, Sigma
from calibration.types import CameraPose, Detection, Target, TargetKind, TargetPose
from storage.evidence import evidence_to_document, summary_of
from storage.records import PictureKind

SIZE = (1920, 1080)
HOSTILE = "<script>alert('x')</script> & \"Co\""
VOID = {"meta", "img", "br", "link", "input", "hr"}
REASONS = {"nodal_offset_mm": "targets at one distance only"}


def lens(zoom: float, error: float = 0.0) -> Lens:
    return Lens.from_fov(SIZE, 60.0 * 0.15**zoom + error, -0.2 + 0.3 * zoom, 0.02, (3.0 - 5 * zoom, -2.0 + 4 * zoom))


def level(zoom: float, *, truth: bool = True, focus: float = 0.25, error: float = 1e-4) -> LevelReport:
    result = LevelResult.from_lens(
        zoom,
        focus,
        lens(zoom, error),
        reasons=REASONS,
        sigma=Sigma(fov_x_deg=8.1e-5, k1=1.2e-5, k2=2.2e-5, center_shift_px=(1.7e-4, 1.6e-4)),
        residual_px=PixelError(0.0027, 0.01),
        held_out_px=PixelError(0.0028, 0.0101),
        predicted_overlay_px=PixelError(0.0012, 0.0042),
        engine_overlay_px=PixelError(0.003, 0.0093),
        scenario=2,
        seconds=3.21,
    )
    if not truth:
        return LevelReport(result)
    return LevelReport(result, lens(zoom), overlay(lens(zoom), result.lens(SIZE)))


def failed(zoom: float, reason: str) -> LevelReport:
    out = (LeftOut("real 3 (board)", "cut by the frame"),)
    return LevelReport(LevelResult.failed(zoom, 0.25, reason, left_out=out))


def report(levels: list[LevelReport], name: str = "Lens 8x") -> RunReport:
    table = LensTable(
        lens=name,
        camera="Cam0",
        version=3,
        created=datetime(2026, 1, 2, 3, 4, tzinfo=UTC),
        image_size=SIZE,
        method="joint",
        levels=tuple(shown.result for shown in levels),
    )
    return RunReport(name, table, levels, [("pictures fetched", "38")])


class Checker(HTMLParser):
    """Every element is closed by its own end tag; texts, identifiers and links are collected."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.sources: list[str] = []
        self.images_without_alt = 0
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        told = dict(attrs)
        assert len(told) == len(attrs), f"an attribute stands twice in <{tag}>"
        if (identifier := told.get("id")) is not None:
            self.ids.append(identifier)
        if (link := told.get("href")) is not None:
            self.links.append(link)
        if tag == "img":
            self.sources.append(told.get("src") or "")
            self.images_without_alt += not told.get("alt")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text.append(data)


def parsed(page: str) -> Checker:
    checker = Checker()
    checker.feed(page)
    checker.close()
    assert checker.open == []
    return checker


def words(page: str) -> str:
    return " ".join(" ".join(parsed(page).text).split()).replace(" :", ":")


def picture() -> bytes:
    return jpeg(np.full((1080, 1920, 3), 90, dtype=np.uint8))


def full_report() -> RunReport:
    kinds = (PictureKind.BEFORE, PictureKind.OVERLAY, PictureKind.RESIDUALS, PictureKind.REAL, PictureKind.VIRTUAL)
    first = replace(level(0.0), pictures={kind: picture() for kind in kinds})
    return report([first, level(0.5), level(1.0), failed(0.75, "no target was found")])


def test_page_is_well_formed_and_loads_nothing() -> None:
    page = render_report(full_report())
    checker = parsed(page)
    assert not {"script", "link", "iframe", "object"} & set(checker.tags)
    assert "http:" not in page
    assert "https:" not in page
    assert "@import" not in page
    assert "url(" not in page
    assert all(source.startswith("data:image/") for source in checker.sources)
    assert checker.images_without_alt == 0
    assert len(checker.ids) == len(set(checker.ids))
    assert all(link.startswith("#") and link[1:] in checker.ids for link in checker.links)
    assert "default-src 'none'" in page


def test_charts_are_well_formed_and_have_axes_with_units() -> None:
    page = render_report(full_report())
    drawings = [ET.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]
    charts = [drawing for drawing in drawings if drawing.get("class") == "chart"]
    assert len(charts) == 6
    titles = " ".join("".join(text.itertext()) for chart in charts for text in chart.iter("text"))
    for wanted in ("horizontal FoV, degrees", "k1, radius 1 at half width", "down, px", "largest overlay error, px"):
        assert wanted in titles
    for chart in charts:
        numbers = re.findall(r"-?\d+\.\d+|nan|inf", ET.tostring(chart, encoding="unicode"))
        assert "nan" not in numbers
        assert "inf" not in numbers
        inside = [float(dot.get("cy", 0)) for dot in chart.iter("circle")]
        assert all(0 <= at <= 300 for at in inside)


def test_hostile_names_stay_text() -> None:
    levels = [level(0.0), failed(0.5, f"reason {HOSTILE}")]
    odd = replace(levels[0].result, left_out=(LeftOut(f"picture {HOSTILE}", f"because {HOSTILE}"),))
    page = render_report(report([replace(levels[0], result=odd), levels[1]], HOSTILE))
    assert "<script" not in page
    assert "script" not in parsed(page).tags
    for wanted in (HOSTILE, f"reason {HOSTILE}", f"picture {HOSTILE}", f"because {HOSTILE}"):
        assert wanted in words(page)


def test_every_level_is_listed_and_failures_say_why() -> None:
    shown = full_report()
    page = render_report(shown)
    for view in shown.levels:
        assert page.count(f"zoom {encoder(view.result.zoom)}, focus {encoder(view.result.focus)}</span>") == 1
    assert "no target was found" in words(page)
    assert "real 3 (board) cut by the frame" in words(page)
    assert re.search(r'<details id="level-0.75-0.25" class="level failed" open>', page)
    assert not re.search(r'<details id="level-0.50-0.25" class="level ok" open>', page)


def test_quantities_that_are_not_told_say_why_in_visible_text() -> None:
    page = words(render_report(report([level(0.0), level(1.0)])))
    assert "not told" in page
    assert "a nodal offset: targets at one distance only" in page
    assert page.count("targets at one distance only") == 1  # one note serves both levels


def test_found_values_carry_the_digits_of_their_sigma_and_stand_beside_the_truth() -> None:
    page = words(render_report(report([level(0.0)])))
    assert "60.000100" in page
    assert "± 0.000081" in page
    assert "+0.000100" in page
    assert "+1.2" in page  # error over sigma


def test_a_degraded_level_is_worn_openly() -> None:
    worn = level(0.5)
    result = replace(worn.result, status=LevelStatus.DEGRADED, reason="the engine's render is up to 4.0 px off")
    page = render_report(report([level(0.0), replace(worn, result=result)]))
    assert words(page).count("the engine's render is up to 4.0 px off") >= 2
    assert 'class="verdict degraded"' in page


def test_verdict_in_one_sentence() -> None:
    assert verdict(report([level(0.0, truth=False)])) == ("1 of 1 levels ok; largest expected overlay error 0.0042 px.")
    worst = max(view.error.max_px for view in (level(0.0), level(1.0)) if view.error is not None)
    assert verdict(report([level(0.0), level(1.0), failed(0.5, "dark")])) == (
        "2 of 3 levels ok, 1 failed; largest expected overlay error 0.0042 px; "
        f"against the simulated truth at most {pixels(worst)} px."
    )


def test_without_truth_nothing_of_a_truth_is_said() -> None:
    page = render_report(report([level(0.0, truth=False), level(1.0, truth=False)]))
    text = words(page)
    assert "truth" not in text
    assert "true overlay" not in text
    assert "held out of the fit" in text


def test_a_result_that_folds_where_the_truth_does_not_is_infinitely_wrong() -> None:
    folding = Lens.from_fov(SIZE, 60.0, -0.9)
    shown = replace(level(0.0), error=overlay(Lens.from_fov(SIZE, 75.0), folding))
    assert shown.error is not None
    assert np.isinf(shown.error.max_px)
    page = render_report(report([shown, level(1.0)]))
    parsed(page)
    assert "at most ∞ px" in page


def test_only_failed_levels_and_broken_pictures_still_make_a_page() -> None:
    broken = replace(failed(0.0, "dark"), pictures={PictureKind.REAL: b"no picture", PictureKind.VIRTUAL: b""})
    page = render_report(report([broken, failed(1.0, "darker")]))
    assert "0 of 2 levels ok, 2 failed." in words(page)
    assert "The stored picture cannot be read." in words(page)
    assert 'class="chart"' not in page


def test_thirteen_levels_with_pictures_stay_below_ten_megabytes() -> None:
    noise = np.random.default_rng(4).normal(120, 12, (1080, 1920, 3)).clip(0, 255).astype(np.uint8)
    smooth = np.asarray(noise // 3 + np.linspace(0, 150, 1920, dtype=np.uint8)[None, :, None], dtype=np.uint8)
    data = jpeg(smooth)
    first = replace(level(0.0), pictures=dict.fromkeys(PictureKind, data))
    size = len(render_report(report([first]))) - len(render_report(report([level(0.0)])))
    assert 13 * size < 10e6


def test_written_as_a_whole_and_nothing_left_beside(tmp_path: Path) -> None:
    path = tmp_path / "new" / "report.html"
    write_report(path, report([level(0.0)]))
    assert path.read_text(encoding="utf-8") == render_report(report([level(0.0)]))
    assert [entry.name for entry in path.parent.iterdir()] == ["report.html"]


def test_picture_set_report_shows_each_picture_of_the_fit() -> None:
    rng = np.random.default_rng(11)
    target = Target(
        TargetKind.CHESSBOARD, squares=(8, 8), square_m=0.2, colours=("red", "white"), pose=TargetPose((0.0, 6.0, 1.5))
    )
    true = Lens.from_fov(SIZE, 56.0, -0.12, 0.03, (4.0, -3.0))
    views = []
    for name, pan, tilt in (("a.png", -14.0, 0.0), ("b.png", 12.0, 6.0), ("c.png", 3.0, -7.0)):
        pose = CameraPose((0.0, 0.0, 1.5), pan, tilt)
        seen = observe(true, pose, target, rng)
        assert isinstance(seen, Detection)
        views.append(View(name, "board", target, seen, pose))
    fit = solve_level(views, SIZE)
    result = level_result(fit, 0.0, 0.5, held_out=held_out_residuals(fit, views))
    levels = [SetLevel(result, fit, tuple(views))]
    table = report([LevelReport(result)], "A <b>").table
    page = render_report(picture_set_report("A <b>", table, levels))
    checker = parsed(page)
    assert len(checker.sources) == 2  # residual arrows and the map of expected overlay error
    for name in ("a.png", "b.png", "c.png"):
        assert f"{name} board 49 of 49" in words(page)


def test_the_evidence_says_what_the_pictures_show_first() -> None:
    mistakes = (
        Mistake("height", "board", "mm", 0.1, 0.9, 3.0),
        Mistake("place in depth", "board", "mm", 3.1, 0.4, 3.0),
        Mistake("pan scale", "", "", 0.0001, 0.0019, 0.002),
    )
    target = Target(TargetKind.CHESSBOARD, squares=(8, 8), square_m=0.2, pose=TargetPose((0.0, 6.0, 1.5)))
    rng = np.random.default_rng(12)
    views = []
    for name, pan, tilt in (("a.png", -14.0, 0.0), ("b.png", 12.0, 6.0), ("c.png", 3.0, -7.0)):
        pose = CameraPose((0.0, 0.0, 1.5), pan, tilt)
        seen = observe(Lens.from_fov(SIZE, 56.0, -0.12, 0.03), pose, target, rng)
        assert isinstance(seen, Detection)
        views.append(View(name, "board", target, seen, pose))
    fit = replace(solve_level(views, SIZE), mistakes=mistakes, parallax=Parallax(2.2, 5.0, 56.0, 4.5, 0.31))
    evidence = level_evidence(fit, LevelInputs(0.0, 0.5, SIZE, tuple(views)), {})
    summary = summary_of(evidence)
    assert summary.mistakes == ("place in depth of board: 3.1 ± 0.4 mm (shown)",)
    assert len(summary.inputs_sha256) == 64
    result = replace(level_result(fit, 0.0, 0.5, held_out={}), evidence=summary)
    level = LevelReport(result, fit=fit, evidence=evidence_to_document(evidence))
    text = words(render_report(report([level])))
    assert "Nothing in the residuals speaks against the lens model." in text
    order = ["+3.1 ± 0.4 mm 3 mm shown", "+0.1 ± 0.9 mm 3 mm not shown", "cannot be told"]
    assert [text.find(part) for part in order] == sorted(text.find(part) for part in order)
    assert text.find(order[0]) > 0
    assert "with the nodal offset as given" in text


@pytest.mark.parametrize(
    ("value", "digits", "signed", "text"),
    [(1.25, 2, False, "1.25"), (-0.0004, 2, True, "0.00"), (-2.1, 1, True, "−2.1"), (2.1, 1, True, "+2.1")],
)
def test_numbers(value: float, digits: int, signed: bool, text: str) -> None:
    assert number(value, digits, signed=signed) == text


def test_digits_follow_sigma() -> None:
    assert [digits_for(sigma, 4) for sigma in (0.0123, 0.99, 12.0, 0.0, None)] == [3, 2, 0, 4, 4]


def test_encoder_values_stay_apart() -> None:
    assert [encoder(value) for value in (0.0, 0.5, 1 / 3, 0.1625)] == ["0.00", "0.50", "0.3333", "0.1625"]


def test_ticks_are_round_and_inside() -> None:
    assert ticks(-0.09, 0.04, 6) == pytest.approx([-0.075, -0.05, -0.025, 0.0, 0.025])
    assert log_ticks(7.0, 64.0) == pytest.approx([8, 10, 15, 20, 30, 40, 50, 60])
    assert all(0.9 <= tick <= 1.1 for tick in log_ticks(0.9, 1.1))


def test_the_lens_between_its_levels_is_drawn_and_judged() -> None:
    page = render_report(report([level(zoom, truth=False) for zoom in (0.0, 0.3, 0.7, 1.0)]))
    assert "Between the levels" in page
    assert page.count("data:image/svg+xml;base64,") == 1
    assert "At a level held out of the fit" in page
    both = [level(zoom, truth=False, focus=focus) for zoom in (0.0, 0.5, 1.0) for focus in (0.0, 1.0)]
    assert render_report(report(both)).count("data:image/svg+xml;base64,") == 2
    few = render_report(report([level(0.0), level(1.0)]))
    assert "Between the levels" not in few


def test_levels_that_make_no_surface_are_said() -> None:
    backwards = [replace(level(zoom), result=replace(level(1 - zoom).result, zoom=zoom)) for zoom in (0.0, 0.5, 1.0)]
    page = render_report(report(backwards))
    assert "the zoom encoder runs backwards" in page
    assert "data:image/svg+xml" not in page
