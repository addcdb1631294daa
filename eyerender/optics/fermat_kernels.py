"""Compiled solver of the two-point problem by Fermat's principle: stationary optical length across graphs of surfaces.

A path from a viewpoint X_0 over the points X_i = (h_i(y_i, z_i), y_i, z_i) of m surfaces to an object X_{m+1} has the
optical length S = sum_j n_j |X_{j+1} - X_j|. It is a ray where dS = 0. With e_j the unit vectors along the segments,
the tangents t_y = (h_y, 1, 0), t_z = (h_z, 0, 1), q_i = n_{i-1} e_{i-1} - n_i e_i and the projection A_j = (1 - e_j
e_j^T) n_j / L_j,

    gradient            G_i = t_i . q_i
    Hessian, diagonal   t_i.(A_{i-1} + A_i) t_i + (q_i)_x h_i''
    Hessian, next       -t_i . A_i t_{i+1}

(Born & Wolf 1999, 3.3.2; the Hessian is that of Walter et al. 2009, "Single scattering in refractive media with
triangle mesh boundaries", eq. 6, for any number of surfaces.) Newton needs no intersections, so a biconic costs as much
as a sphere. A mirror point is the same problem with m = 1, equal indices and the object outside. This solver is fast
and serves almost all rays; `shooting` is slower and more robust, and solves the rest.

Rays are solved `LANES` at a time, so that the loops over them become vector instructions. `nodes` (m + 2, ROWS, LANES)
holds the viewpoints, the points on each surface outside in and the targets, with everything known at each.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats, Ints, Statuses
from ..base.jit import compiled
from ..base.status import Status
from .graph_kernels import APEX, AXIS, LEAN, ORIGIN, SMOOTH, helper, inlined, measured_jet, merged, smooth_jet

STEPS = 6
SETTLED_MM = 2e-6
"""Newton is quadratic here, an error e leaves 0.1 to 0.5 e^2: after a last step this small it is some 1e-12 mm."""
SURE_MM = 1e-11
"""Largest miss (mm) of the traced ray at which a path counts as found; rounding stays well below."""
RESIDUAL_LIMIT_MM = 1e-9
"""Largest miss (mm) of any solution."""
FAR_MM = 1000.0
"""For an end farther than this (mm) from the last surface, the miss is measured at this distance.

One rounding of the direction moves a ray by 1e-7 mm at 1e9 mm. What counts is the direction: a residual of 1e-9 mm
is 1e-12 rad for every end that is farther, up to infinity.
"""
EXIT, WAY, END, RESIDUAL, GUESS, RESULTS = 0, 3, 6, 9, 10, 13
"""Rows of a result: the point on the outermost surface, the direction to it from the viewpoint, the direction in the
last medium, the miss of the traced ray (mm), and the first guess of a mirror point.
"""
FOUND, OUTSIDE, LOST = int(Status.OK), int(Status.OUTSIDE_LIMBUS), int(Status.NOT_CONVERGED)
"""Statuses of a ray: found, beyond the rim of the outermost surface, and not found (yet)."""
LANES = 32
COLUMNS = LEAN + 2
X, Y, Z, SLOPE_Y, SLOPE_Z, YY, YZ, ZZ = range(8)
"""Rows of a node: its point, slopes and second derivatives of its surface;"""
INDEX, D_X, D_Y, D_Z, WEIGHT = range(8, 13)
"""the index behind it, the unit direction to the next node and n / L;"""
H_YY, H_YZ, H_ZZ, G_Y, G_Z, C_YY, C_YZ, C_ZY, C_ZZ, K_YY, K_YZ, K_ZY, K_ZZ, STEP_Y, STEP_Z = range(13, 28)
"""its block of the system, the coupling C with the next node, K = B^-1 C, and Newton's step;"""
P_X, P_Y, P_Z, W_X, W_Y, W_Z, T, ON = range(28, 36)
"""the traced point and the direction behind it, the distance from the traced point before, and 1 for a ray that got
here; and a copy of the columns of its surface.
"""
COPY = 36
ROWS = COPY + COLUMNS


