"""Stage 3 with an eye region: shade a group's samples on the globe, and its merged points on the region."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..hits.eyeshape import EyeShape
from ..hits.interaction import SurfaceInteraction, outer_albedo, tear_film
from ..hits.meniscus import MeniscusView, through_water, water_hit
from ..hits.primary import TriangleHit, behind, region_interaction
from ..materials.albedo import sclera_albedo
from ..materials.gloss import glossy_normal
from ..records.frame import DeviceFrame, DeviceLamp
from ..records.recording import syntax
from ..transport.directlight import direct_light, irradiance_through_cornea, lamp_blocked, on_relief
from .groups import PixelGroup
from .merging import RegionSample, WeightedHit, blocked_from_region, merge_hits
from .shading import direct, indirect, off_eye

_FAINT = 1e-3  # highlights this weak, relative to the other light or to a white surface, need no shadow ray


@dataclass(kw_only=True)
class GlobeSamples:
    """Sums over a group's samples on the globe."""

    lit: mi.Float  # sum of radiance times weight over the shaded samples
    shaded: mi.Float  # sum of weights of the shaded samples
    weight: mi.Float  # sum of weights of all samples on the globe
    near: mi.Float  # sum of weights times inverse depth (1/mm)
    water: mi.Float  # sum of radiance times weight of menisci in front of globe and skin
    failures: mi.UInt32  # number of failed light paths

    @classmethod
    def none(cls) -> GlobeSamples:
        """Return empty sums."""
        lit, shaded, weight, near, water = (mi.Float(0) for _ in range(5))
        return cls(lit=lit, shaded=shaded, weight=weight, near=near, water=water, failures=mi.UInt32(0))

    @property
    def radiance(self) -> mi.Float:
        """Sum of radiance times weight of all samples; the shaded ones stand for the others."""
        return self.water + self.lit * dr.select(self.shaded > 0, self.weight / self.shaded, 0)


def shade_group(frame: DeviceFrame, group: PixelGroup) -> tuple[list[mi.Float], mi.UInt32]:
    """Sum the radiance of a group's samples, and count the failed light paths.

    Returns:
        Radiance times weight. If layered, three numbers for each part of the scene, from front to back (in front of the
        skin, skin, globe): its radiance times weight, its number of samples, and that number times inverse depth
        (1/mm).
    """
    sheet, before = merge_hits(frame, group)
    globe = shade_globe(frame, group)
    if not group.layered:
        radiance = shade_region(frame, group, sheet, globe.radiance, on_sheet=True)
        return [shade_region(frame, group, before, radiance, on_sheet=False)], globe.failures
    front = shade_region(frame, group, before, mi.Float(0), on_sheet=False)
    skin = shade_region(frame, group, sheet, mi.Float(0), on_sheet=True)
    weight = group.ray(frame, mi.UInt32(0))[2]  # it hardly differs within a pixel
    one = dr.select(weight > 0, dr.rcp(weight), 0)
    parts = ((front, before), (skin, sheet), (globe.radiance, globe))
    return [x for radiance, part in parts for x in (radiance, part.weight * one, part.near * one)], globe.failures


# The globe, and menisci before it


@syntax
def shade_globe(frame: DeviceFrame, group: PixelGroup) -> GlobeSamples:
    """Shade a group's samples on the globe."""
    globe, i = GlobeSamples.none(), mi.UInt32(0)
    while dr.hint(i < group.count, label="globe", exclude=[frame, group]):
        j = group.in_order(i)
        hit = group.hit(frame, j)
        if dr.hint(~hit.is_valid() | group.wet, exclude=[frame, group, j, hit]):
            _add_globe_sample(frame, group, globe, j, hit)
        i += 1
    return globe


@syntax
def _add_globe_sample(
    frame: DeviceFrame, group: PixelGroup, globe: GlobeSamples, j: mi.UInt32, hit: TriangleHit
) -> None:
    """Add the light of sample j from the globe and from menisci."""
    o, d, weight = group.ray(frame, j)
    view = MeniscusView(si=behind(EyeShape(frame=frame).ray_intersect(o, d), hit, mi.Bool(True)), d=mi.Vector3f(d))
    if dr.hint(group.wet, exclude=[frame, group, o, j, weight]):
        _look_through_water(frame, group, globe, view, o, j, weight)
    on_globe = view.si.globe
    if group.layered:
        # Computed before the branch below, because Dr.Jit would reuse its values outside of it.
        globe.near = globe.near + dr.select(on_globe, weight * view.si.nearness(frame, view.d), 0)
    # Of any four samples, use the two in the middle: for twelve samples, these form a lattice about the pixel's centre.
    in_turn = ~group.halved | (((j + 1) & 2) > 0) | (globe.shaded == 0)
    if dr.hint(on_globe & in_turn, exclude=[frame, group, view, j, weight]):
        radiance, failures = _globe_radiance(frame, group, view, j)
        globe.lit = globe.lit + radiance * weight
        globe.shaded = globe.shaded + weight
        globe.failures = globe.failures + failures
    globe.weight = globe.weight + dr.select(on_globe, weight, 0)


