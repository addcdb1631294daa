"""The whole region as one triangle mesh with one map, posed with the globe; its topology never changes.

Vertices are in the region's frame of a right eye. For a left eye they are mirrored, and the faces have the other
orientation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from ..base.arrays import OBSTACLE, SPECTACLE_FRAME, ArrayValue, Body, Bools, Floats, Ints, frozen, sealed
from .anatomy import Region
from .brow import PLACES as BROW_PLACES
from .brow import brow
from .contour import COLUMNS, Contour, contour
from .globe import Globe
from .hairs import SEGMENTS, Hairs, tube_faces
from .lashes import lashes
from .lids import CONJUNCTIVA, FINE, LID, MARGIN, ROWS, grid_normals, halved, sheet
from .skin import BANDS, BROW, LASH, LASH_U, SHEET_ROWS, SPECTACLES_ROW, TEAR, band_row, sheet_v
from .tears import ROWS as TEAR_ROWS
from .tears import meniscus, on_globe

if TYPE_CHECKING:
    import trimesh

PARTS = ("skin", "lashes", "brow", "tears")
LID_MARKS = 17  # landmarks of a lid in labels
HAIRS = 2  # the first of a mesh's strands, which are hairs


@dataclass(frozen=True, slots=True, eq=False)
class RegionLayout(ArrayValue):
    """Constant parts of a region's mesh: `faces` (m, 3), `uv` (n, 2), and the end of each part's vertices and faces.

    `parts` are their names. Before the tears there may be frames of spectacles and obstacles.
    """

    faces: Ints
    uv: Floats
    vertex_ends: Ints
    face_ends: Ints
    parts: tuple[str, ...] = PARTS


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RegionMesh(ArrayValue):
    """A posed region in the scene's frame (mm).

    If margins, border or strands are unknown, they are empty.

    Attributes:
        vertices: (n, 3) positions, mm.
        normals: (n, 3) unit normals.
        layout: the constant parts.
        upper_margin: (k, 3) landmarks along the upper lid's inner edge, from the temple to the nose.
        lower_margin: (k, 3) the same for the lower lid.
        border: (k, 3) outer end of the skin, closed.
        strands: curves (n, k, 3) of everything in front of the skin.
        radii: those of the hairs among them, (n, k) mm.
    """

    vertices: Floats
    normals: Floats
    layout: RegionLayout
    upper_margin: Floats
    lower_margin: Floats
    border: Floats
    strands: tuple[Floats, ...]
    radii: tuple[Floats, ...]

    def towards(self, other: RegionMesh, share: float) -> RegionMesh:
        """Return the mesh a share of the way to that of another pose of the same subject, along straight lines."""

        def between(a: Floats, b: Floats) -> Floats:
            return sealed(a + share * (b - a))

        return RegionMesh(
            vertices=between(self.vertices, other.vertices),
            normals=between(self.normals, other.normals),
            layout=self.layout,
            upper_margin=between(self.upper_margin, other.upper_margin),
            lower_margin=between(self.lower_margin, other.lower_margin),
            border=between(self.border, other.border),
            strands=tuple(map(between, self.strands, other.strands)),
            radii=tuple(map(between, self.radii, other.radii)),
        )

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts."""
        return self.layout.parts

    def part(self, name: str) -> trimesh.Trimesh:
        """Return one part as a trimesh: skin, lashes, tears or brow."""
        import trimesh  # its import takes a quarter of a second, and few processes need it

        i = self.parts.index(name)
        v0, f0 = (0, 0) if i == 0 else (int(self.layout.vertex_ends[i - 1]), int(self.layout.face_ends[i - 1]))
        v1, f1 = int(self.layout.vertex_ends[i]), int(self.layout.face_ends[i])
        return trimesh.Trimesh(self.vertices[v0:v1], self.layout.faces[f0:f1] - v0, process=False)


