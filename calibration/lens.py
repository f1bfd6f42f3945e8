"""The lens model: a pinhole, radial Brown-Conrady distortion, a shifted centre.

Conventions (``docs/explanations/conventions.md``): rays are (x, y) = (X/Z, Y/Z) in camera axes (x right, y down);

    x_d = x (1 + k1 r^2 + k2 r^4),  r^2 = x^2 + y^2          (undistorted to distorted; Brown 1971)
    u = f_px x_d + (W - 1)/2 + sx,  v = a f_px y_d + (H - 1)/2 + sy

with pixel centres at whole numbers. ``k1``, ``k2`` are in focal-length units; ``k1_hw = k1 h^2``,
``k2_hw = k2 h^4`` with ``h = tan(fov_x / 2)`` are the same with radius 1 at half the picture's width: whatever
interpolates, bounds or compares uses those.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import FoldedLens, InvalidInput, NotConverged
from calibration.types import FloatArray

LENS_PARAMETERS = ("f_px", "k1", "k2", "center_shift_x_px", "center_shift_y_px")
"""Order of the columns of :meth:`Lens.jacobian_parameters`."""

_NEWTON_TOLERANCE = 1e-14
_NEWTON_STEPS = 100
# Bisection halves the bracket whenever Newton leaves it, so 100 steps reach double precision from any start.


def fov_to_f_px(fov_deg: float, size_px: int) -> float:
    """Focal length in px from the field of view over ``size_px`` pixels: f = size / (2 tan(fov / 2)).

    ``fov_deg`` must lie in (0, 180) exclusive. For the vertical field of view this is ``pixel_aspect * f_px``.
    """
    if not math.isfinite(fov_deg) or not 0 < fov_deg < 180:
        raise InvalidInput("field of view (deg)", fov_deg, "must lie between 0 and 180")
    return size_px / (2 * math.tan(math.radians(fov_deg) / 2))


def f_px_to_fov(f_px: float, size_px: int) -> float:
    """Field of view in degrees over ``size_px`` pixels: fov = 2 atan(size / (2 f)). ``f_px`` positive."""
    if not math.isfinite(f_px) or f_px <= 0:
        raise InvalidInput("focal length (px)", f_px, "must be a positive number")
    return math.degrees(2 * math.atan(size_px / (2 * f_px)))


def valid_radius(k1: float, k2: float) -> float:
    """Largest undistorted radius (focal-length units) up to which the model does not fold; infinity if never.

    The smallest positive r with d(r_d)/dr = 1 + 3 k1 r^2 + 5 k2 r^4 = 0.
    """
    a, b = 5 * k2, 3 * k1
    if a == 0:
        return math.sqrt(-1 / b) if b < 0 else math.inf
    discriminant = b * b - 4 * a
    if discriminant < 0:
        return math.inf
    # The numerically stable pair of roots of a s^2 + b s + 1 = 0 in s = r^2.
    q = -(b + math.copysign(math.sqrt(discriminant), b)) / 2
    roots = [q / a] + ([1 / q] if q != 0 else [])
    positive = [root for root in roots if root > 0]
    return math.sqrt(min(positive)) if positive else math.inf


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens at one zoom and focus, in front of a picture of ``image_size`` (W, H) pixels."""

    image_size: tuple[int, int]
    f_px: float
    k1: float = 0.0
    k2: float = 0.0
    center_shift_px: tuple[float, float] = (0.0, 0.0)
    pixel_aspect: float = 1.0
    nodal_offset_mm: float = 0.0

    def __post_init__(self) -> None:
        width, height = self.image_size
        if width < 2 or height < 2:
            raise InvalidInput("image size", self.image_size, "must be at least 2 x 2 pixels")
        for what, value in (("f_px", self.f_px), ("pixel aspect", self.pixel_aspect)):
            if not math.isfinite(value) or value <= 0:
                raise InvalidInput(what, value, "must be a positive number")
        for what, value in (
            ("k1", self.k1),
            ("k2", self.k2),
            ("center shift x", self.center_shift_px[0]),
            ("center shift y", self.center_shift_px[1]),
            ("nodal offset (mm)", self.nodal_offset_mm),
        ):
            if not math.isfinite(value):
                raise InvalidInput(what, value, "must be a finite number")

    @classmethod
    def from_fov(
        cls,
        image_size: tuple[int, int],
        fov_x_deg: float,
        k1: float = 0.0,
        k2: float = 0.0,
        center_shift_px: tuple[float, float] = (0.0, 0.0),
        pixel_aspect: float = 1.0,
        nodal_offset_mm: float = 0.0,
    ) -> Lens:
        """A lens from its horizontal field of view."""
        f_px = fov_to_f_px(fov_x_deg, image_size[0])
        return cls(image_size, f_px, k1, k2, center_shift_px, pixel_aspect, nodal_offset_mm)

    @property
    def half_width(self) -> float:
        """h = tan(fov_x / 2) = W / (2 f_px): half the picture's width in focal-length units."""
        return self.image_size[0] / (2 * self.f_px)

    @property
    def fov_x_deg(self) -> float:
        return f_px_to_fov(self.f_px, self.image_size[0])

    @property
    def fov_y_deg(self) -> float:
        return f_px_to_fov(self.pixel_aspect * self.f_px, self.image_size[1])

    @property
    def k1_hw(self) -> float:
        return self.k1 * self.half_width**2

    @property
    def k2_hw(self) -> float:
        return self.k2 * self.half_width**4

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """Where the optical axis meets the picture: its centre plus the centre shift."""
        width, height = self.image_size
        return (width - 1) / 2 + self.center_shift_px[0], (height - 1) / 2 + self.center_shift_px[1]

    @property
    def valid_radius(self) -> float:
        """See :func:`valid_radius`; rays beyond it project to NaN."""
        return valid_radius(self.k1, self.k2)

    def with_hw(self, f_px: float, k1_hw: float, k2_hw: float) -> Lens:
        """The same lens with another focal length and half-width distortion."""
        h = self.image_size[0] / (2 * f_px)
        return replace(self, f_px=f_px, k1=k1_hw / h**2, k2=k2_hw / h**4)

    def corner_radius(self) -> float:
        """Largest DISTORTED radius (focal-length units) inside the picture: that of its farthest corner."""
        width, height = self.image_size
        cu, cv = self.principal_point_px
        x = max(cu + 0.5, width - 0.5 - cu) / self.f_px
        y = max(cv + 0.5, height - 0.5 - cv) / (self.pixel_aspect * self.f_px)
        return math.hypot(x, y)

    def fold_radius(self) -> float:
        """Largest DISTORTED radius (focal-length units) that any ray reaches; infinity if the lens never folds."""
        radius = self.valid_radius
        if math.isinf(radius):
            return math.inf
        r2 = radius * radius
        return radius * (1 + self.k1 * r2 + self.k2 * r2 * r2)

    def folds_inside(self) -> bool:
        """Whether some pixel of the picture lies beyond the fold."""
        return self.fold_radius() <= self.corner_radius()

    def require_unfolded(self) -> None:
        """Raise :class:`FoldedLens` when the fold lies inside the picture."""
        if self.folds_inside():
            raise FoldedLens(self.fold_radius(), self.corner_radius())

    def distort(self, rays: FloatArray) -> FloatArray:
        """Undistorted rays (N, 2) to distorted ones (N, 2), NaN beyond :attr:`valid_radius`."""
        r2 = np.sum(rays * rays, axis=-1)
        gain = 1 + r2 * (self.k1 + self.k2 * r2)
        gain = np.where(r2 < self.valid_radius**2, gain, np.nan)
        return np.asarray(rays * gain[..., None])

    def undistort(self, distorted: FloatArray) -> FloatArray:
        """Distorted rays (N, 2) back to undistorted ones (N, 2): the exact inverse of :meth:`distort`.

        Safeguarded Newton on the radius, to 1e-14 of it; NaN where no ray lands. Raises :class:`NotConverged`.
        """
        r_d = np.sqrt(np.sum(distorted * distorted, axis=-1))
        radius = invert_radius(r_d, self.k1, self.k2)
        scale = np.divide(radius, r_d, out=np.ones_like(r_d), where=r_d > 0)
        return np.asarray(distorted * scale[..., None])

    def project(self, rays: FloatArray) -> FloatArray:
        """Rays (N, 2) = (X/Z, Y/Z) to pixels (N, 2) = (u, v); NaN beyond :attr:`valid_radius`."""
        d = self.distort(rays)
        cu, cv = self.principal_point_px
        return np.stack([self.f_px * d[..., 0] + cu, self.pixel_aspect * self.f_px * d[..., 1] + cv], axis=-1)

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Pixels (N, 2) to rays (N, 2): the exact inverse of :meth:`project`; NaN where no ray lands."""
        cu, cv = self.principal_point_px
        x = (pixels[..., 0] - cu) / self.f_px
        y = (pixels[..., 1] - cv) / (self.pixel_aspect * self.f_px)
        return self.undistort(np.stack([x, y], axis=-1))

    def jacobian_rays(self, rays: FloatArray) -> FloatArray:
        """d(u, v)/d(x, y), shape (N, 2, 2), in px per focal-length unit."""
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        gain = 1 + r2 * (self.k1 + self.k2 * r2)
        slope = 2 * (self.k1 + 2 * self.k2 * r2)  # d gain / d(x, y) = slope * (x, y)
        jacobian = np.empty((*x.shape, 2, 2))
        jacobian[..., 0, 0] = self.f_px * (gain + slope * x * x)
        jacobian[..., 0, 1] = self.f_px * slope * x * y
        jacobian[..., 1, 0] = self.pixel_aspect * self.f_px * slope * x * y
        jacobian[..., 1, 1] = self.pixel_aspect * self.f_px * (gain + slope * y * y)
        return jacobian

    def jacobian_parameters(self, rays: FloatArray) -> FloatArray:
        """d(u, v)/d(f_px, k1, k2, sx, sy), shape (N, 2, 5), columns as :data:`LENS_PARAMETERS`."""
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        gain = 1 + r2 * (self.k1 + self.k2 * r2)
        jacobian = np.zeros((*x.shape, 2, 5))
        for row, coordinate, scale in ((0, x, 1.0), (1, y, self.pixel_aspect)):
            jacobian[..., row, 0] = scale * coordinate * gain
            jacobian[..., row, 1] = scale * self.f_px * coordinate * r2
            jacobian[..., row, 2] = scale * self.f_px * coordinate * r2 * r2
            jacobian[..., row, 3 + row] = 1.0
        return jacobian


def invert_radius(r_d: FloatArray, k1: float, k2: float) -> FloatArray:
    """Solve r (1 + k1 r^2 + k2 r^4) = r_d for r on the branch through 0, elementwise; NaN where there is none.

    Newton from r_d, replaced by bisection wherever it leaves the bracket [0, valid radius], to 1e-14 relative.
    Raises :class:`NotConverged` if an element does not get there.
    """
    r_d = np.asarray(r_d, dtype=np.float64)
    fold = valid_radius(k1, k2)

    def forward(r: FloatArray) -> FloatArray:
        r2 = r * r
        return np.asarray(r * (1 + r2 * (k1 + k2 * r2)))

    solvable = np.isfinite(r_d)
    if math.isinf(fold):
        high = np.where(solvable, np.maximum(r_d, 1e-300), 1.0)
        for _ in range(200):  # the model never folds, so doubling always finds the far side
            short = forward(high) < r_d
            if not short.any():
                break
            high = np.where(short, 2 * high, high)
    else:
        solvable = solvable & (r_d < float(forward(np.array(fold))))
        high = np.full_like(r_d, fold)
    low = np.zeros_like(r_d)
    goal = np.where(solvable, r_d, 0.0)
    radius = np.minimum(goal, high)
    step = np.full_like(radius, math.inf)
    for _ in range(_NEWTON_STEPS):
        r2 = radius * radius
        error = forward(radius) - goal
        low = np.where(error < 0, radius, low)
        high = np.where(error > 0, radius, high)
        slope = 1 + r2 * (3 * k1 + 5 * k2 * r2)
        newton = radius - np.divide(error, slope, out=np.full_like(error, math.inf), where=slope > 0)
        following = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        following = np.where(error == 0, radius, following)
        step = np.abs(following - radius)
        radius = following
        if np.all(step <= _NEWTON_TOLERANCE * (1 + radius)):
            return np.where(solvable, radius, np.nan)
    raise NotConverged("inverse distortion", _NEWTON_STEPS, float(np.max(step)))
