"""Express surfaces as graphs x = h(y, z) over one plane, as numbers for compiled code (`graph_kernels`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats, Ints, remembered
from ..base.jit import RAYS, ensure_compiled
from .biconic_kernels import Jet
from .graph_kernels import (
    APEX,
    AXIS,
    COLUMNS,
    GRID,
    LEAN,
    LINEAR,
    NUMERATOR,
    ORIGIN,
    ROOT,
    SHAPE,
    SMOOTH,
    TURN,
    X0,
    ZERNIKE,
    crossings,
    heights,
    jets,
)
from .surfaces import Surface
from .surfaces_biconic import Biconic
from .surfaces_graph import GraphSurface
from .surfaces_measured import GridSurface, Measured, ZernikeSurface
from .surfaces_quadric import Quadric

_AXES = 1e-15


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Graphs:
    """Surfaces over the (y, z) plane of a working frame, p_eye = rotation p + origin_mm.

    Attributes:
        kinds: (s,) kinds of the surfaces.
        numbers: (1 or n, s, columns), one row per eye of a batch.
        table: coefficients of measured surfaces.
        origin_mm: (3,) or (n, 3).
        rotation: (3, 3) or (n, 3, 3).
    """

    kinds: Ints
    numbers: Floats
    table: Floats
    origin_mm: Floats
    rotation: Floats

    @property
    def plain(self) -> bool:
        """Whether the working frame is the eye's."""
        return not np.any(self.origin_mm) and bool(np.all(self.rotation == np.eye(3)))

    def jets(self, y: Floats, z: Floats) -> list[Jet]:
        """Compute heights and derivatives of the surfaces of the first eye at positions (k,)."""
        out = np.empty((len(self.kinds), 6, len(y)))
        jets(self.kinds, self.numbers, self.table, np.array(y, dtype=float), np.array(z, dtype=float), out)
        return [Jet(*rows) for rows in out]

    def heights(self, y: Floats, z: Floats) -> Floats:
        """Compute heights (s, k) of the surfaces of the first eye at positions (k,); NaN where they do not reach."""
        out = np.empty((len(self.kinds), len(y)))
        heights(self.kinds, self.numbers, self.table, np.array(y, dtype=float), np.array(z, dtype=float), out)
        return out


@remembered
def graphs_of(*surfaces: Surface) -> Graphs | None:
    """Express surfaces as graphs over one plane (see `express`); cached for the same objects."""
    return express(*surfaces)


def express(*surfaces: Surface) -> Graphs | None:
    """Express surfaces as graphs over one plane.

    Graph surfaces must have parallel x axes. If these are the eye's x axis, the working frame is that of the eye, else
    that of the first graph surface.

    Returns:
        The graphs; None if the surfaces have no common plane.
    """
    ensure_compiled(RAYS)
    frame = next((surface for surface in surfaces if isinstance(surface, GraphSurface)), None)
    first = surfaces[0]
    origin, rotation = np.zeros_like(first.origin_mm), np.broadcast_to(np.eye(3), first.rotation.shape)
    if frame is not None and not _turned_about_x(frame.rotation):
        origin, rotation = frame.origin_mm, frame.rotation
    rows, kinds, table = 1 if first.origin_mm.ndim == 1 else len(first.origin_mm), [], [np.zeros(1)]
    numbers = np.zeros((rows, len(surfaces), COLUMNS))
    back = np.swapaxes(rotation, -1, -2)
    for s, surface in enumerate(surfaces):
        row, turn = numbers[:, s], back @ surface.rotation
        place = (back @ (surface.origin_mm - origin)[..., None])[..., 0]
        row[:, ORIGIN : ORIGIN + 3], row[:, AXIS : AXIS + 3] = place, turn[..., :, 0]
        row[:, X0] = place[..., 0]
        if isinstance(surface, Quadric):
            # Measured from a point beside its origin, so that no digits cancel.
            seen = surface.seen_from(origin + rotation[..., :, 0] * place[..., :1], rotation)
            if not np.all(seen.rotation[..., 0, 0] > 0.5):
                return None
            _write_quadric(row, seen)
            apex = place + turn[..., :, 0] * surface.sag(0.0, 0.0)[..., None]
            row[:, APEX : APEX + 2] = apex[..., 1:]
            kinds.append(SMOOTH)
        elif isinstance(surface, GraphSurface) and _turned_about_x(turn):
            row[:, TURN], row[:, TURN + 1] = turn[..., 1, 1], turn[..., 2, 1]
            row[:, APEX : APEX + 2] = place[..., 1:]
            kinds.append(_write_sheet(row, surface, table))
        else:
            return None
    whole = np.concatenate(table)
    return Graphs(
        kinds=np.array(kinds, dtype=np.int64), numbers=numbers, table=whole, origin_mm=origin, rotation=rotation
    )


def distances(surface: GraphSurface, points: Floats, ways: Floats, far: Floats, inward: bool) -> Floats:
    """Intersect rays with a surface as `GraphSurface.hit` does, but compiled.

    Args:
        surface: one surface, convex towards its local +x.
        points: (n, 3) origins of the rays, which are on the side from which they cross.
        ways: (n, 3) their unit directions.
        far: (n,) distances (mm) from which on hits do not matter.
        inward: whether the rays go in (d.g < 0) or out.

    Returns:
        Distances (n,) of the hits, infinite for none and perhaps for those beyond `far`.
    """
    graphs, conic = _in_own_frame(surface)
    start, out = (points - surface.origin_mm) @ surface.rotation, np.array(far, dtype=float)
    crossings(graphs.kinds, graphs.numbers, graphs.table, conic, start, ways @ surface.rotation, inward, out)
    return out


