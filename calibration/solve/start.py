"""Where the iteration of a level starts: a focal length, and a pose for each picture that has none."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.errors import NotEnoughData
from calibration.lens import Lens
from calibration.solve.problem import FreePoses, View
from calibration.types import FloatArray

_FOVS_DEG = (120.0, 95.0, 75.0, 60.0, 48.0, 38.0, 30.0, 22.0, 15.0, 9.0, 5.0, 3.0)
_K1_HW = (-0.15, -0.05, 0.0, 0.05)
_SHORTEST_F, _LONGEST_F = 0.2, 40.0
# Focal lengths over the picture's width: fields of view of 136 and 1.4 degrees.
# Coarse steps over all lenses that make pictures: the iteration converges from the nearest by far.


def start(
    views: Sequence[View],
    image_size: tuple[int, int],
    pixel_aspect: float,
    nodal_offset_mm: float,
    guess: Lens | None = None,
    *,
    thorough: bool = False,
) -> tuple[Lens, FreePoses]:
    """A lens and the free poses to start from.

    With known poses every ray is known and u = f x + cx is linear in (f, cx, cy); otherwise the focal length
    follows from the homographies, or, ``thorough``, it and the sign of the distortion are tried in coarse steps, each
    with the poses that fit it best.
    """
    free = {i: v for i, v in enumerate(views) if v.free}
    if guess is not None:
        return guess, _poses(free, guess)[0]
    if len(free) < len(views):
        lens = _from_known_rays([v for v in views if not v.free], image_size, pixel_aspect, nodal_offset_mm)
        return lens, _poses(free, lens)[0]
    quick = None if thorough else _from_homographies(views, image_size, pixel_aspect, nodal_offset_mm)
    if quick is not None:
        return quick, _poses(free, quick)[0]
    best: tuple[float, Lens, FreePoses] | None = None
    for fov in _FOVS_DEG:
        for k1_hw in _K1_HW:
            straight = Lens.from_fov(image_size, fov, pixel_aspect=pixel_aspect, nodal_offset_mm=nodal_offset_mm)
            lens = straight.with_hw(straight.f_px, k1_hw, 0.0)
            poses, error = _poses(free, lens)
            if best is None or error < best[0]:
                best = error, lens, poses
    if best is None or not math.isfinite(best[0]):
        raise NotEnoughData("no pose explains any picture; check the target's size and its squares")
    return best[1], best[2]


def _from_homographies(
    views: Sequence[View], image_size: tuple[int, int], pixel_aspect: float, nodal_offset_mm: float
) -> Lens | None:
    """A focal length from the pictures alone, the principal point in the middle and no distortion; None if untold.

    A plane's homography H = [h1 h2 h3] gives two equations linear in 1 / f^2 (Zhang, PAMI 22, 2000), with x, y counted
    from the middle: h1'h2 = 0 and h1'h1 = h2'h2 in the metric diag(1/f^2, 1/f^2, 1). The weighted median of their
    solutions is not led astray by the pictures in which the board faces the camera.
    """
    middle = (np.asarray(image_size, dtype=np.float64) - 1) / 2
    squares: list[tuple[float, float]] = []
    for view in views:
        plane = view.target.points_m()[view.detection.point_ids]
        if len(plane) < 4:
            continue
        pixels = (view.detection.points_px - middle) / [1.0, pixel_aspect] / image_size[0]
        H, _ = cv2.findHomography(plane / max(view.target.outline_m()), pixels)
        if H is None:
            continue
        (a, b), (c, d), (e, f) = (H[row, :2] for row in range(3))
        for numerator, denominator in ((a * b + c * d, -e * f), (a * a + c * c - b * b - d * d, f * f - e * e)):
            if numerator * denominator > 0:
                squares.append((float(numerator / denominator), float(abs(denominator))))
    if not squares:
        return None
    squares.sort()
    weights = np.cumsum([weight for _, weight in squares])
    f_px = math.sqrt(squares[int(np.searchsorted(weights, weights[-1] / 2))][0]) * image_size[0]
    if not _SHORTEST_F < f_px / image_size[0] < _LONGEST_F:
        return None
    return Lens(image_size, f_px, pixel_aspect=pixel_aspect, nodal_offset_mm=nodal_offset_mm)


def _from_known_rays(
    views: Sequence[View], image_size: tuple[int, int], pixel_aspect: float, nodal_offset_mm: float
) -> Lens:
    width, height = image_size
    rows: list[FloatArray] = []
    values: list[FloatArray] = []
    for view in views:
        if view.camera_pose is None or view.target.pose is None:
            continue
        world = target_points_world(view.target.pose, view.target.points_m()[view.detection.point_ids])
        rays = rays_of(world_to_camera(view.camera_pose, nodal_offset_mm, world))
        ones, zeros = np.ones(len(rays)), np.zeros(len(rays))
        rows.append(np.column_stack([rays[:, 0], ones, zeros]))
        values.append(view.detection.points_px[:, 0] - (width - 1) / 2)
        rows.append(np.column_stack([pixel_aspect * rays[:, 1], zeros, ones]))
        values.append(view.detection.points_px[:, 1] - (height - 1) / 2)
    matrix, right = np.concatenate(rows), np.concatenate(values)
    usable = np.isfinite(matrix).all(axis=1)
    if usable.sum() < 6:
        raise NotEnoughData(
            "the target is behind the camera in every picture; check its pose and the head's angles (pan is positive "
            "to the right, tilt upwards)"
        )
    # The centre is only loosely free at the start: with few points it trades against the focal length.
    hold = np.diag([0.0, 1e-2, 1e-2])
    matrix, right = matrix[usable], right[usable]
    f_px, shift_x, shift_y = np.linalg.solve(matrix.T @ matrix + hold, matrix.T @ right)
    if not f_px > 0:
        raise NotEnoughData(
            "the pictures contradict the poses (the target moves the wrong way); check the signs of pan and tilt"
        )
    return Lens(
        image_size,
        float(f_px),
        center_shift_px=(float(shift_x), float(shift_y)),
        pixel_aspect=pixel_aspect,
        nodal_offset_mm=nodal_offset_mm,
    )


def _poses(free: dict[int, View], lens: Lens) -> tuple[FreePoses, float]:
    """Camera-from-target poses for ``lens`` and the RMS distance in px that they leave (infinite if none fits)."""
    poses: FreePoses = {}
    squares, count = 0.0, 0
    for index, view in free.items():
        plane = view.target.points_m()[view.detection.point_ids]
        points = np.column_stack([plane, np.zeros(len(plane))])
        rays = lens.unproject(view.detection.points_px)
        if len(points) < 4 or not np.isfinite(rays).all():
            return _fallback(free, lens), math.inf
        try:
            found, R_vectors, t_vectors, errors = cv2.solvePnPGeneric(
                points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
            )
        except cv2.error:
            return _fallback(free, lens), math.inf
        if not found:
            return _fallback(free, lens), math.inf
        best = int(np.argmin(np.asarray(errors).ravel()))
        R_ct = np.asarray(cv2.Rodrigues(R_vectors[best])[0], dtype=np.float64)
        t_ct_m = np.asarray(t_vectors[best], dtype=np.float64).ravel()
        poses[index] = R_ct, t_ct_m
        back = lens.project(rays_of(points @ R_ct.T + t_ct_m))
        distance = back - view.detection.points_px
        if not np.isfinite(distance).all():
            return _fallback(free, lens), math.inf
        squares += float(np.sum(distance**2))
        count += len(points)
    return poses, math.sqrt(squares / count) if count else 0.0


def _fallback(free: dict[int, View], lens: Lens) -> FreePoses:
    """Poses straight in front, at the distance that the target's size tells."""
    poses: FreePoses = {}
    for index, view in free.items():
        spread_px = float(np.ptp(view.detection.points_px, axis=0).max())
        distance_m = lens.f_px * max(view.target.outline_m()) / max(spread_px, 1.0)
        centre = (view.detection.points_px.mean(axis=0) - np.asarray(lens.principal_point_px)) / lens.f_px
        poses[index] = np.eye(3), np.array([centre[0], centre[1], 1.0]) * distance_m
    return poses
