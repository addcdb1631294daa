"""Geometry of a window: depth, normals, coordinates on the iris, and what each pixel's centre shows, of one ray each.

The device finds the surface of each ray in single precision. On the host, in double precision, the ray is intersected
with the tangent plane there, and on the eye with its exact surface by Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays import ArrayValue, Bools, Bytes, Floats, Singles, frozen, sealed
from ...eye.model import EyeModel
from ...folders.imagefolder import FRAME, IRIS, PUPIL, SCLERA
from ...geometry.surfaces import Surface
from ...region.mesh import sheet_codes
from ...rig.camera import PinholeCamera, Window
from ..hits.primary import facing, intersect
from ..integrator.request import BoundFrame
from ..integrator.sampling import Pixels, camera_ray
from ..records.frame import Frame
from ..records.job import RenderJob
from ..records.recording import recorded
from ..scene.region import RegionScene

NOTHING, SKIN, UPPER_LID, LOWER_LID, LASHES, BROW, CARUNCLE, TEARS = 0, 5, 6, 7, 8, 9, 10, 11
"""Instances in addition to the parts of a mask."""
_PARTS = {"skin": SKIN, "head": SKIN, "lashes": LASHES, "brow": BROW, "tears": TEARS}
_SHEET = np.array([CARUNCLE, UPPER_LID, LOWER_LID, SKIN], dtype=np.uint8)
_STEPS = 2  # of Newton's method


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Geometry(ArrayValue):
    """What the centres of pixels show; NaN where there is none.

    Attributes:
        depth: (height, width) mm along the camera's axis to the first surface.
        normals: (height, width, 3) its unit normals, in the camera's frame (x right, y down, z forward), to the camera.
        iris: (height, width, 2) mm toward the nose and up in the plane of the iris, from the centre of the stop, of
            what the pixel shows through the cornea.
        instances: (height, width) parts of the eye as in a mask, or `SKIN`, `UPPER_LID`, ...
    """

    depth: Singles
    normals: Singles
    iris: Singles
    instances: Bytes

    def behind(self, covered: Bools) -> Geometry:
        """Return it where what frames the camera's view covers the pixels (height, width)."""
        values = {name: getattr(self, name).copy() for name in ("depth", "normals", "iris", "instances")}
        for name, value in values.items():
            value[covered] = FRAME if name == "instances" else np.nan
        return replace(self, **{name: sealed(value) for name, value in values.items()})


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Hits(ArrayValue):
    """Hits of the rays through the n centres of pixels, in the eye's frame.

    Attributes:
        point: (n, 3) mm.
        normal: (n, 3) normals of the surface without its relief.
        inner: (n, 3) mm in the plane of the iris.
        part: (n,) part of the eye, `SKIN` for the surroundings.
        cornea: (n,) whether the cornea is met, also where its rim is opaque.
        instance: (n,) code of the instance.
    """

    point: Singles
    normal: Singles
    inner: Singles
    part: Bytes
    cornea: Bools
    instance: Bytes


def window_hits(bound: BoundFrame, window: Window, scene: object) -> Callable[[], Hits]:
    """Begin to find what the centres of a window's pixels show; the result waits for it.

    Args:
        bound: the frame.
        window: (x0, y0, width, height) in full-sensor pixels.
        scene: the surroundings of the eye.
    """
    count = window[2] * window[3]
    point, normal, inner, (part, cornea, face) = _hits(bound.frame.bare(), Pixels.of(window), count)

    def read() -> Hits:
        parts, numbers = part.numpy().astype(np.uint8), face.numpy()
        instance = parts.copy()
        if isinstance(scene, RegionScene):
            other = parts == SKIN
            instance[other] = _codes(scene)[numbers[other]]
        places = (np.ascontiguousarray(v.numpy().T) for v in (point, normal, inner))
        names = ("point", "normal", "inner")
        rays = {name: sealed(v) for name, v in zip(names, places, strict=True)}
        met = frozen(cornea.numpy() > 0, np.bool_)
        return Hits(**rays, part=sealed(parts), cornea=met, instance=sealed(instance))

    return read


