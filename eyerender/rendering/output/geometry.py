"""Geometry of a window: depth, normals, coordinates on the iris, and what each pixel's centre shows, of one ray each.

The same ray gives the raster labels, so masks have the same bits whether geometry is wanted or not.
The device finds the surface of each ray in single precision. On the host, in double precision, the ray is intersected
with the tangent plane there, and on the eye with its exact surface by Newton's method. Behind spectacles, whose lenses
bend the rays, the device's point counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...base.arrays import OBSTACLE, SPECTACLE_FRAME, ArrayValue, Bools, Bytes, Floats, Indices, Singles, frozen, sealed
from ...optics.interface import dot
from ...optics.surfaces import Surface, Xyz
from ...optics.surfaces_quadric import Quadric
from ...optics.transforms import rotated
from ...region.mesh import sheet_codes
from ...rig.distortion import is_distorted
from ...scene.parts import FRAME, IRIS, PUPIL, SCLERA
from ..hits.eyeshape import EyeShape
from ..hits.primary import behind, facing, hit_before
from ..integrator.hostdata import BoundFrame
from ..integrator.sampling import Pixels, camera_ray
from ..records.frame import DeviceFrame, aligned_copy
from ..records.job import RenderJob
from ..records.recording import recorded
from ..scene.region import RegionScene
from .labels import PartLabels, closed_hit, cover_of, part_of

NOTHING, SKIN, UPPER_LID, LOWER_LID, LASHES, BROW, CARUNCLE, RIMS, TEARS = 0, 5, 6, 7, 8, 9, 10, 11, 12
"""Instances in addition to the parts of a mask."""
_PARTS = {"skin": SKIN, "head": SKIN, "lashes": LASHES, "brow": BROW, "tears": TEARS}
_PARTS |= {SPECTACLE_FRAME: RIMS, OBSTACLE: FRAME}
_STRIP = 4096  # rays whose numbers fit into a processor's cache
_STEPS = 2  # of Newton's method, which rays at a grazing angle need
_SHEET = np.array([CARUNCLE, UPPER_LID, LOWER_LID, SKIN], dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Geometry(ArrayValue):
    """Geometry at the centres of pixels; NaN where there is none, None where a kind was not requested."""

    # (height, width) mm along the camera's axis to the first surface but spectacle lenses; along the ray of a fisheye
    depth: Singles | None
    # (height, width, 3) its unit normals, in the camera's frame (x right, y down, z forward), to the camera
    normals: Singles | None
    # (height, width, 2) mm toward the nose and up in the plane of the iris, from the centre of the stop, of what the
    # pixel shows through the cornea
    iris_coordinates: Singles | None
    instances: Bytes  # (height, width) parts of the eye as in a mask, or `SKIN`, `UPPER_LID`, ...

    def behind(self, covered: Bools) -> Geometry:
        """Return it where what frames the camera's view covers the pixels (height, width)."""
        values: dict[str, Any] = {}
        for name in ("depth", "normals", "iris_coordinates", "instances"):
            own = getattr(self, name)
            if own is not None:
                values[name] = own.copy()
                values[name][covered] = FRAME if name == "instances" else np.nan
        return replace(self, **{name: sealed(value) for name, value in values.items()})


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Hits(ArrayValue):
    """Hits of the rays through the n centres of pixels, in the eye's frame; None where no kind needs them."""

    point: Singles | None  # (3, n) mm
    normal: Singles | None  # (3, n) unit normals of the surface without its relief, toward the camera
    inner: Singles | None  # (3, n) mm in the plane of the iris
    labels: PartLabels  # raster labels of the window, those of `part_labels`
    instance: Bytes  # (n,) code of the instance
    cornea: Bools  # (n,) whether the cornea is met, also where its rim is opaque


def window_hits(bound: BoundFrame, job: RenderJob, scene: object) -> Callable[[], Hits]:
    """Begin to find what the centres of a window's pixels show; the result waits for it.

    `bound`: the frame; `job`: its job, whose kinds of geometry are wanted; `scene`: the surroundings of the eye.
    """
    shape = job.window[3], job.window[2]
    codes = mi.UInt8(aligned_copy(_codes(scene))) if isinstance(scene, RegionScene) else None
    wanted = "depth" in job.geometry or "normals" in job.geometry, "iris_coordinates" in job.geometry
    surface, inner, seen = _hits(bound.frame.bare(), Pixels.of(job.window), shape[0] * shape[1], codes, wanted)

    def read() -> Hits:
        point, normal = (None, None) if surface is None else (sealed(v.numpy()) for v in surface)
        part, amodal, instance, cornea = (v.numpy() for v in seen)
        return Hits(
            point=point,
            normal=normal,
            inner=None if inner is None else sealed(inner.numpy()),
            labels=PartLabels(*(frozen(v.reshape(shape), np.uint8) for v in (part, amodal))),
            instance=frozen(instance, np.uint8),
            cornea=frozen(cornea, np.bool_),
        )

    return read


