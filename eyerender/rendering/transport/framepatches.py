"""The patches of a frame, on host and device, and what is cached per subject and per eye.

The patches come in this order: the globe; skin, the inner sides of the lids, or the background; the limbus; the chamber
behind the cornea. The first three are "outside".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Cache, Floats, Ints
from ...eye.model import EyeModel
from ...optics.transforms import rotated
from ...optics.vectors import dots, lengths
from ...region.globe import Globe
from ...region.look import Look
from ..records.frame import aligned_copy, upload_array
from ..records.job import LampTable, RenderJob
from ..records.recording import recorded
from ..scene.region import RegionScene
from .chamber import PATCHES, Chamber, bundles, chamber_of, limbus_points, patch_albedo, through_limbus
from .chamber import TURNS as IRIS_TURNS
from .manifold import CORNEA_MM
from .patches import (
    GLOBE_COLUMNS,
    GLOBE_ROWS,
    MAP_SIDE,
    RINGS,
    TURNS,
    GlobePatches,
    SkinPatches,
    plane_patches,
    skin_patches,
)

RAYS = 24  # rays from each patch on the globe or around it
_SKIN_RAYS, _INNER_RAYS = 10, 2  # rays from patches on the skin, and on the dark inner sides of the lids
_HALVINGS = 14, 15  # halvings that bundle the rays that leave the eye, without and with light from afar
LANES = 4096  # numbers of lanes are multiples of this, so that recordings serve many subjects
_PATCHES = 256  # lanes for patches in multiples of this, so that recordings serve many subjects and poses
_SMALL, _SPOTS = 0.02, 16  # radius over distance of lamps of which one point is enough; points of larger ones
_CLOSE_MM = 10.5  # distance from the cornea's centre to skin onto which it mirrors lamps


@dataclass(frozen=True, slots=True, kw_only=True)
class ChamberPatches:
    """The chamber of an eye, and everything about it that does not depend on the pose."""

    chamber: Chamber
    form_factors: Floats  # irradiance of its patches per irradiance of each other
    limbus: Floats  # irradiance of its patches per irradiance of the limbus' sectors
    rows: mi.Float  # on the device, the patches, their normals, and whether they are in the eye
    leaving: mi.Float  # on the device, a ray for each bundle of those that leave the eye
    gain: Any  # (patches, bundles) gain with which each bundle lights each patch, sparse

    @classmethod
    def of(cls, eye: EyeModel, film_index: float, look: Look, halvings: int) -> ChamberPatches:
        """Compute the interior for an eye with its pupil and a look; `halvings` sets the number of ray bundles."""
        chamber = chamber_of(eye, film_index)
        albedo = patch_albedo(eye, chamber, look)
        limbus = through_limbus(eye, chamber, look.limbus_width_mm, look.limbus_aspect) * look.limbus_transmittance
        rows = upload_array(np.column_stack([chamber.points, chamber.normals, chamber.valid]))
        rays, gain = bundles(chamber, halvings)
        return cls(
            chamber=chamber, form_factors=chamber.exchange * albedo, limbus=limbus, rows=rows,
            leaving=upload_array(rays), gain=gain,
        )  # fmt: skip


def round_up(number: int, step: int) -> int:
    """Round up to a multiple of a step."""
    return -(-number // step) * step


@dataclass(frozen=True, slots=True, kw_only=True)
class RayPlan:
    """Patches on the skin of a subject, and the rays of all patches outside the eye; independent of the pose."""

    skin: SkinPatches | None  # the patches, None for a bare eye
    count: Ints  # (patches,) number of rays of each patch outside the chamber
    of_patch: mi.UInt32  # on the device, the patch of each ray, padded
    stands_for: mi.Int32  # on the device, the patches that represent both sides of each vertex
    # on the device, the patches around every vertex: first those of rank one for all vertices, then those of rank two,
    # ..
    near: mi.UInt32
    weight: mi.Float  # on the device, their weights there

    @classmethod
    def of(cls, on_globe: int, others: int, skin: SkinPatches | None) -> RayPlan:
        """Plan the rays for given numbers of patches on the globe and of other patches before the limbus."""
        count = np.full(on_globe + others + IRIS_TURNS, RAYS)
        stands_for, near, weight = mi.Int32(0), mi.UInt32(0), mi.Float(0)
        if skin is not None:
            on_skin = len(skin.vertices)
            count[on_globe : on_globe + others] = _SKIN_RAYS
            count[on_globe + on_skin : on_globe + others] = _INNER_RAYS
            table = np.stack([skin.nearest, skin.behind + on_skin], axis=1)
            stands_for = mi.Int32(aligned_copy(table.astype(np.int32).ravel()))
            near = mi.UInt32(aligned_copy(skin.near.T.astype(np.uint32).ravel()))
            weight = upload_array(skin.weight.T.ravel())
        rays = int(count.sum())
        of_patch = np.zeros(round_up(rays, LANES), np.uint32)
        of_patch[:rays] = np.repeat(np.arange(len(count)), count)
        return cls(
            skin=skin, count=count, of_patch=mi.UInt32(aligned_copy(of_patch)), stands_for=stands_for, near=near,
            weight=weight,
        )  # fmt: skip

    @property
    def rays(self) -> int:
        """Number of all rays."""
        return int(self.count.sum())

    def at_vertices(self, patches: Floats) -> mi.Float:
        """Interpolate the patches' numbers (n, 4), the last of which is the whole sky, at all vertices."""
        assert self.skin is not None
        vertices, each = self.skin.near.shape
        count = dr.opaque(mi.UInt32, vertices)
        return _at_vertices(upload_array(patches), self.near, self.weight, count, vertices, each)


