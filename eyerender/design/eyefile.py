"""Eye files with the unknowns of a person applied: the counterpart of `varied_eyes` for files."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import Floats
from ..eye.kappa import angles_of, pupillary_axis, with_kappa
from ..eye.spec import EyeSpec
from .unknowns import ASPHERICITY, DEPTH, KAPPA, LOCAL, RADIUS, ROTATION


def changed_file(spec: EyeSpec, theta: Floats) -> EyeSpec:
    """Eye file with what belongs to a person in `theta` (15,); the position has no place in it.

    The fovea is placed so that the line of sight keeps its direction in the eye, turned by kappa.

    Raises:
        InputError: such an eye cannot exist.
    """
    if not np.any(theta[LOCAL : LOCAL + 6]):
        return spec
    data = spec.to_mapping()
    own = _radius(data["cornea"][0]["shape"])
    for surface in data["cornea"]:
        _scale(surface["shape"], (own + theta[RADIUS]) / own)
    data["cornea"][0]["shape"] = _flattened(data["cornea"][0]["shape"], float(theta[ASPHERICITY]))
    x, y, z = data["stop"]["position_mm"]
    data["stop"]["position_mm"] = [x - theta[DEPTH], y, z]
    for key in ("azimuth_centre_mm", "elevation_centre_mm"):
        x, y, z = data["rotation"][key]
        data["rotation"][key] = [x - theta[ROTATION], y, z]
    changed = EyeSpec.from_mapping({**data, "name": f"{spec.name}, fitted"})
    eye, before = changed.build(), spec.build()
    wanted = angles_of(before, before.chief_ray.direction) + theta[KAPPA] - angles_of(eye, pupillary_axis(eye)[1])
    nasal, up = np.degrees(wanted)
    return with_kappa(changed, (float(nasal), float(up)))


def _radius(shape: dict[str, Any]) -> float:
    return float(shape["radius_mm"] if "radius_mm" in shape else np.mean(shape["radii_mm"]))


def _scale(shape: dict[str, Any], factor: float) -> None:
    if "radius_mm" in shape:
        shape["radius_mm"] *= factor
    else:
        shape["radii_mm"] = [radius * factor for radius in shape["radii_mm"]]


def _flattened(shape: dict[str, Any], change: float) -> dict[str, Any]:
    if shape["kind"] == "biconic":
        return {**shape, "conic_constants": [q + change for q in shape["conic_constants"]]}
    if change == 0.0:
        return shape
    return {
        "kind": "conic",
        "radius_mm": shape["radius_mm"],
        "conic_constant": shape.get("conic_constant", 0.0) + change,
    }
