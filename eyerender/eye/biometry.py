"""Make an eye from the numbers that a biometer prints.

Keratometers state the radius R of the front cornea as the power 337.5 / R, and the axis of a meridian as an examiner
who faces the eye sees it: from the examiner's right, counter-clockwise, for both eyes. This is from nasal towards up in
a right eye, and from temporal towards up in a left one. Biometers measure all lengths along the axis from the front of
the cornea, so that `acd_mm` includes the cornea's thickness.

What a biometer does not measure is that of the eye `adult`: asphericities, the back of the cornea (its radii in
proportion to the front's), the shapes of the lens, the indices, the pupil and the fovea. The retina's semi-axes are in
proportion to the length, and the centres of rotation lie 0.5 mm deeper per mm of length (Dick 1990).
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ..base.errors import InputError
from ..base.spec import Spec, read_yaml

KERATOMETRIC_MM_D = 337.5
"""Radius (mm) times power (D) of keratometers: 1000 (1.3375 - 1)."""
ROOT_GAP_MM, LIMBUS_GAP_MM = 0.1, 0.35
_DEEPER_PER_MM = 0.5
_ADULT = Path(__file__).parent / "catalogue" / "adult.yaml"
MEASURED = ("cornea", "lens", "retina", "limbus_radius_mm", "toric_axis")
"""Keys of an eye file that follow from `biometry`."""

Keratometry = Annotated[float, Field(ge=20.0, le=80.0)]


class BiometrySpec(Spec):
    """Numbers of a biometer, of one eye or of both.

    >>> er.eye.BiometrySpec(k1_d=43, k1_axis_deg=20, k2_d=44, acd_mm=3.4, lens_mm=4, axial_mm=24, wtw_mm=12).k2_d
    44.0
    """

    k1_d: Keratometry = Field(description="power of one principal meridian of the cornea, with the index 1.3375")
    k1_axis_deg: float = Field(
        ge=0.0, le=180.0, description="axis of this meridian as the examiner sees it, in the same sense for both eyes"
    )
    k2_d: Keratometry = Field(description="power of the meridian across it")
    acd_mm: float = Field(ge=1.0, le=8.0, description="from the front of the cornea to the lens")
    lens_mm: float = Field(ge=1.0, le=8.0, description="thickness of the lens")
    axial_mm: float = Field(ge=14.0, le=40.0, description="from the front of the cornea to the retina")
    wtw_mm: float = Field(ge=6.0, le=18.0, description="white to white, the diameter of the limbus")

    def keys(self) -> dict[str, Any]:
        """Return the keys of an eye file with these numbers."""
        made = deepcopy(_adult())
        radii = [KERATOMETRIC_MM_D / self.k1_d, KERATOMETRIC_MM_D / self.k2_d]
        front, back = made["cornea"]
        wider = float(np.mean(radii) / np.mean(front["shape"]["radii_mm"]))
        front["shape"]["radii_mm"], front["tilt_deg"] = radii, [self.k1_axis_deg, 0.0, 0.0]
        back["shape"]["radii_mm"] = [wider * radius for radius in back["shape"]["radii_mm"]]
        lens, stop, retina = made["lens"]["surfaces"], made["stop"], made["retina"]
        stop["position_mm"][0] -= lens[0]["position_mm"][0] + self.acd_mm
        for surface, depth in zip(lens, (self.acd_mm, self.acd_mm + self.lens_mm), strict=True):
            surface["position_mm"] = [-depth, 0.0, 0.0]
        mean = -retina["position_mm"][0]
        retina["position_mm"] = [-self.axial_mm, 0.0, 0.0]
        retina["shape"]["semi_axes_mm"] = [self.axial_mm / mean * axis for axis in retina["shape"]["semi_axes_mm"]]
        for centre in ("azimuth_centre_mm", "elevation_centre_mm"):
            made["rotation"][centre][0] -= _DEEPER_PER_MM * (self.axial_mm - mean)
        shape, depth = back["shape"], back["position_mm"][0] - stop["position_mm"][0]
        made["limbus_radius_mm"] = self.wtw_mm / 2.0
        root = iris_root_mm(min(shape["radii_mm"]), shape["conic_constants"][0], depth, made["limbus_radius_mm"])
        about = {"name": "biometry", "description": "Eye made from a biometer's numbers", "sources": {}}
        return {**made, **about, "iris": {"root_radius_mm": root}, "toric_axis": "same"}


def with_biometry(data: Mapping[str, Any]) -> dict[str, Any]:
    """Replace `biometry` in the keys of an eye file by what follows from it; InputError if a number does not fit it."""
    for key in MEASURED:
        if key in data:
            raise InputError("cannot be combined with 'biometry', from which it follows", path=key)
    try:
        made = BiometrySpec.from_mapping(data["biometry"]).keys()
    except InputError as error:
        raise error.placed(under="biometry") from None
    return {**made, **{key: value for key, value in data.items() if key != "biometry"}}


@cache
def _adult() -> dict[str, Any]:
    return read_yaml(_ADULT)


def iris_root_mm(radius_mm: float, conic_constant: float, depth_mm: float, limbus_mm: float) -> float:
    """Compute the radius of the iris' root, just inside the limbus and the back of the cornea.

    The back is a conic of apex radius `radius_mm`; the stop lies `depth_mm` behind its apex.
    """
    depth = max(depth_mm, 0.0)
    reach = np.sqrt(max(2.0 * radius_mm * depth - (1.0 + conic_constant) * depth**2, 0.0))
    return float(min(limbus_mm - LIMBUS_GAP_MM, reach - ROOT_GAP_MM))
