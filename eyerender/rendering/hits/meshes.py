"""Refracting surfaces as triangle meshes: hits by Embree or OptiX, with interpolated normals.

A mesh is a patch of one of the eye's dielectric bodies (`eye.meshes`). It has its own Mitsuba scene, so a ray that has
been refracted by a surface cannot meet that surface again. Its points are on the triangles, its normals n / |n| are
interpolated from those of the vertices, n = sum_i b_i N_i with barycentric coordinates b_i. Paths and glints are found
by Newton's method on the mesh itself. Their derivatives need dn for a step of the point:

    dn = sum_i N_i db_i,    db_i linear in the step over the surface's plane (y, z)

Both are continuous over edges, so Newton's steps can cross them. Beyond the rim of the mesh, where no path ends, the
search continues on the closed form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import Bools, Cache, Floats, Ints
from ...eye.meshes import Patch, cornea_patches
from ...eye.model import EyeModel
from ...optics.formulas import NUMPY
from ...optics.surfaces import Surface, components, join
from ...optics.transforms import inverse_2x2, normalize
from ..records.frame import aligned_copy, upload_array
from ..records.surfaces import Bundle, DeviceSurface, NormalForm

_ABOVE_MM = 40.0  # height beyond every cornea along its axis
_STEPS = 12
_SETTLED = 1e-12
_PARALLEL = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorPoints:
    """Points that mirror sources to viewpoints (n, 3), in the eye frame."""

    point: Floats  # point on the mirror
    normal: Floats  # unit normal there
    arrives: Floats  # unit direction of the light before it is reflected
    leaves: Floats  # unit direction of the light after reflection
    cross_section: Floats  # cross section of the ray tube at the source per solid angle at the viewpoint, (n,) mm^2/sr
    found: Bools  # (n,) whether there is such a point


@dataclass(kw_only=True)
class MeshGeometry:
    """One surface as a mesh for the kernels, in the surface's own frame (+x outward, mm)."""

    scene: mi.Scene  # the mesh
    faces: mi.UInt32  # four entries for each triangle, of which the first three are its vertices
    vertices: mi.Float  # eight numbers per vertex: position, 0, normal, 0

    @classmethod
    def of(cls, name: str, vertices: Floats, normals: Floats, faces: Ints) -> MeshGeometry:
        """Create a mesh from vertices (n, 3), normals (n, 3) and triangles (m, 3)."""
        mesh = mi.Mesh(name, len(vertices), len(faces))
        params = mi.traverse(mesh)
        params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
        params["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
        params.update()
        scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "mesh": mesh})
        corners = np.zeros((len(faces), 4), np.uint32)
        corners[:, :3] = faces
        records = np.zeros((len(vertices), 8), np.float32)
        records[:, 0:3], records[:, 4:7] = vertices, normals
        return cls(scene=scene, faces=mi.UInt32(aligned_copy(corners.ravel())), vertices=upload_array(records))

    def hit(self, o: mi.Vector3f, d: mi.Vector3f) -> mi.PreliminaryIntersection3f:
        """Compute the first hit of rays in the surface's frame."""
        return self.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o), d), coherent=True, active=True)

    def above(self, y: mi.Float, z: mi.Float) -> mi.PreliminaryIntersection3f:
        """Compute the hit at given (y, z), with rays along the axis from outside."""
        return self.hit(mi.Vector3f(_ABOVE_MM, y, z), mi.Vector3f(-1, 0, 0))

    def corners(self, hit: mi.PreliminaryIntersection3f) -> tuple[list[mi.Vector3f], list[mi.Vector3f]]:
        """Return positions and normals of the corners of the hit triangles."""
        met = hit.is_valid()
        i = dr.gather(mi.Vector4u, self.faces, hit.prim_index, met)
        rows = [[dr.gather(mi.Vector4f, self.vertices, 2 * k + part, met) for k in (i.x, i.y, i.z)] for part in (0, 1)]
        places, normals = ([mi.Vector3f(r.x, r.y, r.z) for r in row] for row in rows)
        return places, normals

    def normal(self, hit: mi.PreliminaryIntersection3f) -> mi.Vector3f:
        """Compute the interpolated unit normal."""
        _, normals = self.corners(hit)
        return dr.normalize(_mixed(normals, hit.prim_uv))

    def form(self, hit: mi.PreliminaryIntersection3f) -> tuple[mi.Float, NormalForm]:
        """Compute the height x at a hit, and the normal form, whose Hessian is the slope of the normals."""
        places, normals = self.corners(hit)
        n = _mixed(normals, hit.prim_uv)
        inv = dr.rsqrt(dr.squared_norm(n))
        a, b = places[1] - places[0], places[2] - places[0]
        area = dr.rcp(a.y * b.z - a.z * b.y)
        first, second = normals[1] - normals[0], normals[2] - normals[0]

        def slope(v: mi.Vector3f) -> mi.Vector3f:
            return ((v.y * b.z - v.z * b.y) * area) * first + ((a.y * v.z - a.z * v.y) * area) * second

        return _mixed(places, hit.prim_uv).x, NormalForm(n * inv, inv, slope)


