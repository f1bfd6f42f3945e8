"""Blurred edges fitted to the pixels: where the sides of a quadrilateral run, with their uncertainty and blur.

Each side is a curve c(t) of low order (the lens bends a straight side), seen through a Gaussian blur of standard
deviation s (optics and pixel together). A side within 45 degrees of the rows is v = c(u) and is read column by
column; the others are u = c(v) and are read row by row. So every pixel is used once and none is resampled. Along
one such line of pixels, in linear light and for each colour channel k,

    L_k(x) = B_k + D_k Phi(+-(x - c) / s') G(x),    s' = s / cos(angle between the line and the edge's normal),

with Phi the normal distribution function and G the product of the same for the two neighbouring sides (which matters
near the corners only). B_k and D_k are free for each line and channel, because what lies behind a
target differs along its side; they are eliminated (variable projection), so a line without contrast simply carries
no information. The curve's coefficients and s (common to the four sides) are found by Gauss-Newton on the
weighted squares (maximum likelihood for noise that is constant in coded values), with lines that do not fit weighed
down. Inverse curvature gives the covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from calibration.detect.aliasing import LEAST_SHARE, UNIFORM_VARIANCE_PX2, unsmoothed_share
from calibration.detect.side import Curve, Side
from calibration.detect.strip import StripLines
from calibration.image import Transfer, light_table
from calibration.types import FloatArray, Picture

_SQRT_2PI = math.sqrt(2 * math.pi)
_QUANTISATION = 1 / math.sqrt(12)
"""Least noise of a coded value: that of rounding it to a whole number."""
_LEAST_SIGMA_PX, _MOST_SIGMA_PX = 0.25, 40.0
"""The box of a pixel alone has 0.29 px; a sharper model would hold the line of one cut pixel for exact."""
# A side shorter than 24 px is bent by less than 0.01 px where the picture's edge is bent by 5 %; the third order
# needs 60 px to show as much. (Lengths at which the order rises to 2 and to 4.)
_QUADRATIC_FROM_PX, _QUARTIC_FROM_PX = 24.0, 60.0
MOST_TERMS = 5
# Lines of pixels per side: more would not be seen in the result, which is bound by the model; blurred sides have
# long lines, so that the number of pixels is bounded too.
MOST_LINES, LEAST_LINES, MOST_PIXELS = 400, 200, 4400
_OTHER_COLOUR = 0.2
"""Distance of a line's inside from the side's colour, both as shares of their light, from which on it is not trusted:
something else is in front. A shadow changes the colour less."""
_PRIOR_SIGMA_PX, _PRIOR_LOG_SPREAD = 0.5, 1.0
"""Weak prior of the blur (log-normal): decides only where all lines cut a sharp edge at the same place of a pixel."""


@dataclass(slots=True, eq=False)
class _Lines:
    """Lines of pixels across the four sides; n lines of m pixels."""

    side: NDArray[np.int64]  # (n,)
    basis: FloatArray  # (n, terms): powers of t, zero beyond the side's order
    first: FloatArray  # (n,) coordinate of the first pixel
    stretch: FloatArray  # (n,) 1 / cos of the angle between line and normal
    light: FloatArray  # (m, 3, n): sums run over the first axis, which is the fast way in numpy
    seen: FloatArray  # (m, 1, n) 1 in the picture, else 0
    sign: FloatArray  # (n,) 1 where the inside lies at larger coordinates, else -1
    neighbours: FloatArray  # (m, 1, n) share of the light that the neighbouring sides leave, 0..1
    weight: FloatArray  # (m, 3, n) inverse variance, 0 outside the picture


def _order_for(length_px: float, most: int) -> int:
    return min(1 + int(length_px >= _QUADRATIC_FROM_PX) + 2 * int(length_px >= _QUARTIC_FROM_PX), most)


def median_of(values: FloatArray) -> float:
    """The (upper) median: numpy's own costs ten times as much on short arrays."""
    middle = values.size // 2
    return float(np.partition(values, middle)[middle])


