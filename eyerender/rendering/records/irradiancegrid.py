"""Irradiance on a square grid, filled once per frame and interpolated by cubics where that is accurate.

The light of lamps varies slowly, except at shadow edges and where a lamp sets below the horizon, so a few thousand
exact values suffice elsewhere. A cell holds the sum over those lamps whose light is known at all sixteen surrounding
nodes, and for which third differences predict a cubic interpolation error below a thousandth. It marks the other lamps;
samples in the cell trace light paths to them individually.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .frame import ALL, BITS
from .recording import syntax

BENT = 0.004  # largest third difference about a cell over its irradiance
Held = Callable[..., Any]  # (lamp, cell, allowed difference) -> mi.Bool


@dataclass(kw_only=True)
class IrradianceGrid:
    """Irradiance (mW/mm^2) in the cells between `side` by `side` nodes."""

    side: int  # number of nodes along a side
    # irradiance at the sixteen nodes around each cell, row by row, summed over the lamps that the cell holds
    cells: mi.Float
    left: mi.UInt32  # bit l of a cell is set if it lacks lamp l. With more than 32 lamps, a cell lacks all or none

    @classmethod
    def unknown(cls, side: int) -> IrradianceGrid:
        """Create a grid whose cells lack all lamps."""
        grid = cls(side=side, cells=dr.zeros(mi.Float, 16 * side**2), left=dr.full(mi.UInt32, ALL, side**2))
        dr.make_opaque(grid.cells, grid.left)
        return grid

    @classmethod
    @syntax
    def build(
        cls, side: int, nodes: mi.Float, lamps: mi.UInt32, *, more: mi.Float | None = None, held: Held | None = None
    ) -> tuple[IrradianceGrid, mi.UInt32, mi.UInt32]:
        """Build a grid from the irradiance of its nodes.

        Args:
            side: number of nodes along a side.
            nodes: irradiance of the nodes, lamp by lamp and row by row, negative where unknown; evaluated.
            lamps: number of lamps, on the device.
            more: additional, slowly varying light at the nodes, which does not decide what a cell holds; evaluated.
            held: called with a lamp, a cell and the allowed third difference where cubic interpolation is too
                inaccurate or a node unknown; returns whether the caller holds this lamp's light in another way.

        Returns:
            The grid, a bit mask per cell of the lamps that the caller holds, and one of those that are known at all
            nodes around the cell.
        """
        cell = dr.arange(mi.UInt32, side * side)
        row = cell // side
        column = cell - row * side
        within = (column > 0) & (row > 0) & (column < side - 2) & (row < side - 2)
        around, many = nodes_about(cell, side), lamps > BITS
        usual = _sum_of_lamps(nodes, lamps, cell, side) / mi.Float(lamps)
        # Separate arrays for each, because Dr.Jit writes the results of the loop into them.
        none, dark = mi.UInt32(0) * cell, mi.Float(0) * mi.Float(cell)
        k, left, elsewhere, known = mi.UInt32(0), *(mi.UInt32(none) for _ in range(3))
        sums = [mi.Float(dark) for _ in around]
        while dr.hint(k < lamps, label="cells", exclude=[cls, side, nodes, around, more, held]):
            values = [dr.gather(mi.Float, nodes, k * side**2 + node) for node in around]
            bent, least, most = unevenness(values)
            allowed = BENT * dr.maximum(most, usual)
            good = (least >= 0) & (bent <= allowed)
            kept = mi.Bool(False) if held is None else _ask(held, k, cell, allowed, within & ~good & ~many)
            bit = mi.UInt32(1) << k
            left |= dr.select(good | kept, 0, dr.select(many, ALL, bit))
            elsewhere |= dr.select(kept, bit, 0)
            known |= dr.select(least >= 0, bit, 0)
            sums = _sum(sums, [dr.select(good, value, 0) for value in values])
            k += 1
        left = dr.select(within, left, ALL)
        if dr.hint(more is not None, mode="scalar"):
            sums = _sum(sums, [dr.gather(mi.Float, more, node) for node in around])
        sums = [dr.select(within & ~(many & (left != 0)), total, 0) for total in sums]
        dr.eval(sums, left, elsewhere, known)
        cells = dr.zeros(mi.Float, 16 * side**2)
        for n in range(4):
            dr.scatter(cells, mi.Vector4f(*sums[4 * n : 4 * n + 4]), 4 * cell + n)
        dr.eval(cells)
        return cls(side=side, cells=cells, left=left), elsewhere, known

    def place(self, u: mi.Float, v: mi.Float, active: mi.Bool) -> GridPlace:
        """Return the grid places of points given in units of the node spacing."""
        inside = active & (u >= 0) & (v >= 0) & (u < self.side - 1) & (v < self.side - 1)
        i, j = mi.UInt32(u), mi.UInt32(v)
        across, down = (cubic_weights(p - mi.Float(n)) for p, n in ((u, i), (v, j)))
        return GridPlace(cell=j * self.side + i, across=mi.Vector4f(*across), down=mi.Vector4f(*down), inside=inside)

    def at(self, place: GridPlace) -> tuple[mi.Float, mi.UInt32]:
        """Interpolate the irradiance (mW/mm^2) at places; also return the lamps it lacks (outside the grid: all)."""
        total = mi.Float(0)
        for k in range(4):
            row = dr.gather(mi.Vector4f, self.cells, 4 * place.cell + k, place.inside)
            total += place.down[k] * dr.dot(place.across, row)
        left = dr.gather(mi.UInt32, self.left, place.cell, place.inside)
        return dr.select(place.inside, dr.maximum(total, 0), 0), dr.select(place.inside, left, ALL)


@dataclass(kw_only=True)
class GridPlace:
    """A position in a grid: its cell, the weights of its four columns and rows of nodes, and whether it is inside."""

    cell: mi.UInt32
    across: mi.Vector4f
    down: mi.Vector4f
    inside: mi.Bool


@syntax
def _sum_of_lamps(nodes: mi.Float, lamps: mi.UInt32, node: mi.UInt32, side: int) -> mi.Float:
    """Sum the irradiance of nodes over all lamps whose light is known there."""
    k, total = mi.UInt32(0), mi.Float(0) * mi.Float(node)
    while dr.hint(k < lamps, label="all lamps", exclude=[nodes, side]):
        total += dr.maximum(dr.gather(mi.Float, nodes, k * side**2 + node), 0)
        k += 1
    return total


@syntax
def _ask(held: Held, lamp: mi.UInt32, cell: mi.UInt32, allowed: mi.Float, asked: mi.Bool) -> mi.Bool:
    """Call `held` for a lamp where `asked`; False elsewhere."""
    kept = mi.Bool(False)
    if dr.hint(asked, exclude=[held]):
        kept = held(lamp, cell, allowed)
    return kept


def _sum(a: list[mi.Float], b: list[mi.Float]) -> list[mi.Float]:
    return [x + y for x, y in zip(a, b, strict=True)]


def grid_nodes(side: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Return the column and row of all nodes of a grid, in row order."""
    index = dr.arange(mi.UInt32, side * side)
    row = index // side
    return index - row * side, row


