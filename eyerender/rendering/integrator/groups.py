"""Groups of a pixel's samples in front of an eye region: what they see of the skin is shaded once for all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..hits.interaction import RegionHit, SurfaceInteraction, behind, intersect_globe, look_at_skin, outer_albedo
from ..hits.meniscus import parts_of, through_water, wetted
from ..materials.gloss import film_normal, glossy_normal
from ..records.frame import Frame, Lamp
from ..scene.region import SkinGeometry
from ..transport.directlight import direct_light, irradiance_through_cornea, lamp_blocked, on_relief
from .shading import direct, indirect, off_eye

_FAINT = 1e-3  # highlights so weak, relative to the other light or to a white surface, need no ray for their shadow
_LIDS_MM = 18.0  # about the axis of the unrotated eye: the region of the lids, where lashes cast shadows


@dataclass(frozen=True, slots=True)
class Group:
    """The samples of a lane, numbered from 0 to `count`, and the lamps that they use with their weights.

    Attributes:
        count: number of samples.
        halved: whether half of the samples that meet the globe are shaded for all of them.
        ray: origin, direction (scene's frame) and weight of sample j.
        hit: what sample j hits of the region, from what it meets of the globe alone, its origin and its direction.
        spot: place of sample j on the lamps' discs, [0, 1)^2.
        shared_spot: the same for the group. The groups that use a lamp have consecutive places.
        asked: number of lamps to which sample j sends rays where it meets the globe.
        lamp: the k-th of these lamps, and its weight.
        lamps: number of lamps that the whole group uses where it meets the region.
        shared: the k-th of these lamps, and its weight.
        fine: whether pairs of samples send rays of their own to the group's first lamp about the lids and on hairs,
            where lashes cast shadows finer than a pixel.
        sharp: whether every sample does so, and everywhere: the lamp is the sun.
        plain: whether the samples' pixel shows nothing but the sheet of skin.
        wet: whether it may show menisci.
        layered: whether the parts of the sum, and their distances, are wanted one by one.
    """

    count: mi.UInt32
    halved: mi.Bool
    ray: Callable[[mi.UInt32], tuple[mi.Vector3f, mi.Vector3f, mi.Float]]
    hit: Callable[[mi.UInt32, SurfaceInteraction, mi.Vector3f, mi.Vector3f], RegionHit]
    spot: Callable[[mi.UInt32], mi.Point2f]
    shared_spot: mi.Point2f
    asked: Callable[[mi.UInt32], mi.UInt32]
    lamp: Callable[[mi.UInt32, mi.UInt32], tuple[Lamp, mi.Float]]
    lamps: mi.UInt32
    shared: Callable[[mi.UInt32], tuple[Lamp, mi.Float]]
    fine: mi.Bool
    sharp: mi.Bool
    plain: mi.Bool
    wet: mi.Bool
    layered: bool = False


@dataclass(frozen=True, slots=True)
class Part:
    """What a group sees of one part of the scene: radiance, weight of the samples, and weight times inverse depth."""

    radiance: mi.Float
    weight: mi.Float
    near: mi.Float


def shade_group(frame: Frame, group: Group) -> tuple[tuple[Part, ...], mi.Float, mi.UInt32]:
    """Sum radiance and failed light paths over a group's samples in front of an eye region.

    The parts, from front to back, are what is before the skin, the skin, and the globe. There are none unless the group
    is layered.

    Every sample has a ray of its own, and the globe is shaded for each, or for half where many are taken because of
    thin hairs. The region is shaded once for the sheet of skin and once for everything in front of it (hairs,
    tears), at the first sample that hits it. The result is multiplied by the number of hits on that surface. In a plain
    pixel the first sample that hits the skin represents the others.
    """
    shading = _GroupShading(frame, frame.region, group)
    no = mi.Bool(False)
    depths = tuple(mi.Float(0) for _ in range(3)) if group.layered else ()
    state = (
        mi.UInt32(0),
        no,
        mi.Float(0),
        GlobeSamples.none(),
        RegionSample.none(),
        RegionSample.none(),
        no,
        no,
        mi.UInt32(0),
        depths,
    )
    names = ("i", "settled", "total", "globe", "sheet", "before", "known", "blocked", "failures", "depths")
    i, settled, total, globe, sheet, before, _, _, failures, depths = dr.while_loop(
        state, shading.goes_on, shading.trace_sample, labels=names, label="group"
    )
    total += globe.radiance
    traced = sheet.weight
    sheet = shading.with_untraced(sheet, i, settled)

    def with_region(total: mi.Float, kept: RegionSample, on_sheet: bool) -> mi.Float:
        return dr.if_stmt(
            (total,), kept.weight > 0, lambda total: shading.add_region(total, kept, on_sheet), lambda total: total
        )

    if group.layered:
        near = list(depths)
        near[1] *= dr.select(traced > 0, sheet.weight / traced, 1)
        radiance = [shading.add_region(mi.Float(0), before, False), shading.add_region(mi.Float(0), sheet, True)]
        weights = (before.weight, sheet.weight, globe.weight)
        parts = tuple(Part(*part) for part in zip((*radiance, total), weights, near, strict=True))
        return parts, total, failures
    return (), with_region(with_region(total, sheet, True), before, False), failures


@dataclass(frozen=True, slots=True)
class _GroupShading:
    """Steps of `shade_group` for one frame."""

    frame: Frame
    skin: SkinGeometry
    group: Group

    @property
    def soft(self) -> bool:
        """Whether light spreads inside skin and sclera."""
        return self.frame.structure.scattering

    def number(self, i: mi.UInt32) -> mi.UInt32:
        """Index of the i-th sample to trace: the middle one first, then the others in turn."""
        middle = self.group.count >> 1
        return dr.select(i == 0, middle, dr.select(i <= middle, i - 1, i))

    def lamp_point(self, lamp: Lamp, j: mi.UInt32) -> mi.Vector3f:
        """Point of sample j on a lamp."""
        u, v = self.group.spot(j)
        return lamp.point(u, *dr.sincos(v * (2 * dr.pi)))

    def goes_on(self, i: mi.UInt32, settled: mi.Bool, *_: object) -> mi.Bool:
        """Whether samples are left to trace."""
        return (i < self.group.count) & ~settled

    def trace_sample(
        self,
        i: mi.UInt32,
        settled: mi.Bool,
        total: mi.Float,
        globe: GlobeSamples,
        sheet: RegionSample,
        before: RegionSample,
        known: mi.Bool,
        blocked: mi.Bool,
        failures: mi.UInt32,
        depths: tuple[mi.Float, ...],
    ) -> tuple[
        mi.UInt32,
        mi.Bool,
        mi.Float,
        GlobeSamples,
        RegionSample,
        RegionSample,
        mi.Bool,
        mi.Bool,
        mi.UInt32,
        tuple[mi.Float, ...],
    ]:
        """Trace one sample: shade the globe if the sample hits it, else keep the hit on the region.

        `known` says whether the previous sample has sent its own ray to the lamp, `blocked` whether that ray met
        anything.
        """
        frame, group, skin = self.frame, self.group, self.skin
        j = self.number(i)
        o, d, weight = group.ray(j)

        view = intersect_globe(frame, o, d)
        hit = group.hit(j, view, o, d)
        view, face = behind(view, hit, mi.Bool(True)), hit.face
        at = o + hit.t * d
        on_sheet = skin.on_sheet(face)
        if skin.water is not None:
            total, d, *parts = dr.if_stmt(
                (total, d, *parts_of(view)),
                group.wet,
                lambda total, d, *parts: self.past_water(total, d, SurfaceInteraction(*parts), o, j, weight),
                lambda *unchanged: unchanged,
            )
            view = SurfaceInteraction(*parts)
        if group.layered:
            # Before the branches below: Dr.Jit would reuse their values outside of them.
            add = weight * view.nearness(frame, d)
            seen = (view.other & ~on_sheet, view.other & on_sheet, view.cornea | view.sclera)
            depths = tuple(n + dr.select(there, add, 0) for n, there in zip(depths, seen, strict=True))

        def shade(lit: mi.Float, shaded: mi.Float, failures: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.UInt32]:
            radiance, missed = self.globe_radiance(view, d, j)
            return lit + radiance * weight, shaded + weight, failures + missed

        on_globe = view.cornea | view.sclera
        # Of any four samples the two in the middle: of twelve, these are a lattice about the pixel's centre.
        in_turn = ~group.halved | (((j + 1) & 2) > 0) | (globe.shaded == 0)
        lit, shaded, failures = dr.if_stmt(
            (globe.lit, globe.shaded, failures), on_globe & in_turn, shade, lambda *unchanged: unchanged
        )
        globe = GlobeSamples(lit, shaded, globe.weight + dr.select(on_globe, weight, 0))
        alone = view.other & group.fine
        if self.soft:
            alone &= ~on_sheet
        else:
            alone &= ~on_sheet | group.sharp | (at.y * at.y + at.z * at.z < _LIDS_MM * _LIDS_MM)

        # Two samples share one ray, unless the shadows are sharp.
        known &= ((i & 1) == 1) & ~group.sharp
        asked = alone & ~known

        def own_ray(_: mi.Bool) -> mi.Bool:
            source = self.lamp_point(group.shared(mi.UInt32(0))[0], j)
            return self.skin_blocked(group.shared(mi.UInt32(0))[0], source, frame.point_to_eye(at), on_sheet, asked)

        blocked = dr.if_stmt((blocked,), asked, own_ray, lambda blocked: blocked)
        known |= asked
        sheet = sheet.with_(view.other & on_sheet, j, face, hit.prim_uv, weight, alone, blocked)
        before = before.with_(view.other & ~on_sheet, j, face, hit.prim_uv, weight, alone, blocked)
        settled = group.plain & view.other & on_sheet & ~alone
        return i + 1, settled, total, globe, sheet, before, known, blocked, failures, depths

    def past_water(
        self, total: mi.Float, d: mi.Vector3f, view: SurfaceInteraction, o: mi.Vector3f, j: mi.UInt32, weight: mi.Float
    ) -> tuple[Any, ...]:
        """Add what menisci mirror to `total`; the direction in air, and the parts of the view, of what is behind."""
        frame, skin, no = self.frame, self.skin, mi.Bool(False)
        film, wet = wetted(skin.water, o, d, view.distance)
        # Mirror images of lamps in water are smaller than a pixel, so no sample stands for others.
        drop = RegionSample.none().with_(wet, j, skin.on_water(film), film.prim_uv, weight, no, no)
        total = dr.if_stmt((total,), wet, lambda total: self.add_region(total, drop, False), lambda total: total)
        view, d = through_water(frame, skin, film, wet, view, o, d)
        return total, d, *parts_of(view)

    def globe_radiance(self, view: SurfaceInteraction, d: mi.Vector3f, j: mi.UInt32) -> tuple[mi.Float, mi.UInt32]:
        """Radiance of the globe along sample j's ray, and failed light paths."""
        frame, group = self.frame, self.group
        seen = on_relief(frame, replace(view, other=mi.Bool(False)))
        inner, missed = irradiance_through_cornea(frame, seen.inner, seen.lit_inside, *group.spot(j))
        albedo = outer_albedo(frame, seen)
        received = frame.caches.radiosity.at_globe(frame.point_to_scene(seen.point))
        rest = indirect(frame, seen, d, albedo, inner, received)
        return rest + self.lamps_on_globe(seen, albedo, -frame.vector_to_eye(d), j), missed

    def lamps_on_globe(self, seen: SurfaceInteraction, albedo: mi.Float, back: mi.Vector3f, j: mi.UInt32) -> mi.Float:
        """Radiance of the matte globe at sample j: the light of all lamps, less what is kept from it.

        The samples of a pixel share the rays to the lamps. So only shadows that end within the pixel are noisy.
        """
        frame, lights, group = self.frame, self.frame.lights, self.group

        mirror = (film_normal(seen.normal), back)
        u, v = group.spot(j)
        turn = dr.sincos(v * (2 * dr.pi))

        def lit_by(lamp: Lamp, matte: mi.Float) -> tuple[mi.Vector3f, mi.Float]:
            source = lamp.point(u, *turn)
            return source, direct(seen, matte, *direct_light(lamp, source, seen, mirror))

        if self.soft:
            # What went through the tissue is known, and what remains is the film's highlight.
            tissues = self.frame.caches.diffusion
            covered, share = ~seen.cornea | (seen.opacity > 0), tissues.lamps_at_globe(self.frame, seen.point)

            def shine(i: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
                lamp = lights[i]
                return i + 1, total + lit_by(lamp, mi.Float(0))[1] * share(lamp.number)

            state = (mi.UInt32(0), direct(seen, albedo, tissues.at_globe(self.frame, seen.point), mi.Float(0)))
            labels = ("i", "total")
            return dr.while_loop(state, lambda i, _: covered & (i < lights.count), shine, labels=labels, label="film")[
                1
            ]

        def add(i: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            return i + 1, total + lit_by(lights[i], albedo)[1]

        state = (mi.UInt32(0), mi.Float(0))
        _, total = dr.while_loop(state, lambda i, _: i < lights.count, add, labels=("i", "total"), label="all lamps")

        def subtract(k: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            lamp, share = group.lamp(j, k)
            source, lit = lit_by(lamp, albedo)
            barred = lamp_blocked(frame, seen.point, source, False, ~seen.cornea, lit > 0)
            return k + 1, total - dr.select(barred, lit * share, 0)

        state, asked = (mi.UInt32(0), total), group.asked(j)
        _, total = dr.while_loop(state, lambda k, _: k < asked, subtract, labels=("k", "total"), label="shadows")
        return total

    def with_untraced(self, sheet: RegionSample, i: mi.UInt32, settled: mi.Bool) -> RegionSample:
        """Add to the skin's hit the weights of the samples from the i-th on, which a plain pixel left untraced."""

        def more(i: mi.UInt32, *_: object) -> mi.Bool:
            return settled & (i < self.group.count)

        def add(i: mi.UInt32, weight: mi.Float, shared: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
            rest = self.group.ray(self.number(i))[2]
            return i + 1, weight + rest, shared + rest

        state = (i, sheet.weight, sheet.shared)
        _, weight, shared = dr.while_loop(state, more, add, labels=("i", "weight", "shared"), label="settled")
        return replace(sheet, weight=weight, shared=shared)

    def skin_blocked(
        self, lamp: Lamp, source: mi.Vector3f, x: mi.Vector3f, on_sheet: mi.Bool | bool, asked: mi.Bool
    ) -> mi.Bool:
        """Whether anything keeps a lamp's light from points x of the region (eye frame), on its sheet or before it."""
        frame, views = self.frame, self.frame.caches.shadow_maps
        # Where the lamp's own view shows bare skin alone, only the globe may be in the way.
        clear = views.at(lamp.number, frame.point_to_scene(x), asked & on_sheet)
        return lamp_blocked(frame, x, source, True, True, asked & ~clear)

    def add_region(self, total: mi.Float, kept: RegionSample, on_sheet: bool) -> mi.Float:
        """Add to `total` the radiance of a kept hit on the region, from the lamps that the group uses."""
        frame, group = self.frame, self.group
        _, d, _ = group.ray(kept.j)
        view = look_at_skin(frame, self.skin, kept.face, kept.uv, d, kept.weight > 0)
        rest = off_eye(frame, view, d, view.albedo, view.received)
        inside, matte, sees = mi.Float(0), view.albedo, None
        soft = self.soft and on_sheet
        if soft:
            tissues = self.frame.caches.diffusion
            on_map = self.skin.map_place(kept.face, kept.uv, kept.weight > 0)
            on_skin, sees = tissues.at_skin(*on_map), tissues.lamps_at_skin(*on_map)
            inside, matte = direct(view, view.albedo, on_skin, mi.Float(0)), mi.Float(0)
        total += (rest + inside) * kept.weight
        faint = _FAINT * inside
        mirror = (glossy_normal(view.normal, view.gloss), -frame.vector_to_eye(d))
        turn = dr.sincos(group.shared_spot.y * (2 * dr.pi))

        def more(k: mi.UInt32, *_: object) -> mi.Bool:
            return k < group.lamps

        def lamp_light(k: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            lamp, share = group.shared(k)
            source = lamp.point(group.shared_spot.x, *turn)
            outer, shine = direct_light(lamp, source, view, mirror)
            lit = direct(view, matte, outer, shine) * share
            if sees is not None:
                return k + 1, total + lit * kept.weight * sees(lamp.number)
            first = group.fine & (k == 0)
            shared = dr.select(first, kept.shared, kept.weight)
            asked = (shared > 0) & (lit > faint) & (lit > _FAINT * dr.inv_pi * share * outer)
            blocked = self.skin_blocked(lamp, source, view.point, on_sheet, asked)
            return k + 1, total + lit * (dr.select(first, kept.clear, 0) + dr.select(blocked, 0, shared))

        return dr.while_loop((mi.UInt32(0), total), more, lamp_light, labels=("k", "total"), label="its lamps")[1]


@dataclass
class GlobeSamples:
    """A group's samples on the globe: radiance times weight of the shaded ones, their weight, and that of all."""

    lit: mi.Float = None
    shaded: mi.Float = None
    weight: mi.Float = None

    @classmethod
    def none(cls) -> GlobeSamples:
        """Return the sums of no samples."""
        return cls(mi.Float(0), mi.Float(0), mi.Float(0))

    @property
    def radiance(self) -> mi.Float:
        """Radiance of all these samples, of which the shaded ones stand for the others."""
        return self.lit * dr.select(self.shaded > 0, self.weight / self.shaded, 0)


@dataclass
class RegionSample:
    """The hit that represents all samples of a group on one kind of surface.

    It holds the sample's number and two weights: that of the samples without a ray of their own to the lamp (`shared`),
    and that of the other samples that see the lamp (`clear`).
    """

    j: mi.UInt32 = None
    face: mi.UInt32 = None
    uv: mi.Point2f = None
    weight: mi.Float = None
    shared: mi.Float = None
    clear: mi.Float = None

    @classmethod
    def none(cls) -> RegionSample:
        """Return an empty hit."""
        return cls(mi.UInt32(0), mi.UInt32(0), mi.Point2f(0), mi.Float(0), mi.Float(0), mi.Float(0))

    def with_(
        self,
        met: mi.Bool,
        j: mi.UInt32,
        face: mi.UInt32,
        uv: mi.Point2f,
        weight: mi.Float,
        alone: mi.Bool,
        blocked: mi.Bool,
    ) -> RegionSample:
        """Add sample `j` where it has `met` the surface; the first sample stands for all."""
        taken = met & (self.weight == 0)
        weight = dr.select(met, weight, 0)
        return RegionSample(
            dr.select(taken, j, self.j),
            dr.select(taken, face, self.face),
            dr.select(taken, uv, self.uv),
            self.weight + weight,
            self.shared + dr.select(alone, 0, weight),
            self.clear + dr.select(alone & ~blocked, weight, 0),
        )
