"""Measured corneas: a Zernike expansion on a conic, or a grid of heights, continued outside the measured zone.

Inside, the surface is the measured one, M. Outside it is the outer biconic B, rotated about its axis and added to a
plane that may be tilted. Between the squared radii q_i and q_o of the window the height is

    h = B + w (M - B),  w = 1 - s^3 (10 - 15 s + 6 s^2),  s = (y^2 + z^2 - q_i) / (q_o - q_i)

w has continuous second derivatives, so the curvature is continuous everywhere.

Term j has the radial order n and the azimuthal order m, j = (n (n + 2) + m) / 2, and

    Z = sqrt((2 - delta_m0) (n + 1)) R_n^|m|(rho) cos(m theta), sin(|m| theta) for m < 0,
    R_n^m(rho) = (-1)^k rho^m P_k^(m, 0)(1 - 2 rho^2), k = (n - m) / 2, with Jacobi's polynomials P

(Thibos et al. 2002, "Standards for reporting the optical aberrations of eyes"; Abramowitz & Stegun 22.5). theta runs
from the first axis towards the second. A sum of terms is evaluated as a sum of products of Chebyshev polynomials T_i(p)
T_j(q): its coefficients are no larger than those of the Zernike terms, so no digits cancel, as they do in powers of p
and q. Derivatives are sums of the same products.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
from numpy.polynomial import chebyshev
from scipy.special import eval_jacobi

from ..base.arrays import Floats, Indices
from .graph_kernels import GRID, ZERNIKE, Sheets
from .sheets import write_biconic
from .surfaces_graph import GraphSurface
from .transforms import read_only, stacked

MAX_ORDER = 14


def terms(order: int) -> int:
    """Return the number of terms up to a radial order."""
    return (order + 1) * (order + 2) // 2


def order_of(count: int) -> int:
    """Return the smallest radial order with at least `count` terms."""
    order = 0
    while terms(order) < count:
        order += 1
    return order


def orders(order: int) -> list[tuple[int, int]]:
    """Return (n, m) of all terms up to a radial order, in the standard order."""
    return [(n, m) for n in range(order + 1) for m in range(-n, n + 1, 2)]


def zernike(order: int, p: Floats, q: Floats) -> Floats:
    """Evaluate all terms up to a radial order at points (p, q) of the unit disc, (terms, ...)."""
    square, angle = p * p + q * q, np.arctan2(q, p)
    rho = np.sqrt(square)
    out = np.empty((terms(order), *np.shape(square)))
    for j, (n, m) in enumerate(orders(order)):
        a = abs(m)
        k = (n - a) // 2
        radial = (-1.0) ** k * rho**a * eval_jacobi(k, a, 0, 1.0 - 2.0 * square)
        wave = np.cos(a * angle) if m >= 0 else np.sin(a * angle)
        out[j] = np.sqrt((n + 1.0) * (1.0 if m == 0 else 2.0)) * radial * wave
    return out


def mirrored(coefficients: Floats) -> Floats:
    """Mirror coefficients (..., k) of a sum in the second axis, p -> -p: theta becomes pi - theta."""
    signs = [(-1.0) ** m if m >= 0 else -((-1.0) ** m) for _, m in orders(order_of(coefficients.shape[-1]))]
    return np.asarray(coefficients * np.array(signs[: coefficients.shape[-1]]))


@lru_cache(maxsize=MAX_ORDER + 1)
def products(order: int) -> Floats:
    """Compute the matrices from Zernike coefficients to those of Chebyshev products, (6, terms, terms).

    The first axis holds the value and its derivatives by p, q, pp, pq and qq. A product T_i(p) T_j(q) has the index of
    the pair (i, j) in `pairs`.
    """
    count = order + 1
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    p, q = np.meshgrid(nodes, nodes, indexing="ij")
    # A polynomial of this order is the interpolant through its values at the Gauss-Chebyshev nodes.
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, order))
    values = np.einsum("ia,jb,kab->kij", inverse, inverse, zernike(order, p, q))
    rows, columns = np.array(pairs(order)).T

    def derived(times_p: int, times_q: int) -> Floats:
        part = chebyshev.chebder(values, times_p, axis=1) if times_p else values
        part = chebyshev.chebder(part, times_q, axis=2) if times_q else part
        whole = np.zeros_like(values)
        whole[:, : part.shape[1], : part.shape[2]] = part
        return np.asarray(whole[:, rows, columns].T)

    table = np.stack([derived(*by) for by in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))])
    table.setflags(write=False)
    return table


@lru_cache(maxsize=MAX_ORDER + 1)
def pairs(order: int) -> tuple[tuple[int, int], ...]:
    """Return the pairs (i, j) with i + j <= order."""
    return tuple((i, j) for i in range(order + 1) for j in range(order + 1 - i))


def at_middle(order: int) -> Floats:
    """Evaluate the products T_i(0) T_j(0) of `pairs`, (terms,)."""
    value = np.cos(0.5 * np.pi * np.arange(order + 1)).round()
    return np.array([value[i] * value[j] for i, j in pairs(order)])


def fitted(order: int, p: Floats, q: Floats, values: Floats) -> Floats:
    """Fit coefficients (terms,) to values (n,) at points (n,) by least squares."""
    return np.asarray(np.linalg.lstsq(zernike(order, p, q).T, values, rcond=None)[0], dtype=np.float64)


_FAR_MM = 1e6


class Measured(GraphSurface):
    """A measured surface inside a biconic."""

    __slots__ = ()

    # (..., 8) the outer biconic: R_u, R_v, Q_u, Q_v, the angle of u from y (rad), the height at the axis (mm), and the
    # slopes along y and z of the plane on which it stands
    outer: Floats
    window_mm: Floats  # (..., 2) radii at which the transition begins and ends

    def write(self, sheets: Sheets, table: list[Floats]) -> int:
        """Write the shape into records that hold its place, and its coefficients into the table."""
        outer, (begin, end) = self.outer, (self.window_mm[..., k] for k in (0, 1))
        c, s = sheets["cosine"], sheets["sine"]
        own_c, own_s = np.cos(outer[..., 4]), np.sin(outer[..., 4])
        write_biconic(sheets, outer[..., :2], outer[..., 2:4], c * own_c - s * own_s, s * own_c + c * own_s)
        place, (_, y, z) = sheets["place"], sheets["origin"].T
        place[:, 1], place[:, 2] = c * outer[..., 6] - s * outer[..., 7], s * outer[..., 6] + c * outer[..., 7]
        place[:, 0] += outer[..., 5] - place[:, 1] * y - place[:, 2] * z
        sheets["begin"], sheets["width"] = begin**2, end**2 - begin**2
        return self._write_inner(sheets, table)

    @abstractmethod
    def _write_inner(self, sheets: Sheets, table: list[Floats]) -> int:
        """Write the measured surface itself, and return its kind."""

    def measured(self, y: Floats, z: Floats) -> Floats:
        """Compute the height of the measured surface itself, also outside its window."""
        far = np.broadcast_to([_FAR_MM, 2.0 * _FAR_MM], self.window_mm.shape)
        return replace(self, window_mm=far).local_sag(y, z)  # type: ignore[type-var]

    def likeness(self) -> tuple[Floats, Floats]:
        """Return curvature (1/mm) and 1 + Q of a similar conic: the means over the outer biconic's meridians."""
        return np.mean(1.0 / self.outer[..., :2], axis=-1), 1.0 + np.mean(self.outer[..., 2:4], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class ZernikeSurface(Measured):
    """x = conic(y, z) - sum_j c_j Z_j(y / r, z / r), shifted so that x = 0 on the axis (see `zernike`)."""

    origin_mm: Floats  # (..., 3) point on the axis, in the eye frame
    rotation: Floats  # (..., 3, 3) local to eye frame
    base: Floats  # (..., 2) curvature 1/R (1/mm) and conic constant Q of the conic; curvature 0 is a plane
    radius_mm: Floats  # (...,) r, the radius of the disc on which the terms are orthonormal
    coefficients_mm: Floats  # (..., k) c_j, depths towards -x, of all terms up to a radial order
    outer: Floats  # see `Measured`
    window_mm: Floats  # see `Measured`
    # (..., 6, k) coefficients of Chebyshev products, for the height and its derivatives; computed if empty
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
            table[..., 0, 0] -= table[..., 0, :] @ at_middle(order)
            object.__setattr__(self, "table", read_only(table))

    @property
    def order(self) -> int:
        """Radial order of the expansion."""
        return order_of(self.coefficients_mm.shape[-1])

    def _write_inner(self, sheets: Sheets, table: list[Floats]) -> int:
        """Write the measured surface itself, and return its kind."""
        curvature, order = self.base[..., 0], self.order
        sheets["radius"], sheets["curvature"], sheets["size"] = self.radius_mm, curvature, order
        sheets["shape"] = (1.0 + self.base[..., 1]) * curvature**2
        sheets["start"] = sum(map(len, table)) + 6 * terms(order) * np.arange(len(sheets))
        table.append(self.table.ravel())
        return ZERNIKE

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
    """

    origin_mm: Floats  # (..., 3) origin of the local frame, in the eye frame
    rotation: Floats  # (..., 3, 3) local to eye frame
    outer: Floats  # see `Measured`
    window_mm: Floats  # see `Measured`
    centre_mm: Floats  # (..., 2) position (y, z) of the middle of the grid
    spacing_mm: Floats  # (...,) spacing of the grid
    row: Indices  # (...,) the surface's grid in the table
    table: Floats  # (e, n, n) coefficients c_ij (mm) of e grids, i along y and j along z; n is odd
    _untilted: bool = field(init=False, repr=False)

    kind: ClassVar[str] = "grid"

    def __post_init__(self) -> None:
        GraphSurface.__post_init__(self)
        object.__setattr__(self, "row", np.asarray(self.row, dtype=np.intp))

    @property
    def coefficients_mm(self) -> Floats:
        """Coefficients c_ij, (..., n, n)."""
        return np.asarray(self.table[self.row])

    def _write_inner(self, sheets: Sheets, table: list[Floats]) -> int:
        """Write the measured surface itself, and return its kind."""
        size = self.table.shape[-1]
        sheets["spacing"], sheets["middle"], sheets["size"] = self.spacing_mm, self.centre_mm, size
        sheets["start"] = sum(map(len, table)) + size * size * self.row
        table.append(self.table.ravel())
        return GRID

    def take(self, index: Indices | int | None) -> Self:
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


def _scaled_outer(outer: Floats, factor: float) -> Floats:
    return np.asarray(outer * np.array([factor, factor, 1.0, 1.0, 1.0, factor, 1.0, 1.0]))


def _mirrored_outer(outer: Floats) -> Floats:
    return np.asarray(outer * np.array([1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0]))
