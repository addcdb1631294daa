"""Compiled functions for poses: the rigid motion of turned eyes, and the poses that turn a line through a target."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from ..base.arrays import Floats
from ..base.jit import compiled
from ..optics.formula_kernels import COMPILED, inlined

Point: TypeAlias = tuple[float, float, float]
dot = COMPILED.dot
SETTLED_MM, SETTLED_RAD = 1e-11, 1e-9
LARGEST_STEP_RAD = 0.5
"""Far from the solution a full step can leave the hemisphere in which Listing's law is defined."""
_STEPS = 20


@compiled("f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,::1]")
def move_all(angles: Floats, centres: Floats, turn: Floats, shift: Floats) -> None:
    """Compute the rigid motions Rz(a) about c_a, Ry(-e) about c_e, Rx(t) about c_t, the last one first.

    `angles` (n, 3) are a, e and t; `centres` (1 or n, 9) are c_a, c_e and c_t. `turn` and `shift` are written.
    """
    for i in range(len(angles)):
        c = centres[min(i, len(centres) - 1)]
        ca, sa, ce, se = np.cos(angles[i, 0]), np.sin(angles[i, 0]), np.cos(angles[i, 1]), np.sin(angles[i, 1])
        ct, st = np.cos(angles[i, 2]), np.sin(angles[i, 2])
        # Rz Ry Rx, whose middle factor carries +x towards +z.
        turn[i, 0, 0], turn[i, 0, 1], turn[i, 0, 2] = ca * ce, -sa * ct - ca * se * st, sa * st - ca * se * ct
        turn[i, 1, 0], turn[i, 1, 1], turn[i, 1, 2] = sa * ce, ca * ct - sa * se * st, -ca * st - sa * se * ct
        turn[i, 2, 0], turn[i, 2, 1], turn[i, 2, 2] = se, ce * st, ce * ct
        y = c[7] - (ct * c[7] - st * c[8]) - c[4]
        z = c[8] - (st * c[7] + ct * c[8]) - c[5]
        x, z = -ce * c[3] - se * z + c[3] - c[0], -se * c[3] + ce * z + c[5] - c[2]
        y = y + c[4] - c[1]
        shift[i, 0], shift[i, 1], shift[i, 2] = ca * x - sa * y + c[0], sa * x + ca * y + c[1], z + c[2]


@inlined
def seen(c: Floats, target: Floats, azimuth: float, elevation: float) -> tuple[Point, Point, Point]:
    """Transform the target into the frame of the turned eye, with its derivatives by azimuth and elevation.

    Listing's torsion is included. `c` are the centres of azimuth, elevation and torsion.
    """
    cos_a, sin_a, cos_e, sin_e = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    whole = 1.0 + cos_a * cos_e
    sin_t = -sin_a * sin_e / whole
    cos_t = np.sqrt(max(1.0 - sin_t * sin_t, 1e-300))
    tau_a = -sin_e * (cos_a + cos_e) / (whole * whole * cos_t)
    tau_e = -sin_a * (cos_e + cos_a) / (whole * whole * cos_t)
    # Rz(-az) about the centre of azimuth, and its derivative (y, -x, 0).
    x, y = target[0] - c[0], target[1] - c[1]
    x, y = cos_a * x + sin_a * y, cos_a * y - sin_a * x
    ax, ay = y, -x
    # Ry(el) about the centre of elevation, and its derivative (z, 0, -x).
    x, y, z = x + (c[0] - c[3]), y + (c[1] - c[7]), target[2] - c[5]
    x, z = cos_e * x + sin_e * z, cos_e * z - sin_e * x
    ax, az = cos_e * ax, -sin_e * ax
    ex, ez = z, -x
    # Rx(-tau) about the centre of torsion, and its derivative (0, z, -y).
    x, z = x + c[3], z + (c[5] - c[8])
    y, z = cos_t * y + sin_t * z, cos_t * z - sin_t * y
    by_a = (ax, cos_t * ay + sin_t * az + tau_a * z, cos_t * az - sin_t * ay - tau_a * y)
    by_e = (ex, sin_t * ez + tau_e * z, cos_t * ez - tau_e * y)
    return (x, y + c[7], z + c[8]), by_a, by_e


@compiled("f8[:,::1], f8[:,::1], f8[:,::1], f8, f8[:,::1]")
def turn_all(centres: Floats, lines: Floats, target: Floats, largest_start_rad: float, out: Floats) -> None:
    """Solve for the poses that turn lines fixed to eyes through targets (n, 3), by Newton's method with Listing's law.

    The equations are e1.(q - p) = e2.(q - p) = 0, where q is the target in the frame of the turned eye. `centres` are
    those of `move_all`; `lines` (1 or n, 6) are a point p and the unit direction. `out` (n, 4) receives azimuth,
    elevation, and the target's distance from the line and along it.
    """
    for i in range(len(target)):
        c, line, goal = centres[min(i, len(centres) - 1)], lines[min(i, len(lines) - 1)], target[i]
        point, way = (line[0], line[1], line[2]), (line[3], line[4], line[5])
        scale = 1.0 / np.sqrt(way[0] * way[0] + way[1] * way[1])
        e1 = (-way[1] * scale, way[0] * scale, 0.0)
        e2 = (-way[2] * e1[1], way[2] * e1[0], way[0] * e1[1] - way[1] * e1[0])
        x, y, z = goal[0] - c[0], goal[1] - c[1], goal[2] - c[5]
        azimuth = np.arctan2(y, x) - np.arctan2(way[1], way[0])
        elevation = np.arctan2(z, np.hypot(x, y)) - np.arctan2(way[2], np.hypot(way[0], way[1]))
        azimuth = min(max(azimuth, -largest_start_rad), largest_start_rad)
        elevation = min(max(elevation, -largest_start_rad), largest_start_rad)
        last = False
        for step in range(_STEPS + 1):
            q, by_azimuth, by_elevation = seen(c, goal, azimuth, elevation)
            gap = (q[0] - point[0], q[1] - point[1], q[2] - point[2])
            r1, r2 = dot(e1, gap), dot(e2, gap)
            out[i, 0], out[i, 1], out[i, 2], out[i, 3] = azimuth, elevation, np.hypot(r1, r2), dot(way, gap)
            if last or step == _STEPS or (step > 0 and not abs(r1) + abs(r2) > SETTLED_MM):
                break
            j11, j12 = dot(e1, by_azimuth), dot(e1, by_elevation)
            j21, j22 = dot(e2, by_azimuth), dot(e2, by_elevation)
            inverse = 1.0 / (j11 * j22 - j12 * j21)
            turn, lift = (j22 * r1 - j12 * r2) * inverse, (j11 * r2 - j21 * r1) * inverse
            turn = min(max(turn, -LARGEST_STEP_RAD), LARGEST_STEP_RAD) if turn == turn else 0.0
            lift = min(max(lift, -LARGEST_STEP_RAD), LARGEST_STEP_RAD) if lift == lift else 0.0
            azimuth, elevation = azimuth - turn, elevation - lift
            # Newton converges quadratically, so the remaining error is below rounding. Measure it now.
            last = max(abs(turn), abs(lift)) < SETTLED_RAD
