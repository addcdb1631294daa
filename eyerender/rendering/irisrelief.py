"""The relief of the iris: heights above its plane, parallax of camera rays, and the lamps' light on its slopes.

The height h(y, z) above the plane of the stop is that of the pattern (`region.iris`), which stretches with the iris
when the pupil changes, and of a gentle convexity. It is 0 at the pupil's margin and at the root, so outlines and labels
are those of the plane. Once per frame it is put on a square grid. A ray meets it where X(z) = X(0) + z t, with t its
lateral motion per mm of height, has the height z = h(X(z)); fixed-point steps find the place.

The irradiance of a slope is that of the plane times

    q = sum_l (E_l + h E'_l) V_l max(0, 1 - t_l . grad h) / (sqrt(1 + |grad h|^2) sum_l E_l)

with E_l the lamp's irradiance of the plane, E'_l its change per mm of height (light converges behind the cornea), t_l
the lamp's direction there as lateral motion per mm of height, and V_l whether it is seen over the heights beside. E_l,
E'_l and t_l change slowly and are computed on a coarse grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .frame import RenderJob
from .kept import KeptForEye
from .parameters import leaves, traversed
from .recorded import recorded
from .surfaces import Surface
from .values import Lights, Values
from .view import Textures, iris_height

_COARSE = 20  # places across, at which the lamps' directions are computed
_CELL_PX, _LEAST, _MOST = 0.6, 320, 448  # size of a cell in the picture, cells across: fewer would flatten slopes
_STEP = 16  # in the number of cells across: a new number has Dr.Jit record anew
_STEPS, _REACH_MM, _SOFT = 8, 0.32, 0.2  # of the search for what stands before a lamp
_BLOCK, _SLANT = 4, 0.6  # cells of a block across; lateral motion per mm of light that is not very slanting
_FIXED_POINT_STEPS = 4
_SPARE_MM, _RAISED_MM = 0.1, 0.2


@traversed
@dataclass(frozen=True, slots=True)
class Shape:
    """The heights of an iris on a grid, which do not depend on the pose.

    Attributes:
        heights: of the cells, mm.
        corners: the heights of the four corners of every cell, side by side.
        slopes: of the cells along the grid's rows and columns.
        steepest: largest slope.
        highest: largest height, mm.
        near: largest height about each block of cells, as far as light comes from that is not very slanting, mm.
    """

    heights: mi.Float
    corners: mi.Float
    slopes: tuple[mi.Float, mi.Float]
    steepest: mi.Float
    highest: mi.Float
    near: mi.Float


class IrisRelief:
    """Height of the iris above its plane and the lamps' light on it, on a grid over the plane."""

    DRJIT_STRUCT = leaves("_stop", "_half", "_count", "_on", "_each", "_heights", "_shades")

    def __init__(
        self, job: RenderJob, values: Values, lights: Lights, scene: mi.Scene, textures: Textures,
        shapes: KeptForEye[Shape],
    ) -> None:  # fmt: skip
        """Fill the grid.

        Args:
            job: the job of the frame.
            values: its numbers.
            lights: its lamps.
            scene: what may stand in the way.
            textures: the maps of the iris.
            shapes: the heights of irises that other frames have computed.
        """
        self._values, self._lights, self._scene, self._textures = values, lights, scene, textures
        self._job, self._shapes = job, shapes
        self._stop = values.stop
        self._half = values.iris.root_radius + _SPARE_MM
        self._half_mm = float(np.float32(job.eye.iris_root_radius_mm) + np.float32(_SPARE_MM))
        self._side = cells_across(job)
        self._count = dr.opaque(mi.UInt32, self._side)
        self._on = dr.opaque(mi.Bool, textures.raised)
        self._each = dr.opaque(mi.UInt32, lights.points)
        self._heights: mi.Float | None = None
        self._shades: mi.Float | None = None
        self._fill()

    def hit(self, x: mi.Vector3f, slant: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Foot in the plane (eye frame) of the place that rays meet.

        Args:
            x: where they would meet the plane.
            slant: their lateral motion per mm of height above it.
            active: the lanes that matter.
        """
        assert self._heights is not None
        active &= self._on
        z = mi.Float(0)
        for _ in range(_FIXED_POINT_STEPS):
            z = self._on_grid(self._heights, x + z * slant, active)
        return dr.select(active, x + z * slant, x)

    def share(self, x: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The q of the module's docstring at feet `x`."""
        assert self._shades is not None
        active &= self._on
        return dr.select(active, self._on_grid(self._shades, x, active), 1)

    def _fill(self) -> None:
        if not self._textures.raised:
            self._heights = self._shades = dr.zeros(mi.Float, 4)
            dr.make_opaque(self._heights)
            return
        cells, job = self._side**2, self._job
        lanes = _COARSE * _COARSE * self._lights.points * max(len(self._lights), 1)
        # The iris' own heights do not depend on the pose.
        blocks = -(-self._side // _BLOCK)
        about = int(np.ceil((_REACH_MM * _SLANT * self._side / (2 * self._half_mm) + 2) / _BLOCK))
        shape = self._shapes.get(
            job.eye,
            (self._side, job.look.iris_seed, job.look.iris),
            lambda: Shape(
                *self._shape(self._values, self._textures.heights, cells, blocks, dr.opaque(mi.UInt32, about))
            ),
        )
        self._shades = self._shaded(self._values, self._lights, self._scene, shape, cells, lanes)
        self._heights = shape.corners

    @recorded
    def _shape(
        self, values: Values, pattern: mi.Texture2f, cells: int, blocks: int, about: mi.UInt32
    ) -> tuple[Any, ...]:
        """Compute the fields of a `Shape` of so many cells.

        There are so many `blocks` across. Those up to `about` away from a block are near it.
        """
        column, row = self._cells(cells)
        heights = iris_height(values, pattern, self._place(mi.Float(column), mi.Float(row), self._count))
        dr.eval(heights)
        last = self._count - 1
        per = mi.Float(last) / (2 * self._half)

        def slope(high: mi.UInt32, low: mi.UInt32, apart: mi.UInt32) -> mi.Float:
            return (dr.gather(mi.Float, heights, high) - dr.gather(mi.Float, heights, low)) * per / mi.Float(apart)

        left, right = dr.maximum(column, 1) - 1, dr.minimum(column + 1, last)
        above, below = dr.maximum(row, 1) - 1, dr.minimum(row + 1, last)
        hu = slope(row * self._count + right, row * self._count + left, right - left)
        hv = slope(below * self._count + column, above * self._count + column, below - above)
        corners = self._packed(heights, column, row)
        dr.eval(hu, hv, corners)
        steepest, highest = dr.max(dr.sqrt(hu * hu + hv * hv)), dr.max(heights)
        index = dr.arange(mi.UInt32, blocks * blocks)
        count = last // _BLOCK + 1  # the same as `blocks`, but no kernel is compiled for it
        down = index // count
        across = index - down * count
        largest = mi.Float(0)
        for k in range(_BLOCK * _BLOCK):
            i, j = dr.minimum(across * _BLOCK + k % _BLOCK, last), dr.minimum(down * _BLOCK + k // _BLOCK, last)
            largest = dr.maximum(largest, dr.gather(mi.Float, heights, j * self._count + i))
        dr.eval(largest)
        wide = 2 * about + 1

        def beside(k: mi.UInt32, most: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            j = k // wide
            i = across + (k - j * wide)
            i, j = (dr.clip(mi.Int32(n) - mi.Int32(about), 0, mi.Int32(count) - 1) for n in (i, down + j))
            return k + 1, dr.maximum(most, dr.gather(mi.Float, largest, mi.UInt32(j) * count + mi.UInt32(i)))

        state = (mi.UInt32(0), dr.zeros(mi.Float, blocks * blocks))
        near = dr.while_loop(state, lambda k, _: k < wide * wide, beside, label="blocks beside")[1]
        dr.eval(steepest, highest, near)
        return heights, corners, (hu, hv), steepest, highest, near

    @recorded
    def _shaded(
        self, values: Values, lights: Lights, scene: mi.Scene, shape: Shape, cells: int, lanes: int
    ) -> mi.Float:
        """The q of the module's docstring at so many cells, from so many paths of light."""
        column, row = self._cells(cells)
        lamps = self._lamps(values, lights, scene, lanes)
        shades = self._lit(lights, lamps, shape, column, row)
        dr.eval(shades)
        shades = self._packed(shades, column, row)
        dr.eval(shades)
        return shades

    def _cells(self, cells: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Columns and rows of all cells, row by row."""
        index = dr.arange(mi.UInt32, cells)
        row = index // self._count
        return index - row * self._count, row

    def _place(self, column: mi.Float, row: mi.Float, count: mi.UInt32) -> mi.Vector3f:
        """Point of the plane at a place of a grid with `count` places across."""
        stop, per = self._stop, 2 * self._half / mi.Float(count - 1)
        return stop.centre + (column * per - self._half) * stop.u + (row * per - self._half) * stop.v

    def _cell(self, x: mi.Vector3f, count: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Float, mi.Float]:
        """Column and row of the cell of a point, and the place in it."""
        stop = self._stop
        q, most = x - stop.centre, mi.Float(count) - 1.001
        scale = 0.5 * mi.Float(count - 1) / self._half
        u, v = (dr.clip((dr.dot(q, axis) + self._half) * scale, 0, most) for axis in (stop.u, stop.v))
        i, j = mi.UInt32(u), mi.UInt32(v)
        return i, j, u - mi.Float(i), v - mi.Float(j)

    def _on_grid(self, packed: mi.Float, x: mi.Vector3f, active: mi.Bool) -> mi.Float:
        i, j, s, t = self._cell(x, self._count)
        c = dr.gather(mi.Vector4f, packed, j * self._count + i, active)
        return dr.lerp(dr.lerp(c.x, c.y, s), dr.lerp(c.z, c.w, s), t)

    def _packed(self, values: mi.Float, column: mi.UInt32, row: mi.UInt32) -> mi.Float:
        """The four corners of every cell, side by side."""
        last = self._count - 1
        right, below = dr.minimum(column + 1, last), dr.minimum(row + 1, last)
        corners = ((column, row), (right, row), (column, below), (right, below))
        places = [j * self._count + i for i, j in corners]
        out = dr.zeros(mi.Float, 4 * dr.width(values))
        four = mi.Vector4f(*(dr.gather(mi.Float, values, place) for place in places))
        dr.scatter(out, four, places[0])
        return out

    def _lamps(self, values: Values, lights: Lights, scene: mi.Scene, lanes: int) -> mi.Float:
        """E, E t_u, E t_v and E' of points of the lamps at coarse places, in rows."""
        from .lighting import LampPath, behind

        each, count = self._each, mi.UInt32(_COARSE)
        index = dr.arange(mi.UInt32, lanes)
        spot = index // (_COARSE * _COARSE)
        place = index - spot * (_COARSE * _COARSE)
        row = place // count
        x = self._place(mi.Float(place - row * count), mi.Float(row), count)
        lamp = lights[spot // each]
        source = lamp.node(spot - (spot // each) * each, each)
        normal = values.stop.normal
        # The search for paths to other points is long, and in vain.
        reached = (lights.count > 0) & behind(values.surfaces[-1], x)
        path = LampPath.to(values, scene, lamp, source, x, reached)
        above = LampPath.to(values, scene, lamp, source, x + _RAISED_MM * normal, reached)
        lit = dr.select(path.blocked, 0, path.gain)
        more = dr.select(above.gain > 0, (above.gain - path.gain) / _RAISED_MM, 0)
        lateral = _arrival(values.surfaces, source, path.entry, normal)
        rows = (lit, lit * dr.dot(lateral, values.stop.u), lit * dr.dot(lateral, values.stop.v), more)
        out = dr.zeros(mi.Float, 4 * dr.width(index))
        dr.scatter(out, mi.Vector4f(*(dr.select(lit > 0, value, 0) for value in rows)), index)
        dr.eval(out)
        return out

    def _lit(self, lights: Lights, lamps: mi.Float, shape: Shape, column: mi.UInt32, row: mi.UInt32) -> mi.Float:
        """The q of the module's docstring at cells of the grid."""
        stop, cell = self._stop, row * self._count + column
        x = self._place(mi.Float(column), mi.Float(row), self._count)
        h, hu, hv = (dr.gather(mi.Float, values, cell) for values in (shape.heights, *shape.slopes))
        across = (self._count + (_BLOCK - 1)) // _BLOCK
        near = dr.gather(mi.Float, shape.near, row // _BLOCK * across + column // _BLOCK)
        spots, coarse = lights.count * self._each, mi.UInt32(_COARSE)
        i, j, s, t = self._cell(x, coarse)
        place = j * coarse + i

        def lamp(k: mi.UInt32, whole: mi.Float, seen: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
            first = k * (_COARSE * _COARSE) + place
            a, b, c, d = (dr.gather(mi.Vector4f, lamps, first + off) for off in (0, 1, coarse, coarse + 1))
            both = dr.lerp(dr.lerp(a, b, s), dr.lerp(c, d, s), t)
            inv = dr.rcp(dr.maximum(both.x, 1e-20))
            tu, tv = both.y * inv, both.z * inv
            facing = dr.maximum(1 - tu * hu - tv * hv, 0)
            way = tu * stop.u + tv * stop.v
            slant = dr.norm(way)
            asked = (both.x > 0) & (facing > 0) & (slant * shape.steepest > 1)
            above = dr.select(slant < _SLANT, near, shape.highest) - h
            here = dr.maximum(both.x + h * both.w, 0)
            hidden = self._hidden(shape.corners, x, h, way, dr.select(asked, above, 0))
            return k + 1, whole + both.x, seen + here * facing * (1 - hidden)

        state = (mi.UInt32(0), mi.Float(0) * h, mi.Float(0) * h)
        labels = ("k", "whole", "seen")
        _, whole, seen = dr.while_loop(state, lambda k, *_: k < spots, lamp, labels=labels, label="relief")
        return dr.select(whole > 0, seen / whole * dr.rsqrt(1 + hu * hu + hv * hv), 1)

    def _hidden(self, corners: mi.Float, x: mi.Vector3f, h: mi.Float, way: mi.Vector3f, above: mi.Float) -> mi.Float:
        """Share by which heights beside points hide what lies in the direction `way`, 0 to 1.

        above: how much higher than the points these heights are at most, mm.
        """

        def rise(k: mi.UInt32) -> mi.Float:
            part = mi.Float(k + 1) / _STEPS
            return _REACH_MM * part * part

        def step(k: mi.UInt32, hidden: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            up = rise(k)
            over = self._on_grid(corners, x + up * way, mi.Bool(True)) - h - up
            return k + 1, dr.maximum(hidden, dr.clip(over / (_SOFT * up + 0.004), 0, 1))

        def more(k: mi.UInt32, _: mi.Float) -> mi.Bool:
            return (k < _STEPS) & (rise(k) < above)

        state = (mi.UInt32(0), mi.Float(0) * h)
        return dr.while_loop(state, more, step, labels=("k", "hidden"), label="shadows of the relief")[1]


def cells_across(job: RenderJob) -> int:
    """Number of cells across of the grid for a job."""
    half_mm = float(np.float32(job.eye.iris_root_radius_mm) + np.float32(_SPARE_MM))
    across = 2 * half_mm * float(job.camera.scale_at(job.t)) / _CELL_PX
    return int(min(max(_STEP * np.ceil(across / _STEP), _LEAST), _MOST))


def _arrival(
    surfaces: tuple[Surface, ...], source: mi.Vector3f, entry: mi.Vector3f, normal: mi.Vector3f
) -> mi.Vector3f:
    """Direction to a lamp behind the surfaces, as lateral motion per mm along `normal`, of light from `entry`."""
    w = dr.normalize(entry - source)
    x = entry - w
    for surface in surfaces:
        x, w, _, _ = surface.refract(x, w)
    down = dr.dot(w, normal)
    return w / dr.select(down < -0.05, down, -1) - normal
