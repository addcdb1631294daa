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

Rays are solved `LANES` at a time, so that the loops over them become vector instructions.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ..base.arrays import Floats, Ints, Statuses
from ..base.jit import compiled
from ..base.status import Status
from .formula_kernels import COMPILED, helper, inlined, merged
from .formulas import Jet
from .graph_kernels import SHEET, SMOOTH, Sheet, Sheets, measured_jet, smooth_jet

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
FOUND, OUTSIDE, LOST = int(Status.OK), int(Status.OUTSIDE_LIMBUS), int(Status.NOT_CONVERGED)
AT_EDGE = int(Status.AT_LENS_EDGE)
"""Statuses of a ray: found, beyond the rim of the outermost surface, not found (yet), and outside an outline."""
LANES = 32
_FIELDS = (
    # point, slopes and second derivatives of its surface
    "x", "y", "z", "slope_y", "slope_z", "yy", "yz", "zz",
    # index behind the node, unit direction to the next node, and n / L
    "index", "d_x", "d_y", "d_z", "weight",
    # Newton's system: gradient G and Hessian H with the nodes before eliminated, coupling C with the next node,
    # K = H^-1 C, and the step
    "g_y", "g_z", "h_yy", "h_yz", "h_zz", "c_yy", "c_yz", "c_zy", "c_zz", "k_yy", "k_yz", "k_zy", "k_zz",
    "step_y", "step_z",
    # traced point, direction behind it, distance from the traced point before, and 1 for a ray that got here
    "p_x", "p_y", "p_z", "w_x", "w_y", "w_z", "far", "alive",
)  # fmt: skip
_SHEET = ("place", "numerator", "linear", "square")
NODE = np.dtype(
    [(name, np.float64, LANES) for name in _FIELDS]
    + [(name, np.float64, (*SHEET[name].shape, LANES)) for name in _SHEET]
)
"""A viewpoint, a point on a surface, or a target, of `LANES` rays, with everything known there, and the surface."""
Node: TypeAlias = Any
"""One record of the type `NODE`."""
Nodes: TypeAlias = npt.NDArray[np.void]
"""Nodes (m + 2,) of the type `NODE`: the viewpoints, the points on each surface outside in, and the targets."""
_refract, _reflect = COMPILED.refract, COMPILED.reflect


class Surfaces(NamedTuple):
    """Surfaces outside in, as in `graph_kernels`."""

    kinds: Ints
    sheets: Sheets
    table: Floats


class Batch(NamedTuple):
    """Rays `first` and following, of which there are `total` in rows of `columns`."""

    first: int
    total: int
    columns: int


@inlined
def row_of(batch: Batch, lane: int) -> tuple[int, int]:
    """Return row and column of the ray in a lane; surplus lanes repeat the last ray."""
    return divmod(min(batch.first + lane, batch.total - 1), batch.columns)


@inlined
def point_at(points: Floats, i: int, k: int) -> tuple[float, float, float]:
    """Return point k of row i of points (3, 1 or n, 1 or m)."""
    row, column = min(i, points.shape[1] - 1), min(k, points.shape[2] - 1)
    return points[0, row, column], points[1, row, column], points[2, row, column]


@merged
def load(surfaces: Surfaces, ladder: Floats, viewpoint: Floats, target: Floats, batch: Batch, nodes: Nodes) -> None:
    """Set up the nodes of rays."""
    last = len(nodes) - 1
    outer, inner, sheets = nodes[0], nodes[last], surfaces.sheets
    for lane in range(LANES):
        i, k = row_of(batch, lane)
        outer.x[lane], outer.y[lane], outer.z[lane] = point_at(viewpoint, i, k)
        inner.x[lane], inner.y[lane], inner.z[lane] = point_at(target, i, k)
        # One eye's surfaces are the same for all rays.
        if batch.first == 0 or len(ladder) > 1:
            for j in range(last):
                nodes[j].index[lane] = ladder[min(i, len(ladder) - 1), j]
        if batch.first == 0 or len(sheets) > 1:
            for j in range(1, last):
                node, sheet = nodes[j], sheets[min(i, len(sheets) - 1), j - 1]
                for c in range(3):
                    node.place[c, lane], node.linear[c, lane] = sheet.place[c], sheet.linear[c]
                for c in range(6):
                    node.numerator[c, lane], node.square[c, lane] = sheet.numerator[c], sheet.square[c]


