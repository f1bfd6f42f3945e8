"""The light spot: a small, round, bright light, told from windows, desks and lamps by size, shape and surroundings.

Found on the coded picture cut at falling levels; its centre is then fitted to the pixels (``spot``). A round spot
stays round through blur, glow and saturation, because all three treat all directions alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.detect.prediction import Prediction
from calibration.detect.spot import fit_centre
from calibration.errors import InvalidInput
from calibration.image import Transfer, light_table
from calibration.types import (
    Detection,
    DetectionResult,
    Picture,
    Quality,
    Refusal,
    Target,
    TargetKind,
)

_LEVELS = (250, 225, 195, 160, 125, 90, 60)
"""Coded values at which the picture is cut; a light may be dim where the exposure is set for it."""
_MOST_SHARE = 0.08
"""Largest diameter of a light, as a share of the picture's width."""
_LEAST_PIXELS = 3
_LEAST_ROUNDNESS = 0.55
# Radial scatter of an outline: 0 for a disk, 0.11 for a square; pixels alone make 0.3 / radius.
_MOST_SCATTER = 0.085
_LEAST_CONTRAST = 2.5
# A light is among the brightest things that the camera sees.
_LEAST_OF_BRIGHTEST = 0.4
_CLEARLY_BETTER = 1.35
SYSTEMATIC_PX, SYSTEMATIC_OF_RADIUS = 0.004, 0.002
"""Standard deviation of what is left of the symmetry of a real spot, per coordinate, beside what its residuals show."""


@dataclass(frozen=True, slots=True, eq=False)
class _Spot:
    centre: tuple[float, float]
    radius: float
    brightness: float
    contrast: float
    roundness: float

    @property
    def score(self) -> float:
        return self.brightness * self.roundness**2 * math.sqrt(min(self.contrast, 8.0))


def find_light(
    picture: Picture,
    target: Target,
    *,
    transfer: Transfer = Transfer.BT709,
    near: Prediction | None = None,
) -> DetectionResult:
    """Find a small bright spot (``TargetKind.LIGHT``) and its centre.

    ``picture`` (H, W, 3) uint8 BGR; ``transfer``: how its light is coded; ``near``: expected centre (1, 2) in px with
    its sigma: only that part is searched. The detection's blur is NaN: a light's own size is not known in pixels.

    A refusal gives the reason: no light, several equally good ones. Raises :class:`InvalidInput` for a target of
    another kind or a picture of the wrong shape.
    """
    if target.kind is not TargetKind.LIGHT:
        raise InvalidInput("target kind", str(target.kind), "this search is for a light")
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise InvalidInput("picture", picture.shape, "must be (H, W, 3) uint8")
    height, width = picture.shape[:2]
    left, top, right, bottom = 0, 0, width, height
    if near is not None:
        room = 4 * near.sigma_px + 0.5 * _MOST_SHARE * width + 10
        u, v = near.points_px.mean(axis=0)
        left, top = max(0, math.floor(u - room)), max(0, math.floor(v - room))
        right, bottom = min(width, math.ceil(u + room) + 1), min(height, math.ceil(v + room) + 1)
        if right - left < 5 or bottom - top < 5:
            return Refusal("the expected place of the light lies outside the picture")
    part = picture[top:bottom, left:right]
    spots = _spots(part, transfer, _MOST_SHARE * width)
    if near is not None:
        u, v = near.points_px.mean(axis=0) - (left, top)
        spots = [spot for spot in spots if math.dist(spot.centre, (u, v)) < 4 * near.sigma_px + spot.radius + 1]
    if not spots:
        where = " where it is expected" if near is not None else ""
        return Refusal(f"no light was found{where}: nothing small, round and much brighter than its surroundings")
    if len(spots) > 1 and spots[0].score < _CLEARLY_BETTER * spots[1].score:
        (a, b), (c, d) = spots[0].centre, spots[1].centre
        return Refusal(
            f"several lights are equally likely, near ({a + left:.0f}, {b + top:.0f}) and "
            f"({c + left:.0f}, {d + top:.0f}): switch off or cover the others"
        )
    return _measured(part, spots[0], transfer, (left, top))


def _spots(picture: Picture, transfer: Transfer, most_px: float) -> list[_Spot]:
    """Candidates, best first, each place once."""
    dimmest = np.minimum(np.minimum(picture[:, :, 0], picture[:, :, 1]), picture[:, :, 2])
    table = light_table(transfer)
    brightest = float(table[int(dimmest.max())])
    spots: list[_Spot] = []
    for level in _LEVELS:
        if table[level] < _LEAST_OF_BRIGHTEST * 0.5 * brightest:
            break
        binary = (dimmest >= level).view(np.uint8)
        contours, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            x, y, wide, tall = cv2.boundingRect(contour)
            if max(wide, tall) > most_px or min(wide, tall) < 2 or wide * tall < _LEAST_PIXELS:
                continue
            spot = _judge(dimmest, binary, (x, y, wide, tall), picture, table)
            if spot is not None and spot.brightness >= _LEAST_OF_BRIGHTEST * brightest:
                _keep_best(spots, spot)
    return sorted(spots, key=lambda spot: -spot.score)


