"""Response of eyes to light and accommodation, for published models and own eye files.

The lens responds as that of a drawn person (Navarro 2014): curvatures, thickness and asphericity change per dioptre,
starting from those of the file, and iris and front of the lens move forward. The pupil gets the size of Watson and
Yellott's formula, or keeps its own, minus the near miosis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq

from ..base.errors import InputError
from ..eye.entrance import entrance_pupil_mm, stop_for_entrance
from ..eye.parts import EyeParts
from ..eye.spec import EyeSpec
from ..eye.surfaces import index_at, stop_of, surface_of
from ..optics.surfaces import Surface
from .eyes import BACK_PER_D, FORWARD, FRONT_PER_D, FRONT_Q_PER_D, amplitude_d, thickening_mm
from .pupil import watson_yellott_mm
from .table import default_table

REFERENCE_AGE = 28.58
"""Reference age of Watson and Yellott's formula."""
_ROOT_GAP_MM = 0.1
_DIRECTIONS = 16


def responding(
    spec: EyeSpec,  # the eye, which looks far away
    *,
    age_years: float = REFERENCE_AGE,  # age of the eye
    accommodation_d: float = 0.0,  # demanded accommodation in dioptres, limited by age
    # luminance of the visual field; None: the eye's own pupil holds for far vision
    luminance_cd_m2: float | None = None,
    field_deg: float | None = None,  # diameter of the lit field; default: the table's
    own_pupil: bool = False,  # whether the stop keeps its diameter
    wavelength_nm: float = 850.0,  # wavelength of the traced rays
) -> EyeSpec:
    """Copy an eye file, adapted to some light and viewing distance.

    Raises:
        InputError: the eye has no lens that could accommodate, or the result is physically impossible.
    """
    table = default_table()
    response = min(accommodation_d, amplitude_d(table, age_years))
    data = spec.to_mapping()
    far = spec.build(wavelength_nm=wavelength_nm)
    if response > 0.0:
        # The fovea keeps its position on the retina.
        data["fovea"] = {"position_mm": [float(v) for v in far.fovea_mm]}
        forward = _accommodate(data, age_years, response)
        reach = _reach_mm(far.front[-1], data["stop"]["position_mm"][0]) - _ROOT_GAP_MM
        if forward > 0.0 and reach < spec.iris.root_radius_mm:
            data["iris"] = {"root_radius_mm": reach}
    if not own_pupil:
        if luminance_cd_m2 is None:
            wanted = entrance_pupil_mm(far)
        else:
            field = table.constant("field_deg") if field_deg is None else field_deg
            wanted = float(watson_yellott_mm(luminance_cd_m2, field, age_years))
        wanted = max(wanted - table.median("miosis_mm_per_d") * response, table.constant("smallest_pupil_mm"))
        _set_pupil(data, wanted, wavelength_nm)
    return EyeSpec.from_mapping(data)


def _accommodate(data: dict[str, Any], age_years: float, response_d: float) -> float:
    """Change the lens in the keys of an eye file; return how far (mm) its front and the stop move forward."""
    lens = data.get("lens") or {}
    surfaces = [lens["front"], lens["back"]] if lens.get("kind") == "gradient" else list(lens.get("surfaces", ()))
    if len(surfaces) != 2:
        raise InputError("needs an eye whose lens has a front and a back", path="subject.accommodation_d")
    thicker = thickening_mm(age_years, response_d)
    forward = FORWARD * thicker
    changes = ((FRONT_PER_D, FRONT_Q_PER_D, forward), (-BACK_PER_D, 0.0, forward - thicker))
    for surface, (curvature, q, shift) in zip(surfaces, changes, strict=True):
        surface["shape"] = _curved(surface["shape"], curvature * response_d, q * response_d)
        surface["position_mm"] = _shifted(surface.get("position_mm", (0.0, 0.0, 0.0)), shift)
    data["stop"]["position_mm"] = _shifted(data["stop"]["position_mm"], forward)
    return forward


def _curved(shape: dict[str, Any], curvature: float, q: float) -> dict[str, Any]:
    """Return a shape with other apex curvatures (1/mm) and conic constants."""
    if shape["kind"] in ("sphere", "conic"):
        radius = 1.0 / (1.0 / shape["radius_mm"] + curvature)
        return {"kind": "conic", "radius_mm": radius, "conic_constant": shape.get("conic_constant", 0.0) + q}
    if shape["kind"] == "biconic":
        radii = [1.0 / (1.0 / radius + curvature) for radius in shape["radii_mm"]]
        return {"kind": "biconic", "radii_mm": radii, "conic_constants": [v + q for v in shape["conic_constants"]]}
    raise InputError("needs a lens of spheres, conics or biconics", path="subject.accommodation_d")


def _shifted(position: Any, forward_mm: float) -> list[float]:
    return [float(position[0]) + forward_mm, *(float(v) for v in position[1:])]


def _set_pupil(data: dict[str, Any], entrance_mm: float, wavelength_nm: float) -> None:
    """Set the stop of an eye file to the diameter that gives an entrance pupil of `entrance_mm`."""
    parts = EyeParts.from_mapping(data)
    front = tuple(surface_of(s) for s in parts.cornea)
    indices = tuple(index_at(s.medium, wavelength_nm, f"cornea.{k}.medium") for k, s in enumerate(parts.cornea))
    diameter = stop_for_entrance(front, indices, lambda d: stop_of(parts, d), entrance_mm)
    place = stop_of(parts, diameter).centre_mm
    data["stop"] |= {"diameter_mm": diameter, "position_mm": [float(v) for v in place]}


def _reach_mm(cornea: Surface, depth_x: float) -> float:
    """Compute the smallest distance (mm) from the axis at which a surface reaches the depth x."""
    angle = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    way = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=-1)

    def gap(radius: float) -> float:
        points = radius * way + [depth_x, 0.0, 0.0]
        return float(np.max(cornea.implicit(points)))

    return float(brentq(gap, 0.1, 8.0)) if gap(8.0) > 0.0 else 8.0