@remembered
def _in_own_frame(surface: GraphSurface) -> tuple[Graphs, Floats]:
    """Express one surface in its own frame, which is always possible, and return its `likeness`."""
    graphs = express(surface.placed(np.zeros(3), np.eye(3)))
    assert graphs is not None
    return graphs, np.array(surface.likeness())


def _turned_about_x(rotation: Floats) -> bool:
    """Return whether rotations (..., 3, 3) leave the x axis where it is."""
    return bool(np.all(np.abs(rotation[..., 1:, 0]) <= _AXES)) and bool(np.all(rotation[..., 0, 0] > 0.0))


def _write_quadric(row: Floats, quadric: Quadric) -> None:
    """Write a quadric, A_xx x^2 + 2 h x + N = 0 with R = h^2 - A_xx N, to its columns (n, columns)."""
    xx, yy, zz, xy, xz, yz, bx, by, bz, c = quadric.coefficients
    numerator = np.broadcast_arrays(c, 2.0 * by, 2.0 * bz, yy, 2.0 * yz, zz)
    square = (bx * bx, 2.0 * bx * xy, 2.0 * bx * xz, xy * xy, 2.0 * xy * xz, xz * xz)
    for k, (n, h) in enumerate(zip(numerator, square, strict=True)):
        row[:, NUMERATOR + k], row[:, ROOT + k] = n, h - xx * n
    for k, h in enumerate((bx, xy, xz)):
        row[:, LINEAR + k] = h


def _write_sheet(row: Floats, surface: GraphSurface, table: list[Floats]) -> int:
    """Write the columns (n, columns) of a graph of its own frame, extend the table, and return its kind."""
    if isinstance(surface, Biconic):
        _write_biconic(row, surface.radii_mm, surface.conic_constants, row[:, TURN : TURN + 2])
        return SMOOTH
    assert isinstance(surface, Measured)
    outer, window = surface.outer, surface.window_mm
    c, s = np.cos(outer[..., 4]), np.sin(outer[..., 4])
    turn = np.stack([row[:, TURN] * c - row[:, TURN + 1] * s, row[:, TURN + 1] * c + row[:, TURN] * s], axis=-1)
    _write_biconic(row, outer[..., :2], outer[..., 2:4], turn)
    lean_y, lean_z = outer[..., 6], outer[..., 7]
    row[:, LEAN] = row[:, TURN] * lean_y - row[:, TURN + 1] * lean_z
    row[:, LEAN + 1] = row[:, TURN + 1] * lean_y + row[:, TURN] * lean_z
    row[:, X0] += outer[..., 5] - row[:, LEAN] * row[:, ORIGIN + 1] - row[:, LEAN + 1] * row[:, ORIGIN + 2]
    row[:, SHAPE] = window[..., 0] ** 2
    row[:, SHAPE + 1] = window[..., 1] ** 2 - window[..., 0] ** 2
    start = sum(map(len, table))
    if isinstance(surface, ZernikeSurface):
        curvature = surface.base[..., 0]
        size = surface.table.shape[-2] * surface.table.shape[-1]
        values = (surface.radius_mm, curvature, (1.0 + surface.base[..., 1]) * curvature**2, surface.order)
        place = start + size * np.arange(len(row))
    else:
        assert isinstance(surface, GridSurface)
        size = surface.table.shape[-1]
        values = (surface.spacing_mm, surface.centre_mm[..., 0], surface.centre_mm[..., 1], size)
        place = start + size * size * surface.row
    table.append(surface.table.ravel())
    for k, value in enumerate((*values, place)):
        row[:, SHAPE + 2 + k] = value
    return ZERNIKE if isinstance(surface, ZernikeSurface) else GRID


def _write_biconic(row: Floats, radii_mm: Floats, conic_constants: Floats, turn: Floats) -> None:
    """Write a biconic with the axes (c y + s z, c z - s y), (y, z) counting from its origin: h = 1."""
    curvature = 1.0 / radii_mm
    c, s = turn[..., 0], turn[..., 1]
    y, z = row[:, ORIGIN + 1], row[:, ORIGIN + 2]
    for first, (along, across), whole in (
        (NUMERATOR, (curvature[..., 0], curvature[..., 1]), 0.0),
        (ROOT, tuple(-(1.0 + conic_constants[..., k]) * curvature[..., k] ** 2 for k in (0, 1)), 1.0),
    ):
        yy, yz, zz = c * c * along + s * s * across, 2.0 * c * s * (along - across), s * s * along + c * c * across
        row[:, first] = whole + yy * y * y + yz * y * z + zz * z * z
        row[:, first + 1], row[:, first + 2] = -2.0 * yy * y - yz * z, -2.0 * zz * z - yz * y
        row[:, first + 3], row[:, first + 4], row[:, first + 5] = yy, yz, zz
    row[:, LINEAR] = 1.0
