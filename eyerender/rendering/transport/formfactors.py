"""Form factors between patches, from cosine-distributed rays.

From every patch i, K rays are traced to the patches j that it sees. The mean over its rays of the albedo at the hits,
including losses at the cornea, is rho_j F_ij. The rays of the iris are the bundles that leave the eye.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array

from ...base.arrays import Floats, Ints, Reals, remembered
from ..hits.interaction import SurfaceInteraction, outer_albedo
from ..hits.primary import TriangleHit, appearance, intersect
from ..materials.albedo import iris_albedo
from ..records.frame import DeviceFrame, sequence
from .chamber import IRIS_RINGS
from .chamber import TURNS as IRIS_TURNS
from .framepatches import RAYS, FramePatches, PatchTables, gather_rows
from .patches import RINGS, TURNS
from .radiosityfield import RadiosityField

START_MM = 0.02  # above a surface, where rays begin
SHUFFLED = 0x9E3779B1
# A patch is covered if most of its rays are stopped this near, or by the inner side of the skin above it.
_TOUCHING_MM, _UNDER_MM = 0.3, 4.0


@dataclass(kw_only=True)
class RayHits:
    """Hits of the patches' rays, on the device, one number per ray."""

    target: mi.UInt32  # the patch that is hit
    weight: mi.Float  # share of its irradiance that is sent back
    near: mi.Float  # whether the hit is very close
    open: mi.Bool  # whether nothing is hit
    sky: mi.Float  # irradiance from uniform light and the soft part of a map, where nothing is hit
    free: mi.Float  # the same, as if nothing were hit
    on_skin: mi.Bool  # whether the outer side of the sheet of skin is hit
    point: mi.Vector3f  # the hit (eye frame)
    normal: mi.Vector3f  # unit normal there


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchRays:
    """Rays of all patches on the host, one number per ray."""

    shares: csr_array  # (patches, rays) share of each ray in the mean over a patch's rays, sparse
    target: Ints  # as in `RayHits`
    weight: Reals  # as in `RayHits`
    near: Reals  # as in `RayHits`
    sky: Reals  # as in `RayHits`
    free: Reals  # as in `RayHits`
    lit: Reals  # direct irradiance from the lamps at the point of the skin that is hit, -1 where unknown
    bare: Reals  # the same without shadows, -1 where no skin is hit

    @classmethod
    def read(cls, patches: FramePatches, hits: RayHits, lit: mi.Float | None, bare: mi.Float | None) -> PatchRays:
        """Copy the rays' hits to the host; `lit` has only the rays of globe and chamber."""
        plan, globe = patches.plan, patches.on_globe * RAYS
        rays = plan.rays + patches.bundles
        at_hits = np.full(rays, -1.0, np.float32)
        if lit is not None:
            found = lit.numpy()
            at_hits[:globe], at_hits[plan.rays :] = found[:globe], found[globe:]
        columns = (hits.target, hits.weight, hits.near, hits.sky, hits.free)
        target, weight, near, sky, free = (column.numpy()[:rays] for column in columns)
        return cls(
            shares=_shares(plan.count, patches.interior.gain), target=target, weight=weight, near=near, sky=sky,
            free=free, lit=at_hits, bare=at_hits if bare is None else bare.numpy()[:rays],
        )  # fmt: skip

    def mean(self, values: Reals) -> Floats:
        """Average values over the rays of each patch, (patches,)."""
        return np.asarray(self.shares @ values)

    def form_factors(self, stand_in: Ints) -> csr_array:
        """Compute form factors times albedo, (patches, patches); `stand_in` is the patch used for each."""
        part = self.shares
        return csr_array(
            (part.data * self.weight[part.indices], stand_in[self.target][part.indices], part.indptr),
            shape=(part.shape[0],) * 2,
        )

    def correction(self, direct: Floats, bare: Floats) -> Floats:
        """Compute the difference between lamp light at the points that are hit and that of the patches there, `direct`.

        `bare` is the unshadowed lamp light on the patches. Where the light at the point itself is unknown, the shadowed
        share is assumed to be that of the patch.
        """
        if not np.any(self.bare >= 0):
            return np.zeros(self.shares.shape[0])
        target = np.minimum(self.target, len(direct) - 1)
        lit = np.where(self.lit >= 0, self.lit, share_of(direct, bare)[target] * self.bare)
        return self.mean(self.weight * np.where(self.bare >= 0, lit - direct[target], 0))


@remembered
def _shares(count: Ints, gain: csr_array) -> csr_array:
    """Compute the shares of `PatchRays` from each patch's number of rays and the gain of those that leave the eye."""
    ends = np.append(0, np.cumsum(count))
    return csr_array(
        (
            np.append(np.repeat(1 / count, count), gain.data),
            np.append(np.arange(ends[-1]), ends[-1] + gain.indices),
            np.append(ends[:-1], ends[-1] + gain.indptr),
        ),
        shape=(len(count) + gain.shape[0], ends[-1] + gain.shape[1]),
    )


def share_of(part: Floats, whole: Floats) -> Floats:
    """Compute part / whole, 1 where the whole is zero."""
    return np.where(whole > 0, part / np.where(whole > 0, whole, 1), 1.0)


