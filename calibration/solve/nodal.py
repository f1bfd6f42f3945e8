"""The nodal point: what tells it, and what an operator would see of its error.

Pictures of targets at ONE distance hardly tell the nodal offset from the field of view: both make the target larger or
smaller, and only the small way that the pupil swings with the pan tells them apart. At two distances the sizes alone
do. The operator's own check (the study, 1.3.1 and 2.2.4) pans past a near and a far thing and looks whether they move
against each other; :func:`parallax` is that movement in px.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from calibration.camera import camera_rotation
from calibration.lens import Lens
from calibration.solve.problem import View
from calibration.tables import Parallax
from calibration.types import Target

DEPTH_RATIO = 1.25
"""Targets whose distances differ by this factor stand at two distances."""
MEASURED_MM = 1.0
"""With two distances, a nodal offset this certain is a measurement: 1 mm moves a thing at 2 m against one at 4 m by at
most 0.4 px over a whole pan at 65 degrees, less at tele."""
_NEAR_FAR_M = (2.0, 4.0)
# Where an operator's two things stand, where the pictures have one distance only.


def view_distance_m(view: View) -> float | None:
    """Distance of a posed target's middle from the pivot along the optical axis, metres; None without poses."""
    camera, pose = view.camera_pose, view.target.pose
    if camera is None or pose is None:
        return None
    forward = camera_rotation(camera.pan_deg, camera.tilt_deg, camera.roll_deg)[:, 2]
    return float((np.asarray(pose.centre_m) - np.asarray(camera.pivot_m)) @ forward)


def distances_m(views: Iterable[View]) -> tuple[float, float] | None:
    """The nearest and the farthest distance in the pictures, metres; None where none is posed."""
    found = [d for view in views if (d := view_distance_m(view)) is not None and d > 0]
    return (min(found), max(found)) if found else None


def two_distances(views: Iterable[View]) -> bool:
    """Whether the pictures show targets at clearly different distances."""
    found = distances_m(views)
    return found is not None and found[1] >= DEPTH_RATIO * found[0]


def parallax(lens: Lens, as_given_mm: float, sigma_mm: float, views: Sequence[View]) -> Parallax:
    """The operator's no-parallax check as a number.

    A near thing stands before a far one. While the camera pans from one edge of its field to the other, by phi = half
    the field of view each way, a nodal offset that is wrong by e moves the pupil aside by e sin(phi), and the two
    things against each other by

        f 2 e sin(phi) (1 / near - 1 / far)    px.

    ``as_given_px``: for e = the offset given before minus the one found; ``sigma_px``: for e = one sigma of the one
    found. Near and far are those of the pictures, or 2 m and 4 m where they show one distance.
    """
    found = distances_m(views)
    near_m, far_m = found if found is not None and two_distances(views) else _NEAR_FAR_M
    phi = math.radians(lens.fov_x_deg / 2)
    per_mm = lens.f_px * 2 * 0.001 * math.sin(phi) * (1 / near_m - 1 / far_m)
    return Parallax(near_m, far_m, lens.fov_x_deg, abs(as_given_mm - lens.nodal_offset_mm) * per_mm, sigma_mm * per_mm)


def distance_of(target: Target, pivot_m: tuple[float, float, float]) -> float:
    """Distance (m) of a posed target's middle from the pivot; 0 without a pose."""
    if target.pose is None:
        return 0.0
    return float(np.linalg.norm(np.asarray(target.pose.centre_m) - np.asarray(pivot_m)))
