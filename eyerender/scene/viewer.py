"""A camera that sees points in front of an eye through the lenses that are worn, or past them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats
from ..eye.legs import air_legs
from ..eye.worn import WornLens
from ..optics.surfaces import components, join
from ..rig.camera import PinholeCamera


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CameraPastLenses(PinholeCamera):
    """A camera whose `project` follows rays through worn lenses."""

    lenses: tuple[WornLens, ...]  # the lenses, in the frame of the unrotated eye
    apex_mm: Floats  # (3,) origin of that frame in the world
    thorough: bool  # whether rays that are hard to find are searched; labels need them, choices of samples do not

    def project(self, points_mm: ArrayLike) -> tuple[Floats, Bools]:
        """Project world points (..., 3) as `PinholeCamera.project`; points without a ray as if no lens were there."""
        points = np.asarray(points_mm, dtype=float)
        target = components((points - self.apex_mm).reshape(1, -1, 3))
        camera = components((self.nodal_point_mm - self.apex_mm)[None, None])
        lenses = [lens.take(None) for lens in self.lenses]
        seen = join(air_legs(lenses, target, camera, thorough=self.thorough).seen).reshape(points.shape)
        places = np.where(np.isfinite(seen), seen + self.apex_mm, points)
        front = PinholeCamera.project(self, points)[1]
        return PinholeCamera.project(self, places)[0], front


def past_lenses(
    camera: PinholeCamera, lenses: Sequence[WornLens], apex_mm: Floats, *, thorough: bool = True
) -> PinholeCamera:
    """Return the camera that sees an eye's surroundings past its lenses; the camera itself without any."""
    if not lenses:
        return camera
    own = {f.name: getattr(camera, f.name) for f in fields(PinholeCamera)}
    return CameraPastLenses(**own, lenses=tuple(lenses), apex_mm=apex_mm, thorough=thorough)
