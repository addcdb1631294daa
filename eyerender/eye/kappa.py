"""Angle kappa: from the pupillary axis to the line of sight, by tracing.

The pupillary axis is perpendicular to the front cornea and, refracted, passes through the centre of the stop. A coaxial
camera and lamp on this axis see the glint at the centre of the pupil. Instruments report as kappa the angle from this
axis to the line of sight (Le Grand's lambda). Alpha, which eye files hold as `fovea.field_deg`, counts from the optic
axis instead.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..geometry.transforms import normalize
from ..optics.trace import outward_path, trace
from ..status import Status
from .landmarks import field_direction, fovea_by_nodal_ray, incident_node, path_to_retina
from .model import EyeModel
from .parts import FoveaSpec
from .spec import EyeSpec

_START_MM = 20.0
_STEP_RAD = 1e-4
_STEPS = 8
_SETTLED_MM, _SETTLED_RAD = 1e-9, 1e-13
_ASIDE = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def pupillary_axis(eye: EyeModel) -> tuple[Floats, Floats]:
    """Return the point (3,) where the pupillary axis leaves the cornea, and its outward unit direction (3,).

    Raises:
        InputError: the cornea has no such axis.
    """
    return _through_stop(eye, lambda point: np.asarray(eye.front[0].normal(point)), "the cornea has no pupillary axis")


def kappa_deg(eye: EyeModel) -> tuple[float, float]:
    """Compute the angles (horizontal, vertical) from the pupillary axis to the line of sight, nasal and up, in degrees.

    Raises:
        InputError: the cornea has no pupillary axis.
    """
    _, axis = pupillary_axis(eye)
    horizontal, vertical = np.degrees(angles_of(eye, eye.chief_ray.direction) - angles_of(eye, axis))
    return float(horizontal), float(vertical)


def fovea_of_kappa(eye: EyeModel, wanted_deg: tuple[float, float]) -> Floats:
    """Compute the fovea (3,) mm that gives an eye an angle kappa: the retinal point on that line of sight.

    Args:
        eye: the eye; its own fovea is ignored.
        wanted_deg: kappa (horizontal, vertical), nasal and up.

    Raises:
        InputError: the eye has no such line of sight.
    """
    reason = "no place of the fovea gives this angle"
    _, axis = pupillary_axis(eye)
    nasal, up = angles_of(eye, axis) + np.radians(wanted_deg)
    way = field_direction(np.array([_handed(eye) * nasal, up]))
    point, _ = _through_stop(eye, lambda _: way, reason)
    traced = trace(path_to_retina(eye), 1.0, point + _START_MM * way, -way)
    if traced.status != Status.OK:
        raise InputError(reason, path="kappa_deg")
    return np.asarray(traced.points_mm[-1])


def with_kappa(spec: EyeSpec, wanted_deg: tuple[float, float], *, wavelength_nm: float = 850.0) -> EyeSpec:
    """Copy an eye file with the fovea moved so that the eye has a given angle kappa (see `kappa_deg`).

    Args:
        spec: the eye.
        wanted_deg: kappa (horizontal, vertical), nasal and up.
        wavelength_nm: wavelength of the traced rays.

    Raises:
        InputError: no position of the fovea gives this angle.
    """
    eye = spec.build(wavelength_nm=wavelength_nm)
    alpha = alpha_deg(eye, fovea_of_kappa(eye, wanted_deg), distance_mm=spec.fovea.distance_mm)
    fovea = FoveaSpec(field_deg=alpha, distance_mm=spec.fovea.distance_mm)
    return spec.replaced("kappa_deg", {"fovea": fovea.to_mapping()})


def alpha_deg(eye: EyeModel, fovea_mm: Floats | None = None, *, distance_mm: float = 1500.0) -> tuple[float, float]:
    """Compute angles (horizontal, vertical) from the optic axis to the nodal ray of the fovea, nasal and up, degrees.

    Args:
        eye: the eye.
        fovea_mm: (3,) position of the fovea; default: that of the eye.
        distance_mm: distance of the nodal ray's object from the corneal apex.

    Raises:
        InputError: no nodal ray ends there.
    """
    wanted = eye.fovea_mm if fovea_mm is None else fovea_mm

    def miss(field: Floats) -> Floats:
        return (fovea_by_nodal_ray(eye, incident_node(eye), field, distance_mm) - wanted)[1:]

    # A nodal ray has the same direction on both sides, so it starts near that of the fovea from the node.
    field = angles_of(eye, normalize(incident_node(eye) - wanted)) * [_handed(eye), 1.0]
    for _ in range(_STEPS):
        error = miss(field)
        if np.abs(error).max() < _SETTLED_MM:
            horizontal, vertical = np.degrees(field)
            return float(_handed(eye) * horizontal), float(vertical)
        slope = np.column_stack([(miss(field + _STEP_RAD * unit) - error) / _STEP_RAD for unit in np.eye(2)])
        field = field - np.linalg.solve(slope, error)
    raise InputError("no nodal ray ends there", path="fovea")


def _through_stop(eye: EyeModel, way: Callable[[Floats], Floats], reason: str) -> tuple[Floats, Floats]:
    """Find the ray from the centre of the stop that leaves the cornea in a wanted direction, by Newton's method.

    Args:
        eye: the eye.
        way: returns the wanted unit directions (3,) or (k, 3) of rays that leave the cornea at points (k, 3).
        reason: message of the error.

    Returns:
        The point (3,) where the ray leaves the cornea, and its direction (3,) there.

    Raises:
        InputError: there is no such ray.
    """
    path = outward_path(eye.front, eye.front_indices)
    start = np.broadcast_to(eye.stop.centre_mm, (3, 3))
    inside = np.array([1.0, 0.0, 0.0])
    for _ in range(_STEPS):
        traced = trace(path, float(eye.front_indices[-1]), start, normalize(inside + _STEP_RAD * _ASIDE))
        if not (traced.status == Status.OK).all():
            break
        error = (traced.directions[-1] - way(traced.points_mm[-1]))[:, 1:]
        if np.abs(error[0]).max() < _SETTLED_RAD:
            return traced.points_mm[-1, 0], traced.directions[-1, 0]
        slope = (error[1:] - error[0]).T / _STEP_RAD
        inside = normalize(inside - [0.0, *np.linalg.solve(slope, error[0])])
    raise InputError(reason, path="stop.position_mm")


def angles_of(eye: EyeModel, way: Floats) -> Floats:
    """Compute the angles (2,) rad, nasal and up, of a direction from the optic axis: it is along (1, tan h, tan v)."""
    return np.asarray(np.arctan2([_handed(eye) * way[1], way[2]], way[0]))


def _handed(eye: EyeModel) -> float:
    """Return 1 for a right eye, whose +y is nasal, and -1 for a left one."""
    return 1.0 if eye.side == "right" else -1.0
