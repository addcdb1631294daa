"""Surfaces as records for compiled code (`graph_kernels`): heights x = h(y, z) over one plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats, Ints
from ..base.jit import RAYS, ensure_compiled
from .formulas import Jet
from .graph_kernels import SHEET, Sheets, crossings, jets
from .surfaces import Xyz


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Graphs:
    """Surfaces over the (y, z) plane of a working frame, p_eye = rotation p + origin_mm."""

    kinds: Ints  # (s,) kinds of the surfaces
    sheets: Sheets  # (1 or n, s) records of the type `SHEET`, one row per eye of a batch
    table: Floats  # coefficients of measured surfaces
    origin_mm: Floats  # (3,) or (n, 3)
    rotation: Floats  # (3, 3) or (n, 3, 3)

    @property
    def plain(self) -> bool:
        """Whether the working frame is the eye's."""
        return not np.any(self.origin_mm) and bool(np.all(self.rotation == np.eye(3)))

    def jets(self, y: Floats, z: Floats) -> list[Jet]:
        """Compute heights and derivatives at positions of one shape; for a batch, its axis is the first one.

        Heights are NaN where the surfaces do not reach.
        """
        ensure_compiled(RAYS)
        (y, z), shape = self._by_eye((y, z))
        out = np.empty((len(self.kinds), 6, *y.shape))
        jets(self.kinds, self.sheets, self.table, y, z, out)
        return [Jet(*each) for each in out.reshape(len(self.kinds), 6, *shape)]

    def crossings(
        self, conics: Floats, start: Xyz, way: Xyz, inward: bool, far: Floats | None = None
    ) -> tuple[Floats, Bools]:
        """Intersect rays with the first surface: distances (mm), and whether there is a crossing.

        Args:
            conics: (..., 2) curvature and 1 + Q of the conic at which the search starts.
            start: origins of the rays in the working frame; for a batch, its axis is the first one.
            way: their unit directions.
            inward: whether the rays go in or out.
            far: (mm) of a surface that is convex towards +x, for rays that start on the side from which they cross:
                distances from which on crossings do not matter.
        """
        ensure_compiled(RAYS)
        axes, shape = self._by_eye((*start, *way))
        distance = np.full(axes.shape[1:], np.inf)
        if far is not None:
            distance[...] = np.reshape(far, distance.shape)
        found = np.empty(distance.shape, dtype=np.bool_)
        conics = np.ascontiguousarray(np.atleast_2d(conics))
        rays, convex = (axes[:3], axes[3:]), far is not None
        crossings(self.kinds, self.sheets, self.table, conics, *rays, inward, convex, distance, found)
        return distance.reshape(shape), found.reshape(shape)

    def _by_eye(self, values: tuple[Floats, ...]) -> tuple[Floats, tuple[int, ...]]:
        """Arrange arrays that broadcast as (values, n, k), k the size of the axes behind that of the batch."""
        shape = np.broadcast_shapes(*(np.shape(value) for value in values))
        rows = 1
        if self.origin_mm.ndim > 1:
            rows = len(self.sheets)
            shape = (rows, *shape[1:])
        out = np.empty((len(values), *shape))
        for k, value in enumerate(values):
            out[k, ...] = value
        return out.reshape(len(values), rows, -1), shape


def placed_sheets(place: Floats, turn: Floats) -> Sheets:
    """Create records (n,) with place (3,) or (n, 3) and rotation of surfaces in the working frame."""
    sheets = np.zeros(1 if place.ndim == 1 else len(place), dtype=SHEET)
    sheets["origin"], sheets["axis"], sheets["place"][:, 0] = place, turn[..., :, 0], place[..., 0]
    sheets["cosine"], sheets["sine"] = turn[..., 1, 1], turn[..., 2, 1]
    sheets["apex"] = place[..., 1:]
    return sheets


def write_biconic(sheets: Sheets, radii_mm: Floats, conic_constants: Floats, cosine: Floats, sine: Floats) -> None:
    """Write a biconic with the axes (c y + s z, c z - s y), (y, z) counting from its origin: h = 1."""
    curvature = 1.0 / radii_mm
    c, s = cosine, sine
    y, z = sheets["origin"][:, 1], sheets["origin"][:, 2]
    for out, (along, across), whole in (
        (sheets["numerator"], (curvature[..., 0], curvature[..., 1]), 0.0),
        (sheets["square"], tuple(-(1.0 + conic_constants[..., k]) * curvature[..., k] ** 2 for k in (0, 1)), 1.0),
    ):
        yy, yz, zz = c * c * along + s * s * across, 2.0 * c * s * (along - across), s * s * along + c * c * across
        out[:, 0] = whole + yy * y * y + yz * y * z + zz * z * z
        out[:, 1], out[:, 2] = -2.0 * yy * y - yz * z, -2.0 * zz * z - yz * y
        out[:, 3], out[:, 4], out[:, 5] = yy, yz, zz
    sheets["linear"] = 1.0, 0.0, 0.0
