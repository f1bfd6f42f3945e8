"""Where a target is expected in a picture: what a detector may use to look in one place only."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.errors import InvalidInput
from calibration.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The target's points as expected, (N, 2) px in the order of ``Target.points_m``, each good to ``sigma_px``.

    ``sigma_px`` is one standard deviation per coordinate, > 0. Points outside the picture are allowed.
    Raises :class:`InvalidInput` for another shape, numbers that are not finite, and a sigma that is not positive.
    """

    points_px: FloatArray
    sigma_px: float

    def __post_init__(self) -> None:
        points = np.asarray(self.points_px, dtype=np.float64)
        if points.ndim != 2 or points.shape[0] < 1 or points.shape[1] != 2:
            raise InvalidInput("prediction points_px", points.shape, "must have the shape (N, 2)")
        if not np.isfinite(points).all():
            raise InvalidInput("prediction points_px", "NaN or infinite", "every expected point must be finite")
        if not math.isfinite(self.sigma_px) or self.sigma_px <= 0:
            raise InvalidInput("prediction sigma_px", self.sigma_px, "must be a positive number of pixels")
        object.__setattr__(self, "points_px", points)
