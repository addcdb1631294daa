"""The eye region in Mitsuba: triangles with one map, moved in place and reused for one subject after another.

The triangles are in the scene's frame (the world's axes, origin at the apex of the unrotated eye) as one instance,
because Embree then builds their tree without spatial splits, in a third of the time. The menisci form a separate scene.
The appearance at a hit is read from separate buffers (`SkinGeometry`), so kernels do not change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...base.arrays import OBSTACLE, SPECTACLE_FRAME, Bools, Floats, Ints, Singles
from ...region.anatomy import Region
from ...region.contour import COLUMNS
from ...region.globe import Globe
from ...region.head import file_states
from ...region.lids import FINE, ROWS
from ...region.mapcache import kept
from ...region.mesh import HAIRS, RegionLayout, RegionMesh, region_mesh, sheet_ends
from ...region.skin import BANDS, SHEET_ROWS, coarse_skin_texels, sheet_v, skin_texels
from ..records.frame import aligned_copy
from .background import clear_between
from .diffusiongrids import GRID_COLUMNS, GRID_ROWS

_THIN_ROWS = 6.0  # rows of the sheet over which the conjunctiva reaches its full thickness
SHEET_COLUMNS = COLUMNS + 1  # columns of the sheet's grid; the first column is repeated


class RegionScene:
    """The Mitsuba scene of an eye region; `show` poses it, `fill` replaces its subject.

    Attributes:
        scene: the solid parts.
        skin: the region for the kernels.
        relief: mean slopes of the map over the cells of the diffusion grids, by number of rows.
        sheet_faces: number of triangles of the sheet of skin.
        posed: the mesh in its pose.
        subject: identity of the subject it was made for.
        grain: that of its map (`skin.skin_map`).
    """

    obstructed = True
    fixed = False  # whether the mesh keeps still, and has no menisci that light passes through

    def __init__(self, spec: Region, globe: Globe, known: RegionMesh | None = None, grain: int = 1) -> None:
        self.grain = grain
        posed = known or self._posed(spec, globe)
        meshes = {name: _mesh(posed, *cut) for name, cut in self._cuts(posed.layout).items()}
        parts = {name: {"solid": mesh} if self.fixed else _instance(mesh) for name, mesh in meshes.items()}
        scenes = {name: self._loaded(name, part) for name, part in parts.items()}
        self.scene: mi.Scene = scenes["solid"]
        self._water: mi.Scene | None = scenes.get("film")
        self._params = {name: mi.traverse(scene) for name, scene in scenes.items()}
        self._dress(spec, globe, posed)

    @staticmethod
    def _loaded(name: str, parts: dict[str, Any]) -> mi.Scene:
        """Create a scene and its acceleration structure."""
        scene: dict[str, Any] = {"type": "scene", **parts}
        if name == "solid":
            # Without robust intersections, rays slip between the triangles of a large face on some processors. An
            # instance cannot have them, but its triangles are small.
            scene["embree_use_robust_intersections"] = True
        return mi.load_dict(scene)

    def _cuts(self, layout: RegionLayout) -> dict[str, tuple[slice, slice]]:
        """Return the vertices and faces of each mesh."""
        if self.fixed:
            return {"solid": (slice(0, None), slice(0, None))}
        v, f = (int(ends[-2]) for ends in (layout.vertex_ends, layout.face_ends))
        return {"solid": (slice(0, v), slice(0, f)), "film": (slice(v, None), slice(f, None))}

    def _dress(self, spec: Region, globe: Globe, posed: RegionMesh) -> None:
        """Copy the appearance of a subject to the device."""
        self.posed = posed
        texture: Any = mi.Texture2f16  # half the memory to read; albedo and slope need no more digits
        pixels = aligned_copy(self._look(spec))
        look = texture(mi.TensorXf16(pixels), use_accel=False, wrap_mode=dr.WrapMode.Repeat)
        mirror = -1.0 if globe.mirrored else 1.0
        inner = self._inner()
        thin = 0.0 if spec.skin.map == "off" else float(sheet_v(np.array(_THIN_ROWS / (ROWS - 1))))
        self.skin = SkinGeometry.of(look, posed.layout, mirror, thin, inner, self._water)
        self.skin.spectacles, self.skin.obstacles = map(self._range, (SPECTACLE_FRAME, OBSTACLE))
        self.relief = {} if inner is None else _mean_slopes(pixels)
        self.sheet_faces = int(posed.layout.face_ends[0])
        self._records = np.zeros((len(posed.layout.uv), 8), np.float32)
        self._records[:, 3], self._records[:, 7] = posed.layout.uv.T
        self._pose_skin(posed)
        self._shown: tuple[Region, Globe] | None = (spec, globe)
        self.subject = self.key(spec, globe, self.grain)

    def _range(self, name: str) -> tuple[mi.UInt32, mi.UInt32] | None:
        """Return the triangles of a part on the device, from the first one to the first one behind."""
        if name not in self.parts:
            return None
        last = self.parts.index(name)
        return dr.opaque(mi.UInt32, int(self.face_ends[last - 1])), dr.opaque(mi.UInt32, int(self.face_ends[last]))

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts."""
        return self.posed.parts

    @property
    def face_ends(self) -> Ints:
        """End of each part's triangles."""
        return self.posed.layout.face_ends

    def takes(self, spec: Region, globe: Globe, grain: int) -> bool:
        """Return whether a subject fits the meshes of the scene."""
        ends, own = self.posed.layout.vertex_ends, [(len(b.vertices), len(b.faces)) for b in globe.frames]
        fits = np.array_equal([ends[-2] - ends[HAIRS], self.body_faces], np.sum([(0, 0), *own], axis=0))
        return not self.fixed and spec.head is None and fits and grain == self.grain

    @property
    def body_faces(self) -> int:
        """Number of triangles of frames of spectacles and obstacles, which are behind those of brows."""
        return int(self.face_ends[-2] - self.face_ends[HAIRS])

    def fill(self, spec: Region, globe: Globe, known: RegionMesh | None) -> None:
        """Replace the subject by one with the same shapes, so that recordings remain valid."""
        posed = known or self._posed(spec, globe)
        for name, cut in self._cuts(posed.layout).items():
            self._set(name, "faces", _faces(posed.layout, *cut))
        self._send(posed)
        self._dress(spec, globe, posed)

    @staticmethod
    def key(spec: Region, globe: Globe, grain: int) -> tuple[Any, ...]:
        """Return the cache key of a scene: the subject, the side, and the state of a head mesh's files."""
        files = () if spec.head is None else file_states(spec.head)
        worn = tuple((b.part, len(b.vertices), b.albedo, hash(b.faces.tobytes())) for b in globe.frames)
        return spec.with_lids(), globe.mirrored, files, worn, grain

    def show(self, spec: Region, globe: Globe, known: RegionMesh | None = None) -> RegionMesh:
        """Pose lids and lashes, including a blink; the mesh of the pose may already be computed."""
        if self._shown != (spec, globe):
            posed = known or self._posed(spec, globe)
            if posed is not self.posed:
                self.posed = posed
                self._send(posed)
                self._pose_skin(posed)
            self._shown = (spec, globe)
        return self.posed

    def at_rest(self, globe: Globe) -> RegionMesh:
        """Compute the mesh of the subject with open lids around a globe; the scene keeps its pose."""
        assert self._shown is not None
        return self._posed(self._shown[0].with_lids(), globe)

    def _set(self, name: str, array: str, values: mi.Float | mi.UInt32) -> None:
        """Set an array of a mesh."""
        params = self._params[name]
        params[next(key for key in params.keys() if key.endswith(array))] = values  # noqa: SIM118  # no dictionary

    def _send(self, posed: RegionMesh) -> None:
        """Set the vertices, and rebuild the acceleration structures."""
        for name, (cut, _) in self._cuts(posed.layout).items():
            self._set(name, "vertex_positions", _floats(posed.vertices[cut]))
            self._params[name].update()

    def _pose_skin(self, posed: RegionMesh) -> None:
        """Copy positions and normals of the vertices to the kernels' buffers."""
        self._records[:, 0:3], self._records[:, 4:7] = posed.vertices, posed.normals
        self.skin.vertices = mi.Float(aligned_copy(self._records.ravel()))

    def _posed(self, spec: Region, globe: Globe) -> RegionMesh:
        return region_mesh(spec, globe)

    def _look(self, spec: Region) -> NDArray[np.float16]:
        return kept(skin_texels if self.grain == 1 else coarse_skin_texels, spec.with_lids())

    def _inner(self) -> Bools | None:
        """Mark triangles of the sheet of skin away from its ends; None if it may not be a single surface."""
        return ~sheet_ends()

    def clear(self, a: Floats, b: Floats) -> Bools:
        """Return whether the region leaves the line between points (n, 3) of the scene's frame free, ends excluded."""
        return clear_between(self.scene, a, b)


