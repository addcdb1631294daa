"""The two-point problem by shooting: the ray from one point through a path of crossings to another point.

It is solved by Newton's method on the direction at the source, with ray differentials. A unit direction d is varied
along e1, e2 orthogonal to it. Each crossing carries along the differentials dy of the point and dw of the direction
(Igehy 1999, "Tracing ray differentials", eq. 8-19):

    transfer    dt = -N.(dy + t dw) / (N.w),  dy <- dy + t dw + dt w,   dN = (H dy - N (N.H dy)) / |g|
    refraction  w = eta d + f N, f = eta c - c2:  dw = eta dd + df N + f dN,  df = (eta - eta^2 c / c2) dc
    reflection  w = d + 2 c N:                    dw = dd + 2 (dc N + c dN)

with c = -d.N and dc = -(dd.N + d.dN). In the last medium the ray passes the target at y + s w, missing it by r; with
a_i = dy_i + s dw_i the step is d <- d + e1 w.(r x a2)/det + e2 w.(a1 x r)/det, det = w.(a1 x a2). |det| is also the
ratio of the ray tube's cross section at the target to its solid angle at the source (mm^2/sr).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, FloatLike, Floats, Indices, Statuses
from ..base.status import Status, mark
from .fermat_kernels import FAR_MM, RESIDUAL_LIMIT_MM
from .interface import dot, minus, moved, unit
from .surfaces import Xyz
from .trace import BEHIND_MM, Crossing, choose, cross, each, index_of, inside_rim

SETTLED_MM = 1e-12
"""Newton stops at a miss of this plus the effect of one rounding of the direction at the target."""
ROUNDING_RAD = 4e-16

_FAST_STEPS = 8
_GUARDED_STEPS = 60
_RETREATS = 12


class Shot(NamedTuple):
    """Rays shot from a source, one array per coordinate."""

    start: Xyz  # unit direction at the source
    first: Xyz  # the point on the first crossing
    last: Xyz  # the point on the last crossing
    turning: Xyz  # the point of the last reflection; the first point if there is none
    end: Xyz  # unit direction in the last medium
    along: Floats  # distance (mm) from the last crossing to the point of closest approach to the target
    miss: Xyz  # vector from there to the target
    residual_mm: Floats  # its length. For a target more than `FAR_MM` from the last surface it is measured at `FAR_MM`.
    tubes: tuple[Xyz, Xyz]  # a_1 and a_2 of the ray tube (see the module)
    determinant_mm2_sr: Floats  # w . (a_1 x a_2), with its sign.
    status: Statuses  # (...,)


def connect(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, aim: Xyz) -> Shot:
    """Solve for the rays from sources through a path to targets, which broadcast; they are aimed at `aim` first.

    Undamped Newton steps are tried for all rays. The rays that do not converge go through a guarded search, in which
    steps are halved until the miss shrinks. It starts from `aim`, then from points between it and the target. `n_start`
    is the index at the source.
    """
    shape = np.broadcast_shapes(*(p.shape for p in (*source, *target, *aim)))
    source, target = _spread(source, shape), _spread(target, shape)
    aim = _spread(aim, shape)
    shot = _undamped(path, n_start, source, target, aim, _FAST_STEPS)
    settled = (shot.status == Status.OK) & _settled(shot, 100.0)
    if not settled.all():
        shot = _rescue(path, n_start, source, target, aim, shot, ~settled)
    status = shot.status.copy()
    mark(status, ~(shot.residual_mm <= RESIDUAL_LIMIT_MM), Status.NOT_CONVERGED)
    for crossing, point in zip((path[0], path[-1]), (shot.first, shot.last), strict=True):
        if crossing.beyond_rim is not None:
            mark(status, ~inside_rim(crossing, point), crossing.beyond_rim)
    shot = shot._replace(status=status)
    return shot if shape else each(np.squeeze, shot)


def correct(
    path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, aim: Xyz, steps: int = _FAST_STEPS
) -> Shot:
    """Refine rays (m,) whose aim is already close by at most `steps` undamped Newton steps, as `connect` otherwise.

    The rays must meet the surfaces, but rims are not checked.
    """
    shot = _undamped(path, n_start, source, target, aim, steps)
    settled = _settled(shot, 100.0) & (shot.residual_mm <= RESIDUAL_LIMIT_MM)
    mark(shot.status, ~settled, Status.NOT_CONVERGED)
    return shot


def _undamped(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, aim: Xyz, steps: int) -> Shot:
    """Run undamped Newton steps from rays towards `aim`."""
    shot = _shoot(path, n_start, source, unit(minus(aim, source)), target)
    for _ in range(steps):
        if not ((shot.status == Status.OK) & ~_settled(shot, 1.0)).any():
            break
        shot = _shoot(path, n_start, source, _stepped(shot, 1.0), target)
    return shot


class RayTube(NamedTuple):
    """The tube of rays around a traced ray, arrays (...) and components."""

    # cross section at the target per solid angle at the source, |w . (a1 x a2)|. If source and target lie in media of
    # the same index, it is the same in both directions.
    cross_section_mm2_sr: Floats
    end: Xyz  # the ray's unit direction at the target


def ray_tube(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, direction: Xyz, target: Xyz) -> RayTube:
    """Compute the tubes, at `target`, of rays with known unit directions at their sources (see the module)."""
    shape = np.broadcast_shapes(*(p.shape for p in (*source, *direction, *target)))
    shot = _shoot(path, n_start, _spread(source, shape), _spread(direction, shape), _spread(target, shape))
    return RayTube(np.abs(shot.determinant_mm2_sr), shot.end)


def _shoot(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, direction: Xyz, target: Xyz) -> Shot:
    """Trace `direction` with its two differentials to the point of closest approach to `target`.

    Rims are not checked here, because the iteration may move beyond them.
    """
    zero = np.zeros_like(direction[0])
    point, way, index = source, direction, index_of(n_start, zero.ndim)
    moves: tuple[Xyz, ...] = ((zero, zero, zero), (zero, zero, zero))
    turns: tuple[Xyz, ...] = _basis(direction)
    status = np.zeros(zero.shape, dtype=np.int8)
    first: Xyz | None = None
    turning: Xyz | None = None
    for crossing in path:
        step = cross(crossing, point, way, index, moves, turns)
        if crossing.beyond_rim is not None:
            mark(status, ~step.met, Status.MISSED)
        mark(status, step.blocked, Status.TOTAL_REFLECTION)
        point, way, index, moves, turns = step.point, step.way, step.n_after, step.moves, step.turns
        first = point if first is None else first
        turning = point if crossing.reflects or turning is None else turning
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        gap = minus(target, point)
        along = dot(gap, way)
        miss = moved(gap, way, -along)
        a1, a2 = (moved(move, turn, along) for move, turn in zip(moves, turns, strict=True))
        residual = np.sqrt(dot(miss, miss)) * nearness(along)
        determinant = _triple(way, a1, a2)
    mark(status, ~np.isfinite(residual), Status.MISSED)
    # The target must lie ahead in the last medium, else the ray would have to run backwards to it.
    mark(status, along < -BEHIND_MM, Status.MISSED)
    return Shot(
        direction, first or point, point, turning or point, way, along, miss, residual, (a1, a2), determinant, status
    )


def _stepped(shot: Shot, fraction: Floats | float) -> Xyz:
    """Compute the next direction: Newton's, or a fraction of the way to it."""
    a1, a2 = shot.tubes
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = fraction / shot.determinant_mm2_sr
        first = _triple(shot.end, shot.miss, a2) * scale
        second = _triple(shot.end, a1, shot.miss) * scale
    # Rays that have a singular tube or failed keep their direction.
    usable = np.isfinite(first) & np.isfinite(second)
    first, second = np.where(usable, first, 0.0), np.where(usable, second, 0.0)
    e1, e2 = _basis(shot.start)
    return unit(moved(moved(shot.start, e1, first), e2, second))


