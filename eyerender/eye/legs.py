"""Rays between a camera, an eye and lamps that pass worn lenses or run beside them, and the lenses' own reflections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Indices, Statuses
from ..base.status import Status
from ..optics.interface import minus, unit
from ..optics.shooting import connect, correct
from ..optics.solve import Rays, joined_rays, mirroring, refracted_rays, refracting_path
from ..optics.surfaces import Xyz, components, join, shift, turn
from ..optics.trace import Crossing, each
from .model import EyeModel
from .worn import Choice, Course, WornLens, choices, more_telling, reachable_by

_AT_APEX = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
_SEEDS = 5
_SAME_MM = 1e-6
"""Mirror points of one surface closer than this are one."""


class Leg(NamedTuple):
    """Rays from a camera to points of an eye or by way of its cornea to lamps, past the lenses that are worn."""

    seen: Xyz  # the last point on the way to the camera, where the camera sees the feature
    exit: Xyz  # the point on the cornea
    way: Xyz  # unit direction on arriving there from the camera
    end: Xyz  # unit direction in the last medium
    residual_mm: Floats  # miss distance
    status: Statuses  # (...,)
    passed: Indices  # number of the choice of lenses passed; -1 where there is no ray


def refracted_legs(eye: EyeModel, lenses: Sequence[WornLens], target: Xyz, viewpoint: Xyz) -> Leg:
    """Compute rays from the camera through cornea and lenses to points behind the cornea, (n, k)."""
    if not lenses:
        rays = refracted_rays(eye.front, eye.front_indices, target, viewpoint, rim_mm=eye.limbus_radius_mm)
        return Leg(rays.exit, rays.exit, rays.way, rays.end, rays.residual_mm, rays.status, _none(rays.status))
    middle = refracting_path(eye.front, eye.front_indices, eye.limbus_radius_mm)
    return _attempted(middle, lenses, [(choice, ()) for choice in choices(len(lenses))], viewpoint, target)


def mirrored_legs(eye: EyeModel, lenses: Sequence[WornLens], lights: Xyz, viewpoint: Xyz) -> Leg:
    """Compute rays from the camera by way of the cornea to lamps (n, m), each leg past the lenses."""
    return _attempted((mirror_of(eye),), lenses, both_legs(len(lenses)), viewpoint, lights)


def air_legs(lenses: Sequence[WornLens], target: Xyz, viewpoint: Xyz, *, thorough: bool = True) -> Leg:
    """Compute rays from the camera past lenses to points in front of the eye, (n, k); `exit` is the point itself."""
    courses = [(choice, ()) for choice in choices(len(lenses))]
    return _attempted((), lenses, courses, viewpoint, target, thorough=thorough)


def mirror_of(eye: EyeModel) -> Crossing:
    """Return the reflection at the cornea of an eye."""
    return mirroring(eye.front[0], eye.limbus_radius_mm)


def both_legs(count: int) -> list[tuple[Choice, Choice]]:
    """Return the choices of lenses for the legs of camera and lamp, those with most lenses first."""
    every = choices(count)
    return sorted(product(every, every), key=lambda pair: -len(pair[0]) - len(pair[1]))


def apparent_places(lenses: Sequence[WornLens], points_mm: Floats) -> Floats:
    """Compute where points (n, 3) appear from the eye's apex behind lenses: nearest to the rays to three points there.

    Points without a ray stay where they are. Lenses and points are in one frame, the eye's or the unrotated eye's.
    """
    target = components(_AT_APEX[None])
    seen = [air_legs([lens.take(None) for lens in lenses], target, components(p[None, None])) for p in points_mm]
    ways = np.stack([join(leg.way)[0] for leg in seen])
    across = np.eye(3) - ways[..., :, None] * ways[..., None, :]
    found = np.linalg.solve(across.sum(axis=1), np.einsum("npij,pj->ni", across, _AT_APEX)[..., None])[..., 0]
    return np.where(np.isfinite(found), found, points_mm)


def _none(status: Statuses) -> Indices:
    return np.zeros(status.shape, dtype=np.intp)


def _attempted(
    middle: Sequence[Crossing],
    lenses: Sequence[WornLens],
    courses: Sequence[tuple[Choice, Choice]],
    viewpoint: Xyz,
    target: Xyz,
    *,
    thorough: bool = True,
) -> Leg:
    """Solve for the first course (lenses of the camera's leg, of the lamp's leg) that each ray (n, k) can take."""
    shape = np.broadcast_shapes(*(axis.shape for axis in (*viewpoint, *target)))
    starts, ends = (each(lambda axis: np.broadcast_to(axis, shape), point) for point in (viewpoint, target))
    nothing = (np.full(shape, np.nan),) * 3
    status, passed = np.full(shape, Status.NONE, np.int8), np.full(shape, -1)
    whole = Leg(nothing, nothing, nothing, nothing, nothing[0], status, passed)
    for number, (before, after) in enumerate(courses):
        may = reachable_by(lenses, before, viewpoint, None if middle else target) & reachable_by(lenses, after, target)
        may = may & (whole.status != Status.OK)
        rows = np.flatnonzero(may.any(axis=1))
        if not len(rows):
            continue
        course, every = Course.of(lenses, before[::-1], middle, after), len(rows) == shape[0]
        if every:
            found = _one_course(course, starts, ends, thorough)
        else:
            found = _one_course(course.take(rows), _rows_of(starts, rows), _rows_of(ends, rows), thorough)
        good = may[rows] & (found.status == Status.OK)
        status = np.where(may[rows], more_telling(whole.status[rows], found.status), whole.status[rows])
        found = found._replace(passed=np.full(good.shape, number), status=np.where(good, np.int8(Status.OK), status))
        if good.all() and every:
            return found
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


def _one_course(course: Course, viewpoint: Xyz, target: Xyz, thorough: bool) -> Leg:
    """Solve for the rays of one course, and check them."""
    eye = course.first_of_eye
    if not course.path:
        gap = unit(minus(target, viewpoint))
        zero = np.zeros(gap[0].shape)
        rays = Rays(target, gap, gap, target, gap, zero, zero.astype(np.int8))
    else:
        rays = joined_rays(course.path, 1.0, viewpoint, target, eye or 0, outlines=course.outlines(), thorough=thorough)
    exit, way = (target, rays.end) if eye is None else (rays.met, rays.arriving)
    status, ok = np.array(rays.status), rays.status == Status.OK
    rows = np.flatnonzero((ok & (bool(course.beside()) | np.isnan(rays.met[0]))).any(axis=1))
    if len(rows):  # these are not checked by the compiled solver, or have to keep clear of other lenses
        ends = (_rows_of(point, rows) for point in (viewpoint, rays.way, target))
        traced, checked = course.take(rows).follow(*ends)
        status[rows] = np.where(ok[rows], checked, status[rows])
        if eye is not None:
            known = (components(traced.points_mm[eye + 1]), components(traced.directions[eye]))
            exit, way = each(partial(_placed, rows, ok[rows]), (exit, way), known)
    return Leg(rays.exit, exit, way, rays.end, rays.residual_mm, status.astype(np.int8), _none(status))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LensImage:
    """A reflection of a lamp in a lens."""

    lamp: int  # number of the lamp
    surface: str  # front or back
    index: int  # number of the image in this surface; further lenses go on counting
    status: Status  # of the image; the numbers below are NaN where it is not OK
    # (3,) where light of the lamp first meets a lens
    met_mm: Floats = field(default_factory=partial(np.full, 3, np.nan))
    seen_mm: Floats = field(default_factory=partial(np.full, 3, np.nan))  # (3,) the last point on the way to the camera
    mirror_mm: Floats = field(default_factory=partial(np.full, 3, np.nan))  # (3,) the mirror point
    # (3,) unit direction in which the light leaves the lamp
    leaving: Floats = field(default_factory=partial(np.full, 3, np.nan))
    share: float = np.nan  # share of the light that arrives
    cross_section_mm2_sr: float = np.nan  # cross section of the ray tube at the lamp per solid angle at the camera
    residual_mm: float = np.nan  # miss distance


def lens_images(
    lenses: Sequence[WornLens], lamps_mm: Floats, camera_mm: Floats, near_mm: Floats | None = None
) -> list[LensImage]:
    """Compute the reflections of lamps (m, 3) in both surfaces of lenses, seen from a camera (3,), in the head's frame.

    Every surface is searched from a grid of points inside the outline, because it may show several images of a lamp, or
    none. What hides them (the eye, the face) is not considered.

    Args:
        lenses: the lenses, in order from the eye.
        lamps_mm: the lamps.
        camera_mm: the camera.
        near_mm: (p, 3) where mirror points are searched, in place of the grid.
    """
    out: list[LensImage] = []
    for surface in ("front", "back"):
        images: list[list[LensImage]] = [[] for _ in lamps_mm]
        for k in range(len(lenses)):
            _add_images(images, lenses, k, surface, (lamps_mm, camera_mm, near_mm))
        for lamp, own in enumerate(images):
            out += own or [LensImage(lamp=lamp, surface=surface, index=0, status=Status.NO_MIRROR_POINT)]
    return sorted(out, key=lambda one: one.lamp)


def _add_images(
    images: list[list[LensImage]],
    lenses: Sequence[WornLens],
    number: int,
    surface: str,
    ends: tuple[Floats, Floats, Floats | None],
) -> None:
    """Append the images of each lamp in one surface of one lens; `ends` are lamps, camera and places to search."""
    lens, (lamps_mm, camera_mm, near_mm) = lenses[number], ends
    camera, lamps = components(camera_mm), components(lamps_mm[:, None])
    outside = bool(lens.faces(camera))
    beside = lens.faces(lamps)[:, 0] != outside
    first, second = lens.inward() if outside else lens.outward()
    far = getattr(lens, surface) is second.surface
    mirror = Crossing(
        surface=(second if far else first).surface, n_after=lens.index if far else 1.0, inward=outside, reflects=True,
        beyond_rim=Status.MISSED,
    )  # fmt: skip
    middle = (first, mirror, (lens.outward() if outside else lens.inward())[1]) if far else (mirror,)
    seeds = _seeds(lens, mirror) if near_mm is None else components(near_mm)
    between = range(number + 1, len(lenses)) if outside else range(number)
    for before, after in product(choices(len(between)), repeat=2):
        there = sorted((between[k] for k in before), reverse=outside)
        back = sorted((between[k] for k in after), reverse=not outside)
        course = Course.of(lenses, tuple(there), middle, tuple(back), number)
        of_lamp, aims = _found_from(course, 2 * len(there) + len(middle) // 2, camera, lamps, seeds, outside)
        of_lamp, aims = of_lamp[~beside[of_lamp]], each(lambda axis, keep=~beside[of_lamp]: axis[keep], aims)
        if not len(of_lamp):
            continue
        target = components(lamps_mm[of_lamp])
        shot = correct(course.path, 1.0, *_spread_ends(camera, target), aims)
        traced, status = course.follow(_spread_ends(camera, target)[0], shot.start, target)
        points, leaving, share = join(shot.turning), -join(shot.end), course.share(traced)
        for j in np.flatnonzero((shot.status == Status.OK) & (status == Status.OK)).tolist():
            own = images[of_lamp[j]]
            if all(np.linalg.norm(points[j] - other.mirror_mm) >= _SAME_MM for other in own):
                one = LensImage(
                    lamp=int(of_lamp[j]), surface=surface, index=len(own), status=Status.OK,
                    met_mm=traced.points_mm[-1, j], seen_mm=traced.points_mm[1, j],
                    mirror_mm=points[j], leaving=leaving[j],
                    share=float(share[j]), cross_section_mm2_sr=abs(float(shot.determinant_mm2_sr[j])),
                    residual_mm=float(shot.residual_mm[j]),
                )  # fmt: skip
                own.append(one)


def _spread_ends(camera: Xyz, target: Xyz) -> tuple[Xyz, Xyz]:
    """Repeat the camera for each target (m,)."""
    return each(lambda axis: np.broadcast_to(axis, target[0].shape), camera), target


def _found_from(course: Course, mirror: int, camera: Xyz, lamps: Xyz, seeds: Xyz, outside: bool) -> tuple[Indices, Xyz]:
    """Search the rays to lamps (m, 1) from every seed (s,) on the mirror, which is the crossing of this number.

    Returns:
        The lamp of each ray found, those of the first seeds first, and where it first meets a lens. Rays that are the
        same to a tenth of `_SAME_MM` count once.
    """
    if outside:
        rays = joined_rays(
            course.path, 1.0, camera, lamps, mirror, outlines=course.outlines(), starts=seeds, thorough=False
        )
        place, first, good = rays.met, rays.exit, rays.status == Status.OK
    else:
        shot = connect(course.path, 1.0, camera, lamps, seeds)
        place, first, good = shot.turning, shot.first, shot.status == Status.OK
    seed, lamp = np.nonzero(good.T)
    key = np.column_stack([lamp, np.round(join(place)[lamp, seed] / (0.1 * _SAME_MM))])
    kept = np.sort(np.unique(key, axis=0, return_index=True)[1])
    return lamp[kept], components(join(first)[lamp[kept], seed[kept]])


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
