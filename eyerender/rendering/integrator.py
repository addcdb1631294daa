"""The Mitsuba integrator `eyerender`: near-infrared light through a refracting cornea, without noise from small lamps.

A ray meets the eye in closed form (the exact surfaces, not a mesh of them) and everything else by Embree or OptiX; the
nearer counts. At the cornea it splits deterministically; the refracted branch meets the iris plane, which every lamp
lights through all refracting surfaces by manifold next-event estimation:

    L = (1 - F) / n^2 * albedo / pi * sum_l I_l (1 - F_l) cos(theta) / J_l

Sclera and surround are matte and lit directly. Glints are not sampled here; they are splatted (`glints`).
Frames: the scene's frame has the world's axes and its origin at the apex of the unrotated eye; the eye stays still in
its own frame, so that a pose moves numbers and never geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..region.texture import iris_texture, sclera_texture
from .manifold import connect
from .surfaces import fresnel
from .values import Lamp, Lights, Values

NAME = "eyerender"
_NEAR_MM = 20.0
_EPSILON_MM = 2e-3


@dataclass(frozen=True, slots=True)
class View:
    """What a camera ray meets, points and normals in the eye frame."""

    cornea: Any  # it enters through the clear part of the cornea
    sclera: Any
    other: Any  # anything of the scene that is not the eye
    distance: Any
    point: Any  # on the first surface
    normal: Any
    opacity: Any  # of the tissue at the first surface: 0 clear cornea, 1 sclera
    mirrored: Any  # reflectance of the front cornea
    passed: Any  # transmittance of the refracted branch, 0 where it does not reach the plane of the iris
    inner: Any  # point in the plane of the iris
    pupil: Any  # the inner point lies in the pupil
    interaction: Any  # with the scene
    amodal_cornea: Any  # as if the eye stood alone
    amodal_sclera: Any


@dataclass(frozen=True, slots=True)
class Textures:
    """Relative albedos with mean 1: the iris over (angle, pupil to root), the sclera over its front, the surround."""

    iris: Any
    sclera: Any

    @classmethod
    def of_seed(cls, seed: int) -> Textures:
        """The textures of one eye."""
        rows = iris_texture(seed)
        # Repeated, so that the angle wraps; the ends along the radius are kept apart by rows of their own.
        rows = np.concatenate([rows[:1], rows, rows[-1:]])
        texture: Any = mi.Texture2f
        iris = texture(mi.TensorXf(rows[..., None]), use_accel=False, wrap_mode=dr.WrapMode.Repeat)
        sclera = texture(mi.TensorXf(sclera_texture(seed)[..., None]), use_accel=False)
        return cls(iris, sclera)


def opacity(values: Values, rho: Any) -> Any:
    """How much of the cornea's rim has turned to sclera at radius `rho` (mm): a smooth step that ends at the limbus."""
    s = dr.clip((rho - values["limbus_radius"]) * values["limbus_gain"] + 1, 0, 1)
    return s * s * (3 - 2 * s)


