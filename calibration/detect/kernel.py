"""What a lens' blur looks like: a Gaussian, or the disk of a wide aperture out of focus, as a sum of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Kernel:
    """A blur of one standard deviation: Gaussians of ``widths`` with ``weights`` that add up to 1."""

    name: str
    widths: tuple[float, ...]
    weights: tuple[float, ...]


GAUSSIAN = Kernel("gaussian", (1.0,), (1.0,))
