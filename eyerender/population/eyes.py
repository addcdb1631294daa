"""Convert the numbers of a drawn eye to its eye file, at one accommodation and with one entrance pupil."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..eye.biometry import iris_root_mm
from ..eye.build import bare_eye
from ..eye.check import check_eye
from ..eye.entrance import stop_for_entrance
from ..eye.kappa import fovea_of_kappa
from ..eye.margin import drawn_contour
from ..eye.parts import EyeParts
from ..eye.spec import EyeSpec
from ..eye.surfaces import index_at, stop_of, surface_of
from ..optics.surfaces import Surface
from .pupil import ellipticity
from .refraction import AQUEOUS, CORNEA, LENS, VITREOUS
from .table import PopulationTable

LENS_MM_PER_D, LENS_MM_PER_D_YEAR = 0.058, -0.0005
FRONT_PER_D, BACK_PER_D = 0.0077, 0.0043
FRONT_Q_PER_D = -0.5
"""Change of the lens per dioptre: thickness 0.058 - 0.0005 y mm, curvatures 0.0077 and 0.0043 /mm, Q (Navarro 2014)."""
FORWARD = 0.75
"""Share of the lens' thickening that moves its front forward (chosen; Dubbelman et al. 2005, from memory)."""
_IRIS_GAP_MM = 0.02
_SHIFTED_MM = 0.3  # distance by which pupils may move with their size
_DESIGN_NM = 850.0


def amplitude_d(table: PopulationTable, age_years: float) -> float:
    """Compute the accommodation amplitude (D) at an age."""
    return max(table.constant("amplitude_d") + table.constant("amplitude_d_per_year") * age_years, 0.0)


def thickening_mm(age_years: float, accommodation_d: float) -> float:
    """Compute the increase (mm) of the lens' thickness by accommodation."""
    return (LENS_MM_PER_D + LENS_MM_PER_D_YEAR * age_years) * accommodation_d


def eye_file(
    name: str,
    eye: Mapping[str, float],
    table: PopulationTable,
    *,
    age_years: float,
    accommodation_d: float,
    entrance_mm: float,
    seed: int,
) -> EyeSpec:
    """Return the eye file of a drawn eye, for an entrance pupil of `entrance_mm`.

    `eye` are its numbers by their names in the table, including those from `refraction.solve`. The lens is accommodated
    by `accommodation_d`; `seed` selects the outline of the pupil. Raises InputError if the eye is physically
    impossible: surfaces cross, or the stop lies outside the chamber.
    """
    drawn = _accommodated(name, tuple(sorted(eye.items())), _Table(table), age_years, accommodation_d, seed)

    def shaped(diameter: float) -> Any:
        # Diameter of the file's own pupil, so that its shift is the same at every other size.
        flat, axis = ellipticity(diameter)
        own = drawn.parts.stop.model_copy(update={"ellipticity": flat, "axis_deg": axis})
        return stop_of(drawn.parts.model_copy(update={"stop": own}), diameter)

    diameter = stop_for_entrance(drawn.front, drawn.indices, shaped, entrance_mm)
    flat, axis = ellipticity(diameter)
    changes = {
        "diameter_mm": diameter,
        "position_mm": tuple(float(v) for v in shaped(diameter).centre_mm),
        "ellipticity": flat,
        "axis_deg": axis,
    }
    stop = drawn.parts.stop.model_copy(update=changes)
    # All values are already checked; only the geometry remains.
    found = EyeSpec.model_construct(**{**dict(drawn.parts), "stop": stop})
    check_eye(found)
    return found


@dataclass(frozen=True, slots=True)
class _Table:
    """Cache key: a table that is compared by identity."""

    table: PopulationTable

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Table) and other.table is self.table

    def __hash__(self) -> int:
        return id(self.table)


@dataclass(frozen=True, slots=True)
class _Accommodated:
    """A drawn eye at one accommodation, with its stop at the table's reference diameter: eye file and cornea."""

    parts: EyeParts
    front: tuple[Surface, ...]
    indices: tuple[float, ...]