@inlined
def put(node: Node, lane: int, h: Jet) -> None:
    """Store the height at a node."""
    node.x[lane], node.slope_y[lane], node.slope_z[lane] = h.x, h.y, h.z
    node.yy[lane], node.yz[lane], node.zz[lane] = h.yy, h.yz, h.zz


@helper
def blend_measured(surfaces: Surfaces, j: int, batch: Batch, node: Node) -> None:
    """Blend the measured surface of node j into its outer biconic, which was evaluated before."""
    for lane in range(LANES):
        i = min(row_of(batch, lane)[0], len(surfaces.sheets) - 1)
        outer = Jet(node.x[lane], node.slope_y[lane], node.slope_z[lane], node.yy[lane], node.yz[lane], node.zz[lane])
        sheet, kind = surfaces.sheets[i, j - 1], surfaces.kinds[j - 1]
        put(node, lane, measured_jet(kind, sheet, surfaces.table, node.y[lane], node.z[lane], outer))


@inlined
def evaluate(surfaces: Surfaces, j: int, batch: Batch, nodes: Nodes) -> None:
    """Compute height, slopes and second derivatives at the (y, z) of node j."""
    node = nodes[j]
    for lane in range(LANES):
        place, linear = node.place[:, lane], node.linear[:, lane]
        numerator, square = node.numerator[:, lane], node.square[:, lane]
        put(node, lane, smooth_jet(place, numerator, linear, square, node.y[lane], node.z[lane]))
    if surfaces.kinds[j - 1] != SMOOTH:
        blend_measured(surfaces, j, batch, node)


@merged
def paraxial_start(surfaces: Surfaces, rimmed: int, batch: Batch, nodes: Nodes) -> None:
    """Guess the start (y, z) on each surface by paraxial optics.

    On the rimmed surface (the cornea) the guess is the straight line's point, moved by m = 1 / (1 - d (n - 1) / (n R))
    away from the line through the viewpoint and the centre of curvature, which is not refracted; d is the object's
    depth, n its index. On the other surfaces it is on the straight lines from there to the object and to the viewpoint.
    """
    last = len(nodes) - 1
    start, seen, end = nodes[rimmed], nodes[0], nodes[last]
    for lane in range(LANES):
        start.y[lane], start.z[lane] = 0.0, 0.0
    for turn in range(3):
        for j in range(rimmed, rimmed + 1):
            evaluate(surfaces, j, batch, nodes)
        if turn == 0:
            for lane in range(LANES):
                # At the axis; the fields of the traced ray are unused until then.
                start.p_x[lane], start.far[lane] = start.x[lane], -1.0 / start.yy[lane]
                start.y[lane], start.z[lane] = end.y[lane], end.z[lane]
            continue
        for lane in range(LANES):
            apex, radius = start.p_x[lane], start.far[lane]
            centre = apex - radius
            n = nodes[last - 1].index[lane] / seen.index[lane]
            x = start.x[lane]
            x = x if np.isfinite(x) else apex
            depth = x - end.x[lane]
            draw = 1.0 / (1.0 - depth * (n - 1.0) / (n * radius))
            share = depth / (seen.x[lane] - end.x[lane])
            # y = (1 - draw) y_line + draw (y_t + share (y_v - y_t)), gathered.
            far = (1.0 - draw) * (x - centre) / (seen.x[lane] - centre) + draw * share
            near = draw - draw * share
            start.y[lane] = far * seen.y[lane] + near * end.y[lane]
            start.z[lane] = far * seen.z[lane] + near * end.z[lane]
            start.x[lane] = x
    straight_start(surfaces, rimmed, batch, nodes)


