"""Background of an eye without a region: a matte plane and obstacles.

The background is fixed in the scene's frame (the world's axes, origin at the apex of the unrotated eye), so it need not
be rebuilt for another pose or camera. The plane is matte skin behind the apex, and the globe protrudes through it. It
does not imitate lids and brow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import OBSTACLE, Body, Bools, Floats, Ints, Singles
from ...optics.vectors import lengths
from ...region.look import Look
from ...region.mapcache import kept
from ...region.texture import skin_texture
from ..records.frame import aligned_copy
from ..records.recording import recorded

HALF_MM = 500.0
PLANE_FACES = 2  # of the plane, before those of obstacles
_TILE_MM = 60.0
_FEWEST = 64  # rays


@dataclass(frozen=True, slots=True)
class Matte:
    """Points of the background: position, geometric normal (scene's frame), albedo."""

    point: mi.Vector3f
    normal: mi.Vector3f
    albedo: mi.Float


@dataclass(kw_only=True)
class BackgroundGeometry:
    """Triangles of the background for the kernels, and the map of its plane.

    Kernels read them from buffers instead of calling methods of Mitsuba's shapes and materials, because the code of
    such a call depends on the number of objects that the process has created.
    """

    corners: mi.UInt32  # four entries for each triangle, of which the first three are its vertices
    vertices: mi.Float  # four numbers per vertex: position (mm), and albedo, or a negative number to use the map
    map: Any  # albedo of the plane

    @classmethod
    def of(cls, faces: Ints) -> BackgroundGeometry:
        """Copy the triangles (m, 3) to the device."""
        corners = np.zeros((len(faces), 4), np.uint32)  # four entries, which are gathered together
        corners[:, :3] = faces
        blank, texture = mi.TensorXf(np.zeros((2, 2, 1), np.float32)), cast(Any, mi.Texture2f)
        plane = texture(blank, use_accel=False, wrap_mode=dr.WrapMode.Repeat)
        return cls(corners=mi.UInt32(aligned_copy(corners.ravel())), vertices=mi.Float(0), map=plane)

    def place(self, vertices: Floats, albedo: Floats) -> None:
        """Set the vertices (n, 3) mm and their albedos (n,); a negative albedo selects the map of the plane."""
        self.vertices = mi.Float(aligned_copy(np.column_stack([vertices, albedo]).astype(np.float32).ravel()))

    def paint(self, tile: Floats) -> None:
        """Set the repeating albedo map of the plane."""
        self.map.set_tensor(mi.TensorXf(tile.astype(np.float32)[..., None]))

    def surface(self, face: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> Matte:
        """Compute the surface at barycentric coordinates `uv` of triangles."""
        corner = dr.gather(mi.Vector4u, self.corners, face, active)
        a, b, c = (dr.gather(mi.Vector4f, self.vertices, i, active) for i in (corner.x, corner.y, corner.z))
        at = a + uv.x * (b - a) + uv.y * (c - a)
        p, q, r = (mi.Vector3f(v.x, v.y, v.z) for v in (a, b, c))
        around = mi.Point2f(at.y + HALF_MM, at.z + HALF_MM) / _TILE_MM
        mapped = self.map.eval(around, active)[0]
        normal = dr.normalize(dr.cross(q - p, r - p))
        return Matte(mi.Vector3f(at.x, at.y, at.z), normal, dr.select(a.w < 0, mapped, a.w))


class Background:
    """The Mitsuba scene of the background, with the faces of obstacles; `show` changes its look and places."""

    posed = None  # no region
    parts = "head", OBSTACLE

    def __init__(self, obstacles: Sequence[Body] = ()) -> None:
        self._vertices, self._albedos = np.zeros((0, 3)), np.zeros(0)
        self._faces = triangles = _faces(obstacles)
        self.face_ends = np.array([PLANE_FACES, len(triangles)])
        self._place(10.0, obstacles)
        mesh = mi.Mesh("background", len(self._vertices), len(triangles))
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(self._vertices.astype(np.float32).ravel())
        params["faces"] = mi.UInt32(triangles.astype(np.uint32).ravel())
        params.update()
        # Without robust intersections, rays slip between neighbouring triangles on some processors.
        self.scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "background": mesh})
        self._params: Any = mi.traverse(self.scene)
        self.geometry = BackgroundGeometry.of(triangles)
        self.obstructed = len(obstacles) > 0
        self._shown: tuple[float, float, float] | None = None

    def _place(self, distance_mm: float, obstacles: Sequence[Body]) -> bool:
        """Set the vertices, and return whether any of them moved or changed."""
        vertices = np.concatenate([_corners(distance_mm), *(body.vertices for body in obstacles)])
        albedos = np.concatenate([np.full(4, -1.0), *(np.full(len(b.vertices), b.albedo) for b in obstacles)])
        same = np.array_equal(vertices, self._vertices) and np.array_equal(albedos, self._albedos)
        self._vertices, self._albedos = vertices, albedos
        return not same

    def takes(self, obstacles: Sequence[Body]) -> bool:
        """Return whether obstacles have the faces of this background."""
        count = 4 + sum(len(body.vertices) for body in obstacles)
        return len(self._vertices) == count and np.array_equal(self._faces, _faces(obstacles))

    def show(self, look: Look, obstacles: Sequence[Body] = ()) -> None:
        """Set distance, albedo and contrast of the plane from a look, and place obstacles (scene's frame)."""
        wanted = (look.backdrop_distance_mm, look.backdrop_albedo, look.backdrop_contrast)
        moved = self._place(wanted[0], obstacles)
        if wanted == self._shown and not moved:
            return
        if self._shown is None or moved:
            self._params["background.vertex_positions"] = mi.Float(self._vertices.astype(np.float32).ravel())
            self._params.update()
            self.geometry.place(self._vertices, self._albedos)
        tile = wanted[1] * (1 + wanted[2] * (kept(skin_texture, 1) - 1))
        self.geometry.paint(np.clip(tile, 0.0, 0.98))
        self._shown = wanted

    def clear(self, a: Floats, b: Floats) -> Bools:
        """Return whether the background leaves the lines between points (n, 3), scene's frame, free; ends excluded."""
        return clear_between(self.scene, a, b) if self.obstructed else _beside_plane(self._vertices[0, 0], a, b)


