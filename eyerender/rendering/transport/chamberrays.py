"""Rays inside the anterior chamber, traced through the exact surfaces until they arrive at the iris or the wall."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ...base.arrays import Bools, Floats, Ints, join_rows, take_rows
from ...eye.meshes import chamber_rim
from ...optics.formulas import NUMPY
from ...optics.interface import fresnel
from ...optics.surfaces import Surface, components, join
from ...optics.surfaces_graph import GraphSurface, distances
from ...optics.vectors import dots, lengths

_WEAK, _FEW = 0.25, 4  # one in _FEW is traced for all of the rays that the cornea mirrors less than _WEAK
_STEPS = 20  # crossings and mirrorings of a ray
_NEAR_MM = 1e-6
_AHEAD_MM = 1e-4  # hits are searched from here on, because a root cannot be computed from a point on the surface itself
_BELOW_MM = 1.0  # depth of the wall's end below the plane of the iris
_WALL_MM = 1.0  # thickness of the sclera
_SECTORS = 16  # sectors over which the foot of the wall is averaged


@dataclass(frozen=True, kw_only=True)
class Walls:
    """Surfaces around the chamber of an eye; hashable.

    The wall is a cone about x with the radius of the limbus at x = `top`, which grows by `slope` per mm downwards. If
    the cornea has a back surface, which meets the plane of the iris, the wall is the cornea's rim in front of it.
    """

    front: tuple[Surface, ...]  # refracting surfaces from outside inwards
    indices: tuple[float, ...]  # refractive index behind each
    film: float  # refractive index of the film on the first surface
    centre: tuple[float, ...]  # centre of the plane of the iris, mm
    normal: tuple[float, ...]  # normal of that plane
    limbus: float  # radius of the limbus about the axis, mm
    root: float  # radius of the root of the iris, mm
    sclera_x: float  # x of the centre of the sclera's sphere, mm
    sclera_radius: float  # its radius, mm

    @cached_property
    def top(self) -> float:
        """Compute x of the upper edge of the wall, mm."""
        front = self.front[0]
        return float(np.asarray(front.origin_mm)[0] + front.sag(np.array(self.limbus), np.array(0.0)))

    @cached_property
    def slope(self) -> float:
        """Compute the growth of the wall's radius downwards."""
        bottom = self.centre[0] - _BELOW_MM
        inner_radius = self.sclera_radius - _WALL_MM
        wide = np.sqrt(max(inner_radius**2 - (bottom - self.sclera_x) ** 2, self.limbus**2))
        if len(self.front) > 1:
            # The wall stands where the back of the cornea meets the plane of the iris.
            angle = 2 * np.pi * np.arange(_SECTORS) / _SECTORS
            foot = chamber_rim(self.front[-1], np.array(self.centre), np.array(self.normal), self.limbus, angle)
            bottom, wide = min(self.centre[0], self.top - 0.1), float(np.mean(foot))
        return float((wide - self.limbus) / (self.top - bottom))

    @property
    def layer(self) -> int:
        """Medium bounded by the wall, as the number of surfaces in front of it."""
        return max(len(self.front) - 1, 1)

    def height(self, p: Floats) -> Floats:
        """Compute the height (n,) mm of points above the plane of the iris."""
        return np.asarray((p - self.centre) @ self.normal)

    def to_plane(self, o: Floats, d: Floats) -> Floats:
        """Compute the distance (n,) to the plane of the iris, infinite for rays that leave it."""
        down = d @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -self.height(o) / down
        return np.where((down < -1e-9) & (t > _NEAR_MM), t, np.inf)

    def to_wall(self, o: Floats, d: Floats) -> Floats:
        """Compute the distance (n,) to the wall above the plane, infinite where it is not met."""
        r, s = self.limbus + self.slope * (self.top - o[:, 0]), -self.slope * d[:, 0]
        a = d[:, 1] ** 2 + d[:, 2] ** 2 - s * s
        b = o[:, 1] * d[:, 1] + o[:, 2] * d[:, 2] - r * s
        c = o[:, 1] ** 2 + o[:, 2] ** 2 - r * r
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(np.maximum(b * b - a * c, 0))
            t = np.where(a > 0, (root - b) / a, -c / (b + root))
        hit = o + np.where(np.isfinite(t), t, 0)[:, None] * d
        there = (b * b > a * c) & (t > _NEAR_MM) & (hit[:, 0] < self.top) & (self.height(hit) > 0)
        return np.where(there, t, np.inf)