class SurfaceMesh:
    """One surface as a mesh, in its own frame (+x outward, mm), on the host in float64."""

    def __init__(self, patch: Patch, surface: Surface) -> None:
        self.rotation, self.origin = np.asarray(surface.rotation), np.asarray(surface.origin_mm)
        self.vertices = (patch.vertices - self.origin) @ self.rotation
        self.normals = patch.normals @ self.rotation
        self.faces = np.asarray(patch.faces)
        # the same mesh for the kernels
        self.geometry = MeshGeometry.of(patch.name, self.vertices, self.normals, self.faces)

    def mirrored(self, start: Floats, source: Floats, viewpoint: Floats) -> MirrorPoints:
        """Solve for mirror points of sources (n, 3) and viewpoints (n, 3), from starts (n, 3) near them; eye frame."""
        y, lamp, node = ((p - self.origin) @ self.rotation for p in (start, source, viewpoint))
        q = y[:, 1:].copy()
        found = np.ones(len(q), dtype=bool)
        for _ in range(_STEPS):
            x, n, slope, normal_slope, there = self._at(q)
            found &= there
            miss, jacobian = _unevenness(x, n, slope, normal_slope, lamp, node)
            determinant = np.linalg.det(jacobian)
            found &= np.abs(determinant) > _SETTLED
            jacobian[~found] = np.eye(2)
            step = np.einsum("nij,nj->ni", inverse_2x2(jacobian), miss)
            q = np.where(found[:, None], q - step, q)
            if not found.any() or np.max(np.abs(step[found])) < _SETTLED:
                break
        x, n, _, normal_slope, there = self._at(q)
        miss, _ = _unevenness(x, n, _, normal_slope, lamp, node)
        found &= there & (np.max(np.abs(miss), axis=1) < _PARALLEL)
        out, arrive = normalize(x - node), normalize(x - lamp)
        N = normalize(n)
        tube = _tube(out, x, N, n, normal_slope, lamp, node)
        point, normal, arrives, leaves = (p @ self.rotation.T for p in (x, N, arrive, -out))
        point = point + self.origin
        return MirrorPoints(
            point=point, normal=normal, arrives=arrives, leaves=leaves, cross_section=tube, found=found
        )  # fmt: skip

    def _at(self, q: Floats) -> tuple[Floats, Floats, Floats, Floats, Bools]:
        """Compute points of the mesh at (y, z) (n, 2).

        Returns:
            Points (n, 3) and normals (n, 3) (not unit), their derivatives by y and z (n, 3, 2), and whether the mesh
            reaches there.
        """
        hit = self.geometry.above(*(mi.Float(aligned_copy(c.astype(np.float32))) for c in q.T))
        valid, face = hit.is_valid(), hit.prim_index
        dr.eval(valid, face)
        there = np.asarray(valid.numpy(), dtype=bool)
        corners = self.faces[np.where(there, face.numpy(), 0)]
        p, n = self.vertices[corners], self.normals[corners]
        edges = np.swapaxes(p[:, 1:] - p[:, :1], 1, 2)  # (n, 3, 2)
        inverse = inverse_2x2(edges[:, 1:])  # steps in (y, z) to barycentric coordinates
        uv = np.einsum("nij,nj->ni", inverse, q - p[:, 0, 1:])
        turns = np.swapaxes(n[:, 1:] - n[:, :1], 1, 2)
        point = p[:, 0] + np.einsum("nij,nj->ni", edges, uv)
        normal = n[:, 0] + np.einsum("nij,nj->ni", turns, uv)
        return point, normal, edges @ inverse, turns @ inverse, there


def _either(which: mi.Bool, one: NormalForm, other: NormalForm) -> NormalForm:
    """Select one of two normal forms by a mask."""
    return NormalForm(
        dr.select(which, one.normal, other.normal),
        dr.select(which, one.inverse, other.inverse),
        lambda v: dr.select(which, one.hessian(v), other.hessian(v)),
    )


@dataclass(frozen=True, slots=True)
class MeshedSurface(DeviceSurface):
    """A refracting surface whose hits, normals and their slopes are those of a mesh."""

    mesh: MeshGeometry | None = None

    def _mesh(self) -> MeshGeometry:
        assert self.mesh is not None
        return self.mesh

    def meet(self, o: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Float, mi.Bool, mi.Vector3f]:
        """Compute the distance to the mesh, success, and the interpolated unit normal."""
        hit = self._mesh().hit(o, d)
        N = self._mesh().normal(hit)
        met = hit.is_valid() & (dr.dot(d, N) < 0)
        return dr.select(met, hit.t, 0), met, N

    def on_surface(self, x: mi.Vector3f) -> tuple[mi.Vector3f, NormalForm]:
        """Return the mesh point at the same local (y, z), and its form; beyond the mesh those of the closed form."""
        l = self.point_in(x)
        hit = self._mesh().above(l.y, l.z)
        met = hit.is_valid()
        height, form = self._mesh().form(hit)
        outside, other = DeviceSurface.on_surface(self, x)
        point = dr.select(met, x + self.vector_out(mi.Vector3f(height - l.x, 0, 0)), outside)
        return point, _either(met, form, other)

    def refract_bundle(self, b: Bundle) -> tuple[Bundle, mi.Float, mi.Bool]:
        """Refract a bundle into the eye at the mesh; beyond the mesh at the closed form."""
        hit = self._mesh().hit(self.point_in(b.y), self.vector_in(b.w))
        met = hit.is_valid()
        t, form = hit.t, self._mesh().form(hit)[1]
        far, ok, _ = DeviceSurface.meet(self, self.point_in(b.y), self.vector_in(b.w))
        t = dr.select(met, t, far)
        there = b.advance(t)
        out, share, c = self.bend(there, _either(met, form, self._normal_form(self.point_in(there.y))))
        return out, share, (met | ok) & (c > 1e-4)


