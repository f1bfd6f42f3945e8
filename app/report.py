"""x"""
from __future__ import annotations
from dataclasses import dataclass
from pathlib import Path
from calibration.compare import Overlay
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult
from storage.records import PictureKind
@dataclass(frozen=True, slots=True, eq=False)
class LevelReport:
    result: LevelResult
    truth: Lens | None
    error: Overlay | None
    pictures: dict[PictureKind, bytes]
@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    title: str
    table: LensTable
    levels: list[LevelReport]
    facts: list[tuple[str, str]]
def write_report(path: Path, report: RunReport) -> None:
    pass
