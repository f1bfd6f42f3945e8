"""Proof that a picture is fresh: the output's delay is measured, and a picture that should have changed must have.

A picture fetched right after a change may still show the old state. So a job first switches the background off and
on and measures after how long the output follows; after each change it waits that long; and where the change must
be visible (another pose, another source) the picture is compared with the one before.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.types import Picture
from engine_adapters.errors import AdapterError

CHANGED_LEVELS = 0.5
"""Mean difference of two thumbnails, in coded values, above which a picture has changed. Averaging 900 pixels a
thumbnail pixel leaves less than 0.1 of the noise of a picture with sigma 3."""

_THUMBNAIL = (64, 36)


class OutputDoesNotFollow(AdapterError):
    """The output did not show a change that was set in the engine."""


def thumbnail(picture: Picture) -> NDArray[np.float32]:
    """The picture averaged to 64 x 36, float32."""
    small = cv2.resize(picture, _THUMBNAIL, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32)


def changed(before: NDArray[np.float32], after: NDArray[np.float32]) -> bool:
    """Whether two thumbnails show different pictures."""
    return float(np.mean(np.abs(before - after))) > CHANGED_LEVELS


@dataclass(slots=True)
class OutputDelay:
    """How long a change takes to reach the output: measured, and stretched whenever a picture came too early."""

    delay_s: float = 0.0
    picture_s: float = 0.0
    _last_change_s: float = field(default=-1e9)

    def change_made(self) -> None:
        """A change was acknowledged just now."""
        self._last_change_s = time.monotonic()

    async def settle(self) -> None:
        """Wait until the output shows the last change."""
        remaining = self._last_change_s + self.delay_s - time.monotonic()
        if remaining > 0:
            await asyncio.sleep(remaining)

    def came_too_early(self) -> None:
        """The output needed longer than measured; wait longer from now on."""
        self.delay_s = max(self.delay_s * 1.25, self.delay_s + self.picture_s)
