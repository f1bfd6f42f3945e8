"""The study's alternating method on a folder of pictures, without an engine.

The method asks for a camera picture at a place (centre, side, edge, corner): it gets the set's picture of that role,
with the pose that stands in the set. It asks for the engine's render of the same view with trial values: it gets the
target projected through the product's own lens model at that pose, as an engine with exactly this model shows it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from app.documents import PictureModel, PictureSet
from app.jobs.cpu import Cpu
from app.picture_sets import transfer_of
from calibration.camera import project_target
from calibration.detect.target import find_target
from calibration.errors import CalibrationError, InvalidInput
from calibration.image import decode_picture
from calibration.solve.alternating import AlternatingMethod
from calibration.solve.search import Capture, LevelTask, Observation, Source
from calibration.tables import Frames, LeftOut, LevelResult
from calibration.types import CameraPose, Detection, DetectionResult, Quality, Refusal, Role, Target
from engine_adapters.errors import AdapterError
from engine_adapters.ports import PictureFolder

_ROLES = (Role.CENTER_SHIFT, Role.FOV, Role.K1, Role.K2)
_RENDER_SIGMA_PX = 1e-4
# A projected point is exact; the method's noise figures want a positive covariance.

Seen = Mapping[tuple[str, Role], tuple[PictureModel, DetectionResult]]


async def calibrate_alternating(
    described: PictureSet, folder: PictureFolder, cpu: Cpu, progress: Callable[[float, str], None]
) -> list[LevelResult]:
    """Every level of the set by the alternating method, in order of zoom and focus.

    A level needs a picture of each of the study's four roles, with its camera pose, of a target with its pose; one that
    has not is failed with its reason.
    """
    by_level: dict[tuple[float, float], list[PictureModel]] = {}
    for picture in described.pictures:
        by_level.setdefault((picture.zoom, picture.focus), []).append(picture)
    results = []
    for index, ((zoom, focus), pictures) in enumerate(sorted(by_level.items())):
        progress(index / len(by_level), f"level {index + 1} of {len(by_level)}")
        started = time.monotonic()
        result = await _level(described, zoom, focus, pictures, folder, cpu)
        results.append(replace(result, seconds=time.monotonic() - started))
    progress(1.0, "done")
    return results


async def _level(
    described: PictureSet, zoom: float, focus: float, pictures: Sequence[PictureModel], folder: PictureFolder, cpu: Cpu
) -> LevelResult:
    seen: dict[tuple[str, Role], tuple[PictureModel, DetectionResult]] = {}
    left_out = []
    for picture in pictures:
        why = _unusable(described, picture) or (
            "another picture of this role is used" if (picture.target, picture.role) in seen else None
        )
        if why is not None:
            left_out.append(LeftOut(picture.file, why))
            continue
        found = await _look(described, picture, folder, cpu)
        if isinstance(found, Refusal):
            left_out.append(LeftOut(picture.file, found.reason))
        seen[picture.target, picture.role] = (picture, found)
    try:
        result = await cpu.run(_search, described, zoom, focus, seen)
    except CalibrationError as error:
        result = LevelResult.failed(zoom, focus, str(error))
    return replace(result, left_out=tuple(left_out), frames=Frames(len(pictures), result.frames.virtual))


def _unusable(described: PictureSet, picture: PictureModel) -> str | None:
    if picture.role not in _ROLES:
        return f"the alternating method has no use for a picture of the role {picture.role.value}"
    if picture.camera_pose is None:
        return "the alternating method needs its camera_pose"
    if described.targets[picture.target].pose is None:
        return f"the alternating method needs the pose of its target {picture.target}"
    return None


async def _look(described: PictureSet, picture: PictureModel, folder: PictureFolder, cpu: Cpu) -> DetectionResult:
    try:
        frame = await folder.read(picture.file)
        pixels = await cpu.run(decode_picture, frame.data, expected_size=described.image_size)
        target = described.targets[picture.target].to_target()
        return await cpu.run(find_target, pixels, target, transfer=transfer_of(described, picture.file))
    except (AdapterError, InvalidInput) as error:
        return Refusal(str(error))


def _search(described: PictureSet, zoom: float, focus: float, seen: Seen) -> LevelResult:
    lacking = [role.value for role in _ROLES if role not in {role for _, role in seen}]
    if lacking:
        raise InvalidInput(
            "level",
            f"zoom {zoom:g}, focus {focus:g}",
            f"the alternating method needs posed pictures of the roles {', '.join(lacking)} too; "
            "--method joint takes what there is",
        )
    targets = {name: described.targets[name].to_target() for name, _ in seen}
    task = LevelTask(
        zoom=zoom,
        focus=focus,
        image_size=described.image_size,
        targets=targets,
        pivot_m=_pose(next(picture for picture, _ in seen.values())).pivot_m,
        pixel_aspect=described.pixel_aspect,
    )
    method = AlternatingMethod(task)
    trials = 0
    while not method.done:
        capture = method.ask()
        if capture is None:
            break
        trials += capture.source is Source.VIRTUAL
        method.tell(_answer(capture, targets[capture.target], seen))
    return replace(method.result(), frames=Frames(0, trials))


def _answer(capture: Capture, target: Target, seen: Seen) -> Observation:
    entry = seen.get((capture.target, capture.role))
    if entry is None:
        reason = f"the set has no picture of {capture.target} with the role {capture.role.value}"
        return Observation(capture.step, Refusal(reason), CameraPose())
    picture, found = entry
    if capture.source is Source.VIRTUAL:
        found = _rendered(capture, target, _pose(picture))
    return Observation(capture.step, found, _pose(picture), picture.file)


def _rendered(capture: Capture, target: Target, pose: CameraPose) -> DetectionResult:
    if capture.lens is None:
        return Refusal("a render without a lens")
    points = project_target(capture.lens, pose, target)
    width, height = capture.lens.image_size
    if not np.all(np.isfinite(points)):
        return Refusal("the target leaves the lens's domain at these values")
    if np.any(points < 0) or np.any(points > (width - 1, height - 1)):
        return Refusal("the target leaves the picture at these values")
    covariance = np.tile(np.eye(2) * _RENDER_SIGMA_PX**2, (len(points), 1, 1))
    return Detection(
        target.kind, points, np.arange(len(points)), covariance, points.mean(axis=0), 0.0, Quality(score=1.0)
    )


def _pose(picture: PictureModel) -> CameraPose:
    if picture.camera_pose is None:
        raise InvalidInput("camera_pose", picture.file, "the alternating method needs it")
    return picture.camera_pose.to_pose()
