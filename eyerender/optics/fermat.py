"""The two-point problem by Fermat's principle: paths of stationary optical length across graphs of surfaces.

A path from a viewpoint X_0 over the points X_i = (h_i(y_i, z_i), y_i, z_i) of m surfaces to an object X_{m+1} has the
optical length S = sum_j n_j |X_{j+1} - X_j|. It is a ray where dS = 0. With e_j the unit vectors along the segments,
the tangents t_y = (h_y, 1, 0), t_z = (h_z, 0, 1), q_i = n_{i-1} e_{i-1} - n_i e_i and the projection A_j = (1 - e_j
e_j^T) n_j / L_j,

    gradient            G_i = t_i . q_i
    Hessian, diagonal   t_i.(A_{i-1} + A_i) t_i + (q_i)_x h_i''
    Hessian, next       -t_i . A_i t_{i+1}

(Born & Wolf 1999, 3.3.2; the Hessian is that of Walter et al. 2009, "Single scattering in refractive media with
triangle mesh boundaries", eq. 6, for any number of surfaces.) Newton needs no intersections, so a biconic costs as
much as a sphere. A mirror point is the same problem with m = 1, equal indices and the object outside. This solver is
fast and serves almost all rays; `shooting` is slower and more robust, and solves the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import FloatLike, Floats
from ..geometry.graphs import Graph
from ..geometry.surfaces import Xyz

STEPS = 6
SETTLED_MM = 2e-6
"""Newton is quadratic here, an error e leaves 0.1 to 0.5 e^2: after a last step this small it is some 1e-12 mm."""


class Stationary(NamedTuple):
    """Points on the surfaces (in the working frame), and the size of Newton's last step (mm)."""

    points: list[Xyz]
    last_step_mm: float


def stationary_path(
    graphs: Sequence[Graph],
    indices: Sequence[FloatLike],
    viewpoint: Xyz,
    target: Xyz,
    start: Sequence[tuple[Floats, Floats]],
) -> Stationary:
    """Solve dS = 0 by Newton from `start` (y, z) on each surface, all in the frame of the graphs.

    Rays that diverge have meaningless points, so the caller must trace the result.

    Args:
        graphs: the surfaces, from the viewpoint.
        indices: n_0 before the first surface, then the index behind each.
        viewpoint: where the rays end.
        target: the objects.
        start: first guesses (y, z) on each surface.
    """
    ys, zs = [s[0] for s in start], [s[1] for s in start]
    step = np.inf
    points: list[Xyz] = []
    with np.errstate(all="ignore"):
        for count in range(STEPS):
            step = _newton(graphs, indices, viewpoint, target, ys, zs)
            if not step > SETTLED_MM and count:
                break
        points = [(graph.height(y, z), y, z) for graph, y, z in zip(graphs, ys, zs, strict=True)]
    return Stationary(points, step)


class _Block(NamedTuple):
    """Symmetric 2 x 2 system: Hessian (yy, yz, zz) and gradient."""

    yy: Floats
    yz: Floats
    zz: Floats
    y: Floats
    z: Floats


