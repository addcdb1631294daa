"""Sums of products, which normal equations are made of, and their solution."""

from __future__ import annotations

from ..arrays import Floats
from ..jit import inlined, summing


@summing
def add_products(rows: Floats, begin: int, end: int, out: Floats) -> None:
    """Add the products of rows (k, n), over the columns from `begin` to `end`, to the lower half of out (k, k)."""
    for j in range(rows.shape[0]):
        for m in range(j + 1):
            total = 0.0
            for i in range(begin, end):
                total += rows[j, i] * rows[m, i]
            out[j, m] += total


@inlined
def solve(matrix: Floats, right: Floats) -> None:
    """Solve n equations whose matrix (n, n) is positive definite: `right` (n,) becomes the solution.

    The matrix is changed, too. numba takes seconds to compile `np.linalg.solve`.
    """
    for k in range(right.size):
        for i in range(k + 1, right.size):
            factor = matrix[i, k] / matrix[k, k]
            right[i] -= factor * right[k]
            for j in range(k + 1, right.size):
                matrix[i, j] -= factor * matrix[k, j]
    for k in range(right.size - 1, -1, -1):
        for j in range(k + 1, right.size):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]


@inlined
def copy(values: Floats, out: Floats) -> None:
    """Copy values (n,). numba takes a second to compile the assignment of an array to a slice."""
    for i in range(values.size):
        out[i] = values[i]
