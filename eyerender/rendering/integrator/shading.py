"""Shading of one ray: light on matte surfaces, the iris behind the cornea, and mirroring by wet surfaces.

    L = (1 - F) / n^2 * albedo / pi * sum_l I_l (1 - F_l) cos(theta) / J_l

is the radiance of the iris, which every lamp lights through all refracting surfaces (`directlight`). Sclera and
background are matte and lit directly.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..hits.interaction import EPSILON_MM, SurfaceInteraction, outer_albedo
from ..hits.primary import first_hit
from ..materials.albedo import iris_albedo, stop_coordinates
from ..materials.gloss import film_normal, film_reflectance
from ..records.frame import DeviceFrame
from ..records.recording import syntax
from ..transport.directlight import irradiance_through_cornea, on_relief, onto_matte

_FLAT_MM = 1e-2  # distance from the plane of the background


def shade(frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.UInt32]:
    """Compute the radiance (mW/mm^2/sr) along rays of the scene's frame for a bare eye, and count failed light paths.

    (u, v) is the position on each lamp's disc, [0, 1)^2.
    """
    si = on_relief(frame, first_hit(frame, o, d, mi.Bool(True)))
    known, outer_known = mi.Bool(False), mi.Float(0)
    if frame.caches.globe is not None:
        outer_known, known = frame.caches.globe.at(frame, si)
    outer = onto_matte(frame, si, u, v, si.matte & ~known)
    inner, failures = irradiance_through_cornea(frame, si.inner, si.lit_inside, u, v)
    albedo = outer_albedo(frame, si)
    received = of_surroundings(frame, si, known)
    rest = indirect(frame, si, d, albedo, inner, received)
    return rest + direct(si, albedo, outer + outer_known, mi.Float(0)), failures


def direct(si: SurfaceInteraction, albedo: mi.Float, outer: mi.Float, shine: mi.Float) -> mi.Float:
    """Compute the radiance of matte surfaces lit by lamps, the sum of diffuse reflection and gloss."""
    return dr.select(si.met, si.cover * (albedo * outer * dr.inv_pi + shine), 0)


@syntax
def of_surroundings(frame: DeviceFrame, si: SurfaceInteraction, known: mi.Bool) -> mi.Vector4f:
    """Return the light that a bare globe and its background receive from other surfaces.

    See `radiosityfield.RadiosityField`. Obstacles receive nothing. Where `known`, the light on the globe is left out.
    """
    known = known & ~si.other
    wanted = si.matte if frame.structure.ambient else si.matte & ~known
    received, x = mi.Vector4f(0, 1, 0, 0), frame.point_to_scene(si.point)
    if dr.hint(wanted, exclude=[frame, si, x]):
        received = _from_other_surfaces(frame, si.other, x)
    return mi.Vector4f(dr.select(known, 0, received.x), received.y, received.z, received.w)


@syntax
def _from_other_surfaces(frame: DeviceFrame, other: mi.Bool, x: mi.Vector3f) -> mi.Vector4f:
    """Return the light from other surfaces at points x (scene's frame) of the globe, or of something `other`."""
    radiosity = frame.caches.radiosity
    if dr.hint(other, exclude=[frame, radiosity, x]):
        on_plane = dr.abs(x.x - frame.backdrop_x) < _FLAT_MM
        received = dr.select(on_plane, radiosity.at_background(x), mi.Vector4f(0, 1, 0, 0))
    else:
        received = radiosity.at_globe(x)
    return received


def indirect(
    frame: DeviceFrame, si: SurfaceInteraction, d: mi.Vector3f, albedo: mi.Float, inner: mi.Float, received: mi.Vector4f
) -> mi.Float:
    """Compute all radiance except that of `direct`.

    Args:
        frame: the frame.
        si: the visible surface, and the iris behind it.
        d: directions of the rays (scene's frame).
        albedo: albedo of matte surfaces.
        inner: irradiance of the lamps in the plane of the iris.
        received: light of other surfaces on the first surface (see `radiosityfield.RadiosityField`).
    """
    rest = off_eye(frame, si, d, albedo, received)
    if not frame.structure.ambient:
        rest += _mirrored(frame, si, d)
    leaving = _radiosity_of_iris(frame, si, inner) * dr.inv_pi / (frame.inner_index * frame.inner_index)
    if frame.caches.fundus is not None:
        seen = si.cornea & si.pupil
        leaving += dr.select(seen, frame.caches.fundus.at(*stop_coordinates(frame, si.inner), seen), 0)
    rest += dr.select(si.cornea, (1 - si.opacity) * si.passed * leaving, 0)
    return dr.select(si.met, rest, 0)


def off_eye(
    frame: DeviceFrame, si: SurfaceInteraction, d: mi.Vector3f, albedo: mi.Float, received: mi.Vector4f
) -> mi.Float:
    """Compute the radiance as in `indirect`, except for the clear cornea."""
    even, mirrored = received.x, mi.Float(0)
    if frame.structure.ambient:
        facing = si.normal if si.level is None else si.level
        x, normal = frame.point_to_scene(si.point), frame.vector_to_scene(facing)
        even += received.y * frame.caches.ambience.at(x, normal)
        mirrored = _mirrored(frame, si, d)
    return dr.select(si.met, si.cover * albedo * even * dr.inv_pi + mirrored, 0)


@syntax
def _radiosity_of_iris(frame: DeviceFrame, si: SurfaceInteraction, lit: mi.Float) -> mi.Float:
    """Compute the radiosity in the plane of the iris, given its irradiance `lit` from the lamps."""
    radiosity = mi.Float(0)
    if dr.hint(si.lit_inside, exclude=[frame, si, lit]):
        albedo = mi.Float(frame.pupil_albedo)
        if dr.hint(~si.pupil, exclude=[frame, si]):
            albedo = iris_albedo(frame, si.inner)
        radiosity = albedo * (lit + frame.caches.radiosity.at_iris(si.inner))
    return radiosity


def _mirrored(frame: DeviceFrame, si: SurfaceInteraction, d: mi.Vector3f) -> mi.Float:
    """Compute the radiance that wet surfaces mirror to the camera, except that of the lamps.

    The clear front cornea mirrors the ambient light and the surfaces around it. Elsewhere the tear film mirrors the
    ambient light.
    """
    clear = 1 - si.cover
    normal, share, wet, film = si.normal, si.mirrored * clear, si.cornea & (clear > 0), mi.Bool(False)
    if frame.structure.ambient and frame.structure.region:
        film = ~si.cornea & si.met & (si.gloss > 0.5)
        normal = dr.select(film, film_normal(si.normal), si.normal)
        cosine = -dr.dot(normal, frame.vector_to_eye(d))
        share = dr.select(film, film_reflectance(cosine, si.gloss), share)
    normal = frame.vector_to_scene(normal)
    way = d - 2 * dr.dot(d, normal) * normal
    start = frame.point_to_scene(si.point) + EPSILON_MM * normal
    seen = mi.Float(0)
    if frame.structure.ambient:
        seen = frame.ambient_irradiance * dr.inv_pi + frame.caches.ambience.radiance(start, way, wet | film)
    else:
        wet &= frame.caches.radiosity.on
    mirror = mirror_of_scene if frame.structure.obstacles else _mirror_of_plane
    return dr.select(wet | film, share * mirror(frame, start, way, wet, film, seen), 0)


def mirror_of_scene(
    frame: DeviceFrame, start: mi.Vector3f, way: mi.Vector3f, wet: mi.Bool, film: mi.Bool, seen: mi.Float
) -> mi.Float:
    """Compute the radiance of skin mirrored by the cornea or a lens (`wet`); `seen` where a ray meets nothing."""
    hit = frame.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(start), way), coherent=True, active=wet | film)
    surface, met = mi.Float(0), hit.is_valid()
    if frame.region is not None:
        skin = frame.region.surface(frame.region.face(hit), hit.prim_uv, met & wet)
        surface = dr.select(wet, skin.albedo * skin.received.z * dr.inv_pi, 0)
    return dr.select(met, surface, seen)


@syntax
def _mirror_of_plane(
    frame: DeviceFrame, start: mi.Vector3f, way: mi.Vector3f, wet: mi.Bool, film: mi.Bool, seen: mi.Float
) -> mi.Float:
    """Compute the radiance of the background's plane mirrored by the cornea; `seen` where a ray misses it."""
    t = (frame.backdrop_x - start.x) / dr.select(way.x < -1e-4, way.x, -1)
    x = start + t * way
    if dr.hint(wet & (way.x < -1e-4) & (t > 0), exclude=[frame, x]):
        seen = frame.caches.radiosity.at_background(x).z * dr.inv_pi
    return seen
