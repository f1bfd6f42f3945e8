"""Pictures of a level for people: the camera's, the engine's, one over the other before and after, residuals, maps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from app.jobs.heatmap import heat_map
from app.jobs.level import LevelOutcome, SeenPicture
from calibration.camera import project_target
from calibration.compare import Overlay
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.solve.search import LevelTask
from calibration.types import FloatArray, Picture
from engine_adapters.ports import LensValues
from storage.records import PictureKind

_JPEG_QUALITY = 90
_CAMERA, _ENGINE = (233, 200, 70), (30, 120, 255)
# Light blue and orange are told apart without colour vision too.
_WHITE, _INK, _ARROW = (255, 255, 255), (24, 24, 24), (60, 60, 200)
_INSET_HALF, _INSET_SHARE = 16, 0.23
# Half the width of what the inset shows, px, and how much of the picture's width it takes.
_ARROW_PX = 14.0
_FAR_PX = 1e4
# Beyond this OpenCV's fixed-point coordinates would wrap round.


def level_pictures(
    outcome: LevelOutcome,
    task: LevelTask,
    pixel_aspect: float,
    *,
    as_found: LensValues | None = None,
    expected: Overlay | None = None,
) -> dict[PictureKind, bytes]:
    """JPEG files by kind; kinds that there is nothing to show for are missing.

    ``as_found``: the engine's lens before the job changed it. ``expected``: overlay error expected from the fit.
    """
    files: dict[PictureKind, bytes] = {}
    if outcome.real is not None:
        files[PictureKind.REAL] = jpeg(outcome.real.picture)
        if as_found is not None:
            before = before_picture(outcome.real, task, as_found)
            if before is not None:
                files[PictureKind.BEFORE] = jpeg(before)
    if outcome.virtual is not None:
        files[PictureKind.VIRTUAL] = jpeg(outcome.virtual.picture)
    if outcome.real is not None and outcome.virtual is not None:
        files[PictureKind.OVERLAY] = jpeg(after_picture(outcome.real, outcome.virtual, task))
    if outcome.result.fov_x_deg is not None and outcome.seen:
        lens = outcome.result.lens(task.image_size, pixel_aspect)
        files[PictureKind.RESIDUALS] = jpeg(residual_picture(_residuals(outcome, task, lens), task.image_size))
    if expected is not None:
        files[PictureKind.UNCERTAINTY] = jpeg(heat_map(expected.map_px, task.image_size))
    return files


def jpeg(picture: Picture) -> bytes:
    """A picture as a JPEG file."""
    made, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not made:
        raise RuntimeError("OpenCV could not write a JPEG picture")
    return bytes(data)


def before_picture(real: SeenPicture, task: LevelTask, as_found: LensValues) -> Picture | None:
    """The camera's picture with the target as the engine would have drawn it with the values found in it.

    None where those values make no lens or put the target nowhere.
    """
    try:
        lens = Lens.from_fov(
            task.image_size,
            as_found.fov_x_deg,
            as_found.k1,
            as_found.k2,
            as_found.center_shift_px,
            task.pixel_aspect,
            as_found.nodal_offset_mm,
        )
        drawn_px = project_target(lens, task.pose(real.pan_deg, real.tilt_deg), task.targets[real.target])
    except CalibrationError:
        return None
    values = f"FoV {as_found.fov_x_deg:.2f}°, k1 {as_found.k1:g}, k2 {as_found.k2:g}"
    return overlay_picture(real, drawn_px, task.targets[real.target].grid, f"engine as found ({values})")


def after_picture(real: SeenPicture, virtual: SeenPicture, task: LevelTask) -> Picture:
    """The camera's picture with the target where the engine's own last render shows it."""
    target = task.targets[virtual.target]
    drawn_px = np.full((target.grid[0] * target.grid[1], 2), np.nan)
    drawn_px[virtual.detection.point_ids] = virtual.detection.points_px
    return overlay_picture(real, drawn_px, target.grid, "engine's render at the published values")


def overlay_picture(real: SeenPicture, drawn_px: FloatArray, grid: tuple[int, int], title: str) -> Picture:
    """The camera's picture, darkened, with the corners it shows (rings) and the engine's (grid of lines).

    ``drawn_px``: the engine's (N, 2), row by row of the target's ``grid`` (columns, rows), NaN where unknown. The foot
    says how far they are apart at most; an inset shows the surroundings of that corner enlarged.
    """
    canvas = _darkened(real.picture)
    found_px = np.full_like(drawn_px, np.nan)
    found_px[real.detection.point_ids] = real.detection.points_px
    reachable = np.abs(drawn_px).max(axis=1, keepdims=True) < _FAR_PX
    drawn_px = np.where(reachable, drawn_px, np.nan)
    _grid_lines(canvas, drawn_px, grid)
    for u, v in found_px[np.isfinite(found_px).all(axis=1)]:
        _ring(canvas, float(u), float(v), 7.0, _CAMERA, 3)
    distance = np.linalg.norm(found_px - drawn_px, axis=1)
    if not np.isfinite(distance).any():
        return _with_foot(canvas, f"{title}: the target is not in the picture")
    worst = int(np.nanargmax(distance))
    if distance[worst] < _INSET_HALF:
        _inset(canvas, real.picture, found_px, drawn_px, worst)
    far = float(distance[worst])
    return _with_foot(
        canvas, f"{title}: at most {far:.3f} px apart" if far < 1 else f"{title}: up to {far:.1f} px apart"
    )


def residual_picture(pairs: Sequence[tuple[FloatArray, FloatArray]], image_size: tuple[int, int]) -> Picture:
    """Every corner of every picture of the level at its place in the frame, with model minus picture as an arrow.

    ``pairs``: points (N, 2) px and their residuals (N, 2) px of each picture. The arrows are enlarged so that the RMS
    of the level is about 14 px long; the scale is written on the picture.
    """
    width, height = image_size
    canvas = np.full((height, width, 3), 255, dtype=np.uint8)
    given = [residual for _, residual in pairs if np.isfinite(residual).any()]
    if not given:
        return canvas
    rms = math.sqrt(float(np.nanmean(np.concatenate(given) ** 2)))
    scale = _ARROW_PX / max(rms, 1e-4)
    for points, residual in pairs:
        for (u, v), (du, dv) in zip(points, residual * scale, strict=True):
            if math.isfinite(du) and math.isfinite(dv) and max(abs(du), abs(dv)) < _FAR_PX:
                tip = (round(u + du), round(v + dv))
                cv2.arrowedLine(canvas, (round(u), round(v)), tip, _ARROW, 2, cv2.LINE_AA, tipLength=0.25)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), (200, 200, 200), 2)
    counted = f"{len(pairs)} picture" + ("s" if len(pairs) != 1 else "")
    return _with_foot(canvas, f"residuals × {scale:.0f}    RMS per coordinate {rms:.4f} px    {counted}")


def _residuals(outcome: LevelOutcome, task: LevelTask, lens: Lens) -> list[tuple[FloatArray, FloatArray]]:
    pairs = []
    for seen in outcome.seen:
        try:
            drawn = project_target(lens, task.pose(seen.pan_deg, seen.tilt_deg), task.targets[seen.target])
        except CalibrationError:
            continue
        found = seen.detection.points_px
        pairs.append((found, drawn[seen.detection.point_ids] - found))
    return pairs


def _darkened(picture: Picture) -> Picture:
    """Darker and with half of its colour, so that lines stand out on it."""
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.addWeighted(picture, 0.35, grey, 0.35, 0), dtype=np.uint8)


def _fixed(u: float, v: float) -> tuple[int, int]:
    # OpenCV draws at fractions of a pixel with `shift` binary digits.
    return round(u * 16), round(v * 16)


def _grid_lines(canvas: Picture, points_px: FloatArray, grid: tuple[int, int]) -> None:
    columns, rows = grid
    table = points_px.reshape(rows, columns, 2)
    pairs = [(table[r, c], table[r, c + 1]) for r in range(rows) for c in range(columns - 1)]
    pairs += [(table[r, c], table[r + 1, c]) for r in range(rows - 1) for c in range(columns)]
    for start, end in pairs:
        if np.isfinite(start).all() and np.isfinite(end).all():
            cv2.line(canvas, _fixed(*start), _fixed(*end), _ENGINE, 3, cv2.LINE_AA, 4)
    if not pairs and np.isfinite(points_px).all():
        _cross(canvas, float(points_px[0, 0]), float(points_px[0, 1]), 9, _ENGINE, 3)


def _ring(canvas: Picture, u: float, v: float, radius: float, colour: tuple[int, int, int], thickness: int) -> None:
    cv2.circle(canvas, _fixed(u, v), round(radius * 16), colour, thickness, cv2.LINE_AA, 4)


def _cross(canvas: Picture, u: float, v: float, size: int, colour: tuple[int, int, int], thickness: int) -> None:
    x, y = _fixed(u, v)
    for dx, dy in ((size * 16, 0), (0, size * 16)):
        cv2.line(canvas, (x - dx, y - dy), (x + dx, y + dy), colour, thickness, cv2.LINE_AA, 4)


def _inset(canvas: Picture, picture: Picture, found_px: FloatArray, drawn_px: FloatArray, index: int) -> None:
    height, width = picture.shape[:2]
    half = _INSET_HALF
    zoom = round(_INSET_SHARE * width / (2 * half))
    side = 2 * half * zoom
    if zoom < 4 or height < 2 * side:
        return
    u = int(np.clip(round(float(found_px[index, 0])), half, width - half - 1))
    v = int(np.clip(round(float(found_px[index, 1])), half, height - half - 1))
    crop = np.ascontiguousarray(picture[v - half : v + half, u - half : u + half])
    enlarged = cv2.resize(_darkened(crop), (side, side), interpolation=cv2.INTER_NEAREST)
    large: NDArray[np.uint8] = np.asarray(enlarged, dtype=np.uint8)
    for (x, y), is_camera in ((found_px[index], True), (drawn_px[index], False)):
        # The middle of a pixel is half an enlarged pixel in.
        at = [(float(value) - (middle - half) + 0.5) * zoom - 0.5 for value, middle in ((x, u), (y, v))]
        if is_camera:
            _ring(large, at[0], at[1], 2.6 * zoom, _CAMERA, 5)
        else:
            _cross(large, at[0], at[1], 8 * zoom, _ENGINE, 3)
    left, top = _free_corner(np.concatenate([found_px, drawn_px]), (width, height), side)
    canvas[top : top + side, left : left + side] = large
    cv2.rectangle(canvas, (left - 1, top - 1), (left + side, top + side), _WHITE, 2)
    cv2.rectangle(canvas, (u - half, v - half), (u + half, v + half), _WHITE, 2)
    label, size = f"{zoom} x, the corner farthest off", zoom / 14
    cv2.putText(canvas, label, (left + zoom, top + side - zoom), cv2.FONT_HERSHEY_SIMPLEX, size, _WHITE, 2, cv2.LINE_AA)


def _free_corner(points_px: FloatArray, size: tuple[int, int], side: int) -> tuple[int, int]:
    """(left, top) of a square of ``side`` px in that corner of the picture where it hides the fewest points."""
    margin = 24
    far_left, far_top = size[0] - side - margin, size[1] - side - margin
    places = [(far_left, far_top), (margin, far_top), (far_left, margin), (margin, margin)]

    def hidden(place: tuple[int, int]) -> int:
        inside = (points_px > np.array(place) - margin) & (points_px < np.array(place) + side + margin)
        return int(np.count_nonzero(inside.all(axis=1)))

    return min(places, key=hidden)


def _with_foot(canvas: Picture, text: str) -> Picture:
    width = canvas.shape[1]
    scale = min(1.0, width / 1920)
    band = np.full((round(80 * scale), width, 3), 255, dtype=np.uint8)
    at = (round(24 * scale), round(54 * scale))
    cv2.putText(band, text, at, cv2.FONT_HERSHEY_SIMPLEX, 1.4 * scale, _INK, 1, cv2.LINE_AA)
    return np.vstack([canvas, band])
