"""The lens table: what a calibration leaves behind, level by level.

Frozen values only; how a table becomes JSON, CSV or a database row is the business of ``storage``. The fields are
those of ``docs/reference/lens-table.schema.json``. A quantity that could not be told from the pictures is ``None``
with its reason in ``LevelResult.reasons``, never a guess.

The lens itself is ``fov_x_deg``, ``k1``, ``k2`` (focal-length units), ``center_shift_px`` and ``nodal_offset_mm``;
``fov_y_deg``, ``f_px``, ``k1_hw`` and ``k2_hw`` say the same in other units (:class:`calibration.lens.Lens`) and are
checked against them, loosely enough for a table that a person has rounded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum

from calibration.errors import InvalidInput
from calibration.lens import Lens

LENS_QUANTITIES = ("fov_x_deg", "k1", "k2", "center_shift_px", "nodal_offset_mm")
"""What a level measures; each one is told or has its reason."""

EVIDENCE_QUANTITIES = ("residual_px", "held_out_px", "predicted_overlay_px", "engine_overlay_px")
"""What a level says about its own exactness; each one is told or has its reason."""

REASON_KEYS = LENS_QUANTITIES + EVIDENCE_QUANTITIES

MIN_FOV_DEG = 1e-3
"""Far below any lens; smaller values are a mistake of unit, and their focal length is no number any more."""

MAX_NAME_LENGTH = 200
MAX_PICTURE_SIDE_PX = 100_000

_SCENARIOS = (1, 2, 3)
_FOV_Y_TOLERANCE = 0.02
_F_TOLERANCE = 0.02
_HW_TOLERANCE = (0.05, 0.005)
# Relative (and for the distortion also absolute, radius 1 at half width) differences between a quantity and its twin
# in other units. A person's rounding stays below them; another radius unit, picture width or axis does not.


class LevelStatus(StrEnum):
    """How a level ended."""

    OK = "ok"
    DEGRADED = "degraded"
    """Usable, with the reason."""
    FAILED = "failed"
    """No numbers, with the reason."""


@dataclass(frozen=True, slots=True)
class PixelError:
    """An error in px of the picture: root mean square (of what, the field that holds it says) and the largest."""

    rms: float
    max: float

    def __post_init__(self) -> None:
        _not_negative("pixel error rms", self.rms)
        _not_negative("pixel error max", self.max)


@dataclass(frozen=True, slots=True)
class Sigma:
    """Standard deviations (1 sigma) of a level's quantities, each in its quantity's unit; None: not told."""

    fov_x_deg: float | None = None
    k1: float | None = None
    k2: float | None = None
    center_shift_px: tuple[float, float] | None = None
    nodal_offset_mm: float | None = None

    def __post_init__(self) -> None:
        for name in ("fov_x_deg", "k1", "k2", "nodal_offset_mm"):
            value = getattr(self, name)
            if value is not None:
                _not_negative(f"sigma {name}", value)
        if self.center_shift_px is not None:
            for value in self.center_shift_px:
                _not_negative("sigma center_shift_px", value)


@dataclass(frozen=True, slots=True)
class Frames:
    """How many pictures a level took: of the camera (``real``) and of the engine's own render (``virtual``)."""

    real: int = 0
    virtual: int = 0

    def __post_init__(self) -> None:
        if self.real < 0 or self.virtual < 0:
            raise InvalidInput("frames", (self.real, self.virtual), "a number of pictures cannot be negative")


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A picture that the fit did not use, by its name, and why."""

    picture: str
    reason: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "picture", _storable(self.picture))
        object.__setattr__(self, "reason", _storable(self.reason))


@dataclass(frozen=True, slots=True)
class Interpolation:
    """How values between the levels are found, and how far that was off at levels left out of it (None: untried)."""

    kind: str
    held_out_px: PixelError | None = None

    def __post_init__(self) -> None:
        _name("interpolation kind", self.kind)


@dataclass(frozen=True, slots=True)
class Parallax:
    """How far a thing at ``near_m`` moves against one at ``far_m`` (px) while the camera pans over ``pan_deg``: with
    the nodal offset as it was given (``as_given_px``), and by one sigma of the one found (``sigma_px``)."""

    near_m: float
    far_m: float
    pan_deg: float
    as_given_px: float
    sigma_px: float

    def __post_init__(self) -> None:
        for name in ("near_m", "far_m", "pan_deg", "as_given_px", "sigma_px"):
            _not_negative(f"parallax {name}", getattr(self, name))


@dataclass(frozen=True, slots=True)
class EvidenceSummary:
    """What a level's numbers rest on, in short; the whole of it is the level's evidence document.

    ``noise_floor_px``: noise that the pictures have beyond what the detector promises. ``worst_picture`` and
    ``worst_picture_p``: the picture whose residuals noise explains least, and the chance of larger ones.
    ``coverage_share``: of the cells of the frame, how many have points; ``radius_share``: the farthest point's
    distance from the principal point over the farthest corner's. ``fold_margin``: radius of the lens's fold over the
    corner's, None: never. ``misfit``: the term that the lens lacks for certain, None: nothing; ``misfit_px``: how far
    the lens is off for it. ``mistakes``: those of survey, board, head and camera that the pictures show.
    ``inputs_sha256``: of the inputs in the evidence document as canonical JSON.
    """

    noise_floor_px: float
    worst_picture: str
    worst_picture_p: float | None
    coverage_share: float
    radius_share: float
    fold_margin: float | None
    misfit: str | None
    misfit_px: float | None
    mistakes: tuple[str, ...]
    inputs_sha256: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "worst_picture", _storable(self.worst_picture))
        object.__setattr__(self, "mistakes", tuple(_storable(text) for text in self.mistakes))
        for name in ("noise_floor_px", "coverage_share", "radius_share"):
            _not_negative(f"evidence {name}", getattr(self, name))
        for name in ("worst_picture_p", "fold_margin", "misfit_px"):
            if getattr(self, name) is not None:
                _not_negative(f"evidence {name}", getattr(self, name))


@dataclass(frozen=True, slots=True)
class EngineValues:
    """What an engine is to be told for a level where that is not the level's own lens: the same quantities, in the
    product's conventions, as the studio profile converts them."""

    fov_x_deg: float
    k1: float
    k2: float
    center_shift_px: tuple[float, float]
    nodal_offset_mm: float

    def __post_init__(self) -> None:
        for name in ("fov_x_deg", "k1", "k2", "nodal_offset_mm"):
            _finite(f"engine value {name}", getattr(self, name))
        for value in self.center_shift_px:
            _finite("engine value center_shift_px", value)

    @classmethod
    def of(cls, lens: Lens) -> EngineValues:
        """The values of a lens to be asked for."""
        return cls(lens.fov_x_deg, lens.k1, lens.k2, lens.center_shift_px, lens.nodal_offset_mm)