def look(values: Values, scene: Any, o: Any, d: Any, active: Any) -> View:
    """Trace camera rays (scene's frame) to the first surface and through the cornea to the plane of the iris."""
    hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o), d), coherent=True, active=active)
    # Single precision: start next to the eye.
    t0 = -dr.dot(o, d) - _NEAR_MM
    oe, de = values.point_to_eye(o + t0 * d), values.vector_to_eye(d)
    front = values.surfaces[0]
    ol, dl = front.point_in(oe), front.vector_in(de)
    tc, on_cornea = front.hit(ol, dl)
    yl = ol + tc * dl
    rho = dr.sqrt(yl.y * yl.y + yl.z * yl.z)
    on_cornea &= (rho < values["limbus_radius"]) & (yl.x > values["limbus_floor"])
    ts, on_sclera = _sphere(oe - values["sclera.centre"], de, values["sclera.radius"])
    # The sphere's front lies behind the cornea, so a ray that meets it first has met no clear cornea: no cracks, even
    # where the rim of a tilted or toric cornea is no circle of the sphere.
    on_cornea &= ~on_sclera | (tc < ts)
    on_sclera &= ~on_cornea
    t_eye = t0 + dr.select(on_cornea, tc, ts)
    amodal_cornea, amodal_sclera = on_cornea & (t_eye > _EPSILON_MM), on_sclera & (t_eye > _EPSILON_MM)
    on_eye = (amodal_cornea | amodal_sclera) & ~(hit.is_valid() & (hit.t < t_eye)) & active
    on_cornea &= on_eye
    on_sclera &= on_eye
    other = hit.is_valid() & ~on_eye & active
    interaction = hit.compute_surface_interaction(
        mi.Ray3f(mi.Point3f(o), d), mi.RayFlags.Minimal | mi.RayFlags.UV, other
    )

    normal, mirrored, passed, inner, pupil = dr.if_stmt(
        (yl, oe + tc * de, dl),
        amodal_cornea,
        lambda yl, y, dl: _refracted(values, yl, y, dl),
        lambda yl, y, dl: (mi.Vector3f(0), mi.Float(0), mi.Float(0), mi.Vector3f(0), mi.Bool(False)),
    )
    y = oe + tc * de
    xs = oe + ts * de
    xo, no = values.point_to_eye(interaction.p), values.vector_to_eye(interaction.n)
    no = dr.select(dr.dot(no, de) > 0, -no, no)
    point = dr.select(on_cornea, y, dr.select(on_sclera, xs, xo))
    normal = dr.select(on_cornea, normal, dr.select(on_sclera, xs - values["sclera.centre"], no))
    return View(
        on_cornea,
        on_sclera,
        other,
        dr.select(on_eye, t_eye, hit.t),
        point,
        dr.normalize(normal),
        dr.select(amodal_cornea, opacity(values, rho), 1),
        mirrored,
        passed,
        inner,
        pupil,
        interaction,
        amodal_cornea,
        amodal_sclera,
    )


def _refracted(values: Values, yl: Any, y: Any, dl: Any) -> tuple[Any, Any, Any, Any, Any]:
    """From the front cornea to the plane of the iris: normal, reflectance, transmittance, point, whether in the pupil.

    yl, dl: hit point and direction in the front surface's frame; y: the point in the eye frame.
    """
    front = values.surfaces[0]
    N = front.normal(yl)
    c = -dr.dot(N, dl)
    c2 = dr.sqrt(dr.maximum(1 - front.eta * front.eta * (1 - c * c), 0))
    mirrored = fresnel(c, c2, front.eta)
    passed = 1 - mirrored
    w = front.vector_out(front.eta * dl + (front.eta * c - c2) * N)
    inside = mi.Vector3f(y)
    reached = mi.Bool(True)
    for surface in values.surfaces[1:]:
        inside, w, share, ok = surface.refract(inside, w)
        passed *= share
        reached &= ok
    n = values["stop.normal"]
    s = dr.dot(values["stop.centre"] - inside, n) / dr.dot(w, n)
    inner = inside + s * w
    reached &= s > 0
    q = inner - values["stop.centre"]
    a, b = values["stop.axes"]
    pu, pv = dr.dot(q, values["stop.u"]) / a, dr.dot(q, values["stop.v"]) / b
    pupil = reached & (pu * pu + pv * pv < 1)
    return front.vector_out(N), mirrored, dr.select(reached, passed, 0), inner, pupil


def _sphere(o: Any, d: Any, radius: Any) -> tuple[Any, Any]:
    """Distance to the near side of a sphere about the origin, and whether it is met from outside."""
    b, c = dr.dot(o, d), dr.squared_norm(o) - radius * radius
    disc = b * b - c
    q = dr.sqrt(dr.maximum(disc, 0)) - b
    return c / q, (disc > 0) & (q > 0) & (c > 0)


def iris_albedo(values: Values, textures: Textures, x: Any) -> Any:
    """Albedo in the plane of the iris outside the pupil: texture to the root, limbal tissue beyond it."""
    q = x - values["stop.centre"]
    a, b = values["stop.axes"]
    pu, pv = dr.dot(q, values["stop.u"]) / a, dr.dot(q, values["stop.v"]) / b
    beyond = (dr.sqrt(pu * pu + pv * pv) - 1) * dr.sqrt(a * b)
    rho = dr.sqrt(x.y * x.y + x.z * x.z)
    left = values["iris_root"] - rho
    s = dr.clip(beyond / dr.maximum(beyond + dr.maximum(left, 0), 1e-4), 0, 1)
    angle = dr.atan2(pv, pu) / (2 * dr.pi)
    rows = textures.iris.shape[0]
    texture = textures.iris.eval(mi.Point2f(angle, (1 + s * (rows - 2)) / rows))[0]
    albedo = values["iris.albedo"] * dr.maximum(1 + values["iris.contrast"] * (texture - 1), 0.02)
    return dr.select(left > 0, albedo, values["limbus.albedo"])


