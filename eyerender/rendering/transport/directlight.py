"""Lamp light: directly on matte surfaces, and through the cornea on the iris by manifold connections."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..hits.eyeshape import EyeShape
from ..hits.interaction import EPSILON_MM, SurfaceInteraction
from ..hits.primary import ray_blocked, segment
from ..materials.albedo import limbal_radius, opacity
from ..materials.gloss import sheen
from ..records.frame import ALL, BITS, DeviceFrame, DeviceLamp
from ..records.recording import syntax
from ..records.surfaces import DeviceSurface
from .manifold import LampConnection, Target, connect

_AIMINGS = 3
_BEFORE_LENSES_MM = 80.0  # farther from the eye than all lenses


def lamp_blocked(
    frame: DeviceFrame, x: mi.Vector3f, lamp: mi.Vector3f, sphere: mi.Bool, cornea: mi.Bool, active: mi.Bool
) -> mi.Bool:
    """Return whether anything stands between a point of the eye frame and a lamp.

    `sphere` and `cornea` mark the lanes that the globe's sphere and the cornea's bulge can block.
    """
    d = lamp - x
    distance = dr.norm(d)
    d /= distance
    blocked = _eye_blocks(frame, x, d, distance, mi.Bool(sphere), mi.Bool(cornea))
    if not frame.structure.obstacles:
        return blocked | (frame.point_to_scene(lamp).x < frame.backdrop_x)
    start, way = frame.point_to_scene(x + EPSILON_MM * d), frame.vector_to_scene(d)
    return blocked | ray_blocked(frame.scene, segment(start, way, distance * (1 - 1e-4)), active & ~blocked)


@syntax
def _eye_blocks(
    frame: DeviceFrame, x: mi.Vector3f, d: mi.Vector3f, distance: mi.Float, sphere: mi.Bool, cornea: mi.Bool
) -> mi.Bool:
    """Return whether the eye blocks rays from points x along d (see `EyeShape.ray_test`); most miss it by far."""
    r = x - frame.sclera.centre
    along = dr.dot(r, d)
    reach = frame.globe_reach
    near = dr.squared_norm(r) - along * along < reach * reach
    # Where only the bulge of the cornea can block, most rays pass the sphere about it.
    way, bulge2 = frame.limbus.bulge - x, dr.square(frame.limbus.bulge_radius)
    ahead, away2 = dr.dot(way, d), dr.squared_norm(way)
    near &= sphere | ((away2 - ahead * ahead < bulge2) & ((ahead > 0) | (away2 < bulge2)))
    blocked = mi.Bool(False)
    if dr.hint(near & (sphere | cornea), exclude=[frame, x, d, distance, sphere, cornea]):
        blocked = EyeShape(frame=frame).ray_test(x, d, distance, sphere, cornea)
    return blocked


def direct_light(
    lamp: DeviceLamp,
    source: mi.Vector3f,
    view: SurfaceInteraction,
    mirror: tuple[mi.Vector3f, mi.Vector3f] | None = None,
) -> tuple[mi.Float, mi.Float]:
    """Compute the unshadowed light of a lamp at matte points in air.

    `source`: points of the lamp; `view`: the lit points; `mirror`: normal of the mirroring surface and unit direction
    of the viewer (eye frame), to compute their sheen. Returns irradiance (mW/mm^2), and the radiance of the sheen
    towards the viewer.
    """
    to = source - view.point
    inv2 = dr.rcp(dr.squared_norm(to))
    to *= dr.sqrt(inv2)
    cosine = dr.dot(to, view.normal)
    lit = lamp.radiant_intensity(-to) * cosine * inv2 * lamp.shade(view.point, source)
    received = dr.select(view.matte & (cosine > 0), lit, 0)
    return received, mi.Float(0) if mirror is None else received * sheen(mirror[0], to, mirror[1], view.gloss)


def irradiance(lamp: DeviceLamp, source: mi.Vector3f, x: mi.Vector3f, normal: mi.Vector3f) -> mi.Float:
    """Compute the unshadowed irradiance (mW/mm^2) of points x from a lamp's point `source`."""
    to = source - x
    inv2 = dr.rcp(dr.squared_norm(to))
    to *= dr.sqrt(inv2)
    cosine = dr.dot(to, normal)
    return dr.select(cosine > 0, lamp.radiant_intensity(-to) * cosine * inv2 * lamp.shade(x, source), 0)


