"""Lamp light on a bare globe and on the plane around it, on grids that are filled once per frame.

A grid over the globe's front (azimuthal equidistant about its axis) holds the light of the lamps and of other surfaces.
A grid over the plane holds only the light of the lamps, because that of other surfaces has finer structure there. Where
a cell is too inaccurate (see `irradiancegrid`), every sample has its own rays to the lamps.

A small lamp is represented by its middle, a larger one by four points whose mean is exact to third order in its radius.
For large and near lamps there is no grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..hits.interaction import SurfaceInteraction
from ..materials.albedo import GLOBE_EDGE, globe_map
from ..records.frame import DeviceFrame
from ..records.irradiancegrid import IrradianceGrid, grid_nodes
from ..records.recording import recorded, syntax
from .directlight import irradiance, lamp_blocked

_SIDE = 128
_MIDDLE = 0.5 * (_SIDE - 1)
_LOW, _SLOPE = 0.1, 0.6  # cosines: of a lamp about to set, and of one hidden by the rim of the steepest cornea


@dataclass(kw_only=True)
class GlobeIrradiance:
    """Irradiance of matte surfaces of a bare eye from lamps, and of the globe from other surfaces."""

    globe: IrradianceGrid  # grid over the globe's front
    plane: IrradianceGrid  # grid over the plane around it
    reach: mi.Float  # half the width of the plane's grid, mm

    @classmethod
    @recorded
    def build(cls, frame: DeviceFrame, reach: mi.Float, points: mi.UInt32, gridded: bool) -> GlobeIrradiance:
        """Fill the grids.

        `reach`: distance (mm) from the axis of the unrotated eye within which the plane is visible; `points`: number of
        points that represent a lamp; `gridded`: whether the lamps are small enough for grids.
        """
        if not gridded:
            return cls(globe=IrradianceGrid.unknown(_SIDE), plane=IrradianceGrid.unknown(_SIDE), reach=reach)
        a, b = (mi.Float(k) * (2 / (_SIDE - 1)) - 1 for k in grid_nodes(_SIDE))
        polar = dr.sqrt(a * a + b * b)
        sine, cosine = dr.sincos(polar * GLOBE_EDGE)
        share = dr.select(polar > 0, sine / polar, 0)
        normal = mi.Vector3f(cosine, a * share, b * share)
        x = frame.sclera.centre + frame.sclera.radius * normal
        # Under the cornea the grid continues as if there were no cornea, because cells at its rim have nodes there.
        local = frame.surfaces[0].point_in(x)
        outside = (local.y * local.y + local.z * local.z > dr.square(frame.limbus.radius)) | (normal.x < 0)
        on_globe = _from_lamps(frame, points, x, normal, sphere=mi.Bool(False), cornea=outside)
        more = frame.caches.radiosity.at_globe(frame.point_to_scene(x)).x
        seen = frame.point_to_eye(mi.Vector3f(frame.backdrop_x, reach * a, reach * b))
        yes, normal = mi.Bool(True), frame.vector_to_eye(mi.Vector3f(1, 0, 0))
        on_plane = _from_lamps(frame, points, seen, normal, sphere=yes, cornea=yes)
        dr.eval(on_globe, more, on_plane)
        one = dr.opaque(mi.UInt32, 1)  # the sum over the lamps stands for a single one
        globe, *_ = IrradianceGrid.build(_SIDE, on_globe, one, more=more)
        plane, *_ = IrradianceGrid.build(_SIDE, on_plane, one)
        return cls(globe=globe, plane=plane, reach=reach)

    @syntax
    def at(self, frame: DeviceFrame, view: SurfaceInteraction) -> tuple[mi.Float, mi.Bool]:
        """Interpolate the irradiance (mW/mm^2) at visible points, and whether it is known (not on the cornea's rim)."""
        if dr.hint(view.other, exclude=[self, frame, view]):
            found, left = self._on_plane(frame, view)
        else:
            found, left = self._on_globe(frame, view)
        known = left == 0
        return dr.select(known, found, 0), known

    def _on_plane(self, frame: DeviceFrame, view: SurfaceInteraction) -> tuple[mi.Float, mi.UInt32]:
        x, scale = frame.point_to_scene(view.point), _MIDDLE / self.reach
        before = view.other & (frame.camera.centre.x > frame.backdrop_x)
        return self.plane.at(self.plane.place(_MIDDLE + scale * x.y, _MIDDLE + scale * x.z, before))

    def _on_globe(self, frame: DeviceFrame, view: SurfaceInteraction) -> tuple[mi.Float, mi.UInt32]:
        at = globe_map(frame, view.point)
        return self.globe.at(self.globe.place((_SIDE - 1) * at.x, (_SIDE - 1) * at.y, view.sclera))


@syntax
def _from_lamps(
    frame: DeviceFrame, points: mi.UInt32, x: mi.Vector3f, normal: mi.Vector3f, *, sphere: mi.Bool, cornea: mi.Bool
) -> mi.Float:
    """Compute the irradiance of all lamps at points (eye frame); globe's sphere and cornea may block it.

    Under the cornea, where blocking is not tested, a low lamp may be hidden from points just beyond the rim. Such
    points are unknown: -1.
    """
    count = frame.lights.count * points
    k, total, doubtful = mi.UInt32(0), mi.Float(0) * x.x, mi.Bool(False)
    while dr.hint(k < count, label="lamps on a grid", exclude=[frame]):
        i = k // points
        lamp = frame.lights[i]
        source = lamp.node(k - i * points, points)
        lit = irradiance(lamp, source, x, normal)
        blocked = lamp_blocked(frame, x, source, sphere, cornea, lit > 0)
        total += dr.select(blocked, 0, lit)
        cosine = dr.dot(dr.normalize(source - x), normal)
        doubtful |= ~cornea & (cosine > -_LOW) & (cosine < _SLOPE)
        k += 1
    return dr.select(doubtful, -1, total / mi.Float(points))
