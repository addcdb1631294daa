"""Folds that a face gets with age: creases below and above the lids, crow's feet, the trough beside the nose.

Each fold is a groove along an arc in the region's frame (y, z). With u along its heading and v across it,

    depth(u, v) = d T(u / l) exp(-((v - k u^2 / 2 - w(u)) / b)^2),

where T rises and falls at both ends, k is the curvature and w a slow sway. Numbers, places and sizes are chosen to look
like photographs. The strength `skin.folds` decides how many of a person's folds there are, and how deep: with age, they
deepen in the same places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Singles
from .contour import step

_COARSE = 8
# Of each family: most folds, places of the start (y from, to, z from, to; mm), heading (deg, from +y to +z) and its
# spread, curvature (1/mm), lengths, widths (mm), and depth.
_FAMILIES = (
    (8, (4.0, 13.0, -15.0, -6.5), (196.0, 10.0), (-0.035, -0.015), (8.0, 24.0), (0.2, 0.7), (0.25, 1.0)),  # below
    (2, (9.0, 13.0, -8.0, -5.0), (222.0, 9.0), (-0.02, 0.01), (10.0, 20.0), (0.9, 2.0), (0.3, 0.9)),  # beside the nose
    (7, (-20.0, -15.5, -8.0, 5.0), (182.0, 28.0), (-0.02, 0.02), (5.0, 16.0), (0.25, 0.8), (0.3, 1.0)),  # crow's feet
    (5, (2.0, 13.0, 7.0, 13.0), (168.0, 9.0), (0.012, 0.035), (8.0, 22.0), (0.25, 0.7), (0.2, 0.8)),  # above
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fold:
    """A groove: start (mm), heading (rad), curvature (1/mm), length, width (mm), depth (0 to 1), phase of its sway."""

    y: float
    z: float
    heading: float
    bend: float
    length: float
    width: float
    depth: float
    phase: float


def folds(seed: int, strength: float) -> list[Fold]:
    """Draw the folds of a person; a fold appears at a strength of its own and deepens from there."""
    rng = np.random.default_rng((0xF01D, seed))
    out = []
    for most, (y0, y1, z0, z1), (way, spread), bend, length, width, depth in _FAMILIES:
        for _ in range(most):
            first = rng.uniform(0.0, 0.8)
            drawn = Fold(
                y=float(rng.uniform(y0, y1)),
                z=float(rng.uniform(z0, z1)),
                heading=float(np.radians(rng.normal(way, spread))),
                bend=float(rng.uniform(*bend)),
                length=float(rng.uniform(*length)),
                width=float(rng.uniform(*width)),
                depth=float(rng.uniform(*depth)) * min(max(strength - first, 0.0) / 0.4, 1.0),
                phase=float(rng.uniform(0, 2 * np.pi)),
            )
            out += [drawn] if drawn.depth > 0 else []
    return out


def fold_depths(seed: int, strength: float, y: Singles, z: Singles) -> Singles:
    """Compute the depth, 0 to about 1, of a person's folds at points (rows, columns) of the region's frame, mm."""
    out = np.zeros_like(y)
    y_some, z_some = y[::_COARSE, ::_COARSE], z[::_COARSE, ::_COARSE]
    for fold in folds(seed, strength):
        u, v = _along(fold, y_some, z_some)
        near = (np.abs(v) < 3 * fold.width + 2) & (np.abs(u - fold.length / 2) < fold.length / 2 + 2)
        if not near.any():
            continue
        ends = [np.flatnonzero(near.any(axis=axis))[[0, -1]] for axis in (1, 0)]
        part = tuple(slice(max(int(a) - 1, 0) * _COARSE, (int(b) + 2) * _COARSE) for a, b in ends)
        u, v = _along(fold, y[part], z[part])
        t = u / fold.length
        depth = fold.depth * step(t, 0.0, 0.3) * (1 - step(t, 0.6, 1.0)) * np.exp(-np.square(v / fold.width))
        np.maximum(out[part], depth, out=out[part])
    return out


def _along(fold: Fold, y: Singles, z: Singles) -> tuple[Singles, Singles]:
    """Compute the position along a fold and the distance across it, mm."""
    c, s = np.float32(np.cos(fold.heading)), np.float32(np.sin(fold.heading))
    dy, dz = y - np.float32(fold.y), z - np.float32(fold.z)
    u: NDArray[np.float32] = dy * c + dz * s
    sway = np.float32(0.4) * np.sin(u * np.float32(0.5) + np.float32(fold.phase))
    return u, dz * c - dy * s - np.float32(0.5 * fold.bend) * u * u - sway
