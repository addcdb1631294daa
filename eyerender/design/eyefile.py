"""Apply the unknowns of a person to an eye file: the counterpart of `varied_eyes` for files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..eye.kappa import angles_of, pupillary_axis, with_kappa
from ..eye.spec import EyeSpec
from .unknowns import (
    ASPHERICITY,
    CENTRE,
    DEPTH,
    ELLIPTICITY,
    GAP,
    HARMONICS,
    KAPPA,
    LOCAL,
    MARGIN,
    POSITION,
    POSTERIOR,
    POSTERIOR_TORICITY,
    RADIUS,
    ROTATION,
    SHIFT,
    TORICITY,
)


def changed_file(spec: EyeSpec, theta: Floats) -> EyeSpec:
    """Return the eye file with the person's part of `theta` (35,) applied; the position has no key in it.

    The pupil's ellipticity becomes the second harmonic of its contour, which is right to first order. The lens moves
    with the pupil, which rests on it. The fovea is placed so that the line of sight keeps its direction in the eye,
    turned by kappa. Raises InputError if the eye is physically impossible.
    """
    if not np.any(np.delete(theta, POSITION)[LOCAL:]):
        return spec
    data = spec.to_mapping()
    front = data["cornea"][0]["shape"]
    own = float(front["radius_mm"] if "radius_mm" in front else np.mean(front["radii_mm"]))
    for k, surface in enumerate(data["cornea"]):
        _scale(surface["shape"], (own + theta[RADIUS]) / own * (1.0 + theta[POSTERIOR] * (k > 0)))
        if k == 0:
            surface["shape"] = _flattened(surface["shape"], float(theta[ASPHERICITY]))
        toricity = theta[POSTERIOR_TORICITY if k else TORICITY]
        if np.any(toricity):
            _make_toric(surface, *toricity)
    data["stop"] = _changed_stop(data["stop"], theta)
    lens = data.get("lens") or {}
    for part in (*lens.get("surfaces", ()), *(lens[key] for key in ("front", "back") if key in lens)):
        part["position_mm"] = _deeper(part["position_mm"], theta[DEPTH])
    if lens.get("centre_mm"):
        lens["centre_mm"] = _deeper(lens["centre_mm"], theta[DEPTH])
    for key, half in (("azimuth_centre_mm", 0.5), ("elevation_centre_mm", -0.5)):
        data["rotation"][key] = _deeper(data["rotation"][key], theta[ROTATION] + half * theta[GAP])
    changed = EyeSpec.from_mapping({**data, "name": f"{spec.name}, fitted"})
    eye, before = changed.build(), spec.build()
    wanted = angles_of(before, before.chief_ray.direction) + theta[KAPPA] - angles_of(eye, pupillary_axis(eye)[1])
    nasal, up = np.degrees(wanted)
    return with_kappa(changed, (float(nasal), float(up)))


def _deeper(place_mm: Sequence[float], by_mm: float) -> list[float]:
    """Move a place (x, y, z) of the eye frame backwards."""
    x, y, z = place_mm
    return [x - float(by_mm), y, z]


def _changed_stop(stop: dict[str, Any], theta: Floats) -> dict[str, Any]:
    (x, y, z), moves = stop["position_mm"], stop.get("shift_mm_per_mm", (0.0, 0.0))
    nasal, up = theta[CENTRE]
    stop = {
        **stop,
        "position_mm": _deeper((x, y + nasal, z + up), theta[DEPTH]),
        "shift_mm_per_mm": (np.array(moves) + theta[SHIFT]).tolist(),
    }
    if np.any(theta[ELLIPTICITY]) or np.any(theta[MARGIN]):
        own = stop.get("contour") or {"cosines": (), "sines": ()}
        rows = {}
        for part, name in enumerate(("cosines", "sines")):
            row = np.zeros(max(HARMONICS[-1], len(own[name])))
            row[: len(own[name])] = own[name]
            row[1] += theta[ELLIPTICITY][part]
            row[np.array(HARMONICS) - 1] += theta[MARGIN][part::2]
            rows[name] = row.tolist()
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