@dataclass(frozen=True, slots=True)
class LevelResult:
    """One level, a pair of encoder values (``zoom``, ``focus``), and what was measured there.

    ``fov_x_deg``, ``fov_y_deg``: field of view of the pinhole, degrees, under 180. ``f_px``: horizontal focal
    length, px. ``k1``, ``k2``: radius in focal lengths; ``k1_hw``, ``k2_hw``: radius 1 at half the picture's width.
    ``center_shift_px``: principal point minus picture centre, px, right and down. ``nodal_offset_mm``: pivot to
    entrance pupil, positive towards the scene. ``sigma``: one standard deviation of each.

    ``residual_px``: real corners against the fitted model, RMS per coordinate. ``held_out_px``: the same on pictures
    left out of the fit. ``predicted_overlay_px``: overlay error expected from the covariance. ``engine_overlay_px``:
    corners of the engine's own last render at the coefficients as published. ``engine_values``: what the engine must
    be told to draw this lens, None where that is the lens itself. ``parallax``: the operator's no-parallax check as a
    number, where the nodal offset was measured. ``evidence``: what the numbers rest on, None where it was not kept.

    ``scenario`` 1, 2, 3 of the study (chapter 4.3), None where the method knows none. ``seconds``: how long the level
    took. ``reason``: why a level is degraded or failed. ``reasons``: why a quantity of :data:`REASON_KEYS` is None;
    a level that is not failed must give one for each.

    Raises :class:`InvalidInput` for values out of range, a missing reason, or numbers in a failed level.
    """

    zoom: float
    focus: float
    status: LevelStatus
    fov_x_deg: float | None = None
    fov_y_deg: float | None = None
    f_px: float | None = None
    k1: float | None = None
    k2: float | None = None
    k1_hw: float | None = None
    k2_hw: float | None = None
    center_shift_px: tuple[float, float] | None = None
    nodal_offset_mm: float | None = None
    sigma: Sigma = Sigma()
    residual_px: PixelError | None = None
    held_out_px: PixelError | None = None
    predicted_overlay_px: PixelError | None = None
    engine_overlay_px: PixelError | None = None
    engine_values: EngineValues | None = None
    parallax: Parallax | None = None
    evidence: EvidenceSummary | None = None
    scenario: int | None = None
    frames: Frames = Frames()
    seconds: float | None = None
    left_out: tuple[LeftOut, ...] = ()
    reason: str | None = None
    reasons: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "status", LevelStatus(self.status))
        object.__setattr__(self, "left_out", tuple(self.left_out))
        object.__setattr__(self, "reasons", {name: _storable(why) for name, why in self.reasons.items()})
        object.__setattr__(self, "reason", _storable(self.reason) if self.reason else None)
        _finite("zoom", self.zoom)
        _finite("focus", self.focus)
        self._check_quantities()
        self._check_reasons()

    def _check_quantities(self) -> None:
        for name, lowest_deg in (("fov_x_deg", MIN_FOV_DEG), ("fov_y_deg", 0.0)):
            value = getattr(self, name)
            if value is not None and not (value > 0 and lowest_deg <= value < 180):
                raise InvalidInput(name, value, f"must lie between {lowest_deg:g} and 180 degrees")
        for name in ("k1", "k2", "k1_hw", "k2_hw", "nodal_offset_mm"):
            value = getattr(self, name)
            if value is not None:
                _finite(name, value)
        if self.f_px is not None:
            _positive("f_px", self.f_px)
        for value in self.center_shift_px or ():
            _finite("center_shift_px", value)
        if self.seconds is not None:
            _not_negative("seconds", self.seconds)
        if self.scenario is not None and self.scenario not in _SCENARIOS:
            raise InvalidInput("scenario", self.scenario, "must be 1, 2 or 3 (or left open)")
        pairs = (("f_px", "fov_x_deg"), ("fov_y_deg", "fov_x_deg"), ("k1_hw", "k1"), ("k2_hw", "k2"))
        for derived, primary in pairs:
            if getattr(self, derived) is not None and getattr(self, primary) is None:
                raise InvalidInput(derived, getattr(self, derived), f"cannot be told while {primary} is not")

    def _check_reasons(self) -> None:
        where = f"of level zoom {self.zoom:g}, focus {self.focus:g}"
        unknown = sorted(set(self.reasons) - set(REASON_KEYS))
        if unknown:
            raise InvalidInput(f"reasons {where}", unknown[0], f"is none of {', '.join(REASON_KEYS)}")
        for name in self.reasons:
            if getattr(self, name) is not None:
                raise InvalidInput(f"{name} {where}", getattr(self, name), "has a value and a reason why it has none")
        if self.status is not LevelStatus.OK and not self.reason:
            raise InvalidInput(f"status {where}", str(self.status), "needs its reason")
        if self.status is LevelStatus.FAILED:
            told = [name for name in LENS_QUANTITIES if getattr(self, name) is not None]
            if told:
                raise InvalidInput(f"{told[0]} {where}", getattr(self, told[0]), "a failed level has no numbers")
            return
        unexplained = [name for name in REASON_KEYS if getattr(self, name) is None and not self.reasons.get(name)]
        if unexplained:
            raise InvalidInput(f"{unexplained[0]} {where}", None, "a quantity that is not told needs its reason")

    @classmethod
    def from_lens(
        cls,
        zoom: float,
        focus: float,
        lens: Lens,
        *,
        status: LevelStatus = LevelStatus.OK,
        reason: str | None = None,
        reasons: Mapping[str, str] | None = None,
        sigma: Sigma | None = None,
        residual_px: PixelError | None = None,
        held_out_px: PixelError | None = None,
        predicted_overlay_px: PixelError | None = None,
        engine_overlay_px: PixelError | None = None,
        engine_values: EngineValues | None = None,
        parallax: Parallax | None = None,
        scenario: int | None = None,
        frames: Frames | None = None,
        seconds: float | None = None,
        left_out: tuple[LeftOut, ...] = (),
    ) -> LevelResult:
        """A level from its lens; each lens quantity named in ``reasons`` is not told (None), whatever ``lens`` says."""
        reasons = reasons or {}
        has_fov = "fov_x_deg" not in reasons
        has_k1, has_k2 = "k1" not in reasons, "k2" not in reasons
        return cls(
            zoom=zoom,
            focus=focus,
            status=status,
            fov_x_deg=lens.fov_x_deg if has_fov else None,
            fov_y_deg=lens.fov_y_deg if has_fov else None,
            f_px=lens.f_px if has_fov else None,
            k1=lens.k1 if has_k1 else None,
            k2=lens.k2 if has_k2 else None,
            k1_hw=lens.k1_hw if has_k1 and has_fov else None,
            k2_hw=lens.k2_hw if has_k2 and has_fov else None,
            center_shift_px=lens.center_shift_px if "center_shift_px" not in reasons else None,
            nodal_offset_mm=lens.nodal_offset_mm if "nodal_offset_mm" not in reasons else None,
            sigma=sigma or Sigma(),
            residual_px=residual_px,
            held_out_px=held_out_px,
            predicted_overlay_px=predicted_overlay_px,
            engine_overlay_px=engine_overlay_px,
            engine_values=engine_values,
            parallax=parallax,
            scenario=scenario,
            frames=frames or Frames(),
            seconds=seconds,
            left_out=left_out,
            reason=reason,
            reasons=reasons,
        )

    @classmethod
    def failed(
        cls,
        zoom: float,
        focus: float,
        reason: str,
        *,
        frames: Frames | None = None,
        seconds: float | None = None,
        left_out: tuple[LeftOut, ...] = (),
    ) -> LevelResult:
        """A level without numbers, and why."""
        return cls(
            zoom,
            focus,
            LevelStatus.FAILED,
            frames=frames or Frames(),
            seconds=seconds,
            left_out=left_out,
            reason=reason,
        )

    def completed(self, image_size: tuple[int, int], pixel_aspect: float = 1.0) -> LevelResult:
        """The same level with what follows from its lens (``fov_y_deg``, ``f_px``, ``k1_hw``, ``k2_hw``) filled in."""
        if self.fov_x_deg is None:
            return self
        lens = self.lens(image_size, pixel_aspect)
        derived = {"fov_y_deg": lens.fov_y_deg, "f_px": lens.f_px}
        if self.k1 is not None:
            derived["k1_hw"] = lens.k1_hw
        if self.k2 is not None:
            derived["k2_hw"] = lens.k2_hw
        missing = {name: value for name, value in derived.items() if getattr(self, name) is None}
        return replace(self, **missing) if missing else self  # type: ignore[arg-type]

    def lens(self, image_size: tuple[int, int], pixel_aspect: float = 1.0) -> Lens:
        """The level's lens, as an engine shows it: what is not told counts as 0.

        Raises :class:`InvalidInput` when the field of view is not told.
        """
        if self.fov_x_deg is None:
            why = self.reason or self.reasons.get("fov_x_deg", "")
            raise InvalidInput(f"fov_x_deg of level zoom {self.zoom:g}, focus {self.focus:g}", None, f"not told: {why}")
        return Lens.from_fov(
            image_size,
            self.fov_x_deg,
            k1=self.k1 or 0.0,
            k2=self.k2 or 0.0,
            center_shift_px=self.center_shift_px or (0.0, 0.0),
            pixel_aspect=pixel_aspect,
            nodal_offset_mm=self.nodal_offset_mm or 0.0,
        )