def _look_through_water(
    frame: DeviceFrame,
    group: PixelGroup,
    globe: GlobeSamples,
    view: MeniscusView,
    o: mi.Vector3f,
    j: mi.UInt32,
    weight: mi.Float,
) -> None:
    """Add the light that menisci mirror along sample j's ray, and continue the view to the surface behind them."""
    if frame.region.water is None:
        return
    hit = water_hit(frame, o, view.d, view.si.distance)
    no = mi.Bool(False)
    sample = WeightedHit(j=j, hit=hit, on_sheet=no, weight=weight, near=mi.Float(0), own_ray=no)
    # Mirror images of lamps in water are smaller than a pixel, so no sample can stand for others.
    drop = RegionSample.none()
    drop.add(hit.is_valid(), sample, no)
    globe.water = shade_region(frame, group, drop, globe.water, on_sheet=False)
    view.si, view.d = through_water(frame, hit, view.si, o, view.d)


def _globe_radiance(
    frame: DeviceFrame, group: PixelGroup, view: MeniscusView, j: mi.UInt32
) -> tuple[mi.Float, mi.UInt32]:
    """Compute the radiance of the globe along sample j's ray, and failed light paths."""
    si = on_relief(frame, replace(view.si, other=mi.Bool(False)))
    inner, failures = irradiance_through_cornea(frame, si.inner, si.lit_inside, *group.spot(j))
    albedo = outer_albedo(frame, si)
    received = frame.caches.radiosity.at_globe(frame.point_to_scene(si.point))
    radiance = indirect(frame, si, view.d, albedo, inner, received)
    normal, gloss = tear_film(frame, si)
    si = replace(si, gloss=gloss)
    lit = _LitPoint(si=si, normal=normal, to_camera=-frame.vector_to_eye(view.d), spot=group.spot(j))
    if frame.structure.scattering:
        return radiance + _highlights_of_globe(frame, lit, albedo), failures
    return radiance + _lamps_on_globe(frame, group, lit, albedo, j), failures


