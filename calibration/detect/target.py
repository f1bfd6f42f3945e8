"""The one door to all detectors: a picture and a target in, a detection or a reason out."""

from __future__ import annotations

import numpy as np

from calibration.detect.chessboard import find_chessboard
from calibration.detect.light import find_light
from calibration.detect.prediction import Prediction
from calibration.detect.square import find_square
from calibration.errors import InvalidInput
from calibration.image import Transfer
from calibration.types import DetectionResult, Picture, Target, TargetKind

SMALLEST_PICTURE_PX = 16
"""A picture narrower or lower than this shows no target that could be measured."""

__all__ = ["SMALLEST_PICTURE_PX", "Prediction", "find_target"]


def find_target(
    picture: Picture,
    target: Target,
    *,
    transfer: Transfer = Transfer.BT709,
    prediction: Prediction | None = None,
) -> DetectionResult:
    """Find ``target`` in ``picture`` ((H, W, 3) uint8 BGR) and measure its points to sub-pixel.

    ``transfer`` says how the picture's values code light (edges are measured on light). With a ``prediction`` only the
    neighbourhood of the expected points is searched, which is faster.

    A target that is not there, or cannot be measured, is a ``Refusal`` with its reason, never an exception.
    Raises :class:`InvalidInput` for an array that is not a picture, and for a prediction of another number of points.
    """
    if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8:
        kind = getattr(picture, "dtype", type(picture).__name__)
        raise InvalidInput("picture", str(kind), "must be an array of uint8 values")
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise InvalidInput("picture shape", picture.shape, "must be (height, width, 3), BGR")
    if min(picture.shape[:2]) < SMALLEST_PICTURE_PX:
        size = f"{picture.shape[1]}x{picture.shape[0]}"
        raise InvalidInput("picture size", size, f"must be at least {SMALLEST_PICTURE_PX} pixels each way")
    columns, rows = target.grid
    if prediction is not None and len(prediction.points_px) != columns * rows:
        raise InvalidInput("prediction", f"{len(prediction.points_px)} points", f"the target has {columns * rows}")
    if target.kind is TargetKind.CHESSBOARD:
        return find_chessboard(picture, target, transfer=transfer, near=prediction)
    if target.kind is TargetKind.SQUARE:
        return find_square(picture, target, transfer=transfer, near=prediction)
    return find_light(picture, target, transfer=transfer, near=prediction)
