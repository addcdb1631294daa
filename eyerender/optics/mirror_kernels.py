"""Mirror points, compiled: the path of stationary length over one surface, without a change of the index."""

from __future__ import annotations

import numpy as np

from ..arrays import Floats, Ints, Statuses
from ..geometry.graph_kernels import APEX, inlined, jet
from ..jit import compiled
from .fermat_kernels import (
    GUESS,
    LANES,
    LOST,
    OUTSIDE,
    ROWS,
    TYPES,
    Y,
    Z,
    axis_distance,
    leave,
    load,
    point_at,
    solve,
    store,
)


@inlined
def mirror_start(kinds, numbers, table, i, source, viewpoint):  # type: ignore[no-untyped-def]
    """First guess of a mirror point: where the bisector through the apex' centre of curvature meets the surface.

    It is exact on a sphere for source and viewpoint at infinity. The second result is whether the bisector points to
    the front.
    """
    y, z = numbers[i, 0, APEX], numbers[i, 0, APEX + 1]
    x, hy, hz, hyy, hyz, hzz = jet(kinds, numbers, table, i, 0, y, z)
    size = np.sqrt(1.0 + hy * hy + hz * hz)
    nx, ny, nz = 1.0 / size, -hy / size, -hz / size
    radius = 2.0 * size / (-hyy - hzz + ny * ny * hyy + 2.0 * ny * nz * hyz + nz * nz * hzz)
    cx, cy, cz = x - radius * nx, y - radius * ny, z - radius * nz
    ax, ay, az = source[0] - cx, source[1] - cy, source[2] - cz
    bx, by, bz = viewpoint[0] - cx, viewpoint[1] - cy, viewpoint[2] - cz
    a, b = 1.0 / np.sqrt(ax * ax + ay * ay + az * az), 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
    ax, ay, az = a * ax + b * bx, a * ay + b * by, a * az + b * bz
    reach = radius / np.sqrt(max(ax * ax + ay * ay + az * az, 1e-300))
    return (cx + reach * ax, cy + reach * ay, cz + reach * az), ax * nx + ay * ny + az * nz > 0.0


@compiled(TYPES)
def mirror_all(
    kinds: Ints,
    numbers: Floats,
    table: Floats,
    ladder: Floats,
    rims: Floats,
    viewpoint: Floats,
    source: Floats,
    out: Floats,
    state: Statuses,
) -> None:
    """Find the rays from viewpoints to sources that a surface reflects at its outside, as `refract_all` does."""
    nodes = np.zeros((3, ROWS, LANES))
    count, columns = state.size, max(state.shape[1], 1)
    for first in range(0, count, LANES):
        load(numbers, ladder, viewpoint, source, first, count, columns, nodes)
        for lane in range(LANES):
            i, k = divmod(min(first + lane, count - 1), columns)
            row, rim = min(i, len(numbers) - 1), rims[min(i, len(rims) - 1)]
            guess, ahead = mirror_start(kinds, numbers, table, row, point_at(source, i, k), point_at(viewpoint, i, k))
            nodes[1, Y, lane], nodes[1, Z, lane] = guess[1], guess[2]
            for c in range(3):
                out[GUESS + c, i, k] = guess[c]
            # A guess so far outside the rim means that the point cannot be on the surface.
            away = not ahead or axis_distance(numbers, row, guess[0], guess[1], guess[2]) > 1.25 * rim
            state[i, k] = OUTSIDE if rim < np.inf and away else LOST
        solve(kinds, numbers, table, first, count, columns, nodes)
        leave(nodes, True)
        store(numbers, rims, True, first, columns, nodes, out, state)