def nodes_about(cell: mi.UInt32, side: int) -> list[mi.UInt32]:
    """Return the numbers of the sixteen nodes around cells of a grid, row by row."""
    nodes = (mi.Int32(cell) + dv * side + du for dv in range(-1, 3) for du in range(-1, 3))
    return [mi.UInt32(dr.clip(node, 0, side**2 - 1)) for node in nodes]


def unevenness(values: list[mi.Float]) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Compute the largest third difference, the minimum and the maximum of the values at the `nodes_about` cells."""
    bent, least, most = mi.Float(0), values[0], values[0]
    for e in [values[n : n + 4] for n in range(0, 16, 4)] + [values[n::4] for n in range(4)]:
        bent = dr.maximum(bent, dr.abs(e[0] - 3 * e[1] + 3 * e[2] - e[3]))
    for value in values[1:]:
        least, most = dr.minimum(least, value), dr.maximum(most, value)
    return bent, least, most


def cubic_weights(s: mi.Float) -> tuple[mi.Float, ...]:
    """Compute the weights of four neighbours at s in [0, 1] between the second and the third (Keys 1981, a = -1/2)."""
    r = 1 - s
    return -0.5 * s * r * r, 1 + s * s * (1.5 * s - 2.5), 1 + r * r * (1.5 * r - 2.5), -0.5 * r * s * s
