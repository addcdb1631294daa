"""Surfaces as graphs x = h(y, z) over one plane, with first and second derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from ..arrays import FloatLike, Floats
from .surfaces import Surface, fit
from .surfaces_graph import GraphSurface, Jet
from .surfaces_quadric import Quadric


class Graph(Protocol):
    """A surface over the (y, z) plane of a working frame."""

    def height(self, y: Floats, z: Floats) -> Floats:
        """Height h(y, z)."""

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Height h with its first and second derivatives."""


class AxialGraph(NamedTuple):
    """y^2 + z^2 + p x^2 + 2 b x + c = 0 on the sheet where p x + b > 0; u = p x + b = sqrt(b^2 - p (y^2 + z^2 + c))."""

    p: FloatLike
    b: FloatLike
    c: FloatLike
    ndim: int

    def height(self, y: Floats, z: Floats) -> Floats:
        """Height h(y, z) = -r / (b + sqrt(b^2 - p r)), r = y^2 + z^2 + c."""
        b = fit(self.b, self.ndim)
        rest = y * y + z * z + fit(self.c, self.ndim)
        return np.asarray(-rest / (b + np.sqrt(b * b - fit(self.p, self.ndim) * rest)))

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Height h with its first and second derivatives."""
        p, b = fit(self.p, self.ndim), fit(self.b, self.ndim)
        rest = y * y + z * z + fit(self.c, self.ndim)
        u = np.sqrt(b * b - p * rest)
        x = rest / (-b - u)
        inverse = -1.0 / u
        hy, hz = y * inverse, z * inverse
        lean = p * inverse
        ty = lean * hy
        return Jet(x, hy, hz, ty * hy + inverse, ty * hz, lean * (hz * hz) + inverse)


class QuadricGraph(NamedTuple):
    """Any quadric: A_xx x^2 + 2 (A_xy y + A_xz z + b_x) x + F(0, y, z) = 0 on the sheet where g_x > 0."""

    coefficients: tuple[FloatLike, ...]
    ndim: int

    def height(self, y: Floats, z: Floats) -> Floats:
        """Height h(y, z), the root of the quadric on the sheet."""
        return self._root(y, z)[0]

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Height h with its first and second derivatives."""
        xx, yy, zz, xy, xz, yz, _, by, bz, _ = (fit(v, self.ndim) for v in self.coefficients)
        x, u = self._root(y, z)
        inverse = -1.0 / u
        hy = (xy * x + yy * y + yz * z + by) * inverse
        hz = (xz * x + yz * y + zz * z + bz) * inverse
        ay, az = xx * hy + xy, xx * hz + xz
        return Jet(
            x,
            hy,
            hz,
            (ay * hy + xy * hy + yy) * inverse,
            (ay * hz + xz * hy + yz) * inverse,
            (az * hz + xz * hz + zz) * inverse,
        )

    def _root(self, y: Floats, z: Floats) -> tuple[Floats, Floats]:
        xx, yy, zz, xy, xz, yz, bx, by, bz, c = (fit(v, self.ndim) for v in self.coefficients)
        half = xy * y + xz * z + bx
        rest = y * (yy * y + 2.0 * (yz * z + by)) + z * (zz * z + 2.0 * bz) + c
        u = np.sqrt(half * half - xx * rest)
        return np.asarray(-rest / (half + u)), u


class SheetGraph(NamedTuple):
    """A graph surface in a frame with its own axes; `offset` (..., 3) is its origin there."""

    surface: GraphSurface
    offset: Floats

    def height(self, y: Floats, z: Floats) -> Floats:
        """Height h(y, z), the sag of the surface."""
        x, y, z = self._moved(y, z)
        return np.asarray(self.surface.local_sag(y, z) + x)

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Height h with its first and second derivatives."""
        x, y, z = self._moved(y, z)
        jet = self.surface.jet(y, z)
        return jet._replace(x=jet.x + x)

    def _moved(self, y: Floats, z: Floats) -> tuple[FloatLike, Floats, Floats]:
        if not self.offset.any():
            return 0.0, y, z
        dx, dy, dz = (fit(self.offset[..., i], y.ndim) for i in range(3))
        return dx, y - dy, z - dz


def graphs_of(surfaces: Sequence[Surface], ndim: int) -> tuple[list[Graph], Floats, Floats] | None:
    """Express surfaces as graphs over one plane.

    The working frame is the eye's, or that of the first surface that is a graph of its own frame. Another one must have
    parallel axes.

    Args:
        surfaces: what to express.
        ndim: number of axes of the arrays that the graphs will receive.

    Returns:
        (graphs, origin, rotation) of the working frame, or None where the surfaces have no common frame.
    """
    frame = next((surface for surface in surfaces if isinstance(surface, GraphSurface)), None)
    first = surfaces[0]
    origin = np.zeros_like(first.origin_mm) if frame is None else frame.origin_mm
    rotation = np.broadcast_to(np.eye(3), first.rotation.shape) if frame is None else frame.rotation
    graphs: list[Graph] = []
    for surface in surfaces:
        if isinstance(surface, GraphSurface):
            if not np.array_equal(surface.rotation, rotation):
                return None
            offset = (np.swapaxes(rotation, -1, -2) @ (surface.origin_mm - origin)[..., None])[..., 0]
            graphs.append(SheetGraph(surface, offset))
        elif isinstance(surface, Quadric):
            moved = surface if frame is None else surface.seen_from(origin, rotation)
            if not np.all(moved.rotation[..., 0, 0] > 0.5):
                return None
            p, b, c = moved.axial_coefficients or (None, None, None)
            if p is not None and b is not None and c is not None:
                graphs.append(AxialGraph(p, b, c, ndim))
            else:
                graphs.append(QuadricGraph(moved.coefficients, ndim))
        else:
            return None
    return graphs, origin, rotation
