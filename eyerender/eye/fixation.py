"""Fixation: the pose in which the line of sight of an eye runs from a target to the fovea.

There are two definitions of the line of sight:

`chief_ray`: the ray from the target that passes the centre of the stop and ends on the fovea. Its course in the eye
does not depend on the target, so outside the eye it is one line fixed to the eye. The pose turns this line through the
target. That gives two equations in azimuth and elevation, which Newton solves with exact derivatives.

`entrance_window`: six points evenly spaced on the stop's margin are each joined to the target by a refracted ray. The
six exit rays are extended backwards by one common length, chosen so that the mean of the six end points comes closest
to the optic axis. That mean is the window's centre. The line of sight runs from the target towards it and must end on
the fovea. (gkaModelEye's definition, Aguirre 2019, "A model of the entrance pupil of the human eye", Sci. Rep. 9,
9360.)

Behind spectacles the chief ray is traced on through the lenses, or past them outside their outlines; the pose is solved
by Broyden's method. The lenses stay with the head, so here the course outside the eye does depend on the target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, Floats, Statuses, frozen, take_rows
from ..base.errors import InputError
from ..base.status import Status, mark
from ..optics.interface import dot
from ..optics.solve import apparent_points
from ..optics.surfaces import Xyz, components, join
from ..optics.trace import trace
from ..optics.transforms import inverse_2x2, normalize
from .batch import CHUNK_POINTS, chunks, groups, take_eyes
from .landmarks import path_to_retina
from .model import EyeModel
from .pose import Poses, Turning, centres_of, into_eye, listing_torsion, rigid_motion, split
from .pose_kernels import SETTLED_MM, turn_all
from .worn import Course, choices, more_telling, reachable_by

LineOfSightKind = Literal["chief_ray", "entrance_window"]

RESIDUAL_LIMIT_MM = 1e-6
"""A pose whose line of sight misses by more is refused."""
REACH_RAD = np.radians(80.0)
"""No eye turns farther; targets that would need it are out of reach."""
WINDOW_POINTS = 6

_STEPS = 20


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Fixations(ArrayValue):
    """A batch of fixations, leading axis n."""

    poses: Poses  # poses of the eye
    # (n,) miss distance of the line of sight (chief ray: from the target; entrance window: from the fovea)
    residual_mm: Floats
    status: Statuses  # (n,) of `Status`
    line_of_sight_mm: Floats  # (n, 3) point where the line of sight meets the cornea, in the eye-fixed frame
    line_of_sight_direction: Floats  # (n, 3) unit vectors from there to the target, in the eye-fixed frame

    def reason(self, item: int) -> str | None:
        """Return the reason why fixation `item` failed; None if it did not."""
        return Status(int(self.status[item])).reason

    def __len__(self) -> int:
        return len(self.residual_mm)


def fixations(
    eyes: Sequence[EyeModel],
    eye_index: npt.ArrayLike,
    target_mm: npt.ArrayLike,
    position_mm: npt.ArrayLike,
    line_of_sight: LineOfSightKind = "chief_ray",
) -> Fixations:
    """Compute the poses with which n eyes fixate targets.

    The eyes are `eyes[eye_index]`. Their apexes at rest lie at `position_mm` (n, 3) in the world, head position
    included.
    """
    which = np.asarray(eye_index, dtype=np.intp)
    seen = np.asarray(target_mm, dtype=np.float64) - np.asarray(position_mm, dtype=np.float64)
    n = len(which)
    angles = np.zeros((n, 3))
    residual, status = np.zeros(n), np.zeros(n, dtype=np.int8)
    point, way = np.zeros((n, 3)), np.zeros((n, 3))
    for group, rows in groups(eyes, which):
        size = max(1, CHUNK_POINTS // 6) if line_of_sight == "entrance_window" else CHUNK_POINTS
        for part, local in chunks(group, rows, size):
            found = fixate(local, seen[part], line_of_sight)
            poses = found.poses
            angles[part] = np.stack([poses.azimuth_rad, poses.elevation_rad, poses.torsion_rad], axis=-1)
            residual[part], status[part] = found.residual_mm, found.status
            point[part], way[part] = found.line_of_sight_mm, found.line_of_sight_direction
    return Fixations(
        poses=Poses(*angles.T),
        residual_mm=frozen(residual),
        status=frozen(status, np.int8),
        line_of_sight_mm=frozen(point),
        line_of_sight_direction=frozen(way),
    )


def fixate(eye: EyeModel, target_mm: npt.ArrayLike, line_of_sight: LineOfSightKind = "chief_ray") -> Fixations:
    """Compute the poses with which an eye fixates targets.

    Args:
        eye: one eye, or a batch of n.
        target_mm: (n, 3) in the eye frame, i.e. the world's target minus the eye's position minus the head's.
        line_of_sight: "chief_ray" or "entrance_window", see the module.

    Raises:
        InputError: a target is not a finite point, or the definition is unknown.
    """
    target = np.atleast_2d(np.asarray(target_mm, dtype=np.float64))
    if target.ndim != 2 or target.shape[1] != 3 or not np.isfinite(target).all():
        raise InputError("must be finite points (x, y, z)", path="target_mm")
    if line_of_sight == "chief_ray":
        return _by_chief_ray(eye, target) if not eye.worn else _through_lenses(eye, target)
    if line_of_sight == "entrance_window":
        return _by_entrance_window(eye, target)
    raise InputError(f"must be chief_ray or entrance_window, not {line_of_sight!r}", path="line_of_sight")


def with_torsion(
    eyes: Sequence[EyeModel], eye_index: npt.ArrayLike, found: Fixations, target_mm: npt.ArrayLike, extra_rad: Floats
) -> Poses:
    """Turn fixating eyes by a torsion (n,) in addition to that of Listing's law, so that they still see their targets.

    A turn about the optic axis alone would move the line of sight off the target, by angle kappa times the torsion. The
    line of sight keeps its direction to the point where it ended; each step turns the eye by the angle it is off.
    Targets (n, 3) are in the eyes' frames.
    """
    which, target = np.asarray(eye_index, dtype=np.intp), np.asarray(target_mm, dtype=np.float64)
    azimuth, elevation = np.array(found.poses.azimuth_rad), np.array(found.poses.elevation_rad)
    for k in np.unique(which).tolist():
        rows = np.flatnonzero(which == k)
        point, way = found.line_of_sight_mm[rows], found.line_of_sight_direction[rows]
        start, ahead = _sights(eyes[k], take_rows(found.poses, rows), point, way)
        end = start + ahead * np.linalg.norm(target[rows] - start, axis=-1, keepdims=True)
        for _ in range(_STEPS):
            listing = listing_torsion(azimuth[rows], elevation[rows])
            poses = Poses(azimuth[rows], elevation[rows], listing + extra_rad[rows])
            place, direction = _sights(eyes[k], poses, point, way)
            wanted = end - place
            off = np.arctan2(wanted[:, 1], wanted[:, 0]) - np.arctan2(direction[:, 1], direction[:, 0])
            azimuth[rows] += off
            across = np.hypot(wanted[:, 0], wanted[:, 1]), np.hypot(direction[:, 0], direction[:, 1])
            elevation[rows] += np.arctan2(wanted[:, 2], across[0]) - np.arctan2(direction[:, 2], across[1])
    return Poses(azimuth, elevation, listing_torsion(azimuth, elevation) + extra_rad)


def _sights(eye: EyeModel, poses: Poses, point_mm: Floats, way: Floats) -> tuple[Floats, Floats]:
    """Return points and directions (n, 3) of lines of sight that are fixed in posed eyes."""
    turn, shift = rigid_motion(poses, eye)
    return np.einsum("nij,nj->ni", turn, point_mm) + shift, np.einsum("nij,nj->ni", turn, way)


def far_sight_mm(eye: EyeModel) -> Floats:
    """Compute the position (y, z) mm of the line of sight, in the eye frame, for an eye that looks far along +x.

    The chief ray to the fovea has a direction d in the eye. The torsion-free rotation that turns d to +x is that of
    Listing's law for the gaze (d_x, -d_y, -d_z).
    """
    x, y, z = eye.chief_ray.direction
    pose = Poses.listing(np.arctan2(-y, x), np.arcsin(-z))
    turn, shift = rigid_motion(pose, eye)
    return np.asarray((turn[0] @ eye.chief_ray.point_mm + shift[0])[1:])


def _by_chief_ray(eye: EyeModel, target_mm: Floats) -> Fixations:
    """Turn the fixed line p + s u through the target."""
    point, direction = eye.chief_ray.point_mm, eye.chief_ray.direction
    lines, out = np.array(np.atleast_2d(np.concatenate([point, direction], axis=-1))), np.empty((len(target_mm), 4))
    turn_all(centres_of(eye), lines, np.array(target_mm), _START_RAD, out)
    azimuth, elevation, miss, ahead = (np.array(column) for column in out.T)
    status = _status(target_mm, azimuth=azimuth, elevation=elevation, residual=miss)
    status[(status == Status.OK) & ~(ahead > 0.0)] = Status.TARGET_TOO_NEAR
    poses = Poses.listing(azimuth, elevation)
    return Fixations(
        poses=poses,
        residual_mm=miss,
        status=status,
        line_of_sight_mm=np.broadcast_to(point, target_mm.shape),
        line_of_sight_direction=np.broadcast_to(direction, target_mm.shape),
    )


def _by_entrance_window(eye: EyeModel, target_mm: Floats) -> Fixations:
    """Solve for the pose by Broyden's method, starting from the pose by chief ray.

    The error is the miss at the fovea, across the line of sight.
    """
    start = _by_chief_ray(eye, target_mm)
    ok = start.status == Status.OK
    angles, missed = _solved(lambda angles: _window_miss(eye, target_mm, angles), start.poses, ok)
    azimuth, elevation = angles.T
    residual = np.linalg.norm(missed.miss, axis=-1)
    status = np.where(
        ok, _status(target_mm, azimuth=azimuth, elevation=elevation, residual=residual), start.status
    ).astype(np.int8)
    status[ok & missed.lost] = Status.NO_LINE_OF_SIGHT
    return Fixations(
        poses=Poses.listing(azimuth, elevation),
        residual_mm=residual,
        status=status,
        line_of_sight_mm=missed.point,
        line_of_sight_direction=missed.way,
    )


def _through_lenses(eye: EyeModel, target_mm: Floats) -> Fixations:
    """Turn the chief ray, traced on through the lenses or past them, through the target."""
    bare = _by_chief_ray(eye, target_mm)
    angles = np.stack([bare.poses.azimuth_rad, bare.poses.elevation_rad], axis=-1)
    residual, status = np.array(bare.residual_mm), np.full(len(target_mm), Status.NONE, dtype=np.int8)
    for choice in choices(len(eye.worn)):
        course = Course.of(eye.worn, (), (), choice)
        rows = np.flatnonzero((status != Status.OK) & reachable_by(eye.worn, choice, components(target_mm)))
        if not len(rows):
            continue
        one, target, poses = take_eyes(eye, rows), target_mm[rows], take_rows(bare.poses, rows)
        ok = bare.status[rows] == Status.OK
        found, missed = _solved(partial(_lens_miss, course, one, target), poses, ok)
        miss = np.linalg.norm(missed.miss, axis=-1)
        traced, passes = course.follow(components(missed.point), components(missed.way), components(target))
        new = _status(target, azimuth=found[:, 0], elevation=found[:, 1], residual=miss)
        behind = np.sum((target - traced.points_mm[-1]) * traced.directions[-1], axis=-1) <= 0.0
        mark(new, behind, Status.TARGET_TOO_NEAR)
        new = np.where(new == Status.OK, passes, new)
        new = np.where(ok, new, bare.status[rows])
        angles[rows], residual[rows], status[rows] = found, miss, more_telling(status[rows], new)
    return Fixations(
        poses=Poses.listing(angles[:, 0], angles[:, 1]),
        residual_mm=residual,
        status=status,
        line_of_sight_mm=bare.line_of_sight_mm,
        line_of_sight_direction=bare.line_of_sight_direction,
    )


def _lens_miss(course: Course, eye: EyeModel, target_mm: Floats, angles: Floats) -> _Missed:
    """Compute the miss (n, 2) of targets by the chief ray behind lenses, and where it is in the unturned frame."""
    turn, shift = rigid_motion(Poses.listing(angles[:, 0], angles[:, 1]), eye)
    point = np.einsum("nij,nj->ni", turn, np.broadcast_to(eye.chief_ray.point_mm, target_mm.shape)) + shift
    way = np.einsum("nij,nj->ni", turn, np.broadcast_to(eye.chief_ray.direction, target_mm.shape))
    traced = trace(course.path, 1.0, point, way)
    lost = traced.status != Status.OK
    first, second = _tangents(split(traced.directions[-1]))
    gap = split(target_mm - traced.points_mm[-1])
    miss = np.stack([dot(first, gap), dot(second, gap)], axis=-1)
    return _Missed(np.where(lost[:, None], 0.0, miss), point, way, lost)


class _Missed(NamedTuple):
    """A line of sight of a pose: its miss (n, 2) mm, a point and a direction of it (n, 3), and where there is none."""

    miss: Floats
    point: Floats
    way: Floats
    lost: Bools


def _solved(miss_at: Callable[[Floats], _Missed], start: Poses, ok: Bools) -> tuple[Floats, _Missed]:
    """Solve for the azimuths and elevations (n, 2) at which nothing is missed, by Broyden's method."""
    angles = np.stack([start.azimuth_rad, start.elevation_rad], axis=-1)
    angles = np.where(ok[:, None], angles, 0.0)
    now = miss_at(angles)
    miss, lost = now.miss, now.lost
    slope = np.stack([(miss_at(angles + step).miss - miss) / _NUDGE_RAD for step in _NUDGE_RAD * np.eye(2)], axis=-1)
    for _ in range(_STEPS):
        if not np.max(np.abs(miss), where=(ok & ~lost)[:, None], initial=0.0) > SETTLED_MM:
            break
        sound = np.abs(np.linalg.det(slope)) > 1e-12
        safe = np.where(sound[:, None, None], slope, np.eye(2))
        step = -np.einsum("nij,nj->ni", inverse_2x2(safe), np.where(sound[:, None], miss, 0.0))
        step = np.clip(step, -0.2, 0.2)
        angles = angles + step
        now = miss_at(angles)
        new, lost = now.miss, now.lost
        square = np.maximum(np.sum(step * step, -1), 1e-300)
        surprise = new - miss - np.einsum("nij,nj->ni", slope, step)
        # Tiny steps consist of rounding errors and would spoil the slope.
        learn = (square > 1e-22)[:, None, None]
        slope = slope + np.where(learn, surprise[:, :, None] * step[:, None, :] / square[:, None, None], 0.0)
        miss = new
    return angles, now


