"""Camera rays: the nearer hit, on the eye or on the rest of the scene, and the surface there.

The eye is intersected in closed form (`EyeShape`), everything else by Embree or OptiX.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..records.frame import DeviceFrame
from ..records.recording import syntax
from ..scene.background import HALF_MM
from .eyeshape import EyeShape
from .interaction import SurfaceInteraction

_PAST = 1e-4, 1e-6  # step past the surface of a hair: mm, and share of the distance (rounding)


@dataclass(kw_only=True)
class TriangleHit:
    """Hit on a triangle, at infinite distance if there is none; with Mitsuba's names."""

    t: mi.Float
    prim_index: mi.UInt32
    prim_uv: mi.Point2f

    @classmethod
    def of(cls, hit: mi.PreliminaryIntersection3f) -> TriangleHit:
        """Copy what is needed from a hit by Embree or OptiX."""
        t = dr.select(hit.is_valid(), hit.t, dr.inf)
        return cls(t=t, prim_index=mi.UInt32(hit.prim_index), prim_uv=hit.prim_uv)

    @classmethod
    def on_plane(cls, plane_x: mi.Float, o: mi.Vector3f, d: mi.Vector3f, nearest: mi.Float) -> TriangleHit:
        """Intersect the plane x = `plane_x`, given by its first triangle, in closed form, up to a distance."""
        t = (plane_x - o.x) / d.x
        y, z = o.y + t * d.y, o.z + t * d.z
        met = (t > 0) & (t < nearest) & (dr.maximum(dr.abs(y), dr.abs(z)) < HALF_MM)
        uv = mi.Point2f((y - z) / (2 * HALF_MM), (z + HALF_MM) / (2 * HALF_MM))
        return cls(t=dr.select(met, t, dr.inf), prim_index=mi.UInt32(0), prim_uv=uv)

    def is_valid(self) -> mi.Bool:
        """Return whether anything is hit."""
        return self.t < dr.inf


def first_hit(frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool) -> SurfaceInteraction:
    """Trace camera rays (scene's frame) to the first surface and through the cornea to the plane of the iris."""
    si, hit = intersect(frame, o, d, active)
    return appearance(frame, si, hit, d)


def intersect(
    frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool, *, coherent: bool = True
) -> tuple[SurfaceInteraction, TriangleHit]:
    """Trace rays (scene's frame); surfaces other than the eye are not evaluated yet (see `appearance`).

    `coherent` states that neighbouring rays are similar, as those of a camera.
    """
    eye = EyeShape(frame=frame).ray_intersect(o, d)
    hit = hit_before(frame, o, d, eye.distance, active, coherent=coherent)
    return behind(eye, hit, active), hit


def hit_before(
    frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, nearest: mi.Float, active: mi.Bool, *, coherent: bool = True
) -> TriangleHit:
    """Intersect rays (scene's frame) with everything but the eye, up to a distance."""
    if not frame.structure.obstacles:
        return TriangleHit.on_plane(frame.backdrop_x, o, d, nearest)
    ray = segment(o, d, nearest)
    return TriangleHit.of(frame.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active))


@syntax
def hit_past_hairs(frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, nearest: mi.Float) -> tuple[mi.Bool, mi.UInt32]:
    """Intersect rays with a region without its hairs, up to a distance: whether any triangle is hit, and which."""
    first = hit_before(frame, o, d, nearest, mi.Bool(True))
    start, t, face = mi.Float(0), mi.Float(first.t), frame.region.face(first)
    hair = first.is_valid() & frame.region.on_hair(face)
    while dr.hint(hair, label="hairs", exclude=[frame, o, d, nearest]):
        start += t + _PAST[0] + _PAST[1] * t
        ray = segment(o + start * d, d, nearest - start)
        after = frame.scene.ray_intersect_preliminary(ray, coherent=False, active=hair)
        t = dr.select(after.is_valid(), after.t, dr.inf)
        face = frame.region.face(after)
        hair = after.is_valid() & frame.region.on_hair(face)
    return t < dr.inf, face


