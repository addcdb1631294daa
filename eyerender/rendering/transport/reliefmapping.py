"""Relief mapping of the iris: heights above its plane, parallax of camera rays, and lamp light on its slopes.

The height h(y, z) above the plane of the stop is that of the pattern (`region.iris`), which stretches with the iris
when the pupil changes, and of a gentle convexity. The height is 0 at the pupil's margin and at the root, so outlines
and labels are those of the plane. It is sampled once per frame on a square grid. With t the lateral motion of a ray per
mm of height, X(z) = X(0) + z t, the ray meets the relief at z = h(X(z)), which is solved by fixed-point iteration.

The irradiance of a slope is that of the plane times

    q = sum_l (E_l + h E'_l) V_l max(0, 1 - t_l . grad h) / (sqrt(1 + |grad h|^2) sum_l E_l)

with E_l the lamp's irradiance of the plane, E'_l its change per mm of height (light converges behind the cornea), t_l
the lamp's direction there as lateral motion per mm of height, and V_l its visibility over the surrounding heights. E_l,
E'_l and t_l vary slowly and are computed on a coarse grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..materials.albedo import iris_height
from ..records.frame import DeviceFrame
from ..records.job import RenderJob
from ..records.parameters import StopParameters
from ..records.recording import recorded, syntax
from ..records.surfaces import DeviceSurface
from .directlight import LampPath, behind

_COARSE = 20  # places across, at which the lamps' directions are computed
_CELL_PX, _LEAST, _MOST = 0.6, 320, 448  # size of a cell in the picture, cells across: fewer would flatten slopes
_STEP = 16  # the number of cells across is a multiple of this, because Dr.Jit records anew for each number
_STEPS, _REACH_MM, _SOFT = 8, 0.32, 0.2  # of the search for occluders of a lamp: steps, reach, and softness
_BLOCK, _SLANT = 4, 0.6  # cells of a block across; lateral motion per mm of light that is not very slanting
_FIXED_POINT_STEPS = 4
_SPARE_MM, _RAISED_MM = 0.1, 0.2


@dataclass(kw_only=True)
class ReliefShape:
    """The heights of an iris on a grid, which do not depend on the pose."""

    heights: mi.Float  # heights of the cells, mm
    corners: mi.Float  # the heights of the four corners of every cell, side by side
    slopes: tuple[mi.Float, mi.Float]  # slopes of the cells along the grid's rows and columns
    steepest: mi.Float  # largest slope
    highest: mi.Float  # largest height, mm
    near: mi.Float  # largest height around each block of cells, as far as all but very slanting light comes from, mm


@dataclass(kw_only=True)
class ReliefGrid:
    """A square grid over the plane of the iris, whose values are bilinear between its nodes."""

    stop: StopParameters  # the aperture stop, in whose plane the grid lies
    half: mi.Float  # half its width, mm
    count: mi.UInt32  # number of nodes along a side

    def nodes(self, number: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Return the columns and rows of all nodes, row by row."""
        index = dr.arange(mi.UInt32, number)
        row = index // self.count
        return index - row * self.count, row

    def point(self, column: mi.Float, row: mi.Float) -> mi.Vector3f:
        """Return the point of the plane (eye frame) at a column and row of the grid."""
        per = 2 * self.half / mi.Float(self.count - 1)
        return self.stop.centre + (column * per - self.half) * self.stop.u + (row * per - self.half) * self.stop.v

    def cell(self, x: mi.Vector3f) -> tuple[mi.UInt32, mi.UInt32, mi.Float, mi.Float]:
        """Return the column and row of the cell of a point of the plane, and the position in it."""
        q, most = x - self.stop.centre, mi.Float(self.count) - 1.001
        scale = 0.5 * mi.Float(self.count - 1) / self.half
        u, v = (dr.clip((dr.dot(q, axis) + self.half) * scale, 0, most) for axis in (self.stop.u, self.stop.v))
        i, j = mi.UInt32(u), mi.UInt32(v)
        return i, j, u - mi.Float(i), v - mi.Float(j)

    def interpolate(self, corners: mi.Float, x: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Interpolate the result of `corners_of` at points of the plane."""
        i, j, s, t = self.cell(x)
        c = dr.gather(mi.Vector4f, corners, j * self.count + i, active)
        return dr.lerp(dr.lerp(c.x, c.y, s), dr.lerp(c.z, c.w, s), t)

    def corners_of(self, values: mi.Float, column: mi.UInt32, row: mi.UInt32) -> mi.Float:
        """Arrange the values at the four corners of every cell side by side."""
        last = self.count - 1
        right, below = dr.minimum(column + 1, last), dr.minimum(row + 1, last)
        places = [j * self.count + i for i, j in ((column, row), (right, row), (column, below), (right, below))]
        corners = dr.zeros(mi.Float, 4 * dr.width(values))
        dr.scatter(corners, mi.Vector4f(*(dr.gather(mi.Float, values, place) for place in places)), places[0])
        return corners


@dataclass(kw_only=True)
class IrisRelief:
    """Height of the iris above its plane, and lamp light on it, on a grid over the plane."""

    count: mi.UInt32  # number of nodes along a side of the grid
    raised: mi.Bool  # whether the iris has any heights
    heights: mi.Float  # heights at the corners of the cells, mm
    shades: mi.Float  # the q of the module's docstring at the corners

    @classmethod
    def build(
        cls, frame: DeviceFrame, shape: ReliefShape | None, side: mi.UInt32, each: mi.UInt32, size: tuple[int, int]
    ) -> IrisRelief:
        """Compute the lamp light on the heights of an iris.

        Args:
            frame: the frame.
            shape: the heights; None for a flat iris.
            side: number of nodes along a side.
            each: number of points that represent a lamp.
            size: numbers of nodes, and of points of lamps.
        """
        if shape is None:
            nothing = dr.zeros(mi.Float, 4)
            dr.make_opaque(nothing)
            return cls(count=side, raised=dr.opaque(mi.Bool, False), heights=nothing, shades=nothing)
        grid = relief_grid(frame, side)
        column, row = grid.nodes(size[0])
        rows = _arriving(frame, grid, each, _COARSE * _COARSE * size[1])
        shades = _shades(frame.lights.count * each, rows, shape, grid, column, row)
        dr.eval(shades)
        shades = grid.corners_of(shades, column, row)
        dr.eval(shades)
        return cls(count=side, raised=dr.opaque(mi.Bool, True), heights=shape.corners, shades=shades)

    def hit(self, frame: DeviceFrame, x: mi.Vector3f, slant: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Compute where rays meet the relief, as the foot of that point in the plane (eye frame).

        `x`: points where the rays would meet the plane; `slant`: their lateral motion per mm of height above it;
        `active`: active lanes.
        """
        active &= self.raised
        grid, z = relief_grid(frame, self.count), mi.Float(0)
        for _ in range(_FIXED_POINT_STEPS):
            z = grid.interpolate(self.heights, x + z * slant, active)
        return dr.select(active, x + z * slant, x)

    def at(self, frame: DeviceFrame, x: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Return the q of the module's docstring at feet `x`."""
        active &= self.raised
        return dr.select(active, relief_grid(frame, self.count).interpolate(self.shades, x, active), 1)


class ReliefSize(NamedTuple):
    """Grid sizes of a job, on the host: nodes per side, blocks per side, and blocks near a block."""

    side: int
    blocks: int
    about: int

    @classmethod
    def of(cls, job: RenderJob) -> ReliefSize:
        """Choose the grid sizes by the size of the iris in the image."""
        half_mm = float(np.float32(job.eye.iris_root_radius_mm) + np.float32(_SPARE_MM))
        across = 2 * half_mm * float(job.camera.scale_at(job.t)) / _CELL_PX
        side = int(min(max(_STEP * np.ceil(across / _STEP), _LEAST), _MOST))
        return cls(side, -(-side // _BLOCK), int(np.ceil((_REACH_MM * _SLANT * side / (2 * half_mm) + 2) / _BLOCK)))


def relief_grid(frame: DeviceFrame, count: mi.UInt32) -> ReliefGrid:
    """Create the grid over the iris with the given number of nodes along a side."""
    return ReliefGrid(stop=frame.stop, half=frame.iris.root_radius + _SPARE_MM, count=count)


@recorded
def relief_shape(
    frame: DeviceFrame, pattern: mi.Texture2f, side: mi.UInt32, about: mi.UInt32, size: ReliefSize
) -> ReliefShape:
    """Compute the heights of an iris.

    Args:
        frame: the frame.
        pattern: the map of heights.
        side: number of nodes along a side, on the device.
        about: number of blocks on each side that are near a block, on the device.
        size: the same numbers on the host, for the sizes of arrays only.
    """
    grid = relief_grid(frame, side)
    column, row = grid.nodes(size.side**2)
    heights = iris_height(frame, pattern, grid.point(mi.Float(column), mi.Float(row)))
    dr.eval(heights)
    last = side - 1
    per = mi.Float(last) / (2 * grid.half)

    def slope(high: mi.UInt32, low: mi.UInt32, apart: mi.UInt32) -> mi.Float:
        return (dr.gather(mi.Float, heights, high) - dr.gather(mi.Float, heights, low)) * per / mi.Float(apart)

    left, right = dr.maximum(column, 1) - 1, dr.minimum(column + 1, last)
    above, below = dr.maximum(row, 1) - 1, dr.minimum(row + 1, last)
    hu = slope(row * side + right, row * side + left, right - left)
    hv = slope(below * side + column, above * side + column, below - above)
    corners = grid.corners_of(heights, column, row)
    dr.eval(hu, hv, corners)
    steepest, highest = dr.max(dr.sqrt(hu * hu + hv * hv)), dr.max(heights)
    near = _highest_nearby(heights, side, about, size.blocks)
    dr.eval(steepest, highest, near)
    return ReliefShape(
        heights=heights, corners=corners, slopes=(hu, hv), steepest=steepest, highest=highest, near=near
    )  # fmt: skip


@syntax
def _highest_nearby(heights: mi.Float, side: mi.UInt32, about: mi.UInt32, blocks: int) -> mi.Float:
    """Compute the largest height in and around every block of cells."""
    index, last = dr.arange(mi.UInt32, blocks * blocks), side - 1
    count = last // _BLOCK + 1  # equal to `blocks`, but not compiled into the kernel
    down = index // count
    across = index - down * count
    largest = mi.Float(0)
    for k in range(_BLOCK * _BLOCK):
        i, j = dr.minimum(across * _BLOCK + k % _BLOCK, last), dr.minimum(down * _BLOCK + k // _BLOCK, last)
        largest = dr.maximum(largest, dr.gather(mi.Float, heights, j * side + i))
    dr.eval(largest)
    wide = 2 * about + 1
    k, most = mi.UInt32(0), dr.zeros(mi.Float, blocks * blocks)
    while dr.hint(k < wide * wide, label="blocks beside", exclude=[largest]):
        row = k // wide
        place = across + (k - row * wide), down + row
        x, y = (mi.UInt32(dr.clip(mi.Int32(n) - mi.Int32(about), 0, mi.Int32(count) - 1)) for n in place)
        most = dr.maximum(most, dr.gather(mi.Float, largest, y * count + x))
        k += 1
    return most


def _arriving(frame: DeviceFrame, grid: ReliefGrid, each: mi.UInt32, lanes: int) -> mi.Float:
    """Compute E, E t_u, E t_v and E' for points of the lamps at coarse positions, in rows."""
    count = mi.UInt32(_COARSE)
    coarse = ReliefGrid(stop=grid.stop, half=grid.half, count=count)
    index = dr.arange(mi.UInt32, lanes)
    spot = index // (_COARSE * _COARSE)
    place = index - spot * (_COARSE * _COARSE)
    row = place // count
    x = coarse.point(mi.Float(place - row * count), mi.Float(row))
    lamp = frame.lights[spot // each]
    source = lamp.node(spot - (spot // each) * each, each)
    normal = frame.stop.normal
    # To other points the path search is long and fails.
    reached = (frame.lights.count > 0) & behind(frame.surfaces[-1], x)
    path = LampPath.find(frame, lamp, source, x, reached)
    above = LampPath.find(frame, lamp, source, x + _RAISED_MM * normal, reached)
    lit = dr.select(path.blocked, 0, path.gain)
    more = dr.select(above.gain > 0, (above.gain - path.gain) / _RAISED_MM, 0)
    lateral = _arrival(frame.surfaces, source, path.entry, normal)
    rows = (lit, lit * dr.dot(lateral, frame.stop.u), lit * dr.dot(lateral, frame.stop.v), more)
    out = dr.zeros(mi.Float, 4 * dr.width(index))
    dr.scatter(out, mi.Vector4f(*(dr.select(lit > 0, value, 0) for value in rows)), index)
    dr.eval(out)
    return out


@syntax
def _shades(
    spots: mi.UInt32, rows: mi.Float, shape: ReliefShape, grid: ReliefGrid, column: mi.UInt32, row: mi.UInt32
) -> mi.Float:
    """Compute the q of the module's docstring at nodes of the grid; `rows` is the result of `_arriving`."""
    node = row * grid.count + column
    x = grid.point(mi.Float(column), mi.Float(row))
    h, hu, hv = (dr.gather(mi.Float, values, node) for values in (shape.heights, *shape.slopes))
    across = (grid.count + (_BLOCK - 1)) // _BLOCK
    near = dr.gather(mi.Float, shape.near, row // _BLOCK * across + column // _BLOCK)
    coarse = mi.UInt32(_COARSE)
    i, j, s, t = ReliefGrid(stop=grid.stop, half=grid.half, count=coarse).cell(x)
    place = j * coarse + i
    k, whole, seen = mi.UInt32(0), mi.Float(0) * h, mi.Float(0) * h
    while dr.hint(k < spots, label="relief", exclude=[rows, shape, grid]):
        first = k * (_COARSE * _COARSE) + place
        a, b, c, d = (dr.gather(mi.Vector4f, rows, first + off) for off in (0, 1, coarse, coarse + 1))
        both = dr.lerp(dr.lerp(a, b, s), dr.lerp(c, d, s), t)
        inv = dr.rcp(dr.maximum(both.x, 1e-20))
        tu, tv = both.y * inv, both.z * inv
        facing = dr.maximum(1 - tu * hu - tv * hv, 0)
        way = tu * grid.stop.u + tv * grid.stop.v
        slant = dr.norm(way)
        asked = (both.x > 0) & (facing > 0) & (slant * shape.steepest > 1)
        above = dr.select(slant < _SLANT, near, shape.highest) - h
        here = dr.maximum(both.x + h * both.w, 0)
        hidden = _hidden(grid, shape.corners, x, h, way, dr.select(asked, above, 0))
        whole += both.x
        seen += here * facing * (1 - hidden)
        k += 1
    return dr.select(whole > 0, seen / whole * dr.rsqrt(1 + hu * hu + hv * hv), 1)


@syntax
def _hidden(
    grid: ReliefGrid, corners: mi.Float, x: mi.Vector3f, h: mi.Float, way: mi.Vector3f, above: mi.Float
) -> mi.Float:
    """Compute the share, 0 to 1, by which nearby heights hide the direction `way` from points.

    `above` is the largest height (mm) of the neighbourhood above the points.
    """
    k, hidden = mi.UInt32(0), mi.Float(0) * h
    while dr.hint((k < _STEPS) & (_rise(k) < above), label="shadows of the relief", exclude=[grid, corners]):
        up = _rise(k)
        over = grid.interpolate(corners, x + up * way, mi.Bool(True)) - h - up
        hidden = dr.maximum(hidden, dr.clip(over / (_SOFT * up + 0.004), 0, 1))
        k += 1
    return hidden


def _rise(k: mi.UInt32) -> mi.Float:
    """Compute the height (mm) of step k of a search above its start; the steps grow."""
    part = mi.Float(k + 1) / _STEPS
    return _REACH_MM * part * part


def _arrival(
    surfaces: tuple[DeviceSurface, ...], source: mi.Vector3f, entry: mi.Vector3f, normal: mi.Vector3f
) -> mi.Vector3f:
    """Compute the direction of light that arrives from `entry`, as lateral motion per mm along `normal`."""
    w = dr.normalize(entry - source)
    x = entry - w
    for surface in surfaces:
        x, w, _, _ = surface.refract(x, w)
    down = dr.dot(w, normal)
    return w / dr.select(down < -0.05, down, -1) - normal
