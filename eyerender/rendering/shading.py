"""Shading of one ray: light on matte surfaces, the iris behind the cornea, and mirroring by wet surfaces.

    L = (1 - F) / n^2 * albedo / pi * sum_l I_l (1 - F_l) cos(theta) / J_l

from the iris, which every lamp lights through all refracting surfaces (`lighting`). Sclera and surround are matte and
lit directly.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .lighting import light
from .region import film_normal, film_reflectance
from .values import Lights, Values
from .view import EPSILON_MM, Textures, View, iris_albedo, look, outer_albedo, stop_coordinates

_THROUGH = 0.7  # share of the outer hemisphere that the iris sees, times transmittance; chosen


@dataclass(frozen=True, slots=True)
class Shaded:
    """Result of a ray: radiance (mW/mm^2/sr), what it met, the albedo there where it is matte, failed light paths."""

    radiance: mi.Float
    view: View
    albedo: mi.Float
    failures: mi.UInt32


def shade(
    values: Values,
    lights: Lights,
    textures: Textures,
    scene: mi.Scene,
    o: mi.Vector3f,
    d: mi.Vector3f,
    active: mi.Bool,
    u: mi.Float,
    v: mi.Float,
) -> Shaded:
    """Radiance along rays of the scene's frame, from light that comes from the lamps by the shortest way.

    u, v: place on each lamp's disc, [0, 1).
    """
    view = look(values, scene, o, d, active, textures.region)
    outer, shine, inner, failures = light(values, lights, scene, view, -values.vector_to_eye(d), u, v)
    albedo = outer_albedo(values, textures, view, active)
    seen = indirect(values, textures, scene, view, d, albedo, inner) + direct(view, albedo, outer, shine)
    return Shaded(seen, view, albedo, failures)


def direct(view: View, albedo: mi.Float, outer: mi.Float, shine: mi.Float) -> mi.Float:
    """Radiance of matte surfaces lit by the lamps: from their irradiance, and from their sheen."""
    cover = dr.select(view.cornea, view.opacity, 1)
    return dr.select(view.met, cover * (albedo * outer * dr.inv_pi + shine), 0)


def indirect(
    values: Values, textures: Textures, scene: mi.Scene, view: View, d: mi.Vector3f, albedo: mi.Float, inner: mi.Float
) -> mi.Float:
    """Radiance other than `direct`; `inner` is the lamps' irradiance in the plane of the iris."""
    rest = mi.Float(0)
    index = values.inner_index
    if values.structure.ambient:
        ambience = textures.ambience
        assert ambience is not None
        # This is even light from all sides. Through the cornea the iris sees n^2 times its radiance in a smaller cone.
        cover = dr.select(view.cornea, view.opacity, 1)
        scene_of = values.point_to_scene
        axis = values.vector_to_scene(values.stop.normal)
        even = ambience.irradiance(scene_of(view.point), values.vector_to_scene(view.normal))
        within = ambience.irradiance(scene_of(view.inner), axis) * _THROUGH * index * index
        if values.structure.region:
            assert ambience.lids is not None
            reaching = ambience.lids.share(scene_of(view.point))
            # Only the wet parts of the region are between the lids.
            even *= 1 - dr.clip(10 * view.gloss - 4.5, 0, 1) * (1 - reaching)
            within *= reaching
        rest += cover * albedo * even * dr.inv_pi
        inner += within
        rest += _mirrored(values, textures, scene, view, d, 1 - cover)
    behind = dr.if_stmt(
        (view.inner,),
        view.cornea & ~view.pupil,
        lambda inner: iris_albedo(values, textures, inner),
        lambda inner: mi.Float(values.pupil_albedo),
    )
    leaving = behind * inner * dr.inv_pi / (index * index)
    if textures.pupil is not None:
        seen = view.cornea & view.pupil
        leaving += dr.select(seen, textures.pupil.at(*stop_coordinates(values, view.inner), seen), 0)
    rest += dr.select(view.cornea, (1 - view.opacity) * view.passed * leaving, 0)
    return dr.select(view.met, rest, 0)


def _mirrored(
    values: Values, textures: Textures, scene: mi.Scene, view: View, d: mi.Vector3f, clear: mi.Float
) -> mi.Float:
    """Radiance of the ambient light that wet surfaces mirror to the camera.

    These are the front cornea where it is `clear`, and the film of tears elsewhere.
    """
    back = -values.vector_to_eye(d)
    normal, share = view.normal, view.mirrored * clear
    wet = view.cornea
    if values.structure.region:
        film = ~view.cornea & view.met & (view.gloss > 0.5)
        normal = dr.select(film, film_normal(view.normal), view.normal)
        share = dr.select(film, film_reflectance(dr.dot(normal, back), view.gloss), share)
        wet |= film
    assert textures.ambience is not None
    normal = values.vector_to_scene(normal)
    way = d - 2 * dr.dot(d, normal) * normal
    start = values.point_to_scene(view.point) + EPSILON_MM * normal
    seen = values.ambient_irradiance * dr.inv_pi + textures.ambience.radiance(start, way, wet)
    if values.structure.obstacles:
        barred = scene.ray_test(mi.Ray3f(mi.Point3f(start), way), coherent=True, active=wet)
        seen = dr.select(barred, 0, seen)
    return dr.select(wet, share * seen, 0)
