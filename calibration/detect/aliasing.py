"""How far an edge may be off in a picture sharper than its pixels, as one rendered with one sample a pixel is.

There a pixel is one colour or the other, so that an edge shows only between which pixel centres it runs. In each of
the L lines of pixels across an edge of slope m (to the nearer pixel axis) its place m x + c is cut to a whole pixel,
which errs by a sawtooth of period 1. A fit's error is about the mean of these. Over a random offset c it has the
variance (the sawtooth's Fourier series, each harmonic summed over x = 0 .. L - 1)

    sum over n of 1 / (2 pi^2 n^2) (sin(pi L n m) / (L sin(pi n m)))^2,

which is 1 / 12 px^2 for an edge along the pixels (uniform over a pixel), falls to about 1 / (360 K^2) where the edge
crosses K = m L rows, and rises again near slopes that are simple fractions, as 1 / 2 or 1, where the cuts repeat.
"""

from __future__ import annotations

import numpy as np

from calibration.types import FloatArray

UNIFORM_VARIANCE_PX2 = 1 / 12
LEAST_SHARE = 2e-3
"""A smaller share of the error's variance is not worth adding: it moves an edge by less than 0.013 px."""
_HARMONICS = 32
_MAIN_LOBE = 0.75
_AREA_SHARE = 1 / 3
"""Of that error, what a pixel that is the mean of its area leaves (0.25, by the Gaussian model of its response) or of
a few samples (0.35 of 4 x 4, 0.5 of 2 x 2), for edges without any blur."""
_MEAN_SOFTNESS = 0.5
"""Softness of a picture whose pixels are means over their area."""
_BLUR_DECAY_PER_PX2 = 25.0


def edge_variance(angles: FloatArray, lengths_px: FloatArray) -> FloatArray:
    """Variance (px^2) along the normals of edges at ``angles`` (rad), each seen over ``lengths_px``; any one shape."""
    cos, sin = np.abs(np.cos(angles)), np.abs(np.sin(angles))
    along, slope = np.maximum(cos, sin), np.minimum(cos, sin) / np.maximum(cos, sin)
    return np.asarray(cut_variance(slope, lengths_px * along) * along**2, dtype=np.float64)


def cut_variance(slope: FloatArray, pixels: FloatArray) -> FloatArray:
    """Variance (px^2) of the mean error of ``pixels`` cuts, along the pixel axis they are cut on."""
    variance = np.zeros(np.shape(pixels))
    for n in range(1, _HARMONICS + 1):
        phase = np.abs(n * slope - np.rint(n * slope))
        crossings = np.maximum(pixels * phase, 1e-6)
        # Beyond the first lobe the mean of sin^2: how long the edge is seen is not known to a fraction of a pixel.
        numerator = np.where(crossings < _MAIN_LOBE, np.sin(np.pi * crossings) ** 2, 0.5)
        variance += numerator / (np.pi * n * pixels * np.sin(np.pi * crossings / pixels)) ** 2 / 2
    return variance


def unsmoothed_share(softness: float, blur_variance_px2: float) -> float:
    """Share (0..1) of :func:`edge_variance` that a picture is subject to.

    ``softness``: mean of 1 - |2 v - 1| over the pixels an edge runs through, v their light from 0 to 1;
    ``blur_variance_px2``: of the optics, without the pixel. The decay with it was measured on edges of a Gaussian
    blur, exact means over the pixels: 0.073, 0.042, 0.023, 0.0079, 0.0021 px at 0, 0.15, 0.2, 0.3, 0.4 px of blur.
    """
    amplitude = np.clip(1 - (1 - _AREA_SHARE) * softness / _MEAN_SOFTNESS, _AREA_SHARE, 1.0)
    return float((amplitude * np.exp(-_BLUR_DECAY_PER_PX2 * max(blur_variance_px2, 0.0))) ** 2)


def crossing_covariance(angles: FloatArray, variances_px2: FloatArray) -> FloatArray:
    """(N, 2, 2) px^2 of where two edges at ``angles`` (N, 2) cross, whose places have ``variances_px2`` (N, 2)."""
    normals = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    inverse = np.linalg.inv(normals)
    return np.asarray(np.einsum("nij,nj,nkj->nik", inverse, variances_px2, inverse), dtype=np.float64)