class Meshes:
    """Cache of the last eyes' corneas as meshes."""

    def __init__(self) -> None:
        self._made: Cache[tuple[SurfaceMesh, ...]] = Cache()

    def of(self, eye: EyeModel, edge_mm: float) -> tuple[SurfaceMesh, ...]:
        """Return meshes of an eye's refracting surfaces in front of the iris, with edges of at most about `edge_mm`."""
        stop = np.concatenate([eye.stop.centre_mm, eye.stop.normal])
        key = (eye.front, float(eye.limbus_radius_mm), stop.tobytes(), edge_mm)

        def make() -> tuple[SurfaceMesh, ...]:
            patches = cornea_patches(eye, *resolution(float(eye.limbus_radius_mm), edge_mm))
            return tuple(SurfaceMesh(p, s) for p, s in zip(patches, eye.front, strict=True))

        return self._made.get(key, make)


def resolution(radius_mm: float, edge_mm: float) -> tuple[int, int]:
    """Compute the numbers of rings and sectors of a cap whose edges are at most `edge_mm` long."""
    return math.ceil(radius_mm / edge_mm), max(8, math.ceil(2 * math.pi * radius_mm / edge_mm))


def meshed(surfaces: Sequence[DeviceSurface], meshes: Sequence[SurfaceMesh]) -> tuple[DeviceSurface, ...]:
    """Replace surfaces by their meshes."""
    return tuple(
        MeshedSurface(s.origin, s.axes, s.shape, s.eta, s.kind, s.table, s.film, mesh.geometry)
        for s, mesh in zip(surfaces, meshes, strict=True)
    )


def _mixed(corners: Sequence[mi.Vector3f], uv: mi.Point2f) -> mi.Vector3f:
    a, b, c = corners
    return (1 - uv.x - uv.y) * a + uv.x * b + uv.y * c


def _unevenness(
    x: Floats, n: Floats, slope: Floats, normal_slope: Floats, lamp: Floats, node: Floats
) -> tuple[Floats, Floats]:
    """Compute how far the bisector h of the directions to lamp and viewpoint deviates from n: (n, 2), and its Jacobian.

    The deviation is h_i n_x - n_i h_x in the surface's frame, for i = y and z.
    """
    h, dh = np.zeros_like(x), np.zeros_like(slope)
    for end in (lamp, node):
        way = end - x
        length = np.linalg.norm(way, axis=1)[:, None]
        u = way / length
        h += u
        dh -= (slope - u[:, :, None] * np.einsum("ni,nij->nj", u, slope)[:, None, :]) / length[:, :, None]
    miss = h[:, 1:] * n[:, :1] - n[:, 1:] * h[:, :1]
    jacobian = (
        dh[:, 1:] * n[:, :1, None]
        + h[:, 1:, None] * normal_slope[:, :1]
        - normal_slope[:, 1:] * h[:, :1, None]
        - n[:, 1:, None] * dh[:, :1]
    )
    return miss, jacobian


def _tube(out: Floats, x: Floats, N: Floats, n: Floats, normal_slope: Floats, lamp: Floats, node: Floats) -> Floats:
    """Compute the cross section, at the lamp, of a ray tube from the viewpoint per solid angle there, (n,)."""
    s, rest = np.linalg.norm(x - node, axis=1), np.linalg.norm(lamp - x, axis=1)
    way, normal, inverse = components(out), components(N), 1 / np.linalg.norm(n, axis=1)
    bend = NUMPY.reflect(way, normal)
    helper = np.where(np.abs(out[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    e1 = normalize(np.cross(out, helper))
    ends = []
    for e in (e1, np.cross(out, e1)):
        dy = NUMPY.slide(components(s[:, None] * e), way, normal, bend.cosine)
        dn = components(np.einsum("nij,jn->ni", normal_slope, np.stack(dy[1:])))
        dw = NUMPY.bend_differential(bend, way, normal, inverse, dn, components(e))
        ends.append(join(dy) + rest[:, None] * join(dw))
    return np.asarray(np.abs(np.sum(join(bend.way) * np.cross(*ends), axis=1)))
