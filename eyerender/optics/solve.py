"""Apparent points (refraction), mirror points (reflection) and Purkinje images: rays that join two points.

Most rays are solved by Newton's method on the optical length (`fermat_kernels`). Every path is then traced from the
viewpoint through the surfaces; the residual is the distance by which the traced ray misses the other point. If it
exceeds rounding, the path is searched again by shooting with ray differentials and guarded steps (`shooting`), which
also handles surfaces without a common graph. A refracted ray that is still missing is searched from the object's side,
because at grazing angles Newton's method from a straight line may miss an existing ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Bools, FloatLike, Floats, Statuses
from ..base.status import Status
from .fermat_kernels import LOST, connect_all
from .graphs import graphs_of
from .sheets import Graphs
from .shooting import Shot, connect, taken
from .surfaces import Surface, Xyz, components, fit, join, shift, turn, turn_back
from .trace import Crossing, each, outward_path, trace


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ApparentPoints(ArrayValue):
    """Points at which rays from object points to a viewpoint leave the outermost surface."""

    exit_points_mm: Floats  # (..., 3) points on the outermost surface
    directions: Floats  # (..., 3) unit vectors from the exit point to the viewpoint
    inner_directions: Floats  # (..., 3) unit vectors from the object to the innermost surface
    residual_mm: Floats  # (...,) miss distance of the traced ray
    status: Statuses  # (...,)


class Rays(NamedTuple):
    """Rays from a viewpoint to a point through surfaces, one array per coordinate."""

    exit: Xyz  # the point on the outermost surface
    way: Xyz  # unit direction from the viewpoint to it
    end: Xyz  # unit direction in the last medium
    met: Xyz  # the point on the surface with a rim; NaN behind lenses where the ray was found by shooting
    arriving: Xyz  # unit direction before it; NaN like `met`
    residual_mm: Floats  # miss distance of the traced ray
    status: Statuses  # (...,)


def apparent_points(
    surfaces: Sequence[Surface],  # outside in
    indices: Sequence[FloatLike],  # the index behind each surface
    object_points_mm: npt.ArrayLike,  # (..., 3) points behind the surfaces
    viewpoint_mm: npt.ArrayLike,  # (..., 3) viewpoints; they broadcast against the object points
    *,
    rim_mm: FloatLike = np.inf,  # rim radius of the outermost surface (the limbus)
    n_outside: float = 1.0,  # index outside the eye
) -> ApparentPoints:
    """Compute where rays from object points to a viewpoint leave the outermost surface (refraction)."""
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
    return joined_rays(refracting_path(surfaces, indices, rim_mm), n_outside, viewpoint, target)


def refracting_path(
    surfaces: Sequence[Surface], indices: Sequence[FloatLike], rim_mm: FloatLike = np.inf
) -> tuple[Crossing, ...]:
    """Return the refractions at surfaces, outside in, of which the outermost one ends at the limbus."""
    return tuple(
        Crossing(surface=surface, n_after=index, rim_mm=rim_mm if k == 0 else np.inf, beyond_rim=Status.OUTSIDE_LIMBUS)
        for k, (surface, index) in enumerate(zip(surfaces, indices, strict=True))
    )


def mirroring(surface: Surface, rim_mm: FloatLike = np.inf) -> Crossing:
    """Return the reflection at the cornea, which ends at the limbus."""
    return Crossing(surface=surface, n_after=1.0, reflects=True, rim_mm=rim_mm, beyond_rim=Status.OUTSIDE_LIMBUS)


def mirrored_rays(surface: Surface, source: Xyz, viewpoint: Xyz, *, rim_mm: FloatLike = np.inf) -> Rays:
    """Compute where a surface reflects a source to a viewpoint outside: the first Purkinje image.

    Sources and viewpoints broadcast. The surface ends at the radius `rim_mm` (the limbus). The residual is measured at
    1000 mm if the source is farther away.
    """
    return joined_rays((mirroring(surface, rim_mm),), 1.0, viewpoint, source)


def joined_rays(
    path: Sequence[Crossing],  # the crossings, in order from the viewpoint. One of them may reflect: `rimmed`
    n_outside: float,  # index at the viewpoint
    viewpoint: Xyz,  # components of the viewpoints
    target: Xyz,  # components of the targets; both broadcast
    # number of the crossing whose rim counts, the outermost one of the eye. Surfaces in front of it (lenses of
    # spectacles) have none here
    rimmed: int = 0,
    *,
    # (..., s, 3, 3) elliptical outlines of lenses: centre, and both axes over their lengths, 0 for surfaces without
    # one. Rays of the compiled solver that pass outside have the status AT_LENS_EDGE; others, whose `met` is NaN, are
    # not checked
    outlines: Floats | None = None,
    starts: Xyz | None = None,  # points on the mirror from which rays are searched
    thorough: bool = True,  # whether to search for rays that the compiled solver does not find
) -> Rays:
    """Solve for the rays from viewpoints through a path to targets, refracted or reflected by one of its surfaces."""
    edge, graphs = path[rimmed], graphs_of(*(crossing.surface for crossing in path))
    if graphs is None:
        ndim = max(viewpoint[0].ndim, target[0].ndim)
        aim = each(lambda axis: np.asarray(fit(axis, ndim)), components(apex_of(edge.surface)))
        rays = _from_connection(connect(path, n_outside, viewpoint, target, aim if edge.reflects else target))
    else:
        media = (n_outside, *(crossing.n_after for crossing in path))
        ladder = np.stack(np.broadcast_arrays(*(np.atleast_1d(n) for n in media)), axis=-1)
        rays, found, guess = _joined(graphs, ladder, edge, rimmed, viewpoint, target, outlines, starts)
        if thorough and not found.all():
            aim = guess if edge.reflects else target
            rays = _searched(path, n_outside, viewpoint, target, aim, rays, ~found)
    return rays if edge.reflects or not thorough else _launched(path, n_outside, viewpoint, target, rays)


def _joined(
    graphs: Graphs,
    ladder: Floats,
    edge: Crossing,
    rimmed: int,
    viewpoint: Xyz,
    target: Xyz,
    outlines: Floats | None,
    starts: Xyz | None,
) -> tuple[Rays, Bools, Xyz]:
    """Run the compiled solver; return its rays, which of them converged, and the first guesses of mirror points."""
    ends = (viewpoint, target) if starts is None else (viewpoint, target, starts)
    shape = np.broadcast_shapes(*(axis.shape for point in ends for axis in point))
    full = shape or (1,)
    held = np.zeros((1, 0, 9)) if outlines is None else _in_frame(graphs, outlines)
    if not graphs.plain:
        viewpoint, target, *rest = (turn_back(graphs.rotation, shift(p, graphs.origin_mm, -1.0)) for p in ends)
        starts = rest[0] if rest else None
    state = np.full((full[0], int(np.prod(full[1:], dtype=np.intp))), LOST, dtype=np.int8)
    found, residual = np.empty((4 if outlines is None else 6, 3, *state.shape)), np.empty(state.shape)
    if starts is not None:
        found[0] = _rows(starts, full)
    met, arriving = found[4:] if len(found) > 4 else np.empty((2, 3, 0, 0))
    rims = np.array(np.atleast_1d(edge.rim_mm), dtype=np.float64)
    kinds, sheets, table = graphs.kinds, graphs.sheets, graphs.table
    connect_all(
        kinds, sheets, table, ladder, rims, _rows(viewpoint, full), _rows(target, full), held, edge.reflects,
        rimmed + 1, starts is not None, found[0], found[1], found[2], found[3], met, arriving, residual, state,
    )  # fmt: skip
    guess, exits, way, end, *more = ((x, y, z) for x, y, z in found.reshape(-1, 3, *shape))
    if not graphs.plain:
        exits, guess = (shift(turn(graphs.rotation, p), graphs.origin_mm, 1.0) for p in (exits, guess))
        way, end = turn(graphs.rotation, way), turn(graphs.rotation, end)
        if more:
            more = [shift(turn(graphs.rotation, more[0]), graphs.origin_mm, 1.0), turn(graphs.rotation, more[1])]
    place, before = more or (exits, way)
    status = state.reshape(shape)
    return Rays(exits, way, end, place, before, residual.reshape(shape), status), status != LOST, guess


def _in_frame(graphs: Graphs, outlines: Floats) -> Floats:
    """Express outlines (..., s, 3, 3) in the frame of graphs, as rows (1 or n, s, 9) for the compiled solver."""
    moved = np.array(outlines, dtype=np.float64)
    if not graphs.plain:
        moved[..., 0, :] -= graphs.origin_mm[..., None, :]
        moved = moved @ graphs.rotation[..., None, :, :]
    return np.ascontiguousarray(moved.reshape(-1, moved.shape[-3], 9))


def _rows(point: Xyz, full: tuple[int, ...]) -> Floats:
    """Arrange components that broadcast to (n, ...) as points (3, 1 or n, 1 or m), m the size of the further axes."""
    own = np.broadcast_shapes(*(axis.shape for axis in point))
    own = (1,) * (len(full) - len(own)) + own
    if any(size != 1 for size in own[1:]):
        own = (own[0], *full[1:])
    out = np.empty((3, *own))
    for row, axis in zip(out, point, strict=True):
        row[...] = axis
    return out.reshape(3, own[0], -1)


def _launched(path: Sequence[Crossing], n_outside: float, viewpoint: Xyz, target: Xyz, rays: Rays) -> Rays:
    """Search from the object's side for refracted rays that are still missing.

    A cone of rays is traced from the object. The rays that leave closest to the viewpoint's direction are the starts of
    searches.
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
    """Return unit directions (count, 3) spread evenly about +x, up to `reach_rad` from it."""
    step = np.arange(count) + 0.5
    angle, turn = reach_rad * np.sqrt(step / count), np.pi * (1.0 + np.sqrt(5.0)) * step
    return np.column_stack([np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)])


