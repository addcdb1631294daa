"""Light that surfaces send to each other: globe, lids, face or surround, and the iris behind the cornea.

It varies slowly, so its irradiance is computed at some hundred places per pose (`places`, `chamber`), and pixels
interpolate between them. A place of albedo rho_j with irradiance E_j sends the radiance rho_j E_j / pi. From every
place i, K rays of a cosine-distributed pattern find the places j that it sees:

    E_i = E0_i + (1 / K) sum_k w_ik E_j(k)

E0 is the light straight from lamps, panels and surroundings, and on the skin about the eye that of lamps which the
cornea mirrors: up to a sixth of the light on the lids' margins. w is the albedo, with the losses at the cornea where
the ray goes through it. The rays of the iris are those that leave the eye, in bundles; what the cornea mirrors back
into the chamber comes from `chamber`. The equations are solved by iteration, so every number of reflections is
included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ...arrays import Bools, Floats, Ints, Reals, remembered
from ...eye.model import EyeModel
from ...geometry.vectors import dots, lengths
from ...region.globe import Globe
from ...region.look import Look
from ...rig.imaging import Ambient
from ..hits.interaction import appearance, intersect, outer_albedo
from ..materials.albedo import iris_albedo
from ..records.caches import Caches
from ..records.eyecache import EyeCache
from ..records.frame import Frame, Lamp, Lights, aligned_copy, upload_array, upload_scalars
from ..records.job import LampTable, RenderJob
from ..records.recording import recorded
from ..scene.background import Background
from ..scene.region import RegionScene
from .chamber import (
    IRIS,
    IRIS_RINGS,
    PLACES,
    ROOT_RINGS,
    Chamber,
    bundles,
    chamber_of,
    limbus_points,
    shares,
    through_limbus,
)
from .chamber import TURNS as IRIS_TURNS
from .directlight import irradiance, irradiance_at, irradiance_off_cornea, irradiance_through_cornea
from .manifold import CORNEA_MM
from .patches import (
    GLOBE_COLUMNS,
    GLOBE_ROWS,
    MAP_SIDE,
    PLANE_FIRST_MM,
    PLANE_MM,
    RINGS,
    TURNS,
    WIDEST,
    GlobePlaces,
    SkinPlaces,
    filled,
    plane_places,
    skin_places,
)

RAYS = 24  # from each place on the globe or about it
_SKIN_RAYS, _INNER_RAYS = 10, 2  # from places on the skin, and on the lids' inner sides, which lie in the dark
_HALVINGS = 14, 15  # of the rays that leave the eye into bundles, without and with light from afar
_LANES = 4096  # there are lanes for so many times as many rays, so that recordings serve many subjects
_PLACES = 256  # and for places, so that they serve many subjects and poses
_ROUNDS = 6
_START_MM = 0.02
_SMALL, _SPOTS = 0.02, 16  # radius over distance of lamps of which one point is enough; points of larger ones
_CLOSE_MM = 10.5  # from the cornea's centre to skin that it mirrors lamps to
_TOUCHING_MM = 0.3  # a place most of whose rays are stopped this near is covered
_ALPHA = (0.7548776662466927, 0.5698402909980532)
_SHUFFLED = 0x9E3779B1


@dataclass(kw_only=True)
class RadiosityField:
    """What the places receive, for the kernels: irradiance by way of other surfaces, and the share of open sky.

    Every surface has four numbers a place: irradiance from other surfaces, share of the sky that is open, whole
    irradiance (what a mirror image of the place shows), and 0. Without exchange all of it is dark and open.

    Attributes:
        on: whether surfaces send light to each other.
        between: whether the grid of places on the globe lies between lids.
        columns: of that grid.
        rows: of that grid.
        centre: of the globe (scene's frame, mm).
        first: y (mm) of the first column between lids.
        per_mm: columns per mm.
        root2: squared radius of the root of the iris, mm^2.
        reach2: squared reach of the chamber, mm^2.
        plane: y and z of the middle of the surround's rings, and the radius of the first (mm).
        ends: lower and upper end of each column (mm).
        on_globe: four numbers for each place of the globe.
        on_other: four numbers for each place of the surround.
        on_iris: one number for each place of the iris.
    """

    on: mi.Bool
    between: bool
    columns: int
    rows: int
    centre: mi.Vector3f
    first: mi.Float
    per_mm: mi.Float
    root2: mi.Float
    reach2: mi.Float
    plane: tuple[mi.Float, mi.Float, mi.Float]
    ends: mi.Float
    on_globe: mi.Float
    on_other: mi.Float
    on_iris: mi.Float

    @classmethod
    def dark(cls, on: bool, chamber: Chamber, globe: GlobePlaces, plane: tuple[float, float, float]) -> RadiosityField:
        """Send the places to the device; they receive nothing.

        Args:
            on: whether surfaces send light to each other.
            chamber: the chamber of the eye.
            globe: the places on the globe.
            plane: as the attribute.
        """
        rim = [chamber.root_mm**2, chamber.reach_mm**2]
        n = upload_scalars(np.array([*globe.table[:5], *rim, *plane], dtype=np.float32))
        none = upload_array(np.zeros(4))
        return cls(
            on=dr.opaque(mi.Bool, on), between=globe.columns == GLOBE_COLUMNS, columns=globe.columns, rows=globe.rows,
            centre=mi.Vector3f(*n[:3]), first=n[3], per_mm=n[4], root2=n[5], reach2=n[6], plane=(n[7], n[8], n[9]),
            ends=upload_array(globe.table[5:]), on_globe=none, on_other=none, on_iris=none,
        )  # fmt: skip

    def filled(self, globe: Floats, other: Floats, iris: Floats) -> RadiosityField:
        """The same places with what they receive, in the order of the attributes `on_globe`, `on_other`, `on_iris`."""
        return replace(self, on_globe=upload_array(globe), on_other=upload_array(other), on_iris=upload_array(iris))

    def globe(self, x: mi.Vector3f) -> mi.Vector4f:
        """Numbers of points of the globe, given in the scene's frame."""
        beyond = 0.5 if self.between else 0.0  # the last rows are half a row from the lids, where light changes fast
        return _bilinear(self.on_globe, *self.globe_place(x), self.columns, self.rows, beyond)

    def globe_place(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Column and row of points of the globe in the grid of its places."""
        if self.between:
            column = dr.clip((x.y - self.first) * self.per_mm, 0, GLOBE_COLUMNS - 1)
            i = mi.UInt32(dr.minimum(column, GLOBE_COLUMNS - 1.001))
            w = column - mi.Float(i)
            a, b = (dr.gather(mi.Vector2f, self.ends, i + k) for k in (0, 1))
            low, high = a.x + w * (b.x - a.x), a.y + w * (b.y - a.y)
            return column, (x.z - low) / (high - low) * self.rows - 0.5
        r = dr.normalize(x - self.centre)
        polar = dr.acos(dr.clip(r.x, -1, 1)) / WIDEST
        inv = dr.rcp(dr.maximum(dr.sqrt(r.y * r.y + r.z * r.z), 1e-6))
        middle = 0.5 * (MAP_SIDE - 1)
        return middle * (1 + polar * r.y * inv), middle * (1 + polar * r.z * inv)

    def iris(self, x: mi.Vector3f) -> mi.Float:
        """Irradiance of points in the plane of the iris (eye frame), without the light straight from the lamps."""
        return _around(self.on_iris, *self.iris_place(x), IRIS_RINGS, IRIS_TURNS, mi.Float)

    def iris_place(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Ring and turn of points in the plane of the iris among the places of the chamber."""
        turn = dr.atan2(x.z, x.y) * (IRIS_TURNS * 0.5 * dr.inv_pi) - 0.5
        r2 = x.y * x.y + x.z * x.z
        beyond = dr.maximum(r2 - self.root2, 0) * ((IRIS_RINGS - ROOT_RINGS) / (self.reach2 - self.root2))
        ring = dr.minimum(r2 / self.root2, 1) * ROOT_RINGS + beyond - 0.5
        return ring, dr.select(turn < 0, turn + IRIS_TURNS, turn)

    def surround(self, x: mi.Vector3f) -> mi.Vector4f:
        """Numbers of points of the surround's plane, given in the scene's frame."""
        return _around(self.on_other, *self.surround_place(x), RINGS, TURNS, mi.Vector4f)

    def surround_place(self, x: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Ring and turn of points of the surround's plane among its places."""
        y, z, inner = self.plane
        dy, dz = x.y - y, x.z - z
        out = dr.maximum(dr.sqrt(dy * dy + dz * dz) - inner, 0) / PLANE_FIRST_MM
        ring = dr.log(1 + out) * ((RINGS - 1) / float(np.log1p(PLANE_MM / PLANE_FIRST_MM)))
        turn = dr.atan2(dz, dy) * (TURNS * 0.5 * dr.inv_pi)
        return ring, dr.select(turn < 0, turn + TURNS, turn)


def _bilinear(buffer: mi.Float, column: mi.Float, row: mi.Float, columns: int, rows: int, beyond: float) -> mi.Vector4f:
    """Values between columns and rows, continued by so many rows beyond the last ones."""
    column, row = dr.clip(column, 0, columns - 1.001), dr.clip(row, -beyond, rows - 1.001 + beyond)
    i, j = mi.UInt32(column), mi.UInt32(dr.clip(row, 0, rows - 1.001))
    s, t = column - mi.Float(i), row - mi.Float(j)
    place = j * columns + i
    a, b, c, d = (dr.gather(mi.Vector4f, buffer, place + k) for k in (0, 1, columns, columns + 1))
    low, high = a + s * (b - a), c + s * (d - c)
    return dr.maximum(low + t * (high - low), 0)


def _around(buffer: mi.Float, ring: mi.Float, turn: mi.Float, rings: int, turns: int, kind: Any) -> Any:
    """Values between rings and turns; the turns close."""
    ring, turn = dr.clip(ring, 0, rings - 1.001), dr.clip(turn, 0, turns - 0.001)
    i, j = mi.UInt32(ring), mi.UInt32(turn)
    s, t = ring - mi.Float(i), turn - mi.Float(j)
    after = dr.select(j + 1 < turns, j + 1, 0)
    a, b, c, d = (dr.gather(kind, buffer, p * turns + q) for p in (i, i + 1) for q in (j, after))
    near, far = a + t * (b - a), c + t * (d - c)
    return near + s * (far - near)


@dataclass(frozen=True, slots=True)
class _Seen:
    """What the rays of the places meet: numbers of places, weights, open rays, covered rays; all (rays,).

    Attributes:
        shares: (places, rays) share of each ray in the mean over a place's rays, sparse.
        target: numbers of the places that are met.
        weight: share of their irradiance that is sent back.
        near: whether something is met very close.
        sky: irradiance from even light and the soft part of a map, where nothing is met.
        free: the same as if nothing were met.
        lit: irradiance straight from the lamps at the very point of the skin that is met, -1 where it is not known.
        bare: the same if nothing stood in the way, -1 where no skin is met.
    """

    shares: csr_array
    target: Ints
    weight: Reals
    near: Reals
    sky: Reals
    free: Reals
    lit: Reals
    bare: Reals

    def mean(self, values: Reals) -> Floats:
        """Means (places,) over the rays of each place."""
        return np.asarray(self.shares @ values)

    def exchange(self, stand_in: Ints) -> csr_array:
        """Share of the irradiance of each place that each other receives, with the places that are used for them."""
        part = self.shares
        return csr_array(
            (part.data * self.weight[part.indices], stand_in[self.target][part.indices], part.indptr),
            shape=(part.shape[0],) * 2,
        )

    def correction(self, direct: Floats, bare: Floats) -> Floats:
        """What the lamps' light at the points that are met adds to that of the places there, `direct`.

        `bare` is the lamps' light on the places if nothing stood in the way. Where that at the very point is not known,
        the same share of it arrives there.
        """
        if not np.any(self.bare >= 0):
            return np.zeros(self.shares.shape[0])
        target = np.minimum(self.target, len(direct) - 1)
        lit = np.where(self.lit >= 0, self.lit, _over(direct, bare)[target] * self.bare)
        return self.mean(self.weight * np.where(self.bare >= 0, lit - direct[target], 0))


@dataclass(frozen=True, slots=True)
class _Interior:
    """The chamber of an eye, and what does not depend on the eye's pose.

    Attributes:
        chamber: the chamber.
        exchange: shares by which its places light each other.
        limbus: shares by which the sectors of the limbus light the places.
        rows: on the device, the places, their normals, and whether they are in the eye.
        leaving: on the device, a ray for each bundle of those that leave the eye.
        gain: (places, bundles) gain with which each bundle lights each place, sparse.
    """

    chamber: Chamber
    exchange: Floats
    limbus: Floats
    rows: mi.Float
    leaving: mi.Float
    gain: Any

    @classmethod
    def of(cls, eye: EyeModel, film_index: float, look: Look, halvings: int) -> _Interior:
        """Compute it for an eye, with its pupil, and a look, with so many halvings of the rays that leave."""
        chamber = chamber_of(eye, film_index)
        albedo = shares(eye, chamber, look.pupil_albedo, look.iris_albedo, look.limbus_albedo)
        limbus = through_limbus(eye, chamber, look.limbus_width_mm) * look.limbus_transmittance
        rows = np.column_stack([chamber.points, chamber.normals, chamber.valid])
        rays, gain = bundles(chamber, halvings)
        return cls(chamber, chamber.exchange * albedo, limbus, upload_array(rows), upload_array(rays), gain)


@dataclass(frozen=True, slots=True)
class _Plan:
    """What does not depend on the pose: places on the skin of a subject, and the rays of all places outside the eye.

    Attributes:
        skin: the places, None for a bare eye.
        count: (places,) number of rays of each place outside the chamber.
        of_place: on the device, the place of each ray, of some rays more than there are.
        stands_for: on the device, the places that stand for both sides of each vertex.
        near: on the device, the places about every vertex: first the first ones of all vertices, then the second ...
        weight: on the device, their weights there.
    """

    skin: SkinPlaces | None
    count: Ints
    of_place: mi.UInt32
    stands_for: mi.Int32
    near: mi.UInt32
    weight: mi.Float

    @classmethod
    def of(cls, on_globe: int, others: int, skin: SkinPlaces | None) -> _Plan:
        """Plan for so many places on the globe, and so many others before the limbus."""
        count = np.full(on_globe + others + IRIS_TURNS, RAYS)
        stands_for, near, weight = mi.Int32(0), mi.UInt32(0), mi.Float(0)
        if skin is not None:
            on_skin = len(skin.vertices)
            count[on_globe : on_globe + others] = _SKIN_RAYS
            count[on_globe + on_skin : on_globe + others] = _INNER_RAYS
            table = np.stack([skin.nearest, skin.behind + on_skin], axis=1)
            stands_for = mi.Int32(aligned_copy(table.astype(np.int32).ravel()))
            near, weight = (
                mi.UInt32(aligned_copy(skin.near.T.astype(np.uint32).ravel())),
                upload_array(skin.weight.T.ravel()),
            )
        rays = int(count.sum())
        of_place = np.zeros(_rounded(rays, _LANES), np.uint32)
        of_place[:rays] = np.repeat(np.arange(len(count)), count)
        return cls(skin, count, mi.UInt32(aligned_copy(of_place)), stands_for, near, weight)

    @property
    def rays(self) -> int:
        """Number of all rays."""
        return int(self.count.sum())

    def at_vertices(self, places: Floats) -> mi.Float:
        """Four numbers of each vertex, as in `RadiosityField`, from those of places (n, 4); the last is the whole sky."""
        assert self.skin is not None
        vertices, each = self.skin.near.shape
        count = dr.opaque(mi.UInt32, vertices)
        return _at_vertices(upload_array(places), self.near, self.weight, count, vertices, each)


@recorded
def _at_vertices(
    places: mi.Float, near: mi.UInt32, weight: mi.Float, count: mi.UInt32, vertices: int, each: int
) -> mi.Float:
    """Four numbers of every vertex from those of `each` places about it."""
    index = dr.arange(mi.UInt32, vertices)
    total = mi.Vector4f(0)
    for k in range(each):
        place = dr.gather(mi.UInt32, near, index + k * count)
        total += dr.gather(mi.Float, weight, index + k * count) * dr.gather(mi.Vector4f, places, place)
    total.y = dr.select(total.w > 0, total.y / total.w, 1)
    total.w = 0
    out = dr.zeros(mi.Float, 4 * vertices)
    dr.scatter(out, total, index)
    dr.eval(out)
    return out


@remembered
def _shares(count: Ints, gain: csr_array) -> csr_array:
    """Shares as in `_Seen`, from the number of rays of each place and the gain of those that leave the eye."""
    ends = np.append(0, np.cumsum(count))
    return csr_array(
        (
            np.append(np.repeat(1 / count, count), gain.data),
            np.append(np.arange(ends[-1]), ends[-1] + gain.indices),
            np.append(ends[:-1], ends[-1] + gain.indptr),
        ),
        shape=(len(count) + gain.shape[0], ends[-1] + gain.shape[1]),
    )


class RadiositySolver:
    """Computes what the places of a frame receive; keeps what does not change between frames of a subject."""

    def __init__(self) -> None:
        self._skins: list[tuple[tuple[Any, ...], Globe, _Plan]] = []  # of subjects
        self._bare: _Plan | None = None
        self._interiors: EyeCache[_Interior] = EyeCache()

    def begun(
        self, job: RenderJob, lamps: LampTable, places_on_globe: GlobePlaces, frame: Frame, panels: LampTable,
        place: Background | RegionScene,
    ) -> Callable[[], Callable[[], RadiosityField]]:  # fmt: skip
        """Begin to find what the places of a frame receive straight from the lamps, and what they see of each other.

        Returns:
            What reads this. It returns what solves for all light, on the host; before that the device may be given
            other work.

        Args:
            job: the job.
            lamps: its lamps.
            places_on_globe: the places on the globe.
            frame: the frame, with the region and the ambient light.
            panels: parts of its panels, and the bright parts of its map, as lamps.
            place: its surroundings.
        """
        region = place if isinstance(place, RegionScene) else None
        places = self._places(job, places_on_globe, region)
        numbers = RadiosityField.dark(job.interreflection, places.chamber, places.grid, places.plane)
        if not job.interreflection and not frame.structure.ambient:
            return lambda: lambda: numbers.filled(*places.dark(region))
        tables, sizes = _tables(places, lamps, panels)
        found = _light_places(frame, Lights.upload(panels), numbers, tables, sizes)

        def read() -> Callable[[], RadiosityField]:
            known = found.read(places, sizes)
            return lambda: numbers.filled(*places.solved(region, known))

        return read

    def _places(self, job: RenderJob, on_globe: GlobePlaces, region: RegionScene | None) -> _Places:
        """The places of a job."""
        globe = job.globe
        plan = self._plan(region, globe)
        points, normals, plane = _others(job, globe, region, plan.skin)
        return _Places(job, on_globe, self._inside(job), plan, points, normals, plane)

    def _inside(self, job: RenderJob) -> _Interior:
        """The chamber of a job's eye."""
        film, look, halvings = job.film_index, job.look, _halvings(job.ambient)
        return self._interiors.get(job.eye, (film, look, halvings), lambda: _Interior.of(job.eye, film, look, halvings))

    def _plan(self, region: RegionScene | None, globe: Globe) -> _Plan:
        """Places and rays, chosen with the eye straight ahead: no earlier pose may change a picture."""
        if region is None:
            self._bare = self._bare or _Plan.of(MAP_SIDE * MAP_SIDE, RINGS * TURNS, None)
            return self._bare
        rest = replace(globe, M=np.eye(3), t=np.zeros(3))
        for known, still, plan in self._skins:
            if still == rest and known == region.subject:
                return plan
        skin = skin_places(region.at_rest(rest), rest)
        plan = _Plan.of(GLOBE_COLUMNS * GLOBE_ROWS, len(skin.vertices) + len(skin.lids), skin)
        self._skins = [*self._skins[-3:], (region.subject, rest, plan)]
        return plan


def _halvings(ambient: Ambient) -> int:
    """Number of halvings of the rays that leave the eye, more where they look for light."""
    return _HALVINGS[ambient.map is not None or ambient.irradiance_w_m2 > 0]


@dataclass(frozen=True)
class _Places:
    """The places of a frame: on the globe, on skin or surround (`points`, `normals`), on the limbus, in the chamber."""

    job: RenderJob
    grid: GlobePlaces
    interior: _Interior
    plan: _Plan
    points: Floats
    normals: Floats
    plane: tuple[float, float, float]

    @property
    def chamber(self) -> Chamber:
        """The chamber of the eye."""
        return self.interior.chamber

    @property
    def on_globe(self) -> int:
        """Number of places on the globe."""
        return len(self.grid.points)

    @property
    def on_skin(self) -> int:
        """Number of places on the outer side of a region's skin."""
        return 0 if self.plan.skin is None else len(self.plan.skin.vertices)

    @property
    def outside(self) -> int:
        """Number of places outside the chamber; the last ones are on the limbus."""
        return len(self.grid.points) + len(self.points) + IRIS_TURNS

    @cached_property
    def near_cornea(self) -> Ints:
        """Places on skin and lids, by their numbers there, to which the cornea may mirror lamps."""
        job = self.job
        if self.plan.skin is None or not job.interreflection:
            return np.zeros(0, int)
        bulge = job.M @ (np.asarray(job.eye.front[0].origin_mm) - [CORNEA_MM, 0, 0]) + (job.t - job.anchor_mm)
        way = bulge - self.points
        return np.flatnonzero((lengths(way) < _CLOSE_MM) & (dots(way, self.normals) > -0.5 * CORNEA_MM))

    @property
    def outer(self) -> Floats:
        """Points and normals of the places outside the chamber, (n, 6)."""
        job = self.job
        rim, facing = limbus_points(job.eye)
        points = (self.grid.points, self.points, rim @ job.M.T + (job.t - job.anchor_mm))
        return np.column_stack(
            [np.concatenate(points), np.concatenate([self.grid.normals, self.normals, facing @ job.M.T])]
        )

    def dark(self, region: RegionScene | None) -> tuple[Floats, Floats, Floats]:
        """Tables, as for `Received.filled`, of nothing but light straight from the lamps."""
        other = np.tile([0.0, 1.0, 0.0, 0.0], (len(self.points) if region is None else len(region.posed.vertices), 1))
        if region is not None:
            region.skin.received = upload_array(other)
        return np.tile([0.0, 1.0, 0.0, 0.0], (self.on_globe, 1)), other, np.zeros(IRIS)

    def _on_iris(self, values: Floats, along: float) -> Floats:
        """Values of the places in the plane of the iris, filled where it is outside the chamber and smooth in turn."""
        known = self.chamber.valid[:IRIS]
        grids = (values[:IRIS].reshape(IRIS_RINGS, IRIS_TURNS), known.reshape(IRIS_RINGS, IRIS_TURNS))
        closed = [np.concatenate([g[:, -2:], g, g[:, :2]], axis=1).ravel() for g in grids]
        out = filled(closed[0], closed[1], IRIS_RINGS, IRIS_TURNS + 4, (along, 0.0))
        return np.asarray(out.reshape(IRIS_RINGS, -1)[:, 2:-2].ravel())

    def _stand_in(self, valid: Bools) -> Ints:
        """Place that is used for each place: itself, or the nearest one on the globe that is not covered."""
        out = np.arange(self.outside + PLACES)
        points = self.grid.points
        if np.any(valid) and not np.all(valid):
            nearest = cKDTree(points[valid]).query(points[~valid])[1]
            out[: len(points)][~valid] = np.flatnonzero(valid)[nearest]
        return out

    def solved(self, region: RegionScene | None, known: _Known) -> tuple[Floats, Floats, Floats]:
        """Solve for the irradiance of all places: tables as for `Received.filled`."""
        job, outside, seen = self.job, self.outside, known.seen
        # What is hidden of soft light is told by the rays, and of the rest by what stands before its parts.
        soft, hard = known.soft, known.hard
        sky = seen.mean(seen.sky) if np.any(soft) else np.zeros(outside + PLACES)
        arriving = hard * _over(known.shaded, known.free)
        if np.any(soft):
            arriving += soft * _over(sky[:outside], seen.mean(seen.free)[:outside])
        valid = seen.mean(seen.near)[: self.on_globe] < 0.5
        if region is None:
            valid &= self.grid.points[:, 0] > -job.look.backdrop_distance_mm
        start = np.concatenate([known.direct + arriving, known.lamps + known.panels + sky[outside:]])
        total, arrived, within = start, np.zeros(outside + PLACES), np.zeros(PLACES)
        if job.interreflection:
            exchange, inner, limbus = seen.exchange(self._stand_in(valid)), self.interior.exchange, self.interior.limbus
            more = seen.correction(known.direct, known.bare)
            more[:outside] += known.mirrored
            for _ in range(_ROUNDS):
                arrived = exchange @ total + more
                within = inner @ total[outside:] + limbus @ total[outside - IRIS_TURNS : outside]
                total = start + arrived
                total[outside:] += within
        table = np.zeros((outside, 4))
        table[:, 0] = (total - start)[:outside]
        table[:, 1], table[:, 3] = arriving, soft + hard
        table[:, 2] = total[:outside] if job.interreflection else 0
        if region is None:
            table[self.on_globe :, 2] *= job.look.backdrop_albedo
        # Between lids the light changes fast from lid to lid, so it is averaged along them only.
        across = (1.0, 1.0 if region is None else 0.0)
        globe = filled(table[: self.on_globe], valid, self.grid.rows, self.grid.columns, across)
        other = table[self.on_globe : outside - IRIS_TURNS]
        if region is not None:
            region.skin.received = self.plan.at_vertices(other[: self.on_skin])
            other = np.zeros((1, 4))
        for part in (globe, other):
            part[:, 1], part[:, 3] = _over(part[:, 1], part[:, 3]), 0
        iris = self._on_iris((arrived + sky)[outside:], 1.0) + self._on_iris(within + known.panels, 0.0)
        return globe, other, iris


def _over(part: Floats, whole: Floats) -> Floats:
    """Share that a part has of the whole, 1 where there is nothing."""
    return np.where(whole > 0, part / np.where(whole > 0, whole, 1), 1.0)


def _others(
    job: RenderJob, globe: Globe, region: RegionScene | None, skin: SkinPlaces | None
) -> tuple[Floats, Floats, tuple[float, float, float]]:
    """Places that are not on the eye, their normals, and the rings of the surround."""
    if region is not None and skin is not None:
        vertices, normals = (a[skin.vertices] for a in (region.posed.vertices, region.posed.normals))
        both = np.concatenate([vertices, vertices[skin.lids]]), np.concatenate([normals, -normals[skin.lids]])
        return *both, (0.0, 0.0, 1.0)
    points, inner = plane_places(globe, -job.look.backdrop_distance_mm)
    centre = globe.centre * np.array([1.0, -1.0 if globe.mirrored else 1.0, 1.0])
    return points, np.tile([1.0, 0.0, 0.0], (len(points), 1)), (float(centre[1]), float(centre[2]), inner)


def _row(buffer: mi.Float, width: int, i: mi.UInt32, active: mi.Bool | bool = True) -> list[mi.Float]:
    """Rows i of a table with so many columns."""
    return [dr.gather(mi.Float, buffer, i * width + k, active) for k in range(width)]


def _spots(i: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Places on the lamps' discs for lane i."""
    u, v = ((mi.Float((i * mi.UInt32(round(a * 2**32))) >> 8) * 2.0**-24) for a in _ALPHA)
    return u, v


@dataclass(frozen=True, slots=True)
class _Known:
    """What is known of the light before it is solved for, on the host.

    For the places outside the eye (n,): irradiance straight from the lamps with and without shadows, `direct` and
    `bare`, and by way of the cornea, `mirrored`; of ambient light without shadows what is `soft` and what is `hard`;
    this rest from its parts without and with shadows, `free` and `shaded`. For the places of the chamber: irradiance
    straight from `lamps` and `panels`. `seen` is what the rays of all places meet.
    """

    direct: Floats
    bare: Floats
    mirrored: Floats
    soft: Floats
    hard: Floats
    free: Floats
    shaded: Floats
    lamps: Floats
    panels: Floats
    seen: _Seen


@dataclass(kw_only=True)
class _Tables:
    """The places of a frame on the device.

    Attributes:
        outer: points and normals of those outside the eye (scene's frame).
        inside: those of the chamber, as in `_Interior`.
        near_cornea: places on skin to which the cornea mirrors lamps, and some more; None for none.
        leaving: rays that leave the eye.
        of_place: the place of each ray outside the eye.
        stands_for: the places that stand for both sides of each vertex.
        on_globe: number of places on the globe.
        on_skin: number of places on skin.
        before_limbus: number of places outside the eye that are not on the limbus.
        outside: number of places outside the eye.
        rays_outside: number of their rays.
        rays: number of all rays.
        spots: numbers with which the places on the lamps' discs begin: for places outside, near the cornea, and inside.
    """

    outer: mi.Float
    inside: mi.Float
    near_cornea: mi.Float | None
    leaving: mi.Float
    of_place: mi.UInt32
    stands_for: mi.Int32
    on_globe: mi.UInt32
    on_skin: mi.UInt32
    before_limbus: mi.UInt32
    outside: mi.UInt32
    rays_outside: mi.UInt32
    rays: mi.UInt32
    spots: tuple[tuple[mi.UInt32, ...], tuple[mi.UInt32, ...], tuple[mi.UInt32, ...]]


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Sizes of a frame's arrays.

    Attributes:
        outside: lanes for places outside the eye.
        near_cornea: lanes for those to which the cornea mirrors lamps.
        lanes: lanes for rays.
        at_spots: number of rays that look for the light at the very point of the skin that they meet.
        lamps: whether there are lamps.
        panels: whether there are parts of panels or bright parts of a map.
    """

    outside: int
    near_cornea: int
    lanes: int
    at_spots: int
    lamps: bool
    panels: bool


def _tables(places: _Places, lamps: LampTable, panels: LampTable) -> tuple[_Tables, _Sizes]:
    """Send the places of a frame to the device."""
    plan, interior = places.plan, places.interior
    inside = interior.gain.shape[1]
    near = places.near_cornea if len(lamps) else np.zeros(0, int)
    sizes = _Sizes(
        outside=_rounded(places.outside, _PLACES),
        near_cornea=_rounded(len(near), _PLACES),
        lanes=_rounded(plan.rays + inside, _LANES),
        at_spots=places.on_globe * RAYS + inside if plan.skin is not None and len(lamps) else 0,
        lamps=len(lamps) > 0,
        panels=len(panels) > 0,
    )
    rows = None
    if len(near):
        padded = np.append(near, np.full(sizes.near_cornea - len(near), near[0]))
        rows = upload_array(np.column_stack([places.points[padded], places.normals[padded]]))
    counts = (
        places.on_globe, places.on_skin, places.outside - IRIS_TURNS, places.outside, plan.rays, plan.rays + inside
    )  # fmt: skip
    on_globe, on_skin, before_limbus, outside, rays_outside, rays = (dr.opaque(mi.UInt32, n) for n in counts)
    each = 1 if lamps.widest < _SMALL else _SPOTS
    outer, mirrored, within = (
        tuple(dr.opaque(mi.UInt32, k * width) for k in range(each))
        for width in (2 * places.outside, sizes.near_cornea, PLACES)
    )
    tables = _Tables(
        outer=upload_array(np.resize(places.outer, (sizes.outside, 6))), inside=interior.rows, near_cornea=rows,
        leaving=interior.leaving, of_place=plan.of_place, stands_for=plan.stands_for, on_globe=on_globe,
        on_skin=on_skin, before_limbus=before_limbus, outside=outside, rays_outside=rays_outside, rays=rays,
        spots=(outer, mirrored, within),
    )  # fmt: skip
    return tables, sizes


@dataclass(kw_only=True)
class _Found:
    """What the device finds out about the light of the places; the fields are those of `_Known`.

    There is a number for each place on the lamps' discs. `met` and `lit` are the columns of `_Seen`.
    """

    direct: list[tuple[mi.Float, mi.Float]]
    mirrored: list[mi.Float]
    soft: mi.Float | None
    hard: mi.Float | None
    free: mi.Float | None
    shaded: mi.Float | None
    lamps: list[list[mi.Float]]
    panels: list[list[mi.Float]]
    met: tuple[mi.Float, ...]
    lit: mi.Float | None

    def read(self, places: _Places, sizes: _Sizes) -> _Known:
        """Read it, which waits for all launches."""
        count = places.outside
        direct, bare = (part[:count] for part in np.split(_mean(self.direct, 2 * sizes.outside), 2))
        mirrored = np.zeros(count)
        near = places.near_cornea
        if self.mirrored:
            mirrored[places.on_globe + near] = _mean([[one] for one in self.mirrored], sizes.near_cornea)[: len(near)]
        soft, hard, free, shaded = (
            np.zeros(count) if part is None else part.numpy()[:count].astype(float)
            for part in (self.soft, self.hard, self.free, self.shaded)
        )
        lamps, panels = _mean(self.lamps, PLACES), _mean(self.panels, PLACES)
        return _Known(direct, bare, mirrored, soft, hard, free, shaded, lamps, panels, self._seen(places))

    def _seen(self, places: _Places) -> _Seen:
        plan, globe = places.plan, places.on_globe * RAYS
        rays = plan.rays + places.interior.gain.shape[1]
        lit = np.full(rays, -1.0, np.float32)
        if self.lit is not None:
            straight = self.lit.numpy()
            lit[:globe], lit[plan.rays :] = straight[:globe], straight[globe:]
        target, weight, near, sky, free, bare = (column.numpy()[:rays] for column in self.met)
        shares = _shares(plan.count, places.interior.gain)
        bare = lit if plan.skin is None else bare
        return _Seen(shares, target, weight, near, sky, free, lit, bare)


def _rounded(number: int, step: int) -> int:
    """Round up to a multiple of a step."""
    return -(-number // step) * step


def _mean(found: Sequence[Sequence[mi.Float]], width: int) -> Floats:
    """Mean (width,) over the places on the lamps' discs; each has some of the columns after others."""
    total = np.zeros(width)
    for parts in found:
        total += np.concatenate([part.numpy() for part in parts])
    return total / max(len(found), 1)


@recorded
def _light_places(frame: Frame, panels: Lights, numbers: RadiosityField, tables: _Tables, sizes: _Sizes) -> _Found:
    """Find the light that the places of a frame receive straight from all lamps, and what they see of each other."""
    # Shadows of panels are found with rays alone.
    lit_by_panels = replace(frame, lights=panels, caches=Caches(ambience=frame.caches.ambience))
    outer, mirrored, within = tables.spots
    direct = [_onto_outer(frame, tables, first, sizes.outside) for first in outer]
    soft = hard = free = shaded = None
    if frame.structure.ambient:
        n = _row(tables.outer, 6, dr.arange(mi.UInt32, sizes.outside))
        soft, hard = frame.caches.ambience.irradiances(mi.Vector3f(*n[:3]), mi.Vector3f(*n[3:]))
        dr.eval(soft, hard)
    if sizes.panels:
        shaded, free = _onto_outer(lit_by_panels, tables, None, sizes.outside)
    off = []
    if tables.near_cornea is not None:
        off = [_off_cornea(frame, tables.near_cornea, first, sizes.near_cornea) for first in mirrored]
    inside = [_inside(frame, tables.inside, first) for first in within] if sizes.lamps else []
    parts = [_inside(lit_by_panels, tables.inside, within[0])] if sizes.panels else []
    met, spot = _rays_of(frame, numbers, tables, sizes.lanes)
    lit = None
    if sizes.at_spots:
        lit = _at_spots(frame, spot, tables, sizes.at_spots)
    return _Found(
        direct=direct, mirrored=off, soft=soft, hard=hard, free=free, shaded=shaded, lamps=inside, panels=parts,
        met=met, lit=lit,
    )  # fmt: skip


def _onto_outer(frame: Frame, tables: _Tables, first: mi.UInt32 | None, count: int) -> tuple[mi.Float, mi.Float]:
    """Irradiance of the places outside the eye from lamps, with and without shadows; `count` lanes.

    Places on the lamps' discs begin with the number `first`; without it these are their middles.
    """
    index = dr.arange(mi.UInt32, count)
    n = _row(tables.outer, 6, index)
    x, normal = mi.Vector3f(*n[:3]), mi.Vector3f(*n[3:])
    away = (index >= tables.on_globe) & (index < tables.before_limbus)
    start, facing = frame.point_to_eye(x + _START_MM * normal), frame.vector_to_eye(normal)
    u, v = (mi.Float(0), mi.Float(0)) if first is None else _spots(index + first)
    sheet = away & (index < tables.on_globe + tables.on_skin)
    found = irradiance_at(frame, start, facing, u, v, off_globe=away, on_sheet=sheet)
    dr.eval(found)
    return found


def _off_cornea(frame: Frame, rows: mi.Float, first: mi.UInt32, count: int) -> mi.Float:
    """Irradiance of points from lamps by way of the cornea; places on their discs begin with the number `first`."""
    index = dr.arange(mi.UInt32, count)
    n = _row(rows, 6, index)
    normal = mi.Vector3f(*n[3:])
    x, facing = frame.point_to_eye(mi.Vector3f(*n[:3]) + _START_MM * normal), frame.vector_to_eye(normal)
    lit = irradiance_off_cornea(frame, x, facing, *_spots(index + first))
    dr.eval(lit)
    return lit


def _inside(frame: Frame, rows: mi.Float, first: mi.UInt32) -> list[mi.Float]:
    """Irradiance of the chamber's places from lamps; places on their discs begin with the number `first`."""

    def of(begin: int, end: int, inner: bool) -> mi.Float:
        index = dr.arange(mi.UInt32, end - begin)
        n = _row(rows, 7, index + begin)
        x, inside, normal = mi.Vector3f(*n[:3]), n[6] > 0, mi.Vector3f(*n[3:6])
        u, v = _spots(index + first)
        surfaces = frame.surfaces if inner else frame.surfaces[:-1]
        return irradiance_through_cornea(frame, x, inside, u, v, normal=normal, surfaces=surfaces)[0]

    # If there is a back of the cornea, the wall is the rim of the cornea, in front of it.
    parts = [of(0, PLACES, True)] if len(frame.surfaces) == 1 else [of(0, IRIS, True), of(IRIS, PLACES, False)]
    dr.eval(parts)
    return parts


def _pattern(normal: mi.Vector3f, ray: mi.UInt32) -> mi.Vector3f:
    """Cosine-distributed directions about normals; rays of a place have consecutive numbers."""
    u, v = _spots(ray)
    s, c = dr.sincos(v * (2 * dr.pi))
    e1, e2 = mi.coordinate_system(normal)
    r = dr.sqrt(u)
    return (r * c) * e1 + (r * s) * e2 + dr.sqrt(1 - u) * normal


def _rays_of(
    frame: Frame, numbers: RadiosityField, tables: _Tables, lanes: int
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """What the rays of places meet: the columns of `_Seen` but for `lit`, and places on skin (see `_met`).

    The first rays belong to places outside the eye. There are more lanes than rays.
    """
    index, first = dr.arange(mi.UInt32, lanes), tables.rays_outside
    outside, inside = index < first, (index >= first) & (index < tables.rays)
    row = dr.gather(mi.UInt32, tables.of_place, index, outside)
    n = _row(tables.outer, 6, row, outside)
    normal = mi.Vector3f(*n[3:])
    o = mi.Vector3f(*n[:3]) + _START_MM * normal
    d = _pattern(normal, index)
    rays = _row(tables.leaving, 6, index - first, inside)
    o = dr.select(outside, o, frame.point_to_scene(mi.Vector3f(*rays[:3]) + 2e-3 * mi.Vector3f(*rays[3:6])))
    d = dr.select(outside, d, frame.vector_to_scene(mi.Vector3f(*rays[3:6])))
    active = index < tables.rays
    target, weight, open_, distance, spot = _met(frame, numbers, o, d, index, active, tables)
    sky = mi.Float(0) * o.x
    if frame.structure.ambient:
        sky = dr.pi * frame.caches.ambience.soft(d, outside | open_)
    bare = mi.Float(-1) if frame.region is None else _bare(frame.lights, *spot)
    results = (target, weight, mi.Float(distance < _TOUCHING_MM), dr.select(open_, sky, 0), sky, bare)
    dr.eval(results, spot)
    return results, spot


def _bare(lights: Lights, on_skin: mi.Bool, x: mi.Vector3f, normal: mi.Vector3f) -> mi.Float:
    """Irradiance straight from the lamps at points (eye frame) `on_skin` if nothing stood in the way, else -1."""
    u, v = _spots(dr.arange(mi.UInt32, dr.width(x)) * mi.UInt32(_SHUFFLED))
    sine, cosine = dr.sincos(v * (2 * dr.pi))

    def body(i: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        lamp: Lamp = lights[i]
        return i + 1, total + irradiance(lamp, lamp.point(u, sine, cosine), x, normal)

    state, labels = (mi.UInt32(0), mi.Float(0) * x.x), ("i", "total")
    _, total = dr.while_loop(
        state, lambda i, _: on_skin & (i < lights.count), body, labels=labels, label="lamps on skin that is met"
    )
    return dr.select(on_skin, total, -1)


def _at_spots(frame: Frame, spot: tuple[Any, ...], tables: _Tables, lanes: int) -> mi.Float:
    """Irradiance straight from the lamps at points of the skin that rays of globe and chamber have met, else -1.

    What eye and lids send to each other in the narrow space between them comes from places close by, where the light
    changes within a fraction of the distance of the places.
    """
    index = dr.arange(mi.UInt32, lanes)
    globe = tables.on_globe * RAYS
    number = dr.select(index < globe, index, index - globe + tables.rays_outside)
    on_skin, x, normal = (dr.gather(type(part), part, number) for part in spot)
    state = (on_skin, x, normal, number)

    def light(_: mi.Bool, x: mi.Vector3f, normal: mi.Vector3f, number: mi.UInt32) -> mi.Float:
        start = x + _START_MM * normal
        u, v = _spots(number * mi.UInt32(_SHUFFLED))
        return irradiance_at(frame, start, normal, u, v, off_globe=mi.Bool(True), on_sheet=mi.Bool(True))[0]

    lit = dr.if_stmt(state, on_skin, light, lambda *_: mi.Float(-1))
    dr.eval(lit)
    return lit


def _met(
    frame: Frame,
    numbers: RadiosityField,
    o: mi.Vector3f,
    d: mi.Vector3f,
    index: mi.UInt32,
    active: mi.Bool,
    tables: _Tables,
) -> tuple[mi.UInt32, mi.Float, mi.Bool, mi.Float, tuple[mi.Bool, mi.Vector3f, mi.Vector3f]]:
    """What is met along rays with these numbers.

    The place, the share of its irradiance that is sent back, whether nothing is met, the distance, and for the outer
    side of the sheet of skin (a mark) point and normal in the eye frame.
    """
    view, hit = intersect(frame, o, d, active, coherent=False)
    view = appearance(frame, view, hit, d)
    albedo = outer_albedo(frame, view)
    # One of the four places about a point stands for it, each as often as linear interpolation gives it weight.
    s, t = _spots(index * mi.UInt32(_SHUFFLED))
    first = tables.on_globe
    at = frame.point_to_scene(view.point)
    if frame.region is not None:
        face = frame.region.face(hit)
        inner = frame.region.from_behind(face, hit.prim_uv, d, view.other)
        corner = frame.region.corner(face, hit.prim_uv, s, view.other)
        which = dr.gather(mi.Int32, tables.stands_for, 2 * corner + dr.select(inner, 1, 0), view.other)
        other = first + mi.UInt32(which)
        matte = view.other & (~inner | (which >= mi.Int32(tables.on_skin)))
        on_skin = view.other & ~inner & frame.region.on_sheet(face)
    else:
        on_skin = mi.Bool(False)
        ring, turn = numbers.surround_place(at)
        ring = mi.UInt32(dr.clip(ring + s, 0, RINGS - 1))
        turn = mi.UInt32(dr.clip(turn + t, 0, TURNS))
        other = first + ring * TURNS + dr.select(turn < TURNS, turn, 0)
        matte = view.other & (dr.abs(at.x - frame.backdrop_x) < 1e-2)
    column, row = numbers.globe_place(at)
    columns, rows = numbers.columns, numbers.rows
    on_globe = mi.UInt32(dr.clip(row + s, 0, rows - 1)) * columns + mi.UInt32(dr.clip(column + t, 0, columns - 1))
    through = view.cornea & (view.opacity < 0.5)
    depth, sector = numbers.iris_place(view.inner)
    sector = mi.UInt32(dr.clip(sector + t, 0, IRIS_TURNS))
    cell = mi.UInt32(dr.clip(depth + s, 0, IRIS_RINGS - 1)) * IRIS_TURNS + dr.select(sector < IRIS_TURNS, sector, 0)
    behind = dr.select(view.pupil, frame.pupil_albedo, iris_albedo(frame, view.inner))
    inside = view.passed * behind / (frame.inner_index * frame.inner_index)
    target = dr.select(through, tables.outside + cell, dr.select(view.other, other, on_globe))
    back = dr.select(through, inside, dr.select(view.other & ~matte, 0, albedo))
    back = dr.select(view.met, back, 0)
    distance = dr.select(view.met, view.distance, 1e9)
    return dr.select(back > 0, target, 0), back, active & ~view.met, distance, (on_skin, view.point, view.normal)