@dataclass(frozen=True, slots=True)
class LensTable:
    """A calibrated lens: its levels, and what holds for all of them.

    ``version`` counts the tables of one lens on one camera from 1. ``created``: an aware time, kept in UTC.
    ``image_size`` (W, H) px; ``sensor_mm`` (W, H) or None where unknown; ``pixel_aspect``: vertical over horizontal
    focal length in px. ``method``: how the levels were solved (``joint``, ``alternating``, ...).

    Raises :class:`InvalidInput` for an empty table, two results for one level, a naive time, or a level whose
    derived quantities contradict its lens.
    """

    lens: str
    camera: str
    version: int
    created: datetime
    image_size: tuple[int, int]
    method: str
    levels: tuple[LevelResult, ...]
    sensor_mm: tuple[float, float] | None = None
    pixel_aspect: float = 1.0
    interpolation: Interpolation | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", tuple(self.levels))
        for what in ("lens", "camera", "method"):
            _name(what, getattr(self, what))
        if self.version < 1:
            raise InvalidInput("version", self.version, "versions count from 1")
        if self.created.tzinfo is None:
            raise InvalidInput("created", self.created.isoformat(), "must say its time zone, for example Z for UTC")
        object.__setattr__(self, "created", self.created.astimezone(UTC))
        for side in self.image_size:
            if not 2 <= side <= MAX_PICTURE_SIDE_PX:
                raise InvalidInput("image_size", self.image_size, f"each side must be 2 to {MAX_PICTURE_SIDE_PX} px")
        for millimetres in self.sensor_mm or ():
            _positive("sensor_mm", millimetres)
        _positive("pixel_aspect", self.pixel_aspect)
        if not self.levels:
            raise InvalidInput("levels", self.levels, "a lens table needs at least one level")
        seen: set[tuple[float, float]] = set()
        for level in self.levels:
            key = (level.zoom, level.focus)
            if key in seen:
                raise InvalidInput("levels", key, "this (zoom, focus) stands in the table twice")
            seen.add(key)
            self._check_derived(level)

    def _check_derived(self, level: LevelResult) -> None:
        if level.fov_x_deg is None:
            return
        lens = level.lens(self.image_size, self.pixel_aspect)
        hw_relative, hw_absolute = _HW_TOLERANCE
        for name, relative, absolute in (
            ("f_px", _F_TOLERANCE, 0.0),
            ("fov_y_deg", _FOV_Y_TOLERANCE, 0.0),
            ("k1_hw", hw_relative, hw_absolute),
            ("k2_hw", hw_relative, hw_absolute),
        ):
            value, expected = getattr(level, name), getattr(lens, name)
            if value is not None and not math.isclose(value, expected, rel_tol=relative, abs_tol=absolute):
                raise InvalidInput(
                    f"{name} of level zoom {level.zoom:g}, focus {level.focus:g}",
                    value,
                    f"contradicts fov_x_deg, k1, k2 and the picture's size, which give {expected:.6g}",
                )

    def level_at(self, zoom: float, focus: float) -> LevelResult | None:
        """The level with exactly these encoder values, None where there is none."""
        return next((level for level in self.levels if (level.zoom, level.focus) == (zoom, focus)), None)


def _finite(what: str, value: float) -> None:
    if not math.isfinite(value):
        raise InvalidInput(what, value, "must be a finite number")


def _not_negative(what: str, value: float) -> None:
    if not math.isfinite(value) or value < 0:
        raise InvalidInput(what, value, "must be 0 or a positive number")


def _positive(what: str, value: float) -> None:
    if not math.isfinite(value) or value <= 0:
        raise InvalidInput(what, value, "must be a positive number")


def _name(what: str, value: str) -> None:
    if not value.strip() or len(value) > MAX_NAME_LENGTH or not value.isprintable():
        raise InvalidInput(what, value, f"must be 1 to {MAX_NAME_LENGTH} printable characters")


def _storable(text: str) -> str:
    """Free text made storable everywhere: file names may hold bytes that are no Unicode, or NUL from a broken one."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8").replace("\0", "\\0")