@merged
def straight_start(surfaces: Surfaces, rimmed: int, batch: Batch, nodes: Nodes) -> None:
    """Guess (y, z) on all other surfaces, on the straight lines from the guess on the rimmed one to both ends."""
    last = len(nodes) - 1
    start = nodes[rimmed]
    for j in range(1, last):
        if j == rimmed:
            continue
        node, end = nodes[j], nodes[last if j > rimmed else 0]
        for lane in range(LANES):
            node.y[lane], node.z[lane] = start.y[lane], start.z[lane]
        evaluate(surfaces, j, batch, nodes)
        for lane in range(LANES):
            part = (start.x[lane] - node.x[lane]) / (start.x[lane] - end.x[lane])
            part = part if np.isfinite(part) else 0.0
            node.y[lane] = start.y[lane] + part * (end.y[lane] - start.y[lane])
            node.z[lane] = start.z[lane] + part * (end.z[lane] - start.z[lane])


@inlined
def aim(node: Node, following: Node) -> None:
    """Compute direction and weight of the segment to the next node."""
    for lane in range(LANES):
        dx, dy = following.x[lane] - node.x[lane], following.y[lane] - node.y[lane]
        dz = following.z[lane] - node.z[lane]
        inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        node.d_x[lane], node.d_y[lane], node.d_z[lane] = dx * inverse, dy * inverse, dz * inverse
        node.weight[lane] = node.index[lane] * inverse


@inlined
def block(before: Node, node: Node) -> None:
    """Compute gradient and Hessian of the optical length by (y, z) of a node."""
    for lane in range(LANES):
        hy, hz = node.slope_y[lane], node.slope_z[lane]
        n, m = before.index[lane], node.index[lane]
        u, v = before.weight[lane], node.weight[lane]
        ty, tz = hy * before.d_x[lane] + before.d_y[lane], hz * before.d_x[lane] + before.d_z[lane]
        sy, sz = hy * node.d_x[lane] + node.d_y[lane], hz * node.d_x[lane] + node.d_z[lane]
        bend = n * before.d_x[lane] - m * node.d_x[lane]
        node.g_y[lane], node.g_z[lane] = n * ty - m * sy, n * tz - m * sz
        node.h_yy[lane] = (u + v) * (1.0 + hy * hy) - u * ty * ty - v * sy * sy + bend * node.yy[lane]
        node.h_yz[lane] = (u + v) * (hy * hz) - u * ty * tz - v * sy * sz + bend * node.yz[lane]
        node.h_zz[lane] = (u + v) * (1.0 + hz * hz) - u * tz * tz - v * sz * sz + bend * node.zz[lane]


@inlined
def eliminate(before: Node, node: Node) -> None:
    """Eliminate the previous node from the equations of a node."""
    for lane in range(LANES):
        c_yy, c_yz, c_zy, c_zz = before.c_yy[lane], before.c_yz[lane], before.c_zy[lane], before.c_zz[lane]
        k_yy, k_yz, k_zy, k_zz = before.k_yy[lane], before.k_yz[lane], before.k_zy[lane], before.k_zz[lane]
        g_y, g_z = before.g_y[lane], before.g_z[lane]
        node.h_yy[lane] -= c_yy * k_yy + c_zy * k_zy
        node.h_yz[lane] -= c_yy * k_yz + c_zy * k_zz
        node.h_zz[lane] -= c_yz * k_yz + c_zz * k_zz
        node.g_y[lane] -= k_yy * g_y + k_zy * g_z
        node.g_z[lane] -= k_yz * g_y + k_zz * g_z


@inlined
def couple(node: Node, following: Node) -> None:
    """Compute the coupling C of a node with the next one, and K = H^-1 C."""
    for lane in range(LANES):
        v = node.weight[lane]
        dx, dy, dz = node.d_x[lane], node.d_y[lane], node.d_z[lane]
        hy, hz = node.slope_y[lane], node.slope_z[lane]
        iy, iz = following.slope_y[lane], following.slope_z[lane]
        sy, sz, ty, tz = hy * dx + dy, hz * dx + dz, iy * dx + dy, iz * dx + dz
        c_yy, c_yz = v * (ty * sy - hy * iy - 1.0), v * (tz * sy - hy * iz)
        c_zy, c_zz = v * (ty * sz - hz * iy), v * (tz * sz - hz * iz - 1.0)
        yy, yz, zz = node.h_yy[lane], node.h_yz[lane], node.h_zz[lane]
        scale = 1.0 / (yy * zz - yz * yz)
        node.c_yy[lane], node.c_yz[lane], node.c_zy[lane], node.c_zz[lane] = c_yy, c_yz, c_zy, c_zz
        node.k_yy[lane], node.k_yz[lane] = (zz * c_yy - yz * c_zy) * scale, (zz * c_yz - yz * c_zz) * scale
        node.k_zy[lane], node.k_zz[lane] = (yy * c_zy - yz * c_yy) * scale, (yy * c_zz - yz * c_yz) * scale


