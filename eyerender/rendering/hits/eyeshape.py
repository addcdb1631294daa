"""The eye as a shape: ray hits on its exact surfaces, and refraction behind the cornea to the plane of the iris.

The methods have the names and roles of those of Mitsuba's shapes, so a custom shape could call them once Mitsuba allows
shapes written in Python. Until then `primary` combines these hits with those of the scene, and `directlight` the
shadows.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..materials.albedo import limbal_radius, opacity, stop_coordinates
from ..records.frame import DeviceFrame
from ..records.recording import syntax
from ..records.surfaces import DEVICE
from .interaction import EPSILON_MM, SurfaceInteraction

_NEAR_MM = 20.0
_FAR = float(np.finfo(np.float32).max)


@dataclass(kw_only=True)
class EyeHit:
    """Preliminary hit of a ray on the eye, without what lies behind the surface."""

    t: mi.Float  # distance, infinite where the ray misses
    cornea: mi.Bool  # whether the ray enters through the clear part of the cornea
    sclera: mi.Bool  # whether it meets the sclera
    to_cornea: mi.Float  # distance to the cornea from the start near the eye
    to_sclera: mi.Float  # distance to the sclera from the same start
    facing: mi.Vector3f  # unit normal of the cornea, in its own frame


@dataclass(kw_only=True)
class EyeShape:
    """The cornea and the sclera of a frame as one shape."""

    frame: DeviceFrame

    def ray_intersect_preliminary(self, o: mi.Vector3f, d: mi.Vector3f) -> EyeHit:
        """Intersect rays (scene's frame) with the eye, ignoring all other surfaces."""
        frame = self.frame
        t0, oe, de = self._start(o, d)
        front = frame.surfaces[0]
        ol, dl = front.point_in(oe), front.vector_in(de)
        tc, on_cornea, facing = front.meet(ol, dl)
        yl = ol + tc * dl
        on_cornea &= (dr.sqrt(yl.y * yl.y + yl.z * yl.z) < frame.limbus.radius) & (yl.x > frame.limbus.floor)
        ts, on_sclera = intersect_sphere(oe - frame.sclera.centre, de, frame.sclera.radius)
        # The sphere's front is behind the cornea, so a ray that meets the sphere first has met no clear cornea. This
        # avoids cracks even where the rim of a tilted or toric cornea is not a circle of the sphere.
        on_cornea &= ~on_sclera | (tc < ts)
        on_sclera &= ~on_cornea
        t = t0 + dr.select(on_cornea, tc, ts)
        on_cornea &= t > EPSILON_MM
        on_sclera &= t > EPSILON_MM
        t = dr.select(on_cornea | on_sclera, t, _FAR)
        return EyeHit(t=t, cornea=on_cornea, sclera=on_sclera, to_cornea=tc, to_sclera=ts, facing=facing)

    def compute_surface_interaction(self, o: mi.Vector3f, d: mi.Vector3f, hit: EyeHit) -> SurfaceInteraction:
        """Complete hits of rays (scene's frame): the surface of the eye and what lies behind its cornea."""
        frame, front = self.frame, self.frame.surfaces[0]
        _, oe, de = self._start(o, d)
        dl = front.vector_in(de)
        xc, xs = oe + hit.to_cornea * de, oe + hit.to_sclera * de
        si = SurfaceInteraction.blank()
        si.cornea, si.sclera, si.distance, si.point = hit.cornea, hit.sclera, hit.t, dr.select(hit.cornea, xc, xs)
        local = front.point_in(oe) + hit.to_cornea * dl
        si.opacity = dr.select(hit.cornea, opacity(frame, limbal_radius(frame, local)), 1)
        si = self._through_cornea(si, hit.facing, xc, dl)
        si.normal = dr.normalize(dr.select(hit.cornea, si.normal, xs - frame.sclera.centre))
        return si

    def ray_intersect(self, o: mi.Vector3f, d: mi.Vector3f) -> SurfaceInteraction:
        """Intersect rays (scene's frame) with the eye and complete the hits, ignoring all other surfaces."""
        return self.compute_surface_interaction(o, d, self.ray_intersect_preliminary(o, d))

    def ray_test(self, x: mi.Vector3f, d: mi.Vector3f, distance: mi.Float, sphere: mi.Bool, cornea: mi.Bool) -> mi.Bool:
        """Return whether the eye blocks rays from points x along d (eye frame) within a distance.

        `sphere` and `cornea` mark the rays that the globe's sphere and the cornea can block.
        """
        frame = self.frame
        t, met = intersect_sphere(x - frame.sclera.centre, d, frame.sclera.radius)
        blocked = met & sphere & (t > EPSILON_MM) & (t < distance)
        front = frame.surfaces[0]
        o, dl = front.point_in(x), front.vector_in(d)
        t, met = front.hit(o, dl)
        y = o + t * dl
        rho2 = y.y * y.y + y.z * y.z
        met &= (rho2 < frame.limbus.radius * frame.limbus.radius) & (y.x > frame.limbus.floor)
        return blocked | (met & cornea & (t > EPSILON_MM) & (t < distance))

    def _start(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f, mi.Vector3f]:
        """Return the distance to a start near the eye (single precision requires one), the start, and d, eye frame."""
        t0 = -dr.dot(o, d) - _NEAR_MM
        return t0, self.frame.point_to_eye(o + t0 * d), self.frame.vector_to_eye(d)

    @syntax
    def _through_cornea(
        self, si: SurfaceInteraction, facing: mi.Vector3f, x: mi.Vector3f, dl: mi.Vector3f
    ) -> SurfaceInteraction:
        """Refract rays that meet the cornea at x (eye frame) along dl (the cornea's frame) to the plane of the iris."""
        on_cornea = si.cornea
        if dr.hint(on_cornea, exclude=[self, facing, x, dl, on_cornea]):
            _refract(self.frame, si, facing, x, dl)
        return si


def _refract(frame: DeviceFrame, si: SurfaceInteraction, facing: mi.Vector3f, x: mi.Vector3f, dl: mi.Vector3f) -> None:
    """Refract rays at the cornea and record what they meet; see `EyeShape._through_cornea`."""
    front = frame.surfaces[0]
    bend = DEVICE.refract(dl, facing, front.eta)
    mirrored = front.mirrored(bend)
    passed = 1 - mirrored
    w = front.vector_out(mi.Vector3f(*bend.way))
    inside = mi.Vector3f(x)
    reached = mi.Bool(True)
    for surface in frame.surfaces[1:]:
        inside, w, share, ok = surface.refract(inside, w)
        passed *= share
        reached &= ok
    n = frame.stop.normal
    down = dr.dot(w, n)
    s = dr.dot(frame.stop.centre - inside, n) / down
    inner = dr.select(s > 0, inside + s * w, _beyond_root(frame, inside))
    pu, pv = stop_coordinates(frame, inner)
    margin = frame.boundary.radius(pu, pv)
    si.normal, si.mirrored, si.passed = front.vector_out(facing), mirrored, dr.select(reached, passed, 0)
    # A ray without a path may have no position at all, and nothing may be computed from it.
    si.inner = dr.select(reached, inner, frame.stop.centre)
    si.slant = dr.select(reached & (down < -0.05), w / down - n, 0)
    si.pupil = reached & (pu * pu + pv * pv < margin * margin)


def _beyond_root(frame: DeviceFrame, x: mi.Vector3f) -> mi.Vector3f:
    """Return points in the plane of the iris, just beyond its root, that represent points behind the plane.

    In a shallow chamber the cornea may end behind the plane, and a real iris bends back to its root. Its illumination
    there is about that at the end of the flat iris.
    """
    n, centre = frame.stop.normal, frame.stop.centre
    scale = (frame.iris.root_radius + EPSILON_MM) * dr.rsqrt(dr.maximum(x.y * x.y + x.z * x.z, 1e-12))
    y, z = x.y * scale, x.z * scale
    return mi.Vector3f(centre.x - (n.y * (y - centre.y) + n.z * (z - centre.z)) / n.x, y, z)


def intersect_sphere(o: mi.Vector3f, d: mi.Vector3f, radius: mi.Float) -> tuple[mi.Float, mi.Bool]:
    """Intersect a sphere about the origin: distance to its near side, and whether it is met from outside."""
    b, c = dr.dot(o, d), dr.squared_norm(o) - radius * radius
    disc = b * b - c
    q = dr.sqrt(dr.maximum(disc, 0)) - b
    return c / q, (disc > 0) & (q > 0) & (c > 0)
