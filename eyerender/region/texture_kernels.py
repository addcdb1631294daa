"""Compiled growth of vessels."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats
from ..base.jit import compiled, inlined

X, Y, COSINE, SINE, WEIGHT, LEFT, STEPS, LEVEL, COLUMNS = range(9)
"""Columns of a vessel's tip: place (pixels), direction, weight, steps left and in total, and order of branching."""


@compiled()
def prune(tips: Floats, draws: Floats, limbus: float, size: int) -> int:
    """Move the tips (n, COLUMNS) that still grow to the front, in their order, and return their number.

    `draws`: (n,) random numbers from 0 to 1; `limbus`: radius of the limbus, pixels; `size`: side of the map, with the
    limbus in its middle.
    """
    count, half = 0, size / 2
    for k in range(len(tips)):
        x, y = tips[k, X], tips[k, Y]
        inside = min(x, y) > 1 and max(x, y) < size - 2
        away, end = np.sqrt((x - half) ** 2 + (y - half) ** 2), limbus * (1.05 + 0.65 * draws[k])
        if inside and away >= end and tips[k, LEFT] > 0:
            for column in range(COLUMNS):
                tips[count, column] = tips[k, column]
            count += 1
    return count


@compiled()
def grow(tips: Floats, draws: Floats, layers: Floats) -> None:
    """Move tips (n, COLUMNS) by a step, and add their weights to the layers (3, size, size) of their levels.

    `draws`: (n,) random numbers of variance 1; `layers`: maps of the vessels, the widest first.
    """
    half = layers.shape[1] / 2
    for k in range(len(tips)):
        tip = tips[k]
        x, y = half - tip[X], half - tip[Y]
        # Vessels turn slowly towards the middle.
        _turn(tip, 0.16 * draws[k] + 0.02 * (y * tip[COSINE] - x * tip[SINE]) / np.sqrt(x * x + y * y))
        tip[X] += 0.8 * tip[COSINE]
        tip[Y] += 0.8 * tip[SINE]
        layers[min(int(tip[LEVEL]), 2), int(tip[Y]), int(tip[X])] += tip[WEIGHT]
        tip[WEIGHT] *= 0.9985
        tip[LEFT] -= 1


@compiled()
def fork(branches: Floats, bends: Floats) -> None:
    """Turn copies of tips (n, COLUMNS) into branches, at angles (n,) rad to them."""
    for k in range(len(branches)):
        branch = branches[k]
        _turn(branch, bends[k])
        branch[WEIGHT] *= 0.7
        branch[STEPS] //= 2
        branch[LEFT] = branch[STEPS]
        branch[LEVEL] += 1


@inlined
def _turn(tip: Floats, angle: float) -> None:
    c, s = np.cos(angle), np.sin(angle)
    tip[COSINE], tip[SINE] = c * tip[COSINE] - s * tip[SINE], s * tip[COSINE] + c * tip[SINE]
