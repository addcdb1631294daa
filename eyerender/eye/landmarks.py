"""Landmarks of the eye, found by ray tracing: incident node, fovea, and chief ray to the fovea."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..base.arrays import Floats, remembered, sealed
from ..base.errors import InputError
from ..base.status import Status
from ..optics.gradient import GradientMedium
from ..optics.shooting import connect
from ..optics.surfaces import components, join
from ..optics.trace import Crossing, Traced, outward_path, trace
from ..optics.transforms import flip_y, normalize, read_only
from .model import EyeModel, LineOfSight

NODE_RING_DEG = 14.3
"""Field angle of the ring of nodal rays whose waist is the node (Harris 2010, example 3)."""
NODE_RAYS = 16
NODE_DISTANCE_MM = 1500.0


def path_to_retina(eye: EyeModel) -> tuple[Crossing, ...]:
    """Return all surfaces on the path from air to the retina, where the light ends without refraction."""
    last = eye.back_indices[-1] if eye.back else eye.front_indices[-1]
    lens = zip(eye.back, eye.back_indices, eye.back_rims_mm, eye.back_passing, _through(eye, 1), strict=True)
    return (
        *(Crossing(surface=s, n_after=n) for s, n in zip(eye.front, eye.front_indices, strict=True)),
        *(
            Crossing(surface=s, n_after=n, rim_mm=rim, beyond_rim=None if passing else Status.MISSED, through=through)
            for s, n, rim, passing, through in lens
        ),
        Crossing(surface=eye.retina, n_after=last),
    )


def _through(eye: EyeModel, last: int) -> list[GradientMedium | None]:
    """Return the medium in front of each lens surface on a path that leaves a gradient lens at its surface `last`."""
    return [eye.lens_gradient if k == last else None for k in range(len(eye.back))]


def nodal_rays(eye: EyeModel, objects_mm: Floats, guess_mm: Floats) -> tuple[Floats, Floats]:
    """Compute nodal rays from objects: they reach the retina parallel to their direction in air.

    Args:
        eye: the eye.
        objects_mm: (m, 3) objects.
        guess_mm: starting point of the search.

    Returns:
        Directions (m, 3) and retina points (m, 3).

    Raises:
        InputError: an object has no such ray.
    """
    path = path_to_retina(eye)
    direction, error, retina = _parallel_rays(path, objects_mm, normalize(guess_mm - objects_mm))
    for k in np.flatnonzero(~(error < _PARALLEL)):
        row = slice(k, k + 1)
        # The ray meets the edge of a shell, where the index jumps. Solve it with the shells that it meets next to the
        # edge.
        met = crossed(path, trace(path, 1.0, objects_mm[row], direction[row]))
        direction[row], error[row], retina[row] = _parallel_rays(met, objects_mm[row], direction[row])
    if not (error < _PARALLEL).all():
        raise InputError("no nodal ray meets the retina", path="fovea")
    return direction, retina


def _parallel_rays(path: Sequence[Crossing], objects_mm: Floats, direction: Floats) -> tuple[Floats, Floats, Floats]:
    """Solve for nodal rays by Newton's method: directions, |change of direction|, and retina points."""
    for _ in range(30):
        first, second = _tangents(direction)
        bundle = np.stack([direction, direction + _STEP * first, direction + _STEP * second])
        traced = trace(path, 1.0, np.broadcast_to(objects_mm, bundle.shape), normalize(bundle))
        turn = traced.directions[-1] - traced.directions[0]
        error = np.stack([np.sum(turn * first, -1), np.sum(turn * second, -1)], axis=-1)
        ok = (traced.status == Status.OK).all(axis=0)
        size = np.where(ok, np.linalg.norm(error[0], axis=-1), np.inf)
        retina = traced.points_mm[-1, 0]
        slope = np.stack([(error[1] - error[0]) / _STEP, (error[2] - error[0]) / _STEP], axis=-1)
        singular = ~ok | ~(np.abs(np.linalg.det(slope)) > 1e-12)
        slope = np.where(singular[:, None, None], np.eye(2), slope)
        step = np.linalg.solve(slope, np.where(singular[:, None], 0.0, error[0])[..., None])[..., 0]
        if np.max(np.abs(step)) < 1e-16:
            break
        direction = normalize(direction - step[..., :1] * first - step[..., 1:] * second)
    return direction, size, retina


def crossed(path: Sequence[Crossing], traced: Traced) -> tuple[Crossing, ...]:
    """Return the surfaces that one traced ray (leading shape (1,)) met, without their rims."""
    moved = np.linalg.norm(np.diff(traced.points_mm[:, 0], axis=0), axis=-1) > 0.0
    return tuple(replace(c, rim_mm=np.inf, beyond_rim=Status.MISSED) for c, met in zip(path, moved, strict=True) if met)