@inlined
def step(node: Node, following: Node, innermost: bool) -> int:
    """Move a node by Newton's step; return the number of lanes that have not converged."""
    for lane in range(LANES):
        yy, yz, zz = node.h_yy[lane], node.h_yz[lane], node.h_zz[lane]
        y, z = node.g_y[lane], node.g_z[lane]
        scale = 1.0 / (yy * zz - yz * yz)
        node.step_y[lane], node.step_z[lane] = (zz * y - yz * z) * scale, (yy * z - yz * y) * scale
    if not innermost:
        for lane in range(LANES):
            y, z = following.step_y[lane], following.step_z[lane]
            node.step_y[lane] -= node.k_yy[lane] * y + node.k_yz[lane] * z
            node.step_z[lane] -= node.k_zy[lane] * y + node.k_zz[lane] * z
    moving = 0
    for lane in range(LANES):
        node.y[lane] -= node.step_y[lane]
        node.z[lane] -= node.step_z[lane]
        if abs(node.step_y[lane]) > SETTLED_MM or abs(node.step_z[lane]) > SETTLED_MM:
            moving += 1
    return moving


@merged
def solve(surfaces: Surfaces, steps: int, batch: Batch, nodes: Nodes) -> None:
    """Run Newton on all surfaces: eliminate the block-tridiagonal system inwards and solve it outwards."""
    last = len(nodes) - 1
    moving = LANES
    for turn in range(steps + 1):
        for j in range(1, last):
            evaluate(surfaces, j, batch, nodes)
        if turn == steps or (turn > 1 and moving == 0):
            break
        for j in range(last):
            aim(nodes[j], nodes[j + 1])
            if j > 0:
                block(nodes[j - 1], nodes[j])
                if j > 1:
                    eliminate(nodes[j - 1], nodes[j])
                if j < last - 1:
                    couple(nodes[j], nodes[j + 1])
        moving = 0
        for j in range(last - 1, 0, -1):
            moving += step(nodes[j], nodes[j + 1], j == last - 1)


@inlined
def bend(before: Node, node: Node, reflects: bool, sign: float) -> None:
    """Refract or reflect the traced ray on a node, if it comes from the front (the back for a sign -1) and passes."""
    for lane in range(LANES):
        hy, hz = node.slope_y[lane], node.slope_z[lane]
        scale = 1.0 / np.sqrt(1.0 + hy * hy + hz * hz)
        normal = (scale, -hy * scale, -hz * scale)
        way = (before.w_x[lane], before.w_y[lane], before.w_z[lane])
        if reflects:
            mirrored = _reflect(way, normal)
            node.w_x[lane], node.w_y[lane], node.w_z[lane] = mirrored.way
            node.alive[lane] = before.alive[lane] if sign * mirrored.cosine > 0.0 else 0.0
        else:
            bent = _refract(way, normal, before.index[lane] / node.index[lane], 0.0)
            node.w_x[lane], node.w_y[lane], node.w_z[lane] = bent.way
            node.alive[lane] = before.alive[lane] if sign * bent.cosine > 0.0 and bent.passes else 0.0


