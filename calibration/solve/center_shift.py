"""The centre shift of a level, as in chapter 4.1 of the study.

With pan, tilt and roll at zero, and in general wherever a surveyed thing stands on the optical axis, that thing is
seen at the principal point: no field of view and no radial distortion moves it. So its pixel coordinates ARE the
centre shift, counted from the picture's centre ((W - 1)/2, (H - 1)/2), + right, + down, in px.

Two cares are taken that the study does not need for its small light:

* the middle of a large board is not the mean of its corners when the board is seen at an angle (perspective moves the
  mean by 0.4 px for a board 0.9 m wide, 5 m away, seen 7 degrees askew through 1663 px of focal length), so a board is
  read through the rays of all its points (:func:`center_shift_from_points`);
* a thing beside the axis can be used where its ray and the focal length are known.

Between the ends of the zoom range the shift is interpolated, as the study does (:func:`interpolate_center_shift`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.errors import InvalidInput, NotEnoughData
from calibration.types import Detection, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CenterShift:
    """Principal point minus picture centre, px, + right, + down, with its covariance (2, 2) in px^2."""

    shift_px: tuple[float, float]
    covariance_px2: FloatArray


def _picture_centre(image_size: tuple[int, int]) -> FloatArray:
    width, height = image_size
    if width < 2 or height < 2:
        raise InvalidInput("image size", image_size, "must be at least 2 x 2 pixels")
    return np.array([(width - 1) / 2, (height - 1) / 2])


def center_shift_from_centre(
    detection: Detection,
    image_size: tuple[int, int],
    ray: tuple[float, float] = (0.0, 0.0),
    f_px: float | None = None,
    pixel_aspect: float = 1.0,
) -> CenterShift:
    """The shift from where the centre of a light or target is seen: (sx, sy) = centre - picture centre - f (x, a y).

    Source: the study, chapter 4.1, where the thing is on the optical axis, ``ray`` = (0, 0). Beside the axis, give
    its undistorted ``ray`` (X/Z, Y/Z) at the entrance pupil and the focal length ``f_px``; distortion is left out, so
    the ray should be short (its error is f |k1| r^3 px).

    The covariance is that of the mean of the detection's points, sum(C_i) / N^2: exact for a light and for the crossing
    of a square's diagonals seen head on.

    Raises :class:`InvalidInput` for a centre that is no number, or a ray beside the axis without focal length.
    """
    if not np.all(np.isfinite(detection.centre_px)) or not np.all(np.isfinite(ray)):
        raise InvalidInput("target centre (px) and ray", (detection.centre_px.tolist(), ray), "must be finite numbers")
    beside = np.zeros(2)
    if ray != (0.0, 0.0):
        if f_px is None or not math.isfinite(f_px) or f_px <= 0:
            raise InvalidInput("f_px", f_px, "a target beside the optical axis needs the focal length")
        beside = f_px * np.array([ray[0], pixel_aspect * ray[1]])
    shift = detection.centre_px - _picture_centre(image_size) - beside
    count = len(detection.points_px)
    covariance = np.asarray(detection.covariance_px2.sum(axis=0) / count**2)
    return CenterShift((float(shift[0]), float(shift[1])), covariance)


def center_shift_from_points(
    detection: Detection, rays: FloatArray, image_size: tuple[int, int], pixel_aspect: float = 1.0
) -> tuple[float, CenterShift]:
    """Rough focal length (px) and centre shift from one picture of a surveyed target near the optical axis.

    ``rays`` (N, 2) are the undistorted rays of ``detection.points_px``, in the same order. Weighted linear least
    squares for (f, sx, sy) in

        u = f x + (W - 1)/2 + sx,  v = a f y + (H - 1)/2 + sy.

    A target around the axis keeps the shift free of distortion (odd in the ray), while f takes up the mean of
    k1 r^2: it is rough, some parts in a thousand on a wide lens.

    Raises :class:`NotEnoughData` for fewer than three points or points that all lie on one ray (a light), or when the
    size seen makes no sense (mirrored); :class:`InvalidInput` for shapes that do not match.
    """
    points = detection.points_px
    if rays.shape != points.shape:
        raise InvalidInput("rays shape", rays.shape, f"must be that of the points, {points.shape}")
    if len(points) < 3 or float(np.max(np.ptp(rays, axis=0))) <= 0:
        raise NotEnoughData("the focal length cannot be told from a single spot: use a square or a chessboard")
    count = len(points)
    design = np.zeros((count, 2, 3))
    design[:, 0, 0] = rays[:, 0]
    design[:, 1, 0] = pixel_aspect * rays[:, 1]
    design[:, 0, 1] = design[:, 1, 2] = 1.0
    seen = points - _picture_centre(image_size)
    weights = np.linalg.inv(detection.covariance_px2)
    normal = np.einsum("nij,nik,nkl->jl", design, weights, design)
    solution = np.linalg.solve(normal, np.einsum("nij,nik,nk->j", design, weights, seen))
    f_px = float(solution[0])
    if not math.isfinite(f_px) or f_px <= 0:
        raise NotEnoughData(
            f"the target is seen with a focal length of {f_px:.1f} px: it is mirrored, upside down or not the one "
            "surveyed; check its pose"
        )
    covariance = np.linalg.inv(normal)[1:, 1:]
    return f_px, CenterShift((float(solution[1]), float(solution[2])), covariance)


def log_focal_weight(f_px: float, f_wide_px: float, f_tele_px: float) -> float:
    """Where a focal length lies between the ends of a zoom: log(f / f_wide) / log(f_tele / f_wide), 0 wide, 1 tele.

    All in px. Raises :class:`InvalidInput` for focal lengths that are not positive, or equal ends.
    """
    for what, value in (("f_px", f_px), ("f_wide_px", f_wide_px), ("f_tele_px", f_tele_px)):
        if not math.isfinite(value) or value <= 0:
            raise InvalidInput(what, value, "must be a positive number")
    if f_wide_px == f_tele_px:
        raise InvalidInput("f_tele_px", f_tele_px, "must differ from f_wide_px")
    return math.log(f_px / f_wide_px) / math.log(f_tele_px / f_wide_px)


def interpolate_center_shift(wide: CenterShift, tele: CenterShift, weight: float) -> CenterShift:
    """The shift between the shortest and the longest zoom: (1 - w) wide + w tele, w in [0, 1].

    Source: the study, chapter 4.1: only the two ends are measured and values between are interpolated. ``weight`` is
    the zoom's encoder value, or :func:`log_focal_weight`. The covariance is that of two independent measurements; it
    does not know how far the true shift strays from the line.

    Raises :class:`InvalidInput` outside [0, 1]: nothing is extrapolated.
    """
    if not 0 <= weight <= 1:
        raise InvalidInput("weight", weight, "must lie between 0 (wide) and 1 (tele)")
    shift = (1 - weight) * np.asarray(wide.shift_px) + weight * np.asarray(tele.shift_px)
    covariance = (1 - weight) ** 2 * wide.covariance_px2 + weight**2 * tele.covariance_px2
    return CenterShift((float(shift[0]), float(shift[1])), covariance)
