"""Measured corneas: a Zernike expansion on a conic, or a grid of heights, continued outside the measured zone.

Inside, the surface is the measured one, M. Outside it is the outer biconic B, rotated about its axis and added to a
plane that may be tilted. Between the squared radii q_i and q_o of the window the height is

    h = B + w (M - B),  w = 1 - s^3 (10 - 15 s + 6 s^2),  s = (y^2 + z^2 - q_i) / (q_o - q_i)

w has continuous second derivatives, so the curvature is continuous everywhere.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from ..base.arrays import FloatLike, Floats, Indices
from .biconic_kernels import Jet, Slopes, biconic_jet, biconic_slopes
from .surfaces import fit
from .surfaces_graph import GraphSurface
from .transforms import read_only, stacked
from .zernike import mirrored, order_of, product_basis, products

Parts = tuple[Floats, ...]
"""A height, its slopes by y and z, and perhaps its derivatives by yy, yz and zz."""


class Measured(GraphSurface):
    """A measured surface inside a biconic.

    Attributes:
        outer: (..., 8) the outer biconic: R_u, R_v, Q_u, Q_v, the angle of u from y (rad), the height at the axis (mm),
            and the slopes along y and z of the plane on which it stands.
        window_mm: (..., 2) radii at which the transition begins and ends.
    """

    __slots__ = ()

    outer: Floats
    window_mm: Floats

    @abstractmethod
    def measured(self, y: Floats, z: Floats, second: bool, outer: Parts | None = None) -> Parts:
        """Compute height, slopes and (if `second`) second derivatives of the measured surface, as in a `Jet`.

        Args:
            y: positions inside the end of the transition.
            z: positions, of the same shape.
            second: whether to compute second derivatives.
            outer: the same numbers of the outer biconic, if known.
        """

    def slopes(self, y: Floats, z: Floats) -> Slopes:
        """Compute height and slopes over the local (y, z)."""
        y, z = np.broadcast_arrays(y, z)
        share, width = self._share(y, z)
        if not (share > 0.0).any():
            x, slope_y, slope_z = self.measured(y, z, False)
            return Slopes(x, slope_y, slope_z, np.ones(share.shape, dtype=bool))
        outer = self.outer_slopes(y, z)
        if (share >= 1.0).all():
            return outer
        d, dy, dz = self._difference(y, z, share, outer[:3], False)
        w, w1, _ = _window(share, width)
        lever = 2.0 * w1 * d
        return Slopes(outer.x + w * d, outer.y + w * dy + lever * y, outer.z + w * dz + lever * z, outer.inside)

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Compute height, slopes and second derivatives over the local (y, z)."""
        y, z = np.broadcast_arrays(y, z)
        share, width = self._share(y, z)
        if not (share > 0.0).any():
            return Jet(*self.measured(y, z, True))
        outer = self.outer_jet(y, z)
        if (share >= 1.0).all():
            return outer
        d, dy, dz, dyy, dyz, dzz = self._difference(y, z, share, outer, True)
        w, w1, w2 = _window(share, width)
        lever, bend = 2.0 * w1 * d, 4.0 * w2 * d
        return Jet(
            outer.x + w * d,
            outer.y + w * dy + lever * y,
            outer.z + w * dz + lever * z,
            outer.yy + w * dyy + 4.0 * w1 * y * dy + lever + bend * y * y,
            outer.yz + w * dyz + 2.0 * w1 * (y * dz + z * dy) + bend * y * z,
            outer.zz + w * dzz + 4.0 * w1 * z * dz + lever + bend * z * z,
        )

    def outer_slopes(self, y: Floats, z: Floats) -> Slopes:
        """Compute height and slopes of the outer biconic."""
        constants, (c, s, x, ly, lz) = self._outer_constants(y.ndim)
        h = biconic_slopes(constants, c * y + s * z, c * z - s * y)
        return Slopes(h.x + x + ly * y + lz * z, c * h.y - s * h.z + ly, s * h.y + c * h.z + lz, h.inside)

    def outer_jet(self, y: Floats, z: Floats) -> Jet:
        """Compute height, slopes and second derivatives of the outer biconic."""
        constants, (c, s, x, ly, lz) = self._outer_constants(y.ndim)
        h = biconic_jet(constants, c * y + s * z, c * z - s * y)
        return Jet(
            h.x + x + ly * y + lz * z,
            c * h.y - s * h.z + ly,
            s * h.y + c * h.z + lz,
            c * c * h.yy - 2.0 * c * s * h.yz + s * s * h.zz,
            c * s * (h.yy - h.zz) + (c * c - s * s) * h.yz,
            s * s * h.yy + 2.0 * c * s * h.yz + c * c * h.zz,
        )

    def likeness(self) -> tuple[Floats, Floats]:
        """Return curvature (1/mm) and 1 + Q of a similar conic: the means over the outer biconic's meridians."""
        return np.mean(1.0 / self.outer[..., :2], axis=-1), 1.0 + np.mean(self.outer[..., 2:4], axis=-1)

    def _share(self, y: Floats, z: Floats) -> tuple[Floats, FloatLike]:
        """Compute the position in the transition, 0 where it begins and 1 where it ends, and the width q_o - q_i."""
        begin, end = (fit(self.window_mm[..., k], y.ndim) for k in (0, 1))
        width = end * end - begin * begin
        return np.asarray((y * y + z * z - begin * begin) / width), width

    def _difference(self, y: Floats, z: Floats, share: Floats, outer: Parts, second: bool) -> Parts:
        """Compute M - B and its derivatives; 0 beyond the window, where the measured shape may be huge."""
        beyond = share >= 1.0
        y, z = np.where(beyond, 0.0, y), np.where(beyond, 0.0, z)
        inner = self.measured(y, z, second, outer)
        return tuple(np.where(beyond, 0.0, m - b) for m, b in zip(inner, outer, strict=True))

    def _outer_constants(self, ndim: int) -> tuple[tuple[FloatLike, ...], tuple[FloatLike, ...]]:
        curvature = 1.0 / self.outer[..., :2]
        shape = (1.0 + self.outer[..., 2:4]) * curvature**2
        constants = (curvature[..., 0], curvature[..., 1], shape[..., 0], shape[..., 1])
        angle = self.outer[..., 4]
        placed = (np.cos(angle), np.sin(angle), *(self.outer[..., k] for k in (5, 6, 7)))
        return tuple(fit(v, ndim) for v in constants), tuple(fit(v, ndim) for v in placed)


