"""Refracting and reflecting surfaces: their common interface, and points as components.

A surface is the zero set of an implicit function F. F is oriented so that its half gradient g = grad F / 2 points to +x
of the surface's local frame (the optic axis outward, towards the air) everywhere on the sheet that is used. A line
parallel to the local x axis therefore meets the sheet at most once. The sign of d.g distinguishes a ray going into the
eye (d.g < 0) from one coming out, so the choice of the root is unambiguous for spheres, ellipsoids and hyperboloids.

Points are passed as one array per coordinate (`Xyz`), because chunks of such arrays stay in the cache. Parameters of a
surface are numbers, or arrays with one leading batch axis (one surface per eye); points then have that axis first.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import fields, replace
from functools import cache
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from ..base.arrays import Bools, Floats, Indices
from .transforms import flip_y, mirror_rotation, read_only, stacked

Xyz = tuple[Floats, Floats, Floats]


class Hit(NamedTuple):
    """Intersections of rays with a surface: distance (mm), point, half gradient there, and whether there is one."""

    distance: Floats
    point: Xyz
    gradient: Xyz
    ok: Bools


class SymmetricMatrix(NamedTuple):
    """Symmetric 3 x 3 matrix as components (numbers or arrays): the derivative of the half gradient."""

    xx: Floats | float
    yy: Floats | float
    zz: Floats | float
    xy: Floats | float
    xz: Floats | float
    yz: Floats | float

    def times(self, vector: Xyz) -> Xyz:
        """Multiply with a vector; off-diagonal zeros cost nothing."""
        x, y, z = vector
        out_x, out_y, out_z = self.xx * x, self.yy * y, self.zz * z
        if not _is_zero(self.xy):
            out_x, out_y = out_x + self.xy * y, out_y + self.xy * x
        if not _is_zero(self.xz):
            out_x, out_z = out_x + self.xz * z, out_z + self.xz * x
        if not _is_zero(self.yz):
            out_y, out_z = out_y + self.yz * z, out_z + self.yz * y
        return out_x, out_y, out_z


class Surface(ABC):
    """One sheet of a surface in the eye frame.

    The local frame is placed by p_eye = rotation p_local + origin_mm, (..., 3, 3) and (..., 3).
    """

    __slots__ = ()

    origin_mm: Floats
    rotation: Floats
    kind: ClassVar[str]
    """Kind of the surface: 'quadric', 'biconic', 'zernike' or 'grid'."""

    def __post_init__(self) -> None:
        for name, value in zip(_names(type(self)), self._parts(), strict=True):
            object.__setattr__(self, name, read_only(value))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch: () for one surface, (n,) for one surface per eye."""
        return self.origin_mm.shape[:-1]

    # -- one array per coordinate -------------------------------------------------------------------------------------

    @abstractmethod
    def hit(self, origin: Xyz, direction: Xyz, inward: bool) -> Hit:
        """Intersect rays of unit `direction` with the sheet, going in (d.g < 0) or out (d.g > 0)."""

    @abstractmethod
    def value_at(self, point: Xyz) -> Floats:
        """Evaluate the implicit function F."""

    @abstractmethod
    def gradient_at(self, point: Xyz) -> Xyz:
        """Compute the half gradient g, not normalised."""

    @abstractmethod
    def hessian_at(self, point: Xyz) -> SymmetricMatrix:
        """Compute the derivative of the half gradient, H with dg = H dp."""

    @abstractmethod
    def local_sag(self, y: Floats, z: Floats) -> Floats:
        """Compute the depth x of the sheet over the local (y, z); NaN where the sheet does not reach."""

    def take(self, index: Indices | int | None) -> Self:
        """Select surfaces of the batch by `index`; a single surface is returned unchanged."""
        return type(self)(*(part[index] for part in self._parts())) if self.batch_shape else self

    @classmethod
    def stack(cls, surfaces: tuple[Self, ...]) -> Self:
        """Combine single surfaces of this kind into a batch."""
        return cls(*(stacked(parts) for parts in zip(*(s._parts() for s in surfaces), strict=True)))

    def placed(self, origin_mm: Floats, rotation: Floats) -> Self:
        """Move the surface to another origin and rotation."""
        return replace(self, origin_mm=origin_mm, rotation=rotation)  # type: ignore[type-var]

    def seen_from(self, origin_mm: Floats, rotation: Floats) -> Self:
        """Express the surface in another frame p', or in one per eye (n, ...), where p = rotation p' + origin_mm."""
        back = np.swapaxes(rotation, -1, -2)
        moved = (back @ (self.origin_mm - origin_mm)[..., None])[..., 0]
        shape, own = moved.shape[:-1], len(self.batch_shape)
        rest = [np.broadcast_to(part, (*shape, *np.shape(part)[own:])) for part in self._parts()[2:]]
        parts: tuple[Floats, ...] = (moved, back @ self.rotation, *rest)
        return type(self)(*parts)

    def scaled(self, centre_mm: Floats, factor: float) -> Self:
        """Multiply all distances from `centre_mm` (3,) by `factor` > 0."""
        origin = centre_mm + factor * (self.origin_mm - centre_mm)
        return replace(self, origin_mm=origin, **self._scaled_shape(factor))  # type: ignore[type-var]

    def mirrored(self) -> Self:
        """Mirror the surface, y -> -y, for the other eye."""
        placed = {"origin_mm": flip_y(self.origin_mm), "rotation": mirror_rotation(self.rotation)}
        return replace(self, **placed, **self._mirrored_shape())  # type: ignore[type-var]

    @abstractmethod
    def _scaled_shape(self, factor: float) -> dict[str, Floats]:
        """Scale the parameters of the shape for lengths multiplied by `factor`."""

    @abstractmethod
    def _mirrored_shape(self) -> dict[str, Floats]:
        """Mirror the parameters of the shape for y with the opposite sign."""

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and all(
            np.array_equal(a, b) for a, b in zip(self._key(), other._key(), strict=True)
        )

    def __hash__(self) -> int:
        return hash((type(self), *((a + 0.0).tobytes() for a in self._key())))

    def _parts(self) -> tuple[Any, ...]:
        """Return the arrays from which the surface is made."""
        return tuple([getattr(self, name) for name in _names(type(self))])

    def _key(self) -> tuple[Floats, ...]:
        """Return the arrays that define the surface, for comparison."""
        return self._parts()

    # -- points (..., 3) ----------------------------------------------------------------------------------------------

    def implicit(self, points: npt.ArrayLike) -> Floats:
        """Evaluate the implicit function F at points (..., 3); it is zero on the surface."""
        return self.value_at(components(points))

    def gradient(self, points: npt.ArrayLike) -> Floats:
        """Compute the full gradient of F at points (..., 3), twice the half gradient."""
        return 2.0 * join(self.gradient_at(components(points)))

    def normal(self, points: npt.ArrayLike) -> Floats:
        """Compute unit normals g/|g| at points (..., 3), pointing to the air side (+x of the local frame)."""
        gradient = join(self.gradient_at(components(points)))
        unit: Floats = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
        return unit

    def sag(self, y_mm: npt.ArrayLike, z_mm: npt.ArrayLike) -> Floats:
        """Compute the depth x (mm, local frame) of the sheet over local y and z; NaN where it does not reach."""
        return self.local_sag(np.asarray(y_mm, dtype=np.float64), np.asarray(z_mm, dtype=np.float64))

    def intersect(self, origins_mm: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[Floats, Bools]:
        """Compute the nearest crossing ahead of rays (..., 3) with unit directions.

        Returns:
            Distance (...,) in mm, infinite if the ray misses the surface, and whether there is a crossing (...,).
        """
        origin, direction = components(origins_mm), components(directions)
        hits = [self.hit(origin, direction, inward) for inward in (True, False)]
        distances = [np.where(hit.ok & (hit.distance > 0.0), hit.distance, np.inf) for hit in hits]
        nearest = np.minimum(distances[0], distances[1])
        return nearest, np.isfinite(nearest)

    def to_local(self, points: npt.ArrayLike) -> Floats:
        """Transform points (..., 3) from the eye frame to the local frame."""
        return join(turn_back(self.rotation, shift(components(points), self.origin_mm, -1.0)))

    def to_eye(self, points: npt.ArrayLike) -> Floats:
        """Transform points (..., 3) from the local frame to the eye frame."""
        return join(shift(turn(self.rotation, components(points)), self.origin_mm, 1.0))

    def axis_distance(self, point: Xyz) -> Floats:
        """Compute the distance (mm) of points from the local x axis."""
        local_x, local_y, local_z = shift(point, self.origin_mm, -1.0)
        axis_x, axis_y, axis_z = (fit(self.rotation[..., i, 0], point[0].ndim) for i in range(3))
        along = local_x * axis_x + local_y * axis_y + local_z * axis_z
        return np.asarray(np.sqrt(np.maximum(local_x**2 + local_y**2 + local_z**2 - along**2, 0.0)))


@cache
def _names(kind: type) -> tuple[str, ...]:
    """Return the names of the arrays from which surfaces of a kind are made."""
    return tuple(f.name for f in fields(kind) if f.init)


def components(points: npt.ArrayLike) -> Xyz:
    """Split points (..., 3) into three contiguous arrays."""
    array = np.asarray(points, dtype=np.float64)
    return np.array(array[..., 0]), np.array(array[..., 1]), np.array(array[..., 2])


def join(point: Xyz) -> Floats:
    """Join three arrays into points (..., 3)."""
    return np.stack(np.broadcast_arrays(*point), axis=-1)


def fit(value: Floats | float, ndim: int) -> Floats | float:
    """Reshape a parameter () or (n,) to broadcast with points that have `ndim` axes, the batch axis first."""
    if isinstance(value, float | int):
        return float(value)
    if value.ndim == 0:
        return float(value)
    return value.reshape(value.shape + (1,) * (ndim - value.ndim))


def shift(point: Xyz, offset: Floats, sign: float) -> Xyz:
    """Add sign * offset to points; offset is (3,) or (n, 3)."""
    ndim = point[0].ndim
    return (
        point[0] + sign * fit(offset[..., 0], ndim),
        point[1] + sign * fit(offset[..., 1], ndim),
        point[2] + sign * fit(offset[..., 2], ndim),
    )


def turn(rotation: Floats, vector: Xyz) -> Xyz:
    """Rotate vectors by a rotation (3, 3) or (n, 3, 3)."""
    ndim = vector[0].ndim
    rows = [[fit(rotation[..., i, j], ndim) for j in range(3)] for i in range(3)]
    x, y, z = vector
    return (
        rows[0][0] * x + rows[0][1] * y + rows[0][2] * z,
        rows[1][0] * x + rows[1][1] * y + rows[1][2] * z,
        rows[2][0] * x + rows[2][1] * y + rows[2][2] * z,
    )


def turn_back(rotation: Floats, vector: Xyz) -> Xyz:
    """Rotate vectors by the transpose of a rotation (3, 3) or (n, 3, 3)."""
    return turn(np.swapaxes(rotation, -1, -2), vector)


def _is_zero(value: Floats | float) -> bool:
    return isinstance(value, float) and value == 0.0