@merged
def trace(surfaces: Surfaces, reflects: bool, rimmed: int, batch: Batch, nodes: Nodes) -> None:
    """Trace the ray that leaves the viewpoint for the outermost surface through all others.

    Each hit is solved by Newton's method from the path's point.
    """
    seen, front = nodes[0], nodes[1]
    for lane in range(LANES):
        dx, dy, dz = front.x[lane] - seen.x[lane], front.y[lane] - seen.y[lane], front.z[lane] - seen.z[lane]
        inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        seen.w_x[lane], seen.w_y[lane], seen.w_z[lane] = dx * inverse, dy * inverse, dz * inverse
        front.p_x[lane], front.p_y[lane], front.p_z[lane] = front.x[lane], front.y[lane], front.z[lane]
        seen.alive[lane] = 1.0
    for j in range(1, len(nodes) - 1):
        if j > 1:
            meet(surfaces, j, batch, nodes)
        bend(nodes[j - 1], nodes[j], reflects and j == rimmed, -1.0 if reflects and j > rimmed else 1.0)
        node = nodes[j]
        for lane in range(LANES):
            if not abs(node.p_x[lane] - node.x[lane]) < SURE_MM:
                node.alive[lane] = 0.0


@merged
def meet(surfaces: Surfaces, j: int, batch: Batch, nodes: Nodes) -> None:
    """Move the traced ray from the previous node to the surface of node j."""
    before, node = nodes[j - 1], nodes[j]
    for lane in range(LANES):
        node.far[lane] = (
            (node.x[lane] - before.p_x[lane]) * before.w_x[lane]
            + (node.y[lane] - before.p_y[lane]) * before.w_y[lane]
            + (node.z[lane] - before.p_z[lane]) * before.w_z[lane]
        )
    for _ in range(2):
        for lane in range(LANES):
            t = node.far[lane]
            node.p_x[lane] = before.p_x[lane] + t * before.w_x[lane]
            node.y[lane] = before.p_y[lane] + t * before.w_y[lane]
            node.z[lane] = before.p_z[lane] + t * before.w_z[lane]
        evaluate(surfaces, j, batch, nodes)
        for lane in range(LANES):
            rate = before.w_x[lane] - node.slope_y[lane] * before.w_y[lane] - node.slope_z[lane] * before.w_z[lane]
            node.far[lane] -= (node.p_x[lane] - node.x[lane]) / rate
            node.p_y[lane], node.p_z[lane] = node.y[lane], node.z[lane]


@inlined
def axis_distance(sheet: Sheet, x: float, y: float, z: float) -> float:
    """Compute the distance of a point from the axis of a surface."""
    x, y, z = x - sheet.origin[0], y - sheet.origin[1], z - sheet.origin[2]
    along = x * sheet.axis[0] + y * sheet.axis[1] + z * sheet.axis[2]
    return float(np.sqrt(max(x * x + y * y + z * z - along * along, 0.0)))


@inlined
def is_inside(outline: Floats, node: Node, lane: int) -> bool:
    """Return whether a traced point lies inside an elliptical outline: its centre, and its axes over their lengths."""
    x, y, z = node.p_x[lane] - outline[0], node.p_y[lane] - outline[1], node.p_z[lane] - outline[2]
    u = x * outline[3] + y * outline[4] + z * outline[5]
    v = x * outline[6] + y * outline[7] + z * outline[8]
    return bool(u * u + v * v <= 1.0)


@merged
def check_outlines(outlines: Floats, batch: Batch, nodes: Nodes, state: Statuses) -> None:
    """Mark rays that pass a surface outside its outline."""
    for lane in range(min(LANES, batch.total - batch.first)):
        i, k = row_of(batch, lane)
        for j in range(outlines.shape[1]):
            if state[i, k] == FOUND and not is_inside(outlines[min(i, len(outlines) - 1), j], nodes[j + 1], lane):
                state[i, k] = AT_EDGE


@merged
def store_rimmed(before: Node, node: Node, batch: Batch, met: Floats, arriving: Floats) -> None:
    """Write where rays meet the rimmed surface, and the directions in which they arrive."""
    for lane in range(min(LANES, batch.total - batch.first)):
        i, k = row_of(batch, lane)
        met[0, i, k], met[1, i, k], met[2, i, k] = node.p_x[lane], node.p_y[lane], node.p_z[lane]
        arriving[0, i, k], arriving[1, i, k] = before.w_x[lane], before.w_y[lane]
        arriving[2, i, k] = before.w_z[lane]


