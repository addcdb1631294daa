"""The menisci: water between lids and globe, which mirrors the lamps and bends the light behind it.

A camera ray is refracted at the water's surface, n sin(a') = sin(a), and goes on to the globe. There it meets the film
that lies everywhere, so the rest of its way is that of the ray in air which the globe refracts into the same direction.

The margin below the other edge of the meniscus, where the water is thinnest, is seen without displacement. Water
shadows nothing.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...optics.media import TEARS
from ..records.frame import Frame
from ..scene.region import SkinGeometry
from .interaction import SurfaceInteraction, intersect_globe, look_at_skin

_INDEX = float(TEARS.index(850.0))
_LEAST = 0.1  # cosine below which a ray is not followed


def wetted(
    water: mi.Scene, o: mi.Vector3f, d: mi.Vector3f, nearest: mi.Float
) -> tuple[mi.PreliminaryIntersection3f, mi.Bool]:
    """Hits of camera rays (scene's frame) on menisci in front of what they meet, and whether there are any."""
    ray = mi.Ray3f(mi.Point3f(o), d)
    ray.maxt = nearest
    film = water.ray_intersect_preliminary(ray, coherent=True, active=True)
    return film, film.is_valid()


def on_water(frame: Frame, view: SurfaceInteraction, o: mi.Vector3f, d: mi.Vector3f) -> SurfaceInteraction:
    """The view of camera rays where menisci are in front of it, else `view` itself."""
    region = frame.region
    if region is None or region.water is None:
        return view
    film, wet = wetted(region.water, o, d, view.distance)
    water = look_at_skin(frame, region, region.on_water(film), film.prim_uv, d, wet)
    return SurfaceInteraction(*(dr.select(wet, a, b) for a, b in zip(parts_of(water), parts_of(view), strict=True)))


def through_water(
    frame: Frame,
    skin: SkinGeometry,
    film: mi.PreliminaryIntersection3f,
    wet: mi.Bool,
    view: SurfaceInteraction,
    o: mi.Vector3f,
    d: mi.Vector3f,
) -> tuple[SurfaceInteraction, mi.Vector3f]:
    """What rays show of the globe behind a meniscus, where `wet`, and their directions in air before it."""
    wet &= ~view.other

    def bent(d: mi.Vector3f, *parts: Any) -> tuple[Any, ...]:
        view = SurfaceInteraction(*parts)
        x = o + film.t * d
        surface = skin.surface(skin.on_water(film), film.prim_uv, wet)
        below = frame.vector_to_scene(view.normal)
        inside, enters = _refracted(d, surface.normal, 1 / _INDEX)
        cosine = dr.maximum(-dr.dot(inside, below), _LEAST)
        deep = dr.dot(x - frame.point_to_scene(view.point), below)
        outside, leaves = _refracted(inside, below, _INDEX)
        way = dr.select(enters & leaves, outside, d)
        seen = intersect_globe(frame, x + (deep / cosine) * inside, way)
        found = enters & leaves & (seen.cornea | seen.sclera)
        # Below the water nothing mirrors the lamps. The distance is that at which the depth is the one without water.
        forward = frame.camera.forward
        dry, distance = mi.Float(0), view.distance * (dr.dot(d, forward) / dr.dot(way, forward))
        seen = replace(seen, distance=distance)
        seen, view = (replace(v, gloss=dry, mirrored=dry) for v in (seen, view))
        return dr.select(found, way, d), *(
            dr.select(found, a, b) for a, b in zip(parts_of(seen), parts_of(view), strict=True)
        )

    d, *parts = dr.if_stmt((d, *parts_of(view)), wet, bent, lambda *unchanged: unchanged)
    return SurfaceInteraction(*parts), d


def parts_of(view: SurfaceInteraction) -> tuple[Any, ...]:
    """Fields of a view but for the last one, which `intersect_globe` does not set."""
    return tuple(getattr(view, f.name) for f in fields(SurfaceInteraction) if f.name != "level")


def _refracted(d: mi.Vector3f, normal: mi.Vector3f, eta: mi.Float) -> tuple[mi.Vector3f, mi.Bool]:
    """Directions behind a surface whose normal faces the ray, and whether there are any.

    eta: index before the surface over that behind it.
    """
    c = -dr.dot(normal, d)
    rest = 1 - eta * eta * (1 - c * c)
    way = dr.normalize(eta * d + (eta * c - dr.sqrt(dr.maximum(rest, 0))) * normal)
    return way, (rest > 0) & (c > _LEAST)