@dataclass(kw_only=True)
class _LitPoint:
    """A surface point lit by lamps (eye frame)."""

    si: SurfaceInteraction  # the surface there
    normal: mi.Vector3f  # normal of the mirroring film
    to_camera: mi.Vector3f  # unit direction to the viewer
    spot: mi.Point2f  # position on the lamps' discs, [0, 1)^2

    def source(self, lamp: DeviceLamp) -> mi.Vector3f:
        """Return the point of a lamp from which light arrives."""
        return lamp.point(self.spot.x, *dr.sincos(self.spot.y * (2 * dr.pi)))

    def radiance(self, lamp: DeviceLamp, albedo: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Compute what an unblocked lamp adds to the radiance towards the viewer, and its irradiance of the point."""
        irradiance, shine = direct_light(lamp, self.source(lamp), self.si, (self.normal, self.to_camera))
        return direct(self.si, albedo, irradiance, shine), irradiance


@syntax
def _highlights_of_globe(frame: DeviceFrame, lit: _LitPoint, albedo: mi.Float) -> mi.Float:
    """Compute the tear film's highlight on the globe where subsurface light is already computed."""
    tissues, si = frame.caches.diffusion, lit.si
    covered, share = ~si.cornea | (si.opacity > 0), tissues.lamps_at_globe(frame, si.point)
    total = direct(si, albedo, tissues.at_globe(frame, si.point), mi.Float(0))
    i = mi.UInt32(0)
    while dr.hint(covered & (i < frame.lights.count), label="film", exclude=[frame, lit, covered, share]):
        lamp = frame.lights[i]
        total += lit.radiance(lamp, mi.Float(0))[0] * share(lamp.number)
        i += 1
    return total


@syntax
def _lamps_on_globe(frame: DeviceFrame, group: PixelGroup, lit: _LitPoint, albedo: mi.Float, j: mi.UInt32) -> mi.Float:
    """Compute the radiance of the matte globe at sample j: light of all lamps minus what is blocked.

    The samples of a pixel share their rays to the lamps, so noise occurs only where a shadow's edge crosses the pixel.
    """
    total, i = mi.Float(0), mi.UInt32(0)
    while dr.hint(i < frame.lights.count, label="all lamps", exclude=[frame, lit, albedo]):
        total += lit.radiance(frame.lights[i], albedo)[0]
        i += 1
    user, k, si = group.of_pixel(j), mi.UInt32(0), lit.si
    rays = group.sample_turns.count(user)
    while dr.hint(k < rays, label="shadows", exclude=[frame, group, lit, albedo, user, si, rays]):
        share = group.sample_turns.share(user, k)
        radiance, _ = lit.radiance(share.lamp, albedo)
        blocked = lamp_blocked(frame, si.point, lit.source(share.lamp), False, ~si.cornea, radiance > 0)
        total -= dr.select(blocked, radiance * share.weight, 0)
        k += 1
    return total


# Merged points of the region


@syntax
def shade_region(
    frame: DeviceFrame, group: PixelGroup, point: RegionSample, total: mi.Float, *, on_sheet: bool
) -> mi.Float:
    """Add the radiance of a merged point, times its weight, to `total`."""
    if dr.hint(point.weight > 0, exclude=[frame, group, point, on_sheet]):
        total = _add_region(frame, group, point, total, on_sheet)
    return total


def _add_region(
    frame: DeviceFrame, group: PixelGroup, point: RegionSample, total: mi.Float, on_sheet: bool
) -> mi.Float:
    """Add light from other surfaces and from the lamps that the group uses."""
    _, d, _ = group.ray(frame, point.j)
    si = region_interaction(frame, point.face, point.uv, d, point.weight > 0)
    on_map = frame.region.map_place(point.face, point.uv, point.weight > 0)
    if on_sheet and frame.structure.scattering:
        si = _over_globe(frame, si, frame.region.own_share(on_map[1]))
    radiance = off_eye(frame, si, d, si.albedo, si.received)
    lit = _LitPoint(
        si=si, normal=glossy_normal(si.normal, si.gloss), to_camera=-frame.vector_to_eye(d), spot=group.shared_spot
    )  # fmt: skip
    if not (on_sheet and frame.structure.scattering):
        return _lamps_on_region(frame, group, point, lit, total + radiance * point.weight, on_sheet)
    tissues = frame.caches.diffusion
    radiance += direct(si, si.albedo, tissues.at_skin(*on_map), mi.Float(0))
    return _highlights_of_skin(group, point, lit, total + radiance * point.weight, tissues.lamps_at_skin(*on_map))


@syntax
def _over_globe(frame: DeviceFrame, si: SurfaceInteraction, own: mi.Float) -> SurfaceInteraction:
    """Blend albedo and received light of thin conjunctiva with those of the globe below it."""
    albedo, received = mi.Float(si.albedo), mi.Vector4f(si.received)
    if dr.hint(own < 1, exclude=[frame, si, own]):
        white, below = sclera_albedo(frame, si.point), frame.caches.radiosity.at_globe(frame.point_to_scene(si.point))
        albedo = white + own * (albedo - white)
        received = below + own * (received - below)
    return replace(si, albedo=albedo, received=received)


@syntax
def _highlights_of_skin(
    group: PixelGroup, point: RegionSample, lit: _LitPoint, total: mi.Float, share_of: Callable[[mi.UInt32], mi.Float]
) -> mi.Float:
    """Add the highlights of skin with subsurface scattering; `share_of` a lamp reaches it."""
    k = mi.UInt32(0)
    lamps = group.turns.count(group.number)
    while dr.hint(k < lamps, label="highlights", exclude=[group, point, lit, share_of, lamps]):
        share = group.turns.share(group.number, k)
        radiance, _ = lit.radiance(share.lamp, mi.Float(0))
        total += radiance * share.weight * point.weight * share_of(share.lamp.number)
        k += 1
    return total


@syntax
def _lamps_on_region(
    frame: DeviceFrame, group: PixelGroup, point: RegionSample, lit: _LitPoint, total: mi.Float, on_sheet: bool
) -> mi.Float:
    """Add the light of lamps on a matte surface with highlights, including shadows."""
    k = mi.UInt32(0)
    lamps = group.turns.count(group.number)
    while dr.hint(k < lamps, label="its lamps", exclude=[frame, group, point, lit, on_sheet, lamps]):
        share = group.turns.share(group.number, k)
        radiance, irradiance = lit.radiance(share.lamp, lit.si.albedo)
        radiance *= share.weight
        first = group.own_shadows & (k == 0)
        shared = dr.select(first, point.shared, point.weight)
        asked = (shared > 0) & (radiance > 0) & (radiance > _FAINT * dr.inv_pi * share.weight * irradiance)
        source = lit.source(share.lamp)
        blocked = blocked_from_region(frame, share.lamp, source, lit.si.point, on_sheet, asked)
        total += radiance * (dr.select(first, point.clear, 0) + dr.select(blocked, 0, shared))
        k += 1
    return total
