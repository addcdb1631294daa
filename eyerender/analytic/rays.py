"""Rays of the features: from the stop's margin and from the lights to a camera, in the eye frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.arrays import Bools, Floats, Indices, Statuses
from ..base.status import Status, mark
from ..eye.legs import mirrored_legs, refracted_legs
from ..eye.model import EyeModel
from ..eye.worn import WornLens
from ..optics.interface import dot
from ..optics.purkinje import purkinje_points
from ..optics.solve import mirrored_rays
from ..optics.surfaces import Xyz, components, fit, join, shift, turn

_AHEAD_MM = 500.0
_ASIDE = 0.1
_RIM_POINTS = 36


def pupil_exits(
    eye: EyeModel, count: int, camera_mm: Xyz, lenses: Sequence[WornLens] = ()
) -> tuple[Xyz, Floats, Statuses]:
    """Compute where the camera sees `count` points of the stop's margin, and last its centre.

    These are the points at which their rays leave the cornea or, behind glasses, the outermost lens.

    A camera may be behind the plane of the iris, because the cornea refracts light towards it. The status is
    BEHIND_IRIS for a ray that would have to pass the iris, and BEHIND_SCLERA for one that meets the eyeball on its way
    to the camera.

    Args:
        eye: the eyes.
        count: number of points of the margin.
        camera_mm: (n,) nodal points in the eye frame.
        lenses: lenses worn in front of the eyes, in the eye frame.

    Returns:
        These points as three arrays (n, count + 1), residuals and status.
    """
    points = np.concatenate([eye.stop.boundary(count), eye.stop.centre_mm[..., None, :]], axis=-2)
    target, viewpoint = components(points), (camera_mm[0][:, None], camera_mm[1][:, None], camera_mm[2][:, None])
    if points.ndim == 2:
        target = (target[0][None], target[1][None], target[2][None])
    height, distance = eye.stop.height_mm(camera_mm), np.sqrt(dot(camera_mm, camera_mm))
    # From farther to the front no ray to the camera can meet the iris or the sclera.
    aside = height < _ASIDE * distance
    hidden = aside & _sees_no_cornea(eye, camera_mm) if aside.any() else aside
    if hidden.any():
        # These rows have no solution. They are computed for a camera straight ahead instead, and removed afterwards.
        ahead = (_AHEAD_MM, 0.0, 0.0)
        x, y, z = (np.where(hidden[:, None], ahead[i], viewpoint[i]) for i in range(3))
        viewpoint = (x, y, z)
    found = refracted_legs(eye, lenses, target, viewpoint)
    status, residual = np.array(found.status), np.array(found.residual_mm)
    if aside.any():
        nx, ny, nz = (fit(eye.stop.normal[..., i], 2) for i in range(3))
        rises = nx * found.end[0] + ny * found.end[1] + nz * found.end[2] < 0.0
        mark(status, aside[:, None] & ~rises, Status.BEHIND_IRIS)
        mark(status, aside[:, None] & _meets_sclera(eye, found.exit, found.way), Status.BEHIND_SCLERA)
    status[hidden] = Status.BEHIND_IRIS
    residual[hidden] = np.nan
    if lenses:
        _mark_split(status[:, :-1], found.passed[:, :-1])
    return found.seen, residual, status


def _mark_split(status: Statuses, passed: Indices) -> None:
    """Mark, in place, the fewer points of each margin (n, k) where some are seen through and some beside a lens."""
    ok = status == Status.OK
    counts = np.stack([np.count_nonzero(ok & (passed == k), axis=1) for k in range(int(passed.max(initial=0)) + 1)])
    mark(status, passed != counts.argmax(axis=0)[:, None], Status.AT_LENS_EDGE)


def glint_exits(
    eye: EyeModel, order: int, lights_mm: Xyz, camera_mm: Xyz, lenses: Sequence[WornLens] = ()
) -> tuple[Xyz, Floats, Statuses]:
    """Compute where the light of lamps leaves the cornea, or the lenses in front of it, towards the camera.

    The light is reflected at the surface of the given Purkinje image. Images 3 and 4 are seen through the pupil: their
    status is BEHIND_IRIS where the iris blocks the light on its way in or out. Returns exit points as three arrays (n,
    m), residuals and status, for lights (n, m).
    """
    if order not in eye.purkinje_orders:
        nothing = np.full(lights_mm[0].shape, np.nan)
        status = np.full(nothing.shape, Status.MISSED, dtype=np.int8)
        return (nothing, nothing, nothing), nothing, status
    if order == 1:
        place = (camera_mm[0][:, None], camera_mm[1][:, None], camera_mm[2][:, None])
        if lenses:
            legs = mirrored_legs(eye, lenses, lights_mm, place)
            return legs.seen, legs.residual_mm, legs.status
        rays = mirrored_rays(eye.front[0], lights_mm, place, rim_mm=eye.limbus_radius_mm)
        return rays.exit, rays.residual_mm, rays.status
    corneal = len(eye.front)
    depth = {2: corneal, 3: corneal + 1, 4: corneal + len(eye.back)}[order]
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
        status = np.where((status == Status.OK) & ~eye.stop.lets_through(found.course_mm), Status.BEHIND_IRIS, status)
    return components(found.exit_points_mm), found.residual_mm, status.astype(np.int8)


def lit_points(eye: EyeModel, exits: Xyz, lights_mm: Xyz, camera_mm: Xyz, lenses: Sequence[WornLens]) -> Xyz:
    """Compute where the light of lamps (n, m) that leaves at `exits` arrives on the cornea, past the lenses worn."""
    if not lenses:
        return exits
    place = (camera_mm[0][:, None], camera_mm[1][:, None], camera_mm[2][:, None])
    return mirrored_legs(eye, lenses, lights_mm, place).exit


def _sees_no_cornea(eye: EyeModel, camera_mm: Xyz) -> Bools:
    """Return whether the camera is behind the tangent planes of the whole cornea, (n,); False if in doubt.

    The rim of a convex cap faces farthest to the back, so points of the limbus are tested. A tenth of the distance is
    allowed for the points between them.
    """
    surface = eye.front[0]
    angle = 2.0 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim = np.asarray(eye.limbus_radius_mm)[..., None]
    y, z = np.atleast_2d(rim * np.cos(angle)), np.atleast_2d(rim * np.sin(angle))
    point = shift(turn(surface.rotation, (surface.local_sag(y, z), y, z)), surface.origin_mm, 1.0)
    gradient = surface.gradient_at(point)
    size = np.sqrt(dot(gradient, gradient))
    x, y, z = (axis[:, None] for axis in camera_mm)
    height = dot((x - point[0], y - point[1], z - point[2]), gradient) / size
    return np.asarray((height < -0.1 * np.sqrt(dot((x, y, z), (x, y, z)))).all(axis=1))


def _meets_sclera(eye: EyeModel, exits: Xyz, way: Xyz) -> Bools:
    """Return whether rays continued from the exits along `way` (unit, from the camera) enter the sclera's sphere."""
    gap = shift(exits, eye.sclera.centre_mm, -1.0)
    along = -dot(gap, way)
    radius = fit(np.asarray(eye.sclera.radius_mm, dtype=np.float64), gap[0].ndim)
    with np.errstate(invalid="ignore"):
        return np.asarray((along < 0.0) & (dot(gap, gap) - along * along < radius * radius))
