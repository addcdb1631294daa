"""Grids over skin and globe on the device: positions of their cells, and interpolation between them.

The grid over the skin is fixed to the tissue: its rows run around the opening between the lids, and its columns form a
closed ring. The grid over the globe is fixed to the head, in Lambert's equal-area projection. `scene.diffusiongrids`
selects the cells that matter. A pyramid (mip map) has reductions of a grid, for means over areas of many cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Ints
from ...region.skin import BANDS, SHEET_ROWS
from ..records.frame import aligned_copy
from ..scene.diffusiongrids import SIDE, WIDTH, GlobeCells, SheetCells
from ..scene.region import SHEET_COLUMNS, SkinGeometry

LEVELS = 5  # largest number of levels of a pyramid, each half as fine as the one before
_FINEST_MM = 0.02  # smallest size of a cell; at the corners of the eye cells are smaller


@dataclass(frozen=True, slots=True)
class Bilinear:
    """Bilinear interpolation in a grid: the four cells around each position, and its place between them."""

    numbers: tuple[mi.UInt32, ...]  # upper left, upper right, lower left and lower right cell
    across: mi.Float  # 0 at the left cells to 1 at the right ones
    down: mi.Float  # 0 at the upper cells to 1 at the lower ones

    def interpolate(self, kind: Any, buffer: mi.Float, each: mi.UInt32 | int = 1, which: mi.UInt32 | int = 0) -> Any:
        """Interpolate the numbers of cells; every cell has `each` numbers."""
        a, b, c, d = (dr.gather(kind, buffer, n * each + which) for n in self.numbers)
        high, low = a + self.across * (b - a), c + self.across * (d - c)
        return high + self.down * (low - high)


def _between_rows(
    row: mi.Float, rows: mi.UInt32 | int, columns: mi.UInt32 | int, beside: tuple[mi.UInt32, mi.UInt32], s: mi.Float
) -> Bilinear:
    """Return the cells between rows, at a share s of the way from the first to the second of two columns."""
    v = dr.clip(row, 0, mi.Float(rows) - 1.001)
    i = mi.UInt32(v)
    return Bilinear(tuple(p * columns + q for p in (i, i + 1) for q in beside), s, v - mi.Float(i))


@dataclass(frozen=True, slots=True)
class SheetSize:
    """Numbers of rows and columns of a grid over the skin, on the device; the columns form a closed ring."""

    rows: mi.UInt32
    columns: mi.UInt32

    def place(self, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return the row and column at coordinates of the map of the skin."""
        rows, columns = (mi.Float(n) for n in (self.rows, self.columns))
        return v * ((SHEET_ROWS + BANDS) / SHEET_ROWS) * rows - 0.5, u * columns - 0.5

    def coordinate(self, row: mi.Float) -> mi.Float:
        """Return the coordinate v of the map at rows; the inverse of `place`."""
        return (row + 0.5) / mi.Float(self.rows) * (SHEET_ROWS / (SHEET_ROWS + BANDS))

    def cells(self, row: mi.Float, column: mi.Float, level: int) -> Bilinear:
        """Return cells of the grid reduced by 2^level, around positions in units of its finest cells."""
        rows, columns, scale = self.rows >> level, self.columns >> level, 1 / (1 << level)
        u = (column + 0.5) * scale - 0.5
        u = dr.select(u < 0, u + mi.Float(columns), u)
        j = dr.minimum(mi.UInt32(u), columns - 1)
        right = dr.select(j + 1 < columns, j + 1, 0)
        return _between_rows((row + 0.5) * scale - 0.5, rows, columns, (j, right), u - mi.Float(j))


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetGrid:
    """The grid over a posed sheet of skin."""

    rows: int  # number of its rows
    columns: int  # number of its columns, which form a closed ring
    size: SheetSize  # rows and columns on the device
    # numbers of its cells that matter, and of the surrounding cells on the grid reduced by 2 and by 4
    cells: tuple[mi.UInt32, ...]
    edges: mi.Float  # row of the sheet's vertices at the edges of the grid's rows
    middles: mi.Float  # row of the sheet's vertices in the middles of the grid's rows

    @classmethod
    def upload(cls, cells: SheetCells) -> SheetGrid:
        """Copy the cells of a pose to the device."""
        size = SheetSize(dr.opaque(mi.UInt32, cells.rows), dr.opaque(mi.UInt32, cells.columns))
        edges, middles = (mi.Float(aligned_copy(at)) for at in (cells.edges, cells.middles))
        numbers = tuple(_numbers(n) for n in cells.numbers)
        return cls(rows=cells.rows, columns=cells.columns, size=size, cells=numbers, edges=edges, middles=middles)

    def vertex_row(self, row: mi.UInt32, share: mi.Float) -> mi.Float:
        """Return the row of the sheet's vertices at the share `share` of a row of the grid."""
        a, b = (dr.gather(mi.Float, self.edges, row + k) for k in (0, 1))
        return a + share * (b - a)