@syntax
def irradiance_at(
    frame: DeviceFrame,
    x: mi.Vector3f,  # the points (eye frame)
    normal: mi.Vector3f,  # unit normals there
    u: mi.Float,  # first coordinate on each lamp's disc, [0, 1)
    v: mi.Float,  # second coordinate
    *,
    off_globe: mi.Bool,  # marks points off the globe
    on_sheet: mi.Bool,  # marks points on the outer side of a region's sheet of skin, where shadow maps save rays
) -> tuple[mi.Float, mi.Float]:
    """Compute the direct irradiance of points in air from all lamps.

    Returns:
        Irradiance (mW/mm^2), with and without shadows.
    """
    sine, cosine = dr.sincos(v * (2 * dr.pi))
    # One zero for both sums: Dr.Jit may or may not merge two, which would change the kernel.
    dark = mi.Float(0) * x.x
    i, total, free = mi.UInt32(0), mi.Float(dark), mi.Float(dark)
    while dr.hint(i < frame.lights.count, label="lamps on places", exclude=[frame]):
        lamp = frame.lights[i]
        source = lamp.point(u, sine, cosine)
        lit = irradiance(lamp, source, x, normal)
        clear = shadowless(frame, i, frame.point_to_scene(x), (lit > 0) & on_sheet)
        blocked = lamp_blocked(frame, x, source, off_globe, True, (lit > 0) & ~clear)
        total += dr.select(blocked, 0, lit)
        free += lit
        i += 1
    return total, free


def shadowless(frame: DeviceFrame, lamp: mi.UInt32, x: mi.Vector3f, on_sheet: mi.Bool) -> mi.Bool:
    """Return whether the shadow maps exclude anything between points of the sheet (scene's frame) and a lamp."""
    maps = frame.caches.shadow_maps
    return mi.Bool(False) if maps is None else maps.at(lamp, x, on_sheet)


@syntax
def onto_matte(frame: DeviceFrame, view: SurfaceInteraction, u: mi.Float, v: mi.Float, wanted: mi.Bool) -> mi.Float:
    """Compute the direct irradiance (mW/mm^2) of the first surface of a bare eye from all lamps, where `wanted`.

    `u` and `v` are coordinates on each lamp's disc, [0, 1).

    The cornea is convex, so it does not shadow itself where it faces a lamp.
    """
    sine, cosine = dr.sincos(v * (2 * dr.pi))
    i, total = mi.UInt32(0), mi.Float(0)
    while dr.hint(wanted & (i < frame.lights.count), label="lamps", exclude=[frame, view]):
        lamp = frame.lights[i]
        source = lamp.point(u, sine, cosine)
        direct, _ = direct_light(lamp, source, view)
        blocked = lamp_blocked(frame, view.point, source, view.other, ~view.cornea, direct > 0)
        total += dr.select(blocked, 0, direct)
        i += 1
    return total


@syntax
def irradiance_through_cornea(
    frame: DeviceFrame,
    inner: mi.Vector3f,  # the points (eye frame)
    inside: mi.Bool,  # points for which to compute it
    u: mi.Float,  # first coordinate on each lamp's disc, [0, 1)
    v: mi.Float,  # second coordinate
    normal: mi.Vector3f | None = None,  # unit normals at the points; None for points of the plane of the iris
    surfaces: tuple[DeviceSurface, ...] | None = None,  # surfaces in front of the points; None for all
) -> tuple[mi.Float, mi.UInt32]:
    """Compute the irradiance (mW/mm^2) of all lamps at points behind the cornea, and count failed paths."""
    wanted = inside & behind((surfaces or frame.surfaces)[-1], inner)
    cached, count = frame.caches.iris, frame.lights.count
    many = count > BITS
    sine, cosine = dr.sincos(v * (2 * dr.pi))
    total, left = mi.Float(0), mi.UInt32(ALL)
    if dr.hint(cached is not None, mode="scalar"):
        total, left = cached.at(frame, inner, (u, sine, cosine), wanted)
    # Of the lamps whose light is unknown, the next one is at the lowest set bit; without bits the number is too high.
    i = dr.select(left == 0, count, dr.select(many, 0, dr.tzcnt(left)))
    failures = mi.UInt32(0)
    while dr.hint(wanted & (i < count), label="lamps", exclude=[frame, normal, surfaces, cached]):
        lamp = frame.lights[i]
        path = LampPath.find(frame, lamp, lamp.point(u, sine, cosine), inner, wanted, normal=normal, surfaces=surfaces)
        total += dr.select(path.blocked, 0, path.gain)
        failures += dr.select(path.failed, mi.UInt32(1), mi.UInt32(0))
        left &= left - 1
        i = dr.select(many, i + 1, dr.tzcnt(left))
    relief = frame.caches.relief if normal is None else None
    return total if relief is None else total * relief.at(frame, inner, inside), failures


