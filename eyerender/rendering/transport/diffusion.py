"""Light of all lamps on skin and sclera after its way through the tissue, once per frame on grids over their surfaces.

Light enters the skin at one point and leaves it around there. What leaves is the irradiance, averaged about each point
with the weights of `optics.diffusion`, times the albedo. So even light is reflected as by a matte surface, shadows have
soft edges, and the finest relief is seen in the sheen alone.

The light straight from the lamps is found with its shadows at points within each cell of a coarse grid that is fixed
to the tissue (skin) or of one fixed to the head (globe). On the skin it is a vector, whose product with the normal of
the relief is the irradiance of finer cells. The irradiance is then averaged over rings of a few places in the tangent
plane, each ring a sixth of the light. Places of wide rings read grids that were reduced by factors of two, and so are
the cells whose light they give. On the skin the way out to the rings is walked in steps, because the size of a cell
changes along it.

The grids also tell which share of each lamp every cell sees, for the highlights.

Where a lid lies on the globe, the globe receives what the lid transmits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import Ints
from ...optics.diffusion import rings, transmitted
from ...region.skin import BANDS, SHEET_ROWS
from ..hits.interaction import EPSILON_MM
from ..records.frame import Frame, aligned_copy, quotient
from ..records.job import LampTable, RenderJob
from ..records.recording import recorded
from ..scene.diffusiongrids import SIDE, WIDTH, DiffusionGrids, GlobeCells, SheetCells
from ..scene.region import SHEET_COLUMNS, RegionScene, SkinGeometry
from .directlight import irradiance, lamp_blocked

_LEVELS = 5  # each half as fine as the one before
_RINGS, _TURNS = 6, 6
_LEVEL_RINGS = (0, 1), (1, 4), (4, 6)  # whose light is found on the grid over the skin, and on its two reductions
_FOOTPRINT = 0.8  # size of the cells that a ring reads, in units of its radius
_RAYS = 6  # to the lamps from each cell, and at least one to each
_SMALL, _WIDE_RAYS = 0.02, 16  # radius over distance of lamps of which one point is enough; points of larger ones
_FINEST_MM = 0.02  # of a cell; about the corners of the eye they are smaller
_LID_MM = 4.5  # thicker than any lid
_BETWEEN_MM = 0.05  # between the two surfaces of a lid, at least
_JOINT_MM, _ABOVE_MM = 0.05, 0.15  # above the globe, where the light on conjunctiva and globe is found
_KEYS = (0x51CA, 0x1A3B)
_ALPHA = (0.7548776662466927, 0.5698402909980532)


class Pyramid:
    """A grid of numbers with its reductions by 2, 4, ..., read bilinearly; `around` says whether the columns close."""

    def __init__(self, cells: int, size: tuple[mi.UInt32, mi.UInt32], around: bool) -> None:
        """Prepare for so many numbers, in so many rows and columns."""
        self._finest, self._size, self._around = cells, size, around
        self._cells: mi.Float | None = None

    def fill(self, values: mi.Float) -> None:
        """Set the numbers, row by row."""
        dr.eval(values)
        counts = [self._finest >> 2 * k for k in range(_LEVELS)]
        self._cells = dr.zeros(mi.Float, 4 * sum(counts))
        for k, count in enumerate(counts):
            index = dr.arange(mi.UInt32, count)
            rows, columns = (n >> k for n in self._size)
            row = index // columns
            column = index - row * columns
            if k:
                first, down = 4 * row * columns + 2 * column, 2 * columns
                a, b, c, d = (dr.gather(mi.Float, values, first + n) for n in (0, down, 1, down + 1))
                values = 0.25 * (a + b + c + d)
                dr.eval(values)
            right = dr.select(column + 1 < columns, column + 1, 0 if self._around else column)
            below = dr.minimum(row + 1, rows - 1)
            place = self._first(rows * columns) + index
            for n, (i, j) in enumerate(((row, column), (row, right), (below, column), (below, right))):
                dr.scatter(self._cells, dr.gather(mi.Float, values, i * columns + j), 4 * place + n)
        dr.eval(self._cells)

    def _first(self, cells: mi.UInt32) -> mi.UInt32:
        """Number of the first cell of the level that has so many of them."""
        return (self._size[0] * self._size[1] - cells) // 3 * 4

    def at(self, row: mi.Float, column: mi.Float, level: mi.UInt32 | int, active: mi.Bool | bool = True) -> mi.Float:
        """Numbers at places in units of the finest cells, whose middles are at integers."""
        level = mi.UInt32(level)
        scale = dr.rcp(mi.Float(mi.UInt32(1) << level))
        rows, columns = (n >> level for n in self._size)
        first = self._first(rows * columns)
        v = dr.clip((row + 0.5) * scale - 0.5, 0, mi.Float(rows) - 1)
        u = (column + 0.5) * scale - 0.5
        if self._around:
            u -= dr.floor(u / mi.Float(columns)) * mi.Float(columns)
        else:
            u = dr.clip(u, 0, mi.Float(columns) - 1)
        i, j = mi.UInt32(v), dr.minimum(mi.UInt32(u), columns - 1)
        s, t = u - mi.Float(j), v - mi.Float(i)
        four = dr.gather(mi.Vector4f, self._cells, first + i * columns + j, active)
        high, low = four.x + s * (four.y - four.x), four.z + s * (four.w - four.z)
        return high + t * (low - high)


def _level(size_mm: mi.Float, cell_mm: mi.Float) -> mi.UInt32:
    """Reduction whose cells are about so large."""
    return mi.UInt32(dr.clip(dr.log2(dr.maximum(size_mm / cell_mm, 1)) + 0.5, 0, _LEVELS - 1))


@dataclass(frozen=True, slots=True)
class Places:
    """Places in the tangent plane that stand for equal shares of the light: (x, y, dx, dy) in mm, row by row.

    Walks go out from the middle over places of growing distance; dx and dy are the steps. Places of a walk alternate
    in direction, so that neighbouring rings fill each other's gaps.
    """

    table: mi.Float

    @classmethod
    def of(cls, length_mm: float) -> Places:
        """Make the places for light that spreads so far."""
        turn = 2 * np.pi * (np.arange(_TURNS)[:, None] + 0.5 + 0.5 * (np.arange(_RINGS) % 2)) / _TURNS
        place = rings(_RINGS)[:, None] * length_mm * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        steps = np.diff(place, axis=1, prepend=np.zeros((_TURNS, 1, 2)))
        return cls(mi.Float(aligned_copy(np.concatenate([place, steps], axis=-1).astype(np.float32).ravel())))

    def share(
        self,
        start: tuple[mi.Float, mi.Float],
        read: Callable[..., tuple[mi.Float, mi.Float, mi.Float]],
        first: int = 0,
        last: int = _RINGS,
    ) -> mi.Float:
        """Share of the mean over all places that some of the rings have.

        Args:
            start: row and column where walks begin.
            read: called with the place (mm), the way to it from the place before, its distance, and row and column of
                the place before; returns the number at the place, and its row and column.
            first: the first of the rings.
            last: the ring after the last one.
        """
        inner, count = mi.UInt32(first), mi.UInt32(last - first)

        def more(k: mi.UInt32, *_: object) -> mi.Bool:
            return k < count * _TURNS

        def body(k: mi.UInt32, total: mi.Float, row: mi.Float, column: mi.Float) -> tuple[Any, ...]:
            turn = quotient(k, count)
            begins = k == turn * count
            row, column = dr.select(begins, start[0], row), dr.select(begins, start[1], column)
            place = dr.gather(mi.Vector4f, self.table, turn * _RINGS + inner + k - turn * count)
            distance = dr.sqrt(place.x * place.x + place.y * place.y)
            way = dr.select(begins, mi.Point2f(place.x, place.y), mi.Point2f(place.z, place.w))
            value, row, column = read(mi.Point2f(place.x, place.y), way, distance, row, column)
            return k + 1, total + value, row, column

        state = (mi.UInt32(0), mi.Float(0) * start[0], *start)
        labels = ("k", "total", "row", "column")
        return dr.while_loop(state, more, body, labels=labels, label="places")[1] * (1 / (_RINGS * _TURNS))


@dataclass(kw_only=True)
class DiffusedLight:
    """Light of the lamps on skin and globe, each after its way through the tissue.

    Attributes:
        size: of the grid over the skin.
        skin: light of cells of the skin, and the shares of the lamps that they see, cell by cell.
        globe: the same of the globe.
        lamps: number of the lamps, at least 1.
    """

    size: Size
    skin: tuple[mi.Float, mi.Float]
    globe: tuple[mi.Float, mi.Float]
    lamps: mi.UInt32

    def on_skin(self, u: mi.Float, v: mi.Float) -> mi.Float:
        """Irradiance (mW/mm^2) at coordinates of the map of the skin."""
        return self.size.between(mi.Float, self.skin[0], *self.size.place(u, v), 0)

    def skin_sees(self, u: mi.Float, v: mi.Float) -> Callable[[mi.UInt32], mi.Float]:
        """Shares of the lamps, by their numbers, that the skin sees at coordinates of its map."""
        cells = self.size.cells(*self.size.place(u, v), 1)
        return lambda lamp: dr.clip(cells.of(mi.Float, self.skin[1], self.lamps, lamp), 0, 1)

    def on_globe(self, frame: Frame, x: mi.Vector3f) -> mi.Float:
        """Irradiance (mW/mm^2) at points of the globe (eye frame)."""
        row, column = _globe_cell(frame, x)
        u = dr.clip(column, 0, SIDE - 1.001)
        j = mi.UInt32(u)
        return _Cells.at(row, u - mi.Float(j), (j, j + 1), (SIDE, SIDE)).of(mi.Float, self.globe[0])

    def globe_sees(self, frame: Frame, x: mi.Vector3f) -> Callable[[mi.UInt32], mi.Float]:
        """Shares of the lamps, by their numbers, that points of the globe (eye frame) see."""
        row, column = (mi.UInt32(dr.clip(p + 0.5, 0, SIDE - 1)) for p in _globe_cell(frame, x))
        first = (row * SIDE + column) * self.lamps
        return lambda lamp: dr.gather(mi.Float, self.globe[1], first + lamp)


def _globe_cell(frame: Frame, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Row and column of points of the globe (eye frame) in the grid over it."""
    return _globe_place(frame.vector_to_scene(x - frame.sclera.centre))


