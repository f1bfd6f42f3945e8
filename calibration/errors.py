"""Errors of the numerics.

::

    CalibrationError
    ├── InvalidInput        a value that no calibration can be made of (zero size, NaN, wrong shape)
    ├── GeometryError       a scene that cannot be seen (target behind the camera)
    ├── FoldedLens          the distortion polynomial folds inside the picture
    ├── NotEnoughData       too few pictures or points for what was asked
    └── NotConverged        an iteration ended without a solution

Each message is one line: what is wrong, where, what to do. Facts stand as attributes.
"""

from __future__ import annotations


class CalibrationError(Exception):
    """Base of every error that the numerics raise on purpose."""


class InvalidInput(CalibrationError):
    """A value that no calibration can be made of.

    Attributes: ``what`` names the quantity, ``value`` is its text.
    """

    def __init__(self, what: str, value: object, why: str) -> None:
        self.what = what
        self.value = repr(value)
        super().__init__(f"{what} = {self.value}: {why}")


class GeometryError(CalibrationError):
    """A scene that the camera cannot see, for example a target behind it."""


class FoldedLens(CalibrationError):
    """The polynomial folds inside the picture, so that two rays land on one pixel.

    Attributes, distances from the optical axis on the picture in focal lengths: ``fold_radius`` where it folds,
    ``corner_radius`` of the picture's farthest corner.
    """

    def __init__(self, fold_radius: float, corner_radius: float) -> None:
        self.fold_radius = fold_radius
        self.corner_radius = corner_radius
        super().__init__(
            f"the lens folds inside the picture: no ray lands farther out than {fold_radius:.4f} focal lengths, "
            f"and the picture's corner is at {corner_radius:.4f}; check k1 and k2 (and their radius unit)"
        )


class NotEnoughData(CalibrationError):
    """Too few pictures or points for the quantities asked."""


class NotConverged(CalibrationError):
    """An iteration ended without a solution.

    Attributes: ``iterations`` made, ``last_step`` (size of the last step, in the iteration's own unit).
    """

    def __init__(self, what: str, iterations: int, last_step: float) -> None:
        self.iterations = iterations
        self.last_step = last_step
        super().__init__(f"{what} did not converge in {iterations} iterations (last step {last_step:.3g})")
