"""Where things stand and where the camera looks: from a target's points to rays and pixels.

Frames (``docs/explanations/conventions.md``): world W right-handed in metres, X right, Y forward, Z up. Camera
C: x right, y down, z forward, origin at the entrance pupil. Target T: columns (right), rows (down), normal into
the board, origin at its centre. ``R_ab`` turns coordinates of frame b into frame a.
"""

from __future__ import annotations

import math

import numpy as np

from calibration.errors import GeometryError
from calibration.lens import Lens
from calibration.types import CameraPose, FloatArray, Target, TargetPose

# Camera axes at pan = tilt = roll = 0, as columns in world axes: x right = +X, y down = -Z, z forward = +Y.
# The target's axes (column, row, into the board) at yaw = pitch = roll = 0 are the same ones.
_R_WC_REST: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def _rotation(axis: int, angle_deg: float) -> FloatArray:
    """Right-handed rotation about a world axis (0 X, 1 Y, 2 Z)."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def camera_rotation(pan_deg: float, tilt_deg: float, roll_deg: float) -> FloatArray:
    """``R_wc`` (3, 3): pan right about -Z, tilt up about X, roll clockwise (from behind) about Y, intrinsic."""
    return np.asarray(_rotation(2, -pan_deg) @ _rotation(0, tilt_deg) @ _rotation(1, roll_deg) @ _R_WC_REST)


def camera_angles_deg(R_wc: FloatArray) -> tuple[float, float, float]:
    """(pan, tilt, roll) in degrees of a rotation: the inverse of :func:`camera_rotation`, tilt in [-90, 90]."""
    m = R_wc @ _R_WC_REST.T  # = Rz(-pan) Rx(tilt) Ry(roll)
    tilt = math.asin(max(-1.0, min(1.0, float(m[2, 1]))))
    pan = math.atan2(float(m[0, 1]), float(m[1, 1]))
    roll = math.atan2(-float(m[2, 0]), float(m[2, 2]))
    return math.degrees(pan), math.degrees(tilt), math.degrees(roll)


def target_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> FloatArray:
    """``R_wt`` (3, 3): yaw about Z, pitch about X, roll about Y, intrinsic, right-handed."""
    return np.asarray(_rotation(2, yaw_deg) @ _rotation(0, pitch_deg) @ _rotation(1, roll_deg) @ _R_WC_REST)


def target_points_world(pose: TargetPose, points_m: FloatArray) -> FloatArray:
    """Points (N, 2) of a target's plane to world points (N, 3), metres."""
    R_wt = target_rotation(pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
    return np.asarray(np.asarray(pose.centre_m) + points_m @ R_wt[:, :2].T)


def pupil_m(pose: CameraPose, nodal_offset_mm: float) -> FloatArray:
    """Where the entrance pupil (the pinhole) stands in the world: pivot + nodal offset along the optical axis."""
    R_wc = camera_rotation(pose.pan_deg, pose.tilt_deg, pose.roll_deg)
    return np.asarray(np.asarray(pose.pivot_m) + R_wc[:, 2] * nodal_offset_mm / 1000.0)


def world_to_camera(pose: CameraPose, nodal_offset_mm: float, points_world_m: FloatArray) -> FloatArray:
    """World points (N, 3) to camera axes at the entrance pupil (N, 3), metres."""
    R_wc = camera_rotation(pose.pan_deg, pose.tilt_deg, pose.roll_deg)
    return np.asarray((points_world_m - pupil_m(pose, nodal_offset_mm)) @ R_wc)


def rays_of(points_camera_m: FloatArray) -> FloatArray:
    """Camera points (N, 3) to rays (N, 2) = (X/Z, Y/Z); NaN for points not in front of the pupil."""
    z = points_camera_m[..., 2]
    safe = np.where(z > 0, z, np.nan)
    return np.asarray(points_camera_m[..., :2] / safe[..., None])


def project_points(lens: Lens, pose: CameraPose, points_world_m: FloatArray) -> FloatArray:
    """World points (N, 3) to pixels (N, 2); NaN for points behind the camera or beyond the lens's fold."""
    return lens.project(rays_of(world_to_camera(pose, lens.nodal_offset_mm, points_world_m)))


def project_target(lens: Lens, pose: CameraPose, target: Target) -> FloatArray:
    """A posed target's points in pixels (N, 2), in the order of ``Target.points_m``.

    Raises :class:`GeometryError` when the target has no pose or any of its points is not in front of the camera.
    """
    if target.pose is None:
        raise GeometryError("the target has no pose: give its centre and angles, or let the fit find them")
    camera_points = world_to_camera(pose, lens.nodal_offset_mm, target_points_world(target.pose, target.points_m()))
    if not np.all(camera_points[:, 2] > 0):
        raise GeometryError(
            f"the target at {target.pose.centre_m} m is behind the camera at pan {pose.pan_deg:g}, "
            f"tilt {pose.tilt_deg:g} deg; check the target's pose and the head's angles"
        )
    return lens.project(rays_of(camera_points))


def inside_picture(pixels: FloatArray, image_size: tuple[int, int], margin_px: float = 0.0) -> bool:
    """Whether every pixel (N, 2) is a number and lies inside the picture by at least ``margin_px``."""
    width, height = image_size
    u, v = pixels[..., 0], pixels[..., 1]
    with np.errstate(invalid="ignore"):
        inside = (u >= margin_px) & (u <= width - 1 - margin_px) & (v >= margin_px) & (v <= height - 1 - margin_px)
    return bool(np.all(inside))
