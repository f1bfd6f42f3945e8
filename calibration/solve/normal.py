"""The normal equations of a level, the unknowns of single pictures eliminated.

With shared unknowns s and each picture's own o_v,

    [ A    B_v ] [ds  ]   [-g  ]
    [ B_v' C_v ] [do_v] = [-h_v],

so (A - sum B_v C_v^-1 B_v') ds = -(g - sum B_v C_v^-1 h_v), and do_v follows. The inverse of the matrix on the left is
the covariance of the shared unknowns (Triggs et al., Bundle adjustment, 2000, section 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.solve.problem import OWN, Evaluation, Step
from calibration.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """``A`` (S, S), ``g`` (S,); ``B`` (V, S, 6), ``C`` (V, 6, 6), ``h`` (V, 6): a picture without own unknowns has an
    identity in ``C`` and zeros else."""

    A: FloatArray
    g: FloatArray
    B: FloatArray
    C: FloatArray
    h: FloatArray

    @classmethod
    def of(
        cls,
        rows: Sequence[slice],
        own_count: IntArray,
        evaluation: Evaluation,
        whiten: FloatArray,
        used: NDArray[np.bool_],
    ) -> NormalEquations:
        """From residuals and Jacobians, each picture's points in its ``rows``; ``whiten`` (N, 3) the lower triangles
        (w11, w21, w22) by which each point is multiplied, what is not ``used`` does not count."""
        points, _, count = evaluation.shared.shape
        own = bool(own_count.any())
        # (columns, 2, N): so the Jacobians lie in memory, and one product with itself is every sum that is needed.
        stacked = np.empty((count + own * OWN + 1, 2, points))
        stacked[:count] = evaluation.shared.T
        if own:
            stacked[count:-1] = evaluation.own.T
        stacked[-1] = evaluation.residual_px.T
        w11, w21, w22 = np.ascontiguousarray(whiten.T)
        stacked[:, 1] *= w22
        stacked[:, 1] += w21 * stacked[:, 0]
        stacked[:, 0] *= w11
        if not used.all():
            stacked[:, :, ~used] = 0.0
        shared = stacked[:count].reshape(count, 2 * points)
        prior = evaluation.prior_shared
        A = shared @ shared.T + prior.T @ prior
        g = shared @ stacked[-1].ravel() + prior.T @ evaluation.prior_residual
        views = len(rows)
        B, C, h = np.zeros((views, count, OWN)), np.zeros((views, OWN, OWN)), np.zeros((views, OWN))
        if own:
            for index, part in enumerate(rows):
                if not own_count[index]:
                    continue
                both = stacked[:, :, part].reshape(len(stacked), -1)
                sums = both @ both[count:-1].T
                B[index], C[index], h[index] = sums[:count], sums[count:-1], sums[-1]
            turns = evaluation.own_prior
            C[:, :3, :3] += np.swapaxes(turns, 1, 2) @ turns
            h[:, :3] += np.einsum("vij,vi->vj", turns, evaluation.own_prior_residual)
        missing = np.arange(OWN) >= own_count[:, None]
        C[:, np.arange(OWN), np.arange(OWN)] += missing
        return cls(A, g, B, C, h)

    def solved(self, damping: float) -> Step | None:
        """The step with Levenberg's damping (relative to the diagonal), None where the matrix is singular."""
        A, C = self.A.copy(), self.C.copy()
        diagonal = np.diag(A).copy()
        diagonal[diagonal <= 0] = 1.0
        A[np.diag_indices_from(A)] += damping * diagonal
        own = np.arange(OWN)
        C[:, own, own] *= 1 + damping
        try:
            K = np.linalg.solve(C, np.swapaxes(self.B, 1, 2))  # (V, 6, S)
            k = np.linalg.solve(C, self.h[..., None])[..., 0]
            reduced = A - np.einsum("vso,vot->st", self.B, K)
            shared = np.linalg.solve(reduced, np.einsum("vso,vo->s", self.B, k) - self.g) if len(A) else np.zeros(0)
        except np.linalg.LinAlgError:
            return None
        return Step(np.asarray(shared), np.asarray(-k - K @ shared))

    def shared_covariance(self) -> FloatArray:
        """Covariance (S, S) of the shared unknowns; columns are first scaled to like size: pixels stand beside mm."""
        reduced = self.A
        if len(self.C):
            scale = 1 / np.sqrt(np.maximum(np.einsum("vii->vi", self.C), 1e-300))
            C = self.C * scale[:, :, None] * scale[:, None, :]
            B = self.B * scale[:, None, :]
            reduced = reduced - np.einsum("vso,vot->st", B, np.linalg.pinv(C, hermitian=True) @ np.swapaxes(B, 1, 2))
        scale = 1 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
        inverse = np.linalg.pinv(reduced * np.outer(scale, scale), hermitian=True)
        return np.asarray(inverse * np.outer(scale, scale))