def _rescue(
    path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, aim: Xyz, shot: Shot, left: Bools
) -> Shot:
    """Run the guarded search for rays that did not converge; the remaining ones are returned unchanged."""
    index = np.nonzero(left)
    frame = index[0]
    path = [taken(crossing, frame) for crossing in path]
    n_start = n_start if np.ndim(n_start) == 0 else np.asarray(n_start)[frame]
    source, target, aim, start = (each(lambda a: a[index], value) for value in (source, target, aim, shot.start))
    best = _shoot(path, n_start, source, start, target)
    done = np.zeros(frame.shape, dtype=bool)
    # For an aim at the target itself, all blends are the same.
    for blend in (0.0,) if all(map(np.array_equal, aim, target)) else (0.0, 0.5, -0.5, 1.0):
        aimed = moved(aim, minus(target, aim), np.full(frame.shape, blend))
        trial = _shoot(path, n_start, source, unit(minus(aimed, source)), target)
        trial = _guarded(path, n_start, source, target, trial, done)
        best = choose(~done & _better(trial, best), trial, best)
        done = (best.status == Status.OK) & _settled(best, 100.0)
        if done.all():
            break

    def put(old: Floats, new: Floats) -> Floats:
        out = np.array(old)
        out[index] = new
        return out

    return each(put, shot, best)


