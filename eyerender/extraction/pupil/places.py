"""Positions relative to an ellipse: signed distance, nearest point, normal, curvature and sector."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse

SECTORS = 48  # equal steps of the ellipse's parameter u
STEPS = 3  # Newton steps to the nearest point; they reach 1e-6 px up to b / 2 away
BLOCK = 128  # points whose numbers stay in the first-level cache
# Columns of a block of places, in the order of `Place`; the distance comes first.
COS_T, SIN_T, NX, NY, CURVATURE, COS_U, SIN_U = (k * BLOCK for k in range(1, 8))
# Tangents of the sectors' borders within an eighth of the outline.
TAN_1, TAN_2, TAN_3, TAN_4, TAN_5 = (math.tan(2.0 * math.pi * k / SECTORS) for k in range(1, 6))


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Positions of points (n,) relative to an ellipse.

    These are the signed distance, the nearest point's parameter (cos t, sin t), the outward normal there in the
    ellipse's axes (nx, ny), the curvature, and the parameter counted from the image's x axis (cos u, sin u).
    """

    distance: Floats
    cos_t: Floats
    sin_t: Floats
    nx: Floats
    ny: Floats
    curvature: Floats
    cos_u: Floats
    sin_u: Floats

    @staticmethod
    def middles(ellipse: Ellipse, count: int = SECTORS) -> Place:
        """Return the positions on the ellipse in the middle of each of `count` sectors."""
        (a, b), angle = ellipse.semi_axes_px.tolist(), ellipse.angle_rad
        u = 2.0 * np.pi * ((np.arange(count) + 0.5) / count - 0.5)
        cos_t, sin_t = np.cos(u - angle), np.sin(u - angle)
        nx, ny = b * cos_t, a * sin_t
        height = np.sqrt(nx * nx + ny * ny)
        return Place(np.zeros(count), cos_t, sin_t, nx / height, ny / height, a * b / height**3, np.cos(u), np.sin(u))


@inlined
def places(ellipse: tuple[float, ...], x: Floats, y: Floats, start: int, count: int, out: Floats) -> None:
    """Write the positions of `count` points, beginning with number `start`, as consecutive columns of out (8 BLOCK,).

    Newton's iteration finds the nearest point's parameter t, from the point's own direction:

    f(t) = (a^2 - b^2) cos t sin t - a p sin t + b q cos t = 0.

    The loops are simple sums, which the compiler vectorises.
    """
    cx, cy, a, b, angle = ellipse
    cos, sin, eccentric = math.cos(angle), math.sin(angle), a * a - b * b
    for i in range(count):
        dx, dy = x[start + i] - cx, y[start + i] - cy
        p, q = dx * cos + dy * sin, dy * cos - dx * sin
        c, s = p / a, q / b
        scale = 1.0 / max(math.sqrt(c * c + s * s), 1e-300)
        out[COS_T + i], out[SIN_T + i], out[COS_U + i], out[SIN_U + i] = c * scale, s * scale, p, q
    if eccentric > 1e-9 * a * a:
        for _ in range(STEPS):
            for i in range(count):
                c, s, ap, bq = out[COS_T + i], out[SIN_T + i], a * out[COS_U + i], b * out[SIN_U + i]
                value = eccentric * c * s - ap * s + bq * c
                slope = eccentric * (c * c - s * s) - ap * c - bq * s
                # Far inside (beyond the evolute) the slope changes sign, but no pixel is used there.
                turn = min(max(value / min(slope, -1e-9), -0.3), 0.3)
                c, s = c + turn * s, s - turn * c
                scale = 1.0 / math.sqrt(c * c + s * s)
                out[COS_T + i], out[SIN_T + i] = c * scale, s * scale
    for i in range(count):
        c, s, p, q = out[COS_T + i], out[SIN_T + i], out[COS_U + i], out[SIN_U + i]
        nx, ny = b * c, a * s
        scale = 1.0 / math.sqrt(nx * nx + ny * ny)
        nx, ny = nx * scale, ny * scale
        out[i] = (p - a * c) * nx + (q - b * s) * ny
        out[NX + i], out[NY + i], out[CURVATURE + i] = nx, ny, a * b * scale * scale * scale
        out[COS_U + i], out[SIN_U + i] = c * cos - s * sin, s * cos + c * sin


@inlined
def sector_at(c: float, s: float) -> int:
    """Return the sector of a direction (cos u, sin u), from the ratio of its smaller to its larger component."""
    x, y = abs(c), abs(s)
    t = min(x, y) / max(x, y)
    k = (t >= TAN_1) + (t >= TAN_2) + (t >= TAN_3) + (t >= TAN_4) + (t >= TAN_5)
    k = k if y <= x else 11 - k
    k = k if c >= 0.0 else 23 - k
    return 24 + k if s >= 0.0 else 23 - k


@compiled("UniTuple(f8, 5), f8[::1], f8[::1]")
def sectors_at(ellipse: tuple[float, ...], x: Floats, y: Floats) -> Indices:
    """Return the sector (n,) of each point (x, y) near an ellipse (cx, cy, a, b, angle)."""
    out, place = np.empty(x.size, dtype=np.int64), np.empty(8 * BLOCK)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        places(ellipse, x, y, start, count, place)
        for i in range(count):
            out[start + i] = sector_at(place[COS_U + i], place[SIN_U + i])
    return out


def holding(ellipse: tuple[float, ...], points: Floats) -> Bools:
    """Return whether each sector (SECTORS,) of an ellipse (cx, cy, a, b, angle) contains one of the points (n, 2)."""
    out = np.zeros(SECTORS, dtype=bool)
    out[sectors_at(ellipse, points[:, 0].copy(), points[:, 1].copy())] = True
    return out


@inlined
def relative_to(ellipse: tuple[float, ...], x: float, y: float) -> tuple[float, float, float, float]:
    """Compute signed distance, outward normal (x, y) and curvature of an ellipse at a nearby point, to first order."""
    cx, cy, a, b, angle = ellipse
    cos, sin, dx, dy = math.cos(angle), math.sin(angle), x - cx, y - cy
    p, q = (dx * cos + dy * sin) / a, (dy * cos - dx * sin) / b
    u, v = p / a, q / b
    radius, slope = max(math.sqrt(p * p + q * q), 1e-12), max(math.sqrt(u * u + v * v), 1e-12)
    # With (cos t, sin t) = (p, q) / radius: a b / (a^2 sin^2 t + b^2 cos^2 t)^1.5, and slope is its root over a b.
    curvature = (radius / slope) ** 3 / (a * b) ** 2
    return (radius - 1.0) * radius / slope, (u * cos - v * sin) / slope, (u * sin + v * cos) / slope, curvature