@dataclass(frozen=True, slots=True, eq=False)
class LidMargins(ArrayValue):
    """Landmarks (k, 3) along the lids' inner edges, like those of a `RegionMesh`."""

    upper_margin: Floats
    lower_margin: Floats

    def opening_mm(self, globe: Globe, y_mm: float) -> float:
        """Compute the arc between both edges on the sclera's sphere in the plane y = `y_mm` of the eye's frame.

        Its centre is that of the circle in which the plane cuts the sphere, and its ends are in the directions of the
        points where the edges, straight between their landmarks, pass the plane.
        """
        centre, y = (globe.mirror * globe.centre)[None], np.array([y_mm])
        upper, lower = (edge_angles(edge[None], centre, y)[0] for edge in (self.upper_margin, self.lower_margin))
        radius = np.sqrt(max(globe.radius_mm**2 - (y_mm - centre[0, 1]) ** 2, 0.0))
        return float(radius * max(upper - lower, 0.0))


def edge_angles(edge: Floats, centre_mm: Floats, y_mm: Floats) -> Floats:
    """Return the directions (k,) rad in the plane of x and z from centres (k, 3) to where edges (k, c, 3) pass y (k,).

    Edges are straight between their points and held beyond their ends.
    """
    along = edge if edge[0, 0, 1] < edge[0, -1, 1] else edge[:, ::-1]
    last = np.clip((along[:, :, 1] < y_mm[:, None]).sum(axis=1), 1, along.shape[1] - 1)
    rows = np.arange(len(edge))
    a, b = along[rows, last - 1], along[rows, last]
    share = np.clip((y_mm - a[:, 1]) / (b[:, 1] - a[:, 1]), 0.0, 1.0)
    point = a + share[:, None] * (b - a) - centre_mm
    return np.asarray(np.arctan2(point[:, 2], point[:, 0]))


def lid_margins(spec: Region, globe: Globe) -> LidMargins:
    """Compute only the lids' inner edges, without the surrounding mesh."""
    upper, lower = (frozen(edge * globe.mirror) for edge in _margins(contour(spec, globe)))
    return LidMargins(upper, lower)


def region_mesh(spec: Region, globe: Globe) -> RegionMesh:
    """Compute the region of a subject around a posed globe."""
    s = sheet(spec, globe)
    tears = meniscus(spec, globe, s)
    lash = lashes(spec, globe, s)
    hair, hair_tubes, hair_normals = _brow(spec.with_lids())
    lash_tubes, lash_normals = lash.tubes()
    film, film_normals = _closed(tears), _closed(grid_normals(tears))
    vertices = _joined(s.fine, s.coarse, lash_tubes, hair_tubes, film)
    normals = _joined(s.fine_normals, s.coarse_normals, lash_normals, hair_normals, film_normals)
    curves = [*_margins(s.contour), halved(s.coarse[-1:])[0], lash.points, hair.points, film]
    if globe.mirrored:
        mirror = np.array([1.0, -1.0, 1.0])
        vertices, normals, curves = vertices * mirror, normals * mirror, [c * mirror for c in curves]
    upper, lower, border, *strands = (frozen(c) for c in curves)
    layout = _layout(spec.lashes.upper_count, len(lash.points), len(hair.points), globe.mirrored)
    mesh = RegionMesh(
        vertices=sealed(vertices),
        normals=sealed(normals),
        layout=layout,
        upper_margin=upper,
        lower_margin=lower,
        border=border,
        strands=tuple(strands),
        radii=(lash.radii, hair.radii),
    )
    for name in (SPECTACLE_FRAME, OBSTACLE):
        if some := [body for body in globe.frames if body.part == name]:
            mesh = _with_bodies(mesh, name, some)
    return mesh


