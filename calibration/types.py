"""Values that the numerics pass around: targets, poses, detections.

Units and frames are those of ``docs/explanations/conventions.md``: metres and degrees in a right-handed
world (X right, Y forward, Z up), pixels with centres at whole numbers (u right, v down).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from calibration.errors import InvalidInput

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Picture = NDArray[np.uint8]
"""A picture: uint8, shape (H, W, 3), BGR, coded values as they came from the source."""


class TargetKind(StrEnum):
    """What can be looked for in a picture."""

    CHESSBOARD = "chessboard"
    SQUARE = "square"
    LIGHT = "light"


class Role(StrEnum):
    """What a picture was taken for: a hint only, every picture of a level counts in its fit."""

    CENTER_SHIFT = "center_shift"
    FOV = "fov"
    K1 = "k1"
    K2 = "k2"
    NODAL = "nodal"
    FREE = "free"


_FARTHEST = 1e5
# Metres or degrees: 100 km, beyond any studio; larger numbers are a mistake and cost the fit its digits.


def _finite(what: str, *values: float) -> None:
    for value in values:
        if not math.isfinite(value) or abs(value) > _FARTHEST:
            raise InvalidInput(what, value, f"must be a number between -{_FARTHEST:g} and {_FARTHEST:g}")


def _sigma(what: str, value: float) -> None:
    if not math.isfinite(value) or value < 0:
        raise InvalidInput(what, value, "must be 0 (exact) or a positive number")


@dataclass(frozen=True, slots=True)
class TargetPose:
    """Where a target stands: its centre in metres, then yaw (about Z), pitch (X), roll (Y), intrinsic, degrees.

    At yaw, pitch, roll 0 it faces the camera (normal -Y), columns along +X, rows along -Z.
    ``sigma_m`` and ``sigma_deg`` are the standard deviations of the survey per axis; 0 means exact.
    """

    centre_m: tuple[float, float, float]
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    sigma_m: float = 0.0
    sigma_deg: float = 0.0

    def __post_init__(self) -> None:
        _finite("target pose", *self.centre_m, self.yaw_deg, self.pitch_deg, self.roll_deg)
        _sigma("target pose sigma_m", self.sigma_m)
        _sigma("target pose sigma_deg", self.sigma_deg)


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Where the camera's pivot stands (metres) and how it is turned (pan, tilt, roll, intrinsic Z, X, Y, degrees).

    Positive pan turns right, positive tilt up, positive roll clockwise seen from behind the camera.
    ``sigma_m`` (pivot) and ``sigma_deg`` (each angle) are standard deviations; 0 means exact. ``roll_sigma_deg``: that
    of the roll alone, where the head's roll is another matter than its encoders (None: as the other angles).
    """

    pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    sigma_m: float = 0.0
    sigma_deg: float = 0.0
    roll_sigma_deg: float | None = None

    @property
    def roll_sigma(self) -> float:
        """Standard deviation of the roll, degrees."""
        return self.sigma_deg if self.roll_sigma_deg is None else self.roll_sigma_deg

    def __post_init__(self) -> None:
        _finite("camera pose", *self.pivot_m, self.pan_deg, self.tilt_deg, self.roll_deg)
        _sigma("camera pose sigma_m", self.sigma_m)
        _sigma("camera pose sigma_deg", self.sigma_deg)
        _sigma("camera pose roll_sigma_deg", self.roll_sigma)


