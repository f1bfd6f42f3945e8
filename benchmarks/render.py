"""What a picture of the simulated studio costs its processor, beside the picture time that it imitates."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

from benchmarks.rows import Progress
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded
from engine_adapters.sim.optics import View
from engine_adapters.sim.render import render_real, render_virtual
from engine_adapters.sim.room import RoomKind, build_room
from engine_adapters.sim.studio import StudioSetup

_TURNS = 40
_QUICK_TURNS = 8
_STEP_DEG = 0.013
PLOTS = (("render_ms", "processor time for a picture, ms"),)


def run(*, quick: bool = False, progress: Progress | None = None) -> list[dict[str, object]]:
    """A row for each room, zoom and kind of picture: processor time at new poses, without noise and coding."""
    lens = load_embedded(embedded_lens_names()[0])
    allowed_ms = 1000.0 * StudioSetup().picture_time_s
    turns = _QUICK_TURNS if quick else _TURNS
    rooms = [build_room(kind) for kind in (RoomKind.BOARDS, RoomKind.SQUARE)]
    zooms = {"wide": lens.levels[0], "middle": lens.levels[len(lens.levels) // 2], "tele": lens.levels[-1]}
    rows: list[dict[str, object]] = []
    for number, room in enumerate(rooms):
        for step, (name, level) in enumerate(zooms.items()):
            state = lens.at(level.zoom, level.focus)
            # The largest target that fits into the picture.
            reach = lens.image_size[1] / state.optics.f_px
            panel = next((panel for panel in room.panels if 2 * panel.half_m[1] < reach * 5.0), room.panels[-1])
            start = View(
                state.optics,
                room.pivot_m,
                pan_deg=math.degrees(math.atan2(panel.centre_m[0], panel.centre_m[1])),
                nodal_offset_mm=state.nodal_offset_mm,
            )
            real, virtual = [], []
            for turn in range(turns + 1):
                view = replace(start, pan_deg=start.pan_deg + turn * _STEP_DEG, tilt_deg=-turn * _STEP_DEG)
                real.append(_processor_ms(render_real, view, room, state.blur_px))
                virtual.append(_processor_ms(render_virtual, view, room))
            for method, times in (("real", real[1:]), ("virtual", virtual[1:])):
                rows.append(
                    {
                        "case": f"{room.kind.value}, {name}",
                        "method": method,
                        "pictures": turns,
                        "render_ms": statistics.median(times),
                        "render_max_ms": max(times),
                        "picture_ms_allowed": allowed_ms,
                    }
                )
            if progress is not None:
                progress((number * len(zooms) + step + 1) / (len(rooms) * len(zooms)))
    return rows


def _processor_ms(draw: Callable[..., object], *arguments: object) -> float:
    began = time.thread_time()
    draw(*arguments)
    return 1000.0 * (time.thread_time() - began)
