"""The biconic: two apex radii and two conic constants, one pair per meridian."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np

from ..arrays import Bools, Floats, Indices
from .surfaces import Hit, Surface, SymmetricMatrix, Xyz, fit, shift, turn, turn_back
from .transforms import flip_y, mirror_rotation, read_only


class _Sag(NamedTuple):
    """Sag x(y, z) of the sheet, its first and second derivatives, and where the square root is real (`inside`)."""

    x: Floats
    y: Floats
    z: Floats
    yy: Floats
    yz: Floats
    zz: Floats
    inside: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Biconic(Surface):
    """Biconic surface with its apex at the local origin.

    x = -(c_y y^2 + c_z z^2) / (1 + sqrt(1 - (1 + Q_y) c_y^2 y^2 - (1 + Q_z) c_z^2 z^2)), c = 1/R
    (Smith & Atchison 1997, "The eye and visual optical instruments", biconic surface.)

    F = 2 (x - x(y, z)), so that the half gradient is (1, -dx/dy, -dx/dz).

    Attributes:
        origin_mm: (..., 3) apex in the eye frame.
        rotation: (..., 3, 3) local to eye frame.
        radii_mm: (..., 2) apex radii (R_y, R_z); positive ones open to -x, negative ones to +x.
        conic_constants: (..., 2) conic constants (Q_y, Q_z).
    """

    origin_mm: Floats
    rotation: Floats
    radii_mm: Floats
    conic_constants: Floats
    _untilted: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("origin_mm", "rotation", "radii_mm", "conic_constants"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "_untilted", bool(np.all(self.rotation == np.eye(3))))

    @property
    def kind(self) -> str:
        """The word 'biconic'."""
        return "biconic"

    def hit(self, origin: Xyz, direction: Xyz, inward: bool) -> Hit:
        """Solve x - x(y, z) = 0 along the ray by Newton, from the hit on the conic of mean curvature and mean 1 + Q.

        The gradient's local x component is 1 everywhere, so the sheet is the whole graph.
        """
        ox, oy, oz = self._local_point(origin)
        dx, dy, dz = self._local_vector(direction)
        ndim = max(ox.ndim, dx.ndim)
        curvature = fit(np.mean(1.0 / self.radii_mm, axis=-1), ndim)
        shape = fit(1.0 + np.mean(self.conic_constants, axis=-1), ndim)
        # The osculating conic times its curvature: c (y^2 + z^2) + 2 x + c p x^2 = 0, half gradient towards +x.
        gx = 1.0 + curvature * shape * ox
        a = curvature * (1.0 + (shape - 1.0) * (dx * dx))
        b = gx * dx + curvature * (oy * dy + oz * dz)
        value = (gx + 1.0) * ox + curvature * (oy * oy + oz * oz)
        square = b * b - a * value
        root = np.sqrt(np.maximum(square, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            t = value / (root - b) if inward else value / (-root - b)
            ok = np.asarray((square >= 0.0) & np.isfinite(t))
            t = np.where(ok, t, 0.0)
            error = np.full_like(t, np.inf)
            for _ in range(_STEPS):
                sag = self._first_order(oy + t * dy, oz + t * dz)
                error = ox + t * dx - sag[0]
                t = t - error / (dx - sag[1] * dy - sag[2] * dz)
                if not np.max(np.abs(error), where=ok & np.isfinite(error), initial=0.0) > _SETTLED_MM:
                    break
            y, z = oy + t * dy, oz + t * dz
            _, slope_y, slope_z, inside = self._first_order(y, z)
            # Newton converges quadratically: an error of 1e-7 before the last step leaves less than 1e-14 after it.
            ok &= (np.abs(error) < _SETTLED_MM) & inside & np.isfinite(t)
            crossing = dx - slope_y * dy - slope_z * dz
            ok &= crossing < 0.0 if inward else crossing > 0.0
        point = (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
        return Hit(t, point, self._to_eye((np.ones_like(slope_y), -slope_y, -slope_z)), ok)

    def value_at(self, point: Xyz) -> Floats:
        """Implicit function F = 2 (x - x(y, z))."""
        x, y, z = self._local_point(point)
        return 2.0 * (x - self._first_order(y, z)[0])

    def gradient_at(self, point: Xyz) -> Xyz:
        """Half gradient (1, -dx/dy, -dx/dz) of the local frame, rotated to the eye frame."""
        _, y, z = self._local_point(point)
        _, slope_y, slope_z, _ = self._first_order(y, z)
        return self._to_eye((np.ones_like(slope_y), -slope_y, -slope_z))

    def hessian_at(self, point: Xyz) -> SymmetricMatrix:
        """Derivative of the half gradient, H with dg = H dp."""
        _, y, z = self._local_point(point)
        sag = self.sag_derivatives(y, z)
        if self._untilted:
            return SymmetricMatrix(0.0, -sag.yy, -sag.zz, 0.0, 0.0, -sag.yz)
        r = [[fit(self.rotation[..., i, j], y.ndim) for j in range(3)] for i in range(3)]

        def entry(i: int, j: int) -> Floats:
            cross = r[i][1] * r[j][2] + r[i][2] * r[j][1]
            return np.asarray(-(r[i][1] * r[j][1] * sag.yy + r[i][2] * r[j][2] * sag.zz + cross * sag.yz))

        return SymmetricMatrix(entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2))

    def local_sag(self, y: Floats, z: Floats) -> Floats:
        """Depth x of the sheet in the local frame over the local (y, z); NaN where the square root is not real."""
        x, _, _, inside = self._first_order(y, z)
        return np.asarray(np.where(inside, x, np.nan))

    def sag_derivatives(self, y: Floats, z: Floats) -> _Sag:
        """Sag x(y, z) in the local frame with its first and second derivatives.

        With N = c_y y^2 + c_z z^2 and W the square root, x = -N / (1 + W).
        """
        cy, cz, ky, kz = self._constants(max(y.ndim, z.ndim))
        square = 1.0 - ky * y * y - kz * z * z
        inside = np.asarray(square > 0.0)
        w = np.sqrt(np.where(inside, square, 1.0))
        d = 1.0 / (1.0 + w)
        x = -(cy * y * y + cz * z * z) * d
        wy, wz = -ky * y / w, -kz * z / w
        xy = -d * (2.0 * cy * y + x * wy)
        xz = -d * (2.0 * cz * z + x * wz)
        # x (1 + W) = -N differentiated twice.
        wyy, wzz, wyz = -(ky + wy * wy) / w, -(kz + wz * wz) / w, -wy * wz / w
        xyy = -d * (2.0 * cy + 2.0 * xy * wy + x * wyy)
        xzz = -d * (2.0 * cz + 2.0 * xz * wz + x * wzz)
        xyz = -d * (xy * wz + xz * wy + x * wyz)
        return _Sag(x, xy, xz, xyy, xyz, xzz, inside)

    def take(self, index: Indices) -> Self:
        """Surfaces of the batch at `index`; a single surface is returned as it is."""
        if not self.batch_shape:
            return self
        return type(self)(*(part[index] for part in self._key()))

    def scaled(self, centre_mm: Floats, factor: float) -> Self:
        """Multiply all distances from `centre_mm` (3,) by `factor` > 0; conic constants stay."""
        origin = centre_mm + factor * (self.origin_mm - centre_mm)
        return type(self)(origin, self.rotation, factor * self.radii_mm, self.conic_constants)

    def mirrored(self) -> Self:
        # The sag is even in y, so only the placement is mirrored.
        """Mirror the surface, y -> -y."""
        return type(self)(flip_y(self.origin_mm), mirror_rotation(self.rotation), self.radii_mm, self.conic_constants)

    def _key(self) -> tuple[Floats, ...]:
        return self.origin_mm, self.rotation, self.radii_mm, self.conic_constants

    @classmethod
    def stack(cls, surfaces: tuple[Self, ...]) -> Self:
        """Combine single biconics into a batch."""
        return cls(*(np.stack(parts) for parts in zip(*(s._key() for s in surfaces), strict=True)))

    def _constants(self, ndim: int) -> tuple[Floats | float, ...]:
        curvature = 1.0 / self.radii_mm
        shape = (1.0 + self.conic_constants) * curvature**2
        parts = (curvature[..., 0], curvature[..., 1], shape[..., 0], shape[..., 1])
        return tuple(fit(part, ndim) for part in parts)

    def _first_order(self, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats, Bools]:
        cy, cz, ky, kz = self._constants(max(y.ndim, z.ndim))
        y_square, z_square = y * y, z * z
        square = 1.0 - ky * y_square - kz * z_square
        inside = np.asarray(square > 0.0)
        w = np.sqrt(np.where(inside, square, 1.0))
        d = 1.0 / (1.0 + w)
        x = -(cy * y_square + cz * z_square) * d
        lever = x / w
        return x, -d * y * (2.0 * cy - ky * lever), -d * z * (2.0 * cz - kz * lever), inside

    def _local_point(self, point: Xyz) -> Xyz:
        return self._local_vector(shift(point, self.origin_mm, -1.0))

    def _local_vector(self, vector: Xyz) -> Xyz:
        return vector if self._untilted else turn_back(self.rotation, vector)

    def _to_eye(self, vector: Xyz) -> Xyz:
        return vector if self._untilted else turn(self.rotation, vector)


_STEPS = 12
_SETTLED_MM = 1e-7
