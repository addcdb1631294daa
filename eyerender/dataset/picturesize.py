"""Change image size and bits: scale cameras, lengths in pixels and codes of a template, so that they see the same."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..base.errors import InputError
from ..rig.imaging import Lens, Opening, Star
from ..rig.sensor import Sensor
from .draws import is_draw

_OPTION = "--size"
# Lengths in pixels, by the key of what they belong to; they are scaled also where the template leaves them out.
_LENGTHS = {
    "sensor": {key: Sensor.model_fields[key].default for key in ("psf_sigma_px", "sharpening_px", "border_px")},
    "lens": {key: Lens.model_fields[key].default for key in ("glare_radius_px", "ghost_blur_px")},
    "openings": {"edge_px": Opening.model_fields["edge_px"].default},
    "star": {"reach_px": Star.model_fields["reach_px"].default},
}
_CODES = ("gain_dn_per_e", "black_level_dn", "border_dn")  # of a sensor, in codes
_COUNTS = {"reach_px": (2, 200), "border_px": (0, 4096)}  # whole numbers, and their bounds
_SIZES = ("low", "high", "mean", "sd", "value", "values", "components")  # keys of a draw that are in its unit


def scaled(scene: Mapping[str, Any], size_px: tuple[int, int]) -> dict[str, Any]:
    """Scale resolution, focal length and principal point of all cameras, and all lengths in pixels, to a new size.

    The lengths are those of the window, blur, sharpening, glare, ghosts, stars, borders and edges of openings. The size
    is that of the images: of the window, or of the sensor if there is no window. The pixel pitch
    (`sensor.pixel_pitch_um`) stays, as if another lens and a sensor with another number of pixels were used, so the
    exposure stays too. Raises InputError if the images have several sizes or another aspect ratio, or a camera's size
    is drawn or calibrated.
    """
    image = scene.get("image")
    window = image.get("window_px") if isinstance(image, Mapping) else None
    cameras = list(_cameras(scene.get("rig", {})))
    sizes = {_numbers(window)} if window is not None else {_numbers(camera["resolution_px"]) for camera in cameras}
    if len(sizes) != 1:
        raise InputError("the pictures of this spec have several sizes", source=_OPTION)
    width, height = sizes.pop()
    factor = size_px[0] / width
    if round(factor * height) != size_px[1] and round(size_px[1] / height * width) != size_px[0]:
        raise InputError(f"must have the shape of {width} x {height}", source=_OPTION)
    out: dict[str, Any] = _replaced({"sensor": {}, **scene}, factor)
    if window is not None:
        out["image"] = {**out["image"], "window_px": list(size_px)}
    return out


def with_bits(scene: Mapping[str, Any], bits: int) -> dict[str, Any]:
    """Replace the bits of the pictures, and scale gain, black level and the borders' code to the new full scale.

    Raises:
        InputError: the sensor or its bit depth is drawn.
    """
    sensor = scene.get("sensor") or {}
    old = sensor.get("bit_depth", Sensor.model_fields["bit_depth"].default)
    if is_draw(sensor) or not isinstance(old, int):
        raise InputError("the spec draws it", source="--bit-depth")
    factor = (2**bits - 1) / (2**old - 1)
    scaled = {key: _length(sensor[key], factor, key) for key in _CODES if sensor.get(key) is not None}
    return {**scene, "sensor": {**sensor, "bit_depth": bits, **scaled}}


def _cameras(node: Any) -> list[Mapping[str, Any]]:
    """Return all cameras of a template."""
    if isinstance(node, Mapping):
        if "resolution_px" in node:
            return [node]
        return [camera for value in node.values() for camera in _cameras(value)]
    return [camera for value in node for camera in _cameras(value)] if isinstance(node, list | tuple) else []


def _replaced(node: Any, factor: float, owner: str = "") -> Any:
    """Scale a node of the template, which belongs to the key `owner`."""
    if isinstance(node, list | tuple):
        return [_replaced(value, factor, owner) for value in node]
    if not isinstance(node, Mapping) or node.keys() == {"var"}:
        return node
    if is_draw(node):
        return {key: _replaced(value, factor, owner) for key, value in node.items()}
    if "resolution_px" not in node:
        lengths = _LENGTHS.get(owner, {})
        return {key: _replaced(value, factor, key) for key, value in node.items()} | {
            key: _length(node.get(key, default), factor, key) for key, default in lengths.items()
        }
    if node.get("calibration") is not None:
        raise InputError("a calibrated camera has one size", source=_OPTION)
    camera = {**node, "resolution_px": [round(factor * n) for n in _numbers(node["resolution_px"])]}
    if node.get("focal_length_px") is not None:
        camera["focal_length_px"] = _length(node["focal_length_px"], factor, "focal_length_px")
    if node.get("principal_point_px") is not None:
        # Pixel centres are at integers.
        camera["principal_point_px"] = [factor * (v + 0.5) - 0.5 for v in _numbers(node["principal_point_px"])]
    return camera


def _numbers(pair: Any) -> tuple[Any, ...]:
    if isinstance(pair, list | tuple) and len(pair) == 2 and all(isinstance(v, int | float) for v in pair):
        return tuple(pair)
    raise InputError("the size of a camera is drawn", source=_OPTION)


def _length(node: Any, factor: float, key: str) -> Any:
    """Scale a length in pixels: a number, an expression of variables, or a draw of these."""
    if isinstance(node, list | tuple):
        return [_length(value, factor, key) for value in node]
    if isinstance(node, Mapping):
        if node.keys() == {"var"}:
            return {"var": f"{factor!r} * ({node['var']})"}
        whole = {"low": 0.0, "high": 1.0, **node} if node.get("draw") == "beta" else node
        return {name: _length(value, factor, key) if name in _SIZES else value for name, value in whole.items()}
    if isinstance(node, bool) or not isinstance(node, int | float):
        return node
    if key in _COUNTS:
        low, high = _COUNTS[key]
        return min(max(round(factor * node), low), high)
    return factor * node
