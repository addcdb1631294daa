"""Compiled cover of thin pencils of light by lashes."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats
from ..base.jit import compiled, inlined

_WIDTH = 1.5 * np.sqrt(3.0) / np.pi
"""Half the mean width of a three-sided tube over its radius: its circumference over 2 pi, as of any convex section."""


@compiled("f8[:,:,:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1]")
def leave_free(lashes: Floats, starts: Floats, points: Floats, near_mm: Floats, far_mm: Floats, out: Floats) -> None:
    """Multiply `out` by the share of round pencils of light between starts and points that lashes leave free.

    A lash covers a strip of a pencil's section where it is nearest to the axis; lashes cover it independently.

    Args:
        lashes: (n, k, p, 4) points of the lashes' curves and the radii of their tubes there, mm; NaN for no lash.
        starts: (m, 3) where light comes from or goes to, mm.
        points: (n, m, 3) the other ends, mm; nothing is covered where they are NaN.
        near_mm: (n, m) radii of the pencils there.
        far_mm: (m,) radii of the pencils at the starts.
        out: (n, m), changed.
    """
    way = np.empty(3)
    for i in range(len(lashes)):
        for s in range(lashes.shape[1]):
            lash = lashes[i, s]
            reach = reach_of(lash)
            middle = lash[len(lash) // 2]
            for k in range(len(starts)):
                length, along, size = 0.0, 0.0, 0.0
                for c in range(3):
                    way[c] = starts[k, c] - points[i, k, c]
                    to_middle = middle[c] - points[i, k, c]
                    length += way[c] * way[c]
                    along += way[c] * to_middle
                    size += to_middle * to_middle
                # The squared distance of the lash's middle from the pencil's axis is NaN for no lash or no point.
                if size - along * along / length < (reach + near_mm[i, k] + far_mm[k]) ** 2:
                    out[i, k] *= 1.0 - covered(lash, points[i, k], way, length, near_mm[i, k], far_mm[k])


@inlined
def reach_of(lash: Floats) -> float:
    """Compute the radius of a ball about the middle point of a lash (p, 4) that holds it."""
    most, middle = 0.0, lash[len(lash) // 2]
    for point in lash:
        size = (point[0] - middle[0]) ** 2 + (point[1] - middle[1]) ** 2 + (point[2] - middle[2]) ** 2
        most = max(most, size)
    return np.sqrt(most) + lash[0, 3]  # type: ignore[no-any-return]


@inlined
def covered(lash: Floats, point: Floats, way: Floats, length: float, near_mm: float, far_mm: float) -> float:
    """Compute the share that a lash (p, 4) covers of the pencil from a point along a way of squared length."""
    most, w, u = 0.0, np.empty(3), np.empty(3)
    for j in range(len(lash) - 1):
        uu, ud, uw, dw = 0.0, 0.0, 0.0, 0.0
        for c in range(3):
            u[c], w[c] = lash[j + 1, c] - lash[j, c], lash[j, c] - point[c]
            uu, ud, uw, dw = uu + u[c] * u[c], ud + u[c] * way[c], uw + u[c] * w[c], dw + way[c] * w[c]
        across = uu * length - ud * ud
        q = min(max((ud * dw - length * uw) / across, 0.0), 1.0) if across > 0.0 else 0.0
        t = (dw + q * ud) / length  # places along piece and way where they are nearest to each other
        if 0.0 < t < 1.0:
            size = 0.0
            for c in range(3):
                size += (w[c] + q * u[c] - t * way[c]) ** 2
            half = _WIDTH * (lash[j, 3] + q * (lash[j + 1, 3] - lash[j, 3]))
            disc = max(near_mm * (1.0 - t) + far_mm * t, 1e-9)
            most = max(most, within((np.sqrt(size) + half) / disc) - within((np.sqrt(size) - half) / disc))
    return most


@inlined
def within(x: float) -> float:
    """Compute the share of a unit disc on the left of a line at x."""
    x = min(max(x, -1.0), 1.0)
    return 0.5 + (x * np.sqrt(1.0 - x * x) + np.arcsin(x)) / np.pi  # type: ignore[no-any-return]