@recorded
def _hits(
    frame: DeviceFrame, pixels: Pixels, count: int, codes: mi.UInt8 | None, wanted: tuple[bool, bool]
) -> tuple[tuple[mi.Vector3f, mi.Vector3f] | None, mi.Vector3f | None, tuple[mi.UInt8, mi.UInt8, mi.UInt8, mi.Bool]]:
    """Return points with normals, and places in the plane of the iris, if wanted; the other attributes of `Hits`.

    codes: codes of the instances of a region's triangles.
    """
    u, v = pixels.at(dr.arange(mi.UInt32, count))
    u, v = mi.Float(u), mi.Float(v)
    o, d, _ = camera_ray(frame, u, v)
    eye = EyeShape(frame=frame).ray_intersect(o, d)
    hit = closed_hit(frame, u, v, eye.distance, hit_before(frame, o, d, eye.distance, mi.Bool(True)))
    si = behind(eye, hit, mi.Bool(True))
    amodal = part_of(eye)
    part = instance = dr.select(si.other, cover_of(frame, hit), amodal)
    away = dr.dot(si.normal, frame.vector_to_eye(d)) > 0
    point, normal = si.point, dr.select(away, -si.normal, si.normal)
    if codes is not None:
        face = frame.region.face(hit)
        instance = dr.select(si.other, dr.gather(mi.UInt8, codes, face, si.other), amodal)
        if wanted[0]:
            skin = frame.region.surface(face, hit.prim_uv, si.other)
            point = dr.select(si.other, frame.point_to_eye(skin.point), point)
            normal = dr.select(si.other, facing(frame, skin.smooth, d), normal)
    surface = (point, normal) if wanted[0] else None
    inner = si.inner if wanted[1] else None
    seen = part, amodal, instance, si.cornea
    dr.eval(surface, inner, seen)
    return surface, inner, seen


def _codes(scene: RegionScene) -> Bytes:
    """Code of the instance of each triangle of a region."""
    layout = scene.posed.layout
    ends = layout.face_ends
    counts = np.diff(np.concatenate([[0], ends]))
    codes = np.repeat(np.array([_PARTS[name] for name in scene.parts[: len(counts)]], dtype=np.uint8), counts)
    if scene.skin.is_sheet:
        codes[: int(ends[0])] = _SHEET[sheet_codes()]
    return codes


def geometry_of(job: RenderJob, hits: Hits) -> Geometry:
    """Compute the geometry of a window from its hits."""
    shape = job.window[3], job.window[2]
    depth, normals = (None, None) if hits.point is None else _surface(job, hits)
    return Geometry(
        depth=depth,
        normals=normals,
        iris_coordinates=None if hits.inner is None else _on_iris(job, hits),
        instances=frozen(hits.instance.reshape(shape), np.uint8),
    )


def _surface(job: RenderJob, hits: Hits) -> tuple[Singles | None, Singles | None]:
    """Compute depth and normals, those of them that are wanted."""
    assert hits.point is not None
    assert hits.normal is not None
    shape = job.window[3], job.window[2]
    axes = job.camera.sensor_axes @ job.M  # eye's frame to that of the picture
    bent = bool(job.eye.worn)
    exact = [] if bent or job.mesh_edge_mm is not None else _on_eye(job, hits, axes)
    nothing = np.flatnonzero((hits.instance == NOTHING) | (hits.instance == FRAME))
    depth, normals = None, None
    if "depth" in job.geometry:
        reach = _straight(job, axes, hits.point) if bent else _rays(job, axes).to_planes(hits.point, hits.normal)
        for rows, distance, _ in exact:
            reach[rows] = distance
        reach[nothing] = np.nan
        depth = sealed(reach.astype(np.float32).reshape(shape))
    if "normals" in job.geometry:
        turned = hits.normal.T @ axes.T.astype(np.float32)
        for rows, _, normal in exact:
            turned[rows] = (axes @ normal).T
        turned[nothing] = np.nan
        normals = sealed(turned.reshape(*shape, 3))
    return depth, normals


def _straight(job: RenderJob, axes: Floats, points: Singles) -> Floats:
    """Compute the depth (n,) of points (3, n) that are seen through lenses: of where they are, not appear."""
    gap = points.astype(float) - rotated(job.M.T, job.camera.nodal_point_mm - job.t)[:, None]
    return np.asarray(np.linalg.norm(gap, axis=0) if job.camera.is_fisheye else axes[2] @ gap)


