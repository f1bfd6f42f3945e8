"""Mistakes of the real world as unknowns of a level's fit, each with a prior, and what the pictures say of them.

A survey is a few millimetres wrong, a board is not flat, an encoder has a scale and an offset, a pupil does not stand
on the pivot's axis, a head rolls a little from picture to picture. Taken as exact, such a mistake hides in the lens;
as an unknown with a prior it costs little where it is not there, and is named where the pictures show it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import StrEnum

from calibration.errors import InvalidInput

SHOWN_SIGMAS = 3.0
"""An estimate this many of its own sigmas away from none is shown by the pictures."""
TOLD_SHARE = 0.5
"""The pictures tell a mistake where its sigma comes below this share of its prior's."""


@dataclass(frozen=True, slots=True)
class Priors:
    """How large the mistakes may be, standard deviations; 0: there is none.

    ``bow_m``: by how much the middle of a board stands out of the plane of its corners, along its columns and along its
    rows; None: 1 % of a hand-held board's larger side, 0 for a surveyed one. ``pan_scale``, ``tilt_scale``: relative
    error of the head's encoders; ``pan_offset_deg``, ``tilt_offset_deg``, ``roll_offset_deg``: of their zero, the last
    one also for a sensor turned in its camera. ``off_axis_mm``: the entrance pupil's distance from the line through the
    pivot along the optical axis, right and down. All are common to the pictures of a fit; the roll of single pictures
    is ``CameraPose.roll_sigma_deg``.
    """

    bow_m: float | None = None
    pan_scale: float = 0.0
    tilt_scale: float = 0.0
    pan_offset_deg: float = 0.0
    tilt_offset_deg: float = 0.0
    roll_offset_deg: float = 0.0
    off_axis_mm: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise InvalidInput(f"prior {field.name}", value, "must be 0 (none) or a positive number")


HAND_HELD_BOW = 0.01
"""Prior of a hand-held board's bow, as a share of its larger side."""


class Verdict(StrEnum):
    """What the pictures say of a mistake."""

    SHOWN = "shown"
    NOT_SHOWN = "not shown"
    UNTOLD = "cannot be told"


@dataclass(frozen=True, slots=True)
class Mistake:
    """One possible mistake: ``estimate``, its ``sigma`` and its prior's, all in ``unit``; ``subject`` names the target
    it belongs to, empty for the head's and the camera's."""

    name: str
    subject: str
    unit: str
    estimate: float
    sigma: float
    prior_sigma: float

    @property
    def verdict(self) -> Verdict:
        """See :data:`SHOWN_SIGMAS` and :data:`TOLD_SHARE`."""
        if not math.isfinite(self.sigma) or self.sigma >= TOLD_SHARE * self.prior_sigma:
            return Verdict.UNTOLD
        return Verdict.SHOWN if abs(self.estimate) > SHOWN_SIGMAS * self.sigma else Verdict.NOT_SHOWN

    def __str__(self) -> str:
        what = f"{self.name} of {self.subject}" if self.subject else self.name
        return f"{what}: {self.estimate:.3g} ± {self.sigma:.2g} {self.unit} ({self.verdict.value})".replace("  ", " ")