@syntax
def irradiance_off_cornea(
    frame: DeviceFrame, x: mi.Vector3f, normal: mi.Vector3f, u: mi.Float, v: mi.Float
) -> mi.Float:
    """Compute the irradiance (mW/mm^2) of points outside the eye (eye frame) from lamps mirrored by the cornea.

    (u, v) is the position on each lamp's disc, [0, 1)^2.
    """
    sine, cosine = dr.sincos(v * (2 * dr.pi))
    reach = frame.limbus.radius
    i, total = mi.UInt32(0), mi.Float(0) * x.x
    while dr.hint(i < frame.lights.count, label="mirrored lamps", exclude=[frame]):
        lamp = frame.lights[i]
        source = lamp.point(u, sine, cosine)
        path = connect(frame.surfaces[:1], source, Target(x, normal, x), reach, mi.Bool(True), mirror=True)
        local = frame.surfaces[0].point_in(path.entry)
        there = path.found & (dr.sqrt(local.y * local.y + local.z * local.z) < reach)
        blocked = lamp_blocked(frame, path.entry, source, True, False, there)
        blocked |= lamp_blocked(frame, path.entry, x, True, False, there & ~blocked)
        lit = lamp.radiant_intensity(path.leaving) * path.transfer * (1 - opacity(frame, limbal_radius(frame, local)))
        total += dr.select(there & ~blocked, lit, 0)
        i += 1
    return total


def behind(surface: DeviceSurface, x: mi.Vector3f, ahead_mm: float = 0.0) -> mi.Bool:
    """Return whether points (eye frame) are behind a surface, or at most `ahead_mm` in front of it.

    Only such points receive light through the surface. The outer iris may not: in a shallow chamber, the cornea ends
    behind the plane of the iris.
    """
    away = 8.0
    o = surface.point_in(x) + mi.Vector3f(away, 0, 0)
    t, met = surface.hit(o, mi.Vector3f(-1, 0, 0))
    return met & (t < away + ahead_mm)


def image_of(frame: DeviceFrame, x: mi.Vector3f) -> mi.Vector3f:
    """Return the Gaussian images of points behind the cornea, near the stop, as seen from outside (eye frame).

    A straight line from a lamp must aim there to be refracted to the point.
    """
    return mi.Vector3f(x.x + frame.image.shift, x.y * frame.image.scale, x.z * frame.image.scale)


def on_relief(frame: DeviceFrame, view: SurfaceInteraction) -> SurfaceInteraction:
    """Return the view with the points where the rays meet the iris relief, as their feet in its plane."""
    if frame.caches.relief is None:
        return view
    seen = view.cornea & ~view.pupil & (view.passed > 0)
    return replace(view, inner=frame.caches.relief.hit(frame, view.inner, view.slant, seen))


