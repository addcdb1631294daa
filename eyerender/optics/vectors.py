"""Lengths and products of many short vectors; NumPy's functions would loop over the three numbers of each vector."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats


def lengths(v: Floats) -> Floats:
    """Compute the lengths (...,) of vectors (..., 3)."""
    return np.asarray(np.sqrt(dots(v, v)))


def dots(a: Floats, b: Floats) -> Floats:
    """Compute scalar products (...,) of vectors (..., 3)."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def crosses(a: Floats, b: Floats) -> Floats:
    """Compute vector products (..., 3) of vectors (..., 3)."""
    ax, ay, az, bx, by, bz = (v[..., k] for v in (a, b) for k in range(3))
    out = np.empty(np.broadcast(a, b).shape)
    out[..., 0], out[..., 1], out[..., 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return out
