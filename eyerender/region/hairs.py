"""Hairs as curves, and curves as tapered three-sided tubes.

A hair is a polyline with a radius at each point, which decreases towards the tip. One side of its tube is omitted: a
line through the missing side crosses another one, so outlines and shadows do not change. The omitted side is the one
that cameras see least: towards the skin if hairs lie on it, else the inner side of the hair's bend. If a camera sees
it, the sides behind it are shaded similarly, because normals are turned to the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..base.arrays import ArrayValue, Floats, Ints, frozen
from ..optics.vectors import crosses, dots, lengths
from .contour import unit

SEGMENTS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Hairs(ArrayValue):
    """Curves: `points` (n, k, 3) mm from root to tip, and `radii` (n, k) mm."""

    points: Floats
    radii: Floats

    def tubes(self, out: Floats | None = None) -> tuple[Floats, Floats]:
        """Compute vertices (n * k * 3, 3) of three-sided tubes around the curves, and normals; `tube_faces` joins them.

        The first corner of a ring, opposite to the omitted side, points towards `out` (3,), or towards the outer side
        of the hair's bend.
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
            chord = p[:, -1] - p[:, 0]
            steep = np.abs(chord[:, 1:2]) < 0.8 * lengths(chord)[:, None]
            helper = np.where(steep, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
            bend = p[:, p.shape[1] // 2] - 0.5 * (p[:, 0] + p[:, -1])
            helper[dots(crosses(chord, helper), bend) < 0] *= -1
            e1 = unit(crosses(along, helper[:, None, :]))
        else:
            e1 = unit(out - along * (along @ out)[..., None])
        e2 = crosses(along, e1)
        angle = 2 * np.pi * np.arange(3) / 3
        ring = np.cos(angle)[:, None] * e1[:, :, None, :] + np.sin(angle)[:, None] * e2[:, :, None, :]
        corners = p[:, :, None, :] + self.radii[:, :, None, None] * ring
        return corners.reshape(-1, 3), ring.reshape(-1, 3)


@lru_cache(maxsize=8)
def tube_faces(count: int, points: int, sides: tuple[int, ...] = (0, 2), pointed: bool = False) -> Ints:
    """Return triangles (m, 3) of `count` tubes of `points` rings.

    The sides of a tube follow its corners, so the side 1 is opposite to the first corner. Tubes that are `pointed` end
    in the first corner of their last ring.
    """
    j, s = np.meshgrid(np.arange(points - 1), sides, indexing="ij")
    a, b = 3 * j + s, 3 * j + (s + 1) % 3
    one, other = np.stack([a, b, b + 3], -1), np.stack([a, b + 3, a + 3], -1)
    if pointed:
        one[-1, :, 2] = 3 * (points - 1)
        other = other[:-1]
    tube = np.concatenate([one.reshape(-1, 3), other.reshape(-1, 3)])
    return frozen((tube[None] + 3 * points * np.arange(count)[:, None, None]).reshape(-1, 3), np.int64)


def taper(count: int, root_mm: float, s: Floats, tip: float = 0.1) -> Floats:
    """Compute radii (count, k) at positions s (k,): from the root's radius at 0 to the share `tip` of it at 1."""
    return np.asarray(np.broadcast_to(root_mm / 2 * (1 - (1 - tip) * s**1.4), (count, len(s))))
