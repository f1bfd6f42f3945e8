"""The start of a job in front of an engine: learning how it draws, and saying where its studio profile is wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

from app.engines import EngineFacts
from app.jobs.cpu import Cpu
from app.jobs.taking import PictureTaker, observe
from calibration.image import Transfer
from calibration.solve.engine_fit import LearnedEngine
from calibration.solve.engine_learning import EngineLearning
from calibration.solve.engine_model import Direction, EngineModel
from calibration.solve.search import LevelTask

_SAME = 5e-3
# Relative difference of a gain to that of a known setting below which it is taken to be that setting.
_SAME_PX = 0.2


@dataclass(frozen=True, slots=True)
class KnownEngine:
    """What a job knows of its engine. ``model``: what the levels are solved with; ``disagreements``: lines for the
    operator, one for each setting of the profile that the engine contradicts."""

    learned: LearnedEngine
    model: EngineModel
    disagreements: tuple[str, ...]


async def learn(taker: PictureTaker, task: LevelTask, facts: EngineFacts, transfer: Transfer, cpu: Cpu) -> KnownEngine:
    """Take the renders that learning asks for and learn from them. Raises what the studio raises."""
    learning = EngineLearning(task)
    while not learning.done:
        capture = await cpu.run(learning.ask)
        if capture is None:
            break
        taken = await taker.take(capture)
        learning.tell(await cpu.run(observe, taken, task, transfer, f"render {capture.step} of the engine"))
    learned = await cpu.run(learning.result)
    believed = EngineModel(direction=Direction(facts.direction))
    if not learned.trusted:
        return KnownEngine(learned, believed, ())
    return KnownEngine(learned, learned.model, disagreements(learned.model, facts))


def disagreements(model: EngineModel, facts: EngineFacts) -> tuple[str, ...]:
    """Where an engine draws otherwise than its profile says, each with the setting and what the engine does instead."""
    lines: list[str] = []

    def setting(name: str, says: object, behaves: object) -> None:
        lines.append(f"engine.{name} says {says}, the engine behaves as {behaves}")

    if model.direction.value != facts.direction:
        setting("direction", facts.direction, model.direction.value)
    _distortion(model, facts, lines)
    _field_of_view(model, facts, lines)
    for i, axis in enumerate("xy"):
        if _near(model.shift_gain[i], -1.0):
            setting(f"center_shift_sign_{axis}", facts.center_shift_signs[i], -facts.center_shift_signs[i])
        elif not _near(model.shift_gain[i], 1.0):
            lines.append(f"the engine moves the centre {model.shift_gain[i]:.4g} times as far as asked ({axis})")
    _origin(model, facts, lines)
    for gain, says, behaves in ((1000.0, "mm", "m"), (0.001, "m", "mm")):
        if _near(abs(model.nodal_gain) / gain, 1.0):
            setting("nodal_unit", says, behaves)
    if model.nodal_gain < 0:
        setting("nodal_sign", facts.nodal_sign, -facts.nodal_sign)
    if not _near(model.aspect_gain, 1.0, 1e-4):
        lines.append(
            f"picture.pixel_aspect says {facts.pixel_aspect:.5g}, the engine's pixels have "
            f"{facts.pixel_aspect * model.aspect_gain:.5g}; no value of its lens can change that"
        )
    return tuple(lines)


def _near(value: float, wanted: float, within: float = _SAME) -> bool:
    return abs(value - wanted) <= within * abs(wanted)


def _distortion(model: EngineModel, facts: EngineFacts, lines: list[str]) -> None:
    says = facts.radius_unit
    for unit in facts.unit_px:
        power, gain = facts.unit_gain(unit, model.focal_gain)
        if power == model.unit_power and _near(abs(model.k1_gain), gain) and _near(abs(model.k2_gain), gain**2, 0.02):
            if unit != says:
                lines.append(f"engine.radius_unit says {says}, the engine behaves as {unit}")
            break
    else:
        lines.append(
            f"engine.radius_unit says {says}, the engine takes k1 {model.k1_gain:.4g} and k2 {model.k2_gain:.4g} times "
            "as strong, in a unit that the profile has no name for"
        )
    if model.k1_gain < 0:
        lines.append("the engine takes k1 and k2 with the opposite sign, for which the profile has no setting")


def _field_of_view(model: EngineModel, facts: EngineFacts, lines: list[str]) -> None:
    if _near(model.focal_gain, 1.0, 2e-4):
        return
    width, height = facts.image_size
    ratio = height / (facts.pixel_aspect * width)
    for gain, says, behaves in ((ratio, "x", "y"), (1 / ratio, "y", "x")):
        if facts.fov_axis == says and _near(model.focal_gain, gain):
            lines.append(f"engine.fov_axis says {says}, the engine behaves as {behaves}")
            return
    wide = 1 / model.focal_gain
    lines.append(
        f"the engine draws a field {wide:.4g} times as wide as asked (overscan), for which the profile has no setting"
    )


def _origin(model: EngineModel, facts: EngineFacts, lines: list[str]) -> None:
    offset = model.shift_offset_px
    if math.hypot(*offset) <= _SAME_PX:
        return
    size = max(facts.image_size)
    if math.hypot(*offset) > size / 4:
        other = "absolute_pixel" if facts.center_shift == "offset" else "offset"
        lines.append(f"engine.center_shift says {facts.center_shift}, the engine behaves as {other}")
    elif all(abs(abs(value) - 0.5) <= _SAME_PX for value in offset):
        other = "half" if facts.pixel_centres == "whole" else "whole"
        lines.append(f"engine.pixel_centres says {facts.pixel_centres}, the engine behaves as {other}")
    else:
        lines.append(f"the engine's centre is ({offset[0]:.2f}, {offset[1]:.2f}) px from where it is asked to be")
