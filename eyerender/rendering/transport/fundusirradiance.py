"""The light of the pupil: lamp light that the fundus returns, on a grid over the stop, once per frame.

The fundus mixes the light of the whole pupil, so the result varies slowly and a small grid suffices. Each of its points
sums over the lamps the irradiance of the stop times the return factor of `eye.fundus`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...eye.fundus import CELLS, EDGE
from ..records.frame import DeviceFrame
from ..records.recording import syntax
from .directlight import LampPath


@dataclass(kw_only=True)
class FundusIrradiance:
    """Radiance in air (mW/mm^2/sr) out of the pupil, before the cornea's transmittance, on a square grid."""

    cells: mi.Float

    @classmethod
    def build(cls, frame: DeviceFrame, factors: mi.Float | None) -> FundusIrradiance:
        """Fill the grid.

        Args:
            frame: the frame.
            factors: the return factors of the lamps; None if nothing is returned.
        """
        cells = dr.zeros(mi.Float, CELLS * CELLS) if factors is None else _radiance_of_cells(frame, factors)
        dr.make_opaque(cells)
        return cls(cells=cells)

    def at(self, u: mi.Float, v: mi.Float, active: mi.Bool) -> mi.Float:
        """Interpolate the radiance bilinearly at coordinates of the stop, in units of its semi-axes."""
        x, y = (dr.clip((c * (1 / EDGE) + 1) * (CELLS / 2) - 0.5, 0, CELLS - 1.001) for c in (u, v))
        i, j = mi.UInt32(x), mi.UInt32(y)
        s, t = x - mi.Float(i), y - mi.Float(j)
        first = j * CELLS + i
        a, b, c, d = (dr.gather(mi.Float, self.cells, first + k, active) for k in (0, 1, CELLS, CELLS + 1))
        return dr.lerp(dr.lerp(a, b, s), dr.lerp(c, d, s), t)


@syntax
def _radiance_of_cells(frame: DeviceFrame, factors: mi.Float) -> mi.Float:
    """Sum the lamps' light at the cells: irradiance of the stop times return factor."""
    index = dr.arange(mi.UInt32, CELLS * CELLS)
    row = index // CELLS
    column = index - row * CELLS
    u, v = ((mi.Float(k) + 0.5) * (2 * EDGE / CELLS) - EDGE for k in (column, row))
    a, b = frame.stop.axes
    # Points beyond the margin get the light of the nearest point within it.
    shrink = dr.rcp(dr.maximum(dr.sqrt(u * u + v * v), 1))
    x = frame.stop.centre + (u * shrink * a) * frame.stop.u + (v * shrink * b) * frame.stop.v
    i, total = mi.UInt32(0), mi.Float(0) * x.x
    while dr.hint(i < frame.lights.count, label="light of the fundus", exclude=[frame, factors]):
        factor = dr.gather(mi.Float, factors, i * (CELLS * CELLS) + index)
        lamp = frame.lights[i]
        path = LampPath.find(frame, lamp, lamp.position, x, factor > 0)
        total += dr.select(path.blocked, 0, path.gain * factor)
        i += 1
    return total
