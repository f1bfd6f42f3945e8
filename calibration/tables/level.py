"""One level of a lens table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.tables.checks import finite, not_negative, positive, storable
from calibration.tables.parts import (
    EngineValues,
    EvidenceSummary,
    Frames,
    LeftOut,
    LevelStatus,
    Parallax,
    PixelError,
    Sigma,
)

LENS_QUANTITIES = ("fov_x_deg", "k1", "k2", "center_shift_px", "nodal_offset_mm")
"""What a level measures; each one is told or has its reason."""

EVIDENCE_QUANTITIES = ("residual_px", "held_out_px", "predicted_overlay_px", "engine_overlay_px")
"""What a level says about its own exactness; each one is told or has its reason."""

REASON_KEYS = LENS_QUANTITIES + EVIDENCE_QUANTITIES

MIN_FOV_DEG = 1e-3
"""Far below any lens; smaller values are a mistake of unit, and their focal length is no number any more."""

_SCENARIOS = (1, 2, 3)


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
    sigma: Sigma = field(default_factory=Sigma)
    residual_px: PixelError | None = None
    held_out_px: PixelError | None = None
    predicted_overlay_px: PixelError | None = None
    engine_overlay_px: PixelError | None = None
    engine_values: EngineValues | None = None
    parallax: Parallax | None = None
    evidence: EvidenceSummary | None = None
    scenario: int | None = None
    frames: Frames = field(default_factory=Frames)
    seconds: float | None = None
    left_out: tuple[LeftOut, ...] = ()
    reason: str | None = None
    reasons: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "status", LevelStatus(self.status))
        object.__setattr__(self, "left_out", tuple(self.left_out))
        object.__setattr__(self, "reasons", {name: storable(why) for name, why in self.reasons.items()})
        object.__setattr__(self, "reason", storable(self.reason) if self.reason else None)
        finite("zoom", self.zoom)
        finite("focus", self.focus)
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
                finite(name, value)
        if self.f_px is not None:
            positive("f_px", self.f_px)
        for value in self.center_shift_px or ():
            finite("center_shift_px", value)
        if self.seconds is not None:
            not_negative("seconds", self.seconds)
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
