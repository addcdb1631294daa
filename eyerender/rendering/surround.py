"""Everything in the scene that is not the eye: the matte surround and other obstacles.

It is fixed in the scene's frame (the world's axes, origin at the apex of the unrotated eye), so neither a pose nor a
camera rebuilds it. The surround is a plane of matte skin behind the apex, through which the globe protrudes. It does
not imitate lids and brow, because these are not modelled here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import ArrayValue, Bools, Floats, Ints
from ..region.look import Look
from ..region.mapcache import kept
from ..region.texture import skin_texture

_HALF_MM = 500.0
_TILE_MM = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle(ArrayValue):
    """A matte body in the scene's frame: vertices (n, 3) mm, faces (m, 3), albedo."""

    vertices_mm: Floats
    faces: Any
    albedo: float = 0.3


class Surround:
    """The Mitsuba scene of the surround; `show` changes its look in place."""

    def __init__(self, obstacles: Sequence[Obstacle] = ()) -> None:
        # Without robust intersections rays slip between neighbouring triangles on some processors.
        parts: dict[str, Any] = {"type": "scene", "embree_use_robust_intersections": True, "backdrop": self._backdrop()}
        for i, body in enumerate(obstacles):
            material = _matte(mi.TensorXf(np.full((1, 1, 1), body.albedo, np.float32)))
            parts[f"obstacle{i}"] = _mesh(f"obstacle{i}", body.vertices_mm, body.faces, None, material)
        self.scene = mi.load_dict(parts)
        self._params: Any = mi.traverse(self.scene)
        self.obstructed = len(obstacles) > 0
        self._shown: tuple[float, float, float] | None = None

    def show(self, look: Look) -> None:
        """Update the surround to a look: its plane, albedo and unevenness."""
        wanted = (look.backdrop_distance_mm, look.backdrop_albedo, look.backdrop_contrast)
        if wanted == self._shown:
            return
        if self._shown is None or self._shown[0] != wanted[0]:
            self._params["backdrop.vertex_positions"] = mi.Float(_corners(wanted[0]).ravel())
        tile = wanted[1] * (1 + wanted[2] * (kept(skin_texture, 1) - 1))
        names: list[str] = list(self._params.keys())  # iterating over it would give pairs
        (key,) = (k for k in names if k.startswith("backdrop") and k.endswith("reflectance.data"))
        self._params[key] = mi.TensorXf(np.clip(tile, 0.0, 0.98).astype(np.float32)[..., None])
        self._params.update()
        self._shown = wanted

    def clear(self, a: Floats, b: Floats) -> Bools:
        """Whether nothing of the surround stands between points (n, 3) of the scene's frame; ends not included."""
        return clear_between(self.scene, a, b)

    @staticmethod
    def _backdrop() -> mi.Mesh:
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (2 * _HALF_MM / _TILE_MM)
        material = _matte(mi.TensorXf(np.full((2, 2, 1), 0.4, np.float32)))
        return _mesh("backdrop", _corners(10.0), np.array([[0, 1, 2], [0, 2, 3]]), uv, material)


def clear_between(scene: mi.Scene, a: Floats, b: Floats) -> Bools:
    """Whether nothing of a Mitsuba scene stands between points (n, 3) of its frame; ends not included."""
    return ~np.asarray(scene.ray_test(rays_between(a, b)).numpy(), dtype=bool)


def rays_between(a: Floats, b: Floats, margin_mm: float = 1e-3) -> mi.Ray3f:
    """Rays from points (n, 3) towards points b, without the last `margin_mm` at both ends."""
    length = np.linalg.norm(b - a, axis=-1)
    d = (b - a) / length[:, None]
    table = np.column_stack([a + margin_mm * d, d, length - 2 * margin_mm]).astype(np.float32)
    # The values are gathered from one buffer, else the kernel would depend on the alignment of every NumPy array.
    buffer, row = mi.Float(table.ravel()), dr.arange(mi.UInt32, len(table)) * 7
    o = [dr.gather(mi.Float, buffer, row + k) for k in range(7)]
    ray = mi.Ray3f(mi.Point3f(*o[:3]), mi.Vector3f(*o[3:6]))
    ray.maxt = o[6]
    return ray


def _corners(distance_mm: float) -> Floats:
    h = _HALF_MM
    return np.array([[-distance_mm, y, z] for y, z in ((-h, -h), (h, -h), (h, h), (-h, h))])


def _matte(data: mi.TensorXf) -> dict[str, Any]:
    """A diffuse material; the integrator reads its albedo and turns normals to the viewer, so both sides are matte."""
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "repeat"}}


def _mesh(name: str, vertices: Floats, faces: Ints, uv: Floats | None, material: dict[str, Any]) -> mi.Mesh:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(material)
    mesh = mi.Mesh(name, len(vertices), len(faces), props=props, has_vertex_texcoords=uv is not None)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, dtype=np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, dtype=np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = mi.Float(np.asarray(uv, dtype=np.float32).ravel())
    params.update()
    dr.eval()
    return mesh
