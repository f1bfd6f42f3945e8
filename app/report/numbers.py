"""Numbers as a reader wants them: as many digits as their uncertainty carries, a true minus sign, units apart."""

from __future__ import annotations

import math

MINUS = "−"
NONE = "–"


def digits_for(sigma: float | None, default: int, most: int = 8) -> int:
    """Decimals at which a sigma shows two significant digits; ``default`` where there is none."""
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return default
    return min(max(1 - math.floor(math.log10(sigma)), 0), most)


def number(value: float | None, digits: int, *, signed: bool = False) -> str:
    """A value with fixed decimals; infinity and NaN in signs, None as a dash. A rounded zero has no sign."""
    if value is None:
        return NONE
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "?"
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    if float(text) == 0:
        text = text.lstrip("+-")
    return text.replace("-", MINUS)


def sigma_text(sigma: float | None, digits: int) -> str:
    """``± sigma`` with the decimals of its value; empty where it is not told."""
    return "" if sigma is None else f"± {number(sigma, digits)}"


def pixels(value: float | None) -> str:
    """An error in px with about three significant digits, at most four decimals."""
    if value is None:
        return NONE
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "?"
    if value >= 100:
        return f"{value:.0f}"
    return f"{value:.{4 if value < 0.1 else 3 if value < 1 else 2 if value < 10 else 1}f}"


def encoder(value: float) -> str:
    """A zoom or focus value, 0..1, as short as it can be at four decimals."""
    text = f"{value:.4f}".rstrip("0")
    return (text + "00")[: max(len(text), text.index(".") + 3)].replace("-", MINUS)
