"""The four sides of a quadrilateral, from rough corners: widened until the blur is known, refined, and each side that
is no plain edge fitted with a strip beside it (see ``edge`` and ``strip``)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calibration.detect.edge import LEAST_LINES, MOST_LINES, MOST_PIXELS, MOST_TERMS, EdgeFit, median_of
from calibration.detect.side import Curve, Side, meeting, start_curves
from calibration.detect.strip import fit_strip
from calibration.image import Transfer
from calibration.types import FloatArray, Picture

_ODD_CHI2, _ODD_MISFIT = 1.8, 0.015
"""Median squared residual over the noise, and residual over the contrast, from which on a side is no plain edge, so
that what is left of the misfit widens its place as far as it could have moved it. In pictures with hardly any noise the
shape of a real blur shows against the first, not against the second."""
_TRIED_MISFIT = 0.01
"""The same from which on a strip is tried: it costs as much as all the rest, and a real blur's shape stays below."""
_STRIP_ROOM_PX, _STRIP_LINES = 4.0, 80
_STRIP_SYSTEMATIC_PX = 0.02
"""What a strip between its two levels and one share leaves: a penumbra has another shape, light comes back into it."""
_SIGMA_UNKNOWN, _SIGMA_KNOWN = 1.0, 0.1
"""Shares to which the blur is known before a side with a strip is fitted, and after."""


def fit_sides(
    picture: Picture, corners: FloatArray, *, transfer: Transfer, uncertainty_px: float
) -> tuple[Side, Side, Side, Side] | None:
    """Fit the four sides (top, right, bottom, left) of a quadrilateral.

    ``corners`` (4, 2): rough corners in px, clockwise from the top left; ``uncertainty_px``: how far off they may be.
    None where a side has too few lines of pixels with contrast.
    """
    curves = start_curves(corners)
    lengths = [2 * curve.half for curve in curves]
    room = 0.45 * min(lengths)
    reach = min(max(4.0, uncertainty_px + 3.0), room)
    sigma = max(0.6, reach / 3)
    margin = uncertainty_px
    fit = _straight(picture, curves, transfer, reach, margin, sigma)
    for _ in range(2):
        wanted = min(3.2 * fit.sigma * 1.2 + 2.0, room)
        if wanted <= reach * 1.05:
            break
        # More blurred than thought: the first look may have seen only the middle of the slope.
        reach, sigma = wanted, fit.sigma
        fit = _straight(picture, curves, transfer, reach, margin, sigma)
    sigma = fit.sigma
    # Within a disk's radius (2 sigma) of a corner its two sides are not seen one by one.
    margin = min(2.1 * sigma + 0.5, 0.25 * min(lengths))
    for most_lines, tolerance_px in ((60, 0.01), (MOST_LINES, 5e-4)):
        curves = meeting(fit.curves)
        reach = min(3.2 * fit.sigma * 1.2 + 2.0, room)
        most_lines = min(most_lines, max(LEAST_LINES, int(MOST_PIXELS / (2 * reach + 1))))
        fit = EdgeFit(picture, curves, transfer, reach, margin, fit.sigma, order=MOST_TERMS - 1, most_lines=most_lines)
        fit.run(10, tolerance_px)
    sides = fit.sides()
    if sides is None:
        return None
    odd = [index for index, side in enumerate(sides) if _is_odd(side.chi2, side.contrast, _TRIED_MISFIT)]
    if not odd:
        return sides
    wide = EdgeFit(
        picture,
        fit.curves,
        transfer,
        reach + _STRIP_ROOM_PX,
        margin,
        fit.sigma,
        order=MOST_TERMS - 1,
        most_lines=_STRIP_LINES,
    )
    wide.run(4, tolerance_px)
    # The oddest first: the blur found beside its strip is that of all, which the strips had widened.
    odd.sort(key=lambda index: -sides[index].chi2)
    made = list(sides)
    sigma, known = fit.sigma, _SIGMA_UNKNOWN
    for index in [*odd, *(index for index in range(4) if index not in odd)]:
        side, found = _with_strip(wide, index, sides[index], sigma, known)
        if found and known == _SIGMA_UNKNOWN:
            sigma, known = side.sigma_px, _SIGMA_KNOWN
        if found or known == _SIGMA_KNOWN:
            made[index] = side
        elif index in odd:
            made[index] = replace(sides[index], systematic_px=side.systematic_px)
        else:
            break
    return made[0], made[1], made[2], made[3]


def _straight(
    picture: Picture, curves: list[Curve], transfer: Transfer, reach_px: float, margin_px: float, sigma_px: float
) -> EdgeFit:
    """A first fit of straight sides on few lines of pixels."""
    fit = EdgeFit(picture, curves, transfer, reach_px, margin_px, sigma_px, order=1, most_lines=40)
    fit.run(10, 0.05)
    return fit


def _with_strip(wide: EdgeFit, index: int, plain: Side, sigma_px: float, sigma_known: float) -> tuple[Side, bool]:
    """A side as fitted with a dark strip beside it, and whether there is one; its misfit is counted."""
    lines, curve = wide.strip_lines(index), wide.curves[index]
    if len(lines.first) < len(curve.coefficients) + 2:
        return plain, False
    fit = fit_strip(lines, curve.coefficients, sigma_px, sigma_known)
    good = (fit.trust > 0.3) & (wide.contrast_of(index) > 3.0)
    chi2 = float(np.median(fit.chi2[good])) if good.any() else plain.chi2
    typical = max(median_of(fit.information), 1e-12)
    freedom = float(np.median(3 * ((lines.weight[:, 0] > 0).sum(axis=0) - 2)))
    systematic = _STRIP_SYSTEMATIC_PX if fit.width_px > 0 else plain.systematic_px
    if _is_odd(chi2, plain.contrast):
        systematic = _misfit_px(chi2, freedom, typical)
    side = replace(
        plain,
        middle=curve.middle,
        half=curve.half,
        coefficients=fit.coefficients,
        covariance=fit.covariance,
        sigma_px=fit.sigma_px,
        used=float(np.mean(good)),
        lines=int(np.count_nonzero(good)),
        chi2=chi2,
        line_variance_px2=max(chi2, 1.0) / typical,
        density=len(good) / (2 * curve.half),
        systematic_px=systematic,
    )
    return side, fit.width_px > 0


def _misfit_px(chi2: float, freedom: float, information: float) -> float:
    """How far a misfit that is alike along a whole side may have drawn it (px).

    Of a line's squared residuals above the noise, (chi2 - 1) times its ``freedom``, as much as all could stand for a
    move of the edge, of which ``information`` (1 / px^2) says the squares.
    """
    return math.sqrt(max(chi2 - 1.0, 0.0) * freedom / information)


def _is_odd(chi2: float, contrast: float, misfit: float = _ODD_MISFIT) -> bool:
    """Whether a side fits badly: against the noise, and against its ``contrast`` over the noise."""
    return chi2 > _ODD_CHI2 and math.sqrt(chi2 - 1.0) > misfit * contrast
