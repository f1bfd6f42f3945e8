"""The simulated camera's own optics: world to pixel, and each pixel's exact ray.

Written from ``docs/explanations/conventions.md`` alone and independent of ``calibration``, so that an error in the
fitting code cannot hide behind the same error here.

- Camera axes: the rows of ``axes`` are right, down and forward in world coordinates, for pan (right), tilt (up) and
  roll (clockwise seen from behind), intrinsic about Z, X, Y.
- Entrance pupil = pivot + nodal offset along forward.
- Pinhole x = X/Z, y = Y/Z; radial Brown-Conrady, undistorted to distorted: s(q) = 1 + k1 q + k2 q^2, q = x^2 + y^2;
  u = f x s + (W-1)/2 + sx, v = a f y s + (H-1)/2 + sy.
- An engine's polynomial may go the other way, x = x_d s(q_d): then s is read as that of the distorted radius.
- Inverse: the radial ratio r/r_d is a smooth function of r_d^2. It is tabulated once for each lens (each node by
  Newton to 1e-13) and read by linear interpolation, exact to 1e-6 px.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_TABLE_NODES = 8193
_TABLE_STRIDE = 64
_NEWTON_STEPS = 60
_BEYOND_PICTURE = 1.02


@dataclass(frozen=True)
class Optics:
    """A lens on its sensor: focal length in px, k1 and k2 in focal-length units, centre shift in px. ``reverse``: the
    polynomial takes distorted radii to undistorted ones."""

    image_size: tuple[int, int]
    f_px: float
    k1: float = 0.0
    k2: float = 0.0
    center_shift_px: tuple[float, float] = (0.0, 0.0)
    pixel_aspect: float = 1.0
    reverse: bool = False

    @classmethod
    def from_fov(
        cls,
        image_size: tuple[int, int],
        fov_x_deg: float,
        k1: float = 0.0,
        k2: float = 0.0,
        center_shift_px: tuple[float, float] = (0.0, 0.0),
        pixel_aspect: float = 1.0,
    ) -> Optics:
        """The lens with a horizontal field of view: f = W / (2 tan(fov_x / 2))."""
        f_px = image_size[0] / (2.0 * math.tan(math.radians(fov_x_deg) / 2.0))
        return cls(image_size, f_px, k1, k2, center_shift_px, pixel_aspect)

    @cached_property
    def center_px(self) -> tuple[float, float]:
        """The principal point (u, v)."""
        width, height = self.image_size
        return (width - 1) / 2.0 + self.center_shift_px[0], (height - 1) / 2.0 + self.center_shift_px[1]

    @cached_property
    def fold_radius(self) -> float:
        """Radius at which the polynomial folds, 1 + 3 k1 q + 5 k2 q^2 = 0; infinity where it never does. It is that
        which the polynomial takes: undistorted, or distorted where it is reverse."""
        discriminant = 9.0 * self.k1**2 - 20.0 * self.k2
        if discriminant < 0.0:
            return math.inf
        # The first positive root in the form that loses no digits when k2 is near 0.
        denominator = -3.0 * self.k1 + math.sqrt(discriminant)
        return math.sqrt(2.0 / denominator) if denominator > 0.0 else math.inf

    @cached_property
    def corner_radius(self) -> float:
        """Distorted radius of the picture's farthest corner (outer pixel edge), focal-length units."""
        width, height = self.image_size
        far_u = width / 2.0 + abs(self.center_shift_px[0])
        far_v = height / 2.0 + abs(self.center_shift_px[1])
        return math.hypot(far_u / self.f_px, far_v / (self.f_px * self.pixel_aspect))

    @cached_property
    def fold_distorted(self) -> float:
        """Distorted radius of the fold: beyond it the picture is empty; infinity where there is none."""
        fold = self.fold_radius
        if self.reverse or math.isinf(fold):
            return fold
        q = fold * fold
        return fold * (1.0 + self.k1 * q + self.k2 * q * q)

    @cached_property
    def folds_inside_picture(self) -> bool:
        """Whether two rays land on one pixel of the picture."""
        return self.fold_distorted <= self.corner_radius

    def bent(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """r_d / r and its derivative by q = r^2, at undistorted q (any shape).

        Reverse, with p(q_d) = 1 + k1 q_d + k2 q_d^2: r_d / r = 1 / p, and its derivative is
        -(k1 + 2 k2 q_d) / (p^3 (1 + 3 k1 q_d + 5 k2 q_d^2)).
        """
        k1, k2 = self.k1, self.k2
        if not self.reverse:
            return 1.0 + q * (k1 + k2 * q), k1 + 2.0 * k2 * q
        q_d = _distorted_radius(self, np.sqrt(q)) ** 2
        p = 1.0 + q_d * (k1 + k2 * q_d)
        return 1.0 / p, -(k1 + 2.0 * k2 * q_d) / (p**3 * (1.0 + q_d * (3.0 * k1 + 5.0 * k2 * q_d)))


def undistorted_radius(optics: Optics, distorted: FloatArray) -> FloatArray:
    """Undistorted radius for each distorted radius (any shape), by Newton kept inside its bracket, to 1e-13.

    NaN where no ray below the fold reaches the distorted radius.
    """
    k1, k2 = optics.k1, optics.k2
    fold = optics.fold_radius
    low = np.zeros_like(distorted)
    if math.isfinite(fold):
        high = np.full_like(distorted, fold)
    else:
        # Without a fold the curve rises for ever: double the bracket until it holds every radius asked for.
        reach = 1.0 + float(np.max(distorted, initial=0.0))
        while reach * (1.0 + k1 * reach**2 + k2 * reach**4) < float(np.max(distorted, initial=0.0)):
            reach *= 2.0
        high = np.full_like(distorted, reach)
    outside = high * (1.0 + k1 * high**2 + k2 * high**4) < distorted
    radius = np.minimum(distorted, high)
    for _ in range(_NEWTON_STEPS):
        q = radius * radius
        error = radius * (1.0 + k1 * q + k2 * q * q) - distorted
        low = np.where(error < 0.0, radius, low)
        high = np.where(error >= 0.0, radius, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = radius - error / (1.0 + 3.0 * k1 * q + 5.0 * k2 * q * q)
        inside = (step >= low) & (step <= high)
        following = np.where(inside, step, (low + high) / 2.0)
        done = bool(np.all(np.abs(following - radius) <= 1e-14 + 1e-14 * radius))
        radius = following
        if done:
            break
    return np.where(outside, np.nan, radius)


def _distorted_radius(optics: Optics, undistorted: FloatArray) -> FloatArray:
    """Distorted radius for each undistorted one where the polynomial is reverse: a few plain Newton steps, the
    bracketed ones where they do not end. The same equation as :func:`undistorted_radius`, the radii exchanged."""
    k1, k2 = optics.k1, optics.k2
    radius = undistorted.copy()
    for _ in range(8):
        q = radius * radius
        radius -= (radius * (1.0 + q * (k1 + k2 * q)) - undistorted) / (1.0 + q * (3.0 * k1 + 5.0 * k2 * q))
    q = radius * radius
    error = np.abs(radius * (1.0 + q * (k1 + k2 * q)) - undistorted)
    inside = (radius >= 0.0) & (radius < optics.fold_radius)
    if bool(np.all(inside & (error <= 1e-13 * (1.0 + undistorted)))):
        return radius
    solved = undistorted_radius(optics, undistorted)
    return np.where(np.isnan(solved), min(optics.fold_radius, 1e6), solved)


def _radial_ratio(optics: Optics, squared: FloatArray) -> FloatArray:
    """r / r_d at equally spaced r_d^2 from 0: some by the bracketed Newton, those between by one plain step more.

    Where that is not exact (near a fold) all are found by the bracketed one.
    """
    if optics.reverse:
        return 1.0 + squared * (optics.k1 + optics.k2 * squared)
    ratio = np.ones_like(squared)
    distorted = np.sqrt(squared[1:])
    chosen = squared[::_TABLE_STRIDE]
    coarse = np.ones_like(chosen)
    coarse[1:] = undistorted_radius(optics, np.sqrt(chosen[1:])) / np.sqrt(chosen[1:])
    if not np.isfinite(coarse).all():
        ratio[1:] = undistorted_radius(optics, distorted) / distorted
        return ratio
    k1, k2 = optics.k1, optics.k2
    radius = np.interp(squared[1:], chosen, coarse) * distorted
    for _ in range(2):
        q = radius * radius
        error = radius * (1.0 + q * (k1 + k2 * q)) - distorted
        radius -= error / (1.0 + q * (3.0 * k1 + 5.0 * k2 * q))
    q = radius * radius
    error = radius * (1.0 + q * (k1 + k2 * q)) - distorted
    if not float(np.abs(error).max()) <= 1e-13 * (1.0 + float(distorted[-1])):
        radius = undistorted_radius(optics, distorted)
    ratio[1:] = radius / distorted
    return ratio


class RayTable:
    """Each pixel's exact ray: r / r_d over r_d^2, from the axis to a little beyond the picture's corner."""

    def __init__(self, optics: Optics) -> None:
        self._optics = optics
        self._cu, self._cv = optics.center_px
        reach = (optics.corner_radius * _BEYOND_PICTURE) ** 2
        ratio = _radial_ratio(optics, np.linspace(0.0, reach, _TABLE_NODES))
        self._ratio = ratio
        self._step = np.append(np.diff(ratio), 0.0)
        self._per_unit = (_TABLE_NODES - 1) / reach

    def rays(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(x, y) of the rays through pixel positions, same shape; NaN where the lens has folded before."""
        optics = self._optics
        x = (u - self._cu) * (1.0 / optics.f_px)
        y = (v - self._cv) * (1.0 / (optics.f_px * optics.pixel_aspect))
        position = (x * x + y * y) * self._per_unit
        node = position.astype(np.intp)
        np.minimum(node, _TABLE_NODES - 2, out=node)
        ratio = self._ratio[node] + (position - node) * self._step[node]
        return x * ratio, y * ratio


@lru_cache(maxsize=4)
def ray_table(optics: Optics) -> RayTable:
    """The table of a lens: it is the same in every pose."""
    return RayTable(optics)


@dataclass(frozen=True)
class View:
    """A camera in the world: its optics, its pivot (metres), its turn (degrees), its nodal offset (mm)."""

    optics: Optics
    pivot_m: tuple[float, float, float]
    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    nodal_offset_mm: float = 0.0

    @cached_property
    def axes(self) -> FloatArray:
        """World directions of the camera's right, down, forward as rows, (3, 3)."""
        pan, tilt, roll = (math.radians(angle) for angle in (self.pan_deg, self.tilt_deg, self.roll_deg))
        # Level camera turned by pan: right and forward lie in the floor's plane.
        right = np.array([math.cos(pan), -math.sin(pan), 0.0])
        ahead = np.array([math.sin(pan), math.cos(pan), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        forward = math.cos(tilt) * ahead + math.sin(tilt) * up
        raised = math.cos(tilt) * up - math.sin(tilt) * ahead
        # Clockwise seen from behind: up leans towards right, right towards down.
        right_rolled = math.cos(roll) * right - math.sin(roll) * raised
        up_rolled = math.cos(roll) * raised + math.sin(roll) * right
        return np.stack([right_rolled, -up_rolled, forward])

    @cached_property
    def pupil_m(self) -> FloatArray:
        """Where the pinhole stands, (3,)."""
        pupil = np.asarray(self.pivot_m, dtype=np.float64) + self.axes[2] * (self.nodal_offset_mm / 1000.0)
        return np.asarray(pupil, dtype=np.float64)

    def to_camera(self, points_m: FloatArray) -> FloatArray:
        """World points (N, 3) in camera axes (N, 3): right, down, forward, metres from the pupil."""
        return np.asarray((points_m - self.pupil_m) @ self.axes.T, dtype=np.float64)

    def to_pixels(self, camera_points: FloatArray) -> FloatArray:
        """Points in camera axes (N, 3), Z > 0, to (u, v) (N, 2).

        Beyond the picture, where the polynomial may fold, the radial curve goes on as its tangent: such points only
        carry outlines that leave the picture.
        """
        optics = self.optics
        x = camera_points[:, 0] / camera_points[:, 2]
        y = camera_points[:, 1] / camera_points[:, 2]
        radius = np.hypot(x, y)
        limit = self.picture_radius
        inner = np.minimum(radius, limit)
        q = inner * inner
        ratio, bend = optics.bent(q)
        distorted = inner * ratio
        slope = ratio + 2.0 * q * bend
        distorted = distorted + np.maximum(slope, 0.05) * (radius - inner)
        scale = np.divide(distorted, radius, out=np.ones_like(radius), where=radius > 0.0)
        cu, cv = optics.center_px
        return np.column_stack([optics.f_px * x * scale + cu, optics.f_px * optics.pixel_aspect * y * scale + cv])

    def project(self, points_m: FloatArray) -> FloatArray:
        """World points (N, 3) in front of the camera to (u, v) (N, 2); NaN for points behind it."""
        camera_points = self.to_camera(points_m)
        ahead = camera_points[:, 2] > 0.0
        pixels = np.full((len(points_m), 2), np.nan)
        pixels[ahead] = self.to_pixels(camera_points[ahead])
        return pixels

    @cached_property
    def picture_radius(self) -> float:
        """Undistorted radius that holds the whole picture (or all of it that a ray reaches), focal-length units."""
        optics = self.optics
        if optics.reverse:
            edge = min(optics.corner_radius * _BEYOND_PICTURE, optics.fold_radius)
            return edge * (1.0 + optics.k1 * edge**2 + optics.k2 * edge**4)
        reach = undistorted_radius(optics, np.array([optics.corner_radius * _BEYOND_PICTURE]))[0]
        return float(optics.fold_radius if math.isnan(reach) else reach)
