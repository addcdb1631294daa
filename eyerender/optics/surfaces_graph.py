"""Surfaces that are graphs x = h(y, z) in their own frame, evaluated by compiled code."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..base.arrays import Floats, remembered
from .formulas import Jet
from .graph_kernels import SMOOTH, Sheets
from .sheets import Graphs, placed_sheets, write_biconic
from .surfaces import Hit, Surface, SymmetricMatrix, Xyz, fit, shift, turn, turn_back


class GraphSurface(Surface):
    """A surface x = h(y, z) of the local frame.

    F = 2 (x - h(y, z)), so that the half gradient is (1, -dh/dy, -dh/dz), whose local x component is 1 everywhere: the
    sheet is the whole graph.
    """

    __slots__ = ()

    _untilted: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "_untilted", bool(np.all(self.rotation == np.eye(3))))

    @property
    def untilted(self) -> bool:
        """Whether the local axes are those of the eye."""
        return self._untilted

    @abstractmethod
    def write(self, sheets: Sheets, table: list[Floats]) -> int:
        """Write the shape into records (n,) that hold its place, extend the table, and return its kind."""

    @abstractmethod
    def likeness(self) -> tuple[Floats, Floats]:
        """Return curvature and 1 + Q, (...,), of the approximating conic at which the search for hits starts."""

    def jet(self, y: Floats, z: Floats) -> Jet:
        """Compute height, slopes and second derivatives over the local (y, z); NaN where the sheet does not reach."""
        return _own_graph(self).jets(y, z)[0]

    def hit(self, origin: Xyz, direction: Xyz, inward: bool) -> Hit:
        """Solve x - h(y, z) = 0 along the ray (see `graph_kernels.crossings`)."""
        start, way = self.local_point(origin), self.local_vector(direction)
        graph, conics = _own_graph(self), np.stack(self.likeness(), axis=-1)
        t, ok = graph.crossings(conics, start, way, inward)
        with np.errstate(invalid="ignore", over="ignore"):
            sag = graph.jets(start[1] + t * way[1], start[2] + t * way[2])[0]
            point = (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])
        return Hit(t, point, self.eye_vector((np.ones_like(sag.y), -sag.y, -sag.z)), ok)

    def value_at(self, point: Xyz) -> Floats:
        """Evaluate the implicit function F = 2 (x - h(y, z))."""
        x, y, z = self.local_point(point)
        return np.asarray(2.0 * (x - self.jet(y, z).x))

    def gradient_at(self, point: Xyz) -> Xyz:
        """Compute the half gradient (1, -dh/dy, -dh/dz) of the local frame, rotated to the eye frame."""
        _, y, z = self.local_point(point)
        sag = self.jet(y, z)
        return self.eye_vector((np.ones_like(sag.y), -sag.y, -sag.z))

    def hessian_at(self, point: Xyz) -> SymmetricMatrix:
        """Compute the derivative of the half gradient, H with dg = H dp."""
        _, y, z = self.local_point(point)
        sag = self.jet(y, z)
        if self.untilted:
            return SymmetricMatrix(0.0, -sag.yy, -sag.zz, 0.0, 0.0, -sag.yz)
        r = [[fit(self.rotation[..., i, j], y.ndim) for j in range(3)] for i in range(3)]

        def entry(i: int, j: int) -> Floats:
            cross = r[i][1] * r[j][2] + r[i][2] * r[j][1]
            return np.asarray(-(r[i][1] * r[j][1] * sag.yy + r[i][2] * r[j][2] * sag.zz + cross * sag.yz))

        return SymmetricMatrix(entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2))

    def local_sag(self, y: Floats, z: Floats) -> Floats:
        """Compute the height x of the sheet over the local (y, z); NaN where the sheet does not reach."""
        return np.asarray(self.jet(y, z).x)

    def local_point(self, point: Xyz) -> Xyz:
        """Transform points of the eye frame to the local frame."""
        return self.local_vector(shift(point, self.origin_mm, -1.0))

    def local_vector(self, vector: Xyz) -> Xyz:
        """Rotate directions of the eye frame to the local frame."""
        return vector if self.untilted else turn_back(self.rotation, vector)

    def eye_vector(self, vector: Xyz) -> Xyz:
        """Rotate directions of the local frame to the eye frame."""
        return vector if self.untilted else turn(self.rotation, vector)


@remembered
def _own_graph(surface: GraphSurface) -> Graphs:
    """Express a surface in its own frame; cached for the same object."""
    place, turned = np.zeros_like(surface.origin_mm), np.zeros_like(surface.rotation) + np.eye(3)
    sheets, table = placed_sheets(place, turned), [np.zeros(1)]
    kind = surface.write(sheets, table)
    return Graphs(
        kinds=np.array([kind]), sheets=sheets[:, None], table=np.concatenate(table), origin_mm=place, rotation=turned
    )


def distances(surface: GraphSurface, points: Floats, ways: Floats, far: Floats, inward: bool) -> Floats:
    """Intersect rays with a single surface that is convex towards its local +x.

    The rays (n, 3) start on the side from which they cross, with unit directions, in (d.g < 0) or out. Hits from the
    distances `far` (n,), mm, on do not matter. Returns distances (n,) of the hits, infinite for none and perhaps for
    those beyond `far`.
    """
    start, way = (points - surface.origin_mm) @ surface.rotation, ways @ surface.rotation
    conics = np.stack(surface.likeness(), axis=-1)
    x, y, z = start.T
    t, found = _own_graph(surface).crossings(conics, (x, y, z), tuple(way.T), inward, far)
    return np.where(found, t, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Biconic(GraphSurface):
    """Biconic surface with its apex at the local origin.

    x = -(c_y y^2 + c_z z^2) / (1 + sqrt(1 - (1 + Q_y) c_y^2 y^2 - (1 + Q_z) c_z^2 z^2)), c = 1/R
    (Smith & Atchison 1997, "The eye and visual optical instruments", biconic surface.)
    """

    origin_mm: Floats  # (..., 3) apex in the eye frame
    rotation: Floats  # (..., 3, 3) local to eye frame
    radii_mm: Floats  # (..., 2) apex radii (R_y, R_z); positive ones open to -x, negative ones to +x
    conic_constants: Floats  # (..., 2) conic constants (Q_y, Q_z)
    _untilted: bool = field(init=False, repr=False)

    kind: ClassVar[str] = "biconic"

    def write(self, sheets: Sheets, table: list[Floats]) -> int:
        """Write the shape into records that hold its place."""
        write_biconic(sheets, self.radii_mm, self.conic_constants, sheets["cosine"], sheets["sine"])
        return SMOOTH

    def likeness(self) -> tuple[Floats, Floats]:
        """Return curvature and 1 + Q of the conic with the mean curvature."""
        return np.mean(1.0 / self.radii_mm, axis=-1), 1.0 + np.mean(self.conic_constants, axis=-1)

    def _scaled_shape(self, factor: float) -> dict[str, Floats]:
        """Scale the radii; conic constants stay."""
        return {"radii_mm": factor * self.radii_mm}

    def _mirrored_shape(self) -> dict[str, Floats]:
        """Change nothing, because the sag is even in y."""
        return {}