def _keep_best(spots: list[_Spot], spot: _Spot) -> None:
    for index, other in enumerate(spots):
        if math.dist(spot.centre, other.centre) < max(spot.radius, other.radius) + 1:
            if spot.score > other.score:
                spots[index] = spot
            return
    spots.append(spot)


def _judge(
    dimmest: NDArray[np.uint8],
    binary: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    picture: Picture,
    table: NDArray[np.float32],
) -> _Spot | None:
    """Whether a region is small, round and alone in its brightness."""
    x, y, wide, tall = box
    height, width = dimmest.shape
    if x <= 0 or y <= 0 or x + wide >= width or y + tall >= height:
        return None
    if not 0.5 <= wide / tall <= 2.0:
        return None
    v, u = np.nonzero(binary[y : y + tall, x : x + wide])
    if len(u) < _LEAST_PIXELS:
        return None
    centre_u, centre_v = float(u.mean()), float(v.mean())
    spread = np.cov(np.stack([u, v])) if len(u) > 2 else np.zeros((2, 2))
    small, large = np.linalg.eigvalsh(spread + np.eye(2) / 12)
    roundness = math.sqrt(max(float(small), 0.0) / float(large))
    radius = math.sqrt(len(u) / math.pi)
    # Share of the ellipse with the same moments that is filled: 1 for a disk, less for a ragged or hollow thing.
    fill = len(u) / (4 * math.pi * math.sqrt(max(float(small * large), 1e-9)))
    if roundness < _LEAST_ROUNDNESS or fill < 0.75:
        return None
    if radius > 6 and _scatter(binary[y : y + tall, x : x + wide], centre_u, centre_v, radius) > _MOST_SCATTER:
        return None
    centre = (x + centre_u, y + centre_v)
    around = _surroundings(picture, centre, radius, table)
    brightness = float(table[dimmest[y : y + tall, x : x + wide][v, u]].mean())
    contrast = brightness / (around + 0.01)
    if contrast < _LEAST_CONTRAST:
        return None
    return _Spot(centre, radius, brightness, contrast, min(1.0, roundness))


def _scatter(binary: NDArray[np.uint8], u: float, v: float, radius: float) -> float:
    """Scatter of the outline's distance from the centre over its mean, without what pixels make."""
    contours, _ = cv2.findContours(binary.copy(), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(contours, key=len).reshape(-1, 2)
    distance = np.hypot(outline[:, 0] - u, outline[:, 1] - v)
    return math.sqrt(max(float(np.var(distance)) - 0.1, 0.0)) / radius


def _surroundings(picture: Picture, centre: tuple[float, float], radius: float, table: NDArray[np.float32]) -> float:
    """Light (0..1, mean of the channels) around a spot, exceeded by a sixth of the ring from 2 to 3 radii."""
    height, width = picture.shape[:2]
    outer = 3 * radius + 4
    left, top = max(0, math.floor(centre[0] - outer)), max(0, math.floor(centre[1] - outer))
    right, bottom = min(width, math.ceil(centre[0] + outer) + 1), min(height, math.ceil(centre[1] + outer) + 1)
    v, u = np.mgrid[top:bottom, left:right]
    distance = np.hypot(u - centre[0], v - centre[1])
    ring = (distance > 2 * radius + 2) & (distance <= outer)
    light = table[picture[top:bottom, left:right][ring]].mean(axis=1)
    return float(np.quantile(light, 5 / 6)) if len(light) else 1.0


def _measured(part: Picture, spot: _Spot, transfer: Transfer, origin: tuple[int, int]) -> DetectionResult:
    """Centre and covariance of a spot in a part of the picture that begins at ``origin``."""
    height, width = part.shape[:2]
    reach = 2.2 * spot.radius + 3
    left, top = math.floor(spot.centre[0] - reach - 1), math.floor(spot.centre[1] - reach - 1)
    right, bottom = math.ceil(spot.centre[0] + reach + 2), math.ceil(spot.centre[1] + reach + 2)
    left, top, right, bottom = max(0, left), max(0, top), min(width, right), min(height, bottom)
    u, v = spot.centre
    edge = 1.2 * spot.radius + 1
    if min(u - left, v - top, right - 1 - u, bottom - 1 - v) < edge:
        return Refusal("the light is cut by the picture's frame")
    fit = fit_centre(
        part[top:bottom, left:right], (u - left, v - top), radius_px=spot.radius, reach_px=reach, transfer=transfer
    )
    if fit is None:
        return Refusal("the light has no centre that could be measured: it is not round, or runs into other light")
    centre = fit.place + (left, top)
    floor = SYSTEMATIC_PX + SYSTEMATIC_OF_RADIUS * spot.radius
    covariance = fit.covariance + np.eye(2) * floor**2
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if not math.isfinite(worst) or worst > 1.0:
        return Refusal(f"the light's centre is uncertain by {worst:.1f} px: too faint or too ragged")
    place = centre + np.array(origin)
    return Detection(
        kind=TargetKind.LIGHT,
        points_px=place.reshape(1, 2),
        point_ids=np.zeros(1, dtype=np.int64),
        covariance_px2=covariance.reshape(1, 2, 2),
        centre_px=place,
        blur_px=math.nan,
        quality=Quality(
            score=float(np.clip(spot.roundness * min(1.0, spot.contrast / 8) * min(1.0, 0.1 / worst) ** 0.25, 0, 1)),
            contrast=spot.contrast,
        ),
    )