@dataclass(frozen=True, slots=True)
class Target:
    """A thing to look for: its shape, and its pose where it is known.

    ``squares`` = (columns, rows) of squares and ``square_m`` for a chessboard, ``size_m`` = (width, height) for a
    square, ``diameter_m`` for a light. ``pose`` None: unknown, and free for EACH picture (a hand-held board).
    """

    kind: TargetKind
    squares: tuple[int, int] | None = None
    square_m: float | None = None
    size_m: tuple[float, float] | None = None
    diameter_m: float | None = None
    colours: tuple[str, ...] = ()
    pose: TargetPose | None = None

    def __post_init__(self) -> None:
        if self.kind is TargetKind.CHESSBOARD:
            if self.squares is None or min(self.squares) < 3:
                raise InvalidInput("target squares", self.squares, "a chessboard needs at least 3 x 3 squares")
            _positive("target square_m", self.square_m)
        elif self.kind is TargetKind.SQUARE:
            if self.size_m is None:
                raise InvalidInput("target size_m", None, "a square needs its width and height in metres")
            _positive("target size_m width", self.size_m[0])
            _positive("target size_m height", self.size_m[1])
        elif self.diameter_m is not None:
            _positive("target diameter_m", self.diameter_m)

    @property
    def grid(self) -> tuple[int, int]:
        """(columns, rows) of the target's points: inner corners of a board, 2 x 2 corners of a square, 1 x 1 light."""
        if self.kind is TargetKind.CHESSBOARD:
            columns, rows = self.squares or (0, 0)  # they are there: see __post_init__
            return columns - 1, rows - 1
        return (2, 2) if self.kind is TargetKind.SQUARE else (1, 1)

    def points_m(self) -> FloatArray:
        """The target's points in its own plane, metres, (N, 2): column direction right, row direction down.

        Row by row from the top left, origin at the target's centre.
        """
        columns, rows = self.grid
        if self.kind is TargetKind.CHESSBOARD:
            step_x = step_y = float(self.square_m or 0.0)
        elif self.kind is TargetKind.SQUARE:
            step_x, step_y = self.size_m or (0.0, 0.0)
        else:
            step_x = step_y = 0.0
        right = (np.arange(columns, dtype=np.float64) - (columns - 1) / 2) * step_x
        down = (np.arange(rows, dtype=np.float64) - (rows - 1) / 2) * step_y
        grid_right, grid_down = np.meshgrid(right, down)
        return np.column_stack([grid_right.ravel(), grid_down.ravel()])

    def outline_m(self) -> tuple[float, float]:
        """Width and height of the whole target in metres."""
        if self.kind is TargetKind.CHESSBOARD:
            columns, rows = self.squares or (0, 0)  # both are there: see __post_init__
            return columns * (self.square_m or 0.0), rows * (self.square_m or 0.0)
        if self.kind is TargetKind.SQUARE:
            return self.size_m or (0.0, 0.0)
        diameter = self.diameter_m or 0.0
        return diameter, diameter


def _positive(what: str, value: float | None) -> None:
    if value is None or not math.isfinite(value) or value <= 0:
        raise InvalidInput(what, value, "must be a positive number")


@dataclass(frozen=True, slots=True)
class Quality:
    """How far a detection can be trusted. ``score`` 0..1 sums it up; the parts say why.

    ``contrast``: difference of the two colours over the noise (ratio). ``fit_chi2``: mean squared residual of the
    pixel fit over the noise variance (1 = at the noise floor), NaN where no pixel fit was made. ``grid_rms_px``: how
    far the points are from a smooth grid.
    """

    score: float
    contrast: float = math.nan
    fit_chi2: float = math.nan
    grid_rms_px: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A target found in a picture.

    ``points_px`` (N, 2) are (u, v), pixel centres at whole numbers; ``point_ids`` (N,) says which of the target's
    points (``Target.points_m``, row by row) each one is, so that a partly visible board can be used rightly;
    ``covariance_px2`` (N, 2, 2); ``centre_px`` (2,) the target's centre as seen (crossing of the diagonals, or the
    light's centre); ``blur_px`` the Gaussian sigma of the picture's blur at the target, NaN where unknown.
    A board is read so that its rows run downwards in the picture (its first point is the top left one).
    """

    kind: TargetKind
    points_px: FloatArray
    point_ids: IntArray
    covariance_px2: FloatArray
    centre_px: FloatArray
    blur_px: float
    quality: Quality


@dataclass(frozen=True, slots=True)
class Refusal:
    """A target that was not found, or not well enough to be measured; ``reason`` is one line for the operator."""

    reason: str


DetectionResult = Detection | Refusal
