"""Bodies of triangles between two points: a tree of boxes around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from ..base.arrays import ArrayValue, Body, Bools, Floats, frozen, remembered

_FEW = 8  # triangles of a leaf at most
_MARGIN_MM = 1e-3  # left out at both ends of a line, as in pictures
_ROUNDING_MM = 1e-9
_SHARP_RAD, _MOST_DRAWN = 0.35, 4000  # of edges that drawings show


@dataclass(frozen=True, slots=True, eq=False)
class TriangleTree(ArrayValue):
    """Triangles in a complete binary tree of boxes; the fields are those of `triangle_kernels.meet_between`."""

    boxes: Floats
    corners: Floats
    leaf: int

    @classmethod
    def of(cls, bodies: Sequence[Body]) -> Self:
        """Sort the triangles of bodies: each node's are halved at the median of the longer axis of their centres."""
        points = np.concatenate([body.vertices[body.faces] for body in bodies])
        levels = max(int(np.ceil(np.log2(len(points) / _FEW))), 0)
        leaf = -(-len(points) // 2**levels)
        # The last triangle is repeated, so that all leaves have as many.
        order = np.minimum(np.arange(leaf * 2**levels), len(points) - 1)[None]
        middle = points.mean(axis=1)
        for _ in range(levels):
            places = middle[order]
            axis = np.ptp(places, axis=1).argmax(axis=1)
            along = np.take_along_axis(places, axis[:, None, None], axis=2)[..., 0]
            order = np.take_along_axis(order, np.argsort(along, axis=1, kind="stable"), axis=1)
            order = order.reshape(2 * len(order), -1)
        points = points[order.ravel()]
        each = points.reshape(2**levels, -1, 3)
        boxes = [np.stack([each.min(axis=1) - _ROUNDING_MM, each.max(axis=1) + _ROUNDING_MM], axis=1)]
        for _ in range(levels):
            pairs = boxes[0].reshape(-1, 2, 2, 3)
            boxes.insert(0, np.stack([pairs[:, :, 0].min(axis=1), pairs[:, :, 1].max(axis=1)], axis=1))
        edges = np.stack([points[:, 0], points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]], axis=1)
        return cls(frozen(np.concatenate(boxes)), frozen(edges), leaf)

    def blocks(self, start_mm: Floats, end_mm: Floats) -> Bools:
        """Return whether any triangle lies between points (..., 3); False where one is NaN."""
        # Numba is loaded only where something may block light.
        from .triangle_kernels import meet_between

        start, end = np.broadcast_arrays(start_mm, end_mm)
        out = np.empty(start.shape[:-1], dtype=bool)
        a, b = (np.ascontiguousarray(points.reshape(-1, 3), dtype=np.float64) for points in (start, end))
        meet_between(np.array(self.boxes), np.array(self.corners), self.leaf, a, b, _MARGIN_MM, out.reshape(-1))
        return out


@remembered
def sharp_edges(body: Body) -> Floats:
    """Return edges (n, 2, 3) mm of a body for drawings: where it bends, evenly chosen if they are too many."""
    import trimesh

    mesh = trimesh.Trimesh(body.vertices, body.faces)
    bends = mesh.face_adjacency_edges[mesh.face_adjacency_angles > _SHARP_RAD]
    edges = bends if len(bends) else mesh.edges_unique
    return frozen(mesh.vertices[edges[:: 1 + len(edges) // _MOST_DRAWN]])


def holds(body: Body, point_mm: Floats) -> bool:
    """Return whether a point is inside a closed body: its solid angle there is that of a sphere, not 0.

    The solid angles of triangles are those of van Oosterom and Strackee (1983).
    """
    a, b, c = np.moveaxis((body.vertices - point_mm)[body.faces], 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    below = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    angle = 2.0 * np.arctan2((a * np.cross(b, c)).sum(axis=1), below).sum()
    return bool(abs(angle) > 2.0 * np.pi)


@remembered
def tree_of(*bodies: Body) -> TriangleTree:
    """Return the tree of bodies, which are the same objects from frame to frame."""
    return TriangleTree.of(bodies)
