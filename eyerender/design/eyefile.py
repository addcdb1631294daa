"""Apply the unknowns of a person to an eye file: the counterpart of `varied_eyes` for files."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..eye.kappa import angles_of, pupillary_axis, with_kappa
from ..eye.spec import EyeSpec
from .unknowns import ASPHERICITY, CENTRE, DEPTH, ELLIPTICITY, KAPPA, LOCAL, POSITION, RADIUS, ROTATION, SHIFT, TORICITY


def changed_file(spec: EyeSpec, theta: Floats) -> EyeSpec:
    """Return the eye file with the person's part of `theta` (23,) applied; the position has no key in it.

    The pupil's ellipticity becomes the second harmonic of its contour, which is right to first order. The fovea is
    placed so that the line of sight keeps its direction in the eye, turned by kappa.

    Raises:
        InputError: the eye is physically impossible.
    """
    if not np.any(np.delete(theta, POSITION)[LOCAL:]):
        return spec
    data = spec.to_mapping()
    front = data["cornea"][0]["shape"]
    own = float(front["radius_mm"] if "radius_mm" in front else np.mean(front["radii_mm"]))
    for surface in data["cornea"]:
        _scale(surface["shape"], (own + theta[RADIUS]) / own)
    data["cornea"][0]["shape"] = _flattened(data["cornea"][0]["shape"], float(theta[ASPHERICITY]))
    if np.any(theta[TORICITY]):
        _make_toric(data["cornea"][0], *theta[TORICITY])
    data["stop"] = _changed_stop(data["stop"], theta)
    for key in ("azimuth_centre_mm", "elevation_centre_mm"):
        x, y, z = data["rotation"][key]
        data["rotation"][key] = [x - theta[ROTATION], y, z]
    changed = EyeSpec.from_mapping({**data, "name": f"{spec.name}, fitted"})
    eye, before = changed.build(), spec.build()
    wanted = angles_of(before, before.chief_ray.direction) + theta[KAPPA] - angles_of(eye, pupillary_axis(eye)[1])
    nasal, up = np.degrees(wanted)
    return with_kappa(changed, (float(nasal), float(up)))


def _changed_stop(stop: dict[str, Any], theta: Floats) -> dict[str, Any]:
    (x, y, z), moves = stop["position_mm"], stop.get("shift_mm_per_mm", (0.0, 0.0))
    nasal, up = theta[CENTRE]
    stop = {
        **stop,
        "position_mm": [x - theta[DEPTH], y + nasal, z + up],
        "shift_mm_per_mm": (np.array(moves) + theta[SHIFT]).tolist(),
    }
    if np.any(theta[ELLIPTICITY]):
        own = stop.get("contour") or {"cosines": (), "sines": ()}
        rows = {name: [*own[name], 0.0, 0.0][: max(2, len(own[name]))] for name in ("cosines", "sines")}
        for row, change in zip(rows.values(), theta[ELLIPTICITY], strict=True):
            row[1] += float(change)
        stop["contour"] = rows
    return stop


def _make_toric(surface: dict[str, Any], straight: float, oblique: float) -> None:
    """Give a cornea's front the toricity of `design.varied`, as a biconic turned about its axis."""
    shape = surface["shape"]
    if shape["kind"] == "biconic":
        first, second = shape["radii_mm"]
        mean, own = (first + second) / 2.0, (first - second) / 2.0
        sign = -1.0 if own < 0 else 1.0
        size = sign * np.hypot(own + straight, oblique)
        radii, conic = [mean + size, mean - size], shape["conic_constants"]
        angle = 0.5 * np.arctan2(sign * oblique, sign * (own + straight))
    else:
        radius, q = shape["radius_mm"], shape.get("conic_constant", 0.0)
        share = np.hypot(straight, oblique) / radius
        radii = [radius / (1.0 - share), radius / (1.0 + share)]
        conic = [(1.0 + q) * own / radius - 1.0 for own in radii]
        angle = 0.5 * np.arctan2(oblique, straight)
    surface["shape"] = {"kind": "biconic", "radii_mm": [float(r) for r in radii], "conic_constants": conic}
    x, y, z = surface.get("tilt_deg", (0.0, 0.0, 0.0))
    surface["tilt_deg"] = [x + float(np.degrees(angle)), y, z]


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
