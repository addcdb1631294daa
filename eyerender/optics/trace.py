"""Sequential ray tracing through any number of surfaces, with a status for each ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, FloatLike, Floats, Statuses
from ..base.status import Status, mark
from .gradient import GradientMedium
from .interface import dot, moved, reflect, refract, unit
from .surfaces import Surface, Xyz, components, fit, join


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Crossing:
    """Crossing of a surface by a ray.

    Attributes:
        surface: the surface.
        n_after: index behind the crossing, () or (n,), one per eye. Ignored for a reflection.
        inward: whether the ray goes into the eye (towards -x of the surface's frame).
        reflects: whether the ray is reflected instead of refracted.
        rim_mm: distance from the axis at which the surface ends; infinite without an end.
        beyond_rim: status of a ray that meets the surface outside its rim. None: such a ray continues straight on, like
            one that misses the surface (the inner shells of a gradient lens are smaller than the pupil).
        through: gradient medium in front of the crossing; None: the ray is straight.
    """

    surface: Surface
    n_after: FloatLike
    inward: bool = True
    reflects: bool = False
    rim_mm: FloatLike = np.inf
    beyond_rim: Status | None = Status.MISSED
    through: GradientMedium | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Traced(ArrayValue):
    """Rays traced over S crossings.

    The leading axis of the points is 0 for the start and k for the k-th crossing. Values after a failed crossing are
    undefined.

    Attributes:
        points_mm: (S + 1, ..., 3) points.
        directions: (S + 1, ..., 3) unit directions on leaving each point.
        optical_path_mm: (...,) optical path from the start to the last crossing.
        status: (...,) of `Status`.
    """

    points_mm: Floats
    directions: Floats
    optical_path_mm: Floats
    status: Statuses


def inward_path(surfaces: Sequence[Surface], indices: Sequence[FloatLike]) -> tuple[Crossing, ...]:
    """Return the refractions at `surfaces`, given from outside in, with the index behind each."""
    return tuple(Crossing(surface=surface, n_after=index) for surface, index in zip(surfaces, indices, strict=True))


def outward_path(
    surfaces: Sequence[Surface], indices: Sequence[FloatLike], n_outside: FloatLike = 1.0
) -> tuple[Crossing, ...]:
    """Return the refractions at the same surfaces (given from outside in) on the way out."""
    behind = [n_outside, *indices[:-1]]
    return tuple(
        Crossing(surface=s, n_after=n, inward=False) for s, n in zip(reversed(surfaces), reversed(behind), strict=True)
    )


def trace(path: Sequence[Crossing], n_start: FloatLike, origins_mm: npt.ArrayLike, directions: npt.ArrayLike) -> Traced:
    """Trace rays through a path.

    Args:
        path: the crossings, in order.
        n_start: index of the medium in which the rays start.
        origins_mm: (..., 3) origins.
        directions: (..., 3) unit directions.
    """
    point, direction = components(origins_mm), components(directions)
    ndim = max(point[0].ndim, direction[0].ndim)
    shape = np.broadcast_shapes(point[0].shape, direction[0].shape)
    points, ways = [point], [direction]
    status = np.zeros(shape, dtype=np.int8)
    length = np.zeros(shape)
    index: FloatLike = n_start if isinstance(n_start, float) else fit(np.asarray(n_start, dtype=np.float64), ndim)
    for crossing in path:
        if crossing.through is None:
            # A distant origin loses digits in the quadratic. The foot of the perpendicular from the eye's origin does
            # not.
            lead = -dot(point, direction)
            hit = crossing.surface.hit(moved(point, direction, lead), direction, crossing.inward)
            step = hit.distance + lead
            met = hit.ok & (step > -BEHIND_MM)
        else:
            passage = crossing.through.cross(crossing.surface, crossing.inward, point, direction)
            hit, direction, met = passage.hit, passage.way, passage.hit.ok
            step = hit.distance
            length = length + passage.optical_path_mm
        within = met & inside_rim(crossing, hit.point)
        after, way, passes = cross(crossing, hit.gradient, direction, index)
        if crossing.beyond_rim is None:
            step = np.where(within, step, 0.0)
            passes = passes | ~within
            there = tuple(np.where(within, new, old) for new, old in zip(hit.point, point, strict=True))
            turned = tuple(np.where(within, new, old) for new, old in zip(way, direction, strict=True))
            after = np.where(within, after, index)
        else:
            there, turned = hit.point, way
            mark(status, ~met, Status.MISSED)
            mark(status, met & ~within, crossing.beyond_rim)
        mark(status, ~passes, Status.TOTAL_REFLECTION)
        length = length + index * step
        point, direction = (there[0], there[1], there[2]), (turned[0], turned[1], turned[2])
        index = after
        points.append(point)
        ways.append(direction)
    full = (*shape, 3)
    return Traced(
        np.stack([np.broadcast_to(join(p), full) for p in points]),
        np.stack([np.broadcast_to(join(w), full) for w in ways]),
        length,
        status,
    )


def cross(crossing: Crossing, gradient: Xyz, direction: Xyz, n_before: FloatLike) -> tuple[FloatLike, Xyz, Bools]:
    """Compute index and direction after a crossing with half gradient `gradient`, and whether light passes."""
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = unit(gradient)
        if crossing.reflects:
            way = reflect(direction, normal)
            return n_before, way, np.ones(way[0].shape, dtype=bool)
        n_after = crossing.n_after
        after = n_after if isinstance(n_after, float) else fit(np.asarray(n_after), direction[0].ndim)
        way, passes = refract(direction, normal, n_before, after)
        return after, way, passes


def inside_rim(crossing: Crossing, point: Xyz) -> Bools:
    """Return whether points of the surface lie within its rim."""
    rim = crossing.rim_mm
    if isinstance(rim, float) and rim == np.inf:
        return np.ones(point[0].shape, dtype=bool)
    limit = rim if isinstance(rim, float) else fit(np.asarray(rim), point[0].ndim)
    with np.errstate(invalid="ignore"):
        return np.asarray(crossing.surface.axis_distance(point) <= limit)


BEHIND_MM = 1e-9
"""A crossing this little behind the start counts as one at the start (rounding)."""
