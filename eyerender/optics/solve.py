"""Apparent points (refraction), mirror points (reflection) and Purkinje images: the rays that join two points.

Most rays are found by Newton on the optical length (`fermat`) from a paraxial start. Every path is then traced from the
viewpoint through the surfaces; the distance by which the traced ray misses the other point is the residual. A path that
misses by more than rounding is searched again by shooting with ray differentials and guarded steps (`shooting`), which
also handles surfaces that have no common graph. A refracted ray that is still not found is searched from the object's
side: at grazing angles, Newton from a straight line's guess may miss a ray that exists.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import ArrayValue, Bools, FloatLike, Floats, Statuses
from ..geometry.graphs import Graph, graphs_of
from ..geometry.surfaces import Surface, Xyz, components, fit, join, shift, turn, turn_back
from ..status import Status, mark
from .fermat import stationary_path
from .interface import dot, minus, moved, unit
from .shooting import RESIDUAL_LIMIT_MM, Connection, connect, nearness, taken
from .trace import Crossing, cross, inside_rim, outward_path, trace

SURE_MM = 1e-11
"""A path that its traced ray confirms to this is taken as found; rounding stays well below."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ApparentPoints(ArrayValue):
    """Where the rays from object points to a viewpoint leave the outermost surface.

    Attributes:
        exit_points_mm: (..., 3) points on the outermost surface.
        directions: (..., 3) unit vectors from the exit point to the viewpoint.
        inner_directions: (..., 3) unit vectors from the object to the innermost surface.
        residual_mm: (...,) by how much the traced ray misses.
        status: (...,).
    """

    exit_points_mm: Floats
    directions: Floats
    inner_directions: Floats
    residual_mm: Floats
    status: Statuses


@dataclass(frozen=True, slots=True, eq=False)
class MirrorPoints(ArrayValue):
    """Where light from a source is reflected to a viewpoint.

    Attributes:
        points_mm: (..., 3) points on the surface.
        directions: (..., 3) unit vectors from there to the viewpoint.
        residual_mm: (...,) by how much the traced ray misses the source, 1e-9 at most. It is measured at 1000 mm where
            the source is farther away.
        status: (...,).
    """

    points_mm: Floats
    directions: Floats
    residual_mm: Floats
    status: Statuses


class Rays(NamedTuple):
    """Rays from a viewpoint to a point through surfaces, one array per coordinate.

    Attributes:
        exit: the point on the outermost surface.
        way: unit direction from the viewpoint to it.
        end: unit direction in the last medium.
        residual_mm: by how much the traced ray misses.
        status: (...,).
    """

    exit: Xyz
    way: Xyz
    end: Xyz
    residual_mm: Floats
    status: Statuses


def apparent_points(
    surfaces: Sequence[Surface],
    indices: Sequence[FloatLike],
    object_points_mm: npt.ArrayLike,
    viewpoint_mm: npt.ArrayLike,
    *,
    rim_mm: FloatLike = np.inf,
    n_outside: float = 1.0,
) -> ApparentPoints:
    """Refraction of object points to a viewpoint.

    Args:
        surfaces: outside in.
        indices: the index behind each surface.
        object_points_mm: (..., 3) points behind the surfaces.
        viewpoint_mm: (..., 3) viewpoints; they broadcast against the object points.
        rim_mm: rim radius of the outermost surface (the limbus).
        n_outside: index outside the eye.
    """
    rays = refracted_rays(
        surfaces, indices, components(object_points_mm), components(viewpoint_mm), rim_mm=rim_mm, n_outside=n_outside
    )
    return ApparentPoints(
        exit_points_mm=join(rays.exit),
        directions=-join(rays.way),
        inner_directions=-join(rays.end),
        residual_mm=rays.residual_mm,
        status=rays.status,
    )


def mirror_points(
    surface: Surface, source_mm: npt.ArrayLike, viewpoint_mm: npt.ArrayLike, *, rim_mm: FloatLike = np.inf
) -> MirrorPoints:
    """Reflection of a source to a viewpoint at the outside of a surface: the first Purkinje image.

    Args:
        surface: the mirror.
        source_mm: (..., 3) sources.
        viewpoint_mm: (..., 3) viewpoints; they broadcast against the sources.
        rim_mm: rim radius of the surface (the limbus).
    """
    rays = mirrored_rays(surface, components(source_mm), components(viewpoint_mm), rim_mm=rim_mm)
    return MirrorPoints(join(rays.exit), -join(rays.way), rays.residual_mm, rays.status)


