"""What the formats of film and tracking share: a sensor in millimetres, and lenses refitted the other way.

A sensor's stated size is rounded: 9.59 x 5.39 mm for 1920 x 1080 would make its pixels 0.08 % too flat, half a pixel at
the picture's edge. So a file states the width as it is known, and the height that goes with it, the picture's size and
the pixel aspect; the stated size goes into the file's note.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from calibration.compare import Overlay
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.refit import InverseRadial, refit_lens
from calibration.tables import LensTable, LevelResult
from storage.errors import BadDocument, CannotExport

MAX_LEVELS = 10_000
"""Far above any table; more is another kind of file."""

DEGRADED_FROM_PX = 0.05
"""A lens that is this far off for the change of direction is no longer as good as the file it came from."""

_SQUARE_WITHIN = 0.01
# Stated sensor sizes are rounded by up to this; pixels that are not square differ by more.


def exact_sensor_mm(table: LensTable, carrier: str) -> tuple[float, float]:
    """Width and height of the sensor whose pixels have exactly the table's aspect. Raises :class:`CannotExport`."""
    if table.sensor_mm is None:
        raise CannotExport(f"{carrier} holds lengths in millimetres: put the camera's sensor_mm into the table first")
    width, height = table.image_size
    return table.sensor_mm[0], table.sensor_mm[0] * height / (width * table.pixel_aspect)


def check_count(count: int, place: str = "") -> None:
    """Raise :class:`BadDocument` for a file of more than :data:`MAX_LEVELS` levels."""
    if count > MAX_LEVELS:
        raise BadDocument(place, f"has {count} levels, at most {MAX_LEVELS} are read", "is this a lens table file?")


def pixel_aspect_of(image_size: tuple[int, int], sensor_mm: tuple[float, float]) -> float:
    """The pixel aspect of a foreign file's sensor: exactly 1 where its sizes may be rounded ones of square pixels."""
    aspect = (image_size[1] / sensor_mm[1]) / (image_size[0] / sensor_mm[0])
    return 1.0 if abs(aspect - 1) < _SQUARE_WITHIN else aspect


def unfolded_lens(table: LensTable, level: LevelResult) -> Lens:
    """The level's lens. Raises :class:`CannotExport` where it folds inside the picture."""
    lens = level.lens(table.image_size, table.pixel_aspect)
    try:
        lens.require_unfolded()
    except CalibrationError as error:
        raise CannotExport(f"zoom {level.zoom:g}, focus {level.focus:g}: {error}") from error
    return lens


def refitted_lens(frame: Lens, inverse: InverseRadial, place: str) -> tuple[Lens, Overlay]:
    """The lens of a file's D-U map, with the overlay error that is left. Raises :class:`BadDocument`."""
    try:
        return refit_lens(frame, inverse)
    except CalibrationError as error:
        raise BadDocument(place, str(error), "is the radius in the unit that the format asks for?") from error


def degraded_by(left: Overlay) -> str | None:
    """Why a level read by refit is degraded, None where it is not."""
    if left.max_px <= DEGRADED_FROM_PX:
        return None
    return f"k1, k2 refitted from a distorted-to-undistorted map: off by up to {left.max_px:.2g} px"


def refit_note(refits: Sequence[Overlay]) -> str | None:
    """What a table's provenance says of levels read by refit."""
    if not refits:
        return None
    rms, largest = max(left.rms_px for left in refits), max(left.max_px for left in refits)
    return f"k1, k2 refitted from a distorted-to-undistorted map, off by at most rms {rms:.2g}, max {largest:.2g} px"


def refit_advice(refits: Iterable[tuple[LevelResult, Overlay]]) -> str:
    """What the operator is told of levels written by refit: how far the worst one is off."""
    told = list(refits)
    worst, left = max(told, key=lambda refit: refit[1].max_px)
    where = f"zoom {worst.zoom:g}, focus {worst.focus:g}"
    text = f"refitted from distorted to undistorted: off by rms {left.rms_px:.2g}, max {left.max_px:.2g} px at {where}"
    return text + (", and no more elsewhere; the file states each level's" if len(told) > 1 else "")