def _newton(
    graphs: Sequence[Graph],
    indices: Sequence[FloatLike],
    viewpoint: Xyz,
    target: Xyz,
    ys: list[Floats],
    zs: list[Floats],
) -> float:
    """Take one Newton step on all surfaces; update the caller's `ys` and `zs` and return the largest step."""
    jets = [graph.jet(y, z) for graph, y, z in zip(graphs, ys, zs, strict=True)]
    nodes: list[Xyz] = [viewpoint, *((jet.x, y, z) for jet, y, z in zip(jets, ys, zs, strict=True)), target]
    blocks: list[_Block] = []
    couplings: list[tuple[Floats, Floats, Floats, Floats]] = []
    last = len(graphs)
    carried: tuple[Floats, ...] = ()
    for j, n in enumerate(indices):
        (x0, y0, z0), (x1, y1, z1) = nodes[j], nodes[j + 1]
        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
        inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
        weight = inverse if isinstance(n, float) and n == 1.0 else n * inverse
        dx *= inverse
        dy *= inverse
        dz *= inverse
        if j < last:
            front = jets[j]
            ty, tz = front.y * dx + dy, front.z * dx + dz
            head = (ty, tz)
        if j > 0:
            behind = jets[j - 1]
            sy, sz = behind.y * dx + dy, behind.z * dx + dz
            sum_y, sum_z, pull, stiff, yy, yz, zz = carried
            gradient_y, gradient_z = sum_y - n * sy, sum_z - n * sz
            bend = pull - n * dx
            whole = stiff + weight
            wy, wz = weight * sy, weight * sz
            h_yy = whole * (1.0 + behind.y * behind.y) - yy - wy * sy + bend * behind.yy
            h_yz = whole * (behind.y * behind.z) - yz - wy * sz + bend * behind.yz
            h_zz = whole * (1.0 + behind.z * behind.z) - zz - wz * sz + bend * behind.zz
            blocks.append(_Block(h_yy, h_yz, h_zz, gradient_y, gradient_z))
            if j < last:
                cross = behind.y * front.y
                couplings.append(
                    (
                        weight * (ty * sy - cross - 1.0),
                        weight * (tz * sy - behind.y * front.z),
                        weight * (ty * sz - behind.z * front.y),
                        weight * (tz * sz - behind.z * front.z - 1.0),
                    )
                )
        if j < last:
            ty, tz = head
            wy, wz = weight * ty, weight * tz
            # These parts of the next surface's block belong to the segment before it.
            carried = (n * ty, n * tz, n * dx, weight, wy * ty, wy * tz, wz * tz)
    return _solve(blocks, couplings, ys, zs)


def _solve(
    blocks: list[_Block], couplings: list[tuple[Floats, Floats, Floats, Floats]], ys: list[Floats], zs: list[Floats]
) -> float:
    """Solve by block-tridiagonal elimination from the outermost surface inward and back, and apply the step."""
    reduced = [blocks[0]]
    gains: list[tuple[Floats, Floats, Floats, Floats]] = []
    for block, (yy, yz, zy, zz) in zip(blocks[1:], couplings, strict=True):
        before = reduced[-1]
        scale = 1.0 / (before.yy * before.zz - before.yz * before.yz)
        # K = B^-1 C, where C is the coupling with the rows of the surface before.
        k_yy, k_yz = (before.zz * yy - before.yz * zy) * scale, (before.zz * yz - before.yz * zz) * scale
        k_zy, k_zz = (before.yy * zy - before.yz * yy) * scale, (before.yy * zz - before.yz * yz) * scale
        gains.append((k_yy, k_yz, k_zy, k_zz))
        reduced.append(
            _Block(
                block.yy - yy * k_yy - zy * k_zy,
                block.yz - yy * k_yz - zy * k_zz,
                block.zz - yz * k_yz - zz * k_zz,
                block.y - k_yy * before.y - k_zy * before.z,
                block.z - k_yz * before.y - k_zz * before.z,
            )
        )
    largest = 0.0
    step_y: Floats | None = None
    step_z: Floats | None = None
    for i in reversed(range(len(reduced))):
        b = reduced[i]
        scale = 1.0 / (b.yy * b.zz - b.yz * b.yz)
        new_y, new_z = (b.zz * b.y - b.yz * b.z) * scale, (b.yy * b.z - b.yz * b.y) * scale
        if step_y is not None and step_z is not None:
            k_yy, k_yz, k_zy, k_zz = gains[i]
            new_y = new_y - k_yy * step_y - k_yz * step_z
            new_z = new_z - k_zy * step_y - k_zz * step_z
        step_y, step_z = new_y, new_z
        ys[i], zs[i] = ys[i] - step_y, zs[i] - step_z
        largest = max(largest, float(np.max(np.abs(step_y))), float(np.max(np.abs(step_z))))
    return largest
