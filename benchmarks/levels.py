"""The alternating method and the joint method on the same simulated studio, in one run, level by level.

Both speak to the same process over the same sockets and find the same targets with the same detector; what differs
is the method. Counts of pictures have no noise; seconds are this machine's. The truth is read after the work.
"""

from __future__ import annotations

import asyncio
import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

from app.cli.jobs import run_job
from app.cli.simulated import (
    StudioUse,
    studio_engines,
    studio_job,
    studio_profile,
    studio_use,
    study_levels,
    true_lens,
)
from app.documents import JobRequest
from app.engines import Engines
from app.settings import Settings
from benchmarks.rows import Column, Progress, Row, decimals, percent, readable
from calibration.compare import overlay, relative_errors
from calibration.tables import LensTable
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import ZoomLens, embedded_lens_names, load_embedded

PICTURE_TIME_S = 0.015
DELAY_FRAMES = 2
METHODS = ("joint", "alternating")
HARD_BLUR_PX, HARD_NOISE = 4.0, 5.0
PLOTS = (
    ("pictures", "pictures taken"),
    ("overlay_max_px", "largest overlay error, px"),
    ("seconds", "time, s"),
)


def run(*, quick: bool = False, progress: Progress | None = None) -> list[Row]:
    """Rows per level and method, a total for each, the ratio of the two, and the joint method on hard pictures."""
    return asyncio.run(_run(quick, progress or (lambda share: None)))


async def _run(quick: bool, progress: Progress) -> list[Row]:
    lens = load_embedded(embedded_lens_names()[0])
    levels = study_levels(3, 1) if quick else study_levels()
    rows: list[Row] = []
    totals: dict[str, Row] = {}
    async with launched_studio(("--lens", lens.name, "--payload-format", "jpeg")) as addresses:
        engines = studio_engines(studio_profile(addresses, lens))
        for index, method in enumerate(METHODS):

            def show(share: float, doing: str, index: int = index) -> None:
                # The alternating method takes by far the longest part.
                progress(0.05 * share if index == 0 else 0.05 + 0.85 * share)

            before = await studio_use(addresses, PICTURE_TIME_S, DELAY_FRAMES)
            table = await _table(engines, studio_job(addresses, lens, levels, method), show)
            use = (await studio_use(addresses, PICTURE_TIME_S, DELAY_FRAMES)).since(before)
            of_method = _level_rows(method, table, lens)
            rows += of_method
            totals[method] = _total(method, of_method, use)
    rows += [totals[method] for method in METHODS]
    rows.append(_ratio(totals["joint"], totals["alternating"]))
    rows.append(_study(totals["joint"], len(levels)))
    rows += await _hard(lens, levels)
    progress(0.96)
    rows.append(await _slow_way(lens, levels[0]))
    return rows


async def _table(engines: Engines, request: JobRequest, show: Callable[[float, str], None]) -> LensTable:
    """The lens table of a job on a fresh database."""
    with tempfile.TemporaryDirectory(prefix="lensmatch-bench-") as folder:
        job = await run_job(Settings(database=Path(folder) / "bench.db"), engines, request, show)
    return job.table


async def _hard(lens: ZoomLens, levels: list[tuple[float, float]]) -> list[Row]:
    """The joint method's rows, and their total, on the same lens out of focus and with a noisy camera."""
    truth = lens.truth()
    for level in truth["levels"]:
        level |= {"blur_px": HARD_BLUR_PX, "noise_sigma": HARD_NOISE}
    with tempfile.TemporaryDirectory(prefix="lensmatch-bench-") as folder:
        file = Path(folder) / "hard.json"
        file.write_text(json.dumps(truth), encoding="utf-8")
        async with launched_studio(("--lens-file", str(file), "--payload-format", "jpeg")) as addresses:
            engines = studio_engines(studio_profile(addresses, lens))
            before = await studio_use(addresses, PICTURE_TIME_S, DELAY_FRAMES)
            table = await _table(engines, studio_job(addresses, lens, levels), lambda share, doing: None)
            use = (await studio_use(addresses, PICTURE_TIME_S, DELAY_FRAMES)).since(before)
    method = f"joint, blur {HARD_BLUR_PX:g} px, noise {HARD_NOISE:g}"
    rows = _level_rows(method, table, lens)
    return [*rows, _total(method, rows, use)]


