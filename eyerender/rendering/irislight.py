"""Light of the lamps on the iris, once per frame on a grid in its plane instead of once per sample.

Inside the eye the light of a lamp changes slowly from place to place, so a few thousand light paths through the cornea
give it everywhere. A cell of the grid holds the light of those lamps for which cubic interpolation is good to a
thousandth, as the third differences tell, and that are not hidden at the sixteen nodes about it: near the edge of a
lamp's shadow every sample has its own light path to this lamp. In front of an eye region the nodes must also be far
from all hairs and lids as the lamp sees them (`lampviews`), so that nothing can hide between them.

A lamp is represented by its middle if it is small, else by four points whose mean is exact to the third order of its
radius. Before lamps that are large and near, there is no grid.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .lampviews import LampViews
from .lightgrid import BENT, about, unevenness, weights
from .parameters import leaves
from .recorded import recorded
from .values import ALL, BITS, Lights, Values
from .view import STEEPEST, opacity

_SIDE = 80
_NODES = _SIDE * _SIDE
_SPARE_MM = 0.45  # beyond the root of the iris: two cells
_STEADY = 0.02  # as BENT, of what enters: without the edges of shadows, cubics are off by a hundredth of this
_AHEAD_MM = 1.0  # before the back of the cornea, where nodes continue the light behind it


class IrisLight:
    """The light of the lamps in the plane of the iris."""

    DRJIT_STRUCT = leaves("_stop", "_points", "_used", "_half", "_cells", "_left", "_behind_rim", "_paths")

    def __init__(self, values: Values, lights: Lights, scene: mi.Scene, views: LampViews | None) -> None:
        """Fill the grid.

        Args:
            values: the scene's numbers.
            lights: the lamps.
            scene: what may stand in the way.
            views: the lamps' views of an eye region; None for a bare eye.
        """
        self._values, self._lights, self._scene, self._views = values, lights, scene, views
        self._stop = values.stop
        self._points = dr.opaque(mi.UInt32, lights.points)
        self._used = dr.opaque(mi.Bool, lights.gridded)
        self._half = values.iris.root_radius + _SPARE_MM
        self._cells: mi.Float | None = None
        self._left: mi.UInt32 | None = None
        self._behind_rim: mi.UInt32 | None = None  # lamps of cells whose light must pass the rim
        self._paths: mi.Float | None = None
        self._fill()

    def at(self, values: Values, x: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.UInt32]:
        """Irradiance (mW/mm^2) at points of the plane of the iris (eye frame), and the lamps that it lacks.

        Bit l of the second result stands for lamp l. Of more than 32 lamps it lacks all or none.
        """
        assert self._cells is not None
        stop = self._stop
        q = x - stop.centre
        scale = 0.5 * (_SIDE - 1) / self._half
        u, v = (dr.dot(q, axis) * scale + 0.5 * (_SIDE - 1) for axis in (stop.u, stop.v))
        inside = active & self._used & (u >= 0) & (v >= 0) & (u < _SIDE - 1) & (v < _SIDE - 1)
        i, j = mi.UInt32(u), mi.UInt32(v)
        cell = j * _SIDE + i
        wu, wv = mi.Vector4f(*weights(u - mi.Float(i))), weights(v - mi.Float(j))
        total = mi.Float(0)
        for k, weight in enumerate(wv):
            total += weight * dr.dot(wu, dr.gather(mi.Vector4f, self._cells, 4 * cell + k, inside))
        total = dr.select(inside, dr.maximum(total, 0), 0)
        left = dr.gather(mi.UInt32, self._left, cell, inside)
        lamps = dr.gather(mi.UInt32, self._behind_rim, cell, inside)

        def add(lamps: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            whole, out = mi.Float(0), mi.Float(0)
            first = dr.tzcnt(lamps) * _NODES + cell
            for k, weight in enumerate(wv):
                a, b = _rows(self._paths, first + k * _SIDE - _SIDE)
                whole += weight * dr.dot(wu, a)
                out += weight * dr.dot(wu, b)
            return lamps & (lamps - 1), total + whole * (1 - opacity(values, out))

        _, total = dr.while_loop(
            (lamps, total), lambda lamps, _: lamps != 0, add, labels=("lamps", "total"), label="behind the rim"
        )
        return total, dr.select(inside, left, ALL)

    def _fill(self) -> None:
        lights = self._lights
        if lights.gridded and len(lights):
            found = self._filled(self._values, lights, self._scene, self._views, len(lights))
        else:
            found = (
                dr.zeros(mi.Float, 16 * _NODES),
                dr.full(mi.UInt32, ALL, _NODES),
                dr.zeros(mi.UInt32, _NODES),
                dr.zeros(mi.Float, 8),
            )
            dr.make_opaque(*found)
        self._cells, self._left, self._behind_rim, self._paths = found

    @recorded
    def _filled(
        self, values: Values, lights: Lights, scene: mi.Scene, views: LampViews | None, lamps: int
    ) -> tuple[mi.Float, mi.UInt32, mi.UInt32, mi.Float]:
        """Sixteen numbers of each cell, the lamps that they lack, those behind the rim, and the paths from these.

        The paths are rows of nodes: what passes a clear rim at four nodes, and the radii where it enters.
        """
        index = dr.arange(mi.UInt32, _NODES * lamps)
        lamp = index // _NODES
        lit, *paths = self._at_nodes(values, lights, scene, views, lamp, index - lamp * _NODES)
        dr.eval(lit, paths)
        index = dr.arange(mi.UInt32, _NODES * min(lamps, BITS))
        rows = dr.zeros(mi.Float, 8 * _NODES * min(lamps, BITS))
        last = mi.Int32(dr.minimum(lights.count, BITS) * _NODES) - 1
        for n, path in enumerate(paths):
            four = (dr.gather(mi.Float, path, mi.UInt32(dr.clip(mi.Int32(index) + k, 0, last))) for k in range(-1, 3))
            dr.scatter(rows, mi.Vector4f(*four), 2 * index + n)
        dr.eval(rows)
        cell = dr.arange(mi.UInt32, _NODES)
        row = cell // _SIDE
        column = cell - row * _SIDE
        places = about(cell, _SIDE)
        many = lights.count > BITS

        def sum_up(k: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            return k + 1, total + dr.maximum(dr.gather(mi.Float, lit, k * _NODES + cell), 0)

        state = (mi.UInt32(0), mi.Float(0) * mi.Float(cell))
        _, total = dr.while_loop(state, lambda k, _: k < lights.count, sum_up, labels=("k", "total"), label="all lamps")
        usual = total / mi.Float(lights.count)

        within = (column > 0) & (row > 0) & (column < _SIDE - 2) & (row < _SIDE - 2)

        def even_behind_rim(k: mi.UInt32, allowed: mi.Float) -> mi.Bool:
            four = [_rows(rows, k * _NODES + cell + n * _SIDE - _SIDE) for n in range(4)]
            whole, out = ([value for row in four for value in row[m]] for m in (0, 1))
            bent, least, most = unevenness(whole)
            return (least > 0) & (
                bent + unevenness(out)[0] * most * STEEPEST * values.limbus.gain <= _STEADY / BENT * allowed
            )

        def add(k: mi.UInt32, left: mi.UInt32, behind: mi.UInt32, *sums: mi.Float) -> tuple[mi.UInt32 | mi.Float, ...]:
            v = [dr.gather(mi.Float, lit, k * _NODES + place) for place in places]
            bent, least, most = unevenness(v)
            allowed = BENT * dr.maximum(most, usual)
            good = (least >= 0) & (bent <= allowed)
            rim = dr.if_stmt((k, allowed), within & ~good & ~many, even_behind_rim, lambda k, allowed: mi.Bool(False))
            bit = mi.UInt32(1) << k
            left |= dr.select(good | rim, 0, dr.select(many, ALL, bit))
            behind |= dr.select(rim, bit, 0)
            return k + 1, left, behind, *(s + dr.select(good, value, 0) for s, value in zip(sums, v, strict=True))

        state = (
            mi.UInt32(0),
            mi.UInt32(0) * cell,
            mi.UInt32(0) * cell,
            *(mi.Float(0) * mi.Float(cell) for _ in places),
        )
        labels = ("k", "left", "behind", *(f"sum{n}" for n in range(16)))
        _, left, behind, *sums = dr.while_loop(state, lambda k, *_: k < lights.count, add, labels=labels, label="cells")
        left = dr.select(within, left, ALL)
        sums = [dr.select(within & ~(many & (left != 0)), value, 0) for value in sums]
        dr.eval(sums, left, behind)
        cells = dr.zeros(mi.Float, 16 * _NODES)
        for k in range(4):
            dr.scatter(cells, mi.Vector4f(*sums[4 * k : 4 * k + 4]), 4 * cell + k)
        dr.eval(cells, left, behind)
        return cells, left, behind, rows

    def _at_nodes(
        self, values: Values, lights: Lights, scene: mi.Scene, views: LampViews | None, i: mi.UInt32, node: mi.UInt32
    ) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Irradiance of lamps i at nodes, the same behind a clear rim, and the radius (mm) where it enters.

        Where anything may hide the lamps, or a path was not found, irradiances are negative. Behind a clear rim, that
        of a lamp with several points is so, too.
        """
        from .lighting import LampPath, behind

        stop = self._stop
        row = node // _SIDE
        a, b = (self._half * (mi.Float(k) * (2 / (_SIDE - 1)) - 1) for k in (node - row * _SIDE, row))
        x = stop.centre + a * stop.u + b * stop.v
        points, lamp = self._points, lights[i]
        within = (a * a + b * b < dr.square(self._half)) & behind(values.surfaces[-1], x, _AHEAD_MM)

        def more(k: mi.UInt32, *_: object) -> mi.Bool:
            return within & (k < points)

        def body(
            k: mi.UInt32, total: mi.Float, whole: mi.Float, out: mi.Float, hidden: mi.Bool
        ) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Float, mi.Bool]:
            source = lamp.node(k, points)
            path = LampPath.to(values, scene, lamp, source, x, within, ahead_mm=_AHEAD_MM)
            total += dr.select(path.blocked, 0, path.gain)
            usable = ~path.blocked & (points == 1)
            hidden |= path.failed
            if views is not None:
                free = views.clear(i, values.point_to_scene(path.entry), path.whole > 0)
                hidden |= path.enters & (path.blocked | ~free)
                usable &= free
            return k + 1, total, dr.select(usable, path.whole, -1), path.out, hidden

        state = (mi.UInt32(0), mi.Float(0), mi.Float(-1), mi.Float(0), mi.Bool(False))
        labels = ("k", "total", "whole", "out", "hidden")
        _, total, whole, out, hidden = dr.while_loop(state, more, body, labels=labels, label="grid of the iris")
        hidden |= ~within
        return dr.select(hidden, -1, total / mi.Float(points)), dr.select(hidden, -1, whole), out


def _rows(paths: mi.Float, node: mi.UInt32) -> tuple[mi.Vector4f, mi.Vector4f]:
    """What passes a clear rim at nodes and the three beside them, and the radii where it enters."""
    return dr.gather(mi.Vector4f, paths, 2 * node), dr.gather(mi.Vector4f, paths, 2 * node + 1)
