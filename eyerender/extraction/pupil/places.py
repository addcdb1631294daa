"""Positions relative to an ellipse: signed distance, nearest point, normal, curvature and sector."""

from __future__ import annotations

import math
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse

SECTORS = 48  # equal steps of the ellipse's parameter u
STEPS = 3  # Newton steps to the nearest point; they reach 1e-6 px up to b / 2 away
# Records of this many points stay in the first-level cache, each field in one piece, so that loops become vectors.
BLOCK = 128
# Tangents of the sectors' borders within an eighth of the outline.
TAN_1, TAN_2, TAN_3, TAN_4, TAN_5 = (math.tan(2.0 * math.pi * k / SECTORS) for k in range(1, 6))
Value = TypeVar("Value", float, Floats)


class EllipsePlaces(NamedTuple, Generic[Value]):
    """Position relative to an ellipse: of one point, or of n points as arrays."""

    distance: Value  # signed distance, px, positive outside
    cos_t: Value  # cosine of the nearest point's parameter t
    sin_t: Value  # its sine
    nx: Value  # outward normal there, in the ellipse's axes
    ny: Value  # the same
    curvature: Value  # curvature there, 1/px
    cos_u: Value  # cosine of u, the parameter counted from the image's x axis
    sin_u: Value  # its sine


PLACES = 8 * BLOCK  # numbers in a block of places


@inlined
def place_in(block: Floats, i: int) -> EllipsePlaces[float]:
    """Read place i of a block (PLACES,)."""
    return EllipsePlaces(
        block[i], block[BLOCK + i], block[2 * BLOCK + i], block[3 * BLOCK + i],
        block[4 * BLOCK + i], block[5 * BLOCK + i], block[6 * BLOCK + i], block[7 * BLOCK + i],
    )  # fmt: skip


@inlined
def put_place(block: Floats, i: int, place: EllipsePlaces[float]) -> None:
    """Write place i of a block (PLACES,)."""
    block[i], block[BLOCK + i], block[2 * BLOCK + i], block[3 * BLOCK + i] = place[:4]
    block[4 * BLOCK + i], block[5 * BLOCK + i], block[6 * BLOCK + i], block[7 * BLOCK + i] = place[4:]


def middles(ellipse: Ellipse, count: int = SECTORS) -> EllipsePlaces[Floats]:
    """Return the places on the ellipse in the middle of each of `count` sectors."""
    (a, b), angle = ellipse.semi_axes_px.tolist(), ellipse.angle_rad
    u = 2.0 * np.pi * ((np.arange(count) + 0.5) / count - 0.5)
    cos_t, sin_t = np.cos(u - angle), np.sin(u - angle)
    nx, ny = b * cos_t, a * sin_t
    height = np.sqrt(nx * nx + ny * ny)
    return EllipsePlaces(
        np.zeros(count), cos_t, sin_t, nx / height, ny / height, a * b / height**3, np.cos(u), np.sin(u)
    )


@inlined
def find_places(ellipse: tuple[float, ...], x: Floats, y: Floats, start: int, count: int, out: Floats) -> None:
    """Write the places of `count` points, beginning with number `start`, to a block (PLACES,).

    Newton's iteration finds the nearest point's parameter t, from the point's own direction:

    f(t) = (a^2 - b^2) cos t sin t - a p sin t + b q cos t = 0.

    The loops are simple sums, which the compiler vectorises. Until the last one, (cos_u, sin_u) hold (p, q).
    """
    cx, cy, a, b, angle = ellipse
    cos, sin, eccentric = math.cos(angle), math.sin(angle), a * a - b * b
    for i in range(count):
        dx, dy = x[start + i] - cx, y[start + i] - cy
        p, q = dx * cos + dy * sin, dy * cos - dx * sin
        c, s = p / a, q / b
        scale = 1.0 / max(math.sqrt(c * c + s * s), 1e-300)
        put_place(out, i, EllipsePlaces(0.0, c * scale, s * scale, 0.0, 0.0, 0.0, p, q))
    if eccentric > 1e-9 * a * a:
        for _ in range(STEPS):
            for i in range(count):
                _, c, s, _, _, _, p, q = place_in(out, i)
                value = eccentric * c * s - a * p * s + b * q * c
                slope = eccentric * (c * c - s * s) - a * p * c - b * q * s
                # Far inside (beyond the evolute) the slope changes sign, but no pixel is used there.
                turn = min(max(value / min(slope, -1e-9), -0.3), 0.3)
                c, s = c + turn * s, s - turn * c
                scale = 1.0 / math.sqrt(c * c + s * s)
                put_place(out, i, EllipsePlaces(0.0, c * scale, s * scale, 0.0, 0.0, 0.0, p, q))
    for i in range(count):
        _, c, s, _, _, _, p, q = place_in(out, i)
        nx, ny = b * c, a * s
        scale = 1.0 / math.sqrt(nx * nx + ny * ny)
        nx, ny = nx * scale, ny * scale
        distance, curvature = (p - a * c) * nx + (q - b * s) * ny, a * b * scale * scale * scale
        put_place(out, i, EllipsePlaces(distance, c, s, nx, ny, curvature, c * cos - s * sin, s * cos + c * sin))


def distance_slopes(place: EllipsePlaces[Value], cos: float, sin: float) -> tuple[Value, Value, Value, Value, Value]:
    """Compute derivatives of the signed distance by cx, cy and the shape matrix (aa, bb, ab) in the ellipse's axes.

    `cos` and `sin` are those of the ellipse's angle.
    """
    nx, ny, c, s = place.nx, place.ny, place.cos_t, place.sin_t
    return ny * sin - nx * cos, -nx * sin - ny * cos, -nx * c, -ny * s, -nx * s - ny * c


distance_slopes_at = inlined(distance_slopes)  # for one point, in compiled functions


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
    out, block = np.empty(x.size, dtype=np.int64), np.empty(PLACES)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        find_places(ellipse, x, y, start, count, block)
        for i in range(count):
            place = place_in(block, i)
            out[start + i] = sector_at(place.cos_u, place.sin_u)
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