def refracted_rays(
    surfaces: Sequence[Surface],
    indices: Sequence[FloatLike],
    target: Xyz,
    viewpoint: Xyz,
    *,
    rim_mm: FloatLike = np.inf,
    n_outside: float = 1.0,
) -> Rays:
    """Compute `apparent_points` on components."""
    path = [
        Crossing(surface, index, rim_mm=rim_mm if k == 0 else np.inf, beyond_rim=Status.OUTSIDE_LIMBUS)
        for k, (surface, index) in enumerate(zip(surfaces, indices, strict=True))
    ]
    ndim = max(target[0].ndim, viewpoint[0].ndim)
    frame = graphs_of(surfaces, ndim)
    if frame is None:
        return _launched(
            path, n_outside, viewpoint, target, _from_connection(connect(path, n_outside, viewpoint, target, target))
        )
    graphs, origin, rotation = frame
    plain = not np.any(origin) and np.array_equal(rotation, np.broadcast_to(np.eye(3), rotation.shape))
    inner = target if plain else turn_back(rotation, shift(target, origin, -1.0))
    outer = viewpoint if plain else turn_back(rotation, shift(viewpoint, origin, -1.0))
    ladder = [n_outside, *(fit(n, ndim) for n in indices)]
    points = stationary_path(graphs, ladder, outer, inner, _paraxial_start(graphs, ladder, outer, inner)).points
    first = points[0] if plain else shift(turn(rotation, points[0]), origin, 1.0)
    return _launched(
        path,
        n_outside,
        viewpoint,
        target,
        _confirmed(path, n_outside, viewpoint=viewpoint, target=target, first=first, aim=target),
    )


def mirrored_rays(surface: Surface, source: Xyz, viewpoint: Xyz, *, rim_mm: FloatLike = np.inf) -> Rays:
    """Compute `mirror_points` on components."""
    path = (Crossing(surface, 1.0, reflects=True, rim_mm=rim_mm, beyond_rim=Status.OUTSIDE_LIMBUS),)
    guess = mirror_start(surface, source, viewpoint)
    frame = graphs_of([surface], guess[0].ndim)
    if frame is None:
        return _from_connection(connect(path, 1.0, viewpoint, source, guess))
    graphs, origin, rotation = frame
    outer, other, start = (turn_back(rotation, shift(p, origin, -1.0)) for p in (viewpoint, source, guess))
    points = stationary_path(graphs, [1.0, 1.0], outer, other, [(start[1], start[2])]).points
    hopeless = _far_beyond(path[0], guess)
    return _confirmed(
        path,
        1.0,
        viewpoint=viewpoint,
        target=source,
        first=shift(turn(rotation, points[0]), origin, 1.0),
        aim=guess,
        hopeless=hopeless,
    )


def _far_beyond(crossing: Crossing, guess: Xyz) -> Bools:
    """Whether the first guess of a mirror point is so far outside the rim that the point cannot be on the surface."""
    surface, rim, ndim = crossing.surface, crossing.rim_mm, guess[0].ndim
    if isinstance(rim, float) and rim == np.inf:
        return np.zeros(guess[0].shape, dtype=bool)
    gradient = surface.gradient_at(guess)
    facing = sum(fit(surface.rotation[..., i, 0], ndim) * gradient[i] for i in range(3))
    limit = rim if isinstance(rim, float) else fit(np.asarray(rim), ndim)
    return np.asarray((facing <= 0.0) | (surface.axis_distance(guess) > 1.25 * limit))


