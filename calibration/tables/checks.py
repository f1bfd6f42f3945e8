"""What the parts of a lens table require of their values."""

from __future__ import annotations

import math

from calibration.errors import InvalidInput

MAX_NAME_LENGTH = 200


def finite(what: str, value: float) -> None:
    """Raise :class:`InvalidInput` unless ``value`` is a number."""
    if not math.isfinite(value):
        raise InvalidInput(what, value, "must be a finite number")


def not_negative(what: str, value: float) -> None:
    """Raise :class:`InvalidInput` unless ``value`` is 0 or more."""
    if not math.isfinite(value) or value < 0:
        raise InvalidInput(what, value, "must be 0 or a positive number")


def positive(what: str, value: float) -> None:
    """Raise :class:`InvalidInput` unless ``value`` is more than 0."""
    if not math.isfinite(value) or value <= 0:
        raise InvalidInput(what, value, "must be a positive number")


def printable_name(what: str, value: str) -> None:
    """Raise :class:`InvalidInput` unless ``value`` is a name of printable characters."""
    if not value.strip() or len(value) > MAX_NAME_LENGTH or not value.isprintable():
        raise InvalidInput(what, value, f"must be 1 to {MAX_NAME_LENGTH} printable characters")


def storable(text: str) -> str:
    """Free text made storable everywhere: file names may hold bytes that are no Unicode, or NUL from a broken one."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8").replace("\0", "\\0")