@inlined
def point_at(points, i, k):  # type: ignore[no-untyped-def]
    """Return point k of row i of points (3, 1 or n, 1 or m)."""
    row, column = min(i, points.shape[1] - 1), min(k, points.shape[2] - 1)
    return points[0, row, column], points[1, row, column], points[2, row, column]


@merged
def load(numbers, ladder, viewpoint, target, first, count, columns, nodes):  # type: ignore[no-untyped-def]
    """Set up the nodes of rays `first` and following, of which there are `count` in rows of `columns`."""
    last = nodes.shape[0] - 1
    for lane in range(LANES):
        i, k = divmod(min(first + lane, count - 1), columns)
        outer, inner = point_at(viewpoint, i, k), point_at(target, i, k)
        for c in range(3):
            nodes[0, X + c, lane], nodes[last, X + c, lane] = outer[c], inner[c]
        # One eye's columns are the same for all rays.
        if first == 0 or len(ladder) > 1:
            for j in range(last):
                nodes[j, INDEX, lane] = ladder[min(i, len(ladder) - 1), j]
        if first == 0 or len(numbers) > 1:
            for j in range(1, last):
                for c in range(COLUMNS):
                    nodes[j, COPY + c, lane] = numbers[min(i, len(numbers) - 1), j - 1, c]