@remembered
def incident_node(eye: EyeModel) -> Floats:
    """Compute the incident node (3,): the waist of a ring of nodal rays.

    The ring has 16 nodal rays from (h, v) = 14.3 deg (sin f, cos f), from objects 1500 mm from the apex. The node is
    the mean of the points of closest approach of all pairs. It lies on the optic axis where the eye is centred about
    it, and off the axis where surfaces are tilted or decentred. (Harris 2010, "Nodes and nodal points and lines in eyes
    and other optical systems", Ophthalmic Physiol. Opt. 30, 24-42: an aspheric or tilted eye has no nodal point, but a
    waist.)

    That of a left eye is the mirror image of the right eye's.
    """
    if eye.side == "left":
        return sealed(flip_y(incident_node(eye.mirrored())))
    angle = 2.0 * np.pi * np.arange(NODE_RAYS) / NODE_RAYS
    ring = np.radians(NODE_RING_DEG) * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    objects = NODE_DISTANCE_MM * field_direction(ring)
    directions, _ = nodal_rays(eye, objects, np.array([-7.0, 0.0, 0.0]))
    i, j = np.triu_indices(NODE_RAYS, 1)
    gap = objects[i] - objects[j]
    cosine = np.sum(directions[i] * directions[j], -1)
    along_i, along_j = np.sum(directions[i] * gap, -1), np.sum(directions[j] * gap, -1)
    square = 1.0 - cosine**2
    s, t = (cosine * along_j - along_i) / square, (along_j - cosine * along_i) / square
    middle = 0.5 * (objects[i] + s[:, None] * directions[i] + objects[j] + t[:, None] * directions[j])
    return sealed(np.mean(middle, axis=0))


def fovea_by_nodal_ray(eye: EyeModel, node_mm: Floats, field_rad: Floats, distance_mm: float) -> Floats:
    """Compute the fovea (3,): where the nodal ray from the field direction (h nasal, v up) meets the retina.

    The object lies in the direction (1, tan h, tan v) from the incident node, `distance_mm` from the corneal apex.
    """
    direction = field_direction(field_rad)
    along = float(node_mm @ direction)
    reach = -along + np.sqrt(along**2 - float(node_mm @ node_mm) + distance_mm**2)
    _, retina = nodal_rays(eye, (node_mm + reach * direction)[None], node_mm)
    return np.asarray(retina[0])


def chief_ray_in_air(eye: EyeModel, fovea_mm: Floats) -> LineOfSight:
    """Compute the ray in air from the fovea through the stop's centre.

    This ray is fixed in the eye, so fixation by chief ray only has to turn it onto the target.

    Raises:
        InputError: there is no such ray.
    """
    centre = eye.stop.centre_mm
    if eye.back:
        path = [
            Crossing(
                surface=surface,
                n_after=n,
                inward=False,
                rim_mm=rim,
                beyond_rim=None if passing else Status.MISSED,
                through=through,
            )
            for surface, n, rim, passing, through in zip(
                reversed(eye.back),
                reversed([eye.front_indices[-1], *eye.back_indices[:-1]]),
                reversed(eye.back_rims_mm),
                reversed(eye.back_passing),
                reversed(_through(eye, 0)),
                strict=True,
            )
        ]
        start, target = components(fovea_mm[None]), components(centre[None])
        found = connect(path, eye.back_indices[-1], start, target, target)
        if found.status[0] == Status.NOT_CONVERGED and any(eye.back_passing):
            met = crossed(path, trace(path, eye.back_indices[-1], fovea_mm[None], join(found.start)))
            found = connect(met, eye.back_indices[-1], start, target, target)
        if found.status[0] != Status.OK:
            raise InputError("no ray joins the fovea and the centre of the stop", path="fovea")
        direction = join(found.end)[0]
    else:
        direction = normalize(centre - fovea_mm)
    traced = trace(outward_path(eye.front, eye.front_indices), eye.front_indices[-1], centre, direction)
    if traced.status != Status.OK:
        raise InputError("the chief ray does not leave the eye", path="fovea")
    return LineOfSight(read_only(traced.points_mm[-1]), read_only(traced.directions[-1]))


def field_direction(field_rad: Floats) -> Floats:
    """Compute unit vectors (..., 3) along (1, tan h, tan v) from field angles (h, v) (..., 2) in radians."""
    field = np.asarray(field_rad, dtype=np.float64)
    return normalize(np.stack([np.ones(field.shape[:-1]), np.tan(field[..., 0]), np.tan(field[..., 1])], axis=-1))


def _tangents(direction: Floats) -> tuple[Floats, Floats]:
    first = normalize(np.cross(direction, np.array([0.0, 0.0, 1.0])))
    return first, np.cross(direction, first)


_STEP = 1e-5
_PARALLEL = 1e-13
