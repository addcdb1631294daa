"""Compiled loops over the texels of random textures."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats, Ints, Singles
from ..jit import compiled

BLOCK = 8  # texels along the side of a block that shares a list of nearby cells


@compiled()
def sample(tile: Singles, u: Singles, v: Singles, out: Singles) -> None:
    """Interpolate a tile linearly at positions in texels.

    Args:
        tile: values; rows lie along v. Two rows and columns more than positions reach.
        u: positions (k,), not negative.
        v: positions (k,), not negative.
        out: (k,) interpolated values.
    """
    for k in range(len(u)):
        left, top = np.int32(u[k]), np.int32(v[k])
        du, dv = u[k] - np.float32(left), v[k] - np.float32(top)
        # Signed indices might count from the end, and the test of that takes as long as the rest.
        column, row = np.uint64(left), np.uint64(top)
        right, below = column + np.uint64(1), row + np.uint64(1)
        upper = tile[row, column] + du * (tile[row, right] - tile[row, column])
        lower = tile[below, column] + du * (tile[below, right] - tile[below, column])
        out[k] = upper + dv * (lower - upper)


@compiled()
def nearest_two(seeds: Floats, near: Ints, x: Floats, y: Floats, distances: Singles, numbers: Ints) -> None:
    """Find the two nearest of the nearby seeds for every point.

    Args:
        seeds: (n, 2) positions (x, y).
        near: (h / BLOCK, w / BLOCK, c) numbers of the seeds near each block of points.
        x: (h, w) coordinates of the points.
        y: (h, w).
        distances: (2, h, w) distances to the nearest and the second nearest seed.
        numbers: (2, h, w) numbers of these seeds.
    """
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            first, second, one, two = np.inf, np.inf, 0, 0
            for seed in near[row // BLOCK, column // BLOCK]:
                dx, dy = x[row, column] - seeds[seed, 0], y[row, column] - seeds[seed, 1]
                square = dx * dx + dy * dy
                if square < first:
                    first, second, one, two = square, first, seed, one
                elif square < second:
                    second, two = square, seed
            distances[0, row, column], distances[1, row, column] = np.sqrt(first), np.sqrt(second)
            numbers[0, row, column], numbers[1, row, column] = one, two
