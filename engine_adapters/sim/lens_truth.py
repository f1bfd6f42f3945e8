"""The simulated zoom lens: a truth file, checked, and what the lens is at any zoom and focus.

Between levels (contracts, "Truth file"): first across focus at each zoom that has levels, then a natural cubic over
zoom. What is interpolated is log focal length and ``k1_hw``, ``k2_hw`` (radius 1 at half the picture's width), never
FoV or k1 themselves; outside the levels the nearest one holds.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.optics import Optics

_REQUIRED = ("zoom", "focus", "fov_x_deg")
_OPTIONAL = {"k1": 0.0, "k2": 0.0, "nodal_offset_mm": 0.0, "blur_px": 0.6, "noise_sigma": 2.0}
_KNOWN = (*_REQUIRED, *_OPTIONAL, "center_shift_px")
MAX_PICTURE_SIDE = 8192
"""The longest side of a simulated picture: beyond 8K it is a mistake."""
MAX_LEVELS = 10_000


@dataclass(frozen=True, slots=True)
class LensState:
    """The lens at one zoom and focus: degrees, px, mm; k1, k2 in focal-length units; noise on the 0..255 scale."""

    optics: Optics
    nodal_offset_mm: float
    blur_px: float
    noise_sigma: float


@dataclass(frozen=True, slots=True)
class LensLevel:
    """One line of a truth file."""

    zoom: float
    focus: float
    fov_x_deg: float
    k1: float
    k2: float
    center_shift_px: tuple[float, float]
    nodal_offset_mm: float
    blur_px: float
    noise_sigma: float


class ZoomLens:
    """A zoom lens of known truth: ``name``, ``image_size``, ``sensor_mm`` (width, height), aspect and ``levels``."""

    def __init__(
        self,
        name: str,
        image_size: tuple[int, int],
        sensor_mm: tuple[float, float],
        pixel_aspect: float,
        levels: Sequence[LensLevel],
    ) -> None:
        self.name = name
        self.image_size = image_size
        self.sensor_mm = sensor_mm
        self.pixel_aspect = pixel_aspect
        self.levels = tuple(sorted(levels, key=lambda level: (level.zoom, level.focus)))
        by_zoom: dict[float, list[LensLevel]] = {}
        for level in self.levels:
            by_zoom.setdefault(level.zoom, []).append(level)
        self._zooms = np.array(list(by_zoom))
        self._across_focus = [
            _Smooth(np.array([level.focus for level in row]), np.array([_quantities(level) for level in row]))
            for row in by_zoom.values()
        ]

    def at(self, zoom: float, focus: float) -> LensState:
        """The lens at an encoder position (0..1 each; outside the levels the nearest ones hold)."""
        rows = np.array([smooth.at(focus) for smooth in self._across_focus])
        log_tan, k1_hw, k2_hw, shift_x, shift_y, nodal, blur, noise = _Smooth(self._zooms, rows).at(zoom).tolist()
        half = math.exp(log_tan)
        return LensState(
            Optics(
                self.image_size,
                self.image_size[0] / (2.0 * half),
                k1_hw / half**2,
                k2_hw / half**4,
                (shift_x, shift_y),
                self.pixel_aspect,
            ),
            nodal,
            max(blur, 0.0),
            max(noise, 0.0),
        )

    def truth(self) -> dict[str, Any]:
        """The truth file's content: to be shown beside a result, never to be measured with."""
        return {
            "lens_truth": 1,
            "lens": self.name,
            "image_size": list(self.image_size),
            "sensor_mm": list(self.sensor_mm),
            "pixel_aspect": self.pixel_aspect,
            "levels": [
                {
                    "zoom": level.zoom,
                    "focus": level.focus,
                    "fov_x_deg": level.fov_x_deg,
                    "k1": level.k1,
                    "k2": level.k2,
                    "center_shift_px": list(level.center_shift_px),
                    "nodal_offset_mm": level.nodal_offset_mm,
                    "blur_px": level.blur_px,
                    "noise_sigma": level.noise_sigma,
                }
                for level in self.levels
            ],
        }


