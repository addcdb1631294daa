"""Shading of one ray: light on matte surfaces, the iris behind the cornea, and mirroring by wet surfaces.

    L = (1 - F) / n^2 * albedo / pi * sum_l I_l (1 - F_l) cos(theta) / J_l

from the iris, which every lamp lights through all refracting surfaces (`lighting`). Sclera and surround are matte and
lit directly.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..hits.interaction import EPSILON_MM, SurfaceInteraction, first_hit, outer_albedo
from ..materials.albedo import iris_albedo, stop_coordinates
from ..materials.gloss import film_normal, film_reflectance
from ..records.frame import Frame
from ..transport.directlight import lamp_light, on_relief

_FLAT_MM = 1e-2  # from the plane of a surround


def shade(frame: Frame, o: mi.Vector3f, d: mi.Vector3f, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.UInt32]:
    """Radiance (mW/mm^2/sr) along rays of the scene's frame before a bare eye, and failed light paths.

    u, v: place on each lamp's disc, [0, 1).
    """
    view = on_relief(frame, first_hit(frame, o, d, mi.Bool(True)))
    known, outer_known = mi.Bool(False), mi.Float(0)
    if frame.caches.globe is not None:
        outer_known, known = frame.caches.globe.at(frame, view)
    outer, inner, failures = lamp_light(frame, view, u, v, known)
    albedo = outer_albedo(frame, view)
    received = of_surroundings(frame, view, known)
    seen = indirect(frame, view, d, albedo, inner, received) + direct(view, albedo, outer + outer_known, mi.Float(0))
    return seen, failures


def direct(view: SurfaceInteraction, albedo: mi.Float, outer: mi.Float, shine: mi.Float) -> mi.Float:
    """Radiance of matte surfaces lit by the lamps: from their irradiance, and from their sheen."""
    return dr.select(view.met, _cover(view) * (albedo * outer * dr.inv_pi + shine), 0)


def of_surroundings(frame: Frame, view: SurfaceInteraction, known: mi.Bool) -> mi.Vector4f:
    """What points of a bare globe and of its background receive from other surfaces (see `RadiosityField`).

    Obstacles receive nothing. The light from other surfaces on the globe is left out where it is `known`.
    """
    received, nothing = frame.caches.radiosity, mi.Vector4f(0, 1, 0, 0)

    def of_plane(x: mi.Vector3f) -> mi.Vector4f:
        return dr.select(dr.abs(x.x - frame.backdrop_x) < _FLAT_MM, received.at_background(x), nothing)

    def of_either(x: mi.Vector3f) -> mi.Vector4f:
        return dr.if_stmt((x,), view.other, of_plane, received.at_globe)

    known &= ~view.other
    wanted = view.matte if frame.structure.ambient else view.matte & ~known
    found = dr.if_stmt((frame.point_to_scene(view.point),), wanted, of_either, lambda x: nothing)
    return mi.Vector4f(dr.select(known, 0, found.x), found.y, found.z, found.w)


def indirect(
    frame: Frame, view: SurfaceInteraction, d: mi.Vector3f, albedo: mi.Float, inner: mi.Float, received: mi.Vector4f
) -> mi.Float:
    """Radiance other than `direct`.

    Args:
        frame: the frame.
        view: what is seen.
        d: directions of the rays (scene's frame).
        albedo: of what is matte.
        inner: irradiance of the lamps in the plane of the iris.
        received: what the first surface receives from other surfaces (see `radiosityfield.RadiosityField`).
    """
    index = frame.inner_index
    rest = off_eye(frame, view, d, albedo, received)
    if not frame.structure.ambient:
        rest += _mirrored(frame, view, d, 1 - _cover(view))
    leaving = (
        dr.if_stmt(
            (view.inner, inner),
            view.lit_inside,
            lambda x, lit: _leaving(frame, view.pupil, x, lit),
            lambda x, lit: mi.Float(0),
        )
        * dr.inv_pi
        / (index * index)
    )
    if frame.caches.fundus is not None:
        seen = view.cornea & view.pupil
        leaving += dr.select(seen, frame.caches.fundus.at(*stop_coordinates(frame, view.inner), seen), 0)
    rest += dr.select(view.cornea, (1 - view.opacity) * view.passed * leaving, 0)
    return dr.select(view.met, rest, 0)


def off_eye(
    frame: Frame, view: SurfaceInteraction, d: mi.Vector3f, albedo: mi.Float, received: mi.Vector4f
) -> mi.Float:
    """The same of what is not the clear cornea; see `indirect`."""
    even, mirrored = received.x, mi.Float(0)
    if frame.structure.ambient:
        facing = view.normal if view.level is None else view.level
        x, normal = frame.point_to_scene(view.point), frame.vector_to_scene(facing)
        even += received.y * frame.caches.ambience.irradiance(x, normal)
        mirrored = _mirrored(frame, view, d, 1 - _cover(view))
    return dr.select(view.met, _cover(view) * albedo * even * dr.inv_pi + mirrored, 0)


def _cover(view: SurfaceInteraction) -> mi.Float:
    """Share of the first surface that is matte."""
    return dr.select(view.cornea, view.opacity, 1)


def _leaving(frame: Frame, pupil: mi.Bool, x: mi.Vector3f, lit: mi.Float) -> mi.Float:
    """Radiosity of points in the plane of the iris that have the irradiance `lit` from the lamps."""
    albedo = dr.if_stmt((x,), ~pupil, lambda x: iris_albedo(frame, x), lambda x: mi.Float(frame.pupil_albedo))
    return albedo * (lit + frame.caches.radiosity.at_iris(x))


def _mirrored(frame: Frame, view: SurfaceInteraction, d: mi.Vector3f, clear: mi.Float) -> mi.Float:
    """Radiance that wet surfaces mirror to the camera, but for that of the lamps.

    The front cornea, where it is `clear`, mirrors the ambient light and the surfaces about it. The film of tears
    elsewhere mirrors the ambient light.
    """
    received = frame.caches.radiosity
    normal, share = view.normal, view.mirrored * clear
    seen, wet = mi.Float(0), view.cornea & (clear > 0)
    film = mi.Bool(False)
    if frame.structure.ambient and frame.structure.region:
        film = ~view.cornea & view.met & (view.gloss > 0.5)
        normal = dr.select(film, film_normal(view.normal), view.normal)
        cosine = -dr.dot(normal, frame.vector_to_eye(d))
        share = dr.select(film, film_reflectance(cosine, view.gloss), share)
    normal = frame.vector_to_scene(normal)
    way = d - 2 * dr.dot(d, normal) * normal
    start = frame.point_to_scene(view.point) + EPSILON_MM * normal
    if frame.structure.ambient:
        seen = frame.ambient_irradiance * dr.inv_pi + frame.caches.ambience.radiance(start, way, wet | film)
    else:
        wet &= received.on
    if frame.structure.obstacles:
        hit = frame.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(start), way), coherent=True, active=wet | film)
        barred = hit.is_valid()
        surface = mi.Float(0)
        if frame.region is not None:
            skin = frame.region.surface(frame.region.face(hit), hit.prim_uv, barred & wet)
            surface = dr.select(wet, skin.albedo * skin.received.z * dr.inv_pi, 0)
        seen = dr.select(barred, surface, seen)
    else:
        t = (frame.backdrop_x - start.x) / dr.select(way.x < -1e-4, way.x, -1)
        seen = dr.if_stmt(
            (start + t * way, seen),
            wet & (way.x < -1e-4) & (t > 0),
            lambda x, _: received.at_background(x).z * dr.inv_pi,
            lambda _, seen: seen,
        )
    return dr.select(wet | film, share * seen, 0)