def _with_bodies(mesh: RegionMesh, name: str, frames: Sequence[Body]) -> RegionMesh:
    """Insert frames of spectacles, or obstacles, as a part before the menisci."""
    layout = mesh.layout
    v, f = (int(ends[-2]) for ends in (layout.vertex_ends, layout.face_ends))
    starts = v + np.cumsum([0, *(len(body.vertices) for body in frames)])
    added, row = int(starts[-1]) - v, (SHEET_ROWS + SPECTACLES_ROW) / (SHEET_ROWS + BANDS)
    own = np.concatenate([body.faces + start for body, start in zip(frames, starts[:-1], strict=True)])
    uv = np.concatenate([np.full((len(body.vertices), 2), (body.albedo, row)) for body in frames])

    def joined(values: Floats, new: Floats) -> Floats:
        return np.concatenate([values[:v], new, values[v:]])

    return replace(
        mesh,
        vertices=sealed(joined(mesh.vertices, np.concatenate([body.vertices for body in frames]))),
        normals=sealed(joined(mesh.normals, np.concatenate([body.normals for body in frames]))),
        layout=RegionLayout(
            frozen(np.concatenate([layout.faces[:f], own, layout.faces[f:] + added]), np.int64),
            frozen(joined(layout.uv, uv)),
            frozen([*layout.vertex_ends[:-1], v + added, layout.vertex_ends[-1] + added], np.int64),
            frozen([*layout.face_ends[:-1], f + len(own), layout.face_ends[-1] + len(own)], np.int64),
            (*layout.parts[:-1], name, layout.parts[-1]),
        ),
    )


def _closed(grid: Floats) -> Floats:
    """Repeat the first column of a grid at the end, where the map's u is 1."""
    return np.concatenate([grid, grid[:, :1]], axis=1)


def _joined(fine: Floats, coarse: Floats, lash_tubes: Floats, hair_tubes: Floats, film: Floats) -> Floats:
    """Concatenate all vertices (n, 3), or their normals; `sheet_vertices` numbers those of the sheet."""
    parts = (_closed(fine), _closed(coarse), lash_tubes, hair_tubes, film)
    return np.concatenate([p.reshape(-1, 3) for p in parts])


@lru_cache(maxsize=16)
def _brow(spec: Region) -> tuple[Hairs, Floats, Floats]:
    """Compute the brow, its tubes and their normals; a blink does not move it."""
    hairs = brow(spec)
    tubes, normals = hairs.tubes(np.array([1.0, 0.0, 0.0]))
    return hairs, sealed(tubes), sealed(normals)


def _margins(fissure: Contour) -> tuple[Floats, Floats]:
    point = fissure.point
    half = COLUMNS // 2
    return point[: half + 1][::-1], np.concatenate([point[half:], point[:1]])


@lru_cache(maxsize=16)
def _layout(upper_count: int, lash_count: int, brow_count: int, mirrored: bool) -> RegionLayout:
    tear_uv = _grid_uv(np.arange(COLUMNS + 1) / COLUMNS, np.full(TEAR_ROWS, band_row(TEAR)))
    brow_uv = np.tile([0.5, band_row(BROW)], (brow_count * len(BROW_PLACES) * 3, 1))
    parts = [
        (sheet_faces(), _sheet_uv()),
        (tube_faces(lash_count, SEGMENTS + 1), _lash_uv(upper_count, lash_count)),
        (tube_faces(brow_count, len(BROW_PLACES), pointed=True), brow_uv),
        (_tear_faces(), tear_uv),
    ]
    faces, uv, start = [], [], 0
    for f, t in parts:
        faces.append(f + start)
        uv.append(t)
        start += len(t)
    joined = np.concatenate(faces)
    if mirrored:
        joined = joined[:, ::-1]
    return RegionLayout(
        frozen(joined, np.int64),
        frozen(np.concatenate(uv)),
        frozen(np.cumsum([len(t) for t in uv]), np.int64),
        frozen(np.cumsum([len(f) for f in faces]), np.int64),
    )


def _tear_faces() -> Ints:
    """Return triangles (m, 3) of the menisci where they have any height."""
    n = COLUMNS + 1
    high = on_globe(2 * np.pi * np.arange(n) / COLUMNS) > 0
    i, j = np.meshgrid(np.arange(TEAR_ROWS - 1), np.flatnonzero(high[:-1] | high[1:]), indexing="ij")
    a, b, c, d = i * n + j, i * n + j + 1, (i + 1) * n + j, (i + 1) * n + j + 1
    both = [np.stack([a, c, d], -1).reshape(-1, 3), np.stack([a, d, b], -1).reshape(-1, 3)]
    return np.concatenate(both).astype(np.int64)


