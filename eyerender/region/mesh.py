"""The whole region as one triangle mesh with one map, posed with the globe; its topology never changes.

Vertices are in the region's frame of a right eye. For a left eye they are mirrored, and the faces have the other
orientation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh

from ..arrays import ArrayValue, Bools, Floats, Ints, frozen
from ..geometry.vectors import lengths
from .anatomy import Region
from .brow import brow
from .contour import COLUMNS, Contour, contour
from .globe import Globe
from .hairs import SEGMENTS, Hairs, tube_faces
from .lashes import lashes
from .lids import ROWS, grid_normals, sheet
from .skin import BROW, LASH, LASH_U, TEAR, band_row, sheet_v
from .tears import ROWS as TEAR_ROWS
from .tears import meniscus

PARTS = ("skin", "tears", "lashes", "brow")
HAIRS = 2  # the first of a mesh's strands, which are hairs


@dataclass(frozen=True, slots=True, eq=False)
class RegionLayout(ArrayValue):
    """What never moves: `faces` (m, 3), `uv` (n, 2), and where each part's vertices and faces end."""

    faces: Ints
    uv: Floats
    vertex_ends: Ints
    face_ends: Ints


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RegionMesh(ArrayValue):
    """A posed region in the scene's frame (mm).

    A mesh whose margins, border or strands are unknown has none of them.

    Attributes:
        vertices: (n, 3).
        normals: (n, 3) unit normals.
        layout: what never moves.
        upper_margin: (k, 3) landmarks along the upper lid's inner edge, from the temple to the nose.
        lower_margin: (k, 3) the same for the lower lid.
        border: (k, 3) outer end of the skin, closed.
        strands: curves (n, k, 3) of everything in front of the skin.
    """

    vertices: Floats
    normals: Floats
    layout: RegionLayout
    upper_margin: Floats
    lower_margin: Floats
    border: Floats
    strands: tuple[Floats, ...]

    def part(self, name: str) -> trimesh.Trimesh:
        """Return one part as a trimesh: skin, tears, lashes or brow."""
        i = PARTS.index(name)
        v0, f0 = (0, 0) if i == 0 else (int(self.layout.vertex_ends[i - 1]), int(self.layout.face_ends[i - 1]))
        v1, f1 = int(self.layout.vertex_ends[i]), int(self.layout.face_ends[i])
        return trimesh.Trimesh(self.vertices[v0:v1], self.layout.faces[f0:f1] - v0, process=False)


@dataclass(frozen=True, slots=True, eq=False)
class LidMargins(ArrayValue):
    """Landmarks (k, 3) along the lids' inner edges, like those of a `RegionMesh`."""

    upper_margin: Floats
    lower_margin: Floats


def lid_margins(spec: Region, globe: Globe) -> LidMargins:
    """Compute the lids' inner edges alone, without the mesh around them."""
    mirror = np.array([1.0, -1.0 if globe.mirrored else 1.0, 1.0])
    upper, lower = (frozen(edge * mirror) for edge in _margins(contour(spec, globe)))
    return LidMargins(upper, lower)


def region_mesh(spec: Region, globe: Globe) -> RegionMesh:
    """Make the region of a subject around a posed globe."""
    s = sheet(spec, globe)
    tears = meniscus(spec, globe, s)
    lash = lashes(spec, globe, s)
    hair, hair_tubes, hair_normals = _brow(spec.model_copy(update={"blink": 0.0}))
    lash_tubes = lash.tubes()
    vertices = np.concatenate([_closed(s.vertices), _closed(tears), lash_tubes, hair_tubes])
    normals = np.concatenate([_closed(s.normals), _closed(grid_normals(tears)), _round(lash, lash_tubes), hair_normals])
    upper, lower = _margins(s.contour)
    curves = [upper, lower, s.vertices[-1], lash.points, hair.points, np.concatenate([tears, tears[:, :1]], axis=1)]
    if globe.mirrored:
        mirror = np.array([1.0, -1.0, 1.0])
        vertices, normals, curves = vertices * mirror, normals * mirror, [c * mirror for c in curves]
    upper, lower, border, *strands = (frozen(c) for c in curves)
    layout = _layout(spec.lashes.upper_count, len(lash.points), len(hair.points), globe.mirrored)
    return RegionMesh(
        vertices=frozen(vertices),
        normals=frozen(normals),
        layout=layout,
        upper_margin=upper,
        lower_margin=lower,
        border=border,
        strands=tuple(strands),
    )


