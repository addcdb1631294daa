"""Sums of products, which normal equations are made of."""

from __future__ import annotations

from ..arrays import Floats
from ..jit import summing


@summing
def add_products(rows: Floats, begin: int, end: int, out: Floats) -> None:
    """Add the products of rows (k, n), over the columns from `begin` to `end`, to the lower half of out (k, k)."""
    for j in range(rows.shape[0]):
        for m in range(j + 1):
            total = 0.0
            for i in range(begin, end):
                total += rows[j, i] * rows[m, i]
            out[j, m] += total