def trace_rays(frame: DeviceFrame, field: RadiosityField, tables: PatchTables, lanes: int) -> RayHits:
    """Trace the rays of patches. Rays of outside patches come first; there may be more lanes than rays."""
    index, first = dr.arange(mi.UInt32, lanes), tables.rays_outside
    outside, inside = index < first, (index >= first) & (index < tables.rays)
    patch = dr.gather(mi.UInt32, tables.of_patch, index, outside)
    n = gather_rows(tables.outer, 6, patch, outside)
    normal = mi.Vector3f(*n[3:])
    o = mi.Vector3f(*n[:3]) + START_MM * normal
    d = _pattern(normal, index)
    leaving = gather_rows(tables.leaving, 6, index - first, inside)
    start, way = mi.Vector3f(*leaving[:3]), mi.Vector3f(*leaving[3:6])
    o = dr.select(outside, o, frame.point_to_scene(start + 2e-3 * way))
    d = dr.select(outside, d, frame.vector_to_scene(way))
    hits = _meet(frame, field, tables, o, d, index)
    if frame.structure.ambient:
        hits.free = dr.pi * frame.caches.ambience.soft(d, outside | hits.open)
    hits.sky = dr.select(hits.open, hits.free, 0)
    dr.eval(hits)
    return hits


def _pattern(normal: mi.Vector3f, ray: mi.UInt32) -> mi.Vector3f:
    """Compute cosine-distributed directions about normals; rays of a patch have consecutive numbers."""
    u, v = sequence(ray)
    s, c = dr.sincos(v * (2 * dr.pi))
    e1, e2 = mi.coordinate_system(normal)
    r = dr.sqrt(u)
    return (r * c) * e1 + (r * s) * e2 + dr.sqrt(1 - u) * normal


def _meet(
    frame: DeviceFrame, field: RadiosityField, tables: PatchTables, o: mi.Vector3f, d: mi.Vector3f, index: mi.UInt32
) -> RayHits:
    """Compute the hits along rays with these numbers; `sky` and `free` are set to 0."""
    active = index < tables.rays
    view, hit = intersect(frame, o, d, active, coherent=False)
    view = appearance(frame, view, hit, d)
    # One of the four patches around a point is chosen at random, by its weight in linear interpolation.
    s, t = sequence(index * mi.UInt32(SHUFFLED))
    # Where nothing is hit, the point is not a number, which would become an index far outside the tables.
    at = dr.select(view.met, frame.point_to_scene(view.point), 0)
    if frame.region is None:
        other, matte = _patch_on_background(frame, field, tables, view, at, s, t)
        on_skin = inner = mi.Bool(False)
    else:
        other, matte, on_skin, inner = _patch_on_skin(frame, tables, view, hit, d, s)
    column, row = field.globe_place(at)
    i, j = mi.UInt32(dr.clip(column + t, 0, field.columns - 1)), mi.UInt32(dr.clip(row + s, 0, field.rows - 1))
    through = view.cornea & (view.opacity < 0.5)
    outer = dr.select(view.other, other, j * field.columns + i)
    target = dr.select(through, tables.outside + _patch_of_iris(field, view, s, t), outer)
    behind = dr.select(view.pupil, frame.pupil_albedo, iris_albedo(frame, view.inner))
    inside = view.passed * behind / (frame.inner_index * frame.inner_index)
    back = dr.select(through, inside, dr.select(view.other & ~matte, 0, outer_albedo(frame, view)))
    back = dr.select(view.met, back, 0)
    dark = mi.Float(0) * o.x
    near = dr.select(view.met, view.distance, 1e9) < dr.select(inner, _UNDER_MM, _TOUCHING_MM)
    return RayHits(
        target=dr.select(back > 0, target, 0), weight=back,
        near=mi.Float(near), open=active & ~view.met, sky=dark,
        free=dark, on_skin=on_skin, point=view.point, normal=view.normal,
    )  # fmt: skip


def _patch_on_skin(
    frame: DeviceFrame, tables: PatchTables, view: SurfaceInteraction, hit: TriangleHit, d: mi.Vector3f, s: mi.Float
) -> tuple[mi.UInt32, mi.Bool, mi.Bool, mi.Bool]:
    """Return the hit patch of a region, if it sends light back, and if it is the sheet's outer or inner side."""
    face = frame.region.face(hit)
    inner = frame.region.from_behind(face, hit.prim_uv, d, view.other)
    corner = frame.region.corner(face, hit.prim_uv, s, view.other)
    which = dr.gather(mi.Int32, tables.stands_for, 2 * corner + dr.select(inner, 1, 0), view.other)
    matte = view.other & ~frame.region.on_obstacles(face) & (~inner | (which >= mi.Int32(tables.on_skin)))
    sheet = view.other & frame.region.on_sheet(face)
    return tables.on_globe + mi.UInt32(which), matte, sheet & ~inner, sheet & inner


def _patch_on_background(
    frame: DeviceFrame, field: RadiosityField, tables: PatchTables, view: SurfaceInteraction, at: mi.Vector3f,
    s: mi.Float, t: mi.Float,
) -> tuple[mi.UInt32, mi.Bool]:  # fmt: skip
    """Return the hit patch of the background at points of the scene's frame, and whether it sends light back."""
    ring, turn = field.background_place(at)
    ring, turn = mi.UInt32(dr.clip(ring + s, 0, RINGS - 1)), mi.UInt32(dr.clip(turn + t, 0, TURNS))
    patch = tables.on_globe + ring * TURNS + dr.select(turn < TURNS, turn, 0)
    return patch, view.other & (dr.abs(at.x - frame.backdrop_x) < 1e-2)


def _patch_of_iris(field: RadiosityField, view: SurfaceInteraction, s: mi.Float, t: mi.Float) -> mi.UInt32:
    """Return the hit patch of the iris, by its number in the chamber."""
    ring, turn = field.iris_place(view.inner)
    turn = mi.UInt32(dr.clip(turn + t, 0, IRIS_TURNS))
    return mi.UInt32(dr.clip(ring + s, 0, IRIS_RINGS - 1)) * IRIS_TURNS + dr.select(turn < IRIS_TURNS, turn, 0)