@lru_cache(maxsize=64)
def _accommodated(
    name: str,
    numbers: tuple[tuple[str, float], ...],
    table: _Table,
    age_years: float,
    accommodation_d: float,
    seed: int,
) -> _Accommodated:
    """Build what all pupils of an eye share; cached, as frames of a person differ more often in pupil than in lens.

    Raises:
        InputError: there is no such lens.
    """
    eye, constant = dict(numbers), table.table
    if not np.isfinite(eye["lens_c0"]):
        raise InputError("no lens of this shape gives the eye its refraction", path="lens.surfaces.0.medium")
    data = _mapping(name, eye, constant, age_years, accommodation_d)
    relaxed = _mapping(name, eye, constant, age_years, 0.0)
    data["fovea"] = _fovea(eye, relaxed, constant.constant("refraction_nm"))
    data["stop"]["contour"] = drawn_contour(seed, eye["pupil_noncircularity"]).to_mapping()
    parts = EyeParts.from_mapping(data)
    front = tuple(surface_of(s) for s in parts.cornea)
    return _Accommodated(parts, front, tuple(index_at(s.medium, _DESIGN_NM, "cornea") for s in parts.cornea))


def _mapping(
    name: str, eye: Mapping[str, float], table: PopulationTable, age: float, accommodation: float
) -> dict[str, Any]:
    """Return the keys of the eye file, with the stop at its reference diameter and the fovea on the optic axis."""
    constant = table.constant
    thicker = thickening_mm(age, accommodation)
    lens_front = -(eye["chamber_depth_mm"] - FORWARD * thicker)
    stop_x = lens_front + _stop_gap(eye)
    limbus = eye["iris_diameter_mm"] / 2.0
    return {
        "name": name,
        "cornea": _cornea(eye),
        "lens": {"kind": "surfaces", "surfaces": _lens(eye, table, age, accommodation)},
        "retina": {
            "shape": {
                "kind": "ellipsoid",
                "semi_axes_mm": [eye["retina_axial_mm"], eye["retina_horizontal_mm"], eye["retina_vertical_mm"]],
                "side": "back",
            },
            "position_mm": [-eye["axial_length_mm"], 0.0, 0.0],
        },
        "stop": {
            "diameter_mm": constant("pupil_reference_mm"),
            "position_mm": [stop_x, eye["pupil_nasal_mm"], eye["pupil_up_mm"]],
            "shift_mm_per_mm": [eye["pupil_shift_nasal_mm_per_mm"], eye["pupil_shift_up_mm_per_mm"]],
        },
        "limbus_radius_mm": limbus,
        "iris": {"root_radius_mm": _iris_root(eye, stop_x, limbus)},
        "sclera": {"radius_mm": eye["sclera_radius_mm"]},
        "rotation": {
            "azimuth_centre_mm": [-eye["rotation_azimuth_mm"], constant("rotation_nasal_mm"), 0.0],
            "elevation_centre_mm": [-eye["rotation_elevation_mm"], 0.0, constant("rotation_up_mm")],
        },
        "fovea": {},
    }


def _cornea(eye: Mapping[str, float]) -> list[dict[str, Any]]:
    """Compute the front and back of the cornea."""
    return [
        {
            "name": "anterior cornea",
            **_toric(eye["flat_mm"], eye["steep_mm"], eye["flat_axis_deg"], eye["corneal_asphericity"]),
            "medium": {"cauchy": list(CORNEA)},
        },
        {
            "name": "posterior cornea",
            **_toric(
                eye["posterior_flat_mm"],
                eye["posterior_steep_mm"],
                eye["posterior_flat_axis_deg"],
                eye["posterior_asphericity"],
            ),
            "position_mm": [-eye["corneal_thickness_mm"], 0.0, 0.0],
            "medium": {"cauchy": list(AQUEOUS)},
        },
    ]