def _level_rows(method: str, table: LensTable, lens: ZoomLens) -> list[Row]:
    rows: list[Row] = []
    for level in table.levels:
        row: Row = {
            "case": f"zoom {level.zoom:.3f} focus {level.focus:.2f}",
            "method": method,
            "status": level.status.value,
            "scenario": level.scenario,
            "pictures": level.frames.real + level.frames.virtual,
            "seconds": level.seconds,
        }
        if level.fov_x_deg is not None:
            truth = true_lens(lens, level.zoom, level.focus)
            found = level.lens(table.image_size, table.pixel_aspect)
            error = overlay(truth, found)
            relative = relative_errors(truth, found)
            row |= {
                "overlay_rms_px": error.rms_px,
                "overlay_max_px": error.max_px if math.isfinite(error.max_px) else None,
                "fov_error": relative["fov_x_deg"],
                "k1_error": relative["k1"],
                "k2_error": relative["k2"],
            }
        rows.append(row)
    return rows


def _total(method: str, rows: list[Row], use: StudioUse) -> Row:
    def worst(name: str) -> float | None:
        values = [float(v) for row in rows if isinstance(v := row.get(name), float)]
        return max(values) if values else None

    seconds = sum(float(v) for row in rows if isinstance(v := row["seconds"], float))
    return {
        "case": f"total of {len(rows)} levels",
        "method": method,
        "status": f"{sum(row['status'] != 'failed' for row in rows)} measured",
        "pictures": use.pictures,
        "seconds": seconds,
        "engine_bound_s": use.engine_bound_s,
        "overlay_max_px": worst("overlay_max_px"),
        "fov_error": worst("fov_error"),
        "k1_error": worst("k1_error"),
        "k2_error": worst("k2_error"),
    }


def _ratio(joint: Row, alternating: Row) -> Row:
    def quotient(name: str) -> float | None:
        over, under = alternating.get(name), joint.get(name)
        if not isinstance(over, int | float) or not isinstance(under, int | float) or under == 0:
            return None
        return float(over) / float(under)

    names = ("pictures", "seconds", "overlay_max_px")
    return {"case": "ratio", "method": "alternating / joint"} | {name: quotient(name) for name in names}


def _study(joint: Row, levels: int) -> Row:
    """The study's own number of pictures, from the two times it gives: not measured here, only for comparison.

    A level takes n (picture time + other work): 65 min for 6 levels at 0.3 s a picture, 35.1 min for 13 at 0.015 s.
    """
    slow_s, fast_s = 65 * 60 / 6, 35.1 * 60 / 13
    pictures = levels * (slow_s - fast_s) / (0.3 - 0.015)
    fetched = joint["pictures"]
    row: Row = {"case": "the study's own, derived from its times", "method": "alternating / joint"}
    return row | {"pictures": pictures / fetched if isinstance(fetched, int) else None}


async def _slow_way(lens: ZoomLens, level: tuple[float, float]) -> Row:
    """One level with pictures as the study first took them: snapshots on the engine's disk, 0.3 s each."""
    async with launched_studio(("--lens", lens.name, "--payload-format", "jpeg")) as addresses:
        engines = studio_engines(studio_profile(addresses, lens), slow_pictures=True)
        table = await _table(engines, studio_job(addresses, lens, [level]), lambda share, doing: None)
    rows = _level_rows("joint, snapshots on disk", table, lens)
    return rows[0]


def columns() -> list[Column]:
    """How a person reads the rows: column and format."""

    return [
        ("case", readable),
        ("method", readable),
        ("status", readable),
        ("scenario", readable),
        ("pictures", readable),
        ("seconds", decimals(2)),
        ("engine_bound_s", decimals(2)),
        ("overlay_rms_px", decimals(4)),
        ("overlay_max_px", decimals(4)),
        ("fov_error", percent(2)),
        ("k1_error", percent(2)),
        ("k2_error", percent(2)),
    ]
