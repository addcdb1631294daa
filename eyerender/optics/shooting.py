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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..base.arrays import Bools, FloatLike, Floats, Indices, Statuses
from ..base.status import Status, mark
from .fermat_kernels import FAR_MM, RESIDUAL_LIMIT_MM
from .interface import dot, minus, moved, unit
from .surfaces import Xyz, fit
from .trace import BEHIND_MM, Crossing, inside_rim

SETTLED_MM = 1e-12
"""Newton stops at a miss of this plus the effect of one rounding of the direction at the target."""
ROUNDING_RAD = 4e-16

_Nested = TypeVar("_Nested")
_FAST_STEPS = 8
_GUARDED_STEPS = 60
_RETREATS = 12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Connection:
    """The connecting rays, one array per coordinate.

    Attributes:
        start: unit direction at the source.
        first: the point on the first crossing.
        last: the point on the last crossing.
        turning: the point of the last reflection; the first point if there is none.
        end: unit direction in the last medium.
        residual_mm: miss distance of the traced ray at the target. For a target more than `FAR_MM` from the last
            surface it is measured at `FAR_MM`.
        status: (...,).
    """

    start: Xyz
    first: Xyz
    last: Xyz
    turning: Xyz
    end: Xyz
    residual_mm: Floats
    status: Statuses


class Corrected(NamedTuple):
    """Rays of `correct`, named as in `Connection`; determinant_mm2_sr keeps its sign."""

    start: Xyz
    first: Xyz
    last: Xyz
    turning: Xyz
    residual_mm: Floats
    determinant_mm2_sr: Floats
    status: Statuses


class _Shot(NamedTuple):
    first: Xyz
    last: Xyz
    turning: Xyz
    end: Xyz
    along: Floats
    miss: Xyz
    residual_mm: Floats
    tubes: tuple[Xyz, Xyz]
    determinant: Floats
    status: Statuses


def connect(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, aim: Xyz) -> Connection:
    """Solve for the rays from a source through a path to a target.

    Undamped Newton steps are tried for all rays. The rays that do not converge go through a guarded search, in which
    steps are halved until the miss shrinks. It starts from `aim`, then from points between it and the target.

    Args:
        path: the crossings, in order.
        n_start: index of the medium at the source.
        source: start points of the rays.
        target: end points of the rays; source and target broadcast.
        aim: points at which the rays are aimed first.
    """
    shape = np.broadcast_shapes(*(p.shape for p in (*source, *target, *aim)))
    source, target = _spread(source, shape), _spread(target, shape)
    direction, shot = _undamped(path, n_start, source, target, _spread(aim, shape), _FAST_STEPS)
    settled = (shot.status == Status.OK) & _settled(shot, 100.0)
    if not settled.all():
        direction, shot = _rescue(
            path,
            n_start,
            source=source,
            target=target,
            aim=_spread(aim, shape),
            direction=direction,
            shot=shot,
            left=~settled,
        )
    status = shot.status.copy()
    mark(status, ~(shot.residual_mm <= RESIDUAL_LIMIT_MM), Status.NOT_CONVERGED)
    for crossing, point in zip((path[0], path[-1]), (shot.first, shot.last), strict=True):
        if crossing.beyond_rim is not None:
            mark(status, ~inside_rim(crossing, point), crossing.beyond_rim)
    found: dict[str, Any] = {
        "start": direction, "first": shot.first, "last": shot.last, "turning": shot.turning, "end": shot.end,
        "residual_mm": shot.residual_mm, "status": status,
    }  # fmt: skip
    return Connection(**(found if shape else {name: _each(np.squeeze, value) for name, value in found.items()}))


def correct(
    path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, aim: Xyz, steps: int = _FAST_STEPS
) -> Corrected:
    """Refine rays (m,) whose aim is already close, without the guarded search.

    The rays must meet the surfaces, but rims are not checked.

    Args:
        path: the crossings, in order.
        n_start: index of the medium at the source.
        source: (m,) start points of the rays.
        target: (m,) end points of the rays.
        aim: (m,) points at which they are aimed first.
        steps: largest number of undamped Newton steps.
    """
    direction, shot = _undamped(path, n_start, source, target, aim, steps)
    settled = _settled(shot, 100.0) & (shot.residual_mm <= RESIDUAL_LIMIT_MM)
    mark(shot.status, ~settled, Status.NOT_CONVERGED)
    return Corrected(direction, shot.first, shot.last, shot.turning, shot.residual_mm, shot.determinant, shot.status)


def _undamped(
    path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, aim: Xyz, steps: int
) -> tuple[Xyz, _Shot]:
    """Run undamped Newton steps from rays towards `aim`; return the directions at the source, and the rays."""
    direction = unit(minus(aim, source))
    shot = _shoot(path, n_start, source, direction, target)
    for _ in range(steps):
        if not ((shot.status == Status.OK) & ~_settled(shot, 1.0)).any():
            break
        direction = _stepped(direction, shot, 1.0)
        shot = _shoot(path, n_start, source, direction, target)
    return direction, shot


