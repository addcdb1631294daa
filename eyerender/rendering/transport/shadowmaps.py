"""Shadow maps of an eye region: where a lamp certainly reaches the skin, so that no shadow ray is needed.

The map of every lamp holds the directions from its middle in stereographic projection, divided into cells. A cell is
marked if it may contain a hair, an end of the sheet of skin, or a triangle of the sheet that faces away from any point
of the lamp. A ray through a cell without marks meets the sheet from its front only. The crossings from the front, less
those from the back, are at most one, because the sheet is one surface with a hole (see `pixels`). So a point of the
sheet in such a cell is the only one there, and the lamp lights it.

Seen from another point of a lamp of radius r, an occluder at distance a shifts relative to a receiver at distance b by
at most r (1 / a - 1 / b). The marks are enlarged by this amount.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Floats, Singles
from ...optics.vectors import crosses
from ...region.mesh import HAIRS, RegionMesh
from ...rig.light import Lamp
from ..records.frame import quotient, upload_array
from ..records.recording import recorded, syntax
from ..scene.region import RegionScene, SkinGeometry

_CELLS = 256  # cells along each side of a map
_WIDTH = 16  # numbers of a lamp
_REACH_MM = 72.0  # radius of the sheet about the apex of the eye
_HAIR_MM = 0.06  # half the thickness of hairs, with a margin
_LARGEST = 0.85  # half the width of a map: tan of half the angle to the axis


@dataclass(kw_only=True)
class ShadowMaps:
    """Shadow maps of all lamps for one pose of a region, on the device."""

    table: mi.Float  # numbers of the lamps' views (see `shadow_map_table`)
    known: mi.Bool  # whether the sheet is known to be one surface; otherwise every cell counts as marked
    marks: mi.UInt8  # 1 for marked cells of each map, else 0

    @classmethod
    def build(cls, region: RegionScene, table: Singles) -> ShadowMaps:
        """Draw the shadow maps of a posed region; `table` as from `shadow_map_table`."""
        # Without lamps nothing reads the table, but kernels cannot be compiled for an empty one.
        views = upload_array(table if len(table) else np.zeros(_WIDTH))
        skin, known = region.skin, dr.opaque(mi.Bool, region.skin.is_sheet)
        if not skin.is_sheet:
            return cls(table=views, known=known, marks=dr.zeros(mi.UInt8, 1))
        pieces = _pieces(region.posed)
        counts = region.sheet_faces, len(pieces), region.body_faces
        on_device = tuple(dr.opaque(mi.UInt32, count) for count in counts)
        hairs = upload_array(pieces if len(pieces) else np.zeros(8))
        return cls(table=views, known=known, marks=_marked(views, skin, hairs, on_device, counts, len(table)))

    def at(self, lamp: mi.UInt32, x: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        """Return whether the region leaves points of the sheet (scene's frame) in view of every point of a lamp."""
        place = _View.of(self.table, lamp).place(x)
        u, v = place.u, place.v
        inside = active & self.known & (u >= 0) & (v >= 0) & (u < _CELLS) & (v < _CELLS)
        cell = (lamp * _CELLS + mi.UInt32(v)) * _CELLS + mi.UInt32(u)
        return inside & (dr.gather(mi.UInt8, self.marks, cell, inside) == 0)


@recorded
def _marked(
    table: mi.Float, skin: SkinGeometry, hairs: mi.Float, on_device: tuple[mi.UInt32, ...],
    counts: tuple[int, ...], lamps: int,
) -> mi.UInt8:  # fmt: skip
    """Compute the marks of all lamps, from triangles of the sheet, pieces of hairs, and bodies before the eye.

    Their `counts` are passed on the device too, otherwise they would be compiled into the kernels.
    """
    marks = dr.zeros(mi.UInt8, max(lamps, 1) * _CELLS * _CELLS)
    for count, number, mark in zip(counts, on_device, (_mark_triangles, _mark_hairs, _mark_bodies), strict=True):
        if count and lamps:
            index = dr.arange(mi.UInt32, count * lamps)
            lamp = index // number
            mark(marks, lamp, _View.of(table, lamp), index - lamp * number, skin, hairs)
    return marks


def _mark_triangles(
    marks: mi.UInt8, lamp: mi.UInt32, view: _View, index: mi.UInt32, skin: SkinGeometry, _: mi.Float
) -> None:
    """Mark the cells that triangles of the sheet may cover, if they can cast shadows."""
    a, b, c, special = skin.corners(index)
    normal = dr.cross(b - a, c - a)
    limit = view.radius * dr.norm(normal)
    front = reduce(dr.minimum, [dr.dot(normal, view.origin - corner) for corner in (a, b, c)])
    ahead = reduce(dr.maximum, [view.ahead(corner) for corner in (a, b, c)]) > -view.radius
    places = [view.place(p) for p in (a, b, c)]
    edge = _Edge.longest([p.u for p in places], [p.v for p in places])
    _mark(marks, lamp, places, mi.Float(0), edge, view.scale, ahead & (special | (front <= limit)))


def _mark_bodies(
    marks: mi.UInt8, lamp: mi.UInt32, view: _View, index: mi.UInt32, skin: SkinGeometry, hairs: mi.Float
) -> None:
    """Mark the cells that triangles of frames of spectacles and obstacles may cover."""
    bodies = skin.spectacles or skin.obstacles
    assert bodies is not None
    _mark_triangles(marks, lamp, view, bodies[0] + index, skin, hairs)


def _mark_hairs(
    marks: mi.UInt8, lamp: mi.UInt32, view: _View, index: mi.UInt32, _: SkinGeometry, hairs: mi.Float
) -> None:
    """Mark the cells that straight pieces of hairs may cover; each piece is two ends of four numbers."""
    four = [dr.gather(mi.Vector4f, hairs, 2 * index + k) for k in (0, 1)]
    p, q = (view.place(mi.Vector3f(e.x, e.y, e.z)) for e in four)
    thick = _HAIR_MM * dr.maximum(p.per_mm, q.per_mm)
    edge = _Edge(p.u, p.v, q.u - p.u, q.v - p.v, thick)
    _mark(marks, lamp, [p, q], thick, edge, view.scale, mi.Bool(True))


@syntax
def _mark(
    marks: mi.UInt8,
    lamp: mi.UInt32,
    places: Sequence[_Place],
    thick: mi.Float,
    edge: _Edge,
    scale: mi.Float,
    marked: mi.Bool,
) -> None:
    """Mark the cells within `thick`, plus the lamp's size, of bodies with these corners, where `marked`."""
    corners = [mi.Point2f(p.u, p.v) for p in places]
    lowest, highest = reduce(dr.minimum, corners), reduce(dr.maximum, corners)
    # Straight edges are arcs in a map, of a radius of one unit at least.
    size = dr.square(highest - lowest)
    slack = reduce(dr.maximum, [p.wide for p in places]) + 0.02 + (size.x + size.y) / (8 * scale)
    first = mi.Point2i(dr.clip(dr.floor(lowest - slack - thick), -1, _CELLS))
    last = mi.Point2i(dr.clip(dr.floor(highest + slack + thick), -1, _CELLS))
    columns, rows = mi.Point2u(dr.maximum(last - first + 1, 0))
    count = dr.select(marked, columns * rows, 0)
    # A thin triangle covers few of the cells around it: those near the longest edge.
    reach = edge.width + slack + 0.71
    k = mi.UInt32(0)
    while dr.hint(k < count, label="marks", exclude=[marks, edge, places]):
        row = quotient(k, columns)
        u, v = first.x + mi.Int32(k - row * columns), first.y + mi.Int32(row)
        near = edge.distance2(mi.Float(u) + 0.5, mi.Float(v) + 0.5) < reach * reach
        inside = (u >= 0) & (v >= 0) & (u < _CELLS) & (v < _CELLS)
        cell = (lamp * _CELLS + mi.UInt32(v)) * _CELLS + mi.UInt32(u)
        dr.scatter(marks, mi.UInt8(1), cell, near & inside)
        k += 1
    dr.eval(marks)


def _pieces(region: RegionMesh) -> Singles:
    """Return straight pieces (n, 2, 4) of the hairs of a region; the fourth number of each end is 0."""
    curves = [c for c in region.strands[:HAIRS] if c.size]
    pieces = np.zeros((sum(c.shape[0] * (c.shape[1] - 1) for c in curves), 2, 4), np.float32)
    first = 0
    for c in curves:
        part = pieces[first : first + c.shape[0] * (c.shape[1] - 1)].reshape(len(c), -1, 2, 4)
        part[:, :, 0, :3], part[:, :, 1, :3] = c[:, :-1], c[:, 1:]
        first += len(c) * (c.shape[1] - 1)
    return pieces


@dataclass(frozen=True, slots=True)
class _Place:
    """Position in a map: cells across and down, shift in cells by the lamp's size, cells per mm."""

    u: mi.Float
    v: mi.Float
    wide: mi.Float
    per_mm: mi.Float


class _View:
    """One lamp's projection: position, two axes across its axis, the axis, cells per unit, radius, largest distance."""

    def __init__(
        self, origin: mi.Vector3f, e1: mi.Vector3f, e2: mi.Vector3f, axis: mi.Vector3f, *scalars: mi.Float
    ) -> None:
        self.origin, self._e1, self._e2, self._axis = origin, e1, e2, axis
        self.scale, self.radius, self._farthest = scalars

    @classmethod
    def of(cls, table: mi.Float, lamp: mi.UInt32) -> _View:
        """Read the projections of lamps from the table."""
        four = [dr.gather(mi.Vector4f, table, lamp * (_WIDTH // 4) + k) for k in range(_WIDTH // 4)]
        row = [n for part in four for n in (part.x, part.y, part.z, part.w)]
        return cls(*(mi.Vector3f(*row[k : k + 3]) for k in (0, 3, 6, 9)), *row[12:15])

    def ahead(self, x: mi.Vector3f) -> mi.Float:
        """Compute how far points of the scene's frame lie before the lamp; what is behind it shades no map."""
        return dr.dot(x - self.origin, self._axis)

    def place(self, x: mi.Vector3f) -> _Place:
        """Project points of the scene's frame. The map is conformal, so its scale is the same in all directions."""
        p = x - self.origin
        distance = dr.norm(p)
        ahead = dr.maximum(dr.dot(p, self._axis) + distance, 1e-3 * distance)
        k = self.scale / ahead
        middle = 0.5 * _CELLS
        shift = self.radius * dr.maximum(1 / distance - 1 / self._farthest, 0) * distance * k
        # The origin is on the axis through the middle of the scene, and far lamps leave x no digits in p.
        return _Place(middle + k * dr.dot(x, self._e1), middle + k * dr.dot(x, self._e2), shift, k)


class _Edge:
    """A straight line in a map, such as the longest edge of a triangle; `width` is the extent of the rest from it."""

    def __init__(self, u: mi.Float, v: mi.Float, du: mi.Float, dv: mi.Float, width: mi.Float) -> None:
        self._u, self._v, self._du, self._dv, self.width = u, v, du, dv, width
        self._inverse = dr.rcp(dr.maximum(du * du + dv * dv, 1e-12))

    @classmethod
    def longest(cls, us: Sequence[mi.Float], vs: Sequence[mi.Float]) -> _Edge:
        edges = [(us[i], vs[i], us[j] - us[i], vs[j] - vs[i]) for i, j in ((0, 1), (1, 2), (2, 0))]
        best, size = edges[0], edges[0][2] * edges[0][2] + edges[0][3] * edges[0][3]
        for edge in edges[1:]:
            other = edge[2] * edge[2] + edge[3] * edge[3]
            best = tuple(dr.select(other > size, x, y) for x, y in zip(edge, best, strict=True))
            size = dr.maximum(size, other)
        area = dr.abs(edges[0][2] * edges[2][3] - edges[0][3] * edges[2][2])
        return cls(*best, area * dr.rsqrt(dr.maximum(size, 1e-12)))

    def distance2(self, u: mi.Float, v: mi.Float) -> mi.Float:
        """Compute the squared distance of points from the edge."""
        x, y = u - self._u, v - self._v
        t = dr.clip((x * self._du + y * self._dv) * self._inverse, 0, 1)
        return dr.square(x - t * self._du) + dr.square(y - t * self._dv)


def shadow_map_table(lights: Sequence[Lamp], anchor_mm: Floats, reach_mm: float) -> Singles:
    """Compute the projections of lamps (lamps, 16) on the host.

    `lights`: the lamps; `anchor_mm`: origin of the scene's frame in the world; `reach_mm`: distance from this origin
    within which skin matters.
    """
    rows = [_frame(lamp, anchor_mm, min(reach_mm, _REACH_MM)) for lamp in lights]
    return np.array(rows, dtype=np.float32).reshape(-1, _WIDTH)


def _frame(lamp: Lamp, anchor_mm: Floats, reach_mm: float) -> list[float]:
    """Compute the numbers of a lamp's projection, in the scene's frame."""
    origin = np.asarray(lamp.position_mm - anchor_mm, dtype=float)
    distance = float(np.linalg.norm(origin))
    axis = -origin / distance if distance > 0 else np.array([-1.0, 0.0, 0.0])
    e1 = crosses(axis, np.array((0.0, 0.0, 1.0) if abs(axis[2]) < 0.8 else (0.0, 1.0, 0.0)))
    e1 /= np.linalg.norm(e1)
    widest = np.arcsin(min(reach_mm / max(distance, 1e-9), 1.0))
    half = min(float(np.tan(widest / 2)), _LARGEST)
    numbers = 0.5 * _CELLS / half, float(lamp.radius_mm), distance + reach_mm, 0
    return [*origin, *e1, *crosses(axis, e1), *axis, *numbers]
