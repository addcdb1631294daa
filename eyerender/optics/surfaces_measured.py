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

from ..base.arrays import Floats, Indices
from .graph_kernels import GRID, ZERNIKE, Sheets
from .sheets import write_biconic
from .surfaces_graph import GraphSurface
from .transforms import read_only, stacked
from .zernike import at_middle, mirrored, order_of, products, terms

_FAR_MM = 1e6


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
