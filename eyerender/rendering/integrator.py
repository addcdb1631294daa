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

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .lighting import lamp_blocked, light, straight, through_cornea
from .values import Lamp, Lights, Values
from .view import EPSILON_MM, Textures, View, iris_albedo, look, look_around, meet, outer_albedo

NAME = "eyerender"
_LIDS_MM = 18.0  # about the axis of the unrotated eye: the lids, and where lashes cast shadows
_THROUGH = 0.7  # share of the outer hemisphere that the iris sees, times transmittance; chosen


@dataclass(frozen=True, slots=True)
class Shaded:
    """What a ray sees: radiance (mW/mm^2/sr) but for the lamps' light on matte surfaces, the radiance by this light,
    what the ray met, the albedo there where it is matte, and failed light paths."""

    rest: Any
    direct: Any
    view: View
    albedo: Any
    failures: Any

    @property
    def radiance(self) -> Any:
        """All of it."""
        return self.rest + self.direct


def shade(
    values: Values, lights: Lights, textures: Textures, scene: Any, o: Any, d: Any, active: Any, u: Any, v: Any
) -> Shaded:
    """Radiance along rays of the scene's frame by light that comes from the lamps on the shortest way.

    u, v: place on each lamp's disc, [0, 1).
    """
    view = look(values, scene, o, d, active, textures.region)
    outer, shine, inner, failures = light(values, lights, scene, view, -values.vector_to_eye(d), u, v)
    albedo = outer_albedo(values, textures, view, active)
    rest, direct = _radiance(values, textures, scene, view, d, albedo, outer, shine, inner)
    return Shaded(rest, direct, view, albedo, failures)


def _radiance(
    values: Values, textures: Textures, scene: Any, view: View, d: Any, albedo: Any, outer: Any, shine: Any, inner: Any
) -> tuple[Any, Any]:
    """Radiance but for the lamps' light on matte surfaces, and by it, from the irradiance outside and inside."""
    cover = dr.select(view.cornea, view.opacity, 1)
    direct = cover * (albedo * outer * dr.inv_pi + shine)
    rest = mi.Float(0)
    index = values["inner_index"]
    if values.structure.ambient:
        # Even light from all sides; through the cornea the iris sees n^2 times its radiance in a smaller cone.
        scene_of = values.point_to_scene
        axis = values.vector_to_scene(values["stop.normal"])
        even = textures.panels.irradiance(scene_of(view.point), values.vector_to_scene(view.normal))
        within = textures.panels.irradiance(scene_of(view.inner), axis) * _THROUGH * index * index
        if values.structure.region:
            reaching = textures.panels.lids.share(scene_of(view.point))
            # Of the region only what is wet lies between the lids.
            even *= 1 - dr.clip(10 * view.gloss - 4.5, 0, 1) * (1 - reaching)
            within *= reaching
        rest += cover * albedo * even * dr.inv_pi
        inner += within
        rest += view.mirrored * (1 - cover) * _mirrored_ambient(values, textures.panels, scene, view, d)
    behind = dr.if_stmt(
        (view.inner,),
        view.cornea & ~view.pupil,
        lambda inner: iris_albedo(values, textures, inner),
        lambda inner: mi.Float(values["pupil.albedo"]),
    )
    through = (1 - view.opacity) * view.passed * behind * inner * dr.inv_pi / (index * index)
    rest += dr.select(view.cornea, through, 0)
    return dr.select(view.met, rest, 0), dr.select(view.met, direct, 0)


def _mirrored_ambient(values: Values, panels: Any, scene: Any, view: View, d: Any) -> Any:
    """Radiance of the ambient light that the front cornea mirrors to the camera."""
    normal = values.vector_to_scene(view.normal)
    way = d - 2 * dr.dot(d, normal) * normal
    start = values.point_to_scene(view.point) + EPSILON_MM * normal
    seen = values["ambient.irradiance"] * dr.inv_pi + panels.radiance(start, way, view.cornea)
    if values.structure.obstacles:
        barred = scene.ray_test(mi.Ray3f(mi.Point3f(start), way), coherent=True, active=view.cornea)
        seen = dr.select(barred, 0, seen)
    return dr.select(view.cornea, seen, 0)


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
    start = values.point_to_scene(view.point) + EPSILON_MM * normal
    return start, way, weight, view.met


def _random(base: Any, i: Any) -> tuple[Any, Any]:
    """Two numbers in [0, 1) that are independent for every i: a hash of a sample's own pair (Tea)."""
    tea: Any = mi.sample_tea_32
    a, b = tea(mi.UInt32(base.x * 2.0**24) + i * mi.UInt32(0x9E3779B9), mi.UInt32(base.y * 2.0**24))
    return mi.Float(a >> 8) * 2.0**-24, mi.Float(b >> 8) * 2.0**-24


def _start(values: Values, first: Shaded, d: Any, turn: Any) -> tuple[Any, Any, Any, Any]:
    o, way, weight, on = onward(values, first, d, turn.x, turn.y)
    return on, o, way, weight


