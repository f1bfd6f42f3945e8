"""Lens tables of true lenses, for tests of what lies between levels."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from calibration.tables import LensTable, LevelResult


def table_of_levels(levels: Sequence[LevelResult], image_size: tuple[int, int] = (1920, 1080)) -> LensTable:
    """A table of these levels."""
    created = datetime(2026, 11, 21, 10, tzinfo=UTC)
    return LensTable("XA 20x", "Cam0", 1, created, image_size, "joint", tuple(levels), (9.59, 5.39))
