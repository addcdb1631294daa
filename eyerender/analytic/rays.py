"""The rays behind the features: from the stop's margin and from the lights to a camera, in the eye frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..arrays import Floats
from ..eye.model import Eye
from ..geometry.surfaces import Xyz, components, join
from ..optics.purkinje import purkinje_points
from ..optics.solve import mirrored_rays, refracted_rays
from ..optics.trace import RayStatus

Statuses = npt.NDArray[np.int8]

_AHEAD_MM = 500.0


def pupil_exits(eye: Eye, count: int, camera_mm: Xyz) -> tuple[Xyz, Floats, Statuses]:
    """Where the rays from `count` points of the stop's margin, and last from its centre, leave the cornea.

    camera_mm : nodal points (n,) in the eye frame. Returns exit points as three arrays (n, count + 1), residuals,
    status.
    """
    points = np.concatenate([eye.stop.boundary(count), eye.stop.centre_mm[..., None, :]], axis=-2)
    target, viewpoint = components(points), (camera_mm[0][:, None], camera_mm[1][:, None], camera_mm[2][:, None])
    if points.ndim == 2:
        target = (target[0][None], target[1][None], target[2][None])
    hidden = _behind_stop(eye, camera_mm)
    if hidden.any():
        # Nothing is to be found there: those rows look from straight ahead instead, and are struck out afterwards.
        ahead = (_AHEAD_MM, 0.0, 0.0)
        x, y, z = (np.where(hidden[:, None], ahead[i], viewpoint[i]) for i in range(3))
        viewpoint = (x, y, z)
    found = refracted_rays(eye.front, eye.front_indices, target, viewpoint, rim_mm=eye.limbus_radius_mm)
    found.status[hidden] = RayStatus.BEHIND_IRIS
    found.residual_mm[hidden] = np.nan
    return found.exit, found.residual_mm, found.status


def glint_exits(eye: Eye, order: int, lights_mm: Xyz, camera_mm: Xyz) -> tuple[Xyz, Floats, Statuses]:
    """Where the light of m lights (n, m) leaves the cornea for the camera, reflected at the surface of Purkinje's
    `order`.

    Images 3 and 4 are seen through the pupil: BEHIND_IRIS where the iris is in the light's way in or out. Returns exit
    points as three arrays (n, m), residuals, status.
    """
    if order not in eye.purkinje_orders:
        nothing = np.full(lights_mm[0].shape, np.nan)
        status = np.full(nothing.shape, RayStatus.MISSED, dtype=np.int8)
        return (nothing, nothing, nothing), nothing, status
    if order == 1:
        place = (camera_mm[0][:, None], camera_mm[1][:, None], camera_mm[2][:, None])
        rays = mirrored_rays(eye.front[0], lights_mm, place, rim_mm=eye.limbus_radius_mm)
        return rays.exit, rays.residual_mm, rays.status
    corneal = len(eye.front)
    depth = {2: 2, 3: corneal + 1, 4: corneal + len(eye.back)}[order]
    found = purkinje_points(
        (eye.front + eye.back)[:depth],
        (eye.front_indices + eye.back_indices)[:depth],
        (eye.limbus_radius_mm, *(np.inf for _ in eye.front[1:]), *eye.back_rims_mm)[:depth],
        ((False,) * corneal + eye.back_passing)[:depth],
        join(lights_mm),
        join(camera_mm)[:, None, :],
        eye.lens_gradient if order == 4 else None,
    )
    status = found.status
    if order > 2:
        status = np.where(
            (status == RayStatus.OK) & ~eye.stop.lets_through(found.course_mm), RayStatus.BEHIND_IRIS, status
        )
    return components(found.exit_points_mm), found.residual_mm, status.astype(np.int8)


def _behind_stop(eye: Eye, camera_mm: Xyz) -> npt.NDArray[np.bool_]:
    """Whether the camera stands behind the plane of the iris, (n,)."""
    return ~(eye.stop.height_mm(camera_mm) > 0.0)