def _window(share: Floats, width: FloatLike) -> tuple[Floats, Floats, Floats]:
    """Compute the weight w over its share s, and its first and second derivatives by the squared radius."""
    s = np.clip(share, 0.0, 1.0)
    rest = 1.0 - s
    w = rest**3 * (1.0 + s * (3.0 + 6.0 * s))
    w1 = -30.0 * (s * rest) ** 2 / width
    w2 = -60.0 * s * rest * (1.0 - 2.0 * s) / (width * width)
    return w, w1, w2


@dataclass(frozen=True, slots=True, eq=False)
class ZernikeSurface(Measured):
    """x = conic(y, z) - sum_j c_j Z_j(y / r, z / r), shifted so that x = 0 on the axis (see `zernike`).

    Attributes:
        origin_mm: (..., 3) point on the axis, in the eye frame.
        rotation: (..., 3, 3) local to eye frame.
        base: (..., 2) curvature 1/R (1/mm) and conic constant Q of the conic; curvature 0 is a plane.
        radius_mm: (...,) r, the radius of the disc on which the terms are orthonormal.
        coefficients_mm: (..., k) c_j, depths towards -x, of all terms up to a radial order.
        outer: see `Measured`.
        window_mm: see `Measured`.
        table: (..., 6, k) coefficients of Chebyshev products, for the height and its derivatives; computed if empty.
    """

    origin_mm: Floats
    rotation: Floats
    base: Floats
    radius_mm: Floats
    coefficients_mm: Floats
    outer: Floats
    window_mm: Floats
    table: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    _untilted: bool = field(init=False, repr=False)

    kind: ClassVar[str] = "zernike"

    def __post_init__(self) -> None:
        GraphSurface.__post_init__(self)
        if not self.table.size:
            order = self.order
            table = -np.einsum("dkj,...j->...dk", products(order), self.coefficients_mm, optimize=True)
            table /= self.radius_mm[..., None, None] ** np.array([0, 1, 1, 2, 2, 2])[:, None]
            # The constant term makes the height 0 on the axis.
            table[..., 0, 0] -= table[..., 0, :] @ product_basis(order, np.zeros(()), np.zeros(()), 0)
            object.__setattr__(self, "table", read_only(table))

    @property
    def order(self) -> int:
        """Radial order of the expansion."""
        return order_of(self.coefficients_mm.shape[-1])

    def measured(self, y: Floats, z: Floats, second: bool, outer: Parts | None = None) -> Parts:
        """Compute the height of the expansion and its derivatives (see `Measured`)."""
        count = 6 if second else 3
        radius = fit(self.radius_mm, y.ndim)
        p, q = y / radius, z / radius
        # A small matrix product for each row: large products would be spread over cores, which costs more than it
        # saves.
        batch = min(max(p.ndim - 1, len(self.batch_shape)), 1)
        basis = product_basis(self.order, p, q, batch)
        flat = basis.reshape(*basis.shape[: batch + 1], -1)
        found = (self.table[..., :count, :] @ flat).reshape(*p.shape[:batch], count, *p.shape[batch:])
        parts = tuple(np.moveaxis(found, batch, 0))
        if not self.base[..., 0].any():
            return parts
        curvature = self.base[..., 0]
        c, k = (fit(v, y.ndim) for v in (curvature, (1.0 + self.base[..., 1]) * curvature**2))
        conic = biconic_jet((c, c, k, k), y, z) if second else biconic_slopes((c, c, k, k), y, z)
        return tuple(a + b for a, b in zip(parts, conic[:count], strict=True))

    def _scaled_shape(self, factor: float) -> dict[str, Floats]:
        return {
            "base": self.base * np.array([1.0 / factor, 1.0]),
            "radius_mm": factor * self.radius_mm,
            "coefficients_mm": factor * self.coefficients_mm,
            "outer": _scaled_outer(self.outer, factor),
            "window_mm": factor * self.window_mm,
            "table": np.zeros(0),
        }

    def _mirrored_shape(self) -> dict[str, Floats]:
        coefficients = mirrored(self.coefficients_mm)
        return {"coefficients_mm": coefficients, "outer": _mirrored_outer(self.outer), "table": np.zeros(0)}

    def _key(self) -> tuple[Floats, ...]:
        return self._parts()[:-1]

    @classmethod
    def stack(cls, surfaces: tuple[Self, ...]) -> Self:
        """Combine single expansions into a batch; shorter ones are padded with zeros."""
        counts = {surface.coefficients_mm.shape[-1] for surface in surfaces}
        if len(counts) > 1:
            surfaces = tuple(surface.with_terms(max(counts)) for surface in surfaces)
        return cls(*(stacked(parts) for parts in zip(*(s._parts() for s in surfaces), strict=True)))

    def with_terms(self, count: int) -> Self:
        """Pad the expansion with coefficients of 0 up to `count` terms."""
        missing = count - self.coefficients_mm.shape[-1]
        return replace(self, coefficients_mm=np.pad(self.coefficients_mm, (0, missing)), table=np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class GridSurface(Measured):
    """x = outer biconic + sum_ij c_ij b(u - i) b(v - j), b the cubic B-spline: a bicubic surface on a biconic.

    u and v count the spacings from the first coefficient. A batch keeps the grids of its eyes in one table.

    Attributes:
        origin_mm: (..., 3) origin of the local frame, in the eye frame.
        rotation: (..., 3, 3) local to eye frame.
        outer: see `Measured`.
        window_mm: see `Measured`.
        centre_mm: (..., 2) position (y, z) of the middle of the grid.
        spacing_mm: (...,) spacing of the grid.
        row: (...,) the surface's grid in the table.
        table: (e, n, n) coefficients c_ij (mm) of e grids, i along y and j along z; n is odd.
    """

    origin_mm: Floats
    rotation: Floats
    outer: Floats
    window_mm: Floats
    centre_mm: Floats
    spacing_mm: Floats
    row: Indices
    table: Floats
    _untilted: bool = field(init=False, repr=False)

    kind: ClassVar[str] = "grid"

    def __post_init__(self) -> None:
        GraphSurface.__post_init__(self)
        object.__setattr__(self, "row", np.asarray(self.row, dtype=np.intp))

    @property
    def coefficients_mm(self) -> Floats:
        """Coefficients c_ij, (..., n, n)."""
        return np.asarray(self.table[self.row])

    def measured(self, y: Floats, z: Floats, second: bool, outer: Parts | None = None) -> Parts:
        """Compute the height of the bicubic surface on the outer biconic and its derivatives (see `Measured`)."""
        if outer is None:
            outer = self.outer_jet(y, z) if second else self.outer_slopes(y, z)[:3]
        size = self.table.shape[-1]
        spacing = fit(self.spacing_mm, y.ndim)
        places = []
        for k, place in ((0, y), (1, z)):
            u = (place - fit(self.centre_mm[..., k], y.ndim)) / spacing + 0.5 * (size - 1)
            first = np.clip(np.floor(np.nan_to_num(u)), 1.0, size - 3.0)
            places.append((first.astype(np.intp) - 1, splines(u - first, spacing, second)))
        (i, along_y), (j, along_z) = places
        row = self.row.reshape(self.row.shape + (1,) * (y.ndim - self.row.ndim)) if self.row.ndim else self.row
        corner = (row * size + i) * size + j
        step = np.arange(4)
        near = self.table.reshape(-1)[corner[..., None, None] + (size * step[:, None] + step)]
        # rows: sums along z of value, slope and bend; then along y.
        sums = [np.einsum("...ij,...j->...i", near, w) for w in along_z]
        wanted = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))[: 6 if second else 3]
        return tuple(
            b + np.einsum("...i,...i->...", along_y[p], sums[q]) for b, (p, q) in zip(outer, wanted, strict=True)
        )

    def take(self, index: Indices) -> Self:
        """Select surfaces of the batch by `index`, with the same table; a single surface is returned unchanged."""
        *parts, table = self._parts()
        return type(self)(*(*(part[index] for part in parts), table)) if self.batch_shape else self

    def with_outer(self, outer: Floats) -> Self:
        """Replace the outer biconic, keeping the bicubic heights."""
        return replace(self, outer=outer)

    def _scaled_shape(self, factor: float) -> dict[str, Floats]:
        return {
            "outer": _scaled_outer(self.outer, factor),
            "window_mm": factor * self.window_mm,
            "centre_mm": factor * self.centre_mm,
            "spacing_mm": factor * self.spacing_mm,
            "table": factor * self.table,
        }

    def _mirrored_shape(self) -> dict[str, Floats]:
        centre = self.centre_mm * np.array([-1.0, 1.0])
        return {"outer": _mirrored_outer(self.outer), "centre_mm": centre, "table": self.table[:, ::-1]}

    def _key(self) -> tuple[Floats, ...]:
        return (*self._parts()[:-2], self.coefficients_mm)

    @classmethod
    def stack(cls, surfaces: tuple[Self, ...]) -> Self:
        """Combine single grids into a batch; smaller ones are padded with zeros on all sides."""
        size = max(surface.table.shape[-1] for surface in surfaces)
        table = np.zeros((len(surfaces), size, size))
        for whole, surface in zip(table, surfaces, strict=True):
            pad = (size - surface.table.shape[-1]) // 2
            whole[pad : pad + surface.table.shape[-1], pad : pad + surface.table.shape[-1]] = surface.coefficients_mm
        parts = zip(*(surface._parts()[:-2] for surface in surfaces), strict=True)
        o, r, outer, window, centre, spacing = (stacked(part) for part in parts)
        return cls(
            origin_mm=o,
            rotation=r,
            outer=outer,
            window_mm=window,
            centre_mm=centre,
            spacing_mm=spacing,
            row=np.arange(len(surfaces)),
            table=table,
        )


