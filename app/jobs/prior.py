"""The lens that a calibration starts from: another table's, of the same lens or of one of its type."""

from __future__ import annotations

import asyncio
import math

from app.documents import JobRequest, read_table
from app.engines import StudioMismatch
from app.lens_at import surface_fit
from calibration.surface import LensSurface
from calibration.tables import LensTable
from storage.repository import Repository

_ASPECT_TOLERANCE = 1e-6


async def require_prior(request: JobRequest, repository: Repository) -> LensTable | None:
    """The table that a job starts from, None where it starts from none.

    Raises :class:`storage.errors.NotFound`, :class:`app.engines.StudioMismatch` for one of another picture.
    """
    given = request.start_from
    if given is None:
        return None
    table = (await repository.get_table(given)).table if isinstance(given, int) else read_table(given, "start_from")
    if table.image_size != request.image_size:
        there, here = (f"{size[0]} x {size[1]} px" for size in (table.image_size, request.image_size))
        raise StudioMismatch(f"start_from: a lens of pictures of {there} is no start for pictures of {here}")
    if not math.isclose(table.pixel_aspect, request.pixel_aspect, rel_tol=_ASPECT_TOLERANCE):
        raise StudioMismatch(
            f"start_from: a lens of pixel aspect {table.pixel_aspect:.9g} is no start for one of "
            f"{request.pixel_aspect:.9g}"
        )
    return table


async def prior_surface(request: JobRequest, repository: Repository) -> LensSurface | None:
    """The surface of the table that a job starts from, None where it starts from none.

    Raises as :func:`require_prior`, and :class:`calibration.errors.CalibrationError` for levels that make no surface.
    """
    table = await require_prior(request, repository)
    return None if table is None else (await asyncio.to_thread(surface_fit, table)).surface