_CONE = _cone(256, 1.45)
_TRIED = 3
_LAUNCHED_AT_ONCE = 200


def _searched(
    path: Sequence[Crossing], n_start: FloatLike, viewpoint: Xyz, target: Xyz, aim: Xyz, rays: Rays, left: Bools
) -> Rays:
    """Solve for the rays at `left` by shooting, and keep the other ones."""
    shape = left.shape or (1,)
    rows = np.nonzero(left.reshape(shape))
    few = [taken(crossing, rows[0]) for crossing in path]
    start = n_start if np.ndim(n_start) == 0 else np.asarray(n_start)[rows[0]]
    ends = each(lambda axis: np.broadcast_to(axis, shape)[rows], (viewpoint, target, aim))
    found = _from_connection(connect(few, start, *ends))

    def put(whole: Floats, part: Floats) -> Floats:
        out = np.array(np.broadcast_to(whole, shape))
        out[rows] = part
        return out.reshape(left.shape)

    return each(put, rays, found)


def _from_connection(found: Shot) -> Rays:
    unknown = (np.full(found.status.shape, np.nan),) * 3
    return Rays(found.first, found.start, found.end, unknown, unknown, found.residual_mm, found.status)


def apex_of(surface: Surface) -> Floats:
    """Return the point of the sheet on its local axis, (..., 3) mm."""
    zero = np.zeros(surface.batch_shape)
    return surface.to_eye(np.stack([surface.sag(zero, zero), zero, zero], axis=-1))
