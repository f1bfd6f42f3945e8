"""The look that all pictures share: a sheet with a head, axes, colours that the colour-blind tell apart, saving.

Never ``pyplot``: a :class:`matplotlib.figure.Figure` by itself keeps nothing alive.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, Locator, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from app.lens_at import surface_fit
from calibration.surface import LensSurface, SurfaceFit
from calibration.tables import LensTable
from calibration.types import FloatArray

INK, SOFT, RULE, HAIR = "#1b2026", "#545d67", "#d9dde1", "#e9ecef"
ACCENT, FAILED = "#0a5f9e", "#a3161f"
LINES = ("#0067a8", "#c8540a", "#007f5f", "#a0457c")
"""The report's series colours."""
MOST_LINES = 8

ZOOM, FOCUS = "zoom (encoder, 0 wide to 1 tele)", "focus (encoder, 0 infinity to 1 near)"
K1, K2 = "k1 (radius 1 at half width)", "k2 (radius 1 at half width)"
FOV = "horizontal FoV, degrees"

WIDTH_IN = 12.8
_PNG_DPI = 150
_HEAD_IN, _LINE_IN = 0.78, 0.19
_TITLE_SIGNS, _REMARK_SIGNS = 95, 150
# What fits beside each other.
_PLACE_DIGITS = 5
_UNKNOWN = "\N{REPLACEMENT CHARACTER}"

_SETTINGS: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": SOFT,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9.5,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlepad": 8,
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "grid.color": HAIR,
    "grid.linewidth": 0.8,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "lensmatch",
    "text.color": INK,
    "text.parse_math": False,  # a lens may be called anything
    "axes.formatter.use_mathtext": False,
    "axes.formatter.useoffset": False,
    "xtick.color": SOFT,
    "xtick.labelsize": 9,
    "ytick.color": SOFT,
    "ytick.labelsize": 9,
}


@contextmanager
def styled() -> Iterator[None]:
    """matplotlib with its own defaults and the settings of these pictures, whatever a user's file says."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(cast(Any, _SETTINGS))
        yield


class Sheet:
    """One picture: a head of two lines, and axes under it."""

    def __init__(self, title: str, remark: str, height_in: float = 4.9) -> None:
        self.title = title
        told = textwrap.wrap(writable(remark), _REMARK_SIGNS) or [""]
        extra = _LINE_IN * (len(told) - 1)
        height_in += extra
        self.figure = Figure(figsize=(WIDTH_IN, height_in), facecolor="white", layout="constrained")
        head = (_HEAD_IN + extra) / height_in
        engine = cast(ConstrainedLayoutEngine, self.figure.get_layout_engine())
        engine.set(rect=(0.004, 0.01, 0.992, 1 - head - 0.01), w_pad=0.1, h_pad=0.1, wspace=0.03, hspace=0.04)
        top = 1 - 0.14 / height_in
        self.figure.text(0.012, top, writable(_cut(title)), fontsize=14, fontweight="bold", va="top")
        self.figure.text(0.012, top - 0.32 / height_in, "\n".join(told), fontsize=10, color=SOFT, va="top")

    def axes(self, rows: int, columns: int, widths: Sequence[float] | None = None) -> list[Axes]:
        """The axes, row by row."""
        grid = self.figure.subplots(rows, columns, squeeze=False, gridspec_kw={"width_ratios": widths})
        return [cast(Axes, axes) for axes in grid.ravel()]

    def bar(self, drawn: Any, axes: Axes, label: str, ticks: Locator | None = None) -> None:
        """A colour bar beside ``axes``."""
        bar = self.figure.colorbar(drawn, ax=axes, pad=0.02, fraction=0.05, aspect=28, ticks=ticks)
        if ticks is not None:
            bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        bar.minorticks_off()
        bar.set_label(label, fontsize=9)
        bar.outline.set_visible(False)
        bar.ax.tick_params(length=2)
        bar.ax.grid(False)

    def saved(self, media: str) -> bytes:
        """The file: no date and no version in it, so that the same table gives the same bytes."""
        self._settle()
        out = io.BytesIO()
        if media == "svg":
            self.figure.savefig(out, format="svg", metadata={"Date": None, "Creator": "Lensmatch", "Title": self.title})
        else:
            self.figure.savefig(out, format="png", dpi=_PNG_DPI, metadata={"Software": "Lensmatch"})
        return out.getvalue()

    def _settle(self) -> None:
        """Place the axes once, to rounded places: the layout's solver leaves other last digits each time."""
        layout = self.figure.get_layout_engine()
        if layout is not None:
            layout.execute(self.figure)
        self.figure.set_layout_engine("none")
        for axes in self.figure.axes:
            corners = np.round(axes.get_position(original=True).get_points(), _PLACE_DIGITS)
            axes.set_position(Bbox(corners), which="original")


def _cut(title: str) -> str:
    return title if len(title) <= _TITLE_SIGNS else title[: _TITLE_SIGNS - 1] + "…"


def fit_of(table: LensTable) -> SurfaceFit:
    """The table's surface. Raises :class:`calibration.errors.CalibrationError`."""
    return surface_fit(table)


def named(table: LensTable) -> str:
    """A table as a head says it."""
    return f"{table.lens} on {table.camera}, version {table.version}"


def writable(text: str) -> str:
    """``text`` with what the font cannot draw replaced."""
    known = get_font(findfont("DejaVu Sans")).get_charmap()
    return "".join(sign if ord(sign) in known else _UNKNOWN for sign in text)


def place(zoom: float, focus: float) -> str:
    """A place as a head says it."""
    return f"zoom {zoom:.3f}, focus {focus:.2f}"


def line_colours(count: int) -> list[str]:
    """``count`` colours in order: of the report, or of one dark-to-light scale where it has too few."""
    if count <= len(LINES):
        return list(LINES[:count])
    scale = mpl.colormaps["viridis"]
    return [mpl.colors.to_hex(scale(0.88 * i / (count - 1))) for i in range(count)]


def around_zero(values: FloatArray) -> tuple[str, Normalize]:
    """Colour map and scale: diverging about 0 where the values have both signs."""
    low, high = float(values.min()), float(values.max())
    if low < 0 < high:
        end = max(-low, high)
        return "PuOr", TwoSlopeNorm(0.0, -end, end)
    return "viridis", Normalize(low, high if high > low else low + 1e-9)


def log_ticks(axes: Axes, values: FloatArray) -> None:
    """A logarithmic y axis with plain numbers, if the values span enough for one."""
    if values.size == 0 or float(values.min()) <= 0 or float(values.max() / values.min()) < 3:
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(f"{axes.get_ylabel()} (log)")


def is_area(surface: LensSurface) -> bool:
    """Whether the levels span both zoom and focus."""
    return surface.zoom_range[1] > surface.zoom_range[0] and surface.focus_range[1] > surface.focus_range[0]


def alone(axes: Axes, along: FloatArray) -> None:
    """The encoder's whole range where all points stand at one place, instead of a hair's breadth about it."""
    if float(np.ptp(along)) == 0.0:
        axes.set_xlim(min(-0.03, float(along[0]) - 0.1), max(1.03, float(along[0]) + 0.1))
