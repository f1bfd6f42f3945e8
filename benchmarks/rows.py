"""What every benchmark has in common: its rows, and how a person reads the figures in them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Row = dict[str, object]
"""``{"case":, "method":, figures...}``."""

Progress = Callable[[float], None]
"""Called with the share that is done, 0 to 1."""

Column = tuple[str, Callable[[Any], str]]
"""(name of the figure, its format)."""


def readable(value: Any) -> str:
    """A figure in at most four significant digits, a text as it is, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def decimals(digits: int) -> Callable[[Any], str]:
    """A figure with that many digits behind the point, nothing for None."""
    return lambda value: "" if value is None else f"{value:.{digits}f}"


def percent(digits: int) -> Callable[[Any], str]:
    """A share in percent with that many digits behind the point, nothing for None."""
    return lambda value: "" if value is None else f"{100 * value:.{digits}f} %"