@recorded
def _hits(
    frame: Frame, pixels: Pixels, count: int
) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f, tuple[mi.UInt8, mi.UInt8, mi.UInt32]]:
    """Return points, normals and places in the plane of the iris; parts, whether on the cornea, and triangles."""
    u, v = pixels.at(dr.arange(mi.UInt32, count))
    o, d, _ = camera_ray(frame, mi.Float(u), mi.Float(v))
    si, hit = intersect(frame, o, d, mi.Bool(True))
    clear = si.cornea & (si.opacity < 0.5)
    inside = dr.select(si.pupil, mi.UInt8(PUPIL), mi.UInt8(IRIS))
    part = dr.select(clear, inside, dr.select(si.cornea | si.sclera, mi.UInt8(SCLERA), mi.UInt8(NOTHING)))
    point, normal, face = si.point, si.normal, mi.UInt32(0)
    if frame.region is not None:
        face = frame.region.face(hit)
        skin = frame.region.surface(face, hit.prim_uv, si.other)
        part = dr.select(si.other, mi.UInt8(SKIN), part)
        point = dr.select(si.other, frame.point_to_eye(skin.point), point)
        normal = dr.select(si.other, facing(frame, skin.smooth, d), normal)
    cornea = dr.select(si.cornea, mi.UInt8(1), mi.UInt8(0))
    dr.eval(point, normal, si.inner, part, cornea, face)
    return point, normal, si.inner, (part, cornea, face)


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
    width, height = job.window[2:]
    camera, eye = job.camera, job.eye
    origin = job.M.T @ (camera.nodal_point_mm - job.t)
    ways = _ways(camera, job.window) @ (camera.sensor_axes @ job.M)  # one mm along the camera's axis
    depth = np.full(len(ways), np.nan)
    normals = np.full((len(ways), 3), np.nan)
    there = np.flatnonzero(hits.instance != NOTHING)
    normal = hits.normal[there].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = _dot(hits.point[there] - origin, normal) / _dot(ways[there], normal)
    if job.mesh_edge_mm is None:
        cornea = hits.cornea[there]
        sclera = (hits.part[there] == SCLERA) & ~cornea
        for rows, surface in ((cornea, eye.front[0]), (sclera, _Sphere.of(eye))):
            if rows.any():
                reach[rows], normal[rows] = _refined(origin, ways[there[rows]], reach[rows], surface)
    normal *= -np.sign(_dot(ways[there], normal))[:, None]
    depth[there] = reach
    normals[there] = normal @ (camera.sensor_axes @ job.M).T
    shape = (height, width)
    return Geometry(
        depth=frozen(depth.reshape(shape), np.float32),
        normals=frozen(normals.reshape(*shape, 3), np.float32),
        iris=frozen(_on_iris(job, hits).reshape(*shape, 2), np.float32),
        instances=frozen(hits.instance.reshape(shape), np.uint8),
    )


class _Sphere:
    """The sphere of the sclera, with the methods of a `Surface`."""

    def __init__(self, centre: Floats, radius: float) -> None:
        self._centre, self._radius = centre, radius

    @classmethod
    def of(cls, eye: EyeModel) -> _Sphere:
        """Take that of an eye."""
        return cls(np.asarray(eye.sclera.centre_mm), float(eye.sclera.radius_mm))

    def implicit(self, x: Floats) -> Floats:
        """Like `Surface.implicit`."""
        return np.asarray(_dot(x - self._centre, x - self._centre) - self._radius**2)

    def gradient(self, x: Floats) -> Floats:
        """Like `Surface.gradient`."""
        return np.asarray(2 * (x - self._centre))


def _refined(origin: Floats, ways: Floats, reach: Floats, surface: Surface | _Sphere) -> tuple[Floats, Floats]:
    """Improve distances along rays to a surface by Newton's method; returns them with the unit normals there."""
    for _ in range(_STEPS):
        x = origin + reach[:, None] * ways
        reach = reach - surface.implicit(x) / _dot(ways, surface.gradient(x))
    normal = surface.gradient(origin + reach[:, None] * ways)
    return reach, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _on_iris(job: RenderJob, hits: Hits) -> Floats:
    """Places (n, 2) in the plane of the iris, toward the nose and up; NaN where neither iris nor pupil is seen."""
    stop = job.eye.stop
    nasal = np.array([0.0, -1.0 if job.eye.side == "left" else 1.0, 0.0])
    normal = np.asarray(stop.normal)
    u = nasal - normal * float(normal @ nasal)
    u /= np.linalg.norm(u)
    up = np.array([0.0, 0.0, 1.0])
    up -= normal * float(normal @ up)
    v = up - u * float(u @ up)
    v /= np.linalg.norm(v)
    out = (hits.inner - np.asarray(stop.centre_mm)) @ np.stack([u, v], axis=1)
    out[(hits.part != IRIS) & (hits.part != PUPIL)] = np.nan
    return np.asarray(out)


def _ways(camera: PinholeCamera, window: Window) -> Floats:
    """Directions (n, 3) through the centres of pixels, in the picture's frame, of length 1 along the camera's axis."""
    x0, y0, width, height = window
    v, u = np.mgrid[y0 : y0 + height, x0 : x0 + width]
    pixels = camera.ideal(np.stack([u.ravel(), v.ravel()], axis=-1))
    x = (pixels[:, 0] - camera.K[0, 2]) / camera.K[0, 0]
    y = (pixels[:, 1] - camera.K[1, 2]) / camera.K[1, 1]
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", a, b))
