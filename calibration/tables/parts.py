"""The parts of a level and of a table: errors in px, sigmas, counts, and what a number rests on."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from calibration.errors import InvalidInput
from calibration.lens import Lens
from calibration.tables.checks import finite, not_negative, printable_name, storable


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
        not_negative("pixel error rms", self.rms)
        not_negative("pixel error max", self.max)


SIGMA_PARAMETERS = ("fov_x_deg", "k1", "k2", "center_shift_x_px", "center_shift_y_px")
"""Order of the rows and columns of :attr:`Sigma.correlation`."""

_ABOVE_ONE = 1e-6
# By how much rounding may lift a correlation above 1.


@dataclass(frozen=True, slots=True)
class Sigma:
    """Standard deviations (1 sigma) of a level's quantities, each in its quantity's unit; None: not told.

    ``correlation`` (5 x 5, order :data:`SIGMA_PARAMETERS`) ties the errors of one level together: those of field of
    view, k1 and k2 nearly cancel in the picture. None: not kept.
    """

    fov_x_deg: float | None = None
    k1: float | None = None
    k2: float | None = None
    center_shift_px: tuple[float, float] | None = None
    nodal_offset_mm: float | None = None
    correlation: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        for name in ("fov_x_deg", "k1", "k2", "nodal_offset_mm"):
            value = getattr(self, name)
            if value is not None:
                not_negative(f"sigma {name}", value)
        if self.center_shift_px is not None:
            for value in self.center_shift_px:
                not_negative("sigma center_shift_px", value)
        if self.correlation is not None:
            object.__setattr__(self, "correlation", tuple(tuple(row) for row in self.correlation))
            _check_correlation(self.correlation)


def _check_correlation(rows: tuple[tuple[float, ...], ...]) -> None:
    size = len(SIGMA_PARAMETERS)
    if len(rows) != size or any(len(row) != size for row in rows):
        raise InvalidInput("sigma correlation", rows, f"must be {size} x {size}: {', '.join(SIGMA_PARAMETERS)}")
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            if not abs(value) <= 1 + _ABOVE_ONE:
                raise InvalidInput("sigma correlation", value, "must lie between -1 and 1")
            if abs(value - rows[j][i]) > _ABOVE_ONE or (i == j and abs(value - 1) > _ABOVE_ONE):
                raise InvalidInput("sigma correlation", value, "must be symmetric with ones on the diagonal")


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
        object.__setattr__(self, "picture", storable(self.picture))
        object.__setattr__(self, "reason", storable(self.reason))


@dataclass(frozen=True, slots=True)
class Interpolation:
    """How values between the levels are found, and how far that was off at levels left out of it (None: untried)."""

    kind: str
    held_out_px: PixelError | None = None

    def __post_init__(self) -> None:
        printable_name("interpolation kind", self.kind)


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
            not_negative(f"parallax {name}", getattr(self, name))


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
        object.__setattr__(self, "worst_picture", storable(self.worst_picture))
        object.__setattr__(self, "mistakes", tuple(storable(text) for text in self.mistakes))
        for name in ("noise_floor_px", "coverage_share", "radius_share"):
            not_negative(f"evidence {name}", getattr(self, name))
        for name in ("worst_picture_p", "fold_margin", "misfit_px"):
            if getattr(self, name) is not None:
                not_negative(f"evidence {name}", getattr(self, name))


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
            finite(f"engine value {name}", getattr(self, name))
        for value in self.center_shift_px:
            finite("engine value center_shift_px", value)

    @classmethod
    def of(cls, lens: Lens) -> EngineValues:
        """The values of a lens to be asked for."""
        return cls(lens.fov_x_deg, lens.k1, lens.k2, lens.center_shift_px, lens.nodal_offset_mm)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a table comes from. ``source``: ``calibrated``, ``imported``, ``corrected``, ``rolled back`` or another
    word; ``software``: name and version of what made it; ``job_id``: of the job, None without one; ``profile`` and
    ``profile_sha256``: the studio profile of its engine; ``inputs_sha256``: over all levels' inputs (or the imported
    file); ``parent_sha256``: of the table it was made from; ``note``: whatever else a reader should know, one line.
    """

    source: str
    software: str
    job_id: str | None = None
    profile: str | None = None
    profile_sha256: str | None = None
    inputs_sha256: str | None = None
    parent_sha256: str | None = None
    note: str | None = None

    def __post_init__(self) -> None:
        printable_name("provenance source", self.source)
        printable_name("provenance software", self.software)
        for name in ("job_id", "profile", "profile_sha256", "inputs_sha256", "parent_sha256", "note"):
            value = getattr(self, name)
            object.__setattr__(self, name, storable(value) if value else None)
