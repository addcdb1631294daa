"""Light of all lamps on the iris, once per frame on a grid in its plane instead of once per sample.

Inside the eye the light of a lamp changes slowly from place to place, so a few thousand light paths through the cornea
give it everywhere. A cell of the grid is used where linear interpolation is good to 5e-4, as the second differences
tell, and where no lamp's light is hidden: near the edge of a shadow every sample has its own light paths, as if there
were no grid. In front of an eye region a cell must also be far from all hairs and lids as the lamps see them
(`lampviews`), so that nothing can hide between its corners.

A lamp is represented by its middle if it is small, else by four points whose mean is exact to the third order of its
radius. Before lamps that are large and near, there is no grid.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .lampviews import LampViews
from .values import Lights, Values

_SIDE = 80
_SPARE_MM = 0.3  # beyond the root of the iris
_BENT = 0.004  # largest third difference of a cell over its irradiance
_SMALL, _LARGE = 0.015, 0.25  # radius of a lamp over its distance


class IrisLight:
    """The light of the lamps in the plane of the iris."""

    def __init__(self, values: Values, lights: Lights, scene: mi.Scene, views: LampViews | None) -> None:
        """Prepare the grid.

        Args:
            values: the scene's numbers.
            lights: the lamps.
            scene: what may stand in the way.
            views: the lamps' views of an eye region; None for a bare eye.
        """
        self._values, self._lights, self._scene, self._views = values, lights, scene, views
        self._points = dr.opaque(mi.UInt32, 1 if lights.widest < _SMALL and not lights.rings else 4)
        self._used = dr.opaque(mi.Bool, lights.widest < _LARGE)
        self._empty = not lights.widest < _LARGE
        self._half = values.iris.root_radius + _SPARE_MM
        self._rows: mi.Float | None = None

    def at(self, x: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.Bool]:
        """Irradiance (mW/mm^2) at points of the plane of the iris (eye frame), and whether it is known there."""
        assert self._rows is not None
        stop = self._values.stop
        q = x - stop.centre
        scale = 0.5 * (_SIDE - 1) / self._half
        u, v = (dr.dot(q, axis) * scale + 0.5 * (_SIDE - 1) for axis in (stop.u, stop.v))
        inside = active & self._used & (u >= 0) & (v >= 0) & (u < _SIDE - 1) & (v < _SIDE - 1)
        i, j = mi.UInt32(u), mi.UInt32(v)
        wu, wv = _weights(u - mi.Float(i)), _weights(v - mi.Float(j))
        total, known = mi.Float(0), mi.Bool(inside)
        for k, weight in enumerate(wv):
            row = dr.gather(mi.Vector4f, self._rows, (j + k - 1) * _SIDE + i, inside)
            if k == 1:
                known &= row.x > 0
            total += weight * (wu[0] * dr.abs(row.x) + wu[1] * row.y + wu[2] * row.z + wu[3] * row.w)
        return dr.select(known, dr.maximum(total, 0), 0), known

    def make(self) -> None:
        """Fill the grid, once."""
        if self._rows is not None:
            return
        self._rows = dr.full(mi.Float, -1, 4 * _SIDE * _SIDE)
        dr.make_opaque(self._rows)
        if self._empty:
            return
        index = dr.arange(mi.UInt32, _SIDE * _SIDE)
        row = index // _SIDE
        column = index - row * _SIDE
        irradiance = self._on_grid(column, row)
        dr.eval(irradiance)
        near = [
            [
                dr.gather(mi.Float, irradiance, mi.UInt32(dr.clip(mi.Int32(index) + dv * _SIDE + du, 0, _SIDE**2 - 1)))
                for du in range(-1, 3)
            ]
            for dv in range(-1, 3)
        ]
        edges = [*near, *zip(*near, strict=True)]
        bent, least, most = mi.Float(0), mi.Float(dr.inf), mi.Float(0)
        for e in edges:
            bent = dr.maximum(bent, dr.abs(e[0] - 3 * e[1] + 3 * e[2] - e[3]))
        for value in (v for line in near for v in line):
            least, most = dr.minimum(least, value), dr.maximum(most, value)
        good = (least > 0) & (bent <= _BENT * most)
        good &= (column > 0) & (row > 0) & (column < _SIDE - 2) & (row < _SIDE - 2)
        first = dr.abs(near[1][0])
        for k, value in enumerate((dr.select(good, first, -first), *near[1][1:])):
            dr.scatter(self._rows, value, 4 * index + k)
        dr.eval(self._rows)

    def _on_grid(self, column: mi.UInt32, row: mi.UInt32) -> mi.Float:
        """Irradiance at points of the grid; negative where anything may hide a lamp, or a path was not found."""
        from .lighting import LampPath

        values, lights = self._values, self._lights
        stop = values.stop
        a, b = (self._half * (mi.Float(k) * (2 / (_SIDE - 1)) - 1) for k in (column, row))
        x = stop.centre + a * stop.u + b * stop.v
        points = self._points
        within = a * a + b * b < dr.square(self._half)

        def more(k: mi.UInt32, *_: object) -> mi.Bool:
            return within & (k < lights.count * points)

        def body(k: mi.UInt32, total: mi.Float, hidden: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Bool]:
            i = k // points
            lamp = lights[i]
            turn = (mi.Float(k - i * points) + 0.5) * (0.5 * dr.pi)
            source = lamp.point(dr.select(points > 1, 0.5, 0), *dr.sincos(turn))
            path = LampPath.to(values, self._scene, lamp, source, x, within)
            total += dr.select(path.blocked, 0, path.gain)
            hidden |= path.failed
            if self._views is not None:
                entry = values.point_to_scene(path.entry)
                hidden |= path.enters & (path.blocked | ~self._views.clear(i, entry, path.enters))
            return k + 1, total, hidden

        state = (mi.UInt32(0), mi.Float(0), mi.Bool(False))
        labels = ("k", "total", "hidden")
        _, total, hidden = dr.while_loop(state, more, body, labels=labels, label="grid of the iris")
        return dr.select(hidden | ~within, -1, total / mi.Float(points))


def _weights(s: mi.Float) -> tuple[mi.Float, ...]:
    """Weights of four neighbours at the place s, 0 to 1 between the second and the third."""
    r = 1 - s
    return -0.5 * s * r * r, 1 + s * s * (1.5 * s - 2.5), 1 + r * r * (1.5 * r - 2.5), -0.5 * r * s * s
