"""Patches of skin, globe and background that exchange light, and interpolation between them (host)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...base.arrays import ArrayValue, Bools, Floats, Ints, Singles
from ...region.globe import Globe
from ...region.mesh import RegionMesh

GLOBE_COLUMNS, GLOBE_ROWS = 40, 12  # patches between the lids
MAP_SIDE = 26  # grid over the front of a bare globe
WIDEST = 0.55 * np.pi  # polar angle of the edge of that map
_HALF_MM, _HIGH_MM = 14.0, 8.0  # half width and half height of the opening of a head mesh, whose margins are unknown
_FINE_MM, _NEAR_MM = (
    1.25,
    12.0,
)  # distance of patches on skin this far from the middle of the fissure, and in proportion
_NEIGHBOURS = 12
_MARGIN_LEVEL = -2  # level of the lid margins: half the distance
# Across the margins light changes fast: so many times as fast with the height above the globe as along them. They are
# between these heights: the conjunctiva is lower, and the lids' outer sides are higher.
_STEEP, _LOW_MM, _TOP_MM = 4.0, 0.04, 1.6
_LID_MM = 4.0  # distance from the sclera's sphere to the outside of a lid over the cornea


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SkinPatches(ArrayValue):
    """Vertices of a region that represent the skin around them; they move with the tissue."""

    vertices: Ints  # (n,) indices of the vertices
    nearest: Ints  # (all vertices,) patch that represents each vertex
    # (l,) patches on the skin right in front of the globe, whose inner sides enclose the space around the cornea
    lids: Ints
    behind: Ints  # (all vertices,) index in `lids` of the patch for the inner side of each; -1 for none
    near: Ints  # (all vertices, k) patches around every vertex
    weight: Singles  # (all vertices, k) their weights there


def skin_patches(mesh: RegionMesh, globe: Globe) -> SkinPatches:
    """Choose patches on a region's mesh: one for each cell of a grid that grows with the distance from the eye.

    On the lid margins the cells are smaller, above all across the margin. `mesh`: the region with the eye straight
    ahead and open lids; `globe`: the globe in that pose.
    """
    ends = mesh.layout.vertex_ends
    solid = np.arange(ends[0])
    if "head" in mesh.parts:  # what is neither hair nor tears
        solid = np.append(solid, np.arange(ends[3], ends[4]))
    # Coordinates (n, 4) of vertices: their points (mm), and a fourth one that grows across the lid margins.
    height = globe.clearance(mesh.vertices * globe.mirror)
    where = np.column_stack([mesh.vertices, _STEEP * (np.clip(height, _LOW_MM, _TOP_MM) - _LOW_MM)])
    p, n, w = mesh.vertices[solid], mesh.normals[solid], where[solid]
    level = np.maximum(np.round(2 * np.log2(np.maximum(np.linalg.norm(p, axis=1), 1e-3) / _NEAR_MM)), 0)
    out = _relative_to_globe(globe, p)
    away = np.linalg.norm(out, axis=1)
    # The margins of the lids, which do not face away from the globe.
    margin = (away < globe.radius_mm + _LID_MM) & (np.sum(out * n, axis=1) < 0.6 * away) & (w[:, 3] > 0)
    level = np.where(margin, _MARGIN_LEVEL, level)
    size = _FINE_MM * 2 ** (level / 2)
    keys = np.column_stack([level, np.floor(w / size[:, None]), np.round(1.2 * n)]).astype(np.int64)
    _, first, group, count = np.unique(keys, axis=0, return_index=True, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    middle = np.stack([np.bincount(group, c) for c in w.T], axis=1) / count[:, None]
    away = np.linalg.norm(w - middle[group], axis=1)
    # Two vertices are equally far from their middle. Rounded, the first one is chosen on every processor.
    order = np.lexsort((np.round(away, 6), group))
    chosen = solid[order[np.searchsorted(group[order], np.arange(len(first)))]]
    near, weight = _neighbours(mesh.normals, where, chosen, size[first])
    nearest = near[np.arange(len(near)), np.argmax(weight, axis=1)]
    out = _relative_to_globe(globe, mesh.vertices[chosen])
    away = np.linalg.norm(out, axis=1)
    over = (away < globe.radius_mm + _LID_MM) & (np.sum(out * mesh.normals[chosen], axis=1) > 0.2 * away)
    lids = np.flatnonzero(over & (out[:, 0] > 0))
    index = np.full(len(chosen), -1)
    index[lids] = np.arange(len(lids))
    return SkinPatches(
        vertices=chosen, nearest=nearest, lids=lids, behind=index[nearest], near=near, weight=weight
    )  # fmt: skip


def _relative_to_globe(globe: Globe, points: Floats) -> Floats:
    """Return points (n, 3) of the scene's frame relative to the centre of a globe at rest."""
    return np.asarray(points - globe.centre * globe.mirror)


