"""Calibrating from a folder of pictures, without an engine: read, find, solve, level by level."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime

from app.documents import PictureModel, PictureSet
from app.jobs.cpu import Cpu
from app.jobs.evidence import versions
from calibration.detect.target import find_target
from calibration.errors import CalibrationError, InvalidInput, NotEnoughData
from calibration.image import Transfer, decode_picture
from calibration.solve.evidence import LevelEvidence, LevelInputs, level_evidence
from calibration.solve.iteration import LevelFit
from calibration.solve.level import held_out_residuals, solve_level
from calibration.solve.outcome import level_result, shift_only_result
from calibration.solve.problem import View
from calibration.tables import Frames, LeftOut, LensTable, LevelResult, LevelStatus
from calibration.types import Refusal
from engine_adapters.errors import AdapterError
from engine_adapters.ports import PictureFolder
from storage.evidence import summary_of

Progress = Callable[[float, str], None]
"""Told how far the work is (0..1) and what is being done."""


@dataclass(frozen=True, slots=True, eq=False)
class SetLevel:
    """One level of a set: its result, its fit (None when it failed) and what was found."""

    result: LevelResult
    fit: LevelFit | None
    views: tuple[View, ...]
    evidence: LevelEvidence | None = None


def transfer_of(described: PictureSet, file: str) -> Transfer:
    """How a picture's values code light: as the set says, else sRGB for JPEG photographs and BT.709 for the rest."""
    if described.transfer is not None:
        return Transfer(described.transfer)
    return Transfer.SRGB if file.lower().endswith((".jpg", ".jpeg")) else Transfer.BT709


async def calibrate_set(
    described: PictureSet, folder: PictureFolder, cpu: Cpu, progress: Progress = lambda share, text: None
) -> list[SetLevel]:
    """Every level of the set, in order of zoom and focus. Pictures that are of no use are left out with reasons."""
    by_level: dict[tuple[float, float], list[PictureModel]] = {}
    for picture in described.pictures:
        by_level.setdefault((picture.zoom, picture.focus), []).append(picture)
    done, total = 0, len(described.pictures)
    levels: list[SetLevel] = []
    for (zoom, focus), pictures in sorted(by_level.items()):
        started = time.monotonic()
        found: list[View | LeftOut] = []
        hashes: dict[str, str] = {}
        for view in asyncio.as_completed([_look(described, picture, folder, cpu, hashes) for picture in pictures]):
            found.append(await view)
            done += 1
            progress(0.95 * done / total, f"finding targets, {done} of {total} pictures")
        level = await cpu.run(_solve, described, zoom, focus, pictures, found, hashes)
        seconds = time.monotonic() - started
        levels.append(replace(level, result=replace(level.result, seconds=seconds)))
    progress(1.0, "done")
    return levels


def table_of(described: PictureSet, levels: list[SetLevel], created: datetime) -> LensTable:
    """The lens table of a calibrated set. Raises InvalidInput when no level could be measured."""
    results = tuple(level.result for level in levels)
    if all(result.status is LevelStatus.FAILED for result in results):
        reasons = "; ".join(sorted({result.reason or "" for result in results}))
        raise InvalidInput("picture set", described.lens, f"no level could be measured: {reasons}")
    return LensTable(
        lens=described.lens,
        camera=described.camera,
        version=1,
        created=created,
        image_size=described.image_size,
        method="joint",
        levels=results,
        sensor_mm=described.sensor_mm,
        pixel_aspect=described.pixel_aspect,
    )


def _view_name(picture: PictureModel) -> str:
    return f"{picture.file} [{picture.target}]"


async def _look(
    described: PictureSet, picture: PictureModel, folder: PictureFolder, cpu: Cpu, hashes: dict[str, str]
) -> View | LeftOut:
    target = described.targets[picture.target].to_target()
    try:
        frame = await folder.read(picture.file)
        hashes[_view_name(picture)] = await cpu.run(_sha256, frame.data)
        pixels = await cpu.run(decode_picture, frame.data, expected_size=described.image_size)
        found = await cpu.run(find_target, pixels, target, transfer=transfer_of(described, picture.file))
    except (AdapterError, InvalidInput) as error:
        return LeftOut(picture.file, str(error))
    if isinstance(found, Refusal):
        return LeftOut(picture.file, found.reason)
    pose = picture.camera_pose.to_pose() if picture.camera_pose is not None else None
    return View(_view_name(picture), picture.target, target, found, pose)


def _solve(
    described: PictureSet,
    zoom: float,
    focus: float,
    pictures: list[PictureModel],
    found: list[View | LeftOut],
    hashes: dict[str, str],
) -> SetLevel:
    # Pictures finish in any order; the fit must not depend on it.
    place = {_view_name(picture): index for index, picture in enumerate(pictures)}
    views = sorted((f for f in found if isinstance(f, View)), key=lambda view: place[view.name])
    left_out = sorted((f for f in found if isinstance(f, LeftOut)), key=lambda out: out.picture)
    try:
        fit = solve_level(
            views,
            described.image_size,
            pixel_aspect=described.pixel_aspect,
            priors=described.priors.to_priors(),
        )
        held_out = held_out_residuals(fit, views)
        result = level_result(fit, zoom, focus, held_out=held_out, left_out=left_out)
    except CalibrationError as error:
        too_little = isinstance(error, NotEnoughData)
        shift_only = shift_only_result(views, described.image_size, zoom, focus, left_out) if too_little else None
        if shift_only is not None:
            shift_only = replace(shift_only, frames=Frames(real=len(pictures)))
            return SetLevel(shift_only, None, tuple(views))
        reason = str(error)
        if not views and left_out:
            reason += f"; {left_out[0].picture}: {left_out[0].reason}"
        return SetLevel(LevelResult.failed(zoom, focus, reason, left_out=tuple(left_out)), None, tuple(views))
    inputs = LevelInputs(
        zoom,
        focus,
        described.image_size,
        tuple(views),
        described.pixel_aspect,
        priors=described.priors.to_priors(),
        left_out=tuple(left_out),
        picture_sha256={view.name: hashes[view.name] for view in views},
        versions=versions(),
    )
    evidence = level_evidence(fit, inputs, held_out)
    result = replace(result, frames=Frames(real=len(pictures)), evidence=summary_of(evidence))
    return SetLevel(result, fit, tuple(views), evidence)


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
