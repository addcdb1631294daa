"""Mirror points of the front cornea as points (..., 3) in place of components."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from eyerender.base.arrays import FloatLike, Floats, Statuses
from eyerender.optics.solve import mirrored_rays
from eyerender.optics.surfaces import Surface, components, join


class MirrorPoints(NamedTuple):
    """Points (..., 3) on a surface, unit vectors (..., 3) from there to the viewpoint, miss distances and statuses."""

    points_mm: Floats
    directions: Floats
    residual_mm: Floats
    status: Statuses


def mirror_points(
    surface: Surface, source_mm: npt.ArrayLike, viewpoint_mm: npt.ArrayLike, *, rim_mm: FloatLike = np.inf
) -> MirrorPoints:
    """Where a surface reflects sources (..., 3) to viewpoints (..., 3); both broadcast."""
    rays = mirrored_rays(surface, components(source_mm), components(viewpoint_mm), rim_mm=rim_mm)
    return MirrorPoints(join(rays.exit), -join(rays.way), rays.residual_mm, rays.status)
