"""The eye region in Mitsuba: one mesh with one map, moved in place; its topology is a subject's.

The mesh stands in the scene's frame (the world's axes, origin at the apex of the unrotated eye). Its vertices change
with the pose, so each frame rebuilds the tree over its triangles; kernels stay what they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats
from ..eye.model import Eye
from ..region.anatomy import RegionSpec
from ..region.globe import Globe
from ..region.head import file_states
from ..region.mesh import PARTS, RegionMesh, region_mesh
from ..region.skin import skin_map
from .surround import clear_between, rays_between

_F0 = 0.028  # reflectance at normal incidence of skin's oil and of water, about the same (n 1.40 and 1.33)
_ROUGH_SKIN, _ROUGH_WET = 0.19, 0.04
_RIPPLE = 0.032  # slope of wet tissue


def globe_of(eye: Eye, M: Floats, t: Floats) -> Globe:
    """The posed globe of an eye, p = M x + t into the frame of the unrotated eye."""
    sclera = eye.sclera
    return Globe(
        eye.front[0],
        float(eye.limbus_radius_mm),
        np.asarray(sclera.centre_mm),
        float(sclera.radius_mm),
        M,
        t,
        eye.side == "left",
    )


class RegionScene:
    """The Mitsuba scene of one subject's eye region; `show` moves it."""

    obstructed = True
    parts: tuple[str, ...] = PARTS

    def __init__(self, spec: RegionSpec, globe: Globe) -> None:
        posed = self._posed(spec, globe)
        layout = posed.layout
        props = mi.Properties()
        props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": 0.5})
        n, m = len(posed.vertices), len(layout.faces)
        mesh = mi.Mesh("region", n, m, props=props, has_vertex_normals=True, has_vertex_texcoords=True)
        params = mi.traverse(mesh)
        params["faces"] = mi.UInt32(layout.faces.astype(np.uint32).ravel())
        params["vertex_texcoords"] = mi.Float(layout.uv.astype(np.float32).ravel())
        params["vertex_positions"] = mi.Float(posed.vertices.astype(np.float32).ravel())
        params["vertex_normals"] = mi.Float(posed.normals.astype(np.float32).ravel())
        params.update()
        # Without robust intersections rays slip between the triangles of a large face, on some processors.
        self.scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "region": mesh})
        self._params: Any = mi.traverse(self.scene)
        texture: Any = mi.Texture2f16  # half the memory to read; albedo and slope need no more digits
        self.map = texture(
            mi.TensorXf16(self._look(spec).astype(np.float16)), use_accel=False, wrap_mode=dr.WrapMode.Repeat
        )
        self.mirror = -1.0 if globe.mirrored else 1.0
        self._shown: tuple[RegionSpec, Globe] | None = (spec, globe)
        self.posed = posed

    @staticmethod
    def key(spec: RegionSpec, globe: Globe) -> tuple[Any, ...]:
        """What a scene is made for: a subject and a side, and a head mesh's files as they are."""
        files = () if spec.head is None else file_states(spec.head)
        return spec.model_copy(update={"blink": 0.0}), globe.mirrored, files

    def show(self, spec: RegionSpec, globe: Globe) -> RegionMesh:
        """Move lids and lashes to a pose and a blink."""
        if self._shown != (spec, globe):
            posed = self._posed(spec, globe)
            if posed is not self.posed:
                self.posed = posed
                self._params["region.vertex_positions"] = mi.Float(posed.vertices.astype(np.float32).ravel())
                self._params["region.vertex_normals"] = mi.Float(posed.normals.astype(np.float32).ravel())
                self._params.update()
            self._shown = (spec, globe)
        return self.posed

    def _posed(self, spec: RegionSpec, globe: Globe) -> RegionMesh:
        return region_mesh(spec, globe)

    @staticmethod
    def _look(spec: RegionSpec) -> NDArray[np.float32]:
        return skin_map(spec)

    def clear(self, a: Floats, b: Floats) -> Bools:
        """Whether nothing of the region stands between points (n, 3) of the scene's frame; ends not included."""
        return clear_between(self.scene, a, b)


@dataclass(frozen=True, slots=True)
class Surface:
    """What the map says at points of the region: albedo, shading normal (scene's frame), gloss."""

    albedo: Any
    normal: Any
    gloss: Any


def blockers(place: RegionScene, a: Floats, b: Floats) -> list[str | None]:
    """The first part of the region between points (n, 3) a and b of the scene's frame, None where there is none."""
    hit = place.scene.ray_intersect_preliminary(rays_between(a, b), coherent=False, active=True)
    valid, face = hit.is_valid().numpy(), hit.prim_index.numpy()
    which = np.searchsorted(place.posed.layout.face_ends, face, side="right")
    return [place.parts[int(w)] if v else None for v, w in zip(valid, which, strict=True)]


def surface(texture: Any, mirror: Any, interaction: Any, active: Any) -> Surface:
    """Read the map; the relief tilts the normal n by its slope g over the tangent plane: n - (g - n (n . g))."""
    albedo, slope_y, slope_z, gloss = (mi.Float(c) for c in texture.eval(interaction.uv, active))
    n = mi.Vector3f(interaction.sh_frame.n)
    g = mi.Vector3f(0, mirror * slope_y, slope_z)
    return Surface(albedo, dr.normalize(n - (g - n * dr.dot(n, g))), gloss)


def sheen(normal: Any, to_lamp: Any, to_camera: Any, gloss: Any) -> Any:
    """Mirror-like reflectance f (1/sr) of skin (gloss below 0.5) and of wet tissue (above).

        f = w D F / (4 (l . h)^2),  D = a^2 / (pi ((n . h)^2 (a^2 - 1) + 1)^2)

    with h half way between lamp and camera (GGX: Walter et al. 2007; the visibility term: Kelemen, Szirmay-Kalos 2001;
    F: Schlick 1994).
    """
    wet = gloss > 0.5
    # The conjunctiva under the film is uneven: its highlights break up.
    p, q = 71 * normal.y + 23 * normal.z, 67 * normal.z - 29 * normal.y
    ripple = _RIPPLE * mi.Vector3f(0, dr.sin(p + 1.7 * dr.sin(q)), dr.sin(q + 1.7 * dr.sin(p)))
    normal = dr.select(wet, dr.normalize(normal + ripple), normal)
    half = dr.normalize(to_lamp + to_camera)
    lh = dr.maximum(dr.dot(to_lamp, half), 0.05)
    nh = dr.maximum(dr.dot(normal, half), 0)
    a = dr.select(wet, _ROUGH_WET, _ROUGH_SKIN)
    weight = dr.select(wet, 2 * gloss - 1, gloss * (1 / 0.45))
    a2 = a * a
    base = nh * nh * (a2 - 1) + 1
    D = a2 * dr.inv_pi / (base * base)
    s = 1 - lh
    s2 = s * s
    F = _F0 + (1 - _F0) * s2 * s2 * s
    return weight * D * F * 0.25 / (lh * lh)
