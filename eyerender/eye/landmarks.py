"""Landmarks of the eye, found by ray tracing: incident node, fovea, and chief ray to the fovea.

A ray that meets the cornea at the small height h with the small slope u reaches the retina at A h + B u + c. Light of
the vergence K (a power matrix, 1/mm) has u = -K h, so it comes to a focus where A = B K. Spectacles of power F at the
distance d leave K = F / (1 - d F), hence F = K (1 + d K)^-1.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats, frozen, remembered
from ..base.errors import InputError
from ..base.status import Status
from ..optics.gradient import GradientMedium
from ..optics.nodal import crossed, parallel_rays
from ..optics.shooting import connect
from ..optics.surfaces import components, join
from ..optics.trace import Crossing, outward_path, trace
from ..optics.transforms import flip_y, inverse_2x2, normalize
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
    """Compute nodal rays from objects (m, 3): they reach the retina parallel to their direction in air.

    The search starts at `guess_mm`. Returns directions (m, 3) and retina points (m, 3). Raises InputError if an object
    has no such ray.
    """
    found = parallel_rays(path_to_retina(eye), objects_mm, guess_mm)
    if found is None:
        raise InputError("no nodal ray meets the retina", path="fovea")
    return found


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
    right = eye if eye.side == "right" else eye.mirrored()
    angle = 2.0 * np.pi * np.arange(NODE_RAYS) / NODE_RAYS
    ring = np.radians(NODE_RING_DEG) * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    objects = NODE_DISTANCE_MM * field_direction(ring)
    directions, _ = nodal_rays(right, objects, np.array([-7.0, 0.0, 0.0]))
    i, j = np.triu_indices(NODE_RAYS, 1)
    gap = objects[i] - objects[j]
    cosine = np.sum(directions[i] * directions[j], -1)
    along_i, along_j = np.sum(directions[i] * gap, -1), np.sum(directions[j] * gap, -1)
    square = 1.0 - cosine**2
    s, t = (cosine * along_j - along_i) / square, (along_j - cosine * along_i) / square
    middle = 0.5 * (objects[i] + s[:, None] * directions[i] + objects[j] + t[:, None] * directions[j])
    node = np.mean(middle, axis=0)
    return frozen(node if right is eye else flip_y(node))


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

    This ray is fixed in the eye, so fixation by chief ray only has to turn it onto the target. Raises InputError if
    there is no such ray.
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
    return LineOfSight(frozen(traced.points_mm[-1]), frozen(traced.directions[-1]))


def field_direction(field_rad: Floats) -> Floats:
    """Compute unit vectors (..., 3) along (1, tan h, tan v) from field angles (h, v) (..., 2) in radians."""
    field = np.asarray(field_rad, dtype=np.float64)
    return normalize(np.stack([np.ones(field.shape[:-1]), np.tan(field[..., 0]), np.tan(field[..., 1])], axis=-1))


VERTEX_MM = 12.0
_HEIGHT_MM = 2e-3
_SLOPE = 1e-4


def at_cornea_d(spectacles_d: float, vertex_mm: float = VERTEX_MM) -> float:
    """Convert a spectacle power (D) to the refraction at the cornea (D): F / (1 - d F)."""
    return spectacles_d / (1.0 - vertex_mm * spectacles_d / 1000.0)


def refraction_d(eye: EyeModel, *, vertex_mm: float = VERTEX_MM) -> tuple[float, float, float]:
    """Compute the spectacle refraction (D) about the optic axis as a power vector: sphere equivalent M, J0, J45.

    The refraction in the meridian f, from nasal towards up, is M + J0 cos 2f + J45 sin 2f (Thibos, Wheeler and Horner
    1997, Optom. Vis. Sci. 74, 367-375). Derivatives are central differences over 0.002 mm and 0.0001 rad. `eye`: a
    single eye; `vertex_mm`: distance of the spectacles from the cornea. Raises InputError if a ray near the axis does
    not reach the retina.
    """
    path = path_to_retina(eye)
    steps = np.array([[_HEIGHT_MM, 0, 0, 0], [0, _HEIGHT_MM, 0, 0], [0, 0, _SLOPE, 0], [0, 0, 0, _SLOPE]])
    rays = np.concatenate([steps, -steps])
    origin = np.column_stack([np.full(8, 1.0), rays[:, :2] - rays[:, 2:] * 1.0])
    way = normalize(np.column_stack([np.full(8, -1.0), rays[:, 2:]]))
    traced = trace(path, 1.0, origin, way)
    if (traced.status != Status.OK).any():
        raise InputError("a ray near the axis does not reach the retina", path="retina")
    retina = traced.points_mm[-1, :, 1:]
    change = (retina[:4] - retina[4:]).T
    a, b = change[:, :2] / (2 * _HEIGHT_MM), change[:, 2:] / (2 * _SLOPE)
    vergence = inverse_2x2(b) @ a
    power = 1000.0 * vergence @ inverse_2x2(np.eye(2) + vertex_mm * vergence)
    mean, first = (power[0, 0] + power[1, 1]) / 2, (power[0, 0] - power[1, 1]) / 2
    return float(mean), float(first), float((power[0, 1] + power[1, 0]) / 2)
