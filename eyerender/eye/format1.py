"""Conversion of eye files of format 1, whose keys format 2 replaces.

| format 1 | format 2 |
|---|---|
| `placed_by: centre` of a sphere, a conic or an ellipsoid | `position_mm` of the apex |
| `tilt_order: xyz` (Rx Ry Rz) | `tilt_deg` of the same rotation as Rz Ry Rx |
| `index_rate: 2` of a lens with `shells` | `layers`, one by one |

Both describe the same eye.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..base.errors import InputError
from ..base.spec import LARGEST
from ..base.storage.files import shown
from ..optics.transforms import rotation_x, rotation_y, rotation_z, tilt_rotation


def upgraded(data: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the mapping of an eye file of format 1 to format 2.

    Wrong values are left as they are, and the check of format 2 names them.

    Raises:
        InputError: one of the three keys has a value that format 1 did not allow.
    """
    out = {**data, "format": 2}
    if isinstance(out.get("cornea"), list):
        out["cornea"] = [_placed(surface, f"cornea.{k}") for k, surface in enumerate(out["cornea"])]
    out |= {key: _placed(out[key], key) for key in ("retina",) if key in out}
    lens = out.get("lens")
    if isinstance(lens, Mapping):
        out["lens"] = lens = {**lens}
        if isinstance(lens.get("surfaces"), list):
            lens["surfaces"] = [_placed(s, f"lens.surfaces.{k}") for k, s in enumerate(lens["surfaces"])]
        lens |= {key: _placed(lens[key], f"lens.{key}") for key in ("front", "back") if key in lens}
        if lens.get("kind") == "gradient":
            _count_layers(lens)
    return out


def _placed(value: Any, path: str) -> Any:
    """Convert the position and tilt of a shape: to its apex, and to Rz Ry Rx."""
    if not isinstance(value, Mapping):
        return value
    out = {**value}
    placed_by = _choice(out, "placed_by", ("apex", "centre"), path)
    order = _choice(out, "tilt_order", ("zyx", "xyz"), path)
    tilt, position = _numbers(out.get("tilt_deg", [0.0, 0.0, 0.0]), 3), _numbers(out.get("position_mm", [0.0] * 3), 3)
    if tilt is None or position is None:
        return out
    rotation = tilt_rotation(np.radians(tilt))
    if order == "xyz":
        angles = np.radians(tilt)
        rotation = rotation_x(angles[0]) @ rotation_y(angles[1]) @ rotation_z(angles[2])
        out["tilt_deg"] = _tilt_deg(rotation).tolist()
    if placed_by == "centre":
        lead = _apex_from_centre(out.get("shape"), f"{path}.placed_by")
        if lead is not None:
            out["position_mm"] = (position + rotation[:, 0] * lead).tolist()
    return out


def _apex_from_centre(shape: Any, path: str) -> float | None:
    """Compute the distance of the apex from the centre along the axis (mm); None if the shape itself is wrong."""
    kind = shape.get("kind") if isinstance(shape, Mapping) else None
    if kind == "ellipsoid":
        semi_axes = _numbers(shape.get("semi_axes_mm"), 3)
        return None if semi_axes is None else float(semi_axes[0]) * (-1.0 if shape.get("side") == "back" else 1.0)
    if kind in ("sphere", "conic"):
        numbers = _numbers([shape.get("radius_mm"), shape.get("conic_constant", 0.0)], 2)
        if numbers is None:
            return None
        if numbers[1] == -1.0:
            raise InputError("a paraboloid has no centre", path=path)
        return float(numbers[0] / (1.0 + numbers[1]))
    if kind in ("biconic", "quadric", "plane"):
        raise InputError(f"a {kind} is placed by its apex", path=path)
    return None


def _tilt_deg(rotation: Floats) -> Floats:
    """Compute angles (deg) about x, y, z of a rotation (3, 3) as Rz Ry Rx."""
    about_y = np.arctan2(-rotation[2, 0], np.hypot(rotation[2, 1], rotation[2, 2]))
    about_z = np.arctan2(rotation[1, 0], rotation[0, 0])
    # The remaining rotation is the one about x, also where x and z turn about one axis.
    left = rotation_y(-about_y) @ rotation_z(-about_z) @ rotation
    return np.degrees([np.arctan2(left[2, 1], left[1, 1]), about_y, about_z])


def _count_layers(lens: dict[str, Any]) -> None:
    """Replace, in place, the doubled index rate by the layers that it stood for.

    Shell k stood at k / (2 shells) of the way from edge to core and had (k + 1) / shells inside. The lens' own surfaces
    were the first shell.
    """
    rate = _choice(lens, "index_rate", (1, 2), "lens")
    if rate != 2:
        return
    count = lens.pop("shells", None)
    if count is None:
        raise InputError("must be 1 without 'shells'", path="lens.index_rate")
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= 200:
        lens["shells"] = count
        return
    inner = [{"size": float(np.sqrt(1.0 - k / (2 * count))), "index_share": (k + 1) / count} for k in range(count)]
    lens["layers"] = [{"size": 1.0, "index_share": 0.0}, *inner]


def _choice(data: dict[str, Any], key: str, known: tuple[Any, Any], path: str) -> Any:
    """Remove a key of format 1 and return its value; the default is the first known value."""
    value = data.pop(key, known[0])
    if isinstance(value, bool) or not isinstance(value, type(known[0])) or value not in known:
        raise InputError(f"must be {known[0]!r} or {known[1]!r}, not {shown(value)}", path=f"{path}.{key}")
    return value


def _numbers(value: Any, count: int) -> Floats | None:
    """Convert a list of finite numbers within the limits of a spec to an array; None for anything else."""
    if not isinstance(value, list | tuple) or len(value) != count:
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float) or not abs(v) <= LARGEST for v in value):
        return None
    return np.array(value, dtype=np.float64)
