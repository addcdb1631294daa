"""Purkinje images inside the eye: light enters, is reflected by a surface and leaves to a viewpoint.

Such a mirror point need not exist: a hyperboloid, for example the front of a lens that flattens outwards, faces no
farther than its asymptotic cone. If several exist, the Purkinje image is the one that continues the single paraxial
solution on the axis, and it is followed from there. With t from 0 to 1, source and viewpoint move along

    p(t) = o + (1 - t) |p - o| a + t (p - o)        (o, a: apex and axis of the outermost surface)

The exit point is predicted along the secant of the two previous positions, then corrected by Newton with ray
differentials. The step in t is halved if that fails or the ray tube's determinant changes its sign (another branch),
and doubled if it succeeds (Allgower & Georg 1990, "Numerical continuation methods", chapter 2). A branch ends at a
fold, where the determinant vanishes (the viewpoint lies on a caustic), at total reflection, or where a surface ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, FloatLike, Floats, Indices, Statuses
from ..base.status import Status
from .gradient import GradientMedium
from .shooting import Shot, correct, taken
from .solve import apex_of
from .surfaces import Surface, components, join
from .trace import Crossing, trace
from .transforms import normalize

FIRST_STEP = 0.125
SHORTEST_STEP = 2.0**-14
FOLD = 0.05
"""A branch that stalls with the tube's determinant below this part of its largest value ends there. At a fold the
determinant falls as the square root of what is left of t: to about 0.01 at the shortest step.
"""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PurkinjePoints(ArrayValue):
    """Points at which a surface inside the eye reflects light from a source to a viewpoint.

    Values are NaN if there is no such ray.
    """

    points_mm: Floats  # (..., 3) mirror point on the reflecting surface
    exit_points_mm: Floats  # (..., 3) where the ray meets the outermost surface on its way to the viewpoint
    directions: Floats  # (..., 3) unit vectors from there to the viewpoint
    # (2 k - 1, ..., 3) all points of the ray on k surfaces, from the exit point over the mirror point to the point of
    # entry
    course_mm: Floats
    residual_mm: Floats  # (...,) miss distance of the ray
    status: Statuses  # (...,)


def purkinje_path(
    surfaces: Sequence[Surface],  # outside in; the last one reflects
    indices: Sequence[FloatLike],  # the index behind each surface
    rims_mm: Sequence[FloatLike],  # the rim radius of each surface
    passing: Sequence[bool],  # whether a ray that misses a surface continues (shells of a gradient lens)
    # the medium in front of the innermost surface, if its index is not constant
    gradient: GradientMedium | None = None,
    n_outside: float = 1.0,  # index outside the eye
) -> tuple[Crossing, ...]:
    """Return the crossings of a ray that the innermost of `surfaces` reflects."""

    def crossing(k: int, n_after: FloatLike, inward: bool) -> Crossing:
        edge = Status.OUTSIDE_LIMBUS if k == 0 else Status.MISSED
        through = gradient if k == last - 1 and not inward else None
        return Crossing(
            surface=surfaces[k],
            n_after=n_after,
            inward=inward,
            reflects=False,
            rim_mm=rims_mm[k],
            beyond_rim=None if passing[k] else edge,
            through=through,
        )

    last = len(surfaces) - 1
    before = [n_outside, *indices]
    return (
        *(crossing(k, indices[k], True) for k in range(last)),
        Crossing(
            surface=surfaces[last],
            n_after=1.0,
            inward=True,
            reflects=True,
            rim_mm=rims_mm[last],
            beyond_rim=Status.NO_MIRROR_POINT,
            through=gradient,
        ),
        *(crossing(k, before[k], False) for k in reversed(range(last))),
    )


def purkinje_points(
    surfaces: Sequence[Surface],  # as are the next three and `gradient`, see `purkinje_path`
    indices: Sequence[FloatLike],  # the index behind each surface
    rims_mm: Sequence[FloatLike],  # the rim radius of each surface
    passing: Sequence[bool],  # whether a ray that misses a surface continues
    source_mm: npt.ArrayLike,  # (..., 3) sources
    viewpoint_mm: npt.ArrayLike,  # (..., 3) viewpoints; they broadcast against the sources
    gradient: GradientMedium | None = None,  # the medium in front of the innermost surface
    n_outside: float = 1.0,  # index outside the eye
) -> PurkinjePoints:
    """Solve for rays that the innermost of `surfaces` reflects, and that the outer ones refract in and out.

    The status is NO_MIRROR_POINT if the image, followed from the axis, ends before source and viewpoint reach their
    positions, or lies beyond the rim of the reflecting surface.
    """
    path = purkinje_path(surfaces, indices, rims_mm, passing, gradient, n_outside)
    viewpoint, source = np.broadcast_arrays(
        np.asarray(viewpoint_mm, dtype=np.float64), np.asarray(source_mm, dtype=np.float64)
    )
    shape = source.shape[:-1]
    full = shape or (1,)
    # One row per ray, so that finished rays are dropped.
    frame = np.repeat(np.arange(full[0]), int(np.prod(full[1:], dtype=np.intp)))
    outer = surfaces[0].take(frame)
    apex, axis = apex_of(outer), outer.rotation[..., :, 0]
    route = _Route(apex=apex, axis=axis, viewpoint=viewpoint.reshape(-1, 3) - apex, source=source.reshape(-1, 3) - apex)
    found = _followed(tuple(taken(c, frame) for c in path), n_outside, route)
    return PurkinjePoints(
        points_mm=found.points_mm.reshape(*shape, 3),
        exit_points_mm=found.exit_points_mm.reshape(*shape, 3),
        directions=found.directions.reshape(*shape, 3),
        course_mm=found.course_mm.reshape(-1, *shape, 3),
        residual_mm=found.residual_mm.reshape(shape),
        status=found.status.reshape(shape),
    )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Route:
    """Path along which viewpoints and sources move from the axis to their positions.

    Viewpoints and sources (m, 3) are given relative to the apex; apex and axis are (3,) or (m, 3).
    """

    apex: Floats
    axis: Floats
    viewpoint: Floats
    source: Floats

    def at(self, t: Floats, rows: Indices) -> tuple[Floats, Floats]:
        """Compute viewpoints and sources of `rows` at t."""
        apex = np.broadcast_to(self.apex, self.source.shape)[rows]
        axis = np.broadcast_to(self.axis, self.source.shape)[rows]
        along, left = t[:, None], 1.0 - t[:, None]

        def place(end: Floats) -> Floats:
            return np.asarray(apex + left * np.linalg.norm(end, axis=-1, keepdims=True) * axis + along * end)

        return place(self.viewpoint[rows]), place(self.source[rows])


def _followed(path: Sequence[Crossing], n_outside: float, route: _Route) -> PurkinjePoints:
    """Follow the images of a route's m rays from the axis."""
    count = len(route.source)
    t, t_before, step = np.zeros(count), np.zeros(count), np.full(count, FIRST_STEP)
    point, exits, way = (np.zeros((count, 3)) for _ in range(3))
    exits += route.apex
    before = exits.copy()
    residual, tube, largest = np.zeros(count), np.zeros(count), np.zeros(count)

    def sought(rows: Indices, to: Floats, aim: Floats) -> Shot:
        viewpoint, source = route.at(to, rows)
        some = path if len(rows) == count else [taken(c, rows) for c in path]
        return correct(some, n_outside, components(viewpoint), components(source), components(aim))

    def accept(rows: Indices, found: Shot, good: Bools) -> None:
        into = rows[good]
        before[into] = exits[into]
        point[into], exits[into], way[into] = (join(p)[good] for p in (found.turning, found.first, found.start))
        residual[into], tube[into] = found.residual_mm[good], found.determinant_mm2_sr[good]
        largest[into] = np.maximum(largest[into], np.abs(tube[into]))

    everything = np.arange(count)
    found = sought(everything, t, exits)
    good = found.status == Status.OK
    accept(everything, found, good)
    status = np.where(good, Status.OK, Status.NOT_CONVERGED).astype(np.int8)
    while len(rows := np.flatnonzero((status == Status.OK) & (t < 1.0))):
        here, stride = t[rows], np.minimum(step[rows], 1.0 - t[rows])
        past = here - t_before[rows]
        slope = (exits[rows] - before[rows]) / np.where(past > 0.0, past, np.inf)[:, None]
        found = sought(rows, here + stride, exits[rows] + stride[:, None] * slope)
        good = (found.status == Status.OK) & (found.determinant_mm2_sr * tube[rows] > 0.0)
        accept(rows, found, good)
        t_before[rows[good]], t[rows[good]] = here[good], (here + stride)[good]
        step[rows] = np.where(good, 2.0 * stride, 0.5 * stride)
        lost = ~good & (step[rows] < SHORTEST_STEP)
        folded = np.abs(tube[rows]) < FOLD * largest[rows]
        ended = lost & (folded | (found.status == Status.MISSED) | (found.status == Status.TOTAL_REFLECTION))
        status[rows[lost]] = Status.NOT_CONVERGED
        status[rows[ended]] = Status.NO_MIRROR_POINT
    ok = status == Status.OK
    # Rims are checked only for the final ray.
    traced = trace(
        path, n_outside, route.apex + route.viewpoint, np.where(ok[:, None], way, -normalize(route.viewpoint))
    )
    status = np.where(ok, traced.status, status)
    none = (status != Status.OK)[:, None]
    point, exits, way = (np.where(none, np.nan, value) for value in (point, exits, -way))
    course = np.where(none, np.nan, traced.points_mm[1:])
    return PurkinjePoints(
        points_mm=point,
        exit_points_mm=exits,
        directions=way,
        course_mm=course,
        residual_mm=np.where(none[:, 0], np.nan, residual),
        status=status,
    )
