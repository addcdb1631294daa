"""Compiled loops for depth-dependent blur."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Ints, Singles
from ..base.jit import compiled

LANES = 8  # numbers added at once; rows of discs are padded with zeros to a multiple of it


@compiled()
def spread(pictures: Singles, index: Ints, discs: Singles, reaches: Ints, sums: Singles) -> None:
    """Spread every pixel of some images over the disc with its index, in place in `sums`.

    Args:
        pictures: (m, height, width).
        index: (height, width) index of each pixel's disc.
        discs: (n, rows, columns) kernels, each in the corner of its array.
        reaches: (n,) pixels from a disc's middle to its edge; the largest disc has as many rows as the array.
        sums: (m, height + rows - 1, width + columns), to which the discs are added. Pixel (0, 0) lies as far inside as
            the largest disc reaches.
    """
    border = discs.shape[1] // 2
    for p in range(pictures.shape[0]):
        for y in range(pictures.shape[1]):
            for x in range(pictures.shape[2]):
                value = pictures[p, y, x]
                if value == 0:
                    continue
                disc = index[y, x]
                reach = reaches[disc]
                # Unsigned: a signed index might count from the end, and the test of that prevents vector instructions.
                rows = np.uint64(2 * reach + 1)
                columns = np.uint64((2 * reach + LANES) // LANES * LANES)
                top, left = np.uint64(y + border - reach), np.uint64(x + border - reach)
                for i in range(rows):
                    for j in range(columns):
                        sums[p, top + i, left + j] += value * discs[disc, i, j]


@compiled()
def continue_nearest(values: Singles, steps: NDArray[np.int32]) -> None:
    """Fill unknown pixels, in place, with the nearest known value, counting steps along rows and columns.

    `steps` (height, width) is 0 where the value is known, elsewhere more than height + width.
    """
    height, width = values.shape
    for y in range(height):
        for x in range(width):
            if x > 0 and steps[y, x - 1] + 1 < steps[y, x]:
                steps[y, x], values[y, x] = steps[y, x - 1] + 1, values[y, x - 1]
            if y > 0 and steps[y - 1, x] + 1 < steps[y, x]:
                steps[y, x], values[y, x] = steps[y - 1, x] + 1, values[y - 1, x]
    for y in range(height - 1, -1, -1):
        for x in range(width - 1, -1, -1):
            if x < width - 1 and steps[y, x + 1] + 1 < steps[y, x]:
                steps[y, x], values[y, x] = steps[y, x + 1] + 1, values[y, x + 1]
            if y < height - 1 and steps[y + 1, x] + 1 < steps[y, x]:
                steps[y, x], values[y, x] = steps[y + 1, x] + 1, values[y + 1, x]