def splines(share: Floats, spacing: FloatLike, second: bool) -> tuple[Floats, ...]:
    """Evaluate the four cubic B-splines over a knot interval, (..., 4), with first and (on request) second derivatives.

    Args:
        share: position in the interval, from 0 to 1; outside, the cubics are continued.
        spacing: length of the interval, mm.
        second: whether to compute second derivatives.
    """
    t, r = share, 1.0 - share
    h = np.asarray(spacing)
    value = np.stack([r**3, 4.0 - 3.0 * t * t * (1.0 + r), 4.0 - 3.0 * r * r * (1.0 + t), t**3], axis=-1) / 6.0
    slope = np.stack([-r * r, t * (3.0 * t - 4.0), r * (4.0 - 3.0 * r), t * t], axis=-1) / (2.0 * h[..., None])
    if not second:
        return value, slope
    bend = np.stack([r, 3.0 * t - 2.0, 1.0 - 3.0 * t, t], axis=-1) / (h * h)[..., None]
    return value, slope, bend


def _scaled_outer(outer: Floats, factor: float) -> Floats:
    return np.asarray(outer * np.array([factor, factor, 1.0, 1.0, 1.0, factor, 1.0, 1.0]))


def _mirrored_outer(outer: Floats) -> Floats:
    return np.asarray(outer * np.array([1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0]))
