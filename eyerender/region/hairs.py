"""Hairs as curves, and curves as tapered three-sided tubes.

A hair is a polyline with a radius at each point, which decreases towards the tip. What lies on skin does without the
side of its tube that faces the skin: a line that goes in or out through it crosses another one, so all outlines and
shadows stay.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..arrays import ArrayValue, Floats, Ints, frozen
from ..geometry.vectors import crosses
from .contour import unit

SEGMENTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Hairs(ArrayValue):
    """Curves: `points` (n, k, 3) mm from root to tip, and `radii` (n, k) mm."""

    points: Floats
    radii: Floats

    def tubes(self, out: Floats | None = None) -> tuple[Floats, Floats]:
        """Vertices (n * k * 3, 3) of three-sided tubes about the curves, and their normals; `tube_faces` joins them.

        The first corner of a ring is the one towards `out` (3,), and the side opposite to it faces the other way.
        """
        p = self.points
        if len(p) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3))
        along = np.empty_like(p)
        along[:, 1:-1] = p[:, 2:] - p[:, :-2]
        along[:, 0], along[:, -1] = p[:, 1] - p[:, 0], p[:, -1] - p[:, -2]
        along = unit(along)
        if out is None:
            # Each hair has one reference direction, across its chord, so that its tube does not twist.
            chord = unit(p[:, -1] - p[:, 0])
            helper = np.where(np.abs(chord[:, 1:2]) < 0.8, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
            e1 = unit(crosses(along, helper[:, None, :]))
        else:
            e1 = unit(out - along * (along @ out)[..., None])
        e2 = crosses(along, e1)
        angle = 2 * np.pi * np.arange(3) / 3
        ring = np.cos(angle)[:, None] * e1[:, :, None, :] + np.sin(angle)[:, None] * e2[:, :, None, :]
        corners = p[:, :, None, :] + self.radii[:, :, None, None] * ring
        return corners.reshape(-1, 3), ring.reshape(-1, 3)


@lru_cache(maxsize=8)
def tube_faces(count: int, points: int, on_skin: bool = False) -> Ints:
    """Triangles (m, 3) of `count` tubes of `points` rings, without the side opposite to the first corner `on_skin`."""
    j, s = np.meshgrid(np.arange(points - 1), [0, 2] if on_skin else [0, 1, 2], indexing="ij")
    a, b = 3 * j + s, 3 * j + (s + 1) % 3
    one = np.concatenate([np.stack([a, b, b + 3], -1).reshape(-1, 3), np.stack([a, b + 3, a + 3], -1).reshape(-1, 3)])
    return frozen((one[None] + 3 * points * np.arange(count)[:, None, None]).reshape(-1, 3), np.int64)


def taper(count: int, root_mm: float, s: Floats, tip: float = 0.1) -> Floats:
    """Radii (count, k) at places s (k,), which decrease from the root (0) to the share `tip` of it at the tip (1)."""
    return np.asarray(np.broadcast_to(root_mm / 2 * (1 - (1 - tip) * s**1.4), (count, len(s))))