def _mean_slopes(pixels: NDArray[np.float16]) -> dict[int, mi.Float]:
    """Average the slopes of a map over the cells of the two diffusion grids, by number of rows."""
    slopes = pixels[: len(pixels) * SHEET_ROWS // (SHEET_ROWS + BANDS), :, 1:3]
    down, across = len(slopes) // GRID_ROWS, slopes.shape[1] // GRID_COLUMNS
    parts = [slopes[i::down, j::across].astype(np.float32) for i in range(down) for j in range(across)]
    fine: Singles = np.asarray(sum(parts) / len(parts), dtype=np.float32)
    coarse = 0.25 * (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2])
    return {len(means): mi.Float(aligned_copy(means.ravel())) for means in (fine, coarse)}


def _floats(values: Floats) -> mi.Float:
    return mi.Float(aligned_copy(values.astype(np.float32).ravel()))


def _faces(layout: RegionLayout, vertices: slice, faces: slice) -> mi.UInt32:
    """Return some of the triangles, with renumbered vertices."""
    triangles = layout.faces[faces] - vertices.start
    return mi.UInt32(aligned_copy(triangles.astype(np.uint32).ravel()))


def _mesh(posed: RegionMesh, vertices: slice, faces: slice) -> mi.Mesh:
    """Create a mesh of some of the triangles."""
    corners, triangles = posed.vertices[vertices], _faces(posed.layout, vertices, faces)
    mesh = mi.Mesh("region", len(corners), len(triangles) // 3)
    params = mi.traverse(mesh)
    params["faces"] = triangles
    params["vertex_positions"] = _floats(corners)
    params.update()
    return mesh


def _instance(mesh: mi.Mesh) -> dict[str, Any]:
    """Create a group of one mesh, and the group's only instance."""
    group = mi.load_dict({"type": "shapegroup", "mesh": mesh})
    return {"group": group, "shown": mi.load_dict({"type": "instance", "of": group})}


@dataclass(kw_only=True)
class SkinPoint:
    """Points of the region: position, normals with and without relief, albedo, gloss, light from other surfaces."""

    point: mi.Vector3f
    normal: mi.Vector3f
    smooth: mi.Vector3f
    albedo: mi.Float
    gloss: mi.Float
    received: mi.Vector4f


@dataclass(kw_only=True)
class SkinGeometry:
    """A posed region for the kernels: the corners of its triangles, and the map."""

    map: Any  # relative albedo, slopes and gloss over the coordinates of the map
    # the menisci, which are not in the scene because light passes through them; None if they are opaque
    water: mi.Scene | None
    is_sheet: bool  # whether the skin is known to be one surface
    # four entries per triangle: its vertices, and 0 if it lies inside the sheet of skin, away from its ends, else 1
    faces: mi.UInt32
    # eight numbers for each vertex: place (scene's frame, mm), first coordinate of the map, normal, second coordinate
    # of the map
    vertices: mi.Float
    received: mi.Float  # four numbers per vertex: light from other surfaces, as in `radiosityfield.RadiosityField`
    sheet: mi.UInt32  # number of triangles of the sheet, which come first
    hairs_end: mi.UInt32  # number of the first triangle behind the hairs, which follow the sheet
    film: mi.UInt32  # number of the first triangle of the menisci
    mirror: mi.Float  # -1 for a left eye, else 1
    thin: mi.Float  # coordinate v of the map at which the conjunctiva has its full thickness; 0 without a map
    # numbers of the first triangle of the frame of spectacles, and of the first one behind; None without
    spectacles: tuple[mi.UInt32, mi.UInt32] | None = None
    obstacles: tuple[mi.UInt32, mi.UInt32] | None = None  # the same for obstacles, which follow

    @classmethod
    def of(
        cls,
        look: mi.Texture2f,  # the map
        layout: RegionLayout,  # the triangles
        mirror: float,  # -1 for a left eye, else 1
        thin: float,  # as the attribute
        # which triangles of the sheet are away from its ends; None if it may not be a single surface
        inner: Bools | None,
        water: mi.Scene | None,  # the menisci
    ) -> SkinGeometry:
        """Copy the triangles of a region to the device."""
        faces = np.ones((len(layout.faces), 4), np.uint32)  # four entries, which are gathered together
        faces[:, :3] = layout.faces
        faces[: layout.face_ends[0], 3] = False if inner is None else ~inner
        sheet, hairs_end, film = (dr.opaque(mi.UInt32, int(layout.face_ends[k])) for k in (0, HAIRS, -2))
        return cls(
            map=look, water=water, is_sheet=inner is not None, faces=mi.UInt32(aligned_copy(faces.ravel())),
            vertices=mi.Float(0), received=mi.Float(0), sheet=sheet, hairs_end=hairs_end, film=film,
            mirror=dr.opaque(mi.Float, mirror), thin=dr.opaque(mi.Float, thin),
        )  # fmt: skip

    def corners(self, face: mi.UInt32) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f, mi.Bool]:
        """Return the corners of triangles (scene's frame), and whether these are not just inside the sheet of skin."""
        corner = dr.gather(mi.Vector4u, self.faces, face)
        a, b, c = (dr.gather(mi.Vector4f, self.vertices, 2 * i) for i in (corner.x, corner.y, corner.z))
        return *(mi.Vector3f(p.x, p.y, p.z) for p in (a, b, c)), corner.w > 0

    def sheet_point(self, row: mi.Float, column: mi.Float) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Interpolate points on the sheet at fractional rows and columns of its grid, and the smooth normals."""
        i, j = mi.UInt32(dr.clip(row, 0, ROWS - 1.001)), mi.UInt32(dr.clip(column, 0, SHEET_COLUMNS - 1.001))
        wide = dr.select(i < FINE, mi.UInt32(1), 2)
        j -= j & (wide - 1)
        s, t = (column - mi.Float(j)) / mi.Float(wide), row - mi.Float(i)
        # Each cell has two triangles, whose common edge runs from its first corner to the opposite one.
        weights = (1 - dr.maximum(s, t), dr.abs(s - t), dr.minimum(s, t))
        corners = ((i, j), (dr.select(s > t, i, i + 1), dr.select(s > t, j + wide, j)), (i + 1, j + wide))
        place, turned = mi.Vector4f(0), mi.Vector4f(0)
        for weight, corner in zip(weights, corners, strict=True):
            vertex = _sheet_vertex(*corner)
            place += weight * dr.gather(mi.Vector4f, self.vertices, 2 * vertex)
            turned += weight * dr.gather(mi.Vector4f, self.vertices, 2 * vertex + 1)
        return mi.Vector3f(place.x, place.y, place.z), dr.normalize(mi.Vector3f(turned.x, turned.y, turned.z))

    def _corners(self, face: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> list[tuple[mi.Float, mi.UInt32]]:
        """Return the vertices of triangles with their barycentric weights."""
        corner = dr.gather(mi.Vector4u, self.faces, face, active)
        return list(zip((1 - uv.x - uv.y, uv.x, uv.y), (corner.x, corner.y, corner.z), strict=True))

    def _mixed(self, corners: list[tuple[mi.Float, mi.UInt32]], half: int, active: mi.Bool) -> mi.Vector4f:
        """Interpolate the first or second four numbers of vertices."""
        mixed = mi.Vector4f(0)
        for weight, i in corners:
            mixed += weight * dr.gather(mi.Vector4f, self.vertices, 2 * i + half, active)
        return mixed

    def map_place(self, face: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Compute coordinates of the map at barycentric coordinates `uv` of triangles."""
        corners = self._corners(face, uv, active)
        return self._mixed(corners, 0, active).w, self._mixed(corners, 1, active).w

    def own_share(self, v: mi.Float) -> mi.Float:
        """Compute how much of the tissue at coordinates v of the map is the sheet's own, as opposed to the globe's.

        Beside the globe, the conjunctiva begins as a clear film on the white of the eye.
        """
        s = dr.minimum(v / dr.maximum(self.thin, 1e-6), 1)
        return s * s * (3 - 2 * s)

    def tilted(self, normal: mi.Vector3f, slope_y: mi.Float, slope_z: mi.Float) -> mi.Vector3f:
        """Tilt normals by a relief: n - (g - n (n . g)) for the slope g over the tangent plane of the normal n."""
        g = mi.Vector3f(0, self.mirror * slope_y, slope_z)
        return dr.normalize(normal - (g - normal * dr.dot(normal, g)))

    def face(self, hit: mi.PreliminaryIntersection3f) -> mi.UInt32:
        """Return the index of the triangle that was hit in the layout."""
        return mi.UInt32(hit.prim_index)

    def on_water(self, hit: mi.PreliminaryIntersection3f) -> mi.UInt32:
        """Return the index of the meniscus triangle that was hit in the layout."""
        return hit.prim_index + self.film

    def on_sheet(self, face: mi.UInt32) -> mi.Bool:
        """Return whether a triangle belongs to the sheet of skin rather than to something in front of it."""
        return face < self.sheet

    def on_hair(self, face: mi.UInt32) -> mi.Bool:
        """Return whether a triangle belongs to a lash or to the brow."""
        return (face >= self.sheet) & (face < self.hairs_end)

    def on_spectacles(self, face: mi.UInt32) -> mi.Bool:
        """Return whether a triangle belongs to the frame of spectacles."""
        return _within(face, self.spectacles)

    def on_obstacles(self, face: mi.UInt32) -> mi.Bool:
        """Return whether a triangle belongs to an obstacle."""
        return _within(face, self.obstacles)

    def corner(self, face: mi.UInt32, uv: mi.Point2f, u: mi.Float, active: mi.Bool) -> mi.UInt32:
        """Choose a vertex of triangles at random, by barycentric weight, from a uniform u in [0, 1)."""
        corner = dr.gather(mi.Vector4u, self.faces, face, active)
        return dr.select(u < uv.x, corner.y, dr.select(u < uv.x + uv.y, corner.z, corner.x))

    def from_behind(self, face: mi.UInt32, uv: mi.Point2f, d: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        """Return whether rays along d (scene's frame) meet triangles on their inner side, such as that of a lid."""
        corners = self._corners(face, uv, active)
        a, b, c = (
            mi.Vector3f(p.x, p.y, p.z)
            for p in (dr.gather(mi.Vector4f, self.vertices, 2 * i, active) for _, i in corners)
        )
        turned = self._mixed(corners, 1, active)
        n = dr.cross(b - a, c - a)
        behind = dr.dot(n, d) * dr.dot(n, mi.Vector3f(turned.x, turned.y, turned.z)) > 0
        return behind & self.on_sheet(face) if self.is_sheet else behind  # hairs are thin, and some are open tubes

    def surface(self, face: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> SkinPoint:
        """Compute the surface at barycentric coordinates `uv` of triangles."""
        corners, received = self._corners(face, uv, active), mi.Vector4f(0)
        place, turned = self._mixed(corners, 0, active), self._mixed(corners, 1, active)
        for weight, i in corners:
            received += weight * dr.gather(mi.Vector4f, self.received, i, active)
        if self.obstacles is not None:  # they exchange no light
            received = dr.select(self.on_obstacles(face), mi.Vector4f(0, 1, 0, 0), received)
        albedo, slope_y, slope_z, gloss = (mi.Float(c) for c in self.map.eval(mi.Point2f(place.w, turned.w), active))
        smooth = dr.normalize(mi.Vector3f(turned.x, turned.y, turned.z))
        normal = self.tilted(smooth, slope_y, slope_z)
        return SkinPoint(
            point=mi.Vector3f(place.x, place.y, place.z), normal=normal, smooth=smooth, albedo=albedo, gloss=gloss,
            received=received,
        )  # fmt: skip


def _within(face: mi.UInt32, ends: tuple[mi.UInt32, mi.UInt32] | None) -> mi.Bool:
    return mi.Bool(False) if ends is None else (face >= ends[0]) & (face < ends[1])


def _sheet_vertex(row: mi.UInt32, column: mi.UInt32) -> mi.UInt32:
    """Return the numbers of vertices of the sheet, as in `mesh.sheet_vertices`."""
    half = COLUMNS // 2
    return dr.select(row > FINE, half * (FINE + 1) + (half + 1) * row + (column >> 1), SHEET_COLUMNS * row + column)
