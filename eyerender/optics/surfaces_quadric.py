"""Quadrics: sphere, conic, ellipsoid, plane, and any other surface of second order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ..base.arrays import Bools, Floats
from .surfaces import Hit, Surface, SymmetricMatrix, Xyz, fit
from .transforms import MIRROR, flip_y, read_only


@dataclass(frozen=True, slots=True, eq=False)
class Quadric(Surface):
    """F(p) = p^T A p + 2 b.p + c = 0 in the local frame, on the sheet where g_x = (A p + b)_x > 0."""

    origin_mm: Floats  # (..., 3) origin of the local frame in the eye frame
    rotation: Floats  # (..., 3, 3) local to eye frame
    matrix: Floats  # (..., 3, 3) A, symmetric
    vector: Floats  # (..., 3) b, mm
    constant: Floats  # (...,) c, mm^2
    _eye: tuple[Floats | float, ...] = field(init=False, repr=False)
    _axial: bool = field(init=False, repr=False)

    kind: ClassVar[str] = "quadric"

    def __post_init__(self) -> None:
        Surface.__post_init__(self)
        turned = self.rotation @ self.matrix @ np.swapaxes(self.rotation, -1, -2)
        turned_vector = np.einsum("...ij,...j->...i", self.rotation, self.vector)
        pulled = np.einsum("...ij,...j->...i", turned, self.origin_mm)
        vector = turned_vector - pulled
        constant = self.constant + np.sum(self.origin_mm * (pulled - 2.0 * turned_vector), axis=-1)
        entries = [turned[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        entries += [vector[..., i] for i in range(3)] + [constant]
        values = tuple(float(e) if np.ndim(e) == 0 else read_only(e) for e in entries)
        object.__setattr__(self, "_eye", values)
        off_axis = (*values[3:6], values[7], values[8])
        axial = all(np.all(np.asarray(v) == 0.0) for v in off_axis) and bool(np.all(values[1] == values[2]))
        object.__setattr__(self, "_axial", axial and bool(np.all(np.asarray(values[1]) == 1.0)))

    @classmethod
    def conic(
        cls,
        radius_mm: npt.ArrayLike,
        conic_constant: npt.ArrayLike = 0.0,
        origin_mm: npt.ArrayLike = (0.0, 0.0, 0.0),
        rotation: npt.ArrayLike | None = None,
    ) -> Quadric:
        """Create the conic y^2 + z^2 + 2 R x + (1 + Q) x^2 = 0 with its apex at the origin; R > 0 opens to -x."""
        radius = np.asarray(radius_mm, dtype=np.float64)
        shape = np.broadcast_shapes(radius.shape, np.shape(conic_constant), np.shape(origin_mm)[:-1])
        sign = np.broadcast_to(np.sign(radius), shape)
        matrix = np.zeros((*shape, 3, 3))
        matrix[..., 0, 0] = 1.0 + np.asarray(conic_constant)
        matrix[..., 1, 1] = matrix[..., 2, 2] = 1.0
        vector = np.zeros((*shape, 3))
        vector[..., 0] = radius
        return cls.oriented(matrix, vector, np.zeros(shape), sign, origin_mm, rotation)

    @classmethod
    def ellipsoid(
        cls,
        semi_axes_mm: npt.ArrayLike,
        centre_mm: npt.ArrayLike,
        rotation: npt.ArrayLike | None = None,
        front: bool = True,
    ) -> Quadric:
        """Create half of (x/a)^2 + (y/b)^2 + (z/c)^2 = 1 about `centre_mm`, towards +x (`front`) or -x."""
        axes = np.asarray(semi_axes_mm, dtype=np.float64)
        matrix = np.zeros((*axes.shape[:-1], 3, 3))
        scale = axes[..., 1] * axes[..., 2]
        for i in range(3):
            matrix[..., i, i] = scale / axes[..., i] ** 2
        return cls.oriented(matrix, np.zeros(axes.shape), -scale, 1.0 if front else -1.0, centre_mm, rotation)

    @classmethod
    def plane(cls, origin_mm: npt.ArrayLike, rotation: npt.ArrayLike | None = None) -> Quadric:
        """Create the plane x = 0 of the local frame."""
        return cls.oriented(np.zeros((3, 3)), np.array([1.0, 0.0, 0.0]), np.array(0.0), 1.0, origin_mm, rotation)

    @classmethod
    def oriented(
        cls,
        matrix: npt.ArrayLike,
        vector: npt.ArrayLike,
        constant: npt.ArrayLike,
        sign: npt.ArrayLike = 1.0,
        origin_mm: npt.ArrayLike = (0.0, 0.0, 0.0),
        rotation: npt.ArrayLike | None = None,
    ) -> Quadric:
        """Create the sheet of F = 0 on which the half gradient of F has the sign `sign` along x."""
        factor = np.asarray(sign, dtype=np.float64)
        full = factor[..., None, None] * np.asarray(matrix)
        shape = full.shape[:-2]
        origin = np.broadcast_to(np.asarray(origin_mm, dtype=np.float64), (*shape, 3))
        frame = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
        return cls(
            origin,
            np.broadcast_to(frame, (*shape, 3, 3)),
            full,
            np.broadcast_to(factor[..., None] * np.asarray(vector), (*shape, 3)),
            np.broadcast_to(factor * np.asarray(constant), shape),
        )

    @classmethod
    def general(
        cls, coefficients: Sequence[float], front: bool, origin_mm: npt.ArrayLike, rotation: npt.ArrayLike
    ) -> Quadric:
        """Create A x^2 + B y^2 + C z^2 + 2 D xy + 2 E xz + 2 F yz + 2 G x + 2 H y + 2 I z + K = 0, one of its sheets.

        `coefficients` are A to K; `front` is the sheet where dF/dx > 0 with them, instead of < 0.
        """
        a, b, c, d, e, f, g, h, i, k = coefficients
        # The scale ties the size of rounding errors to distances, not to the unit of the coefficients.
        scale = max(abs(v) for v in (a, b, c, d, e, f)) or max(abs(v) for v in (g, h, i))
        if b == c and d == e == f == 0.0 and b != 0.0:
            scale = abs(b)
        matrix = np.array([[a, d, e], [d, b, f], [e, f, c]]) / scale
        sign = 1.0 if front else -1.0
        return cls.oriented(matrix, np.array([g, h, i]) / scale, np.array(k / scale), sign, origin_mm, rotation)

    def as_conic(self) -> tuple[Floats, Floats] | None:
        """Return radius and conic constant (...,) of a conic with its apex at the origin and R > 0; None for others."""
        m, v = self.matrix, self.vector
        square = m * (1.0 - np.eye(3))
        conic = np.all(m[..., 1, 1] == 1.0) and np.all(m[..., 2, 2] == 1.0) and not np.any(square)
        conic = conic and not np.any(self.constant) and not np.any(v[..., 1:]) and np.all(v[..., 0] > 0.0)
        return (np.asarray(v[..., 0]), np.asarray(m[..., 0, 0] - 1.0)) if conic else None

    @property
    def coefficients(self) -> tuple[Floats | float, ...]:
        """Return (A_xx, A_yy, A_zz, A_xy, A_xz, A_yz, b_x, b_y, b_z, c) in the eye frame; numbers or (n,) arrays."""
        return self._eye

    def about(self, point_mm: Floats) -> tuple[Floats | float, ...]:
        """Return the coefficients measured from a point (..., 3) of the eye frame, along the same axes."""
        xx, yy, zz, xy, xz, yz, *_ = self._eye
        x, y, z = np.moveaxis(self.origin_mm - point_mm, -1, 0)
        u, v, w = np.moveaxis(np.einsum("...ij,...j->...i", self.rotation, self.vector), -1, 0)
        pulled = (xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z)
        constant = self.constant + sum(a * (p - 2.0 * b) for a, p, b in zip((x, y, z), pulled, (u, v, w), strict=True))
        return (xx, yy, zz, xy, xz, yz, u - pulled[0], v - pulled[1], w - pulled[2], constant)

    def hit(self, origin: Xyz, direction: Xyz, inward: bool) -> Hit:
        """Solve (d.Ad) t^2 + 2 (d.g(o)) t + F(o) = 0 for the required sign of d.g, as F / (-b -+ sqrt(b^2 - aF))."""
        ox, oy, oz = origin
        dx, dy, dz = direction
        xx, yy, zz, xy, xz, yz, bx, by, bz, c = (fit(v, max(ox.ndim, dx.ndim)) for v in self._eye)
        if self._axial:
            a = 1.0 + (xx - 1.0) * (dx * dx)
            gx = xx * ox + bx
            b = gx * dx + oy * dy + oz * dz
            value = (gx + bx) * ox + oy * oy + oz * oz + c
        else:
            ux, uy, uz = SymmetricMatrix(xx, yy, zz, xy, xz, yz).times(direction)
            a = dx * ux + dy * uy + dz * uz
            gx, gy, gz = self.gradient_at(origin)
            b = gx * dx + gy * dy + gz * dz
            value = (gx + bx) * ox + (gy + by) * oy + (gz + bz) * oz + c
        square = b * b - a * value
        root = np.sqrt(np.maximum(square, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            t = value / (root - b) if inward else value / (-root - b)
            point = (ox + t * dx, oy + t * dy, oz + t * dz)
            gradient = self.gradient_at(point)
            ok = (square >= 0.0) & np.isfinite(t) & self.on_sheet(gradient)
        return Hit(t, point, gradient, ok)

    def on_sheet(self, gradient: Xyz) -> Bools:
        """Return whether a half gradient in the eye frame points to local +x."""
        if self._axial:
            return np.asarray(gradient[0] > 0.0)
        ndim = gradient[0].ndim
        ax, ay, az = (fit(self.rotation[..., i, 0], ndim) for i in range(3))
        return np.asarray(ax * gradient[0] + ay * gradient[1] + az * gradient[2] > 0.0)

    def value_at(self, point: Xyz) -> Floats:
        """Evaluate the implicit function F(p) = p^T A p + 2 b.p + c."""
        x, y, z = point
        gx, gy, gz = self.gradient_at(point)
        bx, by, bz, c = (fit(v, x.ndim) for v in self._eye[6:])
        return np.asarray((gx + bx) * x + (gy + by) * y + (gz + bz) * z + c)

    def gradient_at(self, point: Xyz) -> Xyz:
        """Compute the half gradient g = A p + b."""
        x, y, z = point
        if self._axial:
            return fit(self._eye[0], x.ndim) * x + fit(self._eye[6], x.ndim), y, z
        gx, gy, gz = self.hessian_at(point).times(point)
        bx, by, bz = (fit(v, x.ndim) for v in self._eye[6:9])
        return gx + bx, gy + by, gz + bz

    def hessian_at(self, point: Xyz) -> SymmetricMatrix:
        """Return the derivative of the half gradient, the matrix A in the eye frame."""
        return SymmetricMatrix(*(fit(v, point[0].ndim) for v in self._eye[:6]))

    def local_sag(self, y: Floats, z: Floats) -> Floats:
        """Solve A_xx x^2 + 2 (A_xy y + A_xz z + b_x) x + F(0, y, z) = 0 for x on the sheet."""
        m, v = self.matrix, self.vector
        ndim = max(y.ndim, z.ndim)
        xx, yy, zz, xy, xz, yz = (fit(m[..., i, j], ndim) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        bx, by, bz, c = (fit(e, ndim) for e in (v[..., 0], v[..., 1], v[..., 2], self.constant))
        half = xy * y + xz * z + bx
        rest = yy * y * y + zz * z * z + 2.0 * (yz * y * z + by * y + bz * z) + c
        square = half * half - xx * rest
        with np.errstate(invalid="ignore", divide="ignore"):
            root = np.sqrt(square)  # NaN where the sheet does not reach
            # x = (root - half) / xx, without cancellation near the apex and without dividing by a small xx
            stable = half >= 0.0
            return np.asarray(np.where(stable, -rest / np.where(stable, half + root, 1.0), (root - half) / xx))

    def _scaled_shape(self, factor: float) -> dict[str, Floats]:
        return {"vector": factor * self.vector, "constant": factor * factor * self.constant}

    def _mirrored_shape(self) -> dict[str, Floats]:
        return {"matrix": MIRROR @ self.matrix @ MIRROR, "vector": flip_y(self.vector)}