def _on_eye(job: RenderJob, hits: Hits, axes: Floats) -> list[tuple[Indices, Floats, Floats]]:
    """Intersect the rays that meet cornea and sclera with the exact surfaces.

    Returns:
        For each surface the rows (k,), the distances along the camera's axis (k,) and the unit normals toward the
        camera (3, k).
    """
    assert hits.point is not None
    assert hits.normal is not None
    sclera, radius = job.eye.sclera, float(job.eye.sclera.radius_mm)
    sphere = Quadric.conic(radius, origin_mm=sclera.centre_mm + np.array([radius, 0.0, 0.0]))
    on_sclera = (hits.instance == SCLERA) & ~hits.cornea
    found = []
    for met, surface in ((hits.cornea, job.eye.front[0]), (on_sclera, sphere)):
        rows = np.flatnonzero(met)
        rays = _rays(job, axes, rows)
        start = rays.to_planes(hits.point[:, rows], hits.normal[:, rows])
        found.append((rows, *_refined(rays, start, surface)))
    return found


@dataclass(frozen=True, slots=True)
class _Rays:
    """Rays from a point (3,) in n directions (three arrays), of length 1 along the camera's axis; 1 for a fisheye."""

    origin: Floats
    ways: Xyz

    def at(self, t: Floats) -> Xyz:
        """Return the points at distances along the camera's axis."""
        x, y, z = (o + t * way for o, way in zip(self.origin, self.ways, strict=True))
        return x, y, z

    def to_planes(self, points: Singles, normals: Singles) -> Floats:
        """Compute the distances (n,) to planes through points (3, n) with normals (3, n), in double precision."""
        reach = np.empty(points.shape[1])
        for k in range(0, reach.size, _STRIP):
            part = slice(k, k + _STRIP)
            (a, b, c), (x, y, z) = points[:, part].astype(float), normals[:, part].astype(float)
            (ox, oy, oz), (wx, wy, wz) = self.origin, (way[part] for way in self.ways)
            with np.errstate(divide="ignore", invalid="ignore"):
                reach[part] = dot((a - ox, b - oy, c - oz), (x, y, z)) / dot((wx, wy, wz), (x, y, z))
        return reach


def _refined(rays: _Rays, reach: Floats, surface: Surface) -> tuple[Floats, Floats]:
    """Improve distances to a surface by Newton's method; return them and the unit normals (3, k) toward the camera."""
    for _ in range(_STEPS):
        point = rays.at(reach)
        reach = reach - surface.value_at(point) / (2 * dot(rays.ways, surface.gradient_at(point)))
    gradient = surface.gradient_at(rays.at(reach))
    length = np.sqrt(dot(gradient, gradient))
    away = np.where(dot(rays.ways, gradient) > 0, -length, length)
    return reach, np.stack(gradient) / away


def _on_iris(job: RenderJob, hits: Hits) -> Singles:
    """Places (h, w, 2) in the plane of the iris, toward the nose and up; NaN where neither iris nor pupil is seen."""
    assert hits.inner is not None
    stop = job.eye.stop
    normal = np.asarray(stop.normal)
    nasal = np.array([0.0, -1.0 if job.eye.side == "left" else 1.0, 0.0])
    u = nasal - normal * float(normal @ nasal)
    u /= np.linalg.norm(u)
    v = np.array([0.0, 0.0, 1.0]) - normal * normal[2]
    v -= u * float(u @ v)
    v /= np.linalg.norm(v)
    seen = np.flatnonzero((hits.instance == IRIS) | (hits.instance == PUPIL))
    out = np.full((hits.instance.size, 2), np.nan, dtype=np.float32)
    out[seen] = (hits.inner.T[seen] - np.asarray(stop.centre_mm)) @ np.stack([u, v], axis=1)
    return sealed(out.reshape(job.window[3], job.window[2], 2))


def _rays(job: RenderJob, axes: Floats, rows: Indices | None = None) -> _Rays:
    """Compute the rays through the centres of all pixels, or of some rows of the flattened window.

    axes: rows are right, down and forward of the picture.
    """
    camera, (x0, y0, width, height) = job.camera, job.window
    if rows is None:
        u, v = x0 + np.arange(width, dtype=float), y0 + np.arange(height, dtype=float)[:, None]
    else:
        u, v = (x0 + rows % width).astype(float), (y0 + rows // width).astype(float)
    if is_distorted(camera.distortion):
        pixels = np.stack(np.broadcast_arrays(u, v), axis=-1)
        if camera.is_fisheye:
            ways = np.moveaxis(camera.rays(pixels) @ job.M, -1, 0).reshape(3, -1)
            return _Rays(rotated(job.M.T, camera.nodal_point_mm - job.t), (ways[0], ways[1], ways[2]))
        pixels = camera.ideal(pixels)
        u, v = pixels[..., 0], pixels[..., 1]
    x = (u - camera.K[0, 2]) / camera.K[0, 0]
    y = (v - camera.K[1, 2]) / camera.K[1, 1]
    one, two, three = ((x * axes[0, k] + (y * axes[1, k] + axes[2, k])).ravel() for k in range(3))
    return _Rays(rotated(job.M.T, camera.nodal_point_mm - job.t), (one, two, three))