def _confirmed(
    path: Sequence[Crossing],
    n_start: FloatLike,
    *,
    viewpoint: Xyz,
    target: Xyz,
    first: Xyz,
    aim: Xyz,
    hopeless: Bools | None = None,
) -> Rays:
    """Trace from the viewpoint over the points `first` of the first surface, and search again what misses the target.

    `hopeless` rays are not searched: if they meet the surface at all, they meet it beyond its rim.
    """
    with np.errstate(all="ignore"):
        way = unit(minus(first, viewpoint))
        gradient = path[0].surface.gradient_at(first)
        found = np.asarray(dot(gradient, way) < 0.0)
        index, end, passes = cross(path[0], gradient, way, n_start)
        found &= passes
        point = first
        for crossing in path[1:]:
            hit = crossing.surface.hit(point, end, crossing.inward)
            index, end, passes = cross(crossing, hit.gradient, end, index)
            found &= hit.ok & passes
            point = hit.point
        gap = minus(target, point)
        along = dot(gap, end)
        miss = moved(gap, end, -along)
        residual = np.sqrt(dot(miss, miss))
        reach: FloatLike = SURE_MM
        if path[0].reflects:
            residual = residual * nearness(along)
            # A distant source magnifies Newton's remaining error of the mirror point.
            reach = np.minimum(SURE_MM + 1e-15 * along * along, RESIDUAL_LIMIT_MM)
        found &= (residual <= reach) & (along > 0.0)
    status = np.zeros(residual.shape, dtype=np.int8)
    if hopeless is not None:
        status[hopeless & ~found] = path[0].beyond_rim or Status.MISSED
        found |= hopeless
    mark(status, ~inside_rim(path[0], first), path[0].beyond_rim or Status.MISSED)
    rays = Rays(first, way, end, residual, status)
    return rays if found.all() else _searched(path, n_start, viewpoint, target, aim, rays, ~found)


def _launched(path: Sequence[Crossing], n_outside: float, viewpoint: Xyz, target: Xyz, rays: Rays) -> Rays:
    """Search from the object for the refracted rays that were not found.

    A cone of rays is launched from the object. Those that leave closest to the viewpoint's direction each start a
    search.
    """
    lost = (rays.status != Status.OK) & (rays.status != Status.OUTSIDE_LIMBUS)
    if not lost.any():
        return rays
    shape = lost.shape or (1,)
    rows = np.nonzero(lost.reshape(shape))
    places, ends = (np.broadcast_to(join(point), (*shape, 3))[rows] for point in (viewpoint, target))
    aims, found = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
    for start in range(0, len(ends), _LAUNCHED_AT_ONCE):
        part = slice(start, start + _LAUNCHED_AT_ONCE)
        few = [taken(crossing, rows[0][part]) for crossing in path]
        indices = [crossing.n_after for crossing in few]
        outward = outward_path([crossing.surface for crossing in few], indices, n_outside)
        out = trace(outward, indices[-1], ends[part, None, :], _CONE[None])
        gap = places[part, None, :] - out.points_mm[-1]
        with np.errstate(all="ignore"):
            cosine = np.sum(gap * out.directions[-1], axis=-1) / np.linalg.norm(gap, axis=-1)
        order = np.argsort(np.where(out.status == Status.OK, -cosine, 2.0), axis=1)
        index = tuple(axis[part] for axis in rows)
        for best in order[:, :_TRIED].T:
            aim = ends[part] + _CONE[best]
            shot = connect(outward, indices[-1], components(ends[part]), components(places[part]), components(aim))
            good = ~found[index] & (shot.status == Status.OK)
            aims[index] = np.where(good[:, None], join(shot.last), aims[index])
            found[index] |= good
            if found[index].all():
                break
    if not found.any():
        return rays
    seen_at = components(aims.reshape(*lost.shape, 3))
    return _searched(path, n_outside, viewpoint, target, seen_at, rays, found.reshape(lost.shape))


def _cone(count: int, reach_rad: float) -> Floats:
    """Unit directions (count, 3) spread evenly about +x, up to `reach_rad` from it."""
    step = np.arange(count) + 0.5
    angle, turn = reach_rad * np.sqrt(step / count), np.pi * (1.0 + np.sqrt(5.0)) * step
    return np.column_stack([np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)])


_CONE = _cone(256, 1.45)
_TRIED = 3
_LAUNCHED_AT_ONCE = 200


def _searched(
    path: Sequence[Crossing], n_start: FloatLike, viewpoint: Xyz, target: Xyz, aim: Xyz, rays: Rays, left: Bools
) -> Rays:
    """Find the rays at `left` by shooting, and keep the others."""
    rows = np.nonzero(left) if left.ndim else (np.zeros(1, dtype=np.intp),)
    shape = left.shape or (1,)

    def pick(point: Xyz) -> Xyz:
        x, y, z = (np.broadcast_to(axis, shape)[rows] for axis in point)
        return x, y, z

    few = [taken(crossing, rows[0]) for crossing in path]
    start = n_start if np.ndim(n_start) == 0 else np.asarray(n_start)[rows[0]]
    found = _from_connection(connect(few, start, pick(viewpoint), pick(target), pick(aim)))

    def put(whole: Floats, part: Floats) -> Floats:
        out = np.array(np.broadcast_to(whole, shape))
        out[rows] = part
        return out.reshape(left.shape)

    def put_all(whole: Xyz, part: Xyz) -> Xyz:
        return put(whole[0], part[0]), put(whole[1], part[1]), put(whole[2], part[2])

    return Rays(
        put_all(rays.exit, found.exit),
        put_all(rays.way, found.way),
        put_all(rays.end, found.end),
        put(rays.residual_mm, found.residual_mm),
        np.asarray(put(rays.status, found.status), dtype=np.int8),  # type: ignore[arg-type]
    )