def _window_miss(eye: EyeModel, target_mm: Floats, angles: Floats) -> _Missed:
    """Compute the miss at the fovea (n, 2), point on the cornea, direction to the target, and where no ray exists."""
    poses = Poses.listing(angles[:, 0], angles[:, 1])
    seen = join(into_eye(Turning.of(poses), eye, components(target_mm)))
    centre, lost = entrance_window_centre(eye, seen)
    direction = normalize(centre - seen)
    traced = trace(path_to_retina(eye), 1.0, seen, direction)
    lost = lost | (traced.status != Status.OK)
    first, second = _tangents(split(eye.chief_ray.direction))
    gap = traced.points_mm[-1] - eye.fovea_mm
    miss = np.stack([dot(first, split(gap)), dot(second, split(gap))], axis=-1)
    return _Missed(np.where(lost[:, None], 0.0, miss), traced.points_mm[1], -direction, lost)


def entrance_window_centre(eye: EyeModel, viewpoint_mm: Floats) -> tuple[Floats, Bools]:
    """Compute the centre of the entrance window seen from viewpoints (n, 3), and where it does not exist.

    c = mean(p_i) - t mean(u_i) with exit points p_i and directions u_i, where t makes c come closest to the optic axis.
    Where the mean ray runs along the optic axis, t is not determined. The window is then that of a viewpoint 1e-4 rad
    off the axis on the same side; t changes with the square of that angle, by some 1e-9 mm.
    """
    point, way, lost = _mean_ray(eye, viewpoint_mm)
    length = _to_the_axis(point, way)
    on_axis = np.hypot(way[:, 1], way[:, 2]) < _ON_AXIS_RAD
    on_axis &= np.hypot(point[:, 1], point[:, 2]) < _ON_AXIS_MM
    if on_axis.any():
        side = np.where(np.any(viewpoint_mm[:, 1:], axis=-1, keepdims=True), viewpoint_mm[:, 1:], 1.0)
        reach = 2.0 * _ON_AXIS_RAD * np.linalg.norm(viewpoint_mm, axis=-1, keepdims=True)
        side = reach * side / np.linalg.norm(side, axis=-1, keepdims=True)
        beside, heading, _ = _mean_ray(eye, np.concatenate([viewpoint_mm[:, :1], side], axis=-1))
        length = np.where(on_axis, _to_the_axis(beside, heading), length)
    return point - length[:, None] * way, lost


