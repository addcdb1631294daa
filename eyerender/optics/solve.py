"""Apparent points (refraction), mirror points (reflection) and Purkinje images: the rays that join two points.

All are found by Newton with ray differentials (`shooting`) and carry the residual: by how much the ray, traced from the
viewpoint through the surfaces, misses the other point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..arrays import ArrayValue
from ..geometry.surfaces import Surface, Xyz, components, fit, join, shift
from ..geometry.transforms import Array
from .interface import Number, dot
from .shooting import Connection, connect
from .trace import Crossing, RayStatus, Status


@dataclass(frozen=True, slots=True, eq=False)
class ApparentPoints(ArrayValue):
    """Where the rays from object points to a viewpoint leave the outermost surface.

    exit_points_mm (..., 3); directions (..., 3): unit, from the exit point to the viewpoint; inner_directions (..., 3):
    unit, from the object to the innermost surface; residual_mm (...,); tube_mm2_sr (...,): the cross section at the
    object of a ray tube of one steradian at the viewpoint; status (...,).
    """

    exit_points_mm: Array
    directions: Array
    inner_directions: Array
    residual_mm: Array
    tube_mm2_sr: Array
    status: Status


@dataclass(frozen=True, slots=True, eq=False)
class MirrorPoints(ArrayValue):
    """Where light from a source is thrown back to a viewpoint.

    points_mm (..., 3): the mirror point itself (for a Purkinje image from inside: on the reflecting surface);
    exit_points_mm (..., 3): where the ray meets the outermost surface on its way to the viewpoint (the same for the first
    Purkinje image); directions (..., 3): unit, from the exit point to the viewpoint; residual_mm, tube_mm2_sr, status
    (...,).
    """

    points_mm: Array
    exit_points_mm: Array
    directions: Array
    residual_mm: Array
    tube_mm2_sr: Array
    status: Status


def apparent_points(
    surfaces: Sequence[Surface],
    indices: Sequence[Number],
    object_points_mm: npt.ArrayLike,
    viewpoint_mm: npt.ArrayLike,
    *,
    rim_mm: Number = np.inf,
    n_outside: float = 1.0,
) -> ApparentPoints:
    """Refraction of object points (..., 3) to a viewpoint (..., 3), broadcast against each other.

    surfaces : outside in; indices : the index behind each; rim_mm : where the outermost surface ends (the limbus).
    """
    path = [
        Crossing(surface, index, rim_mm=rim_mm if k == 0 else np.inf, beyond_rim=RayStatus.OUTSIDE_LIMBUS)
        for k, (surface, index) in enumerate(zip(surfaces, indices, strict=True))
    ]
    target = components(object_points_mm)
    found = connect(path, n_outside, components(viewpoint_mm), target, target)
    return ApparentPoints(
        join(found.first),
        -join(found.start),
        -join(found.end),
        found.residual_mm,
        found.tube_mm2_sr,
        found.status,
    )


def mirror_points(
    surface: Surface, source_mm: npt.ArrayLike, viewpoint_mm: npt.ArrayLike, *, rim_mm: Number = np.inf
) -> MirrorPoints:
    """Reflection of a source (..., 3) to a viewpoint (..., 3) at the outside of `surface`: the first Purkinje image."""
    path = (Crossing(surface, 1.0, reflects=True, rim_mm=rim_mm, beyond_rim=RayStatus.OUTSIDE_LIMBUS),)
    viewpoint, source = components(viewpoint_mm), components(source_mm)
    return _mirror(connect(path, 1.0, viewpoint, source, mirror_start(surface, source, viewpoint)))


def purkinje_points(
    surfaces: Sequence[Surface],
    indices: Sequence[Number],
    rims_mm: Sequence[Number],
    passing: Sequence[bool],
    source_mm: npt.ArrayLike,
    viewpoint_mm: npt.ArrayLike,
    n_outside: float = 1.0,
) -> MirrorPoints:
    """Reflection at the innermost of `surfaces`, refraction at the others on the way in and out.

    surfaces : outside in, the last one reflects; indices : the index behind each; rims_mm : where each ends; passing :
    whether a ray that does not meet a surface passes on (shells of a gradient lens).
    """

    def crossing(k: int, n_after: Number, inward: bool) -> Crossing:
        edge = RayStatus.OUTSIDE_LIMBUS if k == 0 else RayStatus.MISSED
        return Crossing(surfaces[k], n_after, inward, False, rims_mm[k], None if passing[k] else edge)

    last = len(surfaces) - 1
    before = [n_outside, *indices]
    path = [
        *(crossing(k, indices[k], True) for k in range(last)),
        Crossing(surfaces[last], 1.0, True, True, rims_mm[last], RayStatus.MISSED),
        *(crossing(k, before[k], False) for k in reversed(range(last))),
    ]
    viewpoint, source = components(viewpoint_mm), components(source_mm)
    return _mirror(connect(path, n_outside, viewpoint, source, mirror_start(surfaces[last], source, viewpoint)))


def mirror_start(surface: Surface, source: Xyz, viewpoint: Xyz) -> Xyz:
    """A first guess of a mirror point: where the bisector through the apex' centre of curvature meets the surface.

    Exact on a sphere for source and viewpoint at infinity.
    """
    ndim = max(source[0].ndim, viewpoint[0].ndim)
    shape = np.broadcast_shapes(source[0].shape, viewpoint[0].shape)
    apex = components(surface.to_eye(_apex(surface)))
    normal = components(surface.normal(join(apex)))
    gradient, hessian = surface.gradient_at(apex), surface.hessian_at(apex)
    bend = dot(normal, normal) * (np.asarray(hessian.xx) + np.asarray(hessian.yy) + np.asarray(hessian.zz))
    bend = bend - dot(normal, hessian.times(normal))
    radius = 2.0 * np.sqrt(dot(gradient, gradient)) / bend
    centre = join((apex[0] - radius * normal[0], apex[1] - radius * normal[1], apex[2] - radius * normal[2]))
    rays = [shift(point, centre, -1.0) for point in (source, viewpoint)]
    units = [tuple(axis / np.sqrt(dot(ray, ray)) for axis in ray) for ray in rays]
    bisector = (units[0][0] + units[1][0], units[0][1] + units[1][1], units[0][2] + units[1][2])
    reach = fit(np.asarray(radius), ndim) / np.sqrt(np.maximum(dot(bisector, bisector), 1e-300))
    guess = shift((reach * bisector[0], reach * bisector[1], reach * bisector[2]), centre, 1.0)
    return (
        np.broadcast_to(guess[0], shape),
        np.broadcast_to(guess[1], shape),
        np.broadcast_to(guess[2], shape),
    )


def _apex(surface: Surface) -> Array:
    """The sheet's point on the local axis, local frame, (..., 3)."""
    zero = np.zeros(surface.batch_shape)
    return np.stack([surface.sag(zero, zero), zero, zero], axis=-1)


def _mirror(found: Connection) -> MirrorPoints:
    return MirrorPoints(
        join(found.turning),
        join(found.first),
        -join(found.start),
        found.residual_mm,
        found.tube_mm2_sr,
        found.status,
    )