def behind(eye: SurfaceInteraction, hit: TriangleHit, active: mi.Bool) -> SurfaceInteraction:
    """Keep the hits on the eye that nothing in front occludes."""
    other, clear = hit.is_valid() & active, ~hit.is_valid() & active
    distance = dr.select(other, hit.t, eye.distance)
    return replace(eye, cornea=eye.cornea & clear, sclera=eye.sclera & clear, other=other, distance=distance)


def appearance(frame: DeviceFrame, si: SurfaceInteraction, hit: TriangleHit, d: mi.Vector3f) -> SurfaceInteraction:
    """Add the surfaces other than the eye to the result of `intersect` along d."""
    region, background = frame.region, frame.background
    if region is not None:
        there = region_interaction(frame, region.face(hit), hit.prim_uv, d, si.other)
    else:
        matte = background.surface(hit.prim_index, hit.prim_uv, si.other)
        there = replace(_matte(frame, matte.point, matte.normal, d, si.other), albedo=matte.albedo)
    return replace(
        si,
        point=dr.select(si.other, there.point, si.point),
        normal=dr.select(si.other, there.normal, si.normal),
        albedo=there.albedo,
        gloss=dr.select(si.other, there.gloss, si.gloss),
        received=there.received,
    )


def region_hit(frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f) -> TriangleHit:
    """Intersect camera rays (scene's frame) with an eye region in front of the globe."""
    ray = segment(o, d, EyeShape(frame=frame).ray_intersect_preliminary(o, d).t)
    return TriangleHit.of(frame.scene.ray_intersect_preliminary(ray, coherent=True, active=True))


def hidden(frame: DeviceFrame, eye: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f) -> mi.Bool:
    """Return whether anything of the scene is in front of the globe along the rays that meet it."""
    if not frame.structure.obstacles:
        return eye.globe & TriangleHit.on_plane(frame.backdrop_x, o, d, eye.distance).is_valid()
    return ray_blocked(frame.scene, segment(o, d, eye.distance), eye.globe)


@syntax
def ray_blocked(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
    """Return whether anything of a scene blocks rays; packets without active rays are skipped."""
    found = mi.Bool(False)
    if dr.hint(active, exclude=[scene, ray]):
        found = scene.ray_test(ray, coherent=True, active=True)
    return found


def segment(o: mi.Vector3f, d: mi.Vector3f, length: mi.Float) -> mi.Ray3f:
    """Create rays that end after a length, for example at the globe, whatever lies behind."""
    ray = mi.Ray3f(mi.Point3f(o), d)
    ray.maxt = length
    return ray


def region_interaction(
    frame: DeviceFrame, face: mi.UInt32, uv: mi.Point2f, d: mi.Vector3f, active: mi.Bool
) -> SurfaceInteraction:
    """Compute the interaction of rays along d (scene's frame) with triangles of an eye region."""
    skin = frame.region.surface(face, uv, active)
    si = _matte(frame, skin.point, skin.normal, d, active)
    level = facing(frame, skin.smooth, d) if frame.structure.scattering else None
    return replace(si, albedo=skin.albedo, gloss=skin.gloss, received=skin.received, level=level)


def _matte(
    frame: DeviceFrame, point: mi.Vector3f, normal: mi.Vector3f, d: mi.Vector3f, active: mi.Bool
) -> SurfaceInteraction:
    """Compute the interaction with matte points of the scene, with normals turned to the viewer."""
    place = frame.point_to_eye(point)
    return replace(SurfaceInteraction.blank(), other=active, point=place, normal=facing(frame, normal, d))


def facing(frame: DeviceFrame, normal: mi.Vector3f, d: mi.Vector3f) -> mi.Vector3f:
    """Compute normals (eye frame) turned to the viewer; normals and rays are given in the scene's frame."""
    normal = frame.vector_to_eye(normal)
    return dr.normalize(dr.select(dr.dot(normal, frame.vector_to_eye(d)) > 0, -normal, normal))