@recorded
def _at_vertices(
    patches: mi.Float, near: mi.UInt32, weight: mi.Float, count: mi.UInt32, vertices: int, each: int
) -> mi.Float:
    """Interpolate four numbers at every vertex from the `each` patches around it."""
    index = dr.arange(mi.UInt32, vertices)
    total = mi.Vector4f(0)
    for k in range(each):
        patch = dr.gather(mi.UInt32, near, index + k * count)
        total += dr.gather(mi.Float, weight, index + k * count) * dr.gather(mi.Vector4f, patches, patch)
    total.y = dr.select(total.w > 0, total.y / total.w, 1)
    total.w = 0
    out = dr.zeros(mi.Float, 4 * vertices)
    dr.scatter(out, total, index)
    dr.eval(out)
    return out


@dataclass(frozen=True, kw_only=True)
class FramePatches:
    """The patches of a frame, on the host."""

    job: RenderJob
    globe: GlobePatches  # patches of the globe
    interior: ChamberPatches  # patches of the chamber
    plan: RayPlan  # the rays
    points: Floats  # (n, 3) patches on skin and lids, or on the background
    normals: Floats  # (n, 3) unit normals there
    plane: tuple[float, float, float]  # as in `RadiosityField`

    @property
    def on_globe(self) -> int:
        """Number of patches on the globe."""
        return len(self.globe.points)

    @property
    def on_skin(self) -> int:
        """Number of patches on the outer side of a region's skin."""
        return 0 if self.plan.skin is None else len(self.plan.skin.vertices)

    @property
    def outside(self) -> int:
        """Number of patches outside the chamber; the last ones are on the limbus."""
        return len(self.globe.points) + len(self.points) + IRIS_TURNS

    @property
    def bundles(self) -> int:
        """Number of rays that leave the eye."""
        return int(self.interior.gain.shape[1])

    @cached_property
    def near_cornea(self) -> Ints:
        """Numbers of the patches on skin and lids onto which the cornea may mirror lamps."""
        job = self.job
        if self.plan.skin is None or not job.interreflection:
            return np.zeros(0, int)
        bulge = rotated(job.M, np.asarray(job.eye.front[0].origin_mm) - [CORNEA_MM, 0, 0]) + (job.t - job.anchor_mm)
        way = bulge - self.points
        return np.flatnonzero((lengths(way) < _CLOSE_MM) & (dots(way, self.normals) > -0.5 * CORNEA_MM))

    @property
    def outer(self) -> Floats:
        """Points and normals of the patches outside the chamber, (n, 6)."""
        job = self.job
        rim, facing = limbus_points(job.eye)
        points = (self.globe.points, self.points, rim @ job.M.T + (job.t - job.anchor_mm))
        normals = (self.globe.normals, self.normals, facing @ job.M.T)
        return np.column_stack([np.concatenate(points), np.concatenate(normals)])


class Patches:
    """Cache of patches: keeps what does not change between frames of a subject."""

    def __init__(self) -> None:
        self._plans: Cache[RayPlan] = Cache()  # per subject
        self._interiors: Cache[ChamberPatches] = Cache()

    def of(self, job: RenderJob, globe: GlobePatches, region: RegionScene | None) -> FramePatches:
        """Return the patches of a job, with those of its globe."""
        plan = self._plan(region, job.globe)
        points, normals, plane = _others(job, region, plan.skin)
        return FramePatches(
            job=job, globe=globe, interior=self._interior(job), plan=plan, points=points, normals=normals, plane=plane
        )

    def _interior(self, job: RenderJob) -> ChamberPatches:
        """Return the chamber of a job's eye; with light from afar, more outgoing rays are used."""
        ambient = job.ambient
        halvings = _HALVINGS[ambient.map is not None or ambient.irradiance_w_m2 > 0]
        film, look = job.film_index, job.look
        return self._interiors.get(
            (job.eye, film, look, halvings), lambda: ChamberPatches.of(job.eye, film, look, halvings)
        )

    def _plan(self, region: RegionScene | None, globe: Globe) -> RayPlan:
        """Compute patches and rays with the eye straight ahead, so that no earlier pose changes an image."""
        if region is None:
            return self._plans.get(None, lambda: RayPlan.of(MAP_SIDE * MAP_SIDE, RINGS * TURNS, None))
        rest = replace(globe, M=np.eye(3), t=np.zeros(3))

        def plan() -> RayPlan:
            skin = skin_patches(region.at_rest(rest), rest)
            return RayPlan.of(GLOBE_COLUMNS * GLOBE_ROWS, len(skin.vertices) + len(skin.lids), skin)

        return self._plans.get((region.subject, rest), plan)


