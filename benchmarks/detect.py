"""Finding targets beside OpenCV's detectors, on pictures with known points: the parts' rows, one after the other."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks import detect_boards, detect_squares

PARTS = (detect_boards.run, detect_squares.run)
PLOTS = (
    ("rmse_px", "error per coordinate, px"),
    ("vs_crb", "error over what the covariance says"),
    ("cpu_ms", "processor time, ms"),
)


def run(*, quick: bool, progress: Callable[[float], None] | None = None) -> list[dict[str, object]]:
    """The rows of every part; ``quick``: a small share of the pictures."""
    rows: list[dict[str, object]] = []
    for number, part in enumerate(PARTS):

        def inner(share: float, done: int = number) -> None:
            if progress is not None:
                progress((done + share) / len(PARTS))

        rows += part(quick=quick, progress=inner)
    return rows
