"""Share of the ambient light that reaches the globe between the lids.

The margins rise from the globe like the walls of a trough. From an even sky, a point of its floor at distances a and b
from walls of height h receives the share

    F = (a / sqrt(a^2 + h^2) + b / sqrt(b^2 + h^2)) / 2

(the view factor of a slot without ends: Hottel's crossed strings), and a part of the rest by reflection from the lids.
Distances are taken upwards and downwards, and h is the upper margin's thickness. The share that the lids reflect is
chosen.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..region.mesh import RegionMesh

_HALF_MM, _PLACES = 20.0, 81
_FAR_MM = 1e3
_SENT_BACK = 0.35


class LidShade:
    """The margins of a posed region on the device; without margins (a head mesh has none) nothing is shaded."""

    def __init__(self, posed: RegionMesh, height_mm: float) -> None:
        y = np.linspace(-_HALF_MM, _HALF_MM, _PLACES)
        table = np.stack([np.full_like(y, _FAR_MM), np.full_like(y, -_FAR_MM)])
        for row, margin in enumerate((posed.upper_margin, posed.lower_margin)):
            if len(margin):
                order = np.argsort(margin[:, 1])
                table[row] = np.interp(y, margin[order, 1], margin[order, 2])
        # Upper and lower heights are adjacent so that both are read at once.
        self._buffer = mi.Float(np.append(table.T.ravel(), height_mm * height_mm).astype(np.float32))

    def share(self, x: mi.Vector3f) -> mi.Float:
        """Share of the ambient light that reaches points of the globe, given in the scene's frame."""
        place = dr.clip((x.y + _HALF_MM) * ((_PLACES - 1) / (2 * _HALF_MM)), 0, _PLACES - 1.001)
        i = mi.UInt32(place)
        w = place - mi.Float(i)
        at = [dr.gather(mi.Float, self._buffer, 2 * i + k) for k in range(4)]
        upper, lower = at[0] + w * (at[2] - at[0]), at[1] + w * (at[3] - at[1])
        h2 = dr.gather(mi.Float, self._buffer, mi.UInt32(2 * _PLACES))
        a, b = dr.maximum(upper - x.z, 0), dr.maximum(x.z - lower, 0)
        seen = 0.5 * (a * dr.rsqrt(a * a + h2) + b * dr.rsqrt(b * b + h2))
        return seen + _SENT_BACK * (1 - seen)
