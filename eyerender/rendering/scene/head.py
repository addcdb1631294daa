"""A user's head mesh in Mitsuba, replacing the procedural eye region: one fixed mesh with one map."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Floats
from ...base.errors import InputError
from ...optics.transforms import rotated
from ...region.anatomy import Region
from ...region.globe import Globe
from ...region.head import head_map, load_head, placed, texture_rows
from ...region.headspec import Head
from ...region.mesh import RegionMesh
from .region import RegionScene

_DEPTH_MM = 4.0
_RINGS, _TURNS = 40, 240


class HeadScene(RegionScene):
    """The Mitsuba scene of a head mesh around one eye.

    Raises:
        InputError: the mesh cannot be read, or reaches into the cornea in the eye's pose.
    """

    fixed = True

    def __init__(self, spec: Region, globe: Globe, known: RegionMesh | None = None, grain: int = 1) -> None:
        super().__init__(spec, globe, known, grain)
        self._refuse_crossing(spec, globe)

    def show(self, spec: Region, globe: Globe, known: RegionMesh | None = None) -> RegionMesh:
        """Show an eye in its pose; the mesh moves only with the position of the globe at rest."""
        new = self._shown != (spec, globe)
        posed = super().show(spec, globe, known)
        if new:
            self._refuse_crossing(spec, globe)
        return posed

    def _posed(self, spec: Region, globe: Globe) -> RegionMesh:
        head = _head(spec)
        key = (head, globe.mirrored, tuple(globe.centre_mm.tolist()))
        if getattr(self, "_stands", None) != key:
            self._stands = key
            self._still = placed(load_head(head), globe, texture_rows(head))
        return self._still

    def _look(self, spec: Region) -> NDArray[np.float16]:
        return head_map(spec, load_head(_head(spec))).astype(np.float16)

    def _inner(self) -> None:
        return None

    def _refuse_crossing(self, spec: Region, globe: Globe) -> None:
        """Raise an error if the mesh reaches too deep into the cornea.

        The depth is measured along lines from the globe's centre that are 0.15 mm apart on the cornea.
        """
        head = _head(spec)
        depth = cornea_depth_mm(self, globe)
        deepest = int(np.argmax(depth))
        if depth[deepest] > head.tolerance_mm:
            # Another pose may be valid, so this one is not recorded as shown.
            self._shown = None
            raise InputError(
                f"reaches {depth[deepest]:.2f} mm into the cornea at this gaze (tolerance_mm is "
                f"{head.tolerance_mm:g}); the mesh does not move, and its parts must not include its own eyeball",
                source=head.files[0],
            )


def cornea_depth_mm(place: RegionScene, globe: Globe) -> Floats:
    """Compute the depth (n,), 0 to 4 mm, of the mesh inside the posed cornea, along lines from the globe's centre."""
    surface = globe.cornea
    if surface is None:
        return np.zeros(1)
    rho = globe.limbus_radius_mm * (np.arange(_RINGS) + 0.5)[:, None] / _RINGS
    turn = 2 * np.pi * (np.arange(_TURNS)[None, :] + 0.5 * (np.arange(_RINGS) % 2)[:, None]) / _TURNS
    y, z = (rho * np.cos(turn)).ravel(), (rho * np.sin(turn)).ravel()
    local = np.stack([np.broadcast_to(surface.sag(y, z), y.shape), y, z], axis=-1)
    points = (surface.origin_mm + local @ np.asarray(surface.rotation).T) @ globe.M.T + globe.t
    out = points - (rotated(globe.M, globe.centre_mm) + globe.t)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    table = np.column_stack([points - _DEPTH_MM * out, out]).astype(np.float32)
    # The values are gathered from one buffer, otherwise the kernel would depend on the alignment of every NumPy array.
    buffer, row = mi.Float(table.ravel()), dr.arange(mi.UInt32, len(table)) * 6
    o = [dr.gather(mi.Float, buffer, row + k) for k in range(6)]
    ray = mi.Ray3f(mi.Point3f(*o[:3]), mi.Vector3f(*o[3:]))
    ray.maxt = dr.opaque(mi.Float, _DEPTH_MM)
    hit = place.scene.ray_intersect_preliminary(ray, coherent=False, active=True)
    t = np.where(hit.is_valid().numpy(), hit.t.numpy(), _DEPTH_MM)
    return np.asarray(_DEPTH_MM - t, dtype=float)


def _head(spec: Region) -> Head:
    if spec.head is None:
        raise ValueError("the region has no head mesh")
    return spec.head
