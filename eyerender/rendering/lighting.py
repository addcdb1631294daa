"""The light of all lamps: directly on matte surfaces, through the cornea by manifold connections on the iris."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .manifold import connect
from .values import Lamp, Lights, Values
from .view import EPSILON_MM, View, meet_sphere, opacity


def lamp_blocked(values: Values, scene: Any, x: Any, lamp: Any, sphere: Any, cornea: Any, active: Any) -> Any:
    """Whether anything stands between a point of the eye frame and a lamp.

    `sphere`, `cornea`: lanes whose way can be barred by the globe's sphere, by the cornea's bulge.
    """
    d = lamp - x
    distance = dr.norm(d)
    d /= distance
    t, met = meet_sphere(x - values["sclera.centre"], d, values["sclera.radius"])
    blocked = met & sphere & (t > EPSILON_MM) & (t < distance)
    front = values.surfaces[0]
    o, dl = front.point_in(x), front.vector_in(d)
    t, met = front.hit(o, dl)
    y = o + t * dl
    rho2 = y.y * y.y + y.z * y.z
    met &= (rho2 < values["limbus_radius"] * values["limbus_radius"]) & (y.x > values["limbus_floor"])
    blocked |= met & cornea & (t > EPSILON_MM) & (t < distance)
    if not values.structure.obstacles:
        return blocked | (values.point_to_scene(lamp).x < values["backdrop.x"])
    ray = mi.Ray3f(mi.Point3f(values.point_to_scene(x + EPSILON_MM * d)), values.vector_to_scene(d))
    ray.maxt = distance * (1 - 1e-4)
    return blocked | scene.ray_test(ray, coherent=True, active=active & ~blocked)


def light(values: Values, lights: Lights, scene: Any, view: View, u: Any, v: Any) -> tuple[Any, Any, Any]:
    """Irradiance (mW/mm^2) at the first surface where it is matte and in the plane of the iris, and failed paths."""
    outside = (view.cornea & (view.opacity > 0)) | view.sclera | view.other
    inside = view.cornea & (view.opacity < 1) & (view.passed > 0)
    return lamps(values, lights, scene, view.point, view.normal, outside, view.other, view.inner, inside, u, v)


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
) -> tuple[Any, Any, Any]:
    """Irradiance (mW/mm^2) of all lamps, and the number of light paths that did not converge.

    Args:
        point, normal: matte points in the air, where `outside`; the scene's own where `other`, else the globe's.
        inner: points in the plane of the iris, where `inside`.
        u, v: place on each lamp's disc, [0, 1).
    """
    n = values["stop.normal"]
    # The point's Gaussian image: where the straight line from a lamp must aim to be bent on to the point.
    scale, shift = values["image.scale"], values["image.shift"]
    aim = mi.Vector3f(inner.x + shift, inner.y * scale, inner.z * scale)

    sine, cosine_v = dr.sincos(v * (2 * dr.pi))

    def more(i: Any, *_: Any) -> Any:
        return i < lights.count

    def body(i: Any, direct: Any, bent: Any, failures: Any) -> Any:
        lamp: Lamp = lights[i]
        source = lamp.point(u, sine, cosine_v)
        to = source - point
        inv2 = dr.rcp(dr.squared_norm(to))
        to *= dr.sqrt(inv2)
        cosine = dr.dot(to, normal)
        lit = outside & (cosine > 0)
        blocked = lamp_blocked(values, scene, point, source, other, True, lit)
        direct += dr.select(lit & ~blocked, lamp.radiant_intensity(-to) * cosine * inv2, 0)

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

    state = (mi.UInt32(0), mi.Float(0), mi.Float(0), mi.UInt32(0))
    _, direct, bent, failures = dr.while_loop(
        state, more, body, labels=("i", "direct", "bent", "failures"), label="lamps"
    )
    return direct, bent, failures
