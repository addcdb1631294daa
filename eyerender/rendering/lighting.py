"""The light of all lamps: directly on matte surfaces, through the cornea by manifold connections on the iris."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .manifold import connect
from .region import sheen
from .values import Lamp, Lights, Values
from .view import EPSILON_MM, View, meet_sphere, opacity


def lamp_blocked(values: Values, scene: Any, x: Any, lamp: Any, sphere: Any, cornea: Any, active: Any) -> Any:
    """Whether anything stands between a point of the eye frame and a lamp.

    `sphere`, `cornea`: lanes whose way can be barred by the globe's sphere, by the cornea's bulge.
    """
    d = lamp - x
    distance = dr.norm(d)
    d /= distance
    r = x - values["sclera.centre"]
    past = r - dr.dot(r, d) * d
    reach = values["globe.reach"]
    blocked = dr.if_stmt(
        (x, r, d, distance, mi.Bool(sphere), mi.Bool(cornea)),
        dr.squared_norm(past) < reach * reach,
        lambda x, r, d, distance, sphere, cornea: _globe_blocks(values, x, r, d, distance, sphere, cornea),
        lambda x, r, d, distance, sphere, cornea: mi.Bool(False),
    )
    if not values.structure.obstacles:
        return blocked | (values.point_to_scene(lamp).x < values["backdrop.x"])
    ray = mi.Ray3f(mi.Point3f(values.point_to_scene(x + EPSILON_MM * d)), values.vector_to_scene(d))
    ray.maxt = distance * (1 - 1e-4)
    return blocked | scene.ray_test(ray, coherent=True, active=active & ~blocked)


def _globe_blocks(values: Values, x: Any, r: Any, d: Any, distance: Any, sphere: Any, cornea: Any) -> Any:
    """Whether the globe stands in the way; r: the point from the sclera's centre."""
    t, met = meet_sphere(r, d, values["sclera.radius"])
    blocked = met & sphere & (t > EPSILON_MM) & (t < distance)
    front = values.surfaces[0]
    o, dl = front.point_in(x), front.vector_in(d)
    t, met = front.hit(o, dl)
    y = o + t * dl
    rho2 = y.y * y.y + y.z * y.z
    met &= (rho2 < values["limbus_radius"] * values["limbus_radius"]) & (y.x > values["limbus_floor"])
    return blocked | (met & cornea & (t > EPSILON_MM) & (t < distance))


def light(
    values: Values, lights: Lights, scene: Any, view: View, back: Any, u: Any, v: Any
) -> tuple[Any, Any, Any, Any]:
    """Irradiance (mW/mm^2) at the first surface where it is matte and in the plane of the iris, the radiance of its
    sheen towards the unit direction `back` (eye frame), and failed paths."""
    outside = (view.cornea & (view.opacity > 0)) | view.sclera | view.other
    inside = view.cornea & (view.opacity < 1) & (view.passed > 0)
    return lamps(values, lights, scene, view.point, view.normal, outside, view.other, view.inner, inside, u, v,
                 (back, view.gloss) if values.structure.region else None)  # fmt: skip


def lamps(
    values: Values,
    lights: Lights,
    scene: Any,
    point: Any,
    normal: Any,
    outside: Any,
    other: Any,
    inner: Any,
    inside: Any,
    u: Any,
    v: Any,
    glossy: tuple[Any, Any] | None = None,
) -> tuple[Any, Any, Any, Any]:
    """Irradiance (mW/mm^2) of all lamps outside, radiance of the sheen, irradiance inside, number of failed paths.

    Args:
        point, normal: matte points in the air, where `outside`; the scene's own where `other`, else the globe's.
        inner: points in the plane of the iris, where `inside`.
        u, v: place on each lamp's disc, [0, 1).
        glossy: unit direction to the viewer and gloss of the points outside, where they mirror at all.
    """
    n = values["stop.normal"]
    # The point's Gaussian image: where the straight line from a lamp must aim to be bent on to the point.
    scale, shift = values["image.scale"], values["image.shift"]
    aim = mi.Vector3f(inner.x + shift, inner.y * scale, inner.z * scale)

    sine, cosine_v = dr.sincos(v * (2 * dr.pi))

    def straight(lamp: Lamp, source: Any) -> tuple[Any, Any]:
        """Irradiance of one lamp in the air, and the unit direction to it."""
        to = source - point
        inv2 = dr.rcp(dr.squared_norm(to))
        to *= dr.sqrt(inv2)
        cosine = dr.dot(to, normal)
        lit = outside & (cosine > 0)
        blocked = lamp_blocked(values, scene, point, source, other, True, lit)
        return dr.select(lit & ~blocked, lamp.radiant_intensity(-to) * cosine * inv2, 0), to

    def more(i: Any, *_: Any) -> Any:
        return i < lights.count

    def body(i: Any, direct: Any, bent: Any, failures: Any) -> Any:
        lamp: Lamp = lights[i]
        source = lamp.point(u, sine, cosine_v)
        if glossy is None:
            direct += straight(lamp, source)[0]

        def through_cornea(source: Any, inner: Any, aim: Any, bent: Any, failures: Any) -> Any:
            path = connect(values.surfaces, source, inner, n, aim, values["limbus_radius"], inside)
            local = values.surfaces[0].point_in(path.entry)
            clear = 1 - opacity(values, dr.sqrt(local.y * local.y + local.z * local.z))
            enters = path.found & (clear > 0)
            blocked = lamp_blocked(values, scene, path.entry, source, True, False, enters)
            gain = lamp.radiant_intensity(path.leaving) * path.transfer * clear
            bent += dr.select(enters & ~blocked, gain, 0)
            return bent, failures + dr.select(path.failed, mi.UInt32(1), mi.UInt32(0))

        bent, failures = dr.if_stmt(
            (source, inner, aim, bent, failures),
            inside,
            through_cornea,
            lambda source, inner, aim, bent, failures: (bent, failures),
        )
        return i + 1, direct, bent, failures

    direct, shine = mi.Float(0), mi.Float(0)
    if glossy is not None:
        # Skin fills the picture and every lamp costs a ray through the region: each sample sees one lamp, for all.
        count = mi.Float(lights.count)
        one = dr.minimum(mi.UInt32(u * count), lights.count - 1)
        lamp: Lamp = lights[one]
        direct, to = straight(lamp, lamp.point(u * count - mi.Float(one), sine, cosine_v))
        direct *= count
        shine = direct * sheen(normal, to, *glossy)
    state = (mi.UInt32(0), direct, mi.Float(0), mi.UInt32(0))
    _, direct, bent, failures = dr.while_loop(
        state, more, body, labels=("i", "direct", "bent", "failures"), label="lamps"
    )
    return direct, shine, bent, failures
