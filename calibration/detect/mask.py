"""Where a picture has a colour: one number per pixel for a colour's name, and the levels at which to cut it.

Colour is taken as a difference of light, not as a hue: a red thing under a dim lamp keeps the ratio of its
channels, and the difference of a dull red and a pink is a matter of level, so cutting at many levels parts two
reddish things that touch (cf. the study's mask, which cut HSV at one level).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.image import Transfer, light_table
from calibration.types import Picture

Channel = NDArray[np.float32]

# Channels (BGR) in which a coloured thing is bright; it is dark in the others.
_BRIGHT_CHANNELS: dict[str, tuple[int, ...]] = {
    "red": (2,),
    "green": (1,),
    "blue": (0,),
    "yellow": (1, 2),
    "cyan": (0, 1),
    "magenta": (0, 2),
    "white": (0, 1, 2),
}

KNOWN_COLOURS: tuple[str, ...] = (*_BRIGHT_CHANNELS, "black")

# Shares of the picture's strongest: a level every 30 %, so that two things that differ by more are parted by one.
_STRENGTH_SHARES = tuple(float(share) for share in np.geomspace(0.04, 0.8, 12))
_PURITY_LEVELS = (0.4, 0.55, 0.7, 0.82, 0.9)
_BLACK_LEVELS = tuple(float(level) for level in np.geomspace(0.3, 0.97, 12))
# Below this much light the ratio of the channels is noise.
_LEAST_STRENGTH = 0.012


@dataclass(frozen=True, slots=True, eq=False)
class ColourField:
    """How much of a colour each pixel has, (H, W) float32.

    ``strength``: light of the colour's own channels above that of the others (0..1; for white the light of the
    darkest channel, for black 1 minus the root of the brightest). ``purity``: strength over the brightest channel
    (0..1), which does not depend on the lamp. ``levels``: pairs (field, level) to cut at.
    """

    strength: Channel
    purity: Channel
    levels: tuple[tuple[Channel, float], ...]


def colour_field(picture: Picture, colour: str, transfer: Transfer) -> ColourField:
    """The field of a colour named in ``KNOWN_COLOURS`` over a picture (H, W, 3), BGR. Raises KeyError."""
    table = light_table(transfer)

    def light(coded: NDArray[np.uint8]) -> Channel:
        return np.asarray(cv2.LUT(coded, table), dtype=np.float32)

    # The curve rises, so that the largest and smallest channel may be taken on coded values.
    planes = [np.ascontiguousarray(picture[:, :, channel]) for channel in range(3)]
    top = light(np.maximum(np.maximum(planes[0], planes[1]), planes[2]))
    if colour == "black":
        strength = np.asarray(1.0 - np.sqrt(top), dtype=np.float32)
        return ColourField(strength, strength, tuple((strength, level) for level in _BLACK_LEVELS))
    bright = _BRIGHT_CHANNELS[colour]
    own = planes[bright[0]]
    for channel in bright[1:]:
        own = np.minimum(own, planes[channel])
    dark = [planes[channel] for channel in range(3) if channel not in bright]
    strength = light(own)
    if dark:
        other = dark[0] if len(dark) == 1 else np.maximum(dark[0], dark[1])
        strength = np.maximum(strength - light(other), np.float32(0.0))
    purity = np.asarray(strength / np.maximum(top, np.float32(1e-4)), dtype=np.float32)
    # Where there is hardly any light the ratio of the channels is noise, and so would be the outlines.
    lit = purity * (strength > _LEAST_STRENGTH)
    strongest = float(strength.max(initial=0.0))
    levels = tuple(
        (strength, share * strongest) for share in _STRENGTH_SHARES if share * strongest > _LEAST_STRENGTH / 2
    )
    levels += tuple((lit, level) for level in _PURITY_LEVELS)
    return ColourField(strength, purity, levels)