@dataclass(frozen=True, slots=True, kw_only=True)
class LampPath:
    """Light path from a point of a lamp through the cornea to a point behind it."""

    gain: mi.Float  # irradiance (mW/mm^2) if nothing blocks the path
    whole: mi.Float  # the same if the whole cornea were clear
    entry: mi.Vector3f  # where the path enters the front surface (eye frame)
    enters: mi.Bool  # whether there is a path, through the clear part of the cornea
    blocked: mi.Bool  # whether anything blocks the path
    failed: mi.Bool  # whether the search did not converge

    @classmethod
    def find(
        cls,
        frame: DeviceFrame,
        lamp: DeviceLamp,
        source: mi.Vector3f,
        inner: mi.Vector3f,
        active: mi.Bool,
        normal: mi.Vector3f | None = None,
        surfaces: tuple[DeviceSurface, ...] | None = None,
        ahead_mm: float = 0.0,
    ) -> LampPath:
        """Solve for the path from a lamp's point `source` to the point `inner` in the plane of the iris (eye frame).

        `ahead_mm` is as for `connect`.
        """
        target = Target(inner, frame.stop.normal if normal is None else normal, image_of(frame, inner))
        through = frame.structure.lit_through
        chain = surfaces or frame.surfaces
        lit_from, beside = source, None
        if through is not True:
            beside = connect(chain, source, target, frame.limbus.radius, active, ahead_mm=ahead_mm)
        if beside is None or through is None:
            path, lit_from = _through_lenses(frame, lamp, (source, target, chain), beside, active, ahead_mm)
        else:
            path = beside
        clear = 1 - opacity(frame, limbal_radius(frame, frame.surfaces[0].point_in(path.entry)))
        enters = path.found & (clear > 0)
        blocked = lamp_blocked(frame, path.entry, lit_from, True, False, enters)
        whole = dr.select(path.found, lamp.radiant_intensity(path.leaving) * path.transfer, 0)
        return cls(
            # Without a path, its entry may not be a number.
            gain=dr.select(enters, whole * clear, 0), whole=whole, entry=path.entry, enters=enters,
            blocked=blocked, failed=path.failed,
        )  # fmt: skip


def _aim_through(lenses: tuple[DeviceSurface, ...], source: mi.Vector3f, aim: mi.Vector3f) -> mi.Vector3f:
    """Shift points so that rays from a lamp towards them pass the points themselves behind the lenses.

    Newton's method must not start beside the cornea, which oblique lamps' rays towards the points themselves may miss.
    """
    towards = aim
    for _ in range(_AIMINGS):
        w = dr.normalize(towards - source)
        y, ok = source + dr.maximum(dr.dot(aim - source, w) - _BEFORE_LENSES_MM, 0) * w, mi.Bool(True)
        for surface in lenses:
            y, w, _, good = surface.refract(y, w)
            ok &= good
        passed = y + dr.dot(aim - y, w) * w
        towards = dr.select(ok, towards + aim - passed, towards)
    return towards


def _through_lenses(
    frame: DeviceFrame,
    lamp: DeviceLamp,
    ends: tuple[mi.Vector3f, Target, tuple[DeviceSurface, ...]],
    beside: LampConnection | None,
    active: mi.Bool,
    ahead_mm: float,
) -> tuple[LampConnection, mi.Vector3f]:
    """Solve for paths through worn lenses, also beyond their outlines, and the eye, for lamps that light it so.

    `ends` are points of the lamp, the target, and the surfaces of the eye in front of it; `beside` paths past the
    lenses for the other lamps, None if there are none. `ahead_mm` is as for `connect`. Returns the paths, with their
    entries into the cornea, and the points in whose direction light arrives there.
    """
    source, target, chain = ends
    lenses = tuple(surface for lens in frame.turned_lenses for surface in (lens.front, lens.back))
    some = active if beside is None else active & (lamp.through > 0.5)
    aimed = replace(target, aim=_aim_through(lenses, source, target.aim))
    path = connect(
        (*lenses, *chain), source, aimed, frame.turned_lenses[0].half[0], some, ahead_mm=ahead_mm, lensed=True
    )
    y, w, gain, ok = path.entry - path.leaving, path.leaving, mi.Float(1), mi.Bool(True)
    for lens in frame.turned_lenses:
        for surface in (lens.front, lens.back):
            y, w, _, good = surface.refract(y, w)
            ok &= good
        gain *= lens.gain
    cornea, _, _, met = chain[0].refract(y, w)
    distance = dr.norm(source - cornea)
    found = path.found & ok & met
    path = replace(path, transfer=path.transfer * gain, entry=cornea, found=found)
    lit_from = cornea - distance * w
    if beside is None:
        return path, lit_from
    through = lamp.through > 0.5
    merged = LampConnection(
        transfer=dr.select(through, path.transfer, beside.transfer),
        entry=dr.select(through, path.entry, beside.entry),
        leaving=dr.select(through, path.leaving, beside.leaving),
        found=dr.select(through, path.found, beside.found),
        failed=dr.select(through, path.failed, beside.failed),
    )
    return merged, dr.select(through, lit_from, source)
