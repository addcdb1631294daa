"""Compiled test of which lashes cross the skin."""

from __future__ import annotations

from ..base.arrays import Bools, Floats, Ints
from ..base.jit import compiled


@compiled()
def crossed(points: Floats, columns: Ints, rows: Floats, out: Bools) -> None:
    """Find the curves that cross the triangles of a sheet in some of its columns.

    The sheet has two triangles between each two rows and columns; the last column joins the first. The test is that of
    Moeller and Trumbore.

    Args:
        points: (n, k, 3) points of the curves.
        columns: (n, c) columns of the sheet that may meet each curve.
        rows: (r, columns, 3) vertices of the sheet.
        out: (n,) whether a curve crosses the sheet.
    """
    count = rows.shape[1]
    for i in range(len(points)):
        for j in range(points.shape[1] - 1):
            ox, oy, oz = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            wx, wy, wz = points[i, j + 1, 0] - ox, points[i, j + 1, 1] - oy, points[i, j + 1, 2] - oz
            for c in range(columns.shape[1]):
                left = columns[i, c]
                right = left + 1 if left + 1 < count else 0
                for r in range(len(rows) - 1):
                    a, d = rows[r, left], rows[r + 1, right]
                    for half in range(2):
                        b = rows[r + 1, left] if half == 0 else rows[r, right]
                        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
                        vx, vy, vz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
                        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                        sx, sy, sz = ox - a[0], oy - a[1], oz - a[2]
                        start = sx * nx + sy * ny + sz * nz
                        end = start + wx * nx + wy * ny + wz * nz
                        if (start > 0) == (end > 0):
                            continue
                        det = start - end
                        mx, my, mz = sy * wz - sz * wy, sz * wx - sx * wz, sx * wy - sy * wx
                        u = (vx * mx + vy * my + vz * mz) / det
                        v = -(ux * mx + uy * my + uz * mz) / det
                        if u >= 0 and v >= 0 and u + v <= 1:
                            out[i] = True