def _guarded(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, shot: Shot, done: Bools) -> Shot:
    """Run Newton's method with steps that are halved until the miss shrinks."""
    for _ in range(_GUARDED_STEPS):
        active = ~done & (shot.status == Status.OK) & ~_settled(shot, 1.0)
        if not active.any():
            break
        fraction = np.ones(active.shape)
        gone = np.zeros(active.shape, dtype=bool)
        for _ in range(_RETREATS):
            way = _stepped(shot, np.where(active & ~gone, fraction, 0.0))
            trial = _shoot(path, n_start, source, way, target)
            accept = active & ~gone & (trial.status == Status.OK) & (trial.residual_mm < shot.residual_mm)
            shot = choose(accept, trial, shot)
            gone |= accept
            if (gone | ~active).all():
                break
            fraction = fraction * 0.5
        if not gone.any():
            break
    return shot


def _settled(shot: Shot, slack: float) -> Bools:
    """Return whether the miss is at most `slack` times the smallest miss that Newton's method can reach."""
    reach = SETTLED_MM + ROUNDING_RAD * np.sqrt(np.abs(shot.determinant_mm2_sr)) * nearness(shot.along)
    return np.asarray(shot.residual_mm <= slack * reach)


def _better(trial: Shot, best: Shot) -> Bools:
    ok, held = trial.status == Status.OK, best.status == Status.OK
    return np.asarray((ok & ~held) | ((ok == held) & (trial.residual_mm < best.residual_mm)))


def nearness(along_mm: Floats) -> Floats:
    """Compute the factor for a miss at `along_mm` behind the last surface: FAR_MM / along_mm, at most 1."""
    return np.asarray(FAR_MM / np.maximum(along_mm, FAR_MM))


def taken(crossing: Crossing, frame: Indices) -> Crossing:
    """Select the per-eye parameters of a crossing for single rays."""
    n_after, rim = crossing.n_after, crossing.rim_mm
    return Crossing(
        surface=crossing.surface.take(frame),
        n_after=n_after if np.ndim(n_after) == 0 else np.asarray(n_after)[frame],
        inward=crossing.inward,
        reflects=crossing.reflects,
        rim_mm=rim if np.ndim(rim) == 0 else np.asarray(rim)[frame],
        beyond_rim=crossing.beyond_rim,
        through=None if crossing.through is None else crossing.through.take(frame),
    )


def _spread(point: Xyz, shape: tuple[int, ...]) -> Xyz:
    # There must be at least one axis, so that rays can be picked out of the batch.
    full = shape or (1,)
    return np.broadcast_to(point[0], full), np.broadcast_to(point[1], full), np.broadcast_to(point[2], full)


def _basis(direction: Xyz) -> tuple[Xyz, Xyz]:
    """Compute two unit vectors orthogonal to a unit direction and to each other (Duff et al. 2017, listing 3)."""
    x, y, z = direction
    # The formula is singular at -z. It is rotated here so that -sign(x) x is the pole.
    sign = np.copysign(1.0, x)
    a = -1.0 / (sign + x)
    b = y * z * a
    return ((-sign * y, 1.0 + sign * y * y * a, sign * b), (-z, b, sign + z * z * a))


def _triple(a: Xyz, b: Xyz, c: Xyz) -> Floats:
    """Compute the triple product a.(b x c)."""
    return np.asarray(
        a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
