"""Sequential ray tracing through any number of surfaces, with a status for each ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, FloatLike, Floats, Statuses
from ..base.status import Status, mark
from .formulas import NUMPY
from .gradient import GradientMedium
from .interface import dot, moved
from .surfaces import Surface, Xyz, components, fit, join

_Nested = TypeVar("_Nested")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Crossing:
    """Crossing of a surface by a ray."""

    surface: Surface  # the surface
    n_after: FloatLike  # index behind the crossing, () or (n,), one per eye. Ignored for a reflection.
    inward: bool = True  # whether the ray goes into the eye (towards -x of the surface's frame)
    reflects: bool = False  # whether the ray is reflected instead of refracted
    rim_mm: FloatLike = np.inf  # distance from the axis at which the surface ends; infinite without an end
    # status of a ray that meets the surface outside its rim. None: such a ray continues straight on, like one that
    # misses the surface (the inner shells of a gradient lens are smaller than the pupil).
    beyond_rim: Status | None = Status.MISSED
    through: GradientMedium | None = None  # gradient medium in front of the crossing; None: the ray is straight


@dataclass(frozen=True, slots=True, eq=False)
class Traced(ArrayValue):
    """Rays traced over S crossings.

    The leading axis of the points is 0 for the start and k for the k-th crossing. Values after a failed crossing are
    undefined.
    """

    points_mm: Floats  # (S + 1, ..., 3) points
    directions: Floats  # (S + 1, ..., 3) unit directions on leaving each point
    optical_path_mm: Floats  # (...,) optical path from the start to the last crossing
    status: Statuses  # (...,) of `Status`


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
    """Trace rays (..., 3) with unit directions through a path, from a medium of index `n_start`."""
    point, way = components(origins_mm), components(directions)
    shape = np.broadcast_shapes(point[0].shape, way[0].shape)
    points, ways = [point], [way]
    status, length = np.zeros(shape, dtype=np.int8), np.zeros(shape)
    index = index_of(n_start, len(shape))
    for crossing in path:
        step = cross(crossing, point, way, index)
        if crossing.beyond_rim is not None:
            mark(status, ~step.met, Status.MISSED)
            mark(status, ~step.within, crossing.beyond_rim)
        mark(status, step.blocked, Status.TOTAL_REFLECTION)
        length = length + step.optical_path_mm
        point, way, index = step.point, step.way, step.n_after
        points.append(point)
        ways.append(way)
    full = (*shape, 3)
    return Traced(
        np.stack([np.broadcast_to(join(p), full) for p in points]),
        np.stack([np.broadcast_to(join(w), full) for w in ways]),
        length,
        status,
    )


class Step(NamedTuple):
    """Rays behind a crossing."""

    point: Xyz  # point on the surface
    way: Xyz  # unit direction behind it
    n_after: FloatLike  # index behind it
    optical_path_mm: Floats  # optical path from the start of the ray
    met: Bools  # whether the ray meets the surface
    within: Bools  # whether it meets the surface within the rim
    blocked: Bools  # whether the surface reflects the ray totally
    moves: tuple[Xyz, ...]  # differentials of the point on the surface, one for each given one
    turns: tuple[Xyz, ...]  # differentials of the direction


def cross(
    crossing: Crossing, point: Xyz, way: Xyz, n_before: FloatLike, moves: Sequence[Xyz] = (), turns: Sequence[Xyz] = ()
) -> Step:
    """Trace rays through one crossing, with differentials of their points and directions.

    The differentials follow `formulas.sliding` and `formulas.differential`.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if crossing.through is None:
            # A distant origin loses digits in the quadratic. The foot of the perpendicular from the eye's origin does
            # not.
            lead = -dot(point, way)
            hit, before = crossing.surface.hit(moved(point, way, lead), way, crossing.inward), way
            distance = hit.distance + lead
            met, length = hit.ok & (distance > -BEHIND_MM), n_before * distance
            carried = [(moved(move, turn, distance), turn) for move, turn in zip(moves, turns, strict=True)]
        else:
            passage = crossing.through.cross(crossing.surface, crossing.inward, point, way, moves, turns)
            hit, before, met, length = passage.hit, passage.way, passage.hit.ok, passage.optical_path_mm
            carried = list(zip(passage.moves, passage.turns, strict=True))
        within = met & inside_rim(crossing, hit.point)
        inverse = 1.0 / np.sqrt(dot(hit.gradient, hit.gradient))
        normal = (hit.gradient[0] * inverse, hit.gradient[1] * inverse, hit.gradient[2] * inverse)
        after = n_before if crossing.reflects else index_of(crossing.n_after, before[0].ndim)
        bend = NUMPY.reflect(before, normal) if crossing.reflects else NUMPY.refract(before, normal, n_before / after)
        out_moves, out_turns = [], []
        for move, turn in carried:
            slid = NUMPY.slide(move, before, normal, bend.cosine)
            curve = crossing.surface.hessian_at(hit.point).times(slid)
            out_moves.append(slid)
            out_turns.append(NUMPY.bend_differential(bend, before, normal, inverse, curve, turn))
    blocked = np.zeros(met.shape, dtype=bool) if crossing.reflects else ~bend.passes
    step = Step(hit.point, bend.way, after, length, met, within, blocked, tuple(out_moves), tuple(out_turns))
    if crossing.beyond_rim is not None:
        return step
    # Rays that miss the surface, or meet it beyond its rim, continue straight on.
    nothing = np.zeros_like(length)
    past = Step(point, before, n_before, nothing, met, within, nothing > 0.0, tuple(moves), tuple(turns))
    return choose(within, step, past)


def choose(mask: Bools, new: _Nested, old: _Nested) -> _Nested:
    """Select arrays of nested tuples of one structure: the new ones where the mask holds, else the old ones."""
    return each(partial(np.where, mask), new, old)


def each(function: Callable[..., Any], *values: _Nested) -> _Nested:
    """Apply a function to each array of nested tuples with the same structure."""
    first: Any = values[0]
    if not isinstance(first, tuple):
        return function(*values)  # type: ignore[no-any-return]
    parts = [each(function, *some) for some in zip(*values, strict=True)]
    return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)  # type: ignore[return-value]


def index_of(value: FloatLike, ndim: int) -> FloatLike:
    """Reshape an index of refraction () or (n,) to broadcast with rays that have `ndim` axes."""
    return value if isinstance(value, float) else fit(np.asarray(value, dtype=np.float64), ndim)


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