class RayTube(NamedTuple):
    """The tube of rays around a traced ray, arrays (...) and components.

    Attributes:
        cross_section_mm2_sr: cross section at the target per solid angle at the source, |w . (a1 x a2)|. If source and
            target lie in media of the same index, it is the same in both directions.
        end: the ray's unit direction at the target.
    """

    cross_section_mm2_sr: Floats
    end: Xyz


def ray_tube(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, direction: Xyz, target: Xyz) -> RayTube:
    """Compute the tube of rays around a known ray (see the module).

    Args:
        path: the crossings, in order.
        n_start: index of the medium at the source.
        source: start points of the rays.
        direction: unit directions of the rays at the source.
        target: points that the rays pass.
    """
    shape = np.broadcast_shapes(*(p.shape for p in (*source, *direction, *target)))
    shot = _shoot(path, n_start, _spread(source, shape), _spread(direction, shape), _spread(target, shape))
    return RayTube(np.abs(shot.determinant), shot.end)


def _shoot(path: Sequence[Crossing], n_start: FloatLike, source: Xyz, direction: Xyz, target: Xyz) -> _Shot:
    """Trace `direction` with its two differentials to the point of closest approach to `target`.

    Rims are not checked here, because the iteration may move beyond them.
    """
    point, way = source, direction
    basis = _basis(direction)
    zero = np.zeros_like(way[0])
    moves: list[Xyz] = [(zero, zero, zero), (zero, zero, zero)]
    turns: list[Xyz] = [basis[0], basis[1]]
    status = np.zeros(way[0].shape, dtype=np.int8)
    index: FloatLike = n_start if isinstance(n_start, float) else fit(np.asarray(n_start), way[0].ndim)
    first: Xyz | None = None
    turning: Xyz | None = None
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for crossing in path:
            if crossing.through is None:
                lead = -dot(point, way)
                near = moved(point, way, lead)
                hit = crossing.surface.hit(near, way, crossing.inward)
                step = hit.distance + lead
                met = hit.ok & (step > -BEHIND_MM)
            else:
                passage = crossing.through.cross(crossing.surface, crossing.inward, point, way, moves, turns)
                hit, way, moves, turns = passage.hit, passage.way, passage.moves, passage.turns
                step, met = hit.distance, hit.ok
            skip: Bools | None = None
            if crossing.beyond_rim is None:
                skip = ~(met & inside_rim(crossing, hit.point))
            else:
                mark(status, ~met, Status.MISSED)
            scale = 1.0 / np.sqrt(dot(hit.gradient, hit.gradient))
            normal = (hit.gradient[0] * scale, hit.gradient[1] * scale, hit.gradient[2] * scale)
            cosine = -dot(way, normal)
            if crossing.reflects:
                eta: FloatLike = 1.0
                factor, slope = 2.0 * cosine, 2.0 + zero
                after = index
            else:
                n_after = crossing.n_after
                after = n_after if isinstance(n_after, float) else fit(np.asarray(n_after), way[0].ndim)
                eta = index / after
                square = 1.0 - eta * eta * (1.0 - cosine * cosine)
                blocked = ~(square > 0.0)
                mark(status, blocked if skip is None else blocked & ~skip, Status.TOTAL_REFLECTION)
                root = np.copysign(np.sqrt(np.maximum(square, 0.0)), cosine)
                factor = eta * cosine - root
                slope = eta - eta * eta * cosine / root
            new_way = (
                eta * way[0] + factor * normal[0],
                eta * way[1] + factor * normal[1],
                eta * way[2] + factor * normal[2],
            )
            hessian = crossing.surface.hessian_at(hit.point)
            for k in (0, 1):
                move = moved(moves[k], turns[k], step)
                move = moved(move, way, dot(normal, move) / cosine)
                bend = hessian.times(move)
                bend = moved(bend, normal, -dot(normal, bend))
                tilt = (bend[0] * scale, bend[1] * scale, bend[2] * scale)
                change = slope * -(dot(turns[k], normal) + dot(way, tilt))
                turned = (
                    eta * turns[k][0] + change * normal[0] + factor * tilt[0],
                    eta * turns[k][1] + change * normal[1] + factor * tilt[1],
                    eta * turns[k][2] + change * normal[2] + factor * tilt[2],
                )
                moves[k] = move if skip is None else _choose(skip, moves[k], move)
                turns[k] = turned if skip is None else _choose(skip, turns[k], turned)
            if skip is None:
                point, way, index = hit.point, new_way, after
            else:
                point, way = _choose(skip, point, hit.point), _choose(skip, way, new_way)
                index = np.where(skip, index, after)
            first = point if first is None else first
            turning = point if crossing.reflects or turning is None else turning
        gap = minus(target, point)
        along = dot(gap, way)
        miss = moved(gap, way, -along)
        a1, a2 = moved(moves[0], turns[0], along), moved(moves[1], turns[1], along)
        residual = np.sqrt(dot(miss, miss)) * nearness(along)
        determinant = _triple(way, a1, a2)
    mark(status, ~np.isfinite(residual), Status.MISSED)
    # The target must lie ahead in the last medium, else the ray would have to run backwards to it.
    mark(status, along < -BEHIND_MM, Status.MISSED)
    return _Shot(
        first=first or point,
        last=point,
        turning=turning or point,
        end=way,
        along=along,
        miss=miss,
        residual_mm=residual,
        tubes=(a1, a2),
        determinant=determinant,
        status=status,
    )