@dataclass(frozen=True, slots=True)
class SheetMetric:
    """Lengths on a posed sheet of skin, along and across its rows."""

    size: SheetSize  # size of the grid
    # for each row and column of vertices: columns per mm along the row, a, rows per mm across it, size of a cell (mm).
    # A point x mm along and y mm across is y * (rows per mm) rows and (x - a * rows) * (columns per mm) columns away
    table: mi.Float

    @classmethod
    def measure(cls, grid: SheetGrid, skin: SkinGeometry) -> SheetMetric:
        """Measure the cells of a grid on a posed surface."""
        columns, last = SHEET_COLUMNS - 1, mi.UInt32(grid.rows - 1)
        index = dr.arange(mi.UInt32, grid.rows * columns)
        i = index // columns
        j = index - i * columns

        def point(i: mi.UInt32, j: mi.UInt32) -> mi.Vector3f:
            return skin.sheet_point(dr.gather(mi.Float, grid.middles, i), mi.Float(j))[0]

        before, after = dr.select(j > 0, j - 1, columns - 1), dr.select(j + 1 < columns, j + 1, 0)
        above, below = dr.maximum(i, 1) - 1, dr.minimum(i + 1, last)
        along = (point(i, after) - point(i, before)) * (0.5 * columns / mi.Float(grid.size.columns))
        down = (point(below, j) - point(above, j)) / mi.Float(below - above)
        width = dr.maximum(dr.norm(along), 1e-6)
        a = dr.dot(along, down) / width
        height = dr.maximum(dr.sqrt(dr.maximum(dr.squared_norm(down) - a * a, 0)), _FINEST_MM)
        width = dr.maximum(width, _FINEST_MM)
        table = dr.zeros(mi.Float, 4 * grid.rows * columns)
        dr.scatter(table, mi.Vector4f(dr.rcp(width), a, dr.rcp(height), dr.maximum(width, height)), index)
        dr.eval(table)
        return cls(grid.size, table)

    def step(self, row: mi.Float, column: mi.Float, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Move x mm along a row and y mm across: the new row and column, and the size of a cell (mm)."""
        columns, around = SHEET_COLUMNS - 1, mi.Float(self.size.columns)
        i = mi.UInt32(row + 0.5)
        j = mi.UInt32((column + 0.5) * (columns / around) + 0.5)
        m = dr.gather(mi.Vector4f, self.table, i * columns + dr.select(j < columns, j, 0))
        down = y * m.z
        column = column + (x - m.y * down) * m.x
        column -= dr.floor(column / around) * around
        return dr.clip(row + down, 0, mi.Float(self.size.rows) - 1), dr.minimum(column, around - 0.51), m.w


@dataclass(frozen=True, slots=True)
class GlobeGrid:
    """Numbers of cells of the grid over the globe."""

    between: mi.UInt32  # cells between the lids
    under: mi.UInt32  # cells under the lids from which light gets there
    coarse: mi.UInt32  # cells of the grid reduced by 2 that contain those of `under`
    over: mi.UInt32  # index in `coarse` for each cell of `under`

    @classmethod
    def upload(cls, cells: GlobeCells) -> GlobeGrid:
        """Copy the cells of a pose to the device."""
        return cls(*(_numbers(numbers) for numbers in (cells.between, cells.under, cells.coarse, cells.over)))


def globe_cells(row: mi.Float, column: mi.Float) -> Bilinear:
    """Return cells of the grid over the globe around positions."""
    u = dr.clip(column, 0, SIDE - 1.001)
    j = mi.UInt32(u)
    return _between_rows(row, SIDE, SIDE, (j, j + 1), u - mi.Float(j))


def globe_place(n: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Return row and column in the globe's grid of directions (scene's frame) from its centre, of any length."""
    n = dr.normalize(n)
    scale = dr.sqrt(2 * dr.rcp(dr.maximum(1 + n.x, 0.1))) * (SIDE / WIDTH)
    return scale * n.z + 0.5 * (SIDE - 1), scale * n.y + 0.5 * (SIDE - 1)


def globe_direction(row: mi.Float, column: mi.Float) -> mi.Vector3f:
    """Compute directions (scene's frame) of positions in the globe's grid."""
    a, b = ((k - 0.5 * (SIDE - 1)) * (WIDTH / SIDE) for k in (column, row))
    q = a * a + b * b
    k = dr.sqrt(dr.maximum(1 - 0.25 * q, 0))
    return mi.Vector3f(1 - 0.5 * q, a * k, b * k)


def _numbers(cells: Ints) -> mi.UInt32:
    """Copy numbers of cells to the device, at least one of them."""
    return mi.UInt32(aligned_copy((cells if cells.size else np.zeros(1)).astype(np.uint32)))


@dataclass(kw_only=True)
class Pyramid:
    """A grid and its reductions, read bilinearly."""

    rows: mi.UInt32  # number of rows of the finest grid
    columns: mi.UInt32  # number of its columns
    closed: bool  # whether the columns form a closed ring
    cells: mi.Float  # for each cell of all levels, its own value and those to the right, below, and below right

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
