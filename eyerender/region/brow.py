"""The brow: hairs in a band over the supraorbital ridge, lying on the skin.

At its head, near the nose, hairs point upwards. Along the arch they turn towards the temple, and those of the upper
border downwards, so that they meet in a line (directions as commonly described). The brow does not move.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..base.arrays import Floats, frozen
from .anatomy import Region
from .contour import step
from .face import face_depth
from .hairs import Hairs, taper

PLACES = np.array([0.0, 0.4, 1.0])  # positions of a hair's points along its length; it bends most at its root


@lru_cache(maxsize=16)
def brow(spec: Region) -> Hairs:
    """Generate the brow of a subject in the region's frame."""
    b = spec.brow
    rng = np.random.default_rng((0xB405, spec.seed))
    n = b.count
    # s is 0 at the head and 1 at the tail. The density falls towards both ends and both borders.
    s = -0.04 + 1.1 * rng.beta(1.25, 1.55, n)
    across = rng.beta(1.7, 1.7, n)
    y, low, high = brow_band(spec, s)
    z = low + across * (high - low) + 0.5 * rng.normal(0, 1, n)
    head = 1 - step(s, -0.02, 0.36)
    upper = step(across, 0.3, 0.95)
    # This is the direction from +z towards the temple (-y): up at the head, then along the band, and down from the
    # upper border.
    along = 70.0 + 26.0 * step(s, 0.45, 0.95)
    lean = np.radians(along + (14.0 - along) * head + 26.0 * (upper - 0.25) * (1 - 0.7 * head))
    # Neighbouring hairs have similar directions; a few differ.
    drift = np.interp(s, np.linspace(-0.1, 1.1, 22), rng.normal(0, 1, 22))
    lean = lean + np.radians(5.0) * drift + np.radians(6.0) * np.clip(rng.standard_t(5, n), -3.5, 3.5)
    length = b.length_mm * rng.triangular(0.35, 0.85, 1.0, n) * (0.62 + 0.38 * np.sin(np.pi * np.clip(s, 0, 1) ** 0.8))
    bend = np.radians(26.0) * rng.normal(1.0, 0.45, n) * (1 - 0.3 * head)
    points = np.empty((n, len(PLACES), 3))
    lift = 0.35 + 0.55 * rng.uniform(0, 1, n) + 0.5 * head
    for j, u in enumerate(PLACES):
        if j:
            turn = lean + bend * (0.5 * (PLACES[j - 1] + u) - 0.375)
            stride = length * (u - PLACES[j - 1])
            y, z = y - stride * np.sin(turn), z + stride * np.cos(turn)
        rise = -0.1 if j == 0 else lift * np.sin(np.pi * min(0.62 * u + 0.08, 1.0))
        points[:, j] = np.stack([_skin(spec, y, z) + rise, y, z], axis=-1)
    return Hairs(frozen(points), frozen(taper(n, b.diameter_mm, PLACES)))


def brow_band(spec: Region, s: Floats) -> tuple[Floats, Floats, Floats]:
    """Compute coordinate y and lower and upper z (mm) of the band at s."""
    b = spec.brow
    y = 21.0 - 46.0 * s
    arch = b.arch_mm * np.sin(np.pi * np.clip(s / 1.25, 0, 1)) ** 1.5
    low = b.height_mm + arch - 3.6 * step(s, 0.62, 1.05) - 1.0 * (1 - step(s, 0.0, 0.2))
    width = b.thickness_mm * (0.75 + 0.25 * step(s, -0.05, 0.2)) * (1 - 0.72 * step(s, 0.35, 1.05))
    return y, low, low + width


def _skin(spec: Region, y: Floats, z: Floats) -> Floats:
    # Here the hairs follow the face only; the transition to the lids' shell adds less than a tenth of a mm.
    return face_depth(spec.face, y, z)