def _neighbours(normals: Floats, where: Floats, chosen: Ints, size: Floats) -> tuple[Ints, Singles]:
    """Return the nearest patches at every vertex, and their weights.

    A patch's weight falls with distance and with the angle between the normals.
    """
    k = min(_NEIGHBOURS, len(chosen))
    distance, index = cKDTree(where[chosen]).query(where, k=k)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    facing = np.einsum("vi,vki->vk", normals, normals[chosen[index]])
    weight = np.exp(-np.square(distance / size[index])) * np.maximum(facing, 0.02) ** 3 + 1e-9
    weight /= weight.sum(axis=1, keepdims=True)
    return index.astype(np.int64), weight.astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobePatches(ArrayValue):
    """Points of the globe in the scene's frame, on a grid of `rows` by `columns`.

    Between lids, columns have constant y and rows divide the opening. On a bare globe, the grid covers its front in
    azimuthal equidistant projection.
    """

    points: Floats  # (rows * columns, 3) mm
    normals: Floats  # (rows * columns, 3) unit normals of the sclera's sphere
    # numbers from which the kernels compute a point's position in the grid: centre 3, first y, columns per mm, then the
    # lower and upper end of each column (mm)
    table: Floats
    columns: int  # number of columns
    rows: int  # number of rows


def globe_patches(globe: Globe, mesh: RegionMesh | None) -> GlobePatches:
    """Choose patches on a posed globe, between the lids of a region or on the front of the bare globe."""
    centre = globe.centre * globe.mirror
    if mesh is None:
        return _on_front(globe, centre)
    y, low, high = _opening(globe, centre, mesh)
    share = (np.arange(GLOBE_ROWS) + 0.5) / GLOBE_ROWS
    z = low + share[:, None] * (high - low)
    dy, dz = np.broadcast_to(y - centre[1], z.shape), z - centre[2]
    dx = np.sqrt(np.maximum(globe.radius_mm**2 - dy * dy - dz * dz, 1.0))
    table = np.concatenate([centre, [y[0], (GLOBE_COLUMNS - 1) / (y[-1] - y[0])], np.stack([low, high], 1).ravel()])
    return _on_globe(globe, centre, np.stack([dx, dy, dz], -1).reshape(-1, 3), table, GLOBE_COLUMNS, GLOBE_ROWS)


def _opening(globe: Globe, centre: Floats, mesh: RegionMesh) -> tuple[Floats, Floats, Floats]:
    """Compute the columns y of the grid and the ends (z) of the lid opening there, mm."""
    if len(mesh.upper_margin) == 0:
        y = centre[1] + np.linspace(-0.9, 0.9, GLOBE_COLUMNS) * min(_HALF_MM, globe.radius_mm)
        return y, np.full_like(y, centre[2] - _HIGH_MM), np.full_like(y, centre[2] + _HIGH_MM)
    upper, lower = (m[np.argsort(m[:, 1])] for m in (mesh.upper_margin, mesh.lower_margin))
    reach = 0.97 * globe.radius_mm
    ends = max(upper[0, 1], lower[0, 1], centre[1] - reach), min(upper[-1, 1], lower[-1, 1], centre[1] + reach)
    y = np.linspace(*ends, GLOBE_COLUMNS)
    low, high = np.interp(y, lower[:, 1], lower[:, 2]), np.interp(y, upper[:, 1], upper[:, 2])
    return y, low, np.maximum(high, low + 1e-3)


