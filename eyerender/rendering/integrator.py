"""The Mitsuba integrator `eyerender`: near-infrared light through a refracting cornea, without noise from small lamps.

A ray is intersected with the eye in closed form (the exact surfaces, not a mesh) and with everything else by Embree or
OptiX; the nearer hit is used. At the cornea the ray splits deterministically. The refracted branch meets the iris
plane, which every lamp lights through all refracting surfaces by manifold next-event estimation:

    L = (1 - F) / n^2 * albedo / pi * sum_l I_l (1 - F_l) cos(theta) / J_l

Sclera and surround are matte and lit directly. Glints are not sampled here; they are splatted (`glints`). Frames: the
scene's frame has the world's axes and its origin at the apex of the unrotated eye. The eye is fixed in its own frame,
so a pose changes numbers and never geometry.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from .shading import Shaded, shade
from .values import Lights, Values
from .view import EPSILON_MM, Textures

if TYPE_CHECKING:
    from .sampling import Sampler

NAME = "eyerender"


def onward(
    values: Values, shaded: Shaded, d: mi.Vector3f, u: mi.Float, v: mi.Float
) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float, mi.Bool]:
    """Continue paths: origin, direction (scene's frame), weight, and whether the path continues.

    From matte points the direction is cosine-distributed; from the clear cornea it is the mirror's direction.
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
    start = values.point_to_scene(view.point) + EPSILON_MM * normal
    return start, way, weight, view.met


def _random(base: mi.Point2f, i: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Two numbers in [0, 1) that are independent for every i: a hash of a sample's own pair (Tea)."""
    tea: Any = mi.sample_tea_32
    a, b = tea(mi.UInt32(base.x * 2.0**24) + i * mi.UInt32(0x9E3779B9), mi.UInt32(base.y * 2.0**24))
    return mi.Float(a >> 8) * 2.0**-24, mi.Float(b >> 8) * 2.0**-24


def _start(
    values: Values, first: Shaded, d: mi.Vector3f, turn: mi.Point2f
) -> tuple[mi.Bool, mi.Vector3f, mi.Vector3f, mi.Float]:
    o, way, weight, on = onward(values, first, d, turn.x, turn.y)
    return on, o, way, weight


_registered: dict[str, type] = {}


def integrator_class() -> type:
    """Class of the integrator for the variant in use, registered with Mitsuba under `NAME`."""
    variant = str(mi.variant())
    if variant in _registered:
        return _registered[variant]

    class EyeIntegrator(mi.SamplingIntegrator):  # type: ignore[misc]
        """Radiance (mW/mm^2/sr) along rays of the scene's frame; `bind` sets the eye, the lamps and the look.

        `bounces` is the number of times that light may continue between sclera, surround and the cornea's mirror before
        it is seen.
        """

        def __init__(self, props: mi.Properties | None = None) -> None:
            super().__init__(mi.Properties() if props is None else props)
            self.bounces = 0
            self.values: Values | None = None
            self.lights: Lights | None = None
            self.textures: Textures | None = None
            self.failures: Any = None

        def bind(self, values: Values, lights: Lights, textures: Textures) -> None:
            """Set the frame that `sample` renders."""
            self.values, self.lights, self.textures = values, lights, textures

        def sample(
            self, scene: mi.Scene, sampler: Sampler, ray: mi.Ray3f, medium: object = None, active: mi.Bool | bool = True
        ) -> tuple[mi.Color1f, mi.Bool, list[mi.Float]]:
            """Radiance along `ray`; the third item is empty, and failed light paths are counted in `failures`."""
            del medium
            if self.values is None or self.lights is None or self.textures is None:
                raise RuntimeError("bind() the integrator to a frame first")
            values, lights, textures = self.values, self.lights, self.textures
            active = mi.Bool(active)
            d = mi.Vector3f(ray.d)
            spot = sampler.next_2d(active)
            first = shade(values, lights, textures, scene, mi.Vector3f(ray.o), d, active, spot.x, spot.y)
            valid = first.view.met
            total, self.failures = first.radiance, first.failures
            if self.bounces > 0:
                turn = sampler.next_2d(active)
                limit = dr.opaque(mi.UInt32, self.bounces)

                def going(i: mi.UInt32, on: mi.Bool, *_: object) -> mi.Bool:
                    return on & (i < limit)

                def bounce(
                    i: mi.UInt32,
                    on: mi.Bool,
                    o: mi.Vector3f,
                    d: mi.Vector3f,
                    weight: mi.Float,
                    total: mi.Float,
                    failures: mi.UInt32,
                ) -> tuple[mi.UInt32, mi.Bool, mi.Vector3f, mi.Vector3f, mi.Float, mi.Float, mi.UInt32]:
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
