"""The benchmarks by name, imported when one is run.

Each is a module with ``run`` and, if it has them, ``columns`` and ``PLOTS``. ``run(*, quick, progress)`` gives rows,
``{"case":, "method":, figures...}``; ``columns()`` gives (name, format) pairs for the table that a person reads;
``PLOTS`` names the figures to be drawn, (column, title with its unit).
"""

from __future__ import annotations

import importlib
import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from benchmarks.rows import Column, Progress, Row, readable

_LIBRARIES = ("numpy", "scipy", "opencv-python-headless")


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A benchmark: what it compares, and its module."""

    name: str
    title: str
    module: str

    takes_lenses: bool = False

    def run(self, *, quick: bool, progress: Progress | None = None, lenses: Path | None = None) -> list[Row]:
        """Run it; ``quick``: a small share of its cases; ``lenses``: a file of lenses, where it takes one."""
        more = {"lenses": lenses} if self.takes_lenses else {}
        rows: list[Row] = importlib.import_module(self.module).run(quick=quick, progress=progress, **more)
        return rows

    def columns(self, rows: list[Row]) -> list[Column]:
        """How a person reads the rows."""
        module = importlib.import_module(self.module)
        if hasattr(module, "columns"):
            chosen: list[Column] = module.columns()
            return chosen
        names = dict.fromkeys(name for row in rows for name in row)
        return [(name, readable) for name in names]

    @property
    def plots(self) -> tuple[tuple[str, str], ...]:
        """(column, title with its unit) of each figure to be drawn."""
        chosen: tuple[tuple[str, str], ...] = getattr(importlib.import_module(self.module), "PLOTS", ())
        return chosen


BENCHMARKS = {
    benchmark.name: benchmark
    for benchmark in (
        Benchmark(
            "levels", "the joint and the study's alternating method on the same simulated studio", "benchmarks.levels"
        ),
        Benchmark(
            "engine",
            "renders until an engine of another kind draws the camera's lens, learned and searched",
            "benchmarks.engine",
        ),
        Benchmark("detect", "finding a chessboard, beside OpenCV's detectors", "benchmarks.detect"),
        Benchmark(
            "nodal", "the nodal offset from targets at one and two distances, beside public ways", "benchmarks.nodal"
        ),
        Benchmark(
            "coverage", "whether errors lie within their sigmas, over random lenses and pictures", "benchmarks.coverage"
        ),
        Benchmark("loop", "how free the event loop stays while a job runs", "benchmarks.loop"),
        Benchmark(
            "lens",
            "levels that a zoom lens needs, a wrong level among good ones, reading the lens anywhere",
            "benchmarks.lens",
            takes_lenses=True,
        ),
        Benchmark("level", "one level's fit, beside OpenCV, mrcal and the study's method", "benchmarks.level"),
        Benchmark(
            "payload", "which picture file the capture card should send, and what decoding costs", "benchmarks.payload"
        ),
        Benchmark(
            "render", "what a picture of the simulated studio costs, beside the time it imitates", "benchmarks.render"
        ),
    )
}


def machine() -> dict[str, object]:
    """What the seconds of a run depend on."""
    return {
        "system": platform.system(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
    }
