"""Nearest correlation matrix, and completion of a partial one."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats
from ..base.errors import InputError

SMALLEST = 1e-6
"""Smallest eigenvalue of the matrices used, which must be invertible for conditions."""


def nearest_correlation(matrix: Floats, *, smallest: float = SMALLEST, steps: int = 2000) -> Floats:
    """Compute the nearest matrix (Frobenius norm) with a unit diagonal and no eigenvalue below `smallest`.

    Projections on the two convex sets alternate, with Dykstra's correction for the cone (Higham 2002, "Computing the
    nearest correlation matrix", IMA J. Numer. Anal. 22, 329-343, algorithm 3.3).

    Args:
        matrix: (m, m), symmetric.
        smallest: smallest eigenvalue of the result.
        steps: largest number of steps.

    Raises:
        InputError: the matrix is not symmetric, or the iteration does not converge.
    """
    if matrix.ndim != 2 or not np.allclose(matrix, matrix.T, atol=1e-12):
        raise InputError("must be a symmetric matrix", path="correlations")
    current, correction = np.array(matrix), np.zeros_like(matrix)
    for _ in range(steps):
        values, vectors = np.linalg.eigh(current - correction)
        cone = (vectors * np.maximum(values, smallest)) @ vectors.T
        correction = cone - (current - correction)
        moved = (cone + cone.T) / 2
        np.fill_diagonal(moved, 1.0)
        done = np.max(np.abs(moved - current)) < 1e-12 and np.linalg.eigvalsh(moved)[0] > 0.5 * smallest
        current = moved
        if done:
            return np.asarray(current)
    raise InputError("no correlation matrix was found near these", path="correlations")


def completed(matrix: Floats, pairs: list[tuple[int, int]], *, sweeps: int = 500) -> Floats:
    """Compute the correlation matrix with the given correlations of `pairs` and the largest determinant.

    All other pairs are independent given the rest: their entries of the inverse are 0 (Dempster 1972, "Covariance
    selection", Biometrics 28, 157-175). The pairs are fitted in turn; if no matrix satisfies them all, that of the last
    sweep is returned.

    Args:
        matrix: (m, m); only the entries of `pairs` are used.
        pairs: indices of the given correlations.
        sweeps: largest number of sweeps.
    """
    current = np.eye(len(matrix))
    for _ in range(sweeps):
        worst = 0.0
        for i, j in pairs:
            at = np.ix_((i, j), (i, j))
            wanted = np.array([[1.0, matrix[i, j]], [matrix[i, j], 1.0]])
            worst = max(worst, float(np.max(np.abs(current[at] - wanted))))
            # The 2 x 2 block gets the required value; the regressions of all others on the pair stay.
            gain = current[:, (i, j)] @ np.linalg.inv(current[at])
            current = current + gain @ (wanted - current[at]) @ gain.T
        if worst < 1e-13:
            break
    scale = 1.0 / np.sqrt(np.diag(current))
    return np.asarray(current * scale[:, None] * scale)
