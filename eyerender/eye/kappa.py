"""Angle kappa: from the pupillary axis to the line of sight, by tracing.

The pupillary axis meets the front cornea at a right angle and leads, refracted on, through the centre of the stop: a
camera with a lamp at its nodal point sees the glint at the centre of the pupil from there. What instruments call kappa
is the direction of the line of sight from that axis (Le Grand called it lambda). Alpha, which eye files hold as
`fovea.field_deg`, counts from the optic axis instead.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import root

from ..arrays import Floats
from ..errors import InputError
from ..optics.trace import inward_path, trace
from ..status import Status
from .model import EyeModel
from .parts import FoveaSpec
from .spec import EyeSpec

_START_MM = 20.0
_STEPS = 12
_SETTLED_DEG = 1e-9


def pupillary_axis(eye: EyeModel) -> tuple[Floats, Floats]:
    """The point (3,) where the pupillary axis leaves the cornea, and its outward unit direction (3,).

    Raises:
        InputError: the cornea has no such axis.
    """
    front, stop = eye.front[0], eye.stop
    path = inward_path(eye.front, eye.front_indices)

    def ray(place: Floats) -> tuple[Floats, Floats]:
        point = front.to_eye(np.array([float(front.sag(*place)), *place]))
        return point, front.normal(point)

    def miss(place: Floats) -> Floats:
        point, normal = ray(place)
        traced = trace(path, 1.0, point + _START_MM * normal, -normal)
        if traced.status != Status.OK:
            return np.full(2, 1e3)
        end, way = traced.points_mm[-1], traced.directions[-1]
        gap = end + way * (((stop.centre_mm - end) @ stop.normal) / (way @ stop.normal)) - stop.centre_mm
        return np.asarray(stop.rotation[:, 1:].T @ gap)

    found = root(miss, np.array(stop.centre_mm[1:]), tol=1e-14)
    if not np.linalg.norm(miss(found.x)) < 1e-9:
        raise InputError("the cornea has no pupillary axis", path="stop.position_mm")
    return ray(found.x)


def kappa_deg(eye: EyeModel) -> tuple[float, float]:
    """Angles (horizontal, vertical) of the line of sight from the pupillary axis, nasal and up, in degrees.

    Raises:
        InputError: the cornea has no pupillary axis.
    """
    _, axis = pupillary_axis(eye)
    nasal = 1.0 if eye.side == "right" else -1.0

    def angles(way: Floats) -> Floats:
        return np.degrees([nasal * np.arctan2(way[1], way[0]), np.arctan2(way[2], way[0])])

    horizontal, vertical = angles(eye.chief_ray.direction) - angles(axis)
    return float(horizontal), float(vertical)


def with_kappa(spec: EyeSpec, wanted_deg: tuple[float, float], *, wavelength_nm: float = 850.0) -> EyeSpec:
    """Copy of an eye whose fovea lies so that the eye has the angle kappa (see `kappa_deg`).

    Args:
        spec: the eye.
        wanted_deg: kappa (horizontal, vertical), nasal and up.
        wavelength_nm: wavelength at which it is traced.

    Raises:
        InputError: no place of the fovea gives this angle.
    """
    field = np.array(spec.fovea.field_deg, dtype=np.float64)
    for _ in range(_STEPS):
        turned = spec.replaced("kappa_deg", {"fovea": _fovea(spec, field)})
        error = np.array(wanted_deg) - kappa_deg(turned.build(wavelength_nm=wavelength_nm))
        if np.abs(error).max() < _SETTLED_DEG:
            return turned
        # Alpha and kappa change by nearly the same angle.
        field = field + error
    raise InputError("no place of the fovea gives this angle", path="kappa_deg")


def _fovea(spec: EyeSpec, field_deg: Floats) -> dict[str, object]:
    return FoveaSpec(
        field_deg=(float(field_deg[0]), float(field_deg[1])), distance_mm=spec.fovea.distance_mm
    ).to_mapping()