def _from_connection(found: Connection) -> Rays:
    return Rays(found.first, found.start, found.end, found.residual_mm, found.status)


def _paraxial_start(
    graphs: Sequence[Graph], ladder: Sequence[FloatLike], viewpoint: Xyz, target: Xyz
) -> list[tuple[Floats, Floats]]:
    """First guesses (y, z) on each surface, outside in.

    On the outermost surface the guess is the straight line's point, moved by m = 1 / (1 - d (n - 1) / (n R)) away from
    the line through the viewpoint and the centre of curvature, which is not refracted; d is the object's depth, n its
    index. On the other surfaces it is on the straight line from there to the object.
    """
    zero = np.zeros((1,) * target[0].ndim)
    with np.errstate(all="ignore"):
        apex = graphs[0].jet(zero, zero)
        radius = -1.0 / apex.yy
        centre = apex.x - radius
        n = ladder[-1] / ladder[0]
        bend = (n - 1.0) / (n * radius)
        above = 1.0 / (viewpoint[0] - centre)
        beyond = 1.0 / (viewpoint[0] - target[0])
        y, z = target[1], target[2]
        for _ in range(2):
            height = graphs[0].height(y, z)
            height = np.where(np.isfinite(height), height, apex.x)
            depth = height - target[0]
            draw = 1.0 / (1.0 - depth * bend)
            share = depth * beyond
            # y = (1 - draw) y_line + draw (y_t + share (y_v - y_t)), gathered.
            far = (1.0 - draw) * (height - centre) * above + draw * share
            near = draw - draw * share
            y, z = far * viewpoint[1] + near * target[1], far * viewpoint[2] + near * target[2]
        out = [(y, z)]
        for graph in graphs[1:]:
            inner = graph.height(y, z)
            part = (height - np.where(np.isfinite(inner), inner, height)) / depth
            out.append((y + part * (target[1] - y), z + part * (target[2] - z)))
    return out


def mirror_start(surface: Surface, source: Xyz, viewpoint: Xyz) -> Xyz:
    """First guess of a mirror point: where the bisector through the apex' centre of curvature meets the surface.

    It is exact on a sphere for source and viewpoint at infinity.
    """
    ndim = max(source[0].ndim, viewpoint[0].ndim)
    shape = np.broadcast_shapes(source[0].shape, viewpoint[0].shape)
    apex = components(apex_of(surface))
    gradient, hessian = surface.gradient_at(apex), surface.hessian_at(apex)
    size = np.sqrt(dot(gradient, gradient))
    normal = (gradient[0] / size, gradient[1] / size, gradient[2] / size)
    trace = np.asarray(hessian.xx) + np.asarray(hessian.yy) + np.asarray(hessian.zz)
    radius = 2.0 * size / (trace - dot(normal, hessian.times(normal)))
    centre = join((apex[0] - radius * normal[0], apex[1] - radius * normal[1], apex[2] - radius * normal[2]))
    to_source, to_viewpoint = unit(shift(source, centre, -1.0)), unit(shift(viewpoint, centre, -1.0))
    bisector = (to_source[0] + to_viewpoint[0], to_source[1] + to_viewpoint[1], to_source[2] + to_viewpoint[2])
    reach = fit(np.asarray(radius), ndim) / np.sqrt(np.maximum(dot(bisector, bisector), 1e-300))
    x, y, z = shift((reach * bisector[0], reach * bisector[1], reach * bisector[2]), centre, 1.0)
    return np.broadcast_to(x, shape), np.broadcast_to(y, shape), np.broadcast_to(z, shape)


def apex_of(surface: Surface) -> Floats:
    """Point of the sheet on its local axis, (..., 3)."""
    zero = np.zeros(surface.batch_shape)
    return surface.to_eye(np.stack([surface.sag(zero, zero), zero, zero], axis=-1))
