"""Detections without pictures: what a perfect detector with known noise would report. For tests and benchmarks."""

from __future__ import annotations

import numpy as np

from calibration.camera import inside_picture, project_target
from calibration.errors import GeometryError
from calibration.lens import Lens
from calibration.types import CameraPose, Detection, DetectionResult, Quality, Refusal, Target


def observe(
    lens: Lens, pose: CameraPose, target: Target, rng: np.random.Generator, sigma_px: float = 0.02
) -> DetectionResult:
    """The posed target as seen through ``lens``, with Gaussian noise ``sigma_px`` on each coordinate.

    A :class:`Refusal` when the target does not lie wholly inside the picture.
    """
    try:
        points = project_target(lens, pose, target)
    except GeometryError as error:
        return Refusal(str(error))
    if not inside_picture(points, lens.image_size):
        return Refusal("the target is cut by the picture's border")
    count = len(points)
    noisy = points + rng.normal(0.0, sigma_px, points.shape) if sigma_px > 0 else points
    return Detection(
        kind=target.kind,
        points_px=noisy,
        point_ids=np.arange(count),
        covariance_px2=np.tile(np.eye(2) * max(sigma_px, 1e-6) ** 2, (count, 1, 1)),
        centre_px=noisy.mean(axis=0),
        blur_px=0.5,
        quality=Quality(score=1.0),
    )