def _closed(grid: Floats) -> Floats:
    """Flattened grid with its first column repeated at the end, where the map's u is 1."""
    return np.concatenate([grid, grid[:, :1]], axis=1).reshape(-1, 3)


@lru_cache(maxsize=16)
def _brow(spec: Region) -> tuple[Hairs, Floats, Floats]:
    """Brow, its tubes and their normals; it does not blink."""
    hairs = brow(spec)
    tubes = frozen(hairs.tubes())
    return hairs, tubes, frozen(_round(hairs, tubes))


def _round(hairs: Hairs, tubes: Floats) -> Floats:
    """Normals of tubes, away from their curves."""
    if len(tubes) == 0:
        return np.zeros((0, 3))
    away = tubes - np.repeat(hairs.points.reshape(-1, 3), 3, axis=0)
    return np.asarray(away / np.maximum(lengths(away)[..., None], 1e-12))


def _margins(fissure: Contour) -> tuple[Floats, Floats]:
    point = fissure.point
    half = COLUMNS // 2
    return point[: half + 1][::-1], np.concatenate([point[half:], point[:1]])


@lru_cache(maxsize=16)
def _layout(upper_count: int, lash_count: int, brow_count: int, mirrored: bool) -> RegionLayout:
    parts = [
        (_grid_faces(ROWS), _grid_uv(ROWS, None)),
        (_grid_faces(TEAR_ROWS), _grid_uv(TEAR_ROWS, band_row(TEAR))),
        (tube_faces(lash_count, SEGMENTS + 1), _lash_uv(upper_count, lash_count)),
        (tube_faces(brow_count, 5), _hair_uv(brow_count, 5, band_row(BROW))),
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


def _grid_faces(rows: int) -> Ints:
    n = COLUMNS + 1
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(COLUMNS), indexing="ij")
    a, b, c, d = i * n + j, i * n + j + 1, (i + 1) * n + j, (i + 1) * n + j + 1
    both = [np.stack([a, c, d], -1).reshape(-1, 3), np.stack([a, d, b], -1).reshape(-1, 3)]
    return np.concatenate(both).astype(np.int64)


@lru_cache(maxsize=1)
def sheet_ends() -> Bools:
    """Whether each triangle of the sheet of skin is in its first or last row, which no other row continues."""
    row = np.arange(2 * (ROWS - 1) * COLUMNS) % ((ROWS - 1) * COLUMNS) // COLUMNS
    return frozen((row == 0) | (row == ROWS - 2), np.bool_)


def _grid_uv(rows: int, v: float | None) -> Floats:
    u = np.arange(COLUMNS + 1) / COLUMNS
    down = sheet_v(np.linspace(0, 1, rows)) if v is None else np.full(rows, v)
    return np.stack(np.meshgrid(u, down), axis=-1).reshape(-1, 2)


def _lash_uv(upper_count: int, count: int) -> Floats:
    """Coordinates of lashes, upper ones first: u runs from root to tip in the half of the band of its lid."""
    along = LASH_U[0] + LASH_U[1] * np.arange(SEGMENTS + 1) / SEGMENTS
    lower = np.where(np.arange(count) < upper_count, 0.0, 0.5)
    u = np.repeat((lower[:, None] + along).reshape(-1), 3)
    return np.stack([u, np.full_like(u, band_row(LASH))], axis=-1)


def _hair_uv(count: int, points: int, v: float) -> Floats:
    return np.tile([0.5, v], (count * points * 3, 1)).reshape(-1, 2)
