"""Direct light on patches from lamps, panels and surroundings: E0 of the radiosity equation.

Patches outside the eye receive it directly. Skin near the cornea also receives light mirrored by the cornea: up to a
sixth of the light on the lid margins. Patches of the chamber receive it through the cornea.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Floats
from ..records.frame import Caches, DeviceFrame, Lights, sequence
from ..records.recording import recorded, syntax
from .chamber import IRIS, PATCHES
from .directlight import irradiance, irradiance_at, irradiance_off_cornea, irradiance_through_cornea
from .formfactors import SHUFFLED, START_MM, PatchRays, RayHits, trace_rays
from .framepatches import RAYS, FramePatches, Lanes, PatchTables, gather_rows
from .radiosityfield import RadiosityField


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchLight:
    """Light that is known before the radiosity is solved, on the host, and the hits of the patches' rays."""

    direct: Floats  # (outside,) direct irradiance of the patches outside the eye from the lamps
    bare: Floats  # (outside,) the same without shadows
    mirrored: Floats  # (outside,) irradiance from lamps mirrored by the cornea
    soft: Floats  # (outside,) irradiance from uniform light and the soft part of a map, without shadows
    hard: Floats  # (outside,) irradiance from the rest of the map and from panels, without shadows
    hard_free: Floats  # (outside,) the same, from the lamps that represent panels and map
    hard_lit: Floats  # (outside,) the same, with shadows
    lamps: Floats  # (inside,) direct irradiance of the patches of the chamber from the lamps
    panels: Floats  # (inside,) the same, from the lamps that represent panels and map
    rays: PatchRays  # hits of the rays of all patches


@dataclass(kw_only=True)
class Gathered:
    """The fields of `PatchLight` on the device; those of lamps have one item per point on the lamps' discs."""

    direct: list[tuple[mi.Float, mi.Float]]  # irradiance with and without shadows
    mirrored: list[mi.Float]  # irradiance from lamps mirrored by the cornea
    soft: mi.Float | None  # as in `PatchLight`; None without ambient light
    hard: mi.Float | None  # as in `PatchLight`; None without ambient light
    # irradiance of outside patches from panels, with and without shadows; None without panels
    panels_outside: tuple[mi.Float | None, mi.Float | None]
    lamps: list[list[mi.Float]]  # irradiance of patches of the chamber, column after column
    panels: list[list[mi.Float]]  # the same, from panels
    hits: RayHits  # hits of the rays
    lit: mi.Float | None  # irradiance at the points of the skin hit by rays of globe and chamber; None if unused
    bare: mi.Float | None  # unshadowed irradiance at the points of the skin hit by all rays; None without skin

    def read(self, patches: FramePatches, lanes: Lanes) -> PatchLight:
        """Copy the light to the host, after all launches have finished."""
        count, near = patches.outside, patches.near_cornea
        direct, bare = (part[:count] for part in np.split(_mean(self.direct, 2 * lanes.outside), 2))
        mirrored = np.zeros(count)
        if self.mirrored:
            mirrored[patches.on_globe + near] = _mean([[m] for m in self.mirrored], lanes.near_cornea)[: len(near)]
        soft, hard, hard_lit, hard_free = (
            np.zeros(count) if part is None else part.numpy()[:count].astype(float)
            for part in (self.soft, self.hard, *self.panels_outside)
        )
        return PatchLight(
            direct=direct, bare=bare, mirrored=mirrored, soft=soft, hard=hard, hard_free=hard_free, hard_lit=hard_lit,
            lamps=_mean(self.lamps, PATCHES), panels=_mean(self.panels, PATCHES),
            rays=PatchRays.read(patches, self.hits, self.lit, self.bare),
        )  # fmt: skip


def _mean(found: Sequence[Sequence[mi.Float]], width: int) -> Floats:
    """Average over the points on the lamps' discs, each of which has `width` columns, (width,)."""
    total = np.zeros(width)
    for parts in found:
        total += np.concatenate([part.numpy() for part in parts])
    return total / max(len(found), 1)


@recorded
def gather_light(
    frame: DeviceFrame, panels: Lights, field: RadiosityField, tables: PatchTables, lanes: Lanes
) -> Gathered:
    """Compute the direct light of all lamps on the patches of a frame, and trace the rays between the patches."""
    # Shadows of panels are found with rays alone.
    of_panels = replace(frame, lights=panels, caches=Caches(ambience=frame.caches.ambience))
    direct = [_onto_outer(frame, tables, first, lanes.outside) for first in tables.outer_spots]
    soft, hard = _ambient(frame, tables, lanes.outside) if frame.structure.ambient else (None, None)
    panels_outside = _onto_outer(of_panels, tables, None, lanes.outside) if lanes.panels else (None, None)
    rows = tables.near_cornea
    mirrored = [] if rows is None else [
        _off_cornea(frame, rows, first, lanes.near_cornea) for first in tables.mirrored_spots
    ]  # fmt: skip
    lamps = [_inside(frame, tables.inside, first) for first in tables.inside_spots] if lanes.lamps else []
    parts = [_inside(of_panels, tables.inside, tables.inside_spots[0])] if lanes.panels else []
    hits = trace_rays(frame, field, tables, lanes.rays)
    return Gathered(
        direct=direct, mirrored=mirrored, soft=soft, hard=hard, panels_outside=panels_outside, lamps=lamps,
        panels=parts, hits=hits, lit=_at_hits(frame, hits, tables, lanes.at_hits) if lanes.at_hits else None,
        bare=None if frame.region is None else _bare_at_hits(frame.lights, hits),
    )  # fmt: skip


