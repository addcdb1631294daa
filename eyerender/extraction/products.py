"""Compiled loops: sums of products for normal equations, their solution, and selections.

numba compiles these loops several times faster than NumPy expressions of whole arrays.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.arrays import Bools, Floats
from ..base.jit import inlined, summing


@summing
def add_products(rows: Floats, begin: int, end: int, out: Floats) -> None:
    """Add the products of rows (k, n), summed over columns from `begin` to `end`, to the lower half of out (k, k)."""
    for j in range(rows.shape[0]):
        for m in range(j + 1):
            total = 0.0
            for i in range(begin, end):
                total += rows[j, i] * rows[m, i]
            out[j, m] += total


@inlined
def solve(matrix: Floats, right: Floats) -> None:
    """Solve n linear equations with a positive definite matrix (n, n); `right` (n,) becomes the solution.

    The matrix is overwritten too. numba takes seconds to compile `np.linalg.solve`.
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
def largest_size(values: Floats) -> float:
    """Compute the largest absolute value of (n,) values; 0 for none, NaN if one is NaN."""
    out = 0.0
    for i in range(values.size):
        size = abs(values[i])
        out = size if size > out or math.isnan(size) else out
        if math.isnan(out):
            break
    return out


@inlined
def selected_rows(values: Floats, which: Bools) -> Floats:
    """Return the rows (m, k) of values (n, k) for which `which` (n,) holds."""
    out, count = np.empty(values.shape), 0
    for i in range(values.shape[0]):
        if which[i]:
            for j in range(values.shape[1]):
                out[count, j] = values[i, j]
            count += 1
    return out[:count]


@inlined
def selected(values: Floats, which: Bools) -> Floats:
    """Return the values (m,) of (n,) for which `which` (n,) holds."""
    out, count = np.empty(values.size), 0
    for i in range(values.size):
        if which[i]:
            out[count] = values[i]
            count += 1
    return out[:count]


@inlined
def copy(values: Floats, out: Floats) -> None:
    """Copy values (n,); numba takes a second to compile the assignment of an array to a slice."""
    for i in range(values.size):
        out[i] = values[i]