def _stepped(direction: Xyz, shot: _Shot, fraction: Floats | float) -> Xyz:
    """Compute the next direction: Newton's, or a fraction of the way to it."""
    a1, a2 = shot.tubes
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = fraction / shot.determinant
        first = _triple(shot.end, shot.miss, a2) * scale
        second = _triple(shot.end, a1, shot.miss) * scale
    # Rays that have a singular tube or failed keep their direction.
    usable = np.isfinite(first) & np.isfinite(second)
    first, second = np.where(usable, first, 0.0), np.where(usable, second, 0.0)
    e1, e2 = _basis(direction)
    return unit(moved(moved(direction, e1, first), e2, second))


def _rescue(
    path: Sequence[Crossing],
    n_start: FloatLike,
    *,
    source: Xyz,
    target: Xyz,
    aim: Xyz,
    direction: Xyz,
    shot: _Shot,
    left: Bools,
) -> tuple[Xyz, _Shot]:
    """Run the guarded search for rays that did not converge; the remaining ones are returned unchanged."""
    index = np.nonzero(left)
    frame = index[0] if left.ndim else np.zeros(1, dtype=np.intp)
    few_path = [taken(crossing, frame) for crossing in path]
    few_start = n_start if isinstance(n_start, float) or np.ndim(n_start) == 0 else np.asarray(n_start)[frame]
    few_source, few_target, few_aim = _pick(source, index), _pick(target, index), _pick(aim, index)
    best_way = _pick(direction, index)
    best = _shoot(few_path, few_start, few_source, best_way, few_target)
    done = np.zeros(frame.shape, dtype=bool)
    # For an aim at the target itself, all blends are the same.
    for blend in (0.0,) if all(map(np.array_equal, few_aim, few_target)) else (0.0, 0.5, -0.5, 1.0):
        aimed = moved(few_aim, minus(few_target, few_aim), np.full(frame.shape, blend))
        way = unit(minus(aimed, few_source))
        trial = _shoot(few_path, few_start, few_source, way, few_target)
        way, trial = _guarded(few_path, few_start, few_source, few_target, way, trial, done)
        better = ~done & _better(trial, best)
        best_way, best = _choose(~better, best_way, way), _choose(~better, best, trial)
        done = (best.status == Status.OK) & _settled(best, 100.0)
        if done.all():
            break
    return _put(direction, best_way, index), _put(shot, best, index)


def _guarded(
    path: Sequence[Crossing], n_start: FloatLike, source: Xyz, target: Xyz, way: Xyz, shot: _Shot, done: Bools
) -> tuple[Xyz, _Shot]:
    """Run Newton's method with steps that are halved until the miss shrinks."""
    for _ in range(_GUARDED_STEPS):
        active = ~done & (shot.status == Status.OK) & ~_settled(shot, 1.0)
        if not active.any():
            break
        fraction = np.ones(active.shape)
        gone = np.zeros(active.shape, dtype=bool)
        for _ in range(_RETREATS):
            trial_way = _stepped(way, shot, np.where(active & ~gone, fraction, 0.0))
            trial = _shoot(path, n_start, source, trial_way, target)
            accept = active & ~gone & (trial.status == Status.OK) & (trial.residual_mm < shot.residual_mm)
            way, shot = _choose(~accept, way, trial_way), _choose(~accept, shot, trial)
            gone |= accept
            if (gone | ~active).all():
                break
            fraction = fraction * 0.5
        if not gone.any():
            break
    return way, shot


def _settled(shot: _Shot, slack: float) -> Bools:
    """Return whether the miss is at most `slack` times the smallest miss that Newton's method can reach."""
    reach = SETTLED_MM + ROUNDING_RAD * np.sqrt(np.abs(shot.determinant)) * nearness(shot.along)
    return np.asarray(shot.residual_mm <= slack * reach)


def _better(trial: _Shot, best: _Shot) -> Bools:
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


def _each(function: Callable[..., Any], *values: _Nested) -> _Nested:
    """Apply a function to each array of nested tuples with the same structure."""
    first: Any = values[0]
    if not isinstance(first, tuple):
        return function(*values)  # type: ignore[no-any-return]
    parts = [_each(function, *some) for some in zip(*values, strict=True)]
    return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)  # type: ignore[return-value]


def _put(old: _Nested, new: _Nested, index: tuple[Indices, ...]) -> _Nested:
    """Return a copy of the old values with new ones at an index."""

    def put(old: Floats, new: Floats) -> Floats:
        out = np.array(old)
        out[index] = new
        return out

    return _each(put, old, new)


def _pick(point: Xyz, index: tuple[Indices, ...]) -> Xyz:
    return _each(lambda values: values[index], point)


def _choose(old_where: Bools, old: _Nested, new: _Nested) -> _Nested:
    return _each(partial(np.where, old_where), old, new)


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