def _others(
    job: RenderJob, region: RegionScene | None, skin: SkinPatches | None
) -> tuple[Floats, Floats, tuple[float, float, float]]:
    """Compute patches outside the eye, their normals, and the rings of the background."""
    if region is not None and skin is not None:
        vertices, normals = (a[skin.vertices] for a in (region.posed.vertices, region.posed.normals))
        both = np.concatenate([vertices, vertices[skin.lids]]), np.concatenate([normals, -normals[skin.lids]])
        return *both, (0.0, 0.0, 1.0)
    globe = job.globe
    points, inner = plane_patches(globe, -job.look.backdrop_distance_mm)
    centre = globe.centre * globe.mirror
    return points, np.tile([1.0, 0.0, 0.0], (len(points), 1)), (float(centre[1]), float(centre[2]), inner)


def gather_rows(buffer: mi.Float, width: int, i: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.Float]:
    """Read rows i of a table with `width` columns."""
    return [dr.gather(mi.Float, buffer, i * width + k, active) for k in range(width)]


@dataclass(kw_only=True)
class PatchTables:
    """The patches of a frame on the device."""

    outer: mi.Float  # points and normals of patches outside the eye (scene's frame)
    inside: mi.Float  # points and normals of patches of the chamber, as in `Interior`
    near_cornea: mi.Float | None  # patches on skin onto which the cornea mirrors lamps, padded; None for none
    leaving: mi.Float  # rays that leave the eye
    of_patch: mi.UInt32  # the patch of each ray outside the eye
    stands_for: mi.Int32  # the patches that represent both sides of each vertex
    on_globe: mi.UInt32  # number of patches on the globe
    on_skin: mi.UInt32  # number of patches on skin
    before_limbus: mi.UInt32  # number of patches outside the eye that are not on the limbus
    outside: mi.UInt32  # number of patches outside the eye
    rays_outside: mi.UInt32  # number of their rays
    rays: mi.UInt32  # number of all rays
    outer_spots: tuple[mi.UInt32, ...]  # first numbers of the points on the lamps' discs, for patches outside the eye
    mirrored_spots: tuple[mi.UInt32, ...]  # the same for patches near the cornea
    inside_spots: tuple[mi.UInt32, ...]  # the same for patches of the chamber

    @classmethod
    def upload(cls, patches: FramePatches, lamps: LampTable, lanes: Lanes) -> PatchTables:
        """Copy the patches of a frame to the device."""
        plan, interior, near = patches.plan, patches.interior, patches.near_cornea
        rows = None
        if lanes.near_cornea:
            padded = np.append(near, np.full(lanes.near_cornea - len(near), near[0]))
            rows = upload_array(np.column_stack([patches.points[padded], patches.normals[padded]]))
        outside, rays = patches.outside, plan.rays
        counts = patches.on_globe, patches.on_skin, outside - IRIS_TURNS, outside, rays, rays + patches.bundles
        on_globe, on_skin, before_limbus, outside, rays_outside, rays = (dr.opaque(mi.UInt32, n) for n in counts)
        each = 1 if lamps.widest < _SMALL else _SPOTS
        spots = [
            tuple(dr.opaque(mi.UInt32, k * width) for k in range(each))
            for width in (2 * patches.outside, lanes.near_cornea, PATCHES)
        ]
        return cls(
            outer=upload_array(np.resize(patches.outer, (lanes.outside, 6))), inside=interior.rows, near_cornea=rows,
            leaving=interior.leaving, of_patch=plan.of_patch, stands_for=plan.stands_for, on_globe=on_globe,
            on_skin=on_skin, before_limbus=before_limbus, outside=outside, rays_outside=rays_outside, rays=rays,
            outer_spots=spots[0], mirrored_spots=spots[1], inside_spots=spots[2],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Lanes:
    """Numbers of lanes of a frame's kernels, rounded up so that recordings serve many frames."""

    outside: int  # lanes for patches outside the eye
    near_cornea: int  # lanes for patches onto which the cornea mirrors lamps
    rays: int  # lanes for rays
    at_hits: int  # lanes for rays that compute the light at the point of the skin that they hit
    lamps: bool  # whether there are lamps
    panels: bool  # whether there are parts of panels or bright parts of a map

    @classmethod
    def of(cls, patches: FramePatches, lamps: LampTable, panels: LampTable) -> Lanes:
        """Count the lanes of a frame."""
        bundles, lit = patches.bundles, len(lamps) > 0
        return cls(
            outside=round_up(patches.outside, _PATCHES),
            near_cornea=round_up(len(patches.near_cornea), _PATCHES) if lit else 0,
            rays=round_up(patches.plan.rays + bundles, LANES),
            at_hits=patches.on_globe * RAYS + bundles if patches.plan.skin is not None and lit else 0,
            lamps=lit,
            panels=len(panels) > 0,
        )