def _mean_ray(eye: EyeModel, viewpoint_mm: Floats) -> tuple[Floats, Floats, Bools]:
    """Average exit points and directions (n, 3) of the rays from the stop's margin; return where one is missing."""
    margin = eye.stop.boundary(WINDOW_POINTS)
    found = apparent_points(eye.front, eye.front_indices, margin, viewpoint_mm[:, None, :])
    lost = (found.status != Status.OK).any(axis=1)
    return np.mean(found.exit_points_mm, axis=1), np.mean(found.directions, axis=1), lost


def _to_the_axis(point: Floats, way: Floats) -> Floats:
    """Compute the parameter t (n,) at which point - t way comes closest to the x axis."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sum(way[:, 1:] * point[:, 1:], axis=-1) / np.sum(way[:, 1:] ** 2, axis=-1))


def _status(target_mm: Floats, *, azimuth: Floats, elevation: Floats, residual: Floats) -> Statuses:
    status = np.full(residual.shape, int(Status.OK), dtype=np.int8)
    status[~(residual <= RESIDUAL_LIMIT_MM)] = Status.NOT_CONVERGED
    turned = ~((np.abs(azimuth) <= REACH_RAD) & (np.abs(elevation) <= REACH_RAD))
    status[turned] = Status.OUT_OF_REACH
    status[(target_mm[:, 0] < 0.0) & (status == Status.NOT_CONVERGED)] = Status.OUT_OF_REACH
    return status


def _tangents(direction: Xyz) -> tuple[Xyz, Xyz]:
    """Compute two unit vectors orthogonal to a direction that points roughly along +x."""
    x, y, z = direction
    scale = 1.0 / np.sqrt(x * x + y * y)
    e1 = (-y * scale, x * scale, 0.0 * x)
    return e1, (-z * e1[1], z * e1[0], x * e1[1] - y * e1[0])


_ON_AXIS_RAD = 5e-5
_ON_AXIS_MM = 1e-3
"""A mean ray this close to the optic axis, in direction and position, counts as lying on it."""
_NUDGE_RAD = 1e-5
_START_RAD = float(np.radians(85.0))