def _faces(obstacles: Sequence[Body]) -> Ints:
    """Return the triangles (m, 3) of the plane and of obstacles behind it in the list of vertices."""
    starts = 4 + np.cumsum([0, *(len(body.vertices) for body in obstacles)])
    own = [body.faces + start for body, start in zip(obstacles, starts[:-1], strict=True)]
    return np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]), *own])


def _beside_plane(x: float, a: Floats, b: Floats) -> Bools:
    """Return whether the plane at x leaves the line between points (n, 3) free."""
    table = _between(a, b).astype(float)
    o, d, length = table[:, :3], table[:, 3:6], table[:, 6]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (x - o[:, 0]) / d[:, 0]
        y, z = o[:, 1] + t * d[:, 1], o[:, 2] + t * d[:, 2]
        met = (t > 0) & (t < length) & (np.maximum(np.abs(y), np.abs(z)) < HALF_MM)
    return np.asarray(~met)


def clear_between(scene: mi.Scene, a: Floats, b: Floats) -> Bools:
    """Return whether a Mitsuba scene leaves the line between points (n, 3) of its frame free, ends excluded."""
    if not len(a):
        return np.zeros(0, dtype=bool)
    # Rounding the number of rays up gives few different sizes, so that recordings are replayed.
    step = max(1 << len(a).bit_length() >> 3, _FEWEST)
    count = -(-len(a) // step) * step
    table = _between(a, b)[np.minimum(np.arange(count), len(a) - 1)]
    return ~np.asarray(_met(scene, mi.Float(aligned_copy(table.ravel())), count).numpy()[: len(a)], dtype=bool)


@recorded
def _met(scene: mi.Scene, table: mi.Float, count: int) -> mi.Bool:
    """Return whether rays meet anything; each row of the table holds origin, direction and length."""
    met = scene.ray_test(_rays(table, count))
    dr.eval(met)
    return met


def rays_between(a: Floats, b: Floats, margin_mm: float = 1e-3) -> mi.Ray3f:
    """Compute rays from points (n, 3) towards points b, without the last `margin_mm` at both ends."""
    table = _between(a, b, margin_mm)
    return _rays(mi.Float(table.ravel()), len(table))


def _between(a: Floats, b: Floats, margin_mm: float = 1e-3) -> Singles:
    """Compute origin, direction and length (n, 7) of the rays of `rays_between`."""
    length = lengths(b - a)
    d = (b - a) / length[:, None]
    return np.column_stack([a + margin_mm * d, d, length - 2 * margin_mm]).astype(np.float32)


def _rays(table: mi.Float, count: int) -> mi.Ray3f:
    # The values are gathered from one buffer, otherwise the kernel would depend on the alignment of every NumPy array.
    row = dr.arange(mi.UInt32, count) * 7
    o = [dr.gather(mi.Float, table, row + k) for k in range(7)]
    ray = mi.Ray3f(mi.Point3f(*o[:3]), mi.Vector3f(*o[3:6]))
    ray.maxt = o[6]
    return ray


def _corners(distance_mm: float) -> Floats:
    h = HALF_MM
    return np.array([[-distance_mm, y, z] for y, z in ((-h, -h), (h, -h), (h, h), (-h, h))])


def blockers(place: Any, a: Floats, b: Floats) -> list[str | None]:
    """Return the first part of a background or region between points (n, 3) a and b; None if there is none."""
    hit = place.scene.ray_intersect_preliminary(rays_between(a, b), coherent=False, active=True)
    valid, face = hit.is_valid(), mi.UInt32(hit.prim_index)
    dr.eval(valid, face)
    which = np.searchsorted(place.face_ends, face.numpy(), side="right")
    return [place.parts[int(w)] if v else None for v, w in zip(valid.numpy(), which, strict=True)]