def outer_albedo(values: Values, textures: Textures, view: View, active: Any) -> Any:
    """Albedo of the first surface where it is matte: sclera, the limbus' rim, or the scene's own material."""
    si = view.interaction
    other = si.bsdf().eval_diffuse_reflectance(si, active & view.other)[0]
    return dr.if_stmt(
        (view.point, other),
        view.other,
        lambda point, other: other,
        lambda point, other: _sclera_albedo(values, textures, point),
    )


def _sclera_albedo(values: Values, textures: Textures, point: Any) -> Any:
    r = point - values["sclera.centre"]
    # Azimuthal equidistant map of the front of the globe, from the pole out to 108 degrees.
    polar = dr.acos(dr.clip(dr.normalize(r).x, -1, 1)) / (0.6 * dr.pi)
    inv = dr.rcp(dr.maximum(dr.sqrt(r.y * r.y + r.z * r.z), 1e-6))
    uv = mi.Point2f(0.5 + 0.5 * polar * r.y * inv, 0.5 + 0.5 * polar * r.z * inv)
    texture = textures.sclera.eval(uv)[0]
    sclera = values["sclera.albedo"] * dr.maximum(1 + values["sclera.contrast"] * (texture - 1), 0.02)
    # The limbus' grey ring fades into the white over its width, on the side of the sclera.
    local = values.surfaces[0].point_in(point)
    away = dr.sqrt(local.y * local.y + local.z * local.z) - values["limbus_radius"]
    s = dr.clip(0.5 + 0.5 * away * values["limbus_gain"], 0, 1)
    s = s * s * (3 - 2 * s)
    return values["limbus.albedo"] + s * (sclera - values["limbus.albedo"])


def lamp_blocked(values: Values, scene: Any, x: Any, lamp: Any, sphere: Any, cornea: Any, active: Any) -> Any:
    """Whether anything stands between a point of the eye frame and a lamp.

    `sphere`, `cornea`: lanes whose way can be barred by the globe's sphere, by the cornea's bulge.
    """
    d = lamp - x
    distance = dr.norm(d)
    d /= distance
    t, met = _sphere(x - values["sclera.centre"], d, values["sclera.radius"])
    blocked = met & sphere & (t > _EPSILON_MM) & (t < distance)
    front = values.surfaces[0]
    o, dl = front.point_in(x), front.vector_in(d)
    t, met = front.hit(o, dl)
    y = o + t * dl
    rho2 = y.y * y.y + y.z * y.z
    met &= (rho2 < values["limbus_radius"] * values["limbus_radius"]) & (y.x > values["limbus_floor"])
    blocked |= met & cornea & (t > _EPSILON_MM) & (t < distance)
    if not values.structure.obstacles:
        return blocked | (values.point_to_scene(lamp).x < values["backdrop.x"])
    ray = mi.Ray3f(mi.Point3f(values.point_to_scene(x + _EPSILON_MM * d)), values.vector_to_scene(d))
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


@dataclass(frozen=True, slots=True)
class Shaded:
    """Radiance of a ray (mW/mm^2/sr), what it met, the albedo there where it is matte, and failed light paths."""

    radiance: Any
    view: View
    albedo: Any
    failures: Any


def shade(
    values: Values, lights: Lights, textures: Textures, scene: Any, o: Any, d: Any, active: Any, u: Any, v: Any
) -> Shaded:
    """Radiance along rays of the scene's frame by light that comes from the lamps on the shortest way."""
    view = look(values, scene, o, d, active)
    outer, inner, failures = light(values, lights, scene, view, u, v)
    albedo = outer_albedo(values, textures, view, active)
    behind = dr.if_stmt(
        (view.inner,),
        view.cornea & ~view.pupil,
        lambda inner: iris_albedo(values, textures, inner),
        lambda inner: mi.Float(values["pupil.albedo"]),
    )
    index = values["inner_index"]
    through = view.passed * behind * inner / (index * index)
    seen = dr.select(view.cornea, view.opacity * albedo * outer + (1 - view.opacity) * through, albedo * outer)
    valid = view.cornea | view.sclera | view.other
    return Shaded(dr.select(valid, seen * dr.inv_pi, 0), view, albedo, failures)