@merged
def store(
    sheets: Sheets, rims: Floats, reflects: bool, rimmed: int, batch: Batch, nodes: Nodes,
    exits: Floats, ways: Floats, ends: Floats, residuals: Floats, state: Statuses,
) -> None:  # fmt: skip
    """Write the rays and their statuses, from the miss of the traced ray at its target."""
    last = len(nodes) - 1
    seen, front, inner, goal, edge = nodes[0], nodes[1], nodes[last - 1], nodes[last], nodes[rimmed]
    for lane in range(min(LANES, batch.total - batch.first)):
        i, k = row_of(batch, lane)
        exits[0, i, k], exits[1, i, k], exits[2, i, k] = front.x[lane], front.y[lane], front.z[lane]
        ways[0, i, k], ways[1, i, k], ways[2, i, k] = seen.w_x[lane], seen.w_y[lane], seen.w_z[lane]
        wx, wy, wz = inner.w_x[lane], inner.w_y[lane], inner.w_z[lane]
        ends[0, i, k], ends[1, i, k], ends[2, i, k] = wx, wy, wz
        x, y = goal.x[lane] - inner.p_x[lane], goal.y[lane] - inner.p_y[lane]
        z = goal.z[lane] - inner.p_z[lane]
        along = x * wx + y * wy + z * wz
        x, y, z = x - along * wx, y - along * wy, z - along * wz
        residual, reach = np.sqrt(x * x + y * y + z * z), SURE_MM
        if reflects:
            residual *= FAR_MM / max(along, FAR_MM)
            # A distant source magnifies Newton's remaining error of the mirror point.
            reach = min(SURE_MM + 1e-15 * along * along, RESIDUAL_LIMIT_MM)
        residuals[i, k] = residual
        sheet, rim = sheets[min(i, len(sheets) - 1), rimmed - 1], rims[min(i, len(rims) - 1)]
        if inner.alive[lane] > 0.0 and residual <= reach and along > 0.0:
            beyond = axis_distance(sheet, edge.x[lane], edge.y[lane], edge.z[lane]) > rim
            state[i, k] = OUTSIDE if beyond else FOUND
        elif state[i, k] != OUTSIDE:
            state[i, k] = LOST


@merged
def mirror_start(
    surfaces: Surfaces, rims: Floats, rimmed: int, batch: Batch, nodes: Nodes, guesses: Floats, state: Statuses
) -> None:
    """Guess mirror points: where the bisectors through the centre of curvature of the apex meet the surface.

    The guesses are exact on a sphere for source and viewpoint at infinity. A ray is marked OUTSIDE if its guess is far
    outside the rim, or its bisector does not point to the front, because then the surface has no mirror point.
    """
    last = len(nodes) - 1
    seen, w, goal, sheets = nodes[0], nodes[rimmed], nodes[last], surfaces.sheets
    for lane in range(LANES):
        apex = sheets[min(row_of(batch, lane)[0], len(sheets) - 1), rimmed - 1].apex
        w.y[lane], w.z[lane] = apex[0], apex[1]
    for j in range(rimmed, rimmed + 1):
        evaluate(surfaces, j, batch, nodes)
    for lane in range(LANES):
        i, k = row_of(batch, lane)
        sheet, rim = sheets[min(i, len(sheets) - 1), rimmed - 1], rims[min(i, len(rims) - 1)]
        hy, hz = w.slope_y[lane], w.slope_z[lane]
        size = np.sqrt(1.0 + hy * hy + hz * hz)
        nx, ny, nz = 1.0 / size, -hy / size, -hz / size
        bent = -w.yy[lane] - w.zz[lane] + ny * ny * w.yy[lane] + 2.0 * ny * nz * w.yz[lane] + nz * nz * w.zz[lane]
        radius = 2.0 * size / bent
        cx, cy, cz = w.x[lane] - radius * nx, w.y[lane] - radius * ny, w.z[lane] - radius * nz
        ax, ay, az = goal.x[lane] - cx, goal.y[lane] - cy, goal.z[lane] - cz
        bx, by, bz = seen.x[lane] - cx, seen.y[lane] - cy, seen.z[lane] - cz
        a, b = 1.0 / np.sqrt(ax * ax + ay * ay + az * az), 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
        ax, ay, az = a * ax + b * bx, a * ay + b * by, a * az + b * bz
        reach = radius / np.sqrt(max(ax * ax + ay * ay + az * az, 1e-300))
        x, y, z = cx + reach * ax, cy + reach * ay, cz + reach * az
        w.y[lane], w.z[lane] = y, z
        guesses[0, i, k], guesses[1, i, k], guesses[2, i, k] = x, y, z
        away = not ax * nx + ay * ny + az * nz > 0.0 or axis_distance(sheet, x, y, z) > 1.25 * rim
        state[i, k] = OUTSIDE if rim < np.inf and away else LOST
        w.x[lane] = x
    straight_start(surfaces, rimmed, batch, nodes)


