"""The formats of a lens table: one module each, pure table -> bytes, with a reader and a round trip.

:data:`EXPORTS` holds them by name. ``write`` raises :class:`storage.errors.CannotExport` for a table that the format
cannot carry at all; ``read`` raises :class:`storage.errors.BadDocument`, naming the field and what to do.
"""

from __future__ import annotations

from storage.exports.base import Export
from storage.exports.colmap import COLMAP
from storage.exports.csv_table import CSV_TABLE
from storage.exports.gyroflow import GYROFLOW
from storage.exports.json_table import JSON_TABLE
from storage.exports.lensfun import LENSFUN
from storage.exports.nuke_3de import NUKE_3DE
from storage.exports.opencv_yaml import OPENCV_YAML
from storage.exports.opentrackio import OPENTRACKIO, OPENTRACKIO_DU
from storage.exports.r3_commands import R3_COMMANDS
from storage.exports.stmap import STMAP
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
        OPENCV_YAML,
        COLMAP,
        GYROFLOW,
        LENSFUN,
        R3_COMMANDS,
        STMAP,
    )
}

__all__ = ["EXPORTS", "Export"]
