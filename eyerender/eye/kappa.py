"""Angle kappa: from the pupillary axis to the line of sight, by tracing.

The pupillary axis is perpendicular to the front cornea and, refracted, passes through the centre of the stop. A coaxial
camera and lamp on this axis see the glint at the centre of the pupil. Instruments report as kappa the angle from this
axis to the line of sight (Le Grand's lambda). Alpha, which eye files hold as `fovea.field_deg`, counts from the optic
axis instead.
"""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats
from ..base.errors import InputError
from ..base.status import Status
from ..optics.solve import ApparentPoints, apparent_points
from ..optics.trace import trace
from ..optics.transforms import inverse_2x2, normalize
from .landmarks import field_direction, fovea_by_nodal_ray, incident_node, path_to_retina
from .model import EyeModel
from .parts import FoveaSpec
from .spec import EyeSpec

_START_MM = 20.0
_STEP_RAD = 1e-4
_STEPS = 8
_SETTLED_MM = 1e-9
_FAR_MM, _NO_INDEX = 1e9, 1e-14


def pupillary_axis(eye: EyeModel) -> tuple[Floats, Floats]:
    """Return where the pupillary axis leaves the cornea (3,), and its outward direction; InputError without one."""
    # Whatever its direction in a medium of index 0, light enters along the normal.
    found = _through_stop(eye, np.array([_FAR_MM, 0.0, 0.0]), _NO_INDEX, "the cornea has no pupillary axis")
    return found.exit_points_mm, np.asarray(eye.front[0].normal(found.exit_points_mm))


def kappa_deg(eye: EyeModel) -> tuple[float, float]:
    """Compute the angles (horizontal, vertical) from the pupillary axis to the line of sight, nasal and up, in degrees.

    >>> np.round(er.eye.kappa_deg(er.load_eye("E4").build()), 2).tolist()
    [5.45, 2.5]

    Raises:
        InputError: the cornea has no pupillary axis.
    """
    _, axis = pupillary_axis(eye)
    horizontal, vertical = np.degrees(angles_of(eye, eye.chief_ray.direction) - angles_of(eye, axis))
    return float(horizontal), float(vertical)


def fovea_of_kappa(eye: EyeModel, wanted_deg: tuple[float, float]) -> Floats:
    """Compute the fovea (3,) mm that gives an eye an angle kappa (horizontal, vertical), nasal and up.

    It is the retinal point on that line of sight; the eye's own fovea is ignored. Raises InputError if the eye has no
    such line of sight.
    """
    reason = "no place of the fovea gives this angle"
    _, axis = pupillary_axis(eye)
    nasal, up = angles_of(eye, axis) + np.radians(wanted_deg)
    way = field_direction(np.array([_handed(eye) * nasal, up]))
    viewpoint = _FAR_MM * way
    for _ in range(2):  # the second ray leaves the cornea along `way`
        found = _through_stop(eye, viewpoint, 1.0, reason)
        viewpoint = found.exit_points_mm + _FAR_MM * way
    outwards, indoors = found.inner_directions, path_to_retina(eye)[len(eye.front) :]
    start = eye.stop.centre_mm + _START_MM * outwards
    traced = trace(indoors, float(eye.front_indices[-1]), start, -outwards)
    if traced.status != Status.OK:
        raise InputError(reason, path="kappa_deg")
    return np.asarray(traced.points_mm[-1])


def with_kappa(spec: EyeSpec, wanted_deg: tuple[float, float], *, wavelength_nm: float = 850.0) -> EyeSpec:
    """Copy an eye file with the fovea moved so that the eye has a given angle kappa (see `kappa_deg`).

    >>> er.eye.with_kappa(er.load_eye("E2"), (5.0, 1.0)).name
    'E2'

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

    The fovea (3,) is that of the eye if None; the object of the nodal ray lies `distance_mm` from the corneal apex.
    Raises InputError if no nodal ray ends there.
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
        field = field - inverse_2x2(slope) @ error
    raise InputError("no nodal ray ends there", path="fovea")


def _through_stop(eye: EyeModel, viewpoint_mm: Floats, n_outside: float, reason: str) -> ApparentPoints:
    """Find the ray from the stop's centre to a viewpoint (3,) in a medium of index `n_outside`, or raise InputError."""
    centre = eye.stop.centre_mm
    found = apparent_points(eye.front, eye.front_indices, centre, viewpoint_mm, n_outside=n_outside)
    if found.status != Status.OK:
        raise InputError(reason, path="stop.position_mm")
    return found


def angles_of(eye: EyeModel, way: Floats) -> Floats:
    """Compute the angles (2,) rad, nasal and up, of a direction from the optic axis: it is along (1, tan h, tan v)."""
    return np.asarray(np.arctan2([_handed(eye) * way[1], way[2]], way[0]))


def _handed(eye: EyeModel) -> float:
    """Return 1 for a right eye, whose +y is nasal, and -1 for a left one."""
    return 1.0 if eye.side == "right" else -1.0