@helper
def blend_measured(kind, numbers, table, j, first, count, columns, w):  # type: ignore[no-untyped-def]
    """Blend the measured surface of a node w (ROWS, LANES) into its outer biconic, which was evaluated before."""
    for lane in range(LANES):
        i = min(min(first + lane, count - 1) // columns, len(numbers) - 1)
        outer = (w[X, lane], w[SLOPE_Y, lane], w[SLOPE_Z, lane], w[YY, lane], w[YZ, lane], w[ZZ, lane])
        found = measured_jet(kind, numbers, table, i, j - 1, w[Y, lane], w[Z, lane], outer)
        w[X, lane], w[SLOPE_Y, lane], w[SLOPE_Z, lane] = found[0], found[1], found[2]
        w[YY, lane], w[YZ, lane], w[ZZ, lane] = found[3], found[4], found[5]


@inlined
def evaluate(kinds, numbers, table, j, first, count, columns, nodes):  # type: ignore[no-untyped-def]
    """Compute height, slopes and second derivatives at the (y, z) of node j."""
    w = nodes[j]
    for lane in range(LANES):
        found = smooth_jet(w[COPY:, lane], w[Y, lane], w[Z, lane])
        w[X, lane], w[SLOPE_Y, lane], w[SLOPE_Z, lane] = found[0], found[1], found[2]
        w[YY, lane], w[YZ, lane], w[ZZ, lane] = found[3], found[4], found[5]
    if kinds[j - 1] != SMOOTH:
        blend_measured(kinds[j - 1], numbers, table, j, first, count, columns, w)


@merged
def paraxial_start(kinds, numbers, table, first, count, columns, nodes):  # type: ignore[no-untyped-def]
    """Guess the start (y, z) on each surface by paraxial optics.

    On the outermost surface the guess is the straight line's point, moved by m = 1 / (1 - d (n - 1) / (n R)) away from
    the line through the viewpoint and the centre of curvature, which is not refracted; d is the object's depth, n its
    index. On the other surfaces it is on the straight line from there to the object.
    """
    last = nodes.shape[0] - 1
    start, seen, end = nodes[1], nodes[0], nodes[last]
    for lane in range(LANES):
        start[Y, lane], start[Z, lane] = 0.0, 0.0
    for turn in range(3):
        for j in range(1, 2):
            evaluate(kinds, numbers, table, j, first, count, columns, nodes)
        if turn == 0:
            for lane in range(LANES):
                # At the axis; the rows of the traced ray are unused until then.
                start[P_X, lane], start[T, lane] = start[X, lane], -1.0 / start[YY, lane]
                start[Y, lane], start[Z, lane] = end[Y, lane], end[Z, lane]
            continue
        for lane in range(LANES):
            apex, radius = start[P_X, lane], start[T, lane]
            centre = apex - radius
            n = nodes[last - 1, INDEX, lane] / seen[INDEX, lane]
            x = start[X, lane]
            x = x if np.isfinite(x) else apex
            depth = x - end[X, lane]
            draw = 1.0 / (1.0 - depth * (n - 1.0) / (n * radius))
            share = depth / (seen[X, lane] - end[X, lane])
            # y = (1 - draw) y_line + draw (y_t + share (y_v - y_t)), gathered.
            far = (1.0 - draw) * (x - centre) / (seen[X, lane] - centre) + draw * share
            near = draw - draw * share
            start[Y, lane] = far * seen[Y, lane] + near * end[Y, lane]
            start[Z, lane] = far * seen[Z, lane] + near * end[Z, lane]
            start[X, lane] = x
    for j in range(2, last):
        w = nodes[j]
        for lane in range(LANES):
            w[Y, lane], w[Z, lane] = start[Y, lane], start[Z, lane]
        evaluate(kinds, numbers, table, j, first, count, columns, nodes)
        for lane in range(LANES):
            part = (start[X, lane] - w[X, lane]) / (start[X, lane] - end[X, lane])
            part = part if np.isfinite(part) else 0.0
            w[Y, lane] = start[Y, lane] + part * (end[Y, lane] - start[Y, lane])
            w[Z, lane] = start[Z, lane] + part * (end[Z, lane] - start[Z, lane])


@inlined
def aim(nodes, j):  # type: ignore[no-untyped-def]
    """Compute direction and weight of the segment from node j to the next."""
    for lane in range(LANES):
        dx = nodes[j + 1, X, lane] - nodes[j, X, lane]
        dy = nodes[j + 1, Y, lane] - nodes[j, Y, lane]
        dz = nodes[j + 1, Z, lane] - nodes[j, Z, lane]
        inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        nodes[j, D_X, lane], nodes[j, D_Y, lane], nodes[j, D_Z, lane] = dx * inverse, dy * inverse, dz * inverse
        nodes[j, WEIGHT, lane] = nodes[j, INDEX, lane] * inverse


@inlined
def block(nodes, j):  # type: ignore[no-untyped-def]
    """Compute gradient and Hessian of the optical length by (y, z) of node j, with the node before eliminated."""
    for lane in range(LANES):
        hy, hz = nodes[j, SLOPE_Y, lane], nodes[j, SLOPE_Z, lane]
        n, m = nodes[j - 1, INDEX, lane], nodes[j, INDEX, lane]
        u, v = nodes[j - 1, WEIGHT, lane], nodes[j, WEIGHT, lane]
        ty = hy * nodes[j - 1, D_X, lane] + nodes[j - 1, D_Y, lane]
        tz = hz * nodes[j - 1, D_X, lane] + nodes[j - 1, D_Z, lane]
        sy = hy * nodes[j, D_X, lane] + nodes[j, D_Y, lane]
        sz = hz * nodes[j, D_X, lane] + nodes[j, D_Z, lane]
        bend = n * nodes[j - 1, D_X, lane] - m * nodes[j, D_X, lane]
        nodes[j, G_Y, lane], nodes[j, G_Z, lane] = n * ty - m * sy, n * tz - m * sz
        nodes[j, H_YY, lane] = (u + v) * (1.0 + hy * hy) - u * ty * ty - v * sy * sy + bend * nodes[j, YY, lane]
        nodes[j, H_YZ, lane] = (u + v) * (hy * hz) - u * ty * tz - v * sy * sz + bend * nodes[j, YZ, lane]
        nodes[j, H_ZZ, lane] = (u + v) * (1.0 + hz * hz) - u * tz * tz - v * sz * sz + bend * nodes[j, ZZ, lane]
    if j > 1:
        for lane in range(LANES):
            c_yy, c_yz = nodes[j - 1, C_YY, lane], nodes[j - 1, C_YZ, lane]
            c_zy, c_zz = nodes[j - 1, C_ZY, lane], nodes[j - 1, C_ZZ, lane]
            k_yy, k_yz = nodes[j - 1, K_YY, lane], nodes[j - 1, K_YZ, lane]
            k_zy, k_zz = nodes[j - 1, K_ZY, lane], nodes[j - 1, K_ZZ, lane]
            g_y, g_z = nodes[j - 1, G_Y, lane], nodes[j - 1, G_Z, lane]
            nodes[j, H_YY, lane] -= c_yy * k_yy + c_zy * k_zy
            nodes[j, H_YZ, lane] -= c_yy * k_yz + c_zy * k_zz
            nodes[j, H_ZZ, lane] -= c_yz * k_yz + c_zz * k_zz
            nodes[j, G_Y, lane] -= k_yy * g_y + k_zy * g_z
            nodes[j, G_Z, lane] -= k_yz * g_y + k_zz * g_z


@inlined
def couple(nodes, j):  # type: ignore[no-untyped-def]
    """Compute the coupling C of node j with the next one, and K = B^-1 C."""
    for lane in range(LANES):
        v = nodes[j, WEIGHT, lane]
        dx, dy, dz = nodes[j, D_X, lane], nodes[j, D_Y, lane], nodes[j, D_Z, lane]
        hy, hz = nodes[j, SLOPE_Y, lane], nodes[j, SLOPE_Z, lane]
        iy, iz = nodes[j + 1, SLOPE_Y, lane], nodes[j + 1, SLOPE_Z, lane]
        sy, sz, ty, tz = hy * dx + dy, hz * dx + dz, iy * dx + dy, iz * dx + dz
        c_yy, c_yz = v * (ty * sy - hy * iy - 1.0), v * (tz * sy - hy * iz)
        c_zy, c_zz = v * (ty * sz - hz * iy), v * (tz * sz - hz * iz - 1.0)
        yy, yz, zz = nodes[j, H_YY, lane], nodes[j, H_YZ, lane], nodes[j, H_ZZ, lane]
        scale = 1.0 / (yy * zz - yz * yz)
        nodes[j, C_YY, lane], nodes[j, C_YZ, lane] = c_yy, c_yz
        nodes[j, C_ZY, lane], nodes[j, C_ZZ, lane] = c_zy, c_zz
        nodes[j, K_YY, lane], nodes[j, K_YZ, lane] = (zz * c_yy - yz * c_zy) * scale, (zz * c_yz - yz * c_zz) * scale
        nodes[j, K_ZY, lane], nodes[j, K_ZZ, lane] = (yy * c_zy - yz * c_yy) * scale, (yy * c_zz - yz * c_yz) * scale


@inlined
def step(nodes, j, innermost):  # type: ignore[no-untyped-def]
    """Move node j by Newton's step; return the number of lanes that have not converged."""
    for lane in range(LANES):
        yy, yz, zz = nodes[j, H_YY, lane], nodes[j, H_YZ, lane], nodes[j, H_ZZ, lane]
        y, z = nodes[j, G_Y, lane], nodes[j, G_Z, lane]
        scale = 1.0 / (yy * zz - yz * yz)
        nodes[j, STEP_Y, lane], nodes[j, STEP_Z, lane] = (zz * y - yz * z) * scale, (yy * z - yz * y) * scale
    if not innermost:
        for lane in range(LANES):
            y, z = nodes[j + 1, STEP_Y, lane], nodes[j + 1, STEP_Z, lane]
            nodes[j, STEP_Y, lane] -= nodes[j, K_YY, lane] * y + nodes[j, K_YZ, lane] * z
            nodes[j, STEP_Z, lane] -= nodes[j, K_ZY, lane] * y + nodes[j, K_ZZ, lane] * z
    moving = 0
    for lane in range(LANES):
        nodes[j, Y, lane] -= nodes[j, STEP_Y, lane]
        nodes[j, Z, lane] -= nodes[j, STEP_Z, lane]
        if abs(nodes[j, STEP_Y, lane]) > SETTLED_MM or abs(nodes[j, STEP_Z, lane]) > SETTLED_MM:
            moving += 1
    return moving


@merged
def solve(kinds, numbers, table, first, count, columns, nodes):  # type: ignore[no-untyped-def]
    """Run Newton on all surfaces: eliminate the block-tridiagonal system inwards and solve it outwards."""
    last = nodes.shape[0] - 1
    moving = LANES
    for turn in range(STEPS + 1):
        for j in range(1, last):
            evaluate(kinds, numbers, table, j, first, count, columns, nodes)
        if turn == STEPS or (turn > 1 and moving == 0):
            break
        for j in range(last):
            aim(nodes, j)
            if j > 0:
                block(nodes, j)
                if j < last - 1:
                    couple(nodes, j)
        moving = 0
        for j in range(last - 1, 0, -1):
            moving += step(nodes, j, j == last - 1)


@inlined
def bend(nodes, j, reflects):  # type: ignore[no-untyped-def]
    """Refract (see `interface.refract`) or reflect the traced ray on node j, if it comes from the front and passes."""
    for lane in range(LANES):
        hy, hz = nodes[j, SLOPE_Y, lane], nodes[j, SLOPE_Z, lane]
        scale = 1.0 / np.sqrt(1.0 + hy * hy + hz * hz)
        nx, ny, nz = scale, -hy * scale, -hz * scale
        wx, wy, wz = nodes[j - 1, W_X, lane], nodes[j - 1, W_Y, lane], nodes[j - 1, W_Z, lane]
        cosine = -(wx * nx + wy * ny + wz * nz)
        eta = nodes[j - 1, INDEX, lane] / nodes[j, INDEX, lane]
        square = 1.0 - eta * eta * (1.0 - cosine * cosine)
        factor = 2.0 * cosine if reflects else eta * cosine - np.sqrt(max(square, 0.0))
        eta = 1.0 if reflects else eta
        nodes[j, W_X, lane], nodes[j, W_Y, lane], nodes[j, W_Z, lane] = (
            eta * wx + factor * nx, eta * wy + factor * ny, eta * wz + factor * nz
        )  # fmt: skip
        nodes[j, ON, lane] = nodes[j - 1, ON, lane] if cosine > 0.0 and (reflects or square > 0.0) else 0.0


@merged
def trace(kinds, numbers, table, reflects, first, count, columns, nodes):  # type: ignore[no-untyped-def]
    """Trace the ray that leaves the viewpoint for the outermost surface through all others.

    Each hit is solved by Newton's method from the path's point.
    """
    for lane in range(LANES):
        dx = nodes[1, X, lane] - nodes[0, X, lane]
        dy = nodes[1, Y, lane] - nodes[0, Y, lane]
        dz = nodes[1, Z, lane] - nodes[0, Z, lane]
        inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        nodes[0, W_X, lane], nodes[0, W_Y, lane], nodes[0, W_Z, lane] = dx * inverse, dy * inverse, dz * inverse
        nodes[1, P_X, lane], nodes[1, P_Y, lane], nodes[1, P_Z, lane] = (
            nodes[1, X, lane], nodes[1, Y, lane], nodes[1, Z, lane]
        )  # fmt: skip
        nodes[0, ON, lane] = 1.0
    for j in range(1, nodes.shape[0] - 1):
        if j > 1:
            meet(kinds, numbers, table, j, first, count, columns, nodes)
        bend(nodes, j, reflects)
        for lane in range(LANES):
            if not abs(nodes[j, P_X, lane] - nodes[j, X, lane]) < SURE_MM:
                nodes[j, ON, lane] = 0.0


@merged
def meet(kinds, numbers, table, j, first, count, columns, nodes):  # type: ignore[no-untyped-def]
    """Move the traced ray from the previous node to the surface of node j."""
    for lane in range(LANES):
        nodes[j, T, lane] = (
            (nodes[j, X, lane] - nodes[j - 1, P_X, lane]) * nodes[j - 1, W_X, lane]
            + (nodes[j, Y, lane] - nodes[j - 1, P_Y, lane]) * nodes[j - 1, W_Y, lane]
            + (nodes[j, Z, lane] - nodes[j - 1, P_Z, lane]) * nodes[j - 1, W_Z, lane]
        )
    for _ in range(2):
        for lane in range(LANES):
            t = nodes[j, T, lane]
            nodes[j, P_X, lane] = nodes[j - 1, P_X, lane] + t * nodes[j - 1, W_X, lane]
            nodes[j, Y, lane] = nodes[j - 1, P_Y, lane] + t * nodes[j - 1, W_Y, lane]
            nodes[j, Z, lane] = nodes[j - 1, P_Z, lane] + t * nodes[j - 1, W_Z, lane]
        evaluate(kinds, numbers, table, j, first, count, columns, nodes)
        for lane in range(LANES):
            error = nodes[j, P_X, lane] - nodes[j, X, lane]
            rate = (
                nodes[j - 1, W_X, lane]
                - nodes[j, SLOPE_Y, lane] * nodes[j - 1, W_Y, lane]
                - nodes[j, SLOPE_Z, lane] * nodes[j - 1, W_Z, lane]
            )
            nodes[j, T, lane] -= error / rate
            nodes[j, P_Y, lane], nodes[j, P_Z, lane] = nodes[j, Y, lane], nodes[j, Z, lane]


@inlined
def axis_distance(numbers, i, x, y, z):  # type: ignore[no-untyped-def]
    """Compute the distance of a point from the axis of the outermost surface."""
    x, y, z = x - numbers[i, 0, ORIGIN], y - numbers[i, 0, ORIGIN + 1], z - numbers[i, 0, ORIGIN + 2]
    along = x * numbers[i, 0, AXIS] + y * numbers[i, 0, AXIS + 1] + z * numbers[i, 0, AXIS + 2]
    return np.sqrt(max(x * x + y * y + z * z - along * along, 0.0))


@merged
def store(numbers, rims, reflects, first, columns, nodes, out, state):  # type: ignore[no-untyped-def]
    """Write the rays and their statuses, from the miss of the traced ray at its target."""
    last = nodes.shape[0] - 1
    for lane in range(min(LANES, state.size - first)):
        i, k = divmod(first + lane, columns)
        gap = 0.0
        along = 0.0
        for c in range(3):
            out[EXIT + c, i, k], out[WAY + c, i, k] = nodes[1, X + c, lane], nodes[0, W_X + c, lane]
            out[END + c, i, k] = nodes[last - 1, W_X + c, lane]
            along += (nodes[last, X + c, lane] - nodes[last - 1, P_X + c, lane]) * nodes[last - 1, W_X + c, lane]
        for c in range(3):
            off = nodes[last, X + c, lane] - nodes[last - 1, P_X + c, lane] - along * nodes[last - 1, W_X + c, lane]
            gap += off * off
        residual, reach = np.sqrt(gap), SURE_MM
        if reflects:
            residual *= FAR_MM / max(along, FAR_MM)
            # A distant source magnifies Newton's remaining error of the mirror point.
            reach = min(SURE_MM + 1e-15 * along * along, RESIDUAL_LIMIT_MM)
        out[RESIDUAL, i, k] = residual
        row, rim = min(i, len(numbers) - 1), rims[min(i, len(rims) - 1)]
        if nodes[last - 1, ON, lane] > 0.0 and residual <= reach and along > 0.0:
            beyond = axis_distance(numbers, row, nodes[1, X, lane], nodes[1, Y, lane], nodes[1, Z, lane]) > rim
            state[i, k] = OUTSIDE if beyond else FOUND
        elif state[i, k] != OUTSIDE:
            state[i, k] = LOST


@merged
def mirror_start(kinds, numbers, table, rims, first, count, columns, nodes, out, state):  # type: ignore[no-untyped-def]
    """Guess mirror points: where the bisectors through the centre of curvature of the apex meet the surface.

    The guesses are exact on a sphere for source and viewpoint at infinity. A ray is marked OUTSIDE if its guess is far
    outside the rim, or its bisector does not point to the front, because then the surface has no mirror point.
    """
    last = nodes.shape[0] - 1
    w = nodes[1]
    for lane in range(LANES):
        row = min(min(first + lane, count - 1) // columns, len(numbers) - 1)
        w[Y, lane], w[Z, lane] = numbers[row, 0, APEX], numbers[row, 0, APEX + 1]
    for j in range(1, last):
        evaluate(kinds, numbers, table, j, first, count, columns, nodes)
    for lane in range(LANES):
        i, k = divmod(min(first + lane, count - 1), columns)
        row, rim = min(i, len(numbers) - 1), rims[min(i, len(rims) - 1)]
        hy, hz = w[SLOPE_Y, lane], w[SLOPE_Z, lane]
        size = np.sqrt(1.0 + hy * hy + hz * hz)
        nx, ny, nz = 1.0 / size, -hy / size, -hz / size
        bent = -w[YY, lane] - w[ZZ, lane] + ny * ny * w[YY, lane] + 2.0 * ny * nz * w[YZ, lane] + nz * nz * w[ZZ, lane]
        radius = 2.0 * size / bent
        cx, cy, cz = w[X, lane] - radius * nx, w[Y, lane] - radius * ny, w[Z, lane] - radius * nz
        ax, ay, az = nodes[last, X, lane] - cx, nodes[last, Y, lane] - cy, nodes[last, Z, lane] - cz
        bx, by, bz = nodes[0, X, lane] - cx, nodes[0, Y, lane] - cy, nodes[0, Z, lane] - cz
        a, b = 1.0 / np.sqrt(ax * ax + ay * ay + az * az), 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
        ax, ay, az = a * ax + b * bx, a * ay + b * by, a * az + b * bz
        reach = radius / np.sqrt(max(ax * ax + ay * ay + az * az, 1e-300))
        x, y, z = cx + reach * ax, cy + reach * ay, cz + reach * az
        w[Y, lane], w[Z, lane] = y, z
        out[GUESS, i, k], out[GUESS + 1, i, k], out[GUESS + 2, i, k] = x, y, z
        away = not ax * nx + ay * ny + az * nz > 0.0 or axis_distance(numbers, row, x, y, z) > 1.25 * rim
        state[i, k] = OUTSIDE if rim < np.inf and away else LOST


@compiled("i8[::1], f8[:,:,::1], f8[::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:,::1], b1, f8[:,:,::1], i1[:,::1]")
def connect_all(
    kinds: Ints,
    numbers: Floats,
    table: Floats,
    ladder: Floats,
    rims: Floats,
    viewpoint: Floats,
    target: Floats,
    reflects: bool,
    out: Floats,
    state: Statuses,
) -> None:
    """Solve for the rays from viewpoints to targets, through all surfaces or reflected by one of them outside.

    Every path is traced from the viewpoint; a ray that misses the target by more than rounding is LOST.

    Args:
        kinds: kinds of the surfaces, outside in.
        numbers: numbers of the surfaces.
        table: table of the surfaces.
        ladder: (1 or n, s + 1) index in front of the first surface, then that behind each.
        rims: (1 or n,) radius at which the outermost surface ends.
        viewpoint: (3, 1 or n, 1 or m) mm.
        target: (3, 1 or n, 1 or m) mm.
        reflects: whether the only surface reflects the rays.
        out: (RESULTS, n, m), written.
        state: (n, m), initially LOST, written.
    """
    nodes = np.zeros((len(kinds) + 2, ROWS, LANES))
    count, columns = state.size, max(state.shape[1], 1)
    for first in range(0, count, LANES):
        load(numbers, ladder, viewpoint, target, first, count, columns, nodes)
        if reflects:
            mirror_start(kinds, numbers, table, rims, first, count, columns, nodes, out, state)
        else:
            paraxial_start(kinds, numbers, table, first, count, columns, nodes)
        solve(kinds, numbers, table, first, count, columns, nodes)
        trace(kinds, numbers, table, reflects, first, count, columns, nodes)
        store(numbers, rims, reflects, first, columns, nodes, out, state)
