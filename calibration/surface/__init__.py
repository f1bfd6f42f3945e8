"""The lens as a surface over zoom and focus: one fit over all levels of a table, and the lens between them."""

from __future__ import annotations

from calibration.surface.evaluate import LensAt, LensBatch, LensSurface
from calibration.surface.fit import LevelCheck, SurfaceFit, fit_surface

__all__ = ["LensAt", "LensBatch", "LensSurface", "LevelCheck", "SurfaceFit", "fit_surface"]
