"""Light of all lamps on a bare globe and on the plane about it, once per frame instead of once per sample.

On matte surfaces in air the light of the lamps changes slowly from place to place, except at the edges of shadows and
where a lamp sets. A grid over the globe's front (azimuthal equidistant about its axis) holds it with the light of other
surfaces, and one over the plane without that, which has finer structure there. Where their cells are not good (see
`lightgrid`), every sample has its own rays to the lamps, as if there were no grid.

A lamp is represented by its middle if it is small, else by four points whose mean is exact to the third order of its
radius. Before lamps that are large and near, there is no grid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from .lightgrid import LightGrid
from .lighting import irradiance, lamp_blocked
from .parameters import leaves
from .recorded import recorded
from .values import Lights, Values
from .view import GLOBE_EDGE, View, globe_map

if TYPE_CHECKING:
    from .exchange import Received

_SIDE = 128
_LOW, _SLOPE = 0.1, 0.6  # cosines: of a lamp about to set, and of one that the rim of the steepest cornea hides


class MatteLight:
    """The light that matte surfaces of a bare eye receive from lamps, and the globe from other surfaces."""

    DRJIT_STRUCT = leaves("_used", "_reach", "_grids")

    def __init__(self, values: Values, lights: Lights, scene: mi.Scene, received: Received, reach_mm: float) -> None:
        """Fill the grids.

        Args:
            values: the scene's numbers.
            lights: the lamps.
            scene: what may stand in the way.
            received: the light of other surfaces.
            reach_mm: distance from the axis of the unrotated eye within which the plane is seen.
        """
        self._values, self._lights, self._scene, self._received = values, lights, scene, received
        self._points = dr.opaque(mi.UInt32, lights.points)
        self._used = dr.opaque(mi.Bool, lights.gridded)
        self._reach = dr.opaque(mi.Float, reach_mm)
        self._grids: tuple[LightGrid, LightGrid] | None = None
        self._fill()

    def at(self, values: Values, view: View) -> tuple[mi.Float, mi.Bool]:
        """Irradiance (mW/mm^2) at points that are seen, and whether it is known: not on the rim of the cornea."""
        assert self._grids is not None
        globe, plane = self._grids
        middle = 0.5 * (_SIDE - 1)

        def on_plane(point: mi.Vector3f) -> tuple[mi.Float, mi.Bool]:
            x, scale = values.point_to_scene(point), middle / self._reach
            before = self._used & (values.camera.centre.x > values.backdrop_x)
            return plane.at(middle + scale * x.y, middle + scale * x.z, before & view.other)

        def on_globe(point: mi.Vector3f) -> tuple[mi.Float, mi.Bool]:
            place = globe_map(values, point)
            return globe.at((_SIDE - 1) * place.x, (_SIDE - 1) * place.y, self._used & view.sclera)

        found: tuple[mi.Float, mi.Bool] = dr.if_stmt((view.point,), view.other, on_plane, on_globe)
        return found

    def _fill(self) -> None:
        if not self._lights.gridded:
            self._grids = LightGrid(_SIDE), LightGrid(_SIDE)
            return
        globe, plane = _filled(self._values, self._lights, self._scene, self._received, self._points, self._reach)
        self._grids = LightGrid(_SIDE, globe), LightGrid(_SIDE, plane)


@recorded
def _filled(
    values: Values, lights: Lights, scene: mi.Scene, received: Received, points: mi.UInt32, reach: mi.Float
) -> tuple[mi.Float, mi.Float]:  # fmt: skip
    """Numbers of the grids over the globe and over the plane."""
    column, row = LightGrid.nodes(_SIDE)
    a, b = (mi.Float(k) * (2 / (_SIDE - 1)) - 1 for k in (column, row))
    polar = dr.sqrt(a * a + b * b)
    sine, cosine = dr.sincos(polar * GLOBE_EDGE)
    share = dr.select(polar > 0, sine / polar, 0)
    normal = mi.Vector3f(cosine, a * share, b * share)
    x = values.sclera.centre + values.sclera.radius * normal
    # Under the cornea the grid goes on as if there were none, because cells at its rim have nodes there.
    local = values.surfaces[0].point_in(x)
    outside = (local.y * local.y + local.z * local.z > dr.square(values.limbus.radius)) | (normal.x < 0)
    on_globe = _lit(values, lights, scene, points, x, normal, mi.Bool(False), outside)
    more = received.globe(values.point_to_scene(x)).x
    seen = values.point_to_eye(mi.Vector3f(values.backdrop_x, reach * a, reach * b))
    yes, normal = mi.Bool(True), values.vector_to_eye(mi.Vector3f(1, 0, 0))
    on_plane = _lit(values, lights, scene, points, seen, normal, yes, yes)
    dr.eval(on_globe, more, on_plane)
    rows = LightGrid.rows_of(_SIDE, on_globe, more), LightGrid.rows_of(_SIDE, on_plane)
    dr.eval(rows)
    return rows


def _lit(
    values: Values, lights: Lights, scene: mi.Scene, points: mi.UInt32, x: mi.Vector3f, normal: mi.Vector3f,
    sphere: mi.Bool, cornea: mi.Bool,
) -> mi.Float:  # fmt: skip
    """Irradiance of all lamps at points (eye frame), which the globe's sphere and the cornea may keep from them.

    Under the cornea, where that is not asked, a lamp that stands low may be hidden from points just beyond the rim.
    Such points are not known.
    """

    def body(k: mi.UInt32, total: mi.Float, doubtful: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Bool]:
        i = k // points
        lamp = lights[i]
        source = lamp.node(k - i * points, points)
        lit = irradiance(lamp, source, x, normal)
        blocked = lamp_blocked(values, scene, x, source, sphere, cornea, lit > 0)
        cosine = dr.dot(dr.normalize(source - x), normal)
        doubtful = doubtful | (~cornea & (cosine > -_LOW) & (cosine < _SLOPE))
        return k + 1, total + dr.select(blocked, 0, lit), doubtful

    state, count = (mi.UInt32(0), mi.Float(0) * x.x, mi.Bool(False)), lights.count * points
    labels = ("k", "total", "doubtful")
    _, total, doubtful = dr.while_loop(state, lambda k, *_: k < count, body, labels=labels, label="lamps on a grid")
    return dr.select(doubtful, -1, total / mi.Float(points))
