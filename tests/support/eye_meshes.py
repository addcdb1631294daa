"""An independent check of an eye's meshes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np


def crossing(eye, meshes, tolerance_mm=1e-6):
    """Names of refracting patches that intersect the next surface outside them; empty for a valid eye."""
    eye = eye.shelled()
    order = [("cornea_front", eye.front[0])]
    if len(eye.front) > 1:
        order.append(("cornea_back", eye.front[-1]))
    order += [("lens_front" if k == 0 else f"lens_shell_{k}_front", eye.back[k]) for k in range(len(eye.back) // 2)]
    bad = []
    for (_, outer), (name, _) in pairwise(order):
        if np.any(outer.implicit(meshes.patches[name].vertices) > tolerance_mm):
            bad.append(name)
    return bad
