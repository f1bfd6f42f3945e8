"""One level in words and figures: its rows in the tables, its pictures, its whole comparison with the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from app.jobs.heatmap import heat_map, scale_end_px
from app.jobs.pictures import jpeg
from app.report.embed import Image, embedded
from app.report.evidence import EvidenceView, evidence_view
from app.report.figures import half_width_sigma
from app.report.model import LevelReport
from app.report.numbers import NONE, digits_for, encoder, number, pixels, sigma_text
from calibration.lens import Lens
from calibration.tables import LeftOut, LensTable, LevelResult, PixelError
from storage.records import PictureKind

Get = Callable[[LevelResult], float | None]


@dataclass(frozen=True, slots=True)
class Quantity:
    """A column of the lens table. ``primary``: the field whose reason explains a missing value."""

    name: str
    unit: str
    primary: str
    digits: int
    value: Get
    sigma: Callable[[LevelReport], float | None]
    true: Callable[[Lens], float]
    has_sigma: bool = True
    """False: derived from another, its sigma only chooses the digits."""


def _fov_y_sigma(level: LevelReport) -> float | None:
    result = level.result
    if result.sigma.fov_x_deg is None or not result.fov_x_deg or result.fov_y_deg is None:
        return None
    return result.sigma.fov_x_deg * result.fov_y_deg / result.fov_x_deg


def _pair(index: int) -> tuple[Get, Callable[[LevelReport], float | None], Callable[[Lens], float]]:
    def value(result: LevelResult) -> float | None:
        return None if result.center_shift_px is None else result.center_shift_px[index]

    def sigma(level: LevelReport) -> float | None:
        told = level.result.sigma.center_shift_px
        return None if told is None else told[index]

    return value, sigma, lambda lens: lens.center_shift_px[index]


QUANTITIES = (
    Quantity(
        "FoV x", "deg", "fov_x_deg", 4, lambda r: r.fov_x_deg, lambda m: m.result.sigma.fov_x_deg, lambda t: t.fov_x_deg
    ),
    Quantity("FoV y", "deg", "fov_x_deg", 4, lambda r: r.fov_y_deg, _fov_y_sigma, lambda t: t.fov_y_deg, False),
    Quantity("k1", "f = 1", "k1", 5, lambda r: r.k1, lambda m: m.result.sigma.k1, lambda t: t.k1),
    Quantity("k2", "f = 1", "k2", 5, lambda r: r.k2, lambda m: m.result.sigma.k2, lambda t: t.k2),
    Quantity(
        "k1", "½ width = 1", "k1", 6, lambda r: r.k1_hw, lambda m: half_width_sigma(m, 1), lambda t: t.k1_hw, False
    ),
    Quantity(
        "k2", "½ width = 1", "k2", 6, lambda r: r.k2_hw, lambda m: half_width_sigma(m, 2), lambda t: t.k2_hw, False
    ),
    Quantity("shift x", "px", "center_shift_px", 3, *_pair(0)),
    Quantity("shift y", "px", "center_shift_px", 3, *_pair(1)),
    Quantity(
        "nodal", "mm", "nodal_offset_mm", 1,
        lambda r: r.nodal_offset_mm, lambda m: m.result.sigma.nodal_offset_mm, lambda t: t.nodal_offset_mm,
    ),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cell:
    """A quantity of a level, as text. ``note``: letter of the reason why it is not told; ``reason``: that reason."""

    name: str
    unit: str
    found: str
    sigma: str = ""
    truth: str = ""
    error: str = ""
    pull: str = ""
    note: str = ""
    reason: str = ""


@dataclass(slots=True)
class Notes:
    """Reasons why something is not told, each once, lettered a, b, c ..."""

    entries: list[tuple[str, str, str]] = field(default_factory=list)

    def letter(self, what: str, reason: str) -> str:
        """The letter of a reason, new or known."""
        for letter, known, why in self.entries:
            if (known, why) == (what, reason):
                return letter
        letter = _letters(len(self.entries))
        self.entries.append((letter, what, reason))
        return letter


@dataclass(frozen=True, slots=True)
class LevelView:
    """What the page says about a level."""

    anchor: str
    zoom: str
    focus: str
    status: str
    reason: str
    opened: bool
    summary: str
    images: tuple[Image, ...]
    cells: tuple[Cell, ...]
    pictures: tuple[tuple[str, str, str, str, str], ...]
    left_out: tuple[LeftOut, ...]
    evidence: EvidenceView | None


def lens_rows(level: LevelReport, table: LensTable, notes: Notes) -> list[Cell]:
    """The level's row of the lens table: found, sigma, truth and error of each quantity; none for a failed level."""
    if level.failed:
        return []
    return [_cell(quantity, level, notes) for quantity in QUANTITIES]


def _cell(quantity: Quantity, level: LevelReport, notes: Notes) -> Cell:
    value, sigma = quantity.value(level.result), quantity.sigma(level)
    digits = digits_for(sigma, quantity.digits)
    truth = number(quantity.true(level.truth), digits if value is not None else quantity.digits) if level.truth else ""
    if value is None:
        reason = level.result.reasons.get(quantity.primary, "")
        note = notes.letter(_title(quantity.primary), reason)
        return Cell(quantity.name, quantity.unit, "not told", truth=truth, note=note, reason=reason)
    error = value - quantity.true(level.truth) if level.truth else None
    pull = f"{error / sigma:+.1f}" if error is not None and quantity.has_sigma and sigma else ""
    return Cell(
        quantity.name,
        quantity.unit,
        number(value, digits),
        sigma_text(sigma, digits) if quantity.has_sigma else "",
        truth,
        number(error, digits, signed=True) if error is not None else "",
        pull.replace("-", "−"),
    )


