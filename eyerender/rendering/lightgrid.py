"""Light on a square grid, interpolated by cubics where these are good to a thousandth.

A cell of the grid is used where the light is known at its sixteen neighbours and third differences say that cubic
interpolation is good: not at the edge of a shadow, nor where a lamp sets.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .parameters import leaves

BENT = 0.004  # largest third difference of a cell over its irradiance


class LightGrid:
    """Irradiance at the nodes of a grid of `side` by `side`."""

    DRJIT_STRUCT = leaves("side", "rows")

    def __init__(self, side: int, rows: mi.Float | None = None) -> None:
        """Make a grid from its rows (see `rows_of`); without them nothing is known."""
        self.side = side
        if rows is None:
            rows = dr.full(mi.Float, -1, 4 * side * side)
            dr.make_opaque(rows)
        self.rows = rows

    @staticmethod
    def nodes(side: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Column and row of all nodes of a grid, in row order."""
        index = dr.arange(mi.UInt32, side * side)
        row = index // side
        return index - row * side, row

    @classmethod
    def rows_of(cls, side: int, irradiance: mi.Float, more: mi.Float | None = None) -> mi.Float:
        """The numbers of a grid from the irradiance of its nodes, negative where it is not known.

        `more` is added. It is known to change slowly, so it does not decide which cells are used. Both must have been
        evaluated.
        """
        column, row = cls.nodes(side)
        index = row * side + column
        places = about(index, side)
        near = [dr.gather(mi.Float, irradiance, place) for place in places]
        bent, least, most = unevenness(near)
        good = (least > 0) & (bent <= BENT * most)
        good &= (column > 0) & (row > 0) & (column < side - 2) & (row < side - 2)
        four = near[4:8]
        if more is not None:
            four = [value + dr.gather(mi.Float, more, place) for value, place in zip(four, places[4:8], strict=True)]
        low = dr.abs(four[0])
        rows = dr.zeros(mi.Float, 4 * side * side)
        dr.scatter(rows, mi.Vector4f(dr.select(good, low, -low), *four[1:]), index)
        return rows

    def at(self, u: mi.Float, v: mi.Float, active: mi.Bool) -> tuple[mi.Float, mi.Bool]:
        """Irradiance at places in units of cells, and whether it is known there."""
        side = self.side
        inside = active & (u >= 0) & (v >= 0) & (u < side - 1) & (v < side - 1)
        i, j = mi.UInt32(u), mi.UInt32(v)
        wu, wv = weights(u - mi.Float(i)), weights(v - mi.Float(j))
        total, known = mi.Float(0), mi.Bool(inside)
        for k, weight in enumerate(wv):
            row = dr.gather(mi.Vector4f, self.rows, (j + k - 1) * side + i, inside)
            if k == 1:
                known &= row.x > 0
            total += weight * (wu[0] * dr.abs(row.x) + wu[1] * row.y + wu[2] * row.z + wu[3] * row.w)
        return dr.select(known, dr.maximum(total, 0), 0), known


def about(index: mi.UInt32, side: int) -> list[mi.UInt32]:
    """The sixteen nodes about cells of a grid, row by row."""
    places = (mi.Int32(index) + dv * side + du for dv in range(-1, 3) for du in range(-1, 3))
    return [mi.UInt32(dr.clip(place, 0, side**2 - 1)) for place in places]


def unevenness(near: list[mi.Float]) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Largest third difference, least and greatest of the values at the nodes `about` cells."""
    bent, least, most = mi.Float(0), near[0], near[0]
    for e in [near[n : n + 4] for n in range(0, 16, 4)] + [near[n::4] for n in range(4)]:
        bent = dr.maximum(bent, dr.abs(e[0] - 3 * e[1] + 3 * e[2] - e[3]))
    for value in near[1:]:
        least, most = dr.minimum(least, value), dr.maximum(most, value)
    return bent, least, most


def weights(s: mi.Float) -> tuple[mi.Float, ...]:
    """Weights of four neighbours at the place s, 0 to 1 between the second and the third."""
    r = 1 - s
    return -0.5 * s * r * r, 1 + s * s * (1.5 * s - 2.5), 1 + r * r * (1.5 * r - 2.5), -0.5 * r * s * s