class _Smooth:
    """Quantities (M columns) over one coordinate: constant, a line, or a natural cubic; held outside its range."""

    def __init__(self, coordinate: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        self._low, self._high = float(coordinate[0]), float(coordinate[-1])
        self._values = values
        self._spline = CubicSpline(coordinate, values, axis=0, bc_type="natural") if len(coordinate) > 1 else None

    def at(self, coordinate: float) -> NDArray[np.float64]:
        if self._spline is None:
            return np.asarray(self._values[0], dtype=np.float64)
        return np.asarray(self._spline(min(max(coordinate, self._low), self._high)), dtype=np.float64)


def _quantities(level: LensLevel) -> tuple[float, ...]:
    half = math.tan(math.radians(level.fov_x_deg) / 2.0)
    # log tan(fov / 2) is minus log focal length but for a constant.
    return (
        math.log(half),
        level.k1 * half**2,
        level.k2 * half**4,
        *level.center_shift_px,
        level.nodal_offset_mm,
        level.blur_px,
        level.noise_sigma,
    )


def load_lens(path: Path) -> ZoomLens:
    """Read and check a truth file. Raises :class:`SimulatorError` with one line: where, what, what to do."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise SimulatorError("no such lens file", where=str(path)) from error
    except (OSError, UnicodeDecodeError) as error:
        raise SimulatorError(f"the lens file cannot be read ({error})", where=str(path)) from error
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise SimulatorError(f"not a JSON file ({error})", where=str(path)) from error
    return parse_lens(content, where=str(path))


def embedded_lens_names() -> tuple[str, ...]:
    """The lenses that come with the product, the default first."""
    return tuple(_embedded_files())


def load_embedded(name: str) -> ZoomLens:
    """An embedded lens by its name. Raises :class:`SimulatorError` for an unknown one."""
    files = _embedded_files()
    if name not in files:
        raise SimulatorError(f"no embedded lens is called {name!r}; there are: {', '.join(files)}")
    data = resources.files("engine_adapters.sim") / "data" / files[name]
    return parse_lens(json.loads(data.read_text(encoding="utf-8")), where=files[name])


def _embedded_files() -> dict[str, str]:
    return {"Demo ENG 8x": "demo_eng_8x.json", "Demo box 4x": "demo_box_4x.json"}


def parse_lens(content: object, *, where: str = "lens truth") -> ZoomLens:
    """Check the content of a truth file. Unknown fields are let pass (other renderers write more)."""
    if not isinstance(content, Mapping):
        raise SimulatorError("a truth file is a JSON object", where=where)
    if content.get("lens_truth") != 1:
        raise SimulatorError(f"lens_truth is {content.get('lens_truth')!r}; this reads version 1", where=where)
    width, height = (_number(side, "image_size", where) for side in _pair(content, "image_size", where))
    if not (2 <= width <= MAX_PICTURE_SIDE and 2 <= height <= MAX_PICTURE_SIDE) or width % 1 or height % 1:
        raise SimulatorError(
            f"image_size {width:g} x {height:g} is no picture size (whole numbers, 2 to {MAX_PICTURE_SIDE})",
            where=where,
        )
    sensor_w, sensor_h = (_number(side, "sensor_mm", where) for side in _pair(content, "sensor_mm", where))
    aspect = _number(content.get("pixel_aspect", 1.0), "pixel_aspect", where)
    if min(sensor_w, sensor_h, aspect) <= 0.0:
        raise SimulatorError("sensor_mm and pixel_aspect must be positive", where=where)
    raw_levels = content.get("levels")
    if not isinstance(raw_levels, list) or not raw_levels:
        raise SimulatorError("levels is missing or empty: a lens needs at least one level", where=where)
    if len(raw_levels) > MAX_LEVELS:
        raise SimulatorError(f"{len(raw_levels)} levels; at most {MAX_LEVELS} are read", where=where)
    image_size = (int(width), int(height))
    seen: set[tuple[float, float]] = set()
    levels = []
    for number, raw in enumerate(raw_levels):
        level = _level(raw, f"{where}, level {number}", image_size, aspect)
        if (level.zoom, level.focus) in seen:
            raise SimulatorError(
                f"zoom {level.zoom:g}, focus {level.focus:g} stands twice; leave one", where=f"{where}, level {number}"
            )
        seen.add((level.zoom, level.focus))
        levels.append(level)
    return ZoomLens(str(content.get("lens", "unnamed")), image_size, (sensor_w, sensor_h), aspect, levels)


def _level(raw: object, where: str, image_size: tuple[int, int], aspect: float) -> LensLevel:
    if not isinstance(raw, Mapping):
        raise SimulatorError("a level is a JSON object", where=where)
    for name in _REQUIRED:
        if name not in raw:
            raise SimulatorError(f"{name} is missing", where=where)
    for name in raw:
        like = difflib.get_close_matches(str(name), _KNOWN, n=1, cutoff=0.8)
        if name not in _KNOWN and like:
            raise SimulatorError(f"field {str(name)[:40]!r} is not known; is {like[0]!r} meant?", where=where)
    values = {name: _number(raw[name], name, where) for name in _REQUIRED}
    for name, default in _OPTIONAL.items():
        values[name] = _number(raw.get(name, default), name, where)
    shift_x, shift_y = (
        (_number(part, "center_shift_px", where) for part in _pair(raw, "center_shift_px", where))
        if "center_shift_px" in raw
        else (0.0, 0.0)
    )
    for name in ("zoom", "focus"):
        if not 0.0 <= values[name] <= 1.0:
            raise SimulatorError(f"{name} {values[name]:g} is not an encoder value 0..1", where=where)
    if not 0.05 <= values["fov_x_deg"] <= 170.0:
        raise SimulatorError(f"fov_x_deg {values['fov_x_deg']:g} is not a field of view (0.05 to 170)", where=where)
    for name in ("blur_px", "noise_sigma"):
        if not 0.0 <= values[name] <= 50.0:
            raise SimulatorError(f"{name} {values[name]:g} is not between 0 and 50", where=where)
    if max(abs(shift_x), abs(shift_y)) > max(image_size) / 4:
        raise SimulatorError(f"center_shift_px ({shift_x:g}, {shift_y:g}) leaves the picture's middle", where=where)
    optics = Optics.from_fov(image_size, values["fov_x_deg"], values["k1"], values["k2"], (shift_x, shift_y), aspect)
    if optics.folds_inside_picture:
        raise SimulatorError(
            f"k1 {values['k1']:g}, k2 {values['k2']:g} fold inside the picture, "
            f"beyond radius {optics.fold_radius:.4g}; check them and their radius unit (focal length)",
            where=where,
        )
    return LensLevel(center_shift_px=(shift_x, shift_y), **values)


def _pair(content: Mapping[str, Any], name: str, where: str) -> tuple[object, object]:
    value = content.get(name)
    if not isinstance(value, list) or len(value) != 2:
        raise SimulatorError(f"{name} is missing or is not a pair of numbers", where=where)
    return value[0], value[1]


def _number(value: object, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SimulatorError(f"{name} is {value!r}, not a number", where=where)
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SimulatorError(f"{name} is {number}, not a finite number", where=where)
    return number
