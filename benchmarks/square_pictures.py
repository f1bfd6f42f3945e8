"""Exact pictures of squares and lights for the benchmarks, with the Cramer-Rao bounds of their points.

Nothing is resampled and nothing is shared with the detectors. A pixel's ray is undistorted in closed form
(:class:`benchmarks.pictures.View`) and each side is a Gaussian edge in the signed distance in pixels; a pixel's box
counts as 1/12 px^2 of blur. A defocus disk of radius d is applied in the Fourier domain with its own transform
2 J1(2 pi f d) / (2 pi f d), on pixels that are soft enough (sigma 0.58 px) to be free of aliasing there. A light is
a disk and a Gaussian in the Fourier domain, moved by a phase, so its centre is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1, ndtr

from benchmarks.pictures import View, project

Array = NDArray[np.float64]
Coded = NDArray[np.uint8]
_PIXEL_VARIANCE = 1 / 12
_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def bt709(light: Array) -> Array:
    """Coded values 0..255, not rounded, of light 0..1 (ITU-R BT.709)."""
    light = np.clip(light, 0, 1)
    return np.asarray(255 * np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099))


def bt709_slope(light: Array) -> Array:
    """Coded values per light."""
    light = np.clip(light, 1e-6, 1)
    return np.asarray(255 * np.where(light < 0.018, 4.5, 1.099 * 0.45 * light**-0.55))


def coded(light: Array, noise: float, rng: np.random.Generator) -> Coded:
    """What a camera delivers: coded, with noise on the coded values, clipped and rounded."""
    values = bt709(light) + rng.normal(0, noise, light.shape)
    return np.asarray(np.clip(np.rint(values), 0, 255), dtype=np.uint8)


def _disk_transform(frequency: Array, radius_px: float) -> Array:
    phase = 2 * np.pi * np.maximum(frequency, 1e-12) * radius_px
    return np.asarray(2 * j1(phase) / phase)


def _defocused(share: Array, radius_px: float) -> Array:
    room = int(radius_px) + 2
    padded = np.pad(share, room)
    fv, fu = np.fft.fftfreq(padded.shape[0])[:, None], np.fft.rfftfreq(padded.shape[1])
    spread = np.fft.irfft2(np.fft.rfft2(padded) * _disk_transform(np.hypot(fv, fu), radius_px), padded.shape)
    return np.asarray(spread[room:-room, room:-room])


@dataclass(frozen=True)
class SquareScene:
    """``share`` (H, W) of each pixel that is the target's, ``corners`` (4, 2) px row by row (TL, TR, BL, BR)."""

    share: Array
    corners: Array
    clockwise: Array


