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
from .lightgrid import LightGrid
from .parameters import leaves
from .recorded import recorded
from .values import Lights, Values

_SIDE = 80
_SPARE_MM = 0.3  # beyond the root of the iris


class IrisLight:
    """The light of the lamps in the plane of the iris."""

    DRJIT_STRUCT = leaves("_values", "_points", "_used", "_half", "_grid")

    def __init__(self, values: Values, lights: Lights, scene: mi.Scene, views: LampViews | None) -> None:
        """Prepare the grid.

        Args:
            values: the scene's numbers.
            lights: the lamps.
            scene: what may stand in the way.
            views: the lamps' views of an eye region; None for a bare eye.
        """
        self._values, self._lights, self._scene, self._views = values, lights, scene, views
        self._points = dr.opaque(mi.UInt32, lights.points)
        self._used = dr.opaque(mi.Bool, lights.gridded)
        self._half = values.iris.root_radius + _SPARE_MM
        self._grid: LightGrid | None = None

    def at(self, x: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.Bool]:
        """Irradiance (mW/mm^2) at points of the plane of the iris (eye frame), and whether it is known there."""
        assert self._grid is not None
        stop = self._values.stop
        q = x - stop.centre
        scale = 0.5 * (_SIDE - 1) / self._half
        u, v = (dr.dot(q, axis) * scale + 0.5 * (_SIDE - 1) for axis in (stop.u, stop.v))
        return self._grid.at(u, v, active & self._used)

    def make(self) -> None:
        """Fill the grid, once."""
        if self._grid is None:
            grid = LightGrid(_SIDE)
            if self._lights.gridded:
                grid.rows = self._rows(self._lights, self._scene, self._views)
            self._grid = grid

    @recorded
    def _rows(self, lights: Lights, scene: mi.Scene, views: LampViews | None) -> mi.Float:
        """Numbers of the filled grid."""
        grid = LightGrid(_SIDE)
        grid.fill(self._on_grid(lights, scene, views, *grid.nodes()))
        return grid.rows

    def _on_grid(
        self, lights: Lights, scene: mi.Scene, views: LampViews | None, column: mi.UInt32, row: mi.UInt32
    ) -> mi.Float:
        """Irradiance at points of the grid; negative where anything may hide a lamp, or a path was not found."""
        from .lighting import LampPath, behind

        values, stop = self._values, self._values.stop
        a, b = (self._half * (mi.Float(k) * (2 / (_SIDE - 1)) - 1) for k in (column, row))
        x = stop.centre + a * stop.u + b * stop.v
        points = self._points
        within = (a * a + b * b < dr.square(self._half)) & behind(values.surfaces[-1], x)

        def more(k: mi.UInt32, *_: object) -> mi.Bool:
            return within & (k < lights.count * points)

        def body(k: mi.UInt32, total: mi.Float, hidden: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Bool]:
            i = k // points
            lamp = lights[i]
            turn = (mi.Float(k - i * points) + 0.5) * (0.5 * dr.pi)
            source = lamp.point(dr.select(points > 1, 0.5, 0), *dr.sincos(turn))
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
