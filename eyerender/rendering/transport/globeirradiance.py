"""Light of all lamps on a bare globe and on the plane about it, on grids that are filled once per frame.

A grid over the globe's front (azimuthal equidistant about its axis) holds the light of the lamps with that of other
surfaces, and one over the plane holds it without that, which has finer structure there. Where a cell is not good enough
(see `irradiancegrid`), every sample has its own rays to the lamps, as if there were no grid.

A lamp is represented by its middle if it is small, else by four points whose mean is exact to the third order of its
radius. Before lamps that are large and near, there is no grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..hits.interaction import SurfaceInteraction
from ..materials.albedo import GLOBE_EDGE, globe_map
from ..records.frame import Frame
from ..records.irradiancegrid import IrradianceGrid, grid_nodes
from ..records.recording import recorded
from .directlight import irradiance, lamp_blocked

if TYPE_CHECKING:
    pass

_SIDE = 128
_MIDDLE = 0.5 * (_SIDE - 1)
_LOW, _SLOPE = 0.1, 0.6  # cosines: of a lamp about to set, and of one that the rim of the steepest cornea hides


@dataclass(kw_only=True)
class GlobeIrradiance:
    """The light that matte surfaces of a bare eye receive from lamps, and the globe from other surfaces.

    Attributes:
        globe: over the globe's front.
        plane: over the plane about it.
        reach: half the width of the latter, mm.
    """

    globe: IrradianceGrid
    plane: IrradianceGrid
    reach: mi.Float

    def at(self, frame: Frame, view: SurfaceInteraction) -> tuple[mi.Float, mi.Bool]:
        """Irradiance (mW/mm^2) at points that are seen, and whether it is known: not on the rim of the cornea."""

        def on_plane(point: mi.Vector3f) -> tuple[mi.Float, mi.UInt32]:
            x, scale = frame.point_to_scene(point), _MIDDLE / self.reach
            before = view.other & (frame.camera.centre.x > frame.backdrop_x)
            return self.plane.at(self.plane.place(_MIDDLE + scale * x.y, _MIDDLE + scale * x.z, before))

        def on_globe(point: mi.Vector3f) -> tuple[mi.Float, mi.UInt32]:
            at = globe_map(frame, point)
            return self.globe.at(self.globe.place((_SIDE - 1) * at.x, (_SIDE - 1) * at.y, view.sclera))

        found, left = dr.if_stmt((view.point,), view.other, on_plane, on_globe)
        known = left == 0
        return dr.select(known, found, 0), known


@recorded
def globe_irradiance(frame: Frame, reach: mi.Float, points: mi.UInt32, gridded: bool) -> GlobeIrradiance:
    """Fill the grids.

    Args:
        frame: the frame.
        reach: distance (mm) from the axis of the unrotated eye within which the plane is seen.
        points: number of points that stand for a lamp.
        gridded: whether the lamps may have grids.
    """
    if not gridded:
        return GlobeIrradiance(globe=IrradianceGrid.unknown(_SIDE), plane=IrradianceGrid.unknown(_SIDE), reach=reach)
    a, b = (mi.Float(k) * (2 / (_SIDE - 1)) - 1 for k in grid_nodes(_SIDE))
    polar = dr.sqrt(a * a + b * b)
    sine, cosine = dr.sincos(polar * GLOBE_EDGE)
    share = dr.select(polar > 0, sine / polar, 0)
    normal = mi.Vector3f(cosine, a * share, b * share)
    x = frame.sclera.centre + frame.sclera.radius * normal
    # Under the cornea the grid goes on as if there were none, because cells at its rim have nodes there.
    local = frame.surfaces[0].point_in(x)
    outside = (local.y * local.y + local.z * local.z > dr.square(frame.limbus.radius)) | (normal.x < 0)
    on_globe = _lit(frame, points, x, normal, mi.Bool(False), outside)
    more = frame.caches.radiosity.globe(frame.point_to_scene(x)).x
    seen = frame.point_to_eye(mi.Vector3f(frame.backdrop_x, reach * a, reach * b))
    yes, normal = mi.Bool(True), frame.vector_to_eye(mi.Vector3f(1, 0, 0))
    on_plane = _lit(frame, points, seen, normal, yes, yes)
    dr.eval(on_globe, more, on_plane)
    one = dr.opaque(mi.UInt32, 1)  # the sum over the lamps stands for a single one
    globe, _ = IrradianceGrid.build(_SIDE, on_globe, one, more=more)
    plane, _ = IrradianceGrid.build(_SIDE, on_plane, one)
    return GlobeIrradiance(globe=globe, plane=plane, reach=reach)


def _lit(
    frame: Frame, points: mi.UInt32, x: mi.Vector3f, normal: mi.Vector3f, sphere: mi.Bool, cornea: mi.Bool
) -> mi.Float:
    """Irradiance of all lamps at points (eye frame), which the globe's sphere and the cornea may keep from them.

    Under the cornea, where that is not asked, a lamp that stands low may be hidden from points just beyond the rim.
    Such points are not known.
    """

    def body(k: mi.UInt32, total: mi.Float, doubtful: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Bool]:
        i = k // points
        lamp = frame.lights[i]
        source = lamp.node(k - i * points, points)
        lit = irradiance(lamp, source, x, normal)
        blocked = lamp_blocked(frame, x, source, sphere, cornea, lit > 0)
        cosine = dr.dot(dr.normalize(source - x), normal)
        doubtful = doubtful | (~cornea & (cosine > -_LOW) & (cosine < _SLOPE))
        return k + 1, total + dr.select(blocked, 0, lit), doubtful

    state, count = (mi.UInt32(0), mi.Float(0) * x.x, mi.Bool(False)), frame.lights.count * points
    labels = ("k", "total", "doubtful")
    _, total, doubtful = dr.while_loop(state, lambda k, *_: k < count, body, labels=labels, label="lamps on a grid")
    return dr.select(doubtful, -1, total / mi.Float(points))