def diffused_light(
    job: RenderJob, frame: Frame, lamps: LampTable, place: RegionScene, cells: DiffusionGrids
) -> DiffusedLight:  # fmt: skip
    """Compute the light on the tissues of a frame.

    Args:
        job: the job.
        frame: the frame.
        lamps: its lamps, on the host.
        place: the posed region.
        cells: the cells of the grids.
    """
    scattering = job.look.scattering
    assert scattering is not None
    assert job.region is not None
    skin, globe = SheetGrid.of(cells.sheet), GlobeGrid.of(cells.globe)
    wide, count = lamps.widest >= _SMALL, max(len(lamps), 1)
    rays = -(-_RAYS // count)
    make = _Maker(
        frame,
        place.skin,
        place.relief[skin.rows],
        dr.opaque(mi.Bool, wide),
        (dr.opaque(mi.UInt32, max(rays, _WIDE_RAYS if wide else 1)), dr.opaque(mi.UInt32, rays)),
        dr.opaque(mi.Float, transmitted(job.region.skin.albedo, scattering.skin_per_mm)),
        count,
    )
    sheet, between = make.both(skin, globe, Places.of(cells.thick_mm), Places.of(cells.thin_mm))
    return DiffusedLight(size=skin.size, skin=sheet, globe=between, lamps=dr.maximum(frame.lights.count, 1))


@dataclass(frozen=True, slots=True)
class _Maker:
    """What the grids of a frame are computed from.

    Attributes:
        frame: the frame.
        scene: the posed region.
        skin: its surface.
        relief: slopes of the cells of the skin's grid.
        wide: whether some lamp is too wide for one point.
        rays: number of rays to each lamp from cells of skin and globe.
        loss_per_mm: of light on its way through a lid.
        lamps: number of lamps, at least 1.
    """

    frame: Frame
    skin: SkinGeometry
    relief: mi.Float
    wide: mi.Bool
    rays: tuple[mi.UInt32, mi.UInt32]
    loss_per_mm: mi.Float
    lamps: int

    @recorded
    def both(
        self, skin: SheetGrid, globe: GlobeGrid, thick: Places, thin: Places
    ) -> tuple[tuple[mi.Float, mi.Float], tuple[mi.Float, mi.Float]]:
        """Light on skin and globe after its way through the tissue, and how much of each lamp cells see there."""
        light, seen = self._sheet(skin.measured(self.skin), thick)
        return (light, seen), self._globe(globe, skin.size, light, thin)

    def _sheet(self, grid: SheetGrid, places: Places) -> tuple[mi.Float, mi.Float]:
        """Light on the skin, and how much of each lamp coarse cells see."""
        straight, seen = self._from_lamps(grid)
        index = grid.sent[0]
        columns = grid.size.columns
        row, column = index // columns, index % columns
        across = (mi.Float(column) + 0.5) * ((SHEET_COLUMNS - 1) / mi.Float(columns))
        _, n = self.skin.sheet_point(grid.vertex_row(row, mi.Float(0.5)), across)
        relief = dr.gather(mi.Vector2f, self.relief, index)
        flux = grid.size.between(mi.Vector4f, straight, mi.Float(row), mi.Float(column), 1)
        facing = dr.dot(mi.Vector3f(flux.x, flux.y, flux.z), self.skin.tilted(n, relief.x, relief.y))
        whole = dr.zeros(mi.Float, grid.rows * grid.columns)
        dr.scatter(whole, dr.maximum(facing, 0), index)
        return grid.spread(whole, places), seen

    def _from_lamps(self, grid: SheetGrid) -> tuple[mi.Float, mi.Float]:
        """Light straight from the lamps at coarse cells.

        Light that passes a place varies slowly, but for shadows. So it is computed for two by two cells as a vector F
        (three of four numbers for each cell, scene's frame): the irradiance of a surface with the normal n is F . n.

        Returns:
            The vectors, and the share of each lamp that each cell sees, cell by cell.
        """
        frame, lights, skin = self.frame, self.frame.lights, self.skin
        cells, columns = grid.rows * grid.columns // 4, grid.size.columns // 2
        straight = dr.zeros(mi.Float, 4 * cells)
        seen = dr.zeros(mi.Float, self.lamps * cells)
        index = grid.sent[1]
        row, column = index // columns, index % columns
        centre = frame.point_to_scene(frame.sclera.centre)
        points, spread = self.rays[0], self.wide
        shifts = [mi.sample_tea_32(index, mi.UInt32(key)) for key in _KEYS]

        def place(s: mi.Float, t: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f]:
            half = mi.UInt32(2 * t)
            across = (mi.Float(column) + s) * ((SHEET_COLUMNS - 1) / mi.Float(columns))
            x, n = skin.sheet_point(grid.vertex_row(2 * row + half, 2 * t - mi.Float(half)), across)
            # The conjunctiva dips into the globe where both join. Neither shades the other there.
            out = x - centre
            return centre + out * dr.maximum(1, (frame.sclera.radius + _JOINT_MM) * dr.rcp(dr.norm(out))), n

        at, n = place(mi.Float(0.5), mi.Float(0.5))
        x, facing = frame.point_to_eye(at), frame.vector_to_eye(n)

        def of_lamp(i: mi.UInt32, total: mi.Vector3f) -> tuple[mi.UInt32, mi.Vector3f]:
            lamp = lights[i]
            before = spread | (dr.dot(lamp.position - x, facing) > 0)
            clear = self.frame.caches.shadow_maps.at(i, at, before)
            count = dr.select(before, dr.select(clear & ~spread, 1, points), 0)

            def at_point(k: mi.UInt32, flux: mi.Vector3f, free: mi.Float) -> tuple[mi.UInt32, mi.Vector3f, mi.Float]:
                u, v = _spots(shifts[1], k)
                sine, cosine = dr.sincos(v * (2 * dr.pi))
                start = frame.point_to_eye(place(*_spots(shifts[0], k))[0])
                source = lamp.point(u, sine, cosine)
                hidden = lamp_blocked(frame, start, source, True, True, ~clear)
                to = dr.select(spread, source, lamp.position) - x
                inv2 = dr.rcp(dr.squared_norm(to))
                to *= dr.sqrt(inv2)
                lit = dr.select(hidden | (dr.dot(to, facing) <= 0), 0, lamp.radiant_intensity(-to) * inv2)
                return k + 1, flux + lit * to, free + dr.select(hidden, 0, 1)

            state, labels = (mi.UInt32(0), mi.Vector3f(0), mi.Float(0)), ("k", "flux", "free")
            _, flux, free = dr.while_loop(
                state, lambda k, *_: k < count, at_point, labels=labels, label="points of a lamp"
            )
            share = dr.rcp(dr.maximum(mi.Float(count), 1))
            dr.scatter(seen, free * share, index * lights.count + i)
            return i + 1, total + flux * share

        state = (mi.UInt32(0), mi.Vector3f(0) * x.x)
        labels = ("i", "total")
        _, total = dr.while_loop(state, lambda i, _: i < lights.count, of_lamp, labels=labels, label="lamps on skin")
        total = frame.vector_to_scene(total)
        dr.eval(total)
        for k, number in enumerate((total.x, total.y, total.z)):
            dr.scatter(straight, number, 4 * index + k)
        dr.eval(straight, seen)
        return straight, seen

    def _globe(self, grid: GlobeGrid, size: Size, sheet: mi.Float, places: Places) -> tuple[mi.Float, mi.Float]:
        """Light on the globe between the lids, and how much of each lamp cells see."""
        # What comes through a lid varies slowly, so it is found for two by two cells.
        coarse = dr.zeros(mi.Float, SIDE * SIDE // 4)
        dr.scatter(coarse, self._through_lids(grid.coarse, size, sheet), grid.coarse)
        cells = dr.zeros(mi.Float, SIDE * SIDE)
        dr.scatter(cells, dr.gather(mi.Float, coarse, grid.over), grid.under)
        lit, seen = self._on_globe(grid.between)
        dr.scatter(cells, dr.gather(mi.Float, cells, grid.between) + lit, grid.between)
        return grid.spread(cells, self.frame.sclera.radius, places), seen

    def _on_globe(self, index: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        """Irradiance of cells of the grid over the globe straight from the lamps; shares of each lamp that they see."""
        frame, lights = self.frame, self.frame.lights
        seen = dr.zeros(mi.Float, self.lamps * SIDE * SIDE)
        points = self.rays[1]
        shifts = [mi.sample_tea_32(index, mi.UInt32(key)) for key in _KEYS]

        def of_lamp(i: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            lamp = lights[i]

            def at_point(k: mi.UInt32, total: mi.Float, free: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
                a, b = _spots(shifts[0], k)
                row, column = mi.Float(index // SIDE) + b - 0.5, mi.Float(index % SIDE) + a - 0.5
                x, normal = self._globe_surface(_globe_direction(row, column))
                x += _ABOVE_MM * normal
                u, v = _spots(shifts[1], k)
                source = lamp.point(u, *dr.sincos(v * (2 * dr.pi)))
                lit = irradiance(lamp, source, x, normal)
                local = frame.surfaces[0].point_in(x)
                outside = local.y * local.y + local.z * local.z > dr.square(frame.limbus.radius)
                hidden = lamp_blocked(frame, x, source, False, outside, lit > 0)
                return k + 1, total + dr.select(hidden, 0, lit), free + dr.select(hidden, 0, 1)

            state, labels = (mi.UInt32(0), mi.Float(0), mi.Float(0)), ("k", "total", "free")
            _, lit, free = dr.while_loop(state, lambda k, *_: k < points, at_point, labels=labels, label="in cells")
            share = dr.rcp(mi.Float(points))
            dr.scatter(seen, free * share, index * lights.count + i)
            return i + 1, total + lit * share

        state = (mi.UInt32(0), mi.Float(0) * mi.Float(index))
        labels = ("i", "total")
        _, total = dr.while_loop(state, lambda i, _: i < lights.count, of_lamp, labels=labels, label="lamps on globe")
        dr.eval(total, seen)
        return total, seen

    def _globe_surface(self, n: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Point and normal (eye frame) of the globe along directions (scene's frame) from its centre."""
        frame, away = self.frame, 8.0
        d = frame.vector_to_eye(n)
        o = frame.sclera.centre + (frame.sclera.radius + away) * d
        front = frame.surfaces[0]
        ol, dl = front.point_in(o), front.vector_in(-d)
        t, met, facing = front.meet(ol, dl)
        y = ol + t * dl
        met &= (y.y * y.y + y.z * y.z < dr.square(frame.limbus.radius)) & (y.x > frame.limbus.floor) & (t < away)
        return o - dr.select(met, t, away) * d, dr.normalize(dr.select(met, front.vector_out(facing), d))

    def _through_lids(self, index: mi.UInt32, size: Size, sheet: mi.Float) -> mi.Float:
        """Irradiance of two by two cells of the globe by way of lids on them: exp(-k t) of that on the lid's skin."""
        frame, skin, half = self.frame, self.skin, SIDE // 2
        n = _globe_direction(2 * mi.Float(index // half) + 0.5, 2 * mi.Float(index % half) + 0.5)
        start = frame.point_to_scene(self._globe_surface(n)[0])
        inner = self._next(start, n, mi.Float(EPSILON_MM), mi.Bool(True))
        outer = self._next(start, n, inner.t + _BETWEEN_MM, inner.is_valid())
        last = dr.select(outer.is_valid(), outer.t, inner.t)
        face = skin.face(inner)
        face = dr.select(outer.is_valid(), skin.face(outer), face)
        uv = dr.select(outer.is_valid(), outer.prim_uv, inner.prim_uv)
        under = inner.is_valid() & skin.on_sheet(face)
        lit = size.between(mi.Float, sheet, *size.place(*skin.map_place(face, uv, under)), 0)
        return dr.select(under, lit * dr.exp(-self.loss_per_mm * last), 0)

    def _next(self, o: mi.Vector3f, d: mi.Vector3f, first: mi.Float, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """First hit along rays beyond a distance and within a lid's thickness; its t counts from the start."""
        ray = mi.Ray3f(mi.Point3f(o + first * d), d)
        ray.maxt = _LID_MM - first
        hit = self.frame.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        hit.t += first
        return hit


@dataclass(frozen=True, slots=True)
class Size:
    """Numbers of rows and columns of a grid over the skin, on the device; the columns close."""

    rows: mi.UInt32
    columns: mi.UInt32

    def count(self, level: int) -> mi.UInt32:
        """Number of cells of the grid reduced by 2^level."""
        return (self.rows * self.columns) >> (2 * level)

    def place(self, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Row and column at coordinates of the map."""
        rows, columns = (mi.Float(n) for n in (self.rows, self.columns))
        return v * ((SHEET_ROWS + BANDS) / SHEET_ROWS) * rows - 0.5, u * columns - 0.5

    def between(
        self,
        kind: Any,
        buffer: mi.Float,
        row: mi.Float,
        column: mi.Float,
        level: int,
    ) -> Any:
        """Numbers between the cells of the grid reduced by 2^level, at places in units of its finest cells."""
        return self.cells(row, column, level).of(kind, buffer)

    def cells(self, row: mi.Float, column: mi.Float, level: int) -> _Cells:
        """Cells of the grid reduced by 2^level, about places in units of its finest cells."""
        rows, columns, scale = self.rows >> level, self.columns >> level, 1 / (1 << level)
        u = (column + 0.5) * scale - 0.5
        u = dr.select(u < 0, u + mi.Float(columns), u)
        j = dr.minimum(mi.UInt32(u), columns - 1)
        right = dr.select(j + 1 < columns, j + 1, 0)
        return _Cells.at((row + 0.5) * scale - 0.5, u - mi.Float(j), (j, right), (rows, columns))


@dataclass(frozen=True, slots=True)
class SheetGrid:
    """The grid over a posed sheet of skin.

    Attributes:
        rows: number of its rows.
        columns: number of its columns, which close.
        size: the same on the device.
        sent: numbers of its cells that matter, and of the cells about them on the grid reduced by 2 and by 4.
        edges: row of the sheet's vertices at the edges of the grid's rows.
        middles: the same in their middles.
        metric: for each row and column of vertices: columns per mm along the row, a, rows per mm across it, size of a
            cell (mm). A place x mm along and y mm across is y per-mm rows and (x - a rows) per-mm columns away. None
            before it is `measured`.
    """

    rows: int
    columns: int
    size: Size
    sent: tuple[mi.UInt32, ...]
    edges: mi.Float
    middles: mi.Float
    metric: mi.Float | None = None

    @classmethod
    def of(cls, cells: SheetCells) -> SheetGrid:
        """Send the cells of a pose to the device."""
        rows, columns = cells.rows, cells.columns
        size = Size(dr.opaque(mi.UInt32, rows), dr.opaque(mi.UInt32, columns))
        sent = tuple(_numbers(numbers) for numbers in cells.numbers)
        return cls(rows, columns, size, sent, *(mi.Float(aligned_copy(at)) for at in (cells.edges, cells.middles)))

    def measured(self, skin: SkinGeometry) -> SheetGrid:
        """The same grid with its metric on a posed surface."""
        columns, last = SHEET_COLUMNS - 1, mi.UInt32(self.rows - 1)
        index = dr.arange(mi.UInt32, self.rows * columns)
        i = index // columns
        j = index - i * columns

        def point(i: mi.UInt32, j: mi.UInt32) -> mi.Vector3f:
            return skin.sheet_point(dr.gather(mi.Float, self.middles, i), mi.Float(j))[0]

        before, after = dr.select(j > 0, j - 1, columns - 1), dr.select(j + 1 < columns, j + 1, 0)
        above, below = dr.maximum(i, 1) - 1, dr.minimum(i + 1, last)
        along = (point(i, after) - point(i, before)) * (0.5 * columns / mi.Float(self.size.columns))
        down = (point(below, j) - point(above, j)) / mi.Float(below - above)
        width = dr.maximum(dr.norm(along), 1e-6)
        a = dr.dot(along, down) / width
        height = dr.maximum(dr.sqrt(dr.maximum(dr.squared_norm(down) - a * a, 0)), _FINEST_MM)
        width = dr.maximum(width, _FINEST_MM)
        metric = dr.zeros(mi.Float, 4 * self.rows * columns)
        dr.scatter(metric, mi.Vector4f(dr.rcp(width), a, dr.rcp(height), dr.maximum(width, height)), index)
        dr.eval(metric)
        return replace(self, metric=metric)

    def spread(self, irradiance: mi.Float, places: Places) -> mi.Float:
        """What leaves the skin, cell by cell, of the light that falls on it, to places about each."""
        straight = Pyramid(self.rows * self.columns, (self.size.rows, self.size.columns), True)
        straight.fill(irradiance)

        def read(
            place: mi.Point2f, way: mi.Point2f, distance: mi.Float, row: mi.Float, column: mi.Float
        ) -> tuple[mi.Float, ...]:
            del place
            row, column, cell = self.step(row, column, way.x, way.y)
            return straight.at(row, column, _level(_FOOTPRINT * distance, cell)), row, column

        light = mi.Float(0)
        # The farther light has come, the more evenly it is spread, and the fewer cells tell it.
        for level, rings_of in reversed(list(enumerate(_LEVEL_RINGS))):
            index, columns, size = self.sent[level], self.size.columns >> level, float(1 << level)
            row, column = ((mi.Float(n) + 0.5) * size - 0.5 for n in (index // columns, index % columns))
            wider, light = light, places.share((row, column), read, *rings_of)
            if level + 1 < len(_LEVEL_RINGS):
                light += self.size.between(mi.Float, wider, row, column, level + 1)
            dr.eval(light)
            everywhere = dr.zeros(mi.Float, self.rows * self.columns >> 2 * level)
            dr.scatter(everywhere, light, index)
            light = everywhere
        return light

    def vertex_row(self, row: mi.UInt32, share: mi.Float) -> mi.Float:
        """Row of the sheet's vertices at a share of the grid's rows."""
        a, b = (dr.gather(mi.Float, self.edges, row + k) for k in (0, 1))
        return a + share * (b - a)

    def step(self, row: mi.Float, column: mi.Float, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Go x mm along a row and y mm across: the new row and column, and the size of a cell (mm)."""
        columns, around = SHEET_COLUMNS - 1, mi.Float(self.size.columns)
        i = mi.UInt32(row + 0.5)
        j = mi.UInt32((column + 0.5) * (columns / around) + 0.5)
        m = dr.gather(mi.Vector4f, self.metric, i * columns + dr.select(j < columns, j, 0))
        down = y * m.z
        column += (x - m.y * down) * m.x
        column -= dr.floor(column / around) * around
        return dr.clip(row + down, 0, mi.Float(self.size.rows) - 1), dr.minimum(column, around - 0.51), m.w


@dataclass(frozen=True, slots=True)
class GlobeGrid:
    """Numbers of cells of the grid over the globe.

    Attributes:
        between: those between the lids.
        under: those under the lids whose light gets there.
        coarse: cells of the grid reduced by 2 that hold the latter.
        over: the one of these for each of `under`.
    """

    between: mi.UInt32
    under: mi.UInt32
    coarse: mi.UInt32
    over: mi.UInt32

    @classmethod
    def of(cls, cells: GlobeCells) -> GlobeGrid:
        """Send the cells of a pose to the device."""
        return cls(*(_numbers(numbers) for numbers in (cells.between, cells.under, cells.coarse, cells.over)))

    def spread(self, irradiance: mi.Float, radius_mm: mi.Float, places: Places) -> mi.Float:
        """What leaves the globe between the lids, cell by cell, of the light that falls on it, to places about each."""
        side, light = mi.UInt32(SIDE), dr.zeros(mi.Float, SIDE * SIDE)
        straight = Pyramid(SIDE * SIDE, (side, side), False)
        straight.fill(irradiance)
        index = self.between
        start = mi.Float(index // SIDE), mi.Float(index % SIDE)
        n = _globe_direction(*start)
        across = dr.normalize(mi.Vector3f(-n.y, n.x, 0))
        up = dr.cross(n, across)

        def read(place: mi.Point2f, way: mi.Point2f, distance: mi.Float, *_: mi.Float) -> tuple[mi.Float, ...]:
            del way
            sine, cosine = dr.sincos(distance / radius_mm)
            out = (sine / distance) * (place.x * across + place.y * up)
            row, column = _globe_place(cosine * n + out)
            return straight.at(row, column, _level(_FOOTPRINT * distance, WIDTH / SIDE * radius_mm)), row, column

        dr.scatter(light, places.share(start, read), index)
        return light


def _spots(shift: tuple[mi.UInt32, mi.UInt32], k: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """The k-th of places in [0, 1)^2 that fill it evenly, for lanes with a shift."""
    u, v = (
        mi.Float((s + k * mi.UInt32(round(a * 2**32))) >> 8) * (2.0**-24) for s, a in zip(shift, _ALPHA, strict=True)
    )
    return u, v


@dataclass(frozen=True, slots=True)
class _Cells:
    """The four cells of a grid about places, row by row, and the shares of the way across and down between them."""

    numbers: tuple[mi.UInt32, ...]
    across: mi.Float
    down: mi.Float

    @classmethod
    def at(
        cls,
        row: mi.Float,
        across: mi.Float,
        beside: tuple[mi.UInt32, mi.UInt32],
        size: tuple[mi.UInt32 | int, mi.UInt32 | int],
    ) -> _Cells:
        """Find the cells between rows, at a share of the way from the first to the second of two columns."""
        v = dr.clip(row, 0, mi.Float(size[0]) - 1.001)
        i = mi.UInt32(v)
        return cls(tuple(p * size[1] + q for p in (i, i + 1) for q in beside), across, v - mi.Float(i))

    def of(self, kind: Any, buffer: mi.Float, each: mi.UInt32 | int = 1, which: mi.UInt32 | int = 0) -> Any:
        """Numbers between the cells, of which each has so many."""
        a, b, c, d = (dr.gather(kind, buffer, n * each + which) for n in self.numbers)
        high, low = a + self.across * (b - a), c + self.across * (d - c)
        return high + self.down * (low - high)


def _numbers(cells: Ints) -> mi.UInt32:
    """Numbers of cells on the device, at least one of them."""
    return mi.UInt32(aligned_copy((cells if cells.size else np.zeros(1)).astype(np.uint32)))


def _globe_place(n: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Row and column of the grid over the globe in directions (scene's frame) from its centre, of any length."""
    n = dr.normalize(n)
    scale = dr.sqrt(2 * dr.rcp(dr.maximum(1 + n.x, 0.1))) * (SIDE / WIDTH)
    return scale * n.z + 0.5 * (SIDE - 1), scale * n.y + 0.5 * (SIDE - 1)


def _globe_direction(row: mi.Float, column: mi.Float) -> mi.Vector3f:
    """Directions (scene's frame) of places of the grid over the globe."""
    a, b = ((k - 0.5 * (SIDE - 1)) * (WIDTH / SIDE) for k in (column, row))
    q = a * a + b * b
    k = dr.sqrt(dr.maximum(1 - 0.25 * q, 0))
    return mi.Vector3f(1 - 0.5 * q, a * k, b * k)
