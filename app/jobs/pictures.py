"""Pictures of a level for people: the camera's, the engine's, one over the other, and the residuals as arrows."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from app.jobs.level import LevelOutcome, SeenPicture
from calibration.camera import project_target
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.solve.search import LevelTask
from calibration.types import FloatArray, Picture
from storage.records import PictureKind

_JPEG_QUALITY = 90
_GREEN, _MAGENTA, _WHITE, _INK = (80, 220, 60), (255, 60, 255), (255, 255, 255), (40, 40, 40)
_INSET_ZOOM = 8


def level_pictures(outcome: LevelOutcome, task: LevelTask, pixel_aspect: float) -> dict[PictureKind, bytes]:
    """JPEG files by kind; kinds that there is nothing to show for are missing."""
    files: dict[PictureKind, bytes] = {}
    if outcome.real is not None:
        files[PictureKind.REAL] = jpeg(outcome.real.picture)
    if outcome.virtual is not None:
        files[PictureKind.VIRTUAL] = jpeg(outcome.virtual.picture)
    if outcome.real is not None and outcome.virtual is not None:
        files[PictureKind.OVERLAY] = jpeg(overlay_picture(outcome.real, outcome.virtual.detection.points_px))
    if outcome.result.fov_x_deg is not None and outcome.seen:
        lens = outcome.result.lens(task.image_size, pixel_aspect)
        files[PictureKind.RESIDUALS] = jpeg(residual_picture(outcome, task, lens))
    return files


def jpeg(picture: Picture) -> bytes:
    """A picture as a JPEG file."""
    made, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not made:
        raise RuntimeError("OpenCV could not write a JPEG picture")
    return bytes(data)


def projected(lens: Lens, task: LevelTask, seen: SeenPicture) -> FloatArray | None:
    """Where ``lens`` puts the points that were found in a picture (N, 2) px; None where it cannot."""
    try:
        points = project_target(lens, task.pose(seen.pan_deg, seen.tilt_deg), task.targets[seen.target])
    except CalibrationError:
        return None
    return points[seen.detection.point_ids]


def overlay_picture(real: SeenPicture, drawn_px: FloatArray) -> Picture:
    """The camera's picture with the corners it shows (green) and where the engine draws them (magenta).

    An inset shows the surroundings of one corner eight times larger, crosses at sub-pixel places.
    """
    canvas = np.asarray((real.picture.astype(np.float32) * 0.75), dtype=np.uint8)
    found_px = real.detection.points_px
    for points, colour, size in ((found_px, _GREEN, 7), (drawn_px, _MAGENTA, 4)):
        for u, v in points[np.isfinite(points).all(axis=1)]:
            _cross(canvas, u, v, size, colour)
    worst = _worst(found_px, drawn_px)
    _inset(canvas, real.picture, found_px, drawn_px, worst)
    _legend(canvas, [("camera", _GREEN), ("engine", _MAGENTA)])
    return canvas


def residual_picture(outcome: LevelOutcome, task: LevelTask, lens: Lens) -> Picture:
    """Every corner of every picture of the level at its place in the frame, with model minus picture as an arrow.

    The arrows are enlarged so that the RMS of the level is about 12 px long; the scale is written on the picture.
    """
    width, height = task.image_size
    canvas = np.full((height, width, 3), 250, dtype=np.uint8)
    pairs = []
    for seen in outcome.seen:
        drawn = projected(lens, task, seen)
        if drawn is not None:
            pairs.append((seen.detection.points_px, drawn - seen.detection.points_px))
    if not pairs:
        return canvas
    rms = math.sqrt(float(np.nanmean(np.concatenate([r for _, r in pairs]) ** 2)))
    scale = 12.0 / max(rms, 1e-4)
    for points, residual in pairs:
        for (u, v), (du, dv) in zip(points, residual * scale, strict=True):
            if math.isfinite(du) and math.isfinite(dv):
                tip = (round(u + du), round(v + dv))
                cv2.arrowedLine(canvas, (round(u), round(v)), tip, (60, 60, 200), 1, cv2.LINE_AA, tipLength=0.25)
    text = f"residuals x {scale:.0f}   RMS per coordinate {rms:.4f} px   {len(pairs)} pictures"
    cv2.putText(canvas, text, (24, height - 28), cv2.FONT_HERSHEY_SIMPLEX, 0.8, _INK, 2, cv2.LINE_AA)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), (200, 200, 200), 2)
    return canvas


def _worst(found: FloatArray, drawn: FloatArray) -> int:
    if found.shape != drawn.shape:
        return 0
    distance = np.nan_to_num(np.linalg.norm(found - drawn, axis=1), nan=0.0)
    return int(np.argmax(distance))


def _cross(canvas: Picture, u: float, v: float, size: int, colour: tuple[int, int, int]) -> None:
    # OpenCV draws at fractions of a pixel with `shift` binary digits.
    at = (round(u * 16), round(v * 16))
    for dx, dy in ((size * 16, 0), (0, size * 16)):
        cv2.line(canvas, (at[0] - dx, at[1] - dy), (at[0] + dx, at[1] + dy), colour, 1, cv2.LINE_AA, 4)


def _inset(canvas: Picture, picture: Picture, found: FloatArray, drawn: FloatArray, index: int) -> None:
    height, width = picture.shape[:2]
    half = 16
    if len(found) == 0 or width < 20 * half or height < 20 * half:
        return
    u = int(np.clip(round(float(found[index][0])), half, width - half - 1))
    v = int(np.clip(round(float(found[index][1])), half, height - half - 1))
    crop = picture[v - half : v + half, u - half : u + half]
    side = 2 * half * _INSET_ZOOM
    large: NDArray[np.uint8] = np.asarray(
        cv2.resize(crop, (side, side), interpolation=cv2.INTER_NEAREST), dtype=np.uint8
    )
    for points, colour, size in ((found, _GREEN, 60), (drawn, _MAGENTA, 40)):
        if index < len(points) and np.isfinite(points[index]).all():
            # The middle of a pixel is half an enlarged pixel in.
            x = (float(points[index][0]) - (u - half) + 0.5) * _INSET_ZOOM - 0.5
            y = (float(points[index][1]) - (v - half) + 0.5) * _INSET_ZOOM - 0.5
            _cross(large, x, y, size, colour)
    # Put where the corner is not.
    top = 20 if v > height / 2 else height - side - 20
    left = 20 if u > width / 2 else width - side - 20
    canvas[top : top + side, left : left + side] = large
    cv2.rectangle(canvas, (left - 1, top - 1), (left + side, top + side), _WHITE, 2)


def _legend(canvas: Picture, entries: list[tuple[str, tuple[int, int, int]]]) -> None:
    for row, (text, colour) in enumerate(entries):
        at = (28, 44 + 34 * row)
        cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.9, _INK, 5, cv2.LINE_AA)
        cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.9, colour, 2, cv2.LINE_AA)