def air_side(surface: Surface) -> float:
    """Return the sign of the implicit function of a surface on its air side."""
    apex = np.asarray(surface.origin_mm) + np.asarray(surface.rotation)[:, 0]
    return float(np.sign(surface.implicit(apex[None])[0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrivals:
    """Ends of traced rays: numbers of the rays that left the eye (`out`) and that arrived (`ray`)."""

    out: Ints
    origin: Floats
    way: Floats
    weight: Floats
    ray: Ints
    share: Floats
    back: Floats
    on_wall: Bools


@dataclass(slots=True, kw_only=True)
class _Rays:
    """Rays in flight in one medium: numbers, weights, points and directions."""

    number: Ints
    weight: Floats
    o: Floats
    d: Floats


def trace_inside(walls: Walls, o: Floats, d: Floats, layer: Ints) -> Arrivals:
    """Trace rays until they arrive at the plane or the wall; record those that leave through the front first.

    The back of the cornea refracts them and mirrors only by total reflection. `layer` is the number of surfaces in
    front of the medium in which each starts.
    """
    whole, media = _Rays(number=np.arange(len(o)), weight=np.ones(len(o)), o=o, d=d), range(1, len(walls.front) + 1)
    rays = {k: take_rows(whole, layer == k) for k in media}
    first = np.ones(len(o), dtype=bool)
    ends, left = [], []
    for _ in range(_STEPS):
        further: dict[int, list[_Rays]] = {k: [] for k in media}
        for k, some in rays.items():
            at_outer, at_inner, end = _advance(walls, some, k)
            ends.append(end)
            if k == 1:
                mirrored, gone = _mirror_at_front(walls, at_outer, first)
                further[1].append(mirrored)
                left.append(gone)
            else:
                passed, mirrored = _cross(walls, at_outer, k - 1, outwards=True)
                further[k - 1].append(passed)
                further[k].append(mirrored)
            if k < len(walls.front):
                passed, mirrored = _cross(walls, at_inner, k, outwards=False)
                further[k + 1].append(passed)
                further[k].append(mirrored)
        rays = {k: join_rows(parts) for k, parts in further.items()}
        if not any(len(some.number) for some in rays.values()):
            break
    columns = [np.concatenate(column) for part in (left, ends) for column in zip(*part, strict=True)]
    return Arrivals(**dict(zip((f.name for f in fields(Arrivals)), columns, strict=True)))


def _advance(walls: Walls, rays: _Rays, k: int) -> tuple[_Rays, _Rays, tuple[Ints, Floats, Floats, Bools]]:
    """Move rays in medium k to what they meet first.

    Returns:
        The rays at the surface in front of the medium, those at the surface behind it, and as in `Arrivals` those that
        arrive at the plane or the wall.
    """
    none = np.full(len(rays.number), np.inf)
    plane = walls.to_plane(rays.o, rays.d) if k == len(walls.front) else none
    wall = walls.to_wall(rays.o, rays.d) if k == walls.layer else none
    end = np.minimum(plane, wall)
    outer = _distance(walls.front[k - 1], rays, end, inward=False)
    if k == 1:
        hit = rays.o + np.where(np.isfinite(outer), outer, 0)[:, None] * rays.d
        local = walls.front[0].to_local(hit)
        outer[(np.hypot(local[:, 1], local[:, 2]) > walls.limbus) | (hit[:, 0] < walls.top - 1e-6)] = np.inf
    nearest = np.minimum(end, outer)
    inner = _distance(walls.front[k], rays, nearest, inward=True) if k < len(walls.front) else none
    nearest = np.minimum(nearest, inner)
    known = np.isfinite(nearest)
    # Where the rim of a tilted cornea is above the wall's edge, rays pass between them: they meet the wall there.
    arrives = ~known | (nearest == end)
    rays.o = rays.o + np.where(known, nearest, 0)[:, None] * rays.d
    at = take_rows(rays, arrives)
    outwards = nearest == outer
    ended = (at.number, at.weight, at.o, (~known | (wall < plane))[arrives])
    return take_rows(rays, ~arrives & outwards), take_rows(rays, ~arrives & ~outwards), ended


def _distance(surface: Surface, rays: _Rays, far: Floats, *, inward: bool) -> Floats:
    """Compute the distance (n,) to a surface; infinite where it is missed, and perhaps where it is beyond `far`."""
    start = rays.o + _AHEAD_MM * rays.d
    if isinstance(surface, GraphSurface):
        return distances(surface, start, rays.d, far - _AHEAD_MM, inward) + _AHEAD_MM
    hit = surface.hit(components(start), components(rays.d), inward)
    return np.where(hit.ok & (hit.distance > 0), hit.distance + _AHEAD_MM, np.inf)


def _mirror_at_front(walls: Walls, rays: _Rays, first: Bools) -> tuple[_Rays, tuple[Ints, Floats, Floats, Floats]]:
    """Mirror rays at the inner side of the front; also return the rays that leave the eye there for the first time.

    `first` marks the rays that have not left yet.
    """
    n, w = walls.front[0].normal(rays.o), rays.d
    cosine = dots(n, w)
    mirrored = fresnel(cosine, walls.indices[0], 1.0, walls.film).unpolarized
    go = first[rays.number] & (mirrored < 1)
    full = rays.weight * walls.indices[0] ** 2 * (1 - mirrored)
    gone = rays.number[go], rays.o[go], _refract(w[go], -n[go], walls.indices[0]), full[go]
    first[rays.number[go]] = False
    weak = mirrored < _WEAK
    rays.weight = rays.weight * np.where(weak, _FEW * mirrored, mirrored)
    on = (rays.weight > 1e-3) & (~weak | (rays.number % _FEW == 0))
    rays = take_rows(rays, on)
    rays.d = rays.d - 2 * cosine[on, None] * n[on]
    return rays, gone


def _cross(walls: Walls, rays: _Rays, k: int, *, outwards: bool) -> tuple[_Rays, _Rays]:
    """Refract rays at surface k behind the front, with the change of radiance between media, or mirror them.

    Returns:
        Refracted rays and mirrored ones.
    """
    n = walls.front[k].normal(rays.o)
    before, after = walls.indices[k - 1], walls.indices[k]
    if outwards:
        n, before, after = -n, after, before
    eta = before / after
    cosine = -dots(n, rays.d)
    passes = 1 - eta * eta * (1 - cosine * cosine) > 0
    mirrored = take_rows(rays, ~passes)
    mirrored.d = mirrored.d + 2 * cosine[~passes, None] * n[~passes]
    passed = take_rows(rays, passes)
    passed.d = _refract(passed.d, n[passes], eta)
    passed.weight = passed.weight * (eta * eta)
    return passed, mirrored


def _refract(d: Floats, n: Floats, eta: float) -> Floats:
    """Refract directions at normals that face them; beyond total reflection, return grazing directions."""
    w = join(NUMPY.refract(components(d), components(n), eta).way)
    return np.asarray(w / lengths(w)[:, None])
