"""The menisci: water between lids and globe, which mirrors the lamps and refracts the light behind it.

A camera ray is refracted at the water's surface, n sin(a') = sin(a), and continues to the globe. There it meets the
tear film, so its further path is that of the ray in air which the globe refracts into the same direction.

The lid margin below the far edge of the meniscus, where the water is thinnest, is shown without displacement. Water
casts no shadow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...optics.media import TEARS
from ..records.frame import DeviceFrame
from ..records.recording import syntax
from ..records.surfaces import DEVICE
from .eyeshape import EyeShape
from .interaction import SurfaceInteraction
from .primary import TriangleHit, region_interaction, segment

_INDEX = float(TEARS.index(850.0))
_LEAST = 0.1  # cosine below which a ray is not followed


@dataclass(kw_only=True)
class MeniscusView:
    """The surface that a camera ray shows, and its direction in air there (scene's frame)."""

    si: SurfaceInteraction
    d: mi.Vector3f


def water_hit(frame: DeviceFrame, o: mi.Vector3f, d: mi.Vector3f, nearest: mi.Float) -> TriangleHit:
    """Intersect camera rays (scene's frame) with the menisci that lie before their first hit."""
    hit = frame.region.water.ray_intersect_preliminary(segment(o, d, nearest), coherent=True, active=True)
    return replace(TriangleHit.of(hit), prim_index=frame.region.on_water(hit))


def on_water(frame: DeviceFrame, si: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f) -> SurfaceInteraction:
    """Replace the surface met by camera rays with a meniscus where one is in front of it."""
    if frame.region is None or frame.region.water is None:
        return si
    hit = water_hit(frame, o, d, si.distance)
    wet = hit.is_valid()
    water = region_interaction(frame, hit.prim_index, hit.prim_uv, d, wet)
    first: SurfaceInteraction = dr.select(wet, replace(water, level=None), replace(si, level=None))
    return first


@syntax
def through_water(
    frame: DeviceFrame, hit: TriangleHit, si: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f
) -> tuple[SurfaceInteraction, mi.Vector3f]:
    """Refract camera rays at menisci that they hit in front of the globe.

    Returns:
        The surface of the globe that they show, and their directions in air in front of it.
    """
    view = MeniscusView(si=si, d=mi.Vector3f(d))
    if dr.hint(hit.is_valid() & ~si.other, exclude=[frame, hit, si, o, d]):
        view = _bent(frame, hit, view, o, d)
    return view.si, view.d


def _bent(frame: DeviceFrame, hit: TriangleHit, view: MeniscusView, o: mi.Vector3f, d: mi.Vector3f) -> MeniscusView:
    """Refract rays into the water and out of it; rays without a solution keep their direction."""
    si = view.si
    x = o + hit.t * d
    surface = frame.region.surface(hit.prim_index, hit.prim_uv, hit.is_valid() & ~si.other)
    below = frame.vector_to_scene(si.normal)
    inside, enters = _refracted(d, surface.normal, 1 / _INDEX)
    cosine = dr.maximum(-dr.dot(inside, below), _LEAST)
    deep = dr.dot(x - frame.point_to_scene(si.point), below)
    outside, leaves = _refracted(inside, below, _INDEX)
    way = dr.select(enters & leaves, outside, d)
    seen = EyeShape(frame=frame).ray_intersect(x + (deep / cosine) * inside, way)
    found = enters & leaves & seen.globe
    # Below the water nothing mirrors the lamps. The distance gives the depth that the point has without water.
    dry = mi.Float(0)
    seen.distance = si.distance * (frame.axis_cosine(d) / frame.axis_cosine(way))
    seen, kept = (replace(s, gloss=dry, mirrored=dry) for s in (seen, si))
    return MeniscusView(si=dr.select(found, seen, kept), d=dr.select(found, way, d))


def _refracted(d: mi.Vector3f, normal: mi.Vector3f, eta: mi.Float) -> tuple[mi.Vector3f, mi.Bool]:
    """Compute refracted directions at a surface whose normal faces the ray, and whether they exist.

    `eta` is the refractive index in front of the surface over that behind it.
    """
    bend = DEVICE.refract(d, normal, eta)
    return dr.normalize(mi.Vector3f(*bend.way)), bend.passes & (bend.cosine > _LEAST)
