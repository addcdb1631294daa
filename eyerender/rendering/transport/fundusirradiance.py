"""What the pupil shows: the light of the lamps that the fundus returns, on a grid over the stop, once per frame.

The fundus mixes the light of the whole pupil and changes it slowly from place to place, so a small grid gives it. Each
of its points sums over the lamps the irradiance of the stop times the return factor of `eye.fundus`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...eye.fundus import CELLS, EDGE
from ..records.frame import Frame
from .directlight import LampPath


@dataclass(kw_only=True)
class FundusIrradiance:
    """Radiance in air (mW/mm^2/sr) that leaves the pupil, before the transmittance of the cornea, on a square grid."""

    cells: mi.Float

    def at(self, u: mi.Float, v: mi.Float, active: mi.Bool) -> mi.Float:
        """Radiance at coordinates of the stop in units of its semi-axes, bilinearly."""
        x, y = (dr.clip((c * (1 / EDGE) + 1) * (CELLS / 2) - 0.5, 0, CELLS - 1.001) for c in (u, v))
        i, j = mi.UInt32(x), mi.UInt32(y)
        s, t = x - mi.Float(i), y - mi.Float(j)

        def cell(di: int, dj: int) -> mi.Float:
            return dr.gather(mi.Float, self.cells, (j + dj) * CELLS + i + di, active)

        low, high = (dr.lerp(cell(0, k), cell(1, k), s) for k in (0, 1))
        return dr.lerp(low, high, t)


def fundus_irradiance(frame: Frame, factors: mi.Float | None) -> FundusIrradiance:
    """Fill the grid.

    Args:
        frame: the frame.
        factors: the return factors of the lamps; None where nothing is returned.
    """
    if factors is None:
        dark = dr.zeros(mi.Float, CELLS * CELLS)
        dr.make_opaque(dark)
        return FundusIrradiance(cells=dark)
    index = dr.arange(mi.UInt32, CELLS * CELLS)
    row = index // CELLS
    u, v = ((mi.Float(k) + 0.5) * (2 * EDGE / CELLS) - EDGE for k in (index - row * CELLS, row))
    a, b = frame.stop.axes
    # Points beyond the margin get the light of the nearest point within it.
    shrink = dr.rcp(dr.maximum(dr.sqrt(u * u + v * v), 1))
    x = frame.stop.centre + (u * shrink * a) * frame.stop.u + (v * shrink * b) * frame.stop.v

    def body(i: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        factor = dr.gather(mi.Float, factors, i * (CELLS * CELLS) + index)
        lamp = frame.lights[i]
        path = LampPath.find(frame, lamp, lamp.position, x, factor > 0)
        return i + 1, total + dr.select(path.blocked, 0, path.gain * factor)

    state = (mi.UInt32(0), mi.Float(0) * x.x)
    labels = ("i", "total")
    _, total = dr.while_loop(
        state, lambda i, _: i < frame.lights.count, body, labels=labels, label="light of the fundus"
    )
    dr.eval(total)
    return FundusIrradiance(cells=total)
