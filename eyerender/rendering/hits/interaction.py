"""Intersection of camera rays with the exact surfaces of the eye or with the scene, and the albedo there.

A ray is intersected with the eye in closed form (the exact surfaces, not a mesh) and with everything else by Embree or
OptiX; the nearer hit is used. Through the clear cornea the ray continues to the plane of the iris.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from ..materials.albedo import opacity, sclera_albedo, stop_coordinates
from ..records.frame import Frame
from ..records.surfaces import Bundle
from ..scene.background import HALF_MM
from ..scene.region import SkinGeometry

EPSILON_MM = 2e-3  # points closer than this are the same in single precision
_NEAR_MM = 20.0
_DEEPEST = 0.75  # least inverse depth of the image of an iris, relative to the cornea's: grazing rays come from afar
_FAR = float(np.finfo(np.float32).max)
_WET = 0.93  # gloss of the sclera


@dataclass(frozen=True, slots=True)
class SurfaceInteraction:
    """What a camera ray meets, with points and normals in the eye frame."""

    cornea: mi.Bool  # it enters through the clear part of the cornea
    sclera: mi.Bool
    other: mi.Bool  # anything of the scene that is not the eye
    distance: mi.Float
    point: mi.Vector3f  # on the first surface
    normal: mi.Vector3f
    opacity: mi.Float  # of the tissue at the first surface: 0 clear cornea, 1 sclera
    mirrored: mi.Float  # reflectance of the front cornea
    passed: mi.Float  # transmittance of the refracted branch, 0 where it does not reach the plane of the iris
    inner: mi.Vector3f  # point in the plane of the iris
    slant: mi.Vector3f  # lateral motion of the ray per mm of height above that plane
    pupil: mi.Bool  # the inner point lies in the pupil
    albedo: mi.Float  # of the region's mesh, where there is one
    gloss: mi.Float  # likewise, and of the wet sclera
    received: mi.Vector4f  # of the region's mesh: what it receives from other surfaces (see `radiosity`)
    level: mi.Vector3f | None = None  # normal without the relief of skin in which light spreads

    @property
    def matte(self) -> mi.Bool:
        """Whether the first surface is matte, at least in part."""
        return (self.cornea & (self.opacity > 0)) | self.sclera | self.other

    @property
    def lit_inside(self) -> mi.Bool:
        """Whether light from behind the cornea is visible."""
        return self.cornea & (self.opacity < 1) & (self.passed > 0)

    @property
    def met(self) -> mi.Bool:
        """Whether the ray meets anything."""
        return self.cornea | self.sclera | self.other

    def nearness(self, frame: Frame, d: mi.Vector3f) -> mi.Float:
        """Inverse depth (1/mm) of what camera rays along d (scene's frame) show.

        Behind the cornea it is the change of direction that keeps a ray on its place in the plane of the iris while the
        pinhole moves across the optical axis: by the mean of moves in two directions, because the image is astigmatic.
        """
        forward = frame.camera.forward
        near = dr.rcp(dr.maximum(self.distance * dr.dot(d, forward), 1e-3))
        deep = self.lit_inside & (self.opacity < 0.5)
        return dr.if_stmt(
            (mi.Vector3f(d), near),
            deep,
            lambda d, near: dr.clip(self._nearness_inside(frame, d), _DEEPEST * near, near),
            lambda _, near: near,
        )

    def _nearness_inside(self, frame: Frame, d: mi.Vector3f) -> mi.Float:
        """The same of lanes that show the plane of the iris."""
        camera, front = frame.camera, frame.surfaces[0]
        cosine = dr.dot(d, camera.forward)
        turned = [frame.vector_to_eye(cosine * (e - d * dr.dot(e, d))) for e in (camera.right, camera.down)]
        moved = [frame.vector_to_eye(e) for e in (camera.right, camera.down)]
        y, form = front.on_surface(self.point)
        w, none = frame.vector_to_eye(d), mi.Vector3f(0)
        at = []
        for points, ways in (([self.distance * e for e in turned], turned), (moved, [none, none])):
            bundle = front.bend(Bundle(y, w, *points, *ways), form)[0]
            for surface in frame.surfaces[1:]:
                bundle = surface.refract_bundle(bundle)[0]
            s = dr.dot(frame.stop.centre - bundle.y, frame.stop.normal) / dr.dot(bundle.w, frame.stop.normal)
            at.append((bundle.w, bundle.da + s * bundle.wa, bundle.db + s * bundle.wb))
        (w, a, b), (_, p, q) = at
        both = dr.dot(w, dr.cross(p, b)) + dr.dot(w, dr.cross(a, q))
        return 0.5 * both / dr.dot(w, dr.cross(a, b))


@dataclass(frozen=True, slots=True)
class PlaneHit:
    """Hit on the plane of the surround in closed form, as on its first triangle, extended."""

    t: mi.Float
    prim_index: mi.UInt32
    prim_uv: mi.Point2f

    @classmethod
    def of(cls, plane_x: mi.Float, o: mi.Vector3f, d: mi.Vector3f, nearest: mi.Float) -> PlaneHit:
        """Hits of rays with the plane at `plane_x` that are nearer than `nearest`."""
        t = (plane_x - o.x) / d.x
        y, z = o.y + t * d.y, o.z + t * d.z
        met = (t > 0) & (t < nearest) & (dr.maximum(dr.abs(y), dr.abs(z)) < HALF_MM)
        uv = mi.Point2f((y - z) / (2 * HALF_MM), (z + HALF_MM) / (2 * HALF_MM))
        return cls(dr.select(met, t, dr.inf), mi.UInt32(0), uv)

    def is_valid(self) -> mi.Bool:
        """Whether the plane is hit."""
        return self.t < dr.inf


@dataclass
class RegionHit:
    """Hit of a ray on a triangle (`face`) of an eye region, infinitely far where there is none."""

    t: mi.Float = None
    face: mi.UInt32 = None
    prim_uv: mi.Point2f = None

    def is_valid(self) -> mi.Bool:
        """Whether anything is hit."""
        return self.t < dr.inf


Hit: TypeAlias = "mi.PreliminaryIntersection3f | PlaneHit"


def first_hit(frame: Frame, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool) -> SurfaceInteraction:
    """Trace camera rays (scene's frame) to the first surface and through the cornea to the plane of the iris."""
    view, hit = intersect(frame, o, d, active)
    return appearance(frame, view, hit, d)


def appearance(frame: Frame, view: SurfaceInteraction, hit: Hit, d: mi.Vector3f) -> SurfaceInteraction:
    """View of rays along which `intersect` found `view` and `hit`, with the surface of what is not the eye."""
    region, background = frame.region, frame.background
    if region is not None:
        there = look_at_skin(frame, region, region.face(hit), hit.prim_uv, d, view.other)
    else:
        matte = background.surface(hit.prim_index, hit.prim_uv, view.other)
        there = replace(_matte(frame, matte.point, matte.normal, d, view.other), albedo=matte.albedo)
    return replace(
        view,
        point=dr.select(view.other, there.point, view.point),
        normal=dr.select(view.other, there.normal, view.normal),
        albedo=there.albedo,
        gloss=dr.select(view.other, there.gloss, view.gloss),
        received=there.received,
    )


def intersect(
    frame: Frame, o: mi.Vector3f, d: mi.Vector3f, active: mi.Bool, *, coherent: bool = True
) -> tuple[SurfaceInteraction, Hit]:
    """View of the globe along rays, and the hit of Embree or OptiX, whose surface is not evaluated yet.

    coherent: whether neighbouring rays are alike, as those of a camera.
    """
    alone = intersect_globe(frame, o, d)
    hit: Hit
    if frame.structure.obstacles:
        ray = _ray(alone, o, d)  # whatever is behind the eye does not matter
        hit = frame.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
    else:
        hit = PlaneHit.of(frame.backdrop_x, o, d, alone.distance)
    return behind(alone, hit, active), hit


def behind(alone: SurfaceInteraction, hit: Hit | RegionHit, active: mi.Bool) -> SurfaceInteraction:
    """View of rays that meet the globe like `alone` where nothing is hit in front of it."""
    clear = ~hit.is_valid() & active
    on_cornea, on_sclera = alone.cornea & clear, alone.sclera & clear
    other = hit.is_valid() & active
    return replace(
        alone, cornea=on_cornea, sclera=on_sclera, other=other, distance=dr.select(other, hit.t, alone.distance)
    )


def region_hit(
    skin: SkinGeometry, scene: mi.Scene, alone: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f
) -> RegionHit:
    """Hits of camera rays on an eye region in front of the globe."""
    hit = scene.ray_intersect_preliminary(_ray(alone, o, d), coherent=True, active=True)
    return RegionHit(dr.select(hit.is_valid(), hit.t, dr.inf), skin.face(hit), hit.prim_uv)


def hidden(frame: Frame, alone: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f) -> mi.Bool:
    """Whether anything of the scene is in front of the globe, where the rays of `intersect_globe` meet it."""
    met = alone.cornea | alone.sclera
    if not frame.structure.obstacles:
        return met & PlaneHit.of(frame.backdrop_x, o, d, alone.distance).is_valid()
    return dr.if_stmt(
        (), met, lambda: frame.scene.ray_test(_ray(alone, o, d), coherent=True, active=True), lambda: mi.Bool(False)
    )


def _ray(alone: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f) -> mi.Ray3f:
    """Rays as far as the globe."""
    ray = mi.Ray3f(mi.Point3f(o), d)
    ray.maxt = alone.distance
    return ray


def intersect_globe(frame: Frame, o: mi.Vector3f, d: mi.Vector3f) -> SurfaceInteraction:
    """View of the globe along rays, as if it stood alone; the distance of rays that miss it has no bound."""
    # In single precision the ray must start next to the eye.
    t0 = -dr.dot(o, d) - _NEAR_MM
    oe, de = frame.point_to_eye(o + t0 * d), frame.vector_to_eye(d)
    front = frame.surfaces[0]
    ol, dl = front.point_in(oe), front.vector_in(de)
    tc, on_cornea, facing = front.meet(ol, dl)
    yl = ol + tc * dl
    rho = dr.sqrt(yl.y * yl.y + yl.z * yl.z)
    on_cornea &= (rho < frame.limbus.radius) & (yl.x > frame.limbus.floor)
    ts, on_sclera = intersect_sphere(oe - frame.sclera.centre, de, frame.sclera.radius)
    # The sphere's front is behind the cornea, so a ray that meets the sphere first has met no clear cornea. This avoids
    # cracks, even where the rim of a tilted or toric cornea is no circle of the sphere.
    on_cornea &= ~on_sclera | (tc < ts)
    on_sclera &= ~on_cornea
    t_eye = t0 + dr.select(on_cornea, tc, ts)
    on_cornea &= t_eye > EPSILON_MM
    on_sclera &= t_eye > EPSILON_MM
    normal, mirrored, passed, inner, slant, pupil = dr.if_stmt(
        (facing, oe + tc * de, dl),
        on_cornea,
        lambda facing, y, dl: _refracted(frame, facing, y, dl),
        lambda *_: (mi.Vector3f(0), mi.Float(0), mi.Float(0), mi.Vector3f(0), mi.Vector3f(0), mi.Bool(False)),
    )
    xs = oe + ts * de
    return SurfaceInteraction(
        cornea=on_cornea,
        sclera=on_sclera,
        other=mi.Bool(False),
        distance=dr.select(on_cornea | on_sclera, t_eye, _FAR),
        point=dr.select(on_cornea, oe + tc * de, xs),
        normal=dr.normalize(dr.select(on_cornea, normal, xs - frame.sclera.centre)),
        opacity=dr.select(on_cornea, opacity(frame, rho), 1),
        mirrored=mirrored,
        passed=passed,
        inner=inner,
        slant=slant,
        pupil=pupil,
        albedo=mi.Float(0),
        gloss=mi.Float(_WET),
        received=mi.Vector4f(0),
    )


def look_at_skin(
    frame: Frame, region: SkinGeometry, face: mi.UInt32, uv: mi.Point2f, d: mi.Vector3f, other: mi.Bool
) -> SurfaceInteraction:
    """View of rays that meet places on triangles of an eye region, where `other`."""
    skin = region.surface(face, uv, other)
    view = _matte(frame, skin.point, skin.normal, d, other)
    level = _facing(frame, skin.smooth, d) if frame.structure.scattering else None
    return replace(view, albedo=skin.albedo, gloss=skin.gloss, received=skin.received, level=level)


def _matte(frame: Frame, point: mi.Vector3f, facing: mi.Vector3f, d: mi.Vector3f, other: mi.Bool) -> SurfaceInteraction:
    """View of matte points of the scene; normals are turned to the viewer."""
    no, nothing = mi.Bool(False), mi.Float(0)
    return SurfaceInteraction(
        cornea=no,
        sclera=no,
        other=other,
        distance=nothing,
        point=frame.point_to_eye(point),
        normal=_facing(frame, facing, d),
        opacity=mi.Float(1),
        mirrored=nothing,
        passed=nothing,
        inner=mi.Vector3f(0),
        slant=mi.Vector3f(0),
        pupil=no,
        albedo=nothing,
        gloss=mi.Float(_WET),
        received=mi.Vector4f(0),
    )


def _facing(frame: Frame, normal: mi.Vector3f, d: mi.Vector3f) -> mi.Vector3f:
    """Normals (eye frame) turned to the viewer; normals and rays are given in the scene's frame."""
    normal = frame.vector_to_eye(normal)
    return dr.normalize(dr.select(dr.dot(normal, frame.vector_to_eye(d)) > 0, -normal, normal))


def _refracted(
    frame: Frame, N: mi.Vector3f, y: mi.Vector3f, dl: mi.Vector3f
) -> tuple[mi.Vector3f, mi.Float, mi.Float, mi.Vector3f, mi.Vector3f, mi.Bool]:
    """From the front cornea to the plane of the iris.

    Normal, reflectance, transmittance, point, lateral motion per mm above the plane, whether in the pupil.

    N, dl: normal and direction in the front surface's frame; y: the point in the eye frame.
    """
    front = frame.surfaces[0]
    c = -dr.dot(N, dl)
    c2 = dr.sqrt(dr.maximum(1 - front.eta * front.eta * (1 - c * c), 0))
    mirrored = front.mirrored(c, c2)
    passed = 1 - mirrored
    w = front.vector_out(front.eta * dl + (front.eta * c - c2) * N)
    inside = mi.Vector3f(y)
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
    pupil = reached & (pu * pu + pv * pv < margin * margin)
    # A ray that finds no way may have no place at all, and nothing may be computed from that.
    inner = dr.select(reached, inner, frame.stop.centre)
    slant = dr.select(reached & (down < -0.05), w / down - n, 0)
    return front.vector_out(N), mirrored, dr.select(reached, passed, 0), inner, slant, pupil


def _beyond_root(frame: Frame, x: mi.Vector3f) -> mi.Vector3f:
    """Places in the plane of the iris, just beyond its root, that stand for points behind the plane.

    Where a shallow chamber's cornea ends behind the plane, a real iris bends back to its root. It is lit there about as
    at the end of the flat one.
    """
    n, centre = frame.stop.normal, frame.stop.centre
    scale = (frame.iris.root_radius + EPSILON_MM) * dr.rsqrt(dr.maximum(x.y * x.y + x.z * x.z, 1e-12))
    y, z = x.y * scale, x.z * scale
    return mi.Vector3f(centre.x - (n.y * (y - centre.y) + n.z * (z - centre.z)) / n.x, y, z)


def intersect_sphere(o: mi.Vector3f, d: mi.Vector3f, radius: mi.Float) -> tuple[mi.Float, mi.Bool]:
    """Distance to the near side of a sphere about the origin, and whether it is met from outside."""
    b, c = dr.dot(o, d), dr.squared_norm(o) - radius * radius
    disc = b * b - c
    q = dr.sqrt(dr.maximum(disc, 0)) - b
    return c / q, (disc > 0) & (q > 0) & (c > 0)


def outer_albedo(frame: Frame, view: SurfaceInteraction) -> mi.Float:
    """Albedo of the first surface where it is matte: sclera, the limbus' rim, or the scene's own material."""
    return dr.if_stmt(
        (view.point, view.albedo),
        view.other,
        lambda point, other: other,
        lambda point, other: sclera_albedo(frame, point),
    )
