"""Compiled loops over the texels of random textures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Ints, Singles
from ..base.jit import compiled

BLOCK = 8  # texels along the side of a block that shares a list of nearby cells
# Rows of a block: places, squares of the distances, and numbers of the cells.
_X, _Y, _FIRST, _SECOND, _ONE, _TWO = range(6)


@compiled()
def weigh(waves: Singles, up: Floats, across: Floats, below_up: Floats, below_across: Floats) -> None:
    """Multiply waves by the gain up * across * (1 - below_up * below_across).

    Args:
        waves: (h, 2 w) real and imaginary parts in turn.
        up: (h,) factors of the rows.
        across: (w,) factors of the columns.
        below_up: (h,).
        below_across: (w,).
    """
    for row in range(len(up)):
        for column in range(len(across)):
            gain = np.float32(up[row] * across[column] * (1 - below_up[row] * below_across[column]))
            waves[row, 2 * column] *= gain
            waves[row, 2 * column + 1] *= gain


@compiled()
def sample(tile: Singles, size: np.float32, u: Singles, v: Singles, out: Singles) -> None:
    """Interpolate a periodic tile linearly.

    Args:
        tile: values; rows lie along v, and two more rows and columns repeat the first ones.
        size: number of rows and columns without these.
        u: positions (k,) as shares of the period, 0 to 1.
        v: positions (k,), 0 to 1.
        out: (k,) interpolated values.
    """
    for k in range(len(u)):
        x, y = size * u[k], size * v[k]
        left, top = np.int32(x), np.int32(y)
        du, dv = x - np.float32(left), y - np.float32(top)
        # Signed indices might count from the end, and the test of that takes as long as the rest.
        column, row = np.uint64(left), np.uint64(top)
        right, below = column + np.uint64(1), row + np.uint64(1)
        upper = tile[row, column] + du * (tile[row, right] - tile[row, column])
        lower = tile[below, column] + du * (tile[below, right] - tile[below, column])
        out[k] = upper + dv * (lower - upper)


@compiled()
def shift(field: Singles, aside: Singles, out: Singles) -> None:
    """Sample the rows of a field linearly beside every place; the columns are periodic.

    Args:
        field: (h, w) values.
        aside: (h, w) distances to the right, columns; less than w.
        out: (h, w) interpolated values.
    """
    width = field.shape[1]
    for row in range(field.shape[0]):
        for column in range(width):
            place = np.float32(column) + aside[row, column]
            before = np.floor(place)
            left = int(before)
            if left < 0:
                left += width
            elif left >= width:
                left -= width
            right = left + 1 if left + 1 < width else 0
            out[row, column] = field[row, left] + (place - before) * (field[row, right] - field[row, left])


@compiled()
def nearest_two(seeds: Floats, near: Ints, x: Floats, y: Floats, lead: Singles, numbers: NDArray[np.int32]) -> None:
    """Find the two nearest of the nearby seeds for every point.

    Args:
        seeds: (n, 2) positions (x, y).
        near: (h / BLOCK, w / BLOCK, c) numbers of the seeds near each block of points.
        x: (h, w) coordinates of the points.
        y: (h, w).
        lead: (h, w) how much farther the second nearest seed is than the nearest.
        numbers: (2, h, w) numbers of these seeds.
    """
    # A seed is compared with all points of a block in vector instructions, which one array of one type allows.
    block = np.empty((6, BLOCK * BLOCK))
    for i in range(near.shape[0]):
        for j in range(near.shape[1]):
            for k in range(BLOCK * BLOCK):
                row, column = BLOCK * i + k // BLOCK, BLOCK * j + k % BLOCK
                block[_X, k], block[_Y, k] = x[row, column], y[row, column]
                block[_FIRST, k], block[_SECOND, k] = np.inf, np.inf
            for seed in near[i, j]:
                seed_x, seed_y, number = seeds[seed, 0], seeds[seed, 1], float(seed)
                for k in range(BLOCK * BLOCK):
                    dx, dy = block[_X, k] - seed_x, block[_Y, k] - seed_y
                    square = dx * dx + dy * dy
                    first, second, one, two = block[_FIRST, k], block[_SECOND, k], block[_ONE, k], block[_TWO, k]
                    block[_SECOND, k] = first if square < first else (square if square < second else second)
                    block[_TWO, k] = one if square < first else (number if square < second else two)
                    block[_FIRST, k] = square if square < first else first
                    block[_ONE, k] = number if square < first else one
            for k in range(BLOCK * BLOCK):
                row, column = BLOCK * i + k // BLOCK, BLOCK * j + k % BLOCK
                lead[row, column] = np.float32(np.sqrt(block[_SECOND, k])) - np.float32(np.sqrt(block[_FIRST, k]))
                numbers[0, row, column], numbers[1, row, column] = block[_ONE, k], block[_TWO, k]
