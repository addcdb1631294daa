"""A grid with its reductions by 2, 4, ... (a mip map), for means over areas of many cells."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

LEVELS = 5  # largest number of levels, each half as fine as the one before


@dataclass(kw_only=True)
class Pyramid:
    """A grid and its reductions, read bilinearly.

    Attributes:
        rows: number of rows of the finest grid.
        columns: number of its columns.
        closed: whether the columns form a closed ring.
        cells: for each cell of all levels, its own value and those to the right, below, and below right.
    """

    rows: mi.UInt32
    columns: mi.UInt32
    closed: bool
    cells: mi.Float

    @classmethod
    def build(cls, values: mi.Float, rows: mi.UInt32, columns: mi.UInt32, *, closed: bool) -> Pyramid:
        """Build the reductions of a grid whose values are given row by row."""
        dr.eval(values)
        counts = [dr.width(values) >> 2 * level for level in range(LEVELS)]
        pyramid = cls(rows=rows, columns=columns, closed=closed, cells=dr.zeros(mi.Float, 4 * sum(counts)))
        for level, count in enumerate(counts):
            index = dr.arange(mi.UInt32, count)
            height, width = rows >> level, columns >> level
            row = index // width
            column = index - row * width
            if level:
                first, below = 4 * row * width + 2 * column, 2 * width
                a, b, c, d = (dr.gather(mi.Float, values, first + n) for n in (0, below, 1, below + 1))
                values = 0.25 * (a + b + c + d)
                dr.eval(values)
            right = dr.select(column + 1 < width, column + 1, 0 if closed else column)
            down = dr.minimum(row + 1, height - 1)
            place = pyramid._first(height * width) + index
            for n, (i, j) in enumerate(((row, column), (row, right), (down, column), (down, right))):
                dr.scatter(pyramid.cells, dr.gather(mi.Float, values, i * width + j), 4 * place + n)
        dr.eval(pyramid.cells)
        return pyramid

    def _first(self, cells: mi.UInt32) -> mi.UInt32:
        """Return the index of the first cell of the level with this number of cells."""
        return (self.rows * self.columns - cells) // 3 * 4

    def at(self, row: mi.Float, column: mi.Float, level: mi.UInt32) -> mi.Float:
        """Interpolate a level at positions in units of the finest cells, whose centres are at integers."""
        scale = dr.rcp(mi.Float(mi.UInt32(1) << level))
        rows, columns = self.rows >> level, self.columns >> level
        first = self._first(rows * columns)
        v = dr.clip((row + 0.5) * scale - 0.5, 0, mi.Float(rows) - 1)
        u = (column + 0.5) * scale - 0.5
        if self.closed:
            u -= dr.floor(u / mi.Float(columns)) * mi.Float(columns)
        else:
            u = dr.clip(u, 0, mi.Float(columns) - 1)
        i, j = mi.UInt32(v), dr.minimum(mi.UInt32(u), columns - 1)
        s, t = u - mi.Float(j), v - mi.Float(i)
        four = dr.gather(mi.Vector4f, self.cells, first + i * columns + j)
        high, low = four.x + s * (four.y - four.x), four.z + s * (four.w - four.z)
        return high + t * (low - high)


def level_of(size_mm: mi.Float, cell_mm: mi.Float) -> mi.UInt32:
    """Return the level whose cells are about `size_mm`, given the finest cells of `cell_mm`."""
    return mi.UInt32(dr.clip(dr.log2(dr.maximum(size_mm / cell_mm, 1)) + 0.5, 0, LEVELS - 1))
