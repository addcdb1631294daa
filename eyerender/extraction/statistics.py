"""Medians and quantiles of one row of values, for compiled functions and others."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats
from ..base.jit import compiled, inlined


def median(values: NDArray[Any]) -> float:
    """Compute the median of (n,) values: the mean of the middle two where n is even, NaN for none."""
    return quantile(values, 0.5)


def quantile(values: NDArray[Any], share: float) -> float:
    """Compute the `share` quantile of values (n,) of any type, by linear interpolation; NaN for none."""
    return quantile_of(np.asarray(values, dtype=np.float64), share)


@compiled("f8[::1], f8")
def quantile_of(values: Floats, share: float) -> float:
    """Compute the `share` quantile of values (n,), by linear interpolation; NaN for none."""
    if values.size == 0:
        return math.nan
    at = share * (values.size - 1)
    low = math.floor(at)
    values = values.copy()
    first = select(values, low)
    if low == at:
        return first
    above = math.inf
    for i in range(low + 1, values.size):
        above = min(above, values[i])
    return first + (at - low) * (above - first)


@inlined
def select(values: Floats, rank: int) -> float:
    """Partially sort values (n,) so that the one of this rank is in its place, and return it, like `np.partition`.

    numba takes several seconds to compile `np.partition`. Source: Hoare (1961).
    """
    low, high = 0, values.size - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]