def shade_group(
    values: Values,
    lights: Lights,
    textures: Textures,
    scene: Any,
    ray: Any,
    spot: Any,
    count: Any,
    lamp: Lamp,
    fine: Any,
) -> tuple[Any, Any, Any]:
    """Sums over `count` samples of a pixel before an eye region: radiance without the lamps' light on matte surfaces,
    radiance by the light of one lamp on these, and failed light paths.

    Every sample has a ray of its own, and the globe is shaded for each. What the region shows of a group is shaded once
    for the sheet of skin and once for all that stands before it (hairs, tears), and counts as often as it was hit. The
    same holds for the ray to the lamp; only about the lids and on hairs, where lashes cast shadows finer than a pixel,
    every sample sends its own, if `fine`.

    Args:
        ray: origin, direction (scene's frame) and weight of sample j.
        spot: place of sample j on the lamps' discs, [0, 1)^2.
        lamp: the lamp of each group.
    """
    middle = count >> 1

    def place(j: Any) -> Any:
        u, v = spot(j)
        return lamp.point(u, *dr.sincos(v * (2 * dr.pi)))

    def going(j: Any, *_: Any) -> Any:
        return j < count

    def one(j: Any, rest: Any, direct: Any, sheet: Kept, before: Kept, known: Any, blocked: Any, failures: Any) -> Any:
        o, d, weight = ray(j)
        view, hit = meet(values, scene, o, d, True)

        def globe(rest: Any, direct: Any, failures: Any) -> tuple[Any, Any, Any]:
            seen = replace(view, other=mi.Bool(False))
            source = place(j)
            outer, shine = straight(lamp, source, seen, -values.vector_to_eye(d))
            inner, missed = through_cornea(values, lights, scene, seen.inner, seen.lit_inside, *spot(j))
            albedo = outer_albedo(values, textures, seen, True)
            more, by_lamp = _radiance(values, textures, scene, seen, d, albedo, outer, shine, inner)
            blocked = lamp_blocked(values, scene, seen.point, source, False, ~seen.cornea, by_lamp > 0)
            return rest + more * weight, direct + dr.select(blocked, 0, by_lamp * weight), failures + missed

        rest, direct, failures = dr.if_stmt(
            (rest, direct, failures), view.cornea | view.sclera, globe, lambda *unchanged: unchanged
        )
        on_sheet = hit.prim_index < mi.UInt32(values["region.sheet"])
        at = o + hit.t * d
        alone = view.other & fine & (~on_sheet | (at.y * at.y + at.z * at.z < _LIDS_MM * _LIDS_MM))

        # Two samples share the ray.
        known &= (j & 1) == 1
        asked = alone & ~known

        def own_ray(_: Any) -> Any:
            return lamp_blocked(values, scene, values.point_to_eye(at), place(j), True, True, asked)

        blocked = dr.if_stmt((blocked,), asked, own_ray, lambda blocked: blocked)
        known |= asked
        sheet = sheet.with_(view.other & on_sheet, j, hit, weight, middle, alone, blocked)
        before = before.with_(view.other & ~on_sheet, j, hit, weight, middle, alone, blocked)
        return j + 1, rest, direct, sheet, before, known, blocked, failures

    no = mi.Bool(False)
    state = (mi.UInt32(0), mi.Float(0), mi.Float(0), Kept.none(), Kept.none(), no, no, mi.UInt32(0))
    names = ("j", "rest", "direct", "sheet", "before", "known", "blocked", "failures")
    _, rest, direct, sheet, before, _, _, failures = dr.while_loop(state, going, one, labels=names, label="group")

    for kept in (sheet, before):

        def surface(rest: Any, direct: Any, kept: Kept = kept) -> tuple[Any, Any]:
            o, d, _ = ray(kept.j)
            view = look_around(values, kept.hit, o, d, kept.weight > 0, textures.region)
            source = place(kept.j)
            outer, shine = straight(lamp, source, view, -values.vector_to_eye(d))
            more, by_lamp = _radiance(values, textures, scene, view, d, view.albedo, outer, shine, mi.Float(0))
            asked = (kept.shared > 0) & (by_lamp > 0)
            blocked = lamp_blocked(values, scene, view.point, source, True, True, asked)
            lit = kept.clear + dr.select(blocked, 0, kept.shared)
            return rest + more * kept.weight, direct + by_lamp * lit

        rest, direct = dr.if_stmt((rest, direct), kept.weight > 0, surface, lambda *unchanged: unchanged)
    return rest, direct, failures


@dataclass
class Kept:
    """The hit of a group's samples that stands for all on one kind of surface, its number, and what all weigh: those
    without a ray of their own to the lamp (`shared`), and those of the others that see it (`clear`)."""

    j: Any = None
    hit: Any = None
    weight: Any = None
    shared: Any = None
    clear: Any = None

    @classmethod
    def none(cls) -> Kept:
        """No hit yet."""
        return cls(mi.UInt32(0), dr.zeros(mi.PreliminaryIntersection3f), mi.Float(0), mi.Float(0), mi.Float(0))

    def with_(self, met: Any, j: Any, hit: Any, weight: Any, best: Any, alone: Any, blocked: Any) -> Kept:
        """With sample `j` where it has `met` the surface; sample `best` stands for all where it has, else the first."""
        taken = met & ((self.weight == 0) | (j == best))
        weight = dr.select(met, weight, 0)
        return Kept(
            dr.select(taken, j, self.j),
            dr.select(taken, hit, self.hit),
            self.weight + weight,
            self.shared + dr.select(alone, 0, weight),
            self.clear + dr.select(alone & ~blocked, weight, 0),
        )


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
            valid = first.view.met
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
