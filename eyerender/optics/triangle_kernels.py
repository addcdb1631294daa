"""Compiled search for triangles between two points, in a tree of boxes."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Bools, Floats
from ..base.jit import compiled

_DEEPEST = 64


@compiled("f8[:,:,::1], f8[:,:,::1], i8, f8[:,::1], f8[:,::1], f8, b1[::1]")
def meet_between(
    boxes: Floats, corners: Floats, leaf: int, start: Floats, end: Floats, margin_mm: float, out: Bools
) -> None:
    """Find whether any triangle lies between points, without `margin_mm` at both ends (Moeller and Trumbore 1997).

    Args:
        boxes: (k, 2, 3) lowest and highest corners of a complete binary tree's nodes: 2 i + 1 and 2 i + 2 are below i.
        corners: (m, 3, 3) corner and both edges from there of the triangles, in the order of the tree's leaves.
        leaf: number of triangles in each leaf.
        start: (n, 3); where a number is NaN, nothing is met.
        end: (n, 3).
        margin_mm: length left out at both ends.
        out: (n,), written.
    """
    first_leaf = len(boxes) // 2
    todo, inverse, d = np.empty(_DEEPEST, np.int64), np.empty(3), np.empty(3)
    for i in range(len(start)):
        out[i] = False
        length = 0.0
        for k in range(3):
            d[k] = end[i, k] - start[i, k]
            length += d[k] * d[k]
            inverse[k] = 1.0 / (d[k] if d[k] != 0.0 else 1e-300)
        if not length > 0.0:
            continue
        low = margin_mm / np.sqrt(length)
        todo[0], count = 0, 1
        while count > 0 and not out[i]:
            count -= 1
            node = todo[count]
            near, far = low, 1.0 - low
            for k in range(3):
                a = (boxes[node, 0, k] - start[i, k]) * inverse[k]
                b = (boxes[node, 1, k] - start[i, k]) * inverse[k]
                near, far = max(near, min(a, b)), min(far, max(a, b))
            if not near <= far:
                continue
            if node < first_leaf:
                todo[count], todo[count + 1] = 2 * node + 1, 2 * node + 2
                count += 2
                continue
            for row in range((node - first_leaf) * leaf, (node - first_leaf + 1) * leaf):
                p, q, r = corners[row, 0], corners[row, 1], corners[row, 2]
                c0, c1, c2 = d[1] * r[2] - d[2] * r[1], d[2] * r[0] - d[0] * r[2], d[0] * r[1] - d[1] * r[0]
                volume = q[0] * c0 + q[1] * c1 + q[2] * c2
                s0, s1, s2 = start[i, 0] - p[0], start[i, 1] - p[1], start[i, 2] - p[2]
                u = (s0 * c0 + s1 * c1 + s2 * c2) / volume
                e0, e1, e2 = s1 * q[2] - s2 * q[1], s2 * q[0] - s0 * q[2], s0 * q[1] - s1 * q[0]
                v = (d[0] * e0 + d[1] * e1 + d[2] * e2) / volume
                t = (r[0] * e0 + r[1] * e1 + r[2] * e2) / volume
                if u >= 0.0 and v >= 0.0 and u + v <= 1.0 and low <= t <= 1.0 - low:
                    out[i] = True
                    break
