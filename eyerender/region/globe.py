"""The posed globe as a radius over direction from its centre: the surface on which the lids lie.

    r(n) = max(R, distance to the front cornea along n where that lies within the limbus)

Here n is a unit direction from the centre of the sclera's sphere (radius R). The globe is star-shaped from there, so r
describes it completely. All points are in the region's frame: the eye frame of the unrotated right eye (a left eye's
region is the mirror image).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..base.arrays import ArrayValue, Body, Floats, frozen, remembered, sealed
from ..optics.surfaces import Surface, components
from ..optics.transforms import rotated
from ..optics.vectors import lengths

_POLAR, _TURNS = 241, 96
_WIDEST = np.radians(40.0)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Globe(ArrayValue):
    """A posed globe."""

    cornea: Surface | None  # front of the cornea in the eye frame; None for the bare sphere
    limbus_radius_mm: float  # radius of the limbus
    centre_mm: Floats  # (3,) centre of the sphere in the eye frame
    radius_mm: float  # radius of the sphere
    M: Floats  # (3, 3) rotation of the motion p = M x + t into the unrotated frame
    t: Floats  # (3,) translation of that motion
    mirrored: bool = False  # whether it is a left eye, whose region's frame has y reversed
    # what holds the lenses worn before it, and obstacles, in the unrotated frame, also for a left eye
    frames: tuple[Body, ...] = ()

    def __post_init__(self) -> None:
        for name in ("centre_mm", "M", "t"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @classmethod
    def sphere(cls, radius_mm: float = 12.0, depth_mm: float = 13.0) -> Globe:
        """Create an average globe at rest, without a cornea."""
        return cls(
            cornea=None,
            limbus_radius_mm=0.0,
            centre_mm=np.array([-depth_mm, 0.0, 0.0]),
            radius_mm=radius_mm,
            M=np.eye(3),
            t=np.zeros(3),
        )

    @property
    def mirror(self) -> Floats:
        """Factors (3,) between a right eye's frame and the region's: -1 along y for a left eye."""
        return np.array([1.0, -1.0 if self.mirrored else 1.0, 1.0])

    @property
    def centre(self) -> Floats:
        """Centre of the sclera's sphere in the region's frame, (3,) mm."""
        return _posed(self).centre

    @property
    def rest(self) -> Floats:
        """Centre of the sphere of the unrotated eye, (3,) mm."""
        return np.asarray(self.mirror * self.centre_mm)

    @property
    def axis(self) -> Floats:
        """Direction of the optic axis in the region's frame."""
        return np.asarray(self.mirror * self.M[:, 0])

    @property
    def elevation_rad(self) -> float:
        """Elevation of the optic axis."""
        return float(np.arcsin(np.clip(self.M[2, 0], -1, 1)))

    def radial(self, direction: Floats) -> Floats:
        """Compute the radius r (n,) mm along unit directions (n, 3) from the centre."""
        direction = np.asarray(direction)
        r = np.full(direction.shape[:-1], self.radius_mm)
        if self.cornea is not None:
            front = direction @ _posed(self).axes[:, 0] > np.cos(_WIDEST)
            r[front] += self._height(direction[front])
        return r

    def _height(self, direction: Floats) -> Floats:
        """Compute the height (n,) mm of the cornea above the sphere along unit directions (n, 3) within its table."""
        posed = _posed(self)
        x, y, z = (direction @ posed.axes).T
        row = np.arccos(np.minimum(x, 1.0)) * ((_POLAR - 1) / _WIDEST)
        column = np.arctan2(z, y) * (_TURNS / (2 * np.pi))
        column += _TURNS * (column < 0)
        i, j = np.minimum(row.astype(int), _POLAR - 2), np.minimum(column.astype(int), _TURNS - 1)
        row -= i
        column -= j
        first, table = i * (_TURNS + 1) + j, posed.bulge.ravel()
        before, after = ((1 - row) * table[k] + row * table[k + _TURNS + 1] for k in (first, first + 1))
        return np.asarray((1 - column) * before + column * after)

    def clearance(self, points: Floats) -> Floats:
        """Compute the distance (n,) mm of points (n, 3) from the globe along lines from its centre; negative inside."""
        away = points - self.centre
        distance = np.maximum(lengths(away), 1e-9)
        return np.asarray(distance - self.radial(away / distance[..., None]))

    def pushed_out(self, points: Floats, clearance_mm: Floats | float) -> Floats:
        """Move points closer to the globe than `clearance_mm` outwards along the line from its centre."""
        posed = _posed(self)
        out = points - posed.centre
        distance = np.maximum(lengths(out), 1e-9)
        least = np.empty_like(distance)
        least[...] = self.radius_mm + clearance_mm
        if self.cornea is not None:
            front = out @ posed.axes[:, 0] > np.cos(_WIDEST) * distance
            near = front & (distance < least + posed.highest_mm)
            least[near] += self._height(out[near] / distance[near][:, None])
        out *= (np.maximum(distance, least) / distance)[..., None]
        out += posed.centre
        return np.asarray(out)


@dataclass(frozen=True, slots=True, eq=False)
class _Posed:
    """Precomputed numbers of a posed globe: centre and axes (columns) in the region's frame, the cornea's height."""

    centre: Floats
    axes: Floats
    bulge: Floats
    highest_mm: float


@remembered
def _posed(globe: Globe) -> _Posed:
    bulge = np.zeros((_POLAR, _TURNS + 1))
    if globe.cornea is not None:
        bulge = _table(globe.cornea, globe.limbus_radius_mm, tuple(globe.centre_mm.tolist()), globe.radius_mm)
    centre = globe.mirror * (rotated(globe.M, globe.centre_mm) + globe.t)
    return _Posed(sealed(centre), globe.mirror[:, None] * globe.M, bulge, float(np.max(bulge)))


@lru_cache(maxsize=32)
def _table(cornea: Surface, limbus_mm: float, centre: tuple[float, ...], radius_mm: float) -> Floats:
    """Compute the cornea's height (mm) above the sphere over (polar angle, turn about x), closed in the turn."""
    polar = np.linspace(0, _WIDEST, _POLAR)[:, None]
    turn = (2 * np.pi * np.arange(_TURNS + 1) / _TURNS)[None, :]
    n = np.stack(
        np.broadcast_arrays(np.cos(polar), np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn)), axis=-1
    )
    n = n / np.linalg.norm(n, axis=-1, keepdims=True)
    c = np.array(centre)
    # Rays run from outside inwards, so that they meet the front of the cornea first.
    start = radius_mm + 8.0
    hit = cornea.hit(components(c + start * n), components(-n), True)
    met = hit.ok & (hit.distance > 0.0)
    r = np.where(met, start - hit.distance, radius_mm)
    local = cornea.to_local(c + r[..., None] * n)
    inside = met & (np.hypot(local[..., 1], local[..., 2]) <= limbus_mm) & (r > 0.5 * radius_mm)
    return frozen(np.where(inside, np.maximum(r - radius_mm, 0.0), 0.0))