@lru_cache(maxsize=1)
def sheet_faces() -> Ints:
    """Return triangles (m, 3) of the sheet, row by row.

    From the row `FINE` on, cells are two columns wide. That row itself has a vertex in every column for the cells
    before it. Every second one lies on an edge of the cells after it, which is divided there, so that no gap opens.
    """
    out = []
    for i in range(ROWS - 1):
        wide = 1 if i < FINE else 2
        j = np.arange(0, COLUMNS, wide)
        a, b, c, d = (sheet_vertices(i + k, j + n) for k in (0, 1) for n in (0, wide))
        middle = sheet_vertices(i, j + 1)
        upper = [(a, d, middle), (middle, d, b)] if i == FINE else [(a, d, b)]
        out += [np.stack(corners, axis=-1) for corners in ((a, c, d), *upper)]
    return frozen(np.concatenate(out), np.int64)


def sheet_vertices(row: Ints | int, column: Ints | int) -> Ints:
    """Return vertex numbers at rows and columns of the sheet's grid; rows beyond `FINE` have even columns only."""
    half = COLUMNS // 2
    coarse = half * (FINE + 1) + (half + 1) * row + column // 2
    return np.where(np.greater(row, FINE), coarse, (COLUMNS + 1) * row + column)


@lru_cache(maxsize=1)
def sheet_ends() -> Bools:
    """Return whether each triangle of the sheet of skin is in its first or last row, which no other row continues."""
    within = (sheet_vertices(1, 0) <= sheet_faces()) & (sheet_faces() < sheet_vertices(ROWS - 1, 0))
    return frozen(~within.all(axis=1), np.bool_)


@lru_cache(maxsize=1)
def sheet_codes() -> Ints:
    """Say what each triangle of the sheet is: 0 conjunctiva and caruncle, 1 upper lid, 2 lower lid, 3 face.

    A lid reaches from the inner edge of its margin to its crease.
    """
    i, j = np.meshgrid(np.arange(ROWS), np.arange(COLUMNS + 1), indexing="ij")
    row, column = (np.zeros(int(sheet_vertices(ROWS - 1, COLUMNS)) + 1, np.int64) for _ in range(2))
    even = (i <= FINE) | (j % 2 == 0)
    row[sheet_vertices(i, j)[even]], column[sheet_vertices(i, j)[even]] = i[even], j[even]
    first = row[sheet_faces()].min(axis=1)
    lid = np.where(column[sheet_faces()].max(axis=1) <= COLUMNS // 2, 1, 2)
    beyond = np.where(first < CONJUNCTIVA + MARGIN + LID, lid, 3)
    return frozen(np.where(first < CONJUNCTIVA, 0, beyond), np.int64)


@lru_cache(maxsize=1)
def sheet_neighbours() -> Ints:
    """Return the numbers (2, ROWS, COLUMNS) of the vertices at each grid position, or before and after it."""
    i, j = np.meshgrid(np.arange(ROWS), np.arange(COLUMNS), indexing="ij")
    odd = np.where(i > FINE, j % 2, 0)
    return frozen(np.stack([sheet_vertices(i, j - odd), sheet_vertices(i, j + odd)]), np.int64)


def _sheet_uv() -> Floats:
    u = np.arange(COLUMNS + 1) / COLUMNS
    v = sheet_v(np.linspace(0, 1, ROWS))
    parts = (u, v[: FINE + 1]), (u[::2], v[FINE + 1 :])
    return np.concatenate([_grid_uv(*part) for part in parts])


def _grid_uv(u: Floats, v: Floats) -> Floats:
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _lash_uv(upper_count: int, count: int) -> Floats:
    """Compute map coordinates of lashes, upper ones first: u runs from root to tip in its lid's half of the band."""
    along = LASH_U[0] + LASH_U[1] * np.arange(SEGMENTS + 1) / SEGMENTS
    lower = np.where(np.arange(count) < upper_count, 0.0, 0.5)
    u = np.repeat((lower[:, None] + along).reshape(-1), 3)
    return np.stack([u, np.full_like(u, band_row(LASH))], axis=-1)