def _on_front(globe: Globe, centre: Floats) -> GlobePatches:
    at = np.linspace(-WIDEST, WIDEST, MAP_SIDE)
    a, b = (v.ravel() for v in np.meshgrid(at, at))
    polar = np.minimum(np.hypot(a, b), np.pi - 0.01)
    s = np.sinc(polar / np.pi)
    table = np.concatenate([centre, np.zeros(2 + 2 * GLOBE_COLUMNS)])
    return _on_globe(globe, centre, np.stack([np.cos(polar), a * s, b * s], -1), table, MAP_SIDE, MAP_SIDE)


def _on_globe(globe: Globe, centre: Floats, way: Floats, table: Floats, columns: int, rows: int) -> GlobePatches:
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    points = centre + globe.radial(way * globe.mirror)[:, None] * way
    return GlobePatches(points=points, normals=way, table=table, columns=columns, rows=rows)


RINGS, TURNS = 24, 16  # patches on the plane of a surround
PLANE_MM, PLANE_FIRST_MM = 500.0, 1.0


def plane_patches(globe: Globe, plane_x: float) -> tuple[Floats, float]:
    """Compute points (RINGS * TURNS, 3) of the plane about a bare globe, and the radius (mm) of the first ring.

    Their distances from the globe grow by a constant factor, from `PLANE_FIRST_MM`.
    """
    centre = globe.centre * globe.mirror
    inner = np.sqrt(max(globe.radius_mm**2 - (plane_x - centre[0]) ** 2, 1.0)) + 0.05
    growth = np.log1p(PLANE_MM / PLANE_FIRST_MM) / (RINGS - 1)
    radius = inner + PLANE_FIRST_MM * np.expm1(growth * np.arange(RINGS))
    turn = 2 * np.pi * np.arange(TURNS) / TURNS
    y, z = radius[:, None] * np.cos(turn) + centre[1], radius[:, None] * np.sin(turn) + centre[2]
    return np.stack([np.full(y.size, plane_x), y.ravel(), z.ravel()], axis=1), float(inner)


def fill_gaps(
    values: Floats, valid: Bools, rows: int, columns: int, across: tuple[float, float] = (1.0, 1.0)
) -> Floats:
    """Replace values (rows * columns, k) by averages over valid neighbours, or over farther ones if none is valid.

    `across` is the weight of each neighbour along columns and along rows; the patch itself has weight 2.
    """
    weight = valid.reshape(rows, columns).astype(float)[..., None]
    total = values.reshape(rows, columns, -1) * weight
    out, known = np.zeros_like(total), np.zeros((rows, columns), dtype=bool)
    while True:
        total, weight = _blur(total, across), _blur(weight, across)
        new = (weight[..., 0] > 0) & ~known
        out[new] = total[new] / weight[new]
        known |= new
        if known.all() or not known.any():
            return np.asarray(out.reshape(len(values), -1))
        across = (1.0, 1.0)


def _blur(values: Floats, across: tuple[float, float]) -> Floats:
    """Sum the 3 x 3 neighbours with weights."""
    height, width, count = values.shape
    padded = np.zeros((height + 2, width + 2, count))
    padded[1:-1, 1:-1] = values
    rows = across[1] * (padded[:-2] + padded[2:]) + 2 * padded[1:-1]
    return np.asarray(across[0] * (rows[:, :-2] + rows[:, 2:]) + 2 * rows[:, 1:-1])