def _lens(eye: Mapping[str, float], table: PopulationTable, age: float, accommodation: float) -> list[dict[str, Any]]:
    """Compute the front and back of the lens."""
    thicker = thickening_mm(age, accommodation)
    front_radius = 1.0 / (1.0 / eye["lens_front_radius_mm"] + FRONT_PER_D * accommodation)
    back_radius = 1.0 / (1.0 / eye["lens_back_radius_mm"] + BACK_PER_D * accommodation)
    lens_front = -(eye["chamber_depth_mm"] - FORWARD * thicker)
    lens_back = -(eye["chamber_depth_mm"] + eye["lens_thickness_mm"] + (1.0 - FORWARD) * thicker)
    place = [eye["lens_nasal_mm"], eye["lens_up_mm"]]
    tilt = [0.0, eye["lens_tilt_y_deg"], eye["lens_tilt_z_deg"]]
    return [
        {
            "name": "lens front",
            "shape": {
                "kind": "conic",
                "radius_mm": front_radius,
                "conic_constant": table.constant("lens_front_asphericity") + FRONT_Q_PER_D * accommodation,
            },
            "position_mm": [lens_front, *place],
            "tilt_deg": tilt,
            "medium": {"cauchy": [eye["lens_c0"], *LENS]},
        },
        {
            "name": "lens back",
            "shape": {
                "kind": "conic",
                "radius_mm": -back_radius,
                "conic_constant": table.constant("lens_back_asphericity"),
            },
            "position_mm": [lens_back, *place],
            "tilt_deg": tilt,
            "medium": {"cauchy": list(VITREOUS)},
        },
    ]


def _fovea(eye: Mapping[str, float], relaxed: dict[str, Any], wavelength_nm: float) -> dict[str, Any]:
    """Compute the fovea from the angle kappa of the relaxed eye, with the stop at the table's reference diameter.

    So the fovea does not move when pupil and lens change.
    """
    kappa = (eye["kappa_horizontal_deg"], eye["kappa_vertical_deg"])
    return {"position_mm": list(_fovea_of(json.dumps(relaxed), kappa, wavelength_nm))}


@lru_cache(maxsize=64)
def _fovea_of(relaxed: str, kappa_deg: tuple[float, float], wavelength_nm: float) -> tuple[float, ...]:
    """Compute the fovea of an eye (JSON); cached, because it is the same in any light and at any distance."""
    parts = EyeParts.from_mapping(json.loads(relaxed))
    bare = bare_eye(parts, wavelength_nm, stop_of(parts, parts.stop.diameter_mm))
    return tuple(float(v) for v in fovea_of_kappa(bare, kappa_deg))


def _toric(flat_mm: float, steep_mm: float, axis_deg: float, asphericity: float) -> dict[str, Any]:
    """Create the biconic whose meridian `axis_deg`, from nasal towards up, has the larger radius."""
    # A turn about x of +t carries nasal (+y) towards up (+z).
    return {
        "shape": {"kind": "biconic", "radii_mm": [flat_mm, steep_mm], "conic_constants": [asphericity, asphericity]},
        "tilt_deg": [axis_deg, 0.0, 0.0],
    }


def _stop_gap(eye: Mapping[str, float]) -> float:
    """Compute the stop's distance in front of the lens' apex, so that its centre clears a tilted lens at every size."""
    away = np.hypot(eye["pupil_nasal_mm"] - eye["lens_nasal_mm"], eye["pupil_up_mm"] - eye["lens_up_mm"])
    tilt = np.radians(np.hypot(eye["lens_tilt_y_deg"], eye["lens_tilt_z_deg"]))
    return float(_IRIS_GAP_MM + (away + _SHIFTED_MM) * np.tan(tilt))


def _iris_root(eye: Mapping[str, float], stop_x: float, limbus: float) -> float:
    """Compute the radius of the iris' root: just inside the posterior cornea in the stop's plane and the limbus."""
    depth = -stop_x - eye["corneal_thickness_mm"]
    return iris_root_mm(eye["posterior_steep_mm"], eye["posterior_asphericity"], depth, limbus)
