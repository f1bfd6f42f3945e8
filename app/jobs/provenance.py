"""Where a lens table comes from, filled in wherever one is made: by a job, from pictures, from a file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace

from app.engines import ProfileFacts
from app.jobs.evidence import versions
from calibration.tables import LensTable, LevelResult, Provenance
from storage.exports import Export
from storage.exports.json_table import write_json


def software() -> str:
    """Name and version of this program."""
    return f"lensmatch {versions()['lensmatch']}"


def inputs_sha256(levels: Iterable[LevelResult]) -> str | None:
    """SHA-256 over the levels' ``evidence.inputs_sha256``, each followed by a line feed, in the table's order.

    Levels that keep no evidence are left out; None where none keeps any.
    """
    told = [level.evidence.inputs_sha256 for level in levels if level.evidence is not None]
    return sha256_of_all(told) if told else None


def sha256_of_all(hashes: Iterable[str]) -> str:
    """SHA-256 over hexadecimal hashes, each followed by a line feed."""
    return hashlib.sha256("".join(f"{one}\n" for one in hashes).encode()).hexdigest()


def provenance_of_job(job_id: str, levels: Iterable[LevelResult], profile: ProfileFacts | None) -> Provenance:
    """Of a table that a job made. ``levels`` in the table's order; ``profile``: the studio profile of its engine."""
    return Provenance(
        "calibrated",
        software(),
        job_id=job_id,
        profile=None if profile is None else profile.name,
        profile_sha256=None if profile is None else profile.sha256,
        inputs_sha256=inputs_sha256(levels),
    )


def provenance_of_set(levels: Iterable[LevelResult], pictures_sha256: str | None = None) -> Provenance:
    """Of a table made from a folder of pictures. ``pictures_sha256`` counts where no level keeps evidence."""
    return Provenance("calibrated", software(), inputs_sha256=inputs_sha256(levels) or pictures_sha256)


def imported(table: LensTable, data: bytes, export: Export) -> LensTable:
    """A table as read from a file's bytes, with the import as its provenance.

    The formats that carry a whole lens table name it as the parent, with what it says of itself in the note; a file of
    another program has no parent, and the note names that program where the file does.
    """
    file_sha256 = hashlib.sha256(data).hexdigest()
    said = table.provenance
    # A reader of coefficients alone gives the file's hash itself; the other formats bring what stood in the table.
    foreign = said is not None and said.source == "imported" and said.inputs_sha256 == file_sha256
    parent = None if foreign else hashlib.sha256(write_json(table)).hexdigest()
    note = (said.note if foreign and said is not None else None) or f"read from a {export.name} file"
    if said is not None and foreign and said.software != "unknown":
        note += f", written by {said.software}"
    elif said is not None and not foreign:
        job = f", job {said.job_id}" if said.job_id else ""
        note += f"; {said.source} by {said.software}{job}"
    provenance = Provenance("imported", software(), inputs_sha256=file_sha256, parent_sha256=parent, note=note)
    return replace(table, provenance=provenance)
