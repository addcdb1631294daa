"""The brow: hairs in a band over the supraorbital ridge, lying on the skin.

At its head, near the nose, hairs stand up; along the arch they turn to the temple, those of the upper border downwards,
so that they meet in a line (Farkas 1994 for the band; directions as commonly described). The brow does not move.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..arrays import Floats, frozen
from .anatomy import RegionSpec
from .contour import step
from .face import face_depth
from .hairs import Hairs, taper

POINTS = 5


@lru_cache(maxsize=16)
def brow(spec: RegionSpec) -> Hairs:
    """The brow of a subject in the region's frame."""
    b = spec.brow
    rng = np.random.default_rng((0xB405, spec.seed))
    n = b.count
    # 0 at the head, 1 at the tail; sparse at both ends.
    s = np.clip(rng.beta(1.1, 1.3, n), 0.0, 1.0)
    across = np.clip(rng.normal(0.5, 0.24, n), 0, 1)
    y, low, high = _band(spec, s)
    z = low + across * (high - low)
    head = 1 - step(s, 0.0, 0.34)
    upper = step(across, 0.35, 0.85)
    # Direction from +z towards the temple (-y).
    lean = np.radians(18 + 62 * (1 - head) + 38 * upper * (1 - 0.8 * head) + 18 * step(s, 0.6, 1.0))
    lean = lean + np.radians(9.0) * rng.normal(0, 1, n)
    length = b.length_mm * rng.uniform(0.55, 1.0, n) * (0.75 + 0.25 * np.sin(np.pi * s))
    bend = np.radians(20.0) * rng.normal(0.9, 0.45, n) * (1 - 0.55 * head)
    points = np.empty((n, POINTS, 3))
    lift = 0.35 + 0.55 * rng.uniform(0, 1, n) + 0.5 * head
    for j in range(POINTS):
        u = j / (POINTS - 1)
        if j:
            turn = lean + bend * (u - 0.5)
            stride = length / (POINTS - 1)
            y, z = y - stride * np.sin(turn), z + stride * np.cos(turn)
        rise = -0.15 if j == 0 else lift * np.sin(np.pi * min(0.62 * u + 0.08, 1.0))
        points[:, j] = np.stack([_skin(spec, y, z) + rise, y, z], axis=-1)
    return Hairs(frozen(points), frozen(taper(length, b.diameter_mm, POINTS)))


def _band(spec: RegionSpec, s: Floats) -> tuple[Floats, Floats, Floats]:
    """(y, lower z, upper z) of the band at s."""
    b = spec.brow
    y = 21.0 - 46.0 * s
    arch = b.arch_mm * np.sin(np.pi * np.clip(s / 1.25, 0, 1)) ** 1.5
    low = b.height_mm + arch - 5.5 * step(s, 0.62, 1.0) - 1.0 * (1 - step(s, 0.0, 0.2))
    width = b.thickness_mm * (0.8 + 0.2 * step(s, 0.0, 0.2)) * (1 - 0.75 * step(s, 0.45, 1.0))
    return y, low, low + width


def _skin(spec: RegionSpec, y: Floats, z: Floats) -> Floats:
    # Up here nothing but the face is under the hairs; the joint with the lids' shell adds less than a tenth of a mm.
    return face_depth(spec.face, y, z)
