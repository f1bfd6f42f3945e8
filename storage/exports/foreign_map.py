"""The lens in an ST map of another program: centre shift, k1 and k2 at half width, fitted over the map.

A map tells where pixels move, not how wide the lens sees: the focal length cannot be found in it. With
``q = c + (p - c) (1 + k1_hw r^2 + k2_hw r^4)``, r = |p - c| over half the picture's width, the undistorting map holds q
at the pixel p and the distorting one p at the pixel q. Programs also differ in the direction of t, and in whether 0..1
reaches from edge to edge or from the first pixel's centre to the last one's. The first shows in the values themselves;
of the others the four combinations are fitted and the best is taken, if it fits and no other way round does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from calibration.types import FloatArray
from storage.errors import BadDocument
from storage.exports.map_picture import MapPicture

FITS_PX = 0.05
"""Largest RMS (per coordinate) of a map that is said to be of this lens model; rounding leaves 2e-5 at 1080p."""
_CLEARER = 5.0
_ROUNDING = 2e-8
"""RMS that 32-bit floats leave, in widths of the picture (1e-8 measured)."""
_GRID = (48, 27)
_LEAST_POINTS = 50


@dataclass(frozen=True, slots=True)
class MapFit:
    """What a map tells. ``rms_px`` per coordinate over the map."""

    center_shift_px: tuple[float, float]
    k1_hw: float
    k2_hw: float
    rms_px: float
    way: str

    def __str__(self) -> str:
        return (
            f"centre shift {self.center_shift_px[0]:.3f}, {self.center_shift_px[1]:.3f} px, "
            f"k1_hw {self.k1_hw:.6f}, k2_hw {self.k2_hw:.6f} ({self.way} map, fitted to {self.rms_px:.2g} px RMS)"
        )


def fit_map(picture: MapPicture, place: str) -> MapFit:
    """The lens of a map without overscan, square pixels. Raises :class:`BadDocument` where it is not one of k1 and k2,
    or where it does not show which way it goes."""
    width, height = picture.size
    columns = np.unique(np.linspace(0, width - 1, _GRID[0]).round().astype(int))
    rows = np.unique(np.linspace(0, height - 1, _GRID[1]).round().astype(int))
    s, t = (channel[np.ix_(rows, columns)].astype(np.float64) for channel in (picture.s, picture.t))
    u, v = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(s) & np.isfinite(t) & (np.abs(s - 0.5) < 1.5) & (np.abs(t - 0.5) < 1.5)
    usable &= (s != -1) | (t != -1)
    if np.count_nonzero(usable) < _LEAST_POINTS:
        raise BadDocument(place, "has too few pixels that point into a picture", "is this an ST map?")
    grid, s, t = np.stack([u, v], axis=-1)[usable], s[usable], t[usable]
    upwards = np.sum((t - t.mean()) * (grid[:, 1] - grid[:, 1].mean())) < 0
    down = 1 - t if upwards else t
    edges = np.stack([s * width - 0.5, down * height - 0.5], axis=-1)
    centres = np.stack([s * (width - 1), down * (height - 1)], axis=-1)
    fits = [
        best
        for way in ("undistorting", "distorting")
        for best in [min((_fit(way, grid, values, picture.size) for values in (edges, centres)), key=_rms)]
    ]
    fits.sort(key=_rms)
    if not fits[0].rms_px <= FITS_PX:
        raise BadDocument(
            place,
            f"is not a lens of k1 and k2: {fits[0].rms_px:.3g} px RMS are left",
            "use a map without overscan, margins or other terms",
        )
    if fits[1].rms_px < _CLEARER * max(fits[0].rms_px, _ROUNDING * width):
        raise BadDocument(
            place, "moves its pixels too little to show which way it goes", "take the coefficients from their source"
        )
    return fits[0]


def _rms(fit: MapFit) -> float:
    return fit.rms_px


def _fit(way: str, grid: FloatArray, values: FloatArray, size: tuple[int, int]) -> MapFit:
    half = size[0] / 2
    middle = np.array([(size[0] - 1) / 2, (size[1] - 1) / 2])
    flat, bent = ((points - middle) / half for points in ((grid, values) if way == "undistorting" else (values, grid)))

    def misfit(parameters: FloatArray) -> FloatArray:
        centre, (k1, k2) = parameters[:2], parameters[2:]
        arm = flat - centre
        r2 = np.sum(arm * arm, axis=-1, keepdims=True)
        return np.asarray(centre + arm * (1 + r2 * (k1 + k2 * r2)) - bent).reshape(-1)

    found = least_squares(misfit, np.zeros(4), method="lm", xtol=1e-14, ftol=1e-14)
    x, y, k1, k2 = (float(value) for value in found.x)
    return MapFit((x * half, y * half), k1, k2, float(np.sqrt(np.mean(found.fun**2))) * half, way)