def _ambient(frame: DeviceFrame, tables: PatchTables, count: int) -> tuple[mi.Float, mi.Float]:
    """Compute the irradiance of the outside patches from the soft and the hard part of the ambient light."""
    n = gather_rows(tables.outer, 6, dr.arange(mi.UInt32, count))
    soft, hard = frame.caches.ambience.soft_and_hard(mi.Vector3f(*n[:3]), mi.Vector3f(*n[3:]))
    dr.eval(soft, hard)
    return soft, hard


def _onto_outer(
    frame: DeviceFrame, tables: PatchTables, first: mi.UInt32 | None, count: int
) -> tuple[mi.Float, mi.Float]:
    """Compute the irradiance of the outside patches from lamps, with and without shadows; `count` lanes.

    Points on the lamps' discs are numbered from `first`; without it, they are the middles.
    """
    index = dr.arange(mi.UInt32, count)
    n = gather_rows(tables.outer, 6, index)
    x, normal = mi.Vector3f(*n[:3]), mi.Vector3f(*n[3:])
    away = (index >= tables.on_globe) & (index < tables.before_limbus)
    start, facing = frame.point_to_eye(x + START_MM * normal), frame.vector_to_eye(normal)
    u, v = (mi.Float(0), mi.Float(0)) if first is None else sequence(index + first)
    sheet = away & (index < tables.on_globe + tables.on_skin)
    found = irradiance_at(frame, start, facing, u, v, off_globe=away, on_sheet=sheet)
    dr.eval(found)
    return found


def _off_cornea(frame: DeviceFrame, rows: mi.Float, first: mi.UInt32, count: int) -> mi.Float:
    """Compute the irradiance of patches from lamps mirrored by the cornea; disc points are numbered from `first`."""
    index = dr.arange(mi.UInt32, count)
    n = gather_rows(rows, 6, index)
    normal = mi.Vector3f(*n[3:])
    x, facing = frame.point_to_eye(mi.Vector3f(*n[:3]) + START_MM * normal), frame.vector_to_eye(normal)
    lit = irradiance_off_cornea(frame, x, facing, *sequence(index + first))
    dr.eval(lit)
    return lit


def _inside(frame: DeviceFrame, rows: mi.Float, first: mi.UInt32) -> list[mi.Float]:
    """Compute the irradiance of the chamber's patches from lamps; disc points are numbered from `first`."""

    def of(begin: int, end: int, inner: bool) -> mi.Float:
        index = dr.arange(mi.UInt32, end - begin)
        n = gather_rows(rows, 7, index + begin)
        x, inside, normal = mi.Vector3f(*n[:3]), n[6] > 0, mi.Vector3f(*n[3:6])
        u, v = sequence(index + first)
        surfaces = frame.surfaces if inner else frame.surfaces[:-1]
        return irradiance_through_cornea(frame, x, inside, u, v, normal=normal, surfaces=surfaces)[0]

    # If there is a back of the cornea, the wall is the rim of the cornea, in front of it.
    parts = [of(0, PATCHES, True)] if len(frame.surfaces) == 1 else [of(0, IRIS, True), of(IRIS, PATCHES, False)]
    dr.eval(parts)
    return parts


@syntax
def _bare_at_hits(lights: Lights, hits: RayHits) -> mi.Float:
    """Compute the unshadowed irradiance from the lamps at points of the skin that rays hit, else -1."""
    on_skin, x, normal = hits.on_skin, hits.point, hits.normal
    u, v = sequence(dr.arange(mi.UInt32, dr.width(x)) * mi.UInt32(SHUFFLED))
    sine, cosine = dr.sincos(v * (2 * dr.pi))
    i, total = mi.UInt32(0), mi.Float(0) * x.x
    while dr.hint(on_skin & (i < lights.count), label="lamps on skin that is met", exclude=[lights]):
        lamp = lights[i]
        total += irradiance(lamp, lamp.point(u, sine, cosine), x, normal)
        i += 1
    total = dr.select(on_skin, total, -1)
    dr.eval(total)
    return total


@syntax
def _at_hits(frame: DeviceFrame, hits: RayHits, tables: PatchTables, count: int) -> mi.Float:
    """Compute the irradiance from the lamps at points of the skin hit by rays of globe and chamber, else -1.

    In the narrow space between eye and lids, light comes from points close by and varies over a fraction of the
    distance between patches.
    """
    index = dr.arange(mi.UInt32, count)
    globe = tables.on_globe * RAYS
    ray = dr.select(index < globe, index, index - globe + tables.rays_outside)
    on_skin, x, normal = (dr.gather(type(part), part, ray) for part in (hits.on_skin, hits.point, hits.normal))
    lit = mi.Float(-1)
    if dr.hint(on_skin, exclude=[frame]):
        u, v = sequence(ray * mi.UInt32(SHUFFLED))
        yes = mi.Bool(True)
        lit, _ = irradiance_at(frame, x + START_MM * normal, normal, u, v, off_globe=yes, on_sheet=yes)
    dr.eval(lit)
    return lit