def onward(values: Values, shaded: Shaded, d: Any, u: Any, v: Any) -> tuple[Any, Any, Any, Any]:
    """How a path goes on: origin, direction (scene's frame), weight, and whether it does.

    From matte points in a cosine-distributed direction; from the clear cornea in the mirror's direction.
    """
    view = shaded.view
    normal = values.vector_to_scene(view.normal)
    mirror = view.cornea & (view.opacity < 0.5)
    e1, e2 = mi.coordinate_system(normal)
    r = dr.sqrt(u)
    s, c = dr.sincos(v * (2 * dr.pi))
    diffuse = r * c * e1 + r * s * e2 + dr.sqrt(1 - u) * normal
    reflected = d - 2 * dr.dot(d, normal) * normal
    weight = dr.select(mirror, view.mirrored * (1 - view.opacity), shaded.albedo * view.opacity)
    way = dr.select(mirror, reflected, diffuse)
    start = values.point_to_scene(view.point) + _EPSILON_MM * normal
    return start, way, weight, view.cornea | view.sclera | view.other


def _random(base: Any, i: Any) -> tuple[Any, Any]:
    """Two numbers in [0, 1) that are independent for every i: a hash of a sample's own pair (Tea)."""
    tea: Any = mi.sample_tea_32
    a, b = tea(mi.UInt32(base.x * 2.0**24) + i * mi.UInt32(0x9E3779B9), mi.UInt32(base.y * 2.0**24))
    return mi.Float(a >> 8) * 2.0**-24, mi.Float(b >> 8) * 2.0**-24


def _start(values: Values, first: Shaded, d: Any, turn: Any) -> tuple[Any, Any, Any, Any]:
    o, way, weight, on = onward(values, first, d, turn.x, turn.y)
    return on, o, way, weight


_registered: dict[str, type] = {}


def integrator_class() -> type:
    """The integrator's class for the variant in use, registered with Mitsuba under `NAME`."""
    variant = str(mi.variant())
    if variant in _registered:
        return _registered[variant]

    class EyeIntegrator(mi.SamplingIntegrator):
        """Radiance (mW/mm^2/sr) along rays of the scene's frame; `bind` gives it the eye, the lamps and the look.

        `bounces` counts how often light goes on between sclera, surround and the cornea's mirror before it is seen.
        """

        def __init__(self, props: Any = None) -> None:
            super().__init__(mi.Properties() if props is None else props)
            self.bounces = 0
            self.values: Values | None = None
            self.lights: Lights | None = None
            self.textures: Textures | None = None
            self.failures: Any = None

        def bind(self, values: Values, lights: Lights, textures: Textures) -> None:
            """Set the frame that `sample` sees."""
            self.values, self.lights, self.textures = values, lights, textures

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            """Radiance along `ray`; the third item is empty, failed light paths are counted in `failures`."""
            del medium
            if self.values is None or self.lights is None or self.textures is None:
                raise RuntimeError("bind() the integrator to a frame first")
            values, lights, textures = self.values, self.lights, self.textures
            active = mi.Bool(active)
            d = mi.Vector3f(ray.d)
            spot = sampler.next_2d(active)
            first = shade(values, lights, textures, scene, mi.Vector3f(ray.o), d, active, spot.x, spot.y)
            valid = first.view.cornea | first.view.sclera | first.view.other
            total, self.failures = first.radiance, first.failures
            if self.bounces > 0:
                turn = sampler.next_2d(active)
                limit = dr.opaque(mi.UInt32, self.bounces)

                def going(i: Any, on: Any, *_: Any) -> Any:
                    return on & (i < limit)

                def bounce(i: Any, on: Any, o: Any, d: Any, weight: Any, total: Any, failures: Any) -> Any:
                    u, v = _random(turn, 2 * i)
                    seen = shade(values, lights, textures, scene, o, d, on, u, v)
                    total += dr.select(on, weight * seen.radiance, 0)
                    failures += dr.select(on, seen.failures, 0)
                    u, v = _random(turn, 2 * i + 1)
                    o, d, share, further = onward(values, seen, d, u, v)
                    return i + 1, on & further, o, d, weight * share, total, failures

                state = (mi.UInt32(0), *_start(values, first, d, turn), total, first.failures)
                names = ("i", "on", "o", "d", "weight", "total", "failures")
                *_, total, self.failures = dr.while_loop(state, going, bounce, labels=names, label="bounces")
            return mi.Color1f(total), valid, []

        def to_string(self) -> str:
            return "EyeIntegrator[]"

    mi.register_integrator(NAME, EyeIntegrator)
    _registered[variant] = EyeIntegrator
    return EyeIntegrator
