"""How free the event loop stays while a job runs: the lag of a 5 ms timer, beside that of an idle loop."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path

import numpy as np

from app.cli.jobs import run_job
from app.cli.simulated import studio_engines, studio_job, studio_profile, study_levels
from app.settings import Settings
from benchmarks.rows import Progress
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded

_TICK_S = 0.005
_IDLE_S = 2.0
PLOTS = (("lag_p99_ms", "delay of the event loop, 99th percentile, ms"),)


def run(*, quick: bool = False, progress: Progress | None = None) -> list[dict[str, object]]:
    """Two rows: the lag of an idle loop and that during a job, ms."""
    return asyncio.run(_run(quick, progress or (lambda share: None)))


async def _run(quick: bool, progress: Progress) -> list[dict[str, object]]:
    lens = load_embedded(embedded_lens_names()[0])
    levels = study_levels(1, 1) if quick else study_levels(3, 1)
    lags: list[float] = []
    rows: list[dict[str, object]] = []
    async with launched_studio(("--lens", lens.name)) as addresses:
        clock = asyncio.create_task(_tick(lags))
        try:
            await asyncio.sleep(_IDLE_S)
            rows.append(_row("idle", lags))
            lags.clear()
            engines = studio_engines(studio_profile(addresses, lens))
            with tempfile.TemporaryDirectory(prefix="lensmatch-bench-") as folder:
                settings = Settings(database=Path(folder) / "bench.db")
                request = studio_job(addresses, lens, levels)
                await run_job(settings, engines, request, lambda share, doing: progress(share))
            rows.append(_row(f"during a job of {len(levels)} levels", lags))
        finally:
            clock.cancel()
            await asyncio.gather(clock, return_exceptions=True)
    return rows


async def _tick(lags: list[float]) -> None:
    loop = asyncio.get_running_loop()
    while True:
        due = loop.time() + _TICK_S
        await asyncio.sleep(_TICK_S)
        lags.append(1000 * (loop.time() - due))


def _row(case: str, lags: list[float]) -> dict[str, object]:
    p50, p99 = np.percentile(lags, [50, 99])
    return {
        "case": case,
        "method": f"{_TICK_S * 1000:.0f} ms timer",
        "samples": len(lags),
        "lag_p50_ms": float(p50),
        "lag_p99_ms": float(p99),
        "lag_max_ms": float(max(lags)),
    }
