"""Rays between a camera, an eye and lamps that pass worn lenses or run beside them, and the lenses' own reflections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Indices, Statuses
from ..base.status import Status
from ..eye.batch import take_eyes
from ..eye.model import EyeModel
from ..eye.worn import Choice, Course, WornLens, choices, more_telling, reachable_by
from ..optics.shooting import connect
from ..optics.solve import joined_rays, mirroring, refracted_rays, refracting_path
from ..optics.surfaces import Xyz, components, join, shift, turn
from ..optics.trace import Crossing, each

_SEEDS = 5
_SAME_MM = 1e-6
"""Mirror points of one surface closer than this are one."""


class Leg(NamedTuple):
    """Rays from a camera to points of an eye or by way of its cornea to lamps, past the lenses that are worn.

    Attributes:
        seen: the last point on the way to the camera, where the camera sees the feature.
        exit: the point on the cornea.
        way: unit direction on arriving there from the camera.
        end: unit direction in the last medium.
        residual_mm: miss distance.
        status: (...,).
        passed: number of the choice of lenses passed; -1 where there is no ray.
    """

    seen: Xyz
    exit: Xyz
    way: Xyz
    end: Xyz
    residual_mm: Floats
    status: Statuses
    passed: Indices


def refracted_legs(eye: EyeModel, lenses: Sequence[WornLens], target: Xyz, viewpoint: Xyz) -> Leg:
    """Compute rays from the camera through cornea and lenses to points behind the cornea, (n, k)."""
    if not lenses:
        rays = refracted_rays(eye.front, eye.front_indices, target, viewpoint, rim_mm=eye.limbus_radius_mm)
        return Leg(rays.exit, rays.exit, rays.way, rays.end, rays.residual_mm, rays.status, _none(rays.status))
    courses = [(choice, ()) for choice in choices(len(lenses))]
    return _attempted(eye, lenses, courses, viewpoint, target, mirrors=False)


def mirrored_legs(eye: EyeModel, lenses: Sequence[WornLens], lights: Xyz, viewpoint: Xyz) -> Leg:
    """Compute rays from the camera by way of the cornea to lamps (n, m), each leg past the lenses."""
    every = choices(len(lenses))
    courses = sorted(((c, l) for c in every for l in every), key=lambda pair: -len(pair[0]) - len(pair[1]))
    return _attempted(eye, lenses, courses, viewpoint, lights, mirrors=True)


def _none(status: Statuses) -> Indices:
    return np.zeros(status.shape, dtype=np.intp)


def _attempted(
    eye: EyeModel,
    lenses: Sequence[WornLens],
    courses: Sequence[tuple[Choice, Choice]],
    viewpoint: Xyz,
    target: Xyz,
    *,
    mirrors: bool,
) -> Leg:
    """Solve for the first course (lenses of the camera's leg, of the lamp's leg) that each ray can take."""
    shape = np.broadcast_shapes(*(axis.shape for axis in (*viewpoint, *target)))
    viewpoint, target = (each(lambda axis: np.broadcast_to(axis, shape), point) for point in (viewpoint, target))
    nothing = (np.full(shape, np.nan),) * 3
    whole = Leg(
        nothing, nothing, nothing, nothing, nothing[0], np.full(shape, Status.NONE, np.int8), np.full(shape, -1)
    )
    for number, (before, after) in enumerate(courses):
        may = reachable_by(lenses, before, viewpoint) & (whole.status != Status.OK)
        if mirrors:
            may &= reachable_by(lenses, after, target)
        rows = np.flatnonzero(may.any(axis=1))
        if not len(rows):
            continue
        some, near = take_eyes(eye, rows), [lens.take(rows) for lens in lenses]
        ends = (_rows_of(point, rows) for point in (viewpoint, target))
        found = _one_course(some, near, (before[::-1], after), *ends, mirrors=mirrors)
        good = may[rows] & (found.status == Status.OK)
        status = np.where(may[rows], more_telling(whole.status[rows], found.status), whole.status[rows])
        found = found._replace(passed=np.full(good.shape, number), status=np.where(good, np.int8(Status.OK), status))
        whole = each(partial(_placed, rows, good), whole, found)
        whole.status[rows] = found.status
    return whole


def _rows_of(point: Xyz, rows: Indices) -> Xyz:
    x, y, z = point
    return x[rows], y[rows], z[rows]


def _placed(rows: Indices, good: Bools, old: Floats, new: Floats) -> Floats:
    """Put new values into rows of old ones where they are good."""
    out = np.array(old)
    out[rows] = np.where(good, new, old[rows])
    return out


def _one_course(
    eye: EyeModel,
    lenses: Sequence[WornLens],
    passed: tuple[Choice, Choice],
    viewpoint: Xyz,
    target: Xyz,
    *,
    mirrors: bool,
) -> Leg:
    """Solve for the rays of one course, and check them."""
    middle = refracting_path(eye.front, eye.front_indices, eye.limbus_radius_mm)
    if mirrors:
        middle = (mirroring(eye.front[0], eye.limbus_radius_mm),)
    course = Course.of(lenses, passed[0], middle, passed[1])
    cornea = course.first_of_eye
    rays = joined_rays(course.path, 1.0, viewpoint, target, cornea)
    traced, status = course.follow(viewpoint, rays.way, target)
    status = np.where(rays.status == Status.OK, status, rays.status).astype(np.int8)
    exit, way = components(traced.points_mm[cornea + 1]), components(traced.directions[cornea])
    return Leg(rays.exit, exit, way, rays.end, rays.residual_mm, status, _none(status))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LensImage:
    """A reflection of a lamp in a lens.

    Attributes:
        lamp: number of the lamp.
        surface: front or back.
        index: number of the image in this surface; further lenses go on counting.
        seen_mm: (3,) the last point on the way to the camera; NaN where the status is not OK.
        residual_mm: miss distance.
        status: of the image.
    """

    lamp: int
    surface: str
    index: int
    seen_mm: Floats
    residual_mm: float
    status: Status


def lens_images(lenses: Sequence[WornLens], lamps_mm: Floats, camera_mm: Floats) -> list[LensImage]:
    """Compute the reflections of lamps (m, 3) in both surfaces of lenses, seen from a camera (3,), in the head's frame.

    Every surface is searched from a grid of points inside the outline, because it may show several images of a lamp, or
    none. What hides them (the eye, the face) is not considered.
    """
    out = []
    for surface in ("front", "back"):
        images: list[list[tuple[Floats, float]]] = [[] for _ in lamps_mm]
        for k in range(len(lenses)):
            _add_images(images, lenses, k, surface, lamps_mm, camera_mm)
        for lamp, own in enumerate(images):
            status = Status.OK if own else Status.NO_MIRROR_POINT
            out += [
                LensImage(lamp=lamp, surface=surface, index=index, seen_mm=seen, residual_mm=residual, status=status)
                for index, (seen, residual) in enumerate(own or [(np.full(3, np.nan), np.nan)])
            ]
    return sorted(out, key=lambda one: one.lamp)


def _add_images(
    images: list[list[tuple[Floats, float]]],
    lenses: Sequence[WornLens],
    number: int,
    surface: str,
    lamps_mm: Floats,
    camera_mm: Floats,
) -> None:
    """Append the images of each lamp in one surface of one lens: the point that the camera sees, and the residual."""
    lens, camera = lenses[number], components(camera_mm)
    lamps: Xyz = components(lamps_mm[:, None])
    outside = bool(lens.faces(camera))
    beside = lens.faces(lamps)[:, 0] != outside
    first, second = lens.inward() if outside else lens.outward()
    mirror = Crossing(
        surface=getattr(lens, surface), n_after=1.0, inward=outside, reflects=True, beyond_rim=Status.MISSED
    )
    middle: tuple[Crossing, ...] = (mirror,)
    if mirror.surface is second.surface:
        middle = (first, mirror, (lens.outward() if outside else lens.inward())[1])
    between = range(number + 1, len(lenses)) if outside else range(number)
    seeds = _seeds(lens, mirror)
    known: list[list[Floats]] = [[] for _ in lamps_mm]
    for before, after in product(choices(len(between)), repeat=2):
        there = sorted((between[k] for k in before), reverse=outside)
        back = sorted((between[k] for k in after), reverse=not outside)
        course = Course.of(lenses, tuple(there), middle, tuple(back), number)
        shot = connect(course.path, 1.0, camera, lamps, seeds)
        start = components(np.broadcast_to(camera_mm, (*shot.status.shape, 3)))
        traced, status = course.follow(start, shot.start, lamps)
        good = (shot.status == Status.OK) & (status == Status.OK) & ~beside[:, None]
        points = join(shot.turning)
        for i, k in np.argwhere(good).tolist():
            if all(np.linalg.norm(points[i, k] - other) >= _SAME_MM for other in known[i]):
                known[i].append(points[i, k])
                images[i].append((traced.points_mm[1, i, k], float(shot.residual_mm[i, k])))


def _seeds(lens: WornLens, mirror: Crossing) -> Xyz:
    """Return points of a surface inside the outline, nearest to its centre first."""
    y, z = (g.ravel() for g in np.meshgrid(*(np.linspace(-0.95, 0.95, _SEEDS),) * 2))
    order = np.argsort(y * y + z * z, kind="stable")
    order = order[: np.count_nonzero(y * y + z * z <= 1.0)]
    y, z = lens.half_mm[0] * y[order], lens.half_mm[1] * z[order]
    start = shift(turn(lens.rotation, (np.zeros_like(y), y, z)), lens.centre_mm, 1.0)
    way = components(np.broadcast_to(lens.rotation[:, 0], (len(y), 3)))
    hit = mirror.surface.hit(start, way, False)
    return hit.point