def square_scene(view: View, *, sigma_px: float, disk_px: float = 0.0) -> SquareScene:
    """The square (0, 0) to (1, 1) of a view's plane through a Gaussian blur and, if given, a defocus disk."""
    width, height = view.size
    clockwise = project(view, _CORNERS)
    room = 8 * (sigma_px + 1) + 2 * disk_px + 8
    low = np.maximum(np.floor(clockwise.min(axis=0) - room), 0).astype(int)
    high = np.minimum(np.ceil(clockwise.max(axis=0) + room), [width - 1, height - 1]).astype(int)
    v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(np.float64)
    x, y = (u - (width - 1) / 2) / view.focal_px, (v - (height - 1) / 2) / view.focal_px
    grow = 1 + view.inverse_k * (x * x + y * y)
    rays = np.stack([x * grow, y * grow, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.homography).T
    sigma = np.hypot(sigma_px, np.sqrt(_PIXEL_VARIANCE))
    inside = np.ones_like(x)
    for axis in (0, 1):
        way = rays[..., axis] / rays[..., 2]
        slope_v, slope_u = np.gradient(way)
        scale = 1 / (np.hypot(slope_u, slope_v) * sigma)
        inside *= ndtr(way * scale) * ndtr((1 - way) * scale)
    if disk_px:
        inside = _defocused(inside, disk_px)
    share = np.zeros((height, width))
    share[low[1] : high[1] + 1, low[0] : high[0] + 1] = inside
    return SquareScene(share, clockwise[[0, 1, 3, 2]], clockwise)


def corner_bound(
    scene: SquareScene, sigma_px: float, disk_px: float, target: Array, around: Array, noise: float
) -> Array:
    """Cramer-Rao bound (4, 2, 2) px^2, row by row, where each side is bent by one unknown number.

    Blur and colours are taken as known, which lowers it.

    A pixel's length of edge tells its place with the information sum over channels and places of (dL/dx)^2 / var L.
    The end of a curve of order 2 over n such lengths has 9 / (n information) (its three Legendre terms 1 + 3 + 5).
    """
    x = np.arange(-8 * sigma_px - disk_px - 4, 8 * sigma_px + disk_px + 4, 0.05)
    edge = ndtr(x / np.hypot(sigma_px, np.sqrt(_PIXEL_VARIANCE)))
    if disk_px:
        t = (np.arange(401) + 0.5) / 401 * 2 - 1
        chord = np.sqrt(1 - t * t)
        sigma = np.hypot(sigma_px, np.sqrt(_PIXEL_VARIANCE))
        edge = (chord[:, None] * ndtr((x - disk_px * t[:, None]) / sigma)).sum(axis=0) / chord.sum()
    light = around + edge[:, None] * (target - around)
    slope = np.gradient(light, 0.05, axis=0) * bt709_slope(light)
    information = float(np.sum(slope**2) * 0.05) / (noise**2 + 1 / 12)
    corners = scene.clockwise
    along = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(along[:, 0], along[:, 1])
    variance = 9 / (length * information)
    normals = np.column_stack([along[:, 1], -along[:, 0]]) / length[:, None]
    bounds = []
    for index in range(4):
        rows = normals[[index, index - 1]]
        inverse = np.linalg.inv(rows)
        bounds.append(inverse @ np.diag(variance[[index, index - 1]]) @ inverse.T)
    return np.array(bounds)[[0, 1, 3, 2]]


@dataclass(frozen=True)
class Spot:
    """A light: a disk of ``radius_px`` with ``power`` (light, 1 saturates) behind a Gaussian blur, a glow about it.

    The glow is a wide Gaussian; the room behind has a level and a gradient per pixel.
    """

    radius_px: float
    power: float
    sigma_px: float
    glow: float = 0.0
    glow_px: float = 20.0
    level: float = 0.03
    gradient: tuple[float, float] = (0.0, 0.0)


def spot_light(spot: Spot, centre: Array, size: int) -> Array:
    """Light (size, size) of a spot at ``centre`` (2,) px; not clipped."""
    fv, fu = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)
    f = np.hypot(fv, fu)
    sigma2 = spot.sigma_px**2 + _PIXEL_VARIANCE
    area = np.pi * spot.radius_px**2
    body = spot.power * area * _disk_transform(f, spot.radius_px) * np.exp(-2 * np.pi**2 * sigma2 * f * f)
    glow = spot.glow * 2 * np.pi * spot.glow_px**2 * np.exp(-2 * np.pi**2 * spot.glow_px**2 * f * f)
    phase = np.exp(-2j * np.pi * (fu * centre[0] + fv * centre[1]))
    place = np.arange(size) - (size - 1) / 2
    room = spot.level + spot.gradient[0] * place + spot.gradient[1] * place[:, None]
    return np.asarray(np.fft.irfft2((body + glow) * phase, (size, size)) + room)


def spot_bound(spot: Spot, centre: Array, size: int, noise: float) -> Array:
    """Cramer-Rao bound (2, 2) px^2 of the centre from three equal channels, all else but the shape unknown too.

    Unknown beside the centre: power, level and gradient. Saturated pixels are censored: with z = (255 - m) / s the
    information on a mean m is (Phi(z) - z phi(z) + phi(z)^2 / (1 - Phi(z))) / s^2 (the Tobit model).
    """
    sigma = float(np.sqrt(noise**2 + 1 / 12))
    step = 1e-3

    def change(make: Callable[[float], Array]) -> Array:
        return np.asarray((make(step) - make(-step)) / (2 * step)).ravel()

    light = spot_light(spot, centre, size).ravel()
    unit = spot_light(Spot(spot.radius_px, 1.0, spot.sigma_px, level=0.0), centre, size).ravel()
    place = np.arange(size) - (size - 1) / 2
    columns = [
        change(lambda s: spot_light(spot, centre + [s, 0], size)),
        change(lambda s: spot_light(spot, centre + [0, s], size)),
        unit,
        np.ones(size * size),
        np.tile(place, size),
        np.repeat(place, size),
    ]
    unclipped = 255 * np.where(light < 0.018, 4.5 * light, 1.099 * np.maximum(light, 1e-9) ** 0.45 - 0.099)
    slope = 255 * np.where(light < 0.018, 4.5, 1.099 * 0.45 * np.maximum(light, 1e-9) ** -0.55)
    z = np.clip((255 - unclipped) / sigma, -8, 8)
    density = np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
    seen = ndtr(z) - z * density + density**2 / np.maximum(ndtr(-z), 1e-300)
    seen = np.where(z <= -8, 0.0, seen)
    jacobian = np.column_stack(columns) * slope[:, None]
    information = 3 * jacobian.T @ (jacobian * seen[:, None]) / sigma**2
    return np.asarray(np.linalg.inv(information)[:2, :2])
