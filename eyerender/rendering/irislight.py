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

_SIDE = 80
_NODES = _SIDE * _SIDE
_SPARE_MM = 0.3  # beyond the root of the iris


class IrisLight:
    """The light of the lamps in the plane of the iris."""

    DRJIT_STRUCT = leaves("_stop", "_points", "_used", "_half", "_cells", "_left")

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
        self._fill()

    def at(self, x: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.UInt32]:
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
        cell, wu, total = j * _SIDE + i, weights(u - mi.Float(i)), mi.Float(0)
        for k, weight in enumerate(weights(v - mi.Float(j))):
            row = dr.gather(mi.Vector4f, self._cells, 4 * cell + k, inside)
            total += weight * (wu[0] * row.x + wu[1] * row.y + wu[2] * row.z + wu[3] * row.w)
        left = dr.gather(mi.UInt32, self._left, cell, inside)
        return dr.select(inside, dr.maximum(total, 0), 0), dr.select(inside, left, ALL)

    def _fill(self) -> None:
        if self._lights.gridded and len(self._lights):
            self._cells, self._left = self._filled(
                self._values, self._lights, self._scene, self._views, len(self._lights)
            )
        else:
            self._cells, self._left = dr.zeros(mi.Float, 16 * _NODES), dr.full(mi.UInt32, ALL, _NODES)
            dr.make_opaque(self._cells, self._left)

    @recorded
    def _filled(
        self, values: Values, lights: Lights, scene: mi.Scene, views: LampViews | None, lamps: int
    ) -> tuple[mi.Float, mi.UInt32]:
        """Sixteen numbers of each cell, and the lamps that they lack."""
        index = dr.arange(mi.UInt32, _NODES * lamps)
        lamp = index // _NODES
        lit = self._at_nodes(values, lights, scene, views, lamp, index - lamp * _NODES)
        dr.eval(lit)
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

        def add(k: mi.UInt32, left: mi.UInt32, *sums: mi.Float) -> tuple[mi.UInt32 | mi.Float, ...]:
            v = [dr.gather(mi.Float, lit, k * _NODES + place) for place in places]
            bent, least, most = unevenness(v)
            good = (least >= 0) & (bent <= BENT * dr.maximum(most, usual))
            left |= dr.select(good, 0, dr.select(many, ALL, mi.UInt32(1) << k))
            return k + 1, left, *(s + dr.select(good, value, 0) for s, value in zip(sums, v, strict=True))

        state = (mi.UInt32(0), mi.UInt32(0) * cell, *(mi.Float(0) * mi.Float(cell) for _ in places))
        labels = ("k", "left", *(f"sum{n}" for n in range(16)))
        _, left, *sums = dr.while_loop(state, lambda k, *_: k < lights.count, add, labels=labels, label="cells")
        within = (column > 0) & (row > 0) & (column < _SIDE - 2) & (row < _SIDE - 2)
        left = dr.select(within, left, ALL)
        sums = [dr.select(within & ~(many & (left != 0)), value, 0) for value in sums]
        dr.eval(sums, left)
        cells = dr.zeros(mi.Float, 16 * _NODES)
        for k in range(4):
            dr.scatter(cells, mi.Vector4f(*sums[4 * k : 4 * k + 4]), 4 * cell + k)
        dr.eval(cells, left)
        return cells, left

    def _at_nodes(
        self, values: Values, lights: Lights, scene: mi.Scene, views: LampViews | None, i: mi.UInt32, node: mi.UInt32
    ) -> mi.Float:
        """Irradiance of lamps i at nodes; negative where anything may hide them, or a path was not found."""
        from .lighting import LampPath, behind

        stop = self._stop
        row = node // _SIDE
        a, b = (self._half * (mi.Float(k) * (2 / (_SIDE - 1)) - 1) for k in (node - row * _SIDE, row))
        x = stop.centre + a * stop.u + b * stop.v
        points, lamp = self._points, lights[i]
        within = (a * a + b * b < dr.square(self._half)) & behind(values.surfaces[-1], x)

        def more(k: mi.UInt32, *_: object) -> mi.Bool:
            return within & (k < points)

        def body(k: mi.UInt32, total: mi.Float, hidden: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Bool]:
            source = lamp.node(k, points)
            path = LampPath.to(values, scene, lamp, source, x, within)
            total += dr.select(path.blocked, 0, path.gain)
            hidden |= path.failed
            if views is not None:
                entry = values.point_to_scene(path.entry)
                hidden |= path.enters & (path.blocked | ~views.clear(i, entry, path.enters))
            return k + 1, total, hidden

        state = (mi.UInt32(0), mi.Float(0), mi.Bool(False))
        labels = ("k", "total", "hidden")
        _, total, hidden = dr.while_loop(state, more, body, labels=labels, label="grid of the iris")
        return dr.select(hidden | ~within, -1, total / mi.Float(points))