@merged
def given_start(surfaces: Surfaces, rimmed: int, batch: Batch, nodes: Nodes, guesses: Floats) -> None:
    """Start from given points of the rimmed surface."""
    w = nodes[rimmed]
    for lane in range(LANES):
        i, k = row_of(batch, lane)
        w.x[lane], w.y[lane], w.z[lane] = guesses[0, i, k], guesses[1, i, k], guesses[2, i, k]
    straight_start(surfaces, rimmed, batch, nodes)


@compiled(
    "i8[::1], SHEET[:,::1], f8[::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], b1, i8, b1, "
    "f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], i1[:,::1]",
    SHEET=SHEET,
)
def connect_all(
    kinds: Ints,  # kinds of the surfaces, outside in
    sheets: Sheets,  # (1 or n, s) surfaces
    table: Floats,  # table of the surfaces
    ladder: Floats,  # (1 or n, s + 1) index in front of the first surface, then that behind each
    rims: Floats,  # (1 or n,) radius at which the rimmed surface ends
    viewpoint: Floats,  # (3, 1 or n, 1 or m) mm
    target: Floats,  # (3, 1 or n, 1 or m) mm
    # (1 or n, s, 9) elliptical outlines of the surfaces: centre, and both axes over their lengths, 0 for none; or (1,
    # 0, 9)
    outlines: Floats,
    # whether the rimmed surface reflects the rays; those behind it in the list are crossed on the way out
    reflects: bool,
    rimmed: int,  # number of the surface with a rim, from 1: the outermost one of the eye
    given: bool,  # whether `guesses` are given
    guesses: Floats,  # (3, n, m) first guesses of mirror points, written if it reflects and they are not given
    exits: Floats,  # (3, n, m) points on the outermost surface, written
    ways: Floats,  # (3, n, m) directions to them from the viewpoint, written
    ends: Floats,  # (3, n, m) directions in the last medium, written
    met: Floats,  # (3, n, m) points on the rimmed surface, written; or empty
    arriving: Floats,  # (3, n, m) directions before it, written; or empty
    residuals: Floats,  # (n, m) misses of the traced rays, mm, written
    state: Statuses,  # (n, m), initially LOST, written
) -> None:
    """Solve for the rays from viewpoints to targets, through all surfaces; the rimmed one may reflect them instead.

    Every path is traced from the viewpoint; a ray that misses the target by more than rounding is LOST.
    """
    nodes, surfaces = np.zeros(len(kinds) + 2, dtype=NODE), Surfaces(kinds, sheets, table)
    for first in range(0, state.size, LANES):
        batch = Batch(first, state.size, max(state.shape[1], 1))
        load(surfaces, ladder, viewpoint, target, batch, nodes)
        if given:
            given_start(surfaces, rimmed, batch, nodes, guesses)
        elif reflects:
            mirror_start(surfaces, rims, rimmed, batch, nodes, guesses, state)
        else:
            paraxial_start(surfaces, rimmed, batch, nodes)
        solve(surfaces, 2 * STEPS if given or rimmed > 1 else STEPS, batch, nodes)
        trace(surfaces, reflects, rimmed, batch, nodes)
        store(sheets, rims, reflects, rimmed, batch, nodes, exits, ways, ends, residuals, state)
        check_outlines(outlines, batch, nodes, state)
        if met.size:
            store_rimmed(nodes[rimmed - 1], nodes[rimmed], batch, met, arriving)