@dataclass(frozen=True, slots=True)
class Evidence:
    """A level's exactness: each figure as "RMS / largest", or its note."""

    figures: tuple[Cell, ...]
    pictures: str
    left_out: int
    scenario: str
    seconds: str


def evidence_row(level: LevelReport, notes: Notes) -> Evidence:
    """The level's row of the table of exactness."""
    result = level.result
    told = (
        ("residual", "residual_px"),
        ("held out", "held_out_px"),
        ("expected overlay", "predicted_overlay_px"),
        ("engine's overlay", "engine_overlay_px"),
    )
    figures = [_figure_cell(name, key, level, notes) for name, key in told]
    if level.error is not None:
        error = level.error
        figures.append(Cell("true overlay", "px", f"{pixels(error.rms_px)} / {pixels(error.max_px)}"))
    elif level.truth is not None:
        figures.append(Cell("true overlay", "px", NONE))
    frames = result.frames
    return Evidence(
        tuple(figures),
        f"{frames.real} + {frames.virtual}",
        len(result.left_out),
        NONE if result.scenario is None else str(result.scenario),
        NONE if result.seconds is None else f"{result.seconds:.1f}",
    )


def _figure_cell(name: str, key: str, level: LevelReport, notes: Notes) -> Cell:
    value: PixelError | None = getattr(level.result, key)
    if value is not None:
        return Cell(name, "px", f"{pixels(value.rms)} / {pixels(value.max)}")
    if level.failed:
        return Cell(name, "px", NONE)
    reason = level.result.reasons.get(key, "")
    return Cell(name, "px", "not told", note=notes.letter(_title(key), reason), reason=reason)


def level_view(level: LevelReport, table: LensTable, opened: bool) -> LevelView:
    """Everything of the level's own section."""
    result = level.result
    where = f"zoom {encoder(result.zoom)}, focus {encoder(result.focus)}"
    summary = []
    if result.predicted_overlay_px is not None:
        summary.append(f"expected overlay error at most {pixels(result.predicted_overlay_px.max)} px")
    if level.error is not None:
        summary.append(f"true {pixels(level.error.max_px)} px")
    summary.append(f"{result.frames.real + result.frames.virtual} pictures")
    return LevelView(
        anchor=f"level-{encoder(result.zoom)}-{encoder(result.focus)}",
        zoom=encoder(result.zoom),
        focus=encoder(result.focus),
        status=result.status.value,
        reason=result.reason or "",
        opened=opened,
        summary=", ".join(summary),
        images=tuple(_images(level, table, where)),
        cells=tuple(lens_rows(level, table, Notes())),
        pictures=tuple(_used_pictures(level)),
        left_out=result.left_out,
        evidence=evidence_view(level.evidence) if level.evidence is not None else None,
    )


_SHOWN = (
    (PictureKind.BEFORE, "Before", "camera (rings), engine as found (grid)"),
    (PictureKind.OVERLAY, "After", "camera (rings), engine's own render (grid)"),
    (PictureKind.UNCERTAINTY, "Expected overlay error", "one sigma, from the fit's covariance"),
    (PictureKind.RESIDUALS, "Residuals", "model minus picture, every corner of every picture"),
    (PictureKind.REAL, "Camera", "as fetched"),
    (PictureKind.VIRTUAL, "Engine", "its own render"),
)
_RAW = (PictureKind.REAL, PictureKind.VIRTUAL)


def _images(level: LevelReport, table: LensTable, where: str) -> list[Image]:
    files: Mapping[PictureKind, bytes] = level.pictures
    expected = level.expected()
    if PictureKind.UNCERTAINTY not in files and expected is not None:
        files = {**files, PictureKind.UNCERTAINTY: jpeg(heat_map(expected.map_px, table.image_size))}
    images = []
    for kind, title, text in _SHOWN:
        if kind in files:
            # Where the overlay shows them too, the bare pictures are small.
            small = kind in _RAW and PictureKind.OVERLAY in files
            images.append(embedded(files[kind], title, text, f"{title}, {where}: {text}", small=small))
        if kind is PictureKind.UNCERTAINTY and level.error is not None:
            data = jpeg(heat_map(level.error.map_px, table.image_size, _common_end_px(level)))
            title, text = "True overlay error", "the result against the truth"
            images.append(embedded(data, title, text, f"{title}, {where}: {text}"))
    return images


def _common_end_px(level: LevelReport) -> float | None:
    """The true map has the colours of the expected one wherever its values fit into them."""
    expected = level.result.predicted_overlay_px
    if level.error is None or expected is None or not level.error.max_px <= expected.max:
        return None
    return scale_end_px(expected.max)


def _used_pictures(level: LevelReport) -> list[tuple[str, str, str, str, str]]:
    if level.fit is None:
        return []
    return [
        (
            view.name.removesuffix(f" [{view.target_name}]"),
            view.target_name,
            f"{int(view.used.sum())} of {len(view.used)}",
            pixels(view.rms_px),
            pixels(view.max_px),
        )
        for view in level.fit.views
    ]


_TITLES = {
    "fov_x_deg": "field of view",
    "k1": "k1",
    "k2": "k2",
    "center_shift_px": "centre shift",
    "nodal_offset_mm": "nodal offset",
    "residual_px": "residual",
    "held_out_px": "held-out residual",
    "predicted_overlay_px": "expected overlay error",
    "engine_overlay_px": "engine's overlay error",
}


def _title(key: str) -> str:
    return _TITLES[key]


def _letters(index: int) -> str:
    """a ... z, aa, ab ..."""
    text = ""
    index += 1
    while index:
        index, rest = divmod(index - 1, 26)
        text = chr(ord("a") + rest) + text
    return text