class _Levels:
    """Least squares of base + rise * shape for each line and channel, from the weighted sums of 1, shape, shape^2."""

    def __init__(self, s0: FloatArray, s1: FloatArray, s2: FloatArray) -> None:
        det = s0 * s2 - s1 * s1
        usable = det > 1e-6 * s0 * s0
        self._s0, self._s1 = s0, s1
        self._inverse = np.where(usable, 1.0 / np.where(usable, det, 1.0), 0.0)
        self._inverse_s0 = 1.0 / np.maximum(s0, 1e-12)

    def solve(self, y0: FloatArray, y1: FloatArray) -> tuple[FloatArray, FloatArray]:
        rise = (self._s0 * y1 - self._s1 * y0) * self._inverse
        return (y0 - rise * self._s1) * self._inverse_s0, rise


class EdgeFit:
    """Gauss-Newton over the four sides and their common blur, on one set of lines of pixels."""

    def __init__(
        self,
        picture: Picture,
        curves: list[Curve],
        transfer: Transfer,
        reach_px: float,
        margin_px: float,
        sigma_px: float,
        *,
        order: int,
        most_lines: int,
    ) -> None:
        table = light_table(transfer).astype(np.float64)
        self._table = table
        # Light per coded step, at each light: the noise of a coded value seen as light.
        self._gain = np.gradient(table)
        self._size = picture.shape[:2]
        self.curves: list[Curve] = []
        for curve in curves:
            wanted = _order_for(2 * curve.half, order) + 1
            coefficients = np.zeros(wanted)
            kept = min(wanted, len(curve.coefficients))
            coefficients[:kept] = curve.coefficients[:kept]
            self.curves.append(Curve(curve.along_rows, curve.low, curve.high, coefficients))
        self.sigma = sigma_px
        self._reach = reach_px
        self._most_sigma = min(_MOST_SIGMA_PX, max(1.0, reach_px / 1.5))
        self._lines = self._gather(picture, reach_px, margin_px, most_lines)
        n = len(self._lines.side)
        bounds = np.searchsorted(self._lines.side, np.arange(5))
        self._of_side = [slice(int(bounds[index]), int(bounds[index + 1])) for index in range(4)]
        self._trust = np.ones(n)
        self._alike = np.ones(n)
        self._chi2 = np.ones(n)
        self._information = np.zeros(n)
        self._contrast = np.zeros(n)
        self._offset = np.zeros(n)
        self._noise = np.ones(3)
        self._hessian = np.eye(1)
        self._aliased = 0.0

    def _gather(self, picture: Picture, reach_px: float, margin_px: float, most_lines: int) -> _Lines:
        height, width = picture.shape[:2]
        count = 2 * math.ceil(reach_px) + 1
        across = np.arange(count)
        parts: list[tuple[FloatArray, ...]] = []
        sides: list[NDArray[np.int64]] = []
        for index, curve in enumerate(self.curves):
            margin = min(margin_px, 0.3 * (curve.high - curve.low))
            x = np.arange(math.ceil(curve.low + margin), math.floor(curve.high - margin) + 1)
            limit = width if curve.along_rows else height
            x = x[(x >= 0) & (x < limit)]
            if len(x) > most_lines:
                x = x[np.linspace(0, len(x) - 1, most_lines).astype(int)]
            places = x.astype(np.float64)
            basis = np.zeros((len(x), MOST_TERMS))
            basis[:, : len(curve.coefficients)] = curve.basis(places)
            first = np.rint(basis[:, : len(curve.coefficients)] @ curve.coefficients) - count // 2
            y = first.astype(np.int64)[:, None] + across
            depth = height if curve.along_rows else width
            inside = (y >= 0) & (y < depth)
            clipped = np.clip(y, 0, depth - 1)
            coded = picture[clipped, x[:, None]] if curve.along_rows else picture[x[:, None], clipped]
            stretch = np.sqrt(1 + curve.slope(places) ** 2)
            beside = self._left_by_neighbours(index, x, y)
            sign = np.full(len(x), self._inward(index))
            parts.append((basis, first, stretch, coded, inside, sign, beside))
            sides.append(np.full(len(x), index))
        basis, first, stretch, coded, inside, sign, beside = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        light = self._table[np.ascontiguousarray(coded.transpose(1, 2, 0))]
        seen = np.ascontiguousarray(inside.T[:, None, :]).astype(np.float64)
        weight = seen * np.ones((1, 3, 1))
        neighbours = np.ascontiguousarray(beside.T[:, None, :])
        return _Lines(np.concatenate(sides), basis, first, stretch, light, seen, sign, neighbours, weight)

    def _inward(self, index: int) -> float:
        """1 where the inside of a side lies at larger coordinates, else -1."""
        opposite = self.curves[(index + 2) % 4]
        return 1.0 if opposite.coefficients[0] > self.curves[index].coefficients[0] else -1.0

    def _left_by_neighbours(self, index: int, x: NDArray[np.int64], y: NDArray[np.int64]) -> FloatArray:
        """Share of the light (n, m) that the two neighbouring sides leave at pixels (along x (n,), across y (n, m))."""
        share = np.ones(y.shape)
        along = np.broadcast_to(x[:, None], y.shape).astype(np.float64)
        across = y.astype(np.float64)
        for other in ((index + 1) % 4, (index + 3) % 4):
            curve = self.curves[other]
            same = curve.along_rows == self.curves[index].along_rows
            place, value = (along, across) if same else (across, along)
            cosine = 1 / math.hypot(1.0, float(curve.slope(np.array([curve.middle]))[0]))
            near = np.clip(place.ravel(), curve.low - curve.half, curve.high + curve.half)
            away = value.ravel() - curve.basis(near) @ curve.coefficients
            share *= ndtr(self._inward(other) * away * cosine / self.sigma).reshape(y.shape)
        return share

    def run(self, most_steps: int, tolerance_px: float) -> None:
        """Iterate until the curves move by less than the tolerance, with weights that have settled."""
        for step in range(most_steps):
            moved = self._step(reweigh=step in (0, 2))
            if moved < tolerance_px and step >= 3:
                break

    def _step(self, *, reweigh: bool) -> float:
        lines = self._lines
        scale = self.sigma * lines.stretch
        x = np.arange(lines.light.shape[0])[:, None] - (self._centres() - lines.first)
        z = (x / scale)[:, None, :]
        shape = ndtr(z * lines.sign) * lines.neighbours
        if reweigh:
            self._weigh(shape, x)
        # Derivatives of the shape by the edge's place and by log s.
        by_z = np.exp(-0.5 * z * z) * (lines.neighbours * (lines.sign / -_SQRT_2PI))
        by_blur, by_place = by_z * z, by_z / scale
        weight, light = lines.weight, lines.light
        weighted_shape, weighted_light = weight * shape, weight * light
        s0, s1, s2 = weight.sum(axis=0), weighted_shape.sum(axis=0), (weighted_shape * shape).sum(axis=0)
        y0, y1 = weighted_light.sum(axis=0), (weighted_light * shape).sum(axis=0)
        levels = _Levels(s0, s1, s2)
        base, rise = levels.solve(y0, y1)
        weighted_place, weighted_blur = weight * by_place, weight * by_blur
        p0, p1 = weighted_place.sum(axis=0), (weighted_place * shape).sum(axis=0)
        b0, b1 = weighted_blur.sum(axis=0), (weighted_blur * shape).sum(axis=0)
        place_base, place_rise = levels.solve(p0, p1)
        blur_base, blur_rise = levels.solve(b0, b1)
        # Curvature and pull with base and rise eliminated, summed over the channels.
        rise2 = rise * rise
        pp = (weighted_place * by_place).sum(axis=0) - place_base * p0 - place_rise * p1
        pb = (weighted_place * by_blur).sum(axis=0) - place_base * b0 - place_rise * b1
        bb = (weighted_blur * by_blur).sum(axis=0) - blur_base * b0 - blur_rise * b1
        place_place = np.maximum((rise2 * pp).sum(axis=0), 0.0)
        place_blur, blur_blur = (rise2 * pb).sum(axis=0), (rise2 * bb).sum(axis=0)
        pull_place = (rise * ((weighted_light * by_place).sum(axis=0) - base * p0 - rise * p1)).sum(axis=0)
        pull_blur = (rise * ((weighted_light * by_blur).sum(axis=0) - base * b0 - rise * b1)).sum(axis=0)
        pixels = lines.seen[:, 0].sum(axis=0)
        squares = ((weighted_light * light).sum(axis=0) - base * y0 - rise * y1).sum(axis=0)
        self._chi2 = squares / np.maximum(3 * (pixels - 2) - 1, 1)
        self._information = place_place
        self._contrast = np.sqrt((s0 * rise2).sum(axis=0) / np.maximum(pixels, 1))
        bound = 1.5 * scale + 0.2
        wanted = np.clip(pull_place / np.maximum(place_place, 1e-12), -bound, bound)
        # A line of a picture with one sample a pixel tells its place to a pixel, however little noise it has.
        left = 1 / (1 + place_place * (self._aliased * UNIFORM_VARIANCE_PX2))
        self._information = place_place = place_place * left
        place_blur = place_blur * left
        return self._solve(wanted, place_place, place_blur, blur_blur, wanted * place_place, pull_blur)

    def _centres(self) -> FloatArray:
        table = np.zeros((4, MOST_TERMS))
        for index, curve in enumerate(self.curves):
            table[index, : len(curve.coefficients)] = curve.coefficients
        return np.asarray(np.sum(self._lines.basis * table[self._lines.side], axis=1))

    def _weigh(self, shape: FloatArray, off_px: FloatArray) -> None:
        """Inverse variances: the noise in coded values, measured on the residuals, as light at the model's level."""
        lines = self._lines
        weighted = lines.weight * shape
        levels = _Levels(lines.weight.sum(axis=0), weighted.sum(axis=0), (weighted * shape).sum(axis=0))
        base, rise = levels.solve((lines.weight * lines.light).sum(axis=0), (weighted * lines.light).sum(axis=0))
        model = base + rise * shape
        gain = np.interp(model, self._table, self._gain)
        self._alike = self._alike_inside(base + rise)
        trusted = self._trust > 0.5
        if np.count_nonzero(trusted) > 8:
            coded = np.abs((lines.light - model)[:, :, trusted]) / gain[:, :, trusted]
            mask = lines.seen[:, 0, trusted] > 0
            pixels = float(mask.sum(axis=0).mean())
            freed = math.sqrt(pixels / max(pixels - 2.3, 1.0))
            for channel in range(3):
                spread = 1.4826 * median_of(coded[:, channel][mask]) * freed
                self._noise[channel] = max(spread, _QUANTISATION)
        lines.weight = lines.seen / (gain * self._noise[:, None]) ** 2
        self._aliased = self._aliased_share(
            ((lines.light - base) * rise).sum(axis=1), (rise * rise).sum(axis=0), off_px
        )

    def _alike_inside(self, inside: FloatArray) -> FloatArray:
        """Weight (n,) 0..1 of each line by the colour of its inside (3, n), beside the median of its side."""
        light = np.maximum(inside, 0.0)
        colour = light / np.maximum(light.sum(axis=0), 1e-6)
        alike = np.ones(inside.shape[1])
        for here in self._of_side:
            if here.stop > here.start:
                apart = np.abs(colour[:, here] - np.median(colour[:, here], axis=1)[:, None]).max(axis=0)
                limit = max(_OTHER_COLOUR, 6 * median_of(apart))
                alike[here] = 1 / (1 + (apart / limit) ** 8)
        return alike

    def _aliased_share(self, products: FloatArray, squares: FloatArray, off_px: FloatArray) -> float:
        """Share of the error of edges cut to whole pixels (see ``aliasing``): from the pixels within half of one.

        ``products`` (m, n) of light above the base and rise, summed over channels; ``squares`` (n,) of the rise.
        """
        near = (np.abs(off_px) < 0.5) & (self._lines.neighbours[:, 0] > 0.98) & (self._trust > 0.5)
        near &= (self._lines.seen[:, 0] > 0) & (squares > 0)
        if not near.any():
            return 0.0
        value = np.clip((products / np.where(squares > 0, squares, 1.0))[near], 0.0, 1.0)
        softness = float(np.mean(1 - np.abs(2 * value - 1)))
        share = unsmoothed_share(softness, self.sigma**2 - UNIFORM_VARIANCE_PX2)
        return share if share >= LEAST_SHARE else 0.0

    def _solve(
        self,
        wanted: FloatArray,
        place_place: FloatArray,
        place_blur: FloatArray,
        blur_blur: FloatArray,
        pull_place: FloatArray,
        pull_blur: FloatArray,
    ) -> float:
        """One step: robust normal equations of all coefficients and log s; returns the largest move in px."""
        lines = self._lines
        starts = np.cumsum([0] + [len(curve.coefficients) for curve in self.curves])
        size = int(starts[-1]) + 1
        prior = 1 / _PRIOR_LOG_SPREAD**2
        step = np.zeros(size)
        hessian = np.eye(size)
        done = np.zeros(len(wanted))
        trust = self._trust_of_residuals(wanted, place_place, settled=False)
        for _ in range(2):
            hessian = np.zeros((size, size))
            gradient = np.zeros(size)
            for index, here in enumerate(self._of_side):
                block = slice(int(starts[index]), int(starts[index + 1]))
                basis = lines.basis[here, : block.stop - block.start]
                weight = trust[here] * place_place[here]
                hessian[block, block] = basis.T @ (basis * weight[:, None]) + 1e-9 * np.eye(basis.shape[1])
                hessian[block, -1] = hessian[-1, block] = basis.T @ (trust[here] * place_blur[here])
                gradient[block] = basis.T @ (trust[here] * pull_place[here])
                bend = self._bend_information(self.curves[index])
                hessian[block, block] += np.diag(bend)
                gradient[block] -= bend * self.curves[index].coefficients
            hessian[-1, -1] = float(trust @ blur_blur) + prior
            gradient[-1] = float(trust @ pull_blur) - prior * math.log(self.sigma / _PRIOR_SIGMA_PX)
            step = np.asarray(np.linalg.solve(hessian, gradient), dtype=np.float64)
            done = np.zeros(len(wanted))
            for index, here in enumerate(self._of_side):
                done[here] = (
                    lines.basis[here, : starts[index + 1] - starts[index]] @ step[starts[index] : starts[index + 1]]
                )
            trust = self._trust_of_residuals(wanted - done, place_place, settled=True)
        self._trust = trust
        self._offset = wanted - done
        self._hessian = hessian
        for index, curve in enumerate(self.curves):
            curve.coefficients = curve.coefficients + step[starts[index] : starts[index + 1]]
        self.sigma = float(
            np.clip(self.sigma * math.exp(float(np.clip(step[-1], -0.5, 0.5))), _LEAST_SIGMA_PX, self._most_sigma)
        )
        return float(np.max(np.abs(done), initial=0.0))

    def _bend_information(self, curve: Curve) -> FloatArray:
        """Prior information (1 / px^2, mean 0) on a curve's coefficients: how far a lens bends a straight side.

        A straight side at distance d from the picture's centre, half length l (both over the picture's half width h),
        bent by radial distortion, has the second order d k1 l^2 h, a fourth order of about
        2 d k1^2 l^4 h + d k2 l^4 h, and a third order that many times 4 x0 / l, with x0 the distance of its middle
        from the foot of the perpendicular. So the second order is loosely bound, as k1 = 0 +- 0.15, which pulls weak
        data only; the higher ones follow the second. Without this, noise is extrapolated into the corners with the
        highest order.
        """
        height, width = self._size
        along, across = (width, height) if curve.along_rows else (height, width)
        middle = abs(curve.middle - (along - 1) / 2)
        distance = abs(float(curve.coefficients[0]) - (across - 1) / 2)
        terms = len(curve.coefficients)
        sigma = np.full(MOST_TERMS, np.inf)
        if terms > 2:
            sagitta = abs(float(curve.coefficients[2]))
            short = (2 * curve.half / width) ** 2
            sigma[2] = 0.01 + 0.15 * (distance + curve.half) * short
            sigma[4] = 0.002 + 3 * sagitta**2 / max(distance, curve.half / 2) + 0.3 * sagitta * short
            sigma[3] = sigma[4] * (1 + 4 * middle / curve.half)
        return np.asarray(1 / sigma[:terms] ** 2)

    def _trust_of_residuals(self, off_px: FloatArray, information: FloatArray, *, settled: bool) -> FloatArray:
        """Weight 0..1 of each line: small where it lies off its side's curve or fits far worse than the others."""
        trust = np.ones(len(off_px))
        for here in self._of_side:
            if here.stop == here.start:
                continue
            off = off_px[here] * np.sqrt(information[here])
            if not settled:
                off = off - median_of(off)
            spread = max(1.4826 * median_of(np.abs(off)), 0.5)
            worse = self._chi2[here] / max(median_of(self._chi2[here]), 0.3)
            trust[here] = 1 / (1 + (off / (3 * spread)) ** 4) / (1 + (worse / 6) ** 2)
        return trust * self._alike

    def sides(self) -> tuple[Side, Side, Side, Side] | None:
        """What the fit found, or None where a side rests on too few lines."""
        starts = np.cumsum([0] + [len(curve.coefficients) for curve in self.curves])
        covariance = np.asarray(np.linalg.inv(self._hessian), dtype=np.float64)
        made = []
        flat = self._flat_noise()
        for index, curve in enumerate(self.curves):
            here = self._of_side[index]
            good = np.zeros(len(self._trust), dtype=bool)
            good[here] = (self._trust[here] > 0.3) & (self._contrast[here] > 3.0)
            lines = int(np.count_nonzero(good))
            if lines < max(4, len(curve.coefficients) + 2):
                return None
            off = self._offset[good] * np.sqrt(self._information[good])
            freedom = max(lines - len(curve.coefficients), 1)
            excess = max(1.0, float(np.sum(off**2)) / freedom)
            block = slice(int(starts[index]), int(starts[index + 1]))
            chi2, contrast = float(np.median(self._chi2[good])), float(np.median(self._contrast[good]))
            # A profile that is off by a share of the step is as one moved by that over its steepest slope.
            share = math.sqrt(max(chi2 - float(np.mean((flat / self._noise) ** 2)), 0.0)) / contrast
            made.append(
                Side(
                    along_rows=curve.along_rows,
                    middle=curve.middle,
                    half=curve.half,
                    coefficients=curve.coefficients,
                    covariance=covariance[block, block] * excess,
                    sigma_px=self.sigma,
                    aliased=self._aliased,
                    line_variance_px2=excess / max(median_of(self._information[good]), 1e-12),
                    density=(here.stop - here.start) / (2 * curve.half),
                    used=lines / (here.stop - here.start),
                    lines=lines,
                    chi2=chi2,
                    contrast=contrast,
                    systematic_px=_SQRT_2PI * self.sigma * share,
                )
            )
        return made[0], made[1], made[2], made[3]

    def _flat_noise(self) -> FloatArray:
        """Noise (3,) of a coded value from second differences along the lines, which a smooth misfit does not enter."""
        light = self._lines.light
        bent = np.abs(light[:-2] - 2 * light[1:-1] + light[2:]) / np.interp(light[1:-1], self._table, self._gain)
        spread = [1.4826 * median_of(bent[:, channel].ravel()) / math.sqrt(6) for channel in range(3)]
        return np.clip(spread, _QUANTISATION, self._noise)

    def strip_lines(self, index: int) -> StripLines:
        """The lines of pixels of one side, for the fit of a strip beside it."""
        here, lines, curve = self._of_side[index], self._lines, self.curves[index]
        return StripLines(
            lines.light[..., here],
            lines.weight[..., here],
            lines.neighbours[..., here],
            lines.first[here],
            lines.stretch[here],
            lines.basis[here, 1],
            lines.basis[here, : len(curve.coefficients)],
            float(lines.sign[here][0]),
            self._bend_information(curve),
            self._alike[here],
        )

    def contrast_of(self, index: int) -> FloatArray:
        """Contrast over the noise of a pixel of each line of a side, (n,)."""
        return self._contrast[self._of_side[index]]
