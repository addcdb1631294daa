"""Rays inside the anterior chamber, traced through the exact surfaces until they arrive at the iris or the wall."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ...arrays import Bools, Floats, Ints
from ...eye.meshes import chamber_rim
from ...geometry.surfaces import Surface, components
from ...optics.interface import fresnel

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

    Attributes:
        front: refracting surfaces from outside inwards.
        indices: refractive index behind each.
        film: refractive index of the film on the first surface.
        centre: centre of the plane of the iris, mm.
        normal: normal of that plane.
        limbus: radius of the limbus about the axis, mm.
        root: radius of the root of the iris, mm.
        sclera_x: x of the centre of the sclera's sphere, mm.
        sclera_radius: its radius, mm.
    """

    front: tuple[Surface, ...]
    indices: tuple[float, ...]
    film: float
    centre: tuple[float, ...]
    normal: tuple[float, ...]
    limbus: float
    root: float
    sclera_x: float
    sclera_radius: float

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
    """Rays in flight: numbers, weights, points, directions, and medium (surfaces in front of it)."""

    number: Ints
    weight: Floats
    o: Floats
    d: Floats
    layer: Ints

    def only(self, some: Bools) -> _Rays:
        return _Rays(**{f.name: getattr(self, f.name)[some] for f in fields(self)})

    def join(self, other: _Rays) -> _Rays:
        return _Rays(**{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)})


def trace_inside(walls: Walls, o: Floats, d: Floats, layer: Ints) -> Arrivals:
    """Trace rays until they arrive at the plane or the wall; record those that leave through the front first.

    The back of the cornea refracts them and mirrors only by total reflection.
    """
    rays = _Rays(number=np.arange(len(o)), weight=np.ones(len(o)), o=o, d=d, layer=layer)
    first = np.ones(len(o), dtype=bool)
    ends, left = [], []
    for _ in range(_STEPS):
        if not len(rays.number):
            break
        outer, inner = _surface_distances(walls, rays)
        plane = np.where(rays.layer == len(walls.front), walls.to_plane(rays.o, rays.d), np.inf)
        wall = np.where(rays.layer == walls.layer, walls.to_wall(rays.o, rays.d), np.inf)
        nearest = np.minimum(np.minimum(plane, wall), np.minimum(outer, inner))
        known = np.isfinite(nearest)
        # Where the rim of a tilted cornea is above the wall's edge, rays pass between them: they meet the wall there.
        arrives = ~known | (nearest == np.minimum(plane, wall))
        at = rays.o + np.where(known, nearest, 0)[:, None] * rays.d
        ends.append((rays.number[arrives], rays.weight[arrives], at[arrives], (~known | (wall < plane))[arrives]))
        rays.o = at
        known &= ~arrives
        outwards = nearest == outer
        at_front = rays.only(known & outwards & (rays.layer == 1))
        at_front, gone = _mirror_at_front(walls, at_front, first)
        left.append(gone)
        further = [at_front]
        for k in range(1, len(walls.front)):
            further.append(_cross(walls, rays.only(known & outwards & (rays.layer == k + 1)), k, outwards=True))
            further.append(_cross(walls, rays.only(known & ~outwards & (rays.layer == k)), k, outwards=False))
        rays = further[0]
        for more in further[1:]:
            rays = rays.join(more)
    columns = [np.concatenate(column) for part in (left, ends) for column in zip(*part, strict=True)]
    return Arrivals(**dict(zip((f.name for f in fields(Arrivals)), columns, strict=True)))


def _surface_distances(walls: Walls, rays: _Rays) -> tuple[Floats, Floats]:
    """Compute distances (n,) to the surfaces in front of and behind the rays' medium; infinite if missed."""
    outer, inner = np.full(len(rays.number), np.inf), np.full(len(rays.number), np.inf)
    for k, surface in enumerate(walls.front):
        here = rays.layer == k + 1
        t = _distance_outwards(surface, rays.o[here], rays.d[here])
        if k == 0:
            hit = rays.o[here] + np.where(np.isfinite(t), t, 0)[:, None] * rays.d[here]
            local = surface.to_local(hit)
            t[(np.hypot(local[:, 1], local[:, 2]) > walls.limbus) | (hit[:, 0] < walls.top - 1e-6)] = np.inf
        outer[here] = t
        here = rays.layer == k
        hit = surface.hit(components(rays.o[here] + _AHEAD_MM * rays.d[here]), components(rays.d[here]), True)
        inner[here] = np.where(hit.ok & (hit.distance > 0), hit.distance + _AHEAD_MM, np.inf)
    return outer, inner


def _mirror_at_front(walls: Walls, rays: _Rays, first: Bools) -> tuple[_Rays, tuple[Ints, Floats, Floats, Floats]]:
    """Mirror rays at the inner side of the front; also return the rays that leave the eye there for the first time.

    `first` marks the rays that have not left yet.
    """
    n, w = walls.front[0].normal(rays.o), rays.d
    cosine = np.sum(n * w, axis=1)
    mirrored = fresnel(cosine, walls.indices[0], 1.0, walls.film).unpolarized
    go = first[rays.number] & (mirrored < 1)
    full = rays.weight * walls.indices[0] ** 2 * (1 - mirrored)
    gone = rays.number[go], rays.o[go], _refract(w[go], -n[go], walls.indices[0]), full[go]
    first[rays.number[go]] = False
    rays.d = w - 2 * cosine[:, None] * n
    weak = mirrored < _WEAK
    rays.weight = rays.weight * np.where(weak, _FEW * mirrored, mirrored)
    return rays.only((rays.weight > 1e-3) & (~weak | (rays.number % _FEW == 0))), gone


def _cross(walls: Walls, rays: _Rays, k: int, *, outwards: bool) -> _Rays:
    """Refract rays at surface k behind the front, with the change of radiance between media, or mirror them."""
    n = walls.front[k].normal(rays.o)
    before, after = walls.indices[k - 1], walls.indices[k]
    if outwards:
        n, before, after = -n, after, before
    eta = before / after
    cosine = -np.sum(n * rays.d, axis=1)
    passes = 1 - eta * eta * (1 - cosine * cosine) > 0
    mirrored = rays.d + 2 * cosine[:, None] * n
    rays.d = np.where(passes[:, None], _refract(rays.d, n, eta), mirrored)
    rays.weight = rays.weight * np.where(passes, eta * eta, 1.0)
    rays.layer = rays.layer + np.where(passes, -1 if outwards else 1, 0)
    return rays


def _distance_outwards(surface: Surface, o: Floats, d: Floats) -> Floats:
    """Compute the distance (n,) to a surface from inside; infinite where it is missed."""
    hit = surface.hit(components(o + _AHEAD_MM * d), components(d), False)
    return np.where(hit.ok & (hit.distance > 0), hit.distance + _AHEAD_MM, np.inf)


def _refract(d: Floats, n: Floats, eta: float) -> Floats:
    """Refract directions at normals that face them; beyond total reflection, return grazing directions."""
    c = -np.sum(n * d, axis=1)
    c2 = np.sqrt(np.maximum(1 - eta * eta * (1 - c * c), 0))
    w = eta * d + (eta * c - c2)[:, None] * n
    return np.asarray(w / np.linalg.norm(w, axis=1, keepdims=True))
