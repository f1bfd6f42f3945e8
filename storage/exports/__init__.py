"""The formats of a lens table: one module each, pure table -> bytes, with a reader and a round trip.

:data:`EXPORTS` holds them by name. ``write`` raises :class:`storage.errors.CannotExport` for a table that the format
cannot carry at all; ``read`` raises :class:`storage.errors.BadDocument`, naming the field and what to do.
"""

from __future__ import annotations

from storage.exports.base import Export
from storage.exports.csv_table import CSV_TABLE
from storage.exports.json_table import JSON_TABLE
from storage.exports.nuke_3de import NUKE_3DE
from storage.exports.opentrackio import OPENTRACKIO, OPENTRACKIO_DU
from storage.exports.ulens import ULENS

EXPORTS: dict[str, Export] = {
    export.name: export
    for export in (
        JSON_TABLE,
        CSV_TABLE,
        OPENTRACKIO,
        OPENTRACKIO_DU,
        ULENS,
        NUKE_3DE,
    )
}

__all__ = ["EXPORTS", "Export"]
