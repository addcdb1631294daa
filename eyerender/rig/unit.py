"""Calibration of one device: all cameras and LEDs of a headset in the device's frame, in one file.

    x_camera = R_c x_device + t_c       the pose of each camera in the file
    x_world = R x_device + t            where the device is, in the scene

So a camera of the scene has the rotation R_c R^T and the translation t_c - R_c R^T t, and an LED the place R x + t.

The file is JSON or YAML with `cameras` and, optionally, `leds`. A camera has the keys of a calibration file
(`opencv.py`) and those of `_OWN`; an LED is a place, or has the keys of a light. Calibrations of Windows Mixed Reality
headsets are read too. They state intrinsics as shares of the sensor, from its corner instead of the centre of its first
pixel, and metres (Azure Kinect Sensor SDK, `transformation/mode_specific_calibration.c`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import yaml
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from ..base.arrays import Floats
from ..base.errors import InputError
from ..base.spec import MAX_YAML_BYTES, Positive, Spec, Vec3, parse_yaml
from ..base.storage.files import parse_json, read_text, shown, write_text
from ..optics.transforms import rotated
from .camera import EyeNames, Matrix3, is_rotation
from .distortion import distortion_data
from .light import NEAREST_EYE
from .opencv import calibration_of

_OWN = ("name", "eyes", "flip", "relative_illumination", "mirror")  # keys of a camera that its calibration has not
_WMR, _RATIONAL = "CalibrationInformation", "CALIBRATION_LensDistortionModelRational6KT"
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_TANGENTIAL_PX = 0.1  # largest error that the tangential terms of those headsets may cause


class UnitCalibration(Spec):
    """File of a device's calibration, and the place of the device in the world: x_world = R x_device + t."""

    file: Annotated[str, Field(min_length=1)] = Field(description="path, relative to the scene")
    R: Matrix3 = Field(default=_IDENTITY, description="rotation, device to world")
    t_mm: Vec3 = Field(default=(0, 0, 0), description="translation, device to world: the device's origin in the world")
    unit_mm: Positive = Field(default=1.0, description="the file's unit of length; files of Windows are in metres")
    eyes: Annotated[tuple[EyeNames, ...], Field(min_length=1)] | None = Field(
        default=None, description="the eyes that each camera of the file sees, in its order, if it does not say so"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not is_rotation(self.R):
            mirror = np.linalg.det(self.R) < 0
            raise ValueError("R must be a rotation matrix" + (" (its determinant is -1: a mirror)" if mirror else ""))
        return self

    def read(self, base: Path | None = None) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Read the cameras and the LEDs of the device, with the keys of a rig, in the world.

        Raises:
            InputError: the file cannot be read; the message names the key.
        """
        path = (base or Path()) / self.file
        source, text = str(path), read_text(path, limit=MAX_YAML_BYTES)
        start = text.lstrip("\ufeff").lstrip()
        if start.startswith("-"):
            text = f"cameras:\n{start}"
        data: Any = parse_json(start, source=source) if start[:1] in "[{" else parse_yaml(text, source)
        data = {"cameras": data} if isinstance(data, list) else data
        if _WMR in data:
            data = {"cameras": [_of_windows(one, source, k) for k, one in enumerate(_listed(data[_WMR], source))]}
            return self.model_copy(update={"unit_mm": 1.0})._placed(data, source)
        return self._placed(data, source)

    def _placed(self, data: Mapping[str, Any], source: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Move cameras and LEDs of the device to the world."""
        cameras = [self._camera(one, source, f"cameras.{k}") for k, one in enumerate(_listed(data, source))]
        if self.eyes is not None:
            if (count := len(cameras)) != len(self.eyes):
                raise InputError(f"needs {count} entries, one per camera of {self.file}", path="rig.calibration.eyes")
            cameras = [{**camera, "eyes": eyes} for camera, eyes in zip(cameras, self.eyes, strict=True)]
        if unknown := sorted(map(str, data.keys() - {"cameras", "leds"})):
            raise InputError("unknown key; a device has cameras and leds", source=source, path=unknown[0])
        leds = data.get("leds") or []
        if not isinstance(leds, list):
            raise InputError("must be a list", source=source, path="leds")
        return cameras, [self._led(one, source, f"leds.{k}") for k, one in enumerate(leds)]

    def _camera(self, given: Any, source: str, path: str) -> dict[str, Any]:
        if not isinstance(given, dict):
            raise InputError("must be a mapping", source=source, path=path)
        own: dict[str, Any] = {key: given[key] for key in _OWN if key in given}
        rest = {str(key): value for key, value in given.items() if key not in (*_OWN, "valid_radius")}
        try:
            found = calibration_of(rest, "")
            if found.R is None or found.t is None or found.size_px is None:
                raise InputError(f"needs {'an image size' if found.size_px is None else 'a pose, R and t'}")
        except InputError as error:
            raise error.placed(source=source, under=path) from None
        R = np.array(self.R)
        calibration = {"K": found.K, "R": found.R @ R.T, "t_mm": found.t * self.unit_mm - found.R @ R.T @ self.t_mm}
        calibration |= {"distortion": distortion_data(found.distortion), "valid_radius": given.get("valid_radius")}
        if isinstance(mirror := own.get("mirror"), Mapping):
            point = self._point(mirror.get("point_mm"), source, f"{path}.mirror.point_mm")
            normal = _vector(mirror.get("normal"), source, f"{path}.mirror.normal")
            own["mirror"] = {**mirror, "point_mm": point, "normal": rotated(R, normal)}
            if isinstance(corners := mirror.get("outline_mm"), list):
                outline = [self._point(corner, source, f"{path}.mirror.outline_mm") for corner in corners]
                own["mirror"]["outline_mm"] = outline
        return {"resolution_px": found.size_px, **own, "calibration": calibration}

    def _led(self, given: Any, source: str, path: str) -> dict[str, Any]:
        led = dict(given) if isinstance(given, Mapping) else {"position_mm": given}
        for key in ("position_mm", "aim_mm"):
            if led.get(key, NEAREST_EYE) != NEAREST_EYE:
                led[key] = self._point(led[key], source, f"{path}.{key}")
        return led

    def _point(self, given: Any, source: str, path: str) -> Floats:
        return np.asarray(rotated(np.array(self.R), _vector(given, source, path) * self.unit_mm) + self.t_mm)


def write_unit(path: str | Path, rig: Any, *, R: ArrayLike = _IDENTITY, t_mm: ArrayLike = (0.0, 0.0, 0.0)) -> None:
    """Write the cameras and the LEDs of an authored `Rig` as the file of a device, JSON or YAML by its suffix.

    The rig's mount is left out, and rings become single LEDs. R and t_mm lead from the device to the world.
    """
    turn, shift = np.asarray(R, dtype=float), np.asarray(t_mm, dtype=float)

    def inside(point: ArrayLike) -> list[float]:
        return list(rotated(turn.T, np.asarray(point, dtype=float) - shift).tolist())

    cameras, leds = [], []
    for spec in rig.cameras:
        camera, own = spec.unmirrored(), {key: value for key, value in spec.to_mapping().items() if key in _OWN}
        if "mirror" in own:
            normal = rotated(turn.T, np.array(own["mirror"]["normal"]))
            own["mirror"] = {"point_mm": inside(own["mirror"]["point_mm"]), "normal": normal.tolist()}
        placed = {"R": (camera.R @ turn).tolist(), "t": (camera.t + rotated(camera.R, shift)).tolist()}
        reach = {"valid_radius": camera.reach} if np.isfinite(camera.reach) else {}
        lens = {"K": camera.K.tolist(), "distortion": distortion_data(camera.distortion), **reach}
        cameras.append({**own, "image_size": list(camera.resolution_px), **lens, **placed})
    for led in rig.single_leds():
        keys = [key for key in ("position_mm", "aim_mm") if led[key] != NEAREST_EYE]
        leds.append({**led, **{key: inside(led[key]) for key in keys}})
    data = {"cameras": cameras, "leds": leds}
    is_yaml = Path(path).suffix.lower() in (".yaml", ".yml")
    write_text(path, yaml.safe_dump(data, sort_keys=False) if is_yaml else json.dumps(data, indent=1) + "\n")


def _listed(data: Any, source: str) -> Sequence[Any]:
    cameras = data.get("cameras", data.get("Cameras")) if isinstance(data, Mapping) else None
    if not isinstance(cameras, list) or not cameras:
        raise InputError("must be the list of the device's cameras", source=source, path="cameras")
    return cameras


def _vector(given: Any, source: str, path: str) -> Floats:
    numbers = isinstance(given, list | tuple) and all(isinstance(v, int | float) for v in given)
    if not numbers or len(given) != 3 or not np.all(np.abs(np.array(given, dtype=float)) <= 1e9):
        raise InputError("must be a vector of 3 numbers", source=source, path=path)
    return np.array(given, dtype=float)


def _of_windows(given: Any, source: str, k: int) -> dict[str, Any]:
    """Convert a camera of Windows Mixed Reality to the keys of this package.

    Its parameters are cx, cy, fx, fy, k1 to k6, the centre of distortion, p2, p1 and the radius of validity. The model
    is OpenCV's rational one with half of its terms in p x y: where this matters, the camera is refused.
    """
    path = f"{_WMR}.Cameras.{k}"
    try:
        width, height, lens, pose = (given[key] for key in ("SensorWidth", "SensorHeight", "Intrinsics", "Rt"))
        model, values = lens["ModelType"], np.array(lens["ModelParameters"], dtype=float)
        values, rotation = values.ravel(), np.array(pose["Rotation"], dtype=float).reshape(3, 3)
        translation = 1000 * np.array(pose["Translation"], dtype=float).reshape(3)
        radius = float(values[14]) if len(values) == 15 else float(given.get("MetricRadius") or 0.0)
        size, name = (int(width), int(height)), str(given.get("Location", f"camera {k}"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"is no camera of Windows Mixed Reality ({error})", source=source, path=path) from None
    if model != _RATIONAL or len(values) not in (14, 15):
        raise InputError(f"the model {shown(model)} is not supported; {_RATIONAL} is", source=source, path=path)
    if values[10] != 0 or values[11] != 0:
        raise InputError("a centre of distortion off the principal point is not supported", source=source, path=path)
    (cx, cy, fx, fy), (p2, p1) = values[:4] * np.tile(size, 2), values[12:14]
    error_px = max(abs(p1) * fx, abs(p2) * fy) * size[0] * size[1] / abs(4 * fx * fy)
    if not error_px <= _TANGENTIAL_PX:
        raise InputError("tangential terms as large as its p1, p2 are not supported", source=source, path=path)
    k1, k2, *k36 = values[4:10].tolist()
    K = [[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]]
    distortion = {"model": "rational", "coefficients": [k1, k2, float(p1), float(p2), *k36]}
    camera = {"name": name.rpartition("CameraLocation")[2], "image_size": list(size), "K": K, "distortion": distortion}
    pose_mm = {"R": rotation.tolist(), "t": translation.tolist()}
    return {**camera, **pose_mm, **({"valid_radius": radius} if radius > 0 else {})}
