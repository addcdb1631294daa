"""Cameras in OpenCV's convention, with lens distortion.

    x_cam = R x_world + t,   x' = x/z, y' = y/z,   (x'', y'') = distorted (x', y'),   u = fx x'' + cx, v = fy y'' + cy

Through a fisheye (x', y') = theta (x, y) / |(x, y)|, theta the angle from the optical axis (`distortion.py`). z is
forward, x right, y down; pixel centres are at integers. At rest (no pan, tilt, roll) a camera looks along -x, towards
the subject, with +z up in the image.

A camera that looks at a plane mirror (the hot mirror of a headset) takes the picture of its mirror image behind the
plane, turned left to right. The mirror image of a point is X' = S X + s with S = 1 - 2 n n^T and s = 2 (n . p) n, so
the camera R, t sees S X + s at R S X + (R s + t). R S has the determinant -1. With F = diag(-1, 1, 1), the virtual
camera F R S, F (R s + t) is a proper one, and its x' is that of the sensor with the other sign.

A picture that is stored turned left to right, u -> W - 1 - u, is that of a camera with the other sign of x', with the
principal point at W - 1 - cx and the other sign of p2. So features need no further case.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from ..base.arrays import ArrayValue, Bools, Floats, frozen
from ..base.errors import InputError
from ..base.spec import NonNegative, Number, Positive, Side, Spec, Vec2, Vec3
from ..optics.transforms import rotated
from .distortion import (
    FARTHEST_RAD,
    Distortion,
    coefficients_of,
    distort,
    distorted_area,
    distortion_data,
    fold_radius,
    is_distorted,
    is_fisheye,
    is_imaged,
    undistort,
)
from .mirror import Mirror as Mirror
from .mirror import MirrorPlate
from .opencv import read_opencv
from .timing import DEFAULT_RATE_HZ, FrameTimes, Interlaced, Rolling, Shutter

Matrix3 = tuple[Vec3, Vec3, Vec3]
Pixels = Annotated[int, Field(gt=0, le=65536)]
Window = tuple[int, int, int, int]
"""A part of a sensor: its first column and row, its width and its height (px)."""


def _distinct(eyes: tuple[Side, ...]) -> tuple[Side, ...]:
    if len(set(eyes)) != len(eyes):
        raise ValueError("name each eye only once")
    return eyes


EyeNames = Annotated[tuple[Side, ...], Field(min_length=1, max_length=2), AfterValidator(_distinct)]


def _rising(table: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    angles = np.array(table)[:, 0]
    if angles[0] != 0 or np.any(np.diff(angles) <= 0) or angles[-1] > 180:
        raise ValueError("angles must rise from 0 to at most 180 degrees")
    return table


RelativeIllumination = Annotated[
    tuple[tuple[Number, NonNegative], ...], Field(min_length=2, max_length=1000), AfterValidator(_rising)
]
_DISTORTION = "lens: k1, k2, p1, p2, k3 (OpenCV); or a `fisheye` or `rational` model"


def serves(eyes: Sequence[str] | None, side: str) -> bool:
    """Return whether a camera or an LED with these `eyes` (None: both) serves an eye, right or left."""
    return eyes is None or side in eyes


_PLACE = {"position_mm", "look_at_mm", "pan_deg", "tilt_deg"}
_TIMES = ("frame_rate_hz", "phase_ms", "clock_ppm", "shutter")
_LENS = {"focal_length_px", "focal_length_mm", "sensor_mm", "principal_point_px"}
# The columns are the camera's right, down and forward axes at rest, in the world (x to the screen, y left, z up).
_REST = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def is_rotation(R: ArrayLike) -> bool:
    """Return whether a matrix (3, 3) is a rotation, to 1e-6."""
    m = np.array(R)
    return np.allclose(m @ m.T, np.eye(3), atol=1e-6) and bool(np.linalg.det(m) > 0)


class CameraCalibration(Spec):
    """Calibration of a camera in OpenCV's form: x_cam = R x_world + t."""

    K: Matrix3 = Field(description="camera matrix, px")
    R: Matrix3 = Field(description="rotation, world to camera")
    t_mm: Vec3 = Field(description="translation, world to camera")
    distortion: Distortion = Field(default=(0, 0, 0, 0, 0), description=_DISTORTION)
    valid_radius: Positive | None = Field(
        default=None, description="radius sqrt(x'^2 + y'^2) without distortion up to which the lens was measured"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not is_rotation(self.R):
            raise ValueError("R must be a rotation matrix")
        K = np.array(self.K)
        if K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0 or K[2, 2] != 1 or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError("K must be upper triangular with positive focal lengths and K[2][2] = 1")
        if K[0, 1] != 0:
            raise ValueError("K has a skew term, which OpenCV's camera model does not support")
        return self


class CalibrationFile(Spec):
    """Path of a calibration file of OpenCV (`cv2.FileStorage`: YAML, XML or JSON), ROS (`camera_info`) or Kalibr."""

    file: Annotated[str, Field(min_length=1)] = Field(description="path, relative to the scene")
    unit_mm: Positive = Field(default=1.0, description="length of the file's unit of translation")
    camera: str | None = Field(default=None, description="key of the camera, in a file of several (Kalibr's cam0)")


def _calibration_tag(value: Any) -> str:
    named = isinstance(value, CalibrationFile) or (isinstance(value, Mapping) and "file" in value)
    return "[file]" if named else "[numbers]"


AnyCalibration = Annotated[
    Annotated[CameraCalibration, Tag("[numbers]")] | Annotated[CalibrationFile, Tag("[file]")],
    Discriminator(_calibration_tag),
]


class Camera(Spec):
    """A camera, given by position, direction and focal length, or by `calibration`.

    >>> camera = er.Camera.looking_at((0, 0, 0), position_mm=(600, 0, -150), focal_length_px=4000, size_px=(640, 480))
    >>> camera.build().project([0.0, 0.0, 0.0])
    (array([319.5, 239.5]), np.True_)
    """

    name: str = Field(default="camera", description="name of the camera, for records and reports")
    resolution_px: tuple[Pixels, Pixels] = Field(description="sensor width and height")
    position_mm: Vec3 | None = Field(default=None, description="nodal point in the world")
    look_at_mm: Vec3 | None = Field(default=None, description="world point on the optical axis")
    pan_deg: Number | None = Field(default=None, description="angle of the optical axis from -x to the subject's left")
    tilt_deg: Number | None = Field(default=None, description="angle of the optical axis upwards from -x")
    roll_deg: Number = Field(default=0.0, description="positive roll turns the image content counter-clockwise")
    focal_length_px: Positive | None = Field(
        default=None, description="focal length in pixels; give this, or `focal_length_mm` and `sensor_mm`"
    )
    focal_length_mm: Positive | None = Field(default=None, description="focal length; `sensor_mm` belongs to it")
    sensor_mm: tuple[Positive, Positive] | None = Field(default=None, description="sensor width and height")
    principal_point_px: Vec2 | None = Field(default=None, description="default: the centre of the sensor")
    distortion: Distortion = Field(default=(0, 0, 0, 0, 0), description=_DISTORTION)
    relative_illumination: RelativeIllumination | None = Field(
        default=None,
        description="pairs of angle from the optical axis (deg) and illumination of the sensor relative to the axis, "
        "from the lens' data sheet, with straight lines between them; default: the fall-off of the lens' projection, "
        "which is cos^4 without distortion",
    )
    calibration: AnyCalibration | None = Field(
        default=None,
        description="OpenCV's calibration, in place of position, direction and lens; beside a calibration file, "
        "position and direction replace the pose of the file",
    )
    mirror: Mirror | None = Field(
        default=None,
        description="plane mirror (a hot mirror) through which it sees the eyes; place, direction and calibration are "
        "those of the camera itself",
    )
    eyes: EyeNames | None = Field(
        default=None, description="eyes that it sees; it has no frames of the other eye; default: both"
    )
    flip: Literal["horizontal"] | None = Field(
        default=None, description="turns the stored picture left to right, after everything else"
    )
    frame_rate_hz: Annotated[float, Field(ge=0.01, le=1e5)] | None = Field(
        default=None, description="frames per second, with a `sequence`; default: 60"
    )
    phase_ms: Annotated[float, Field(ge=0, le=1e6)] | None = Field(
        default=None, description="start of the first frame's exposure, with a `sequence`; default: 0"
    )
    clock_ppm: Annotated[float, Field(ge=-1e4, le=1e4)] | None = Field(
        default=None, description="how much faster its clock runs than the true one, parts per million; default: 0"
    )
    shutter: Shutter | None = Field(
        default=None,
        description="`global`: all rows are exposed at once; `{rolling: {row_us: R}}`: one after the other, visible "
        "with a `sequence`; or `{interlaced: {delay_ms: D}}`: odd rows later; default: global",
    )

    @classmethod
    def from_opencv(
        cls,
        path: str | Path,
        *,
        size_px: tuple[int, int] | None = None,
        unit_mm: float = 1.0,
        camera: str | None = None,
        **fields: Any,
    ) -> Self:
        """Read a camera from a calibration file of OpenCV (`cv2.FileStorage`), ROS, Kalibr (one camera) or a script.

        The file holds a camera matrix, distortion coefficients and, optionally, the image size and the pose (R and T,
        or rvec and tvec) in the world of this package: x_cam = R x_world + t.

        Args:
            path: the file.
            size_px: width and height of the image, if the file does not state them.
            unit_mm: the file's unit of length in mm.
            camera: key of the camera, in a file of several (Kalibr's cam0).
            fields: `name`; instead of the file's pose, `position_mm`, `look_at_mm`, `pan_deg`, `tilt_deg`, `roll_deg`.

        Raises:
            InputError: the file cannot be read, lacks a value, uses an unsupported distortion model, or has a key that
                may describe the lens and is not read.
        """
        size = size_px or read_opencv(path, camera).size_px
        if size is None:
            raise InputError("does not say the size of the image; give size_px", source=str(path))
        calibration = {"file": str(path), "unit_mm": unit_mm, "camera": camera}
        return cls.from_mapping({"resolution_px": size, "calibration": calibration, **fields}).resolved()

    def resolved(self, base: Path | None = None) -> Self:
        """Return the camera with its calibration file read in; the path is relative to `base` or the current folder.

        Raises:
            InputError: the file cannot be read, or does not fit the camera.
        """
        if not isinstance(self.calibration, CalibrationFile):
            return self
        path = (base or Path()) / self.calibration.file
        found = read_opencv(path, self.calibration.camera)
        if found.size_px not in (None, self.resolution_px):
            raise InputError(
                f"is for {found.size_px} px, but resolution_px of the camera is {self.resolution_px}", source=str(path)
            )
        if self.position_mm is not None:
            placed = self.model_copy(update={"calibration": None, "focal_length_px": 1.0}).unmirrored()
            R, t = placed.R, placed.t
        elif found.R is None or found.t is None:
            raise InputError("holds no pose; give position_mm and look_at_mm of the camera", source=str(path))
        else:
            R, t = found.R, found.t * self.calibration.unit_mm
        numbers = {"K": found.K, "R": R, "t_mm": t, "distortion": distortion_data(found.distortion)}
        names = ("name", "resolution_px", "mirror", "eyes", "flip", "relative_illumination", *_TIMES)
        kept = {name: getattr(self, name) for name in names}
        return type(self).from_mapping({**kept, "calibration": numbers}, source=str(path))

    @classmethod
    def looking_at(
        cls,
        point_mm: ArrayLike,
        *,
        position_mm: ArrayLike,
        size_px: tuple[int, int],
        focal_length_px: float | None = None,
        **fields: Any,
    ) -> Self:
        """Create a camera at a position, aimed at a point.

        Args:
            point_mm: (3,) world point on the optical axis.
            position_mm: (3,) nodal point in the world.
            size_px: width and height of the sensor (`resolution_px`).
            focal_length_px: focal length in pixels; without it, give `focal_length_mm` and `sensor_mm`.
            fields: further fields of the camera.

        Raises:
            InputError: a value does not fit.
        """
        placed = {"look_at_mm": point_mm, "position_mm": position_mm, "resolution_px": size_px}
        return cls.from_mapping({**placed, "focal_length_px": focal_length_px, **fields})

    @model_validator(mode="after")
    def _check(self) -> Self:
        placed = {name for name in (*_PLACE, *_LENS) if getattr(self, name) is not None}
        if isinstance(self.calibration, CalibrationFile):
            wrong = sorted(placed & _LENS)
            if wrong or is_distorted(coefficients_of(self.distortion)):
                raise ValueError(f"the calibration file gives the lens; remove {', '.join(wrong) or 'distortion'}")
            if self.position_mm is None and (placed or self.roll_deg != 0):
                raise ValueError("give position_mm with the direction, or neither")
            return self._checked_direction()
        if self.calibration is not None:
            if placed or self.roll_deg != 0 or is_distorted(coefficients_of(self.distortion)):
                raise ValueError("a calibration gives position, direction and lens; remove the other keys")
            return self
        if self.position_mm is None:
            raise ValueError("give position_mm (or a calibration)")
        self._checked_direction()
        if (self.focal_length_px is None) == (self.focal_length_mm is None):
            raise ValueError("give either focal_length_px or focal_length_mm with sensor_mm")
        if (self.focal_length_mm is None) != (self.sensor_mm is None):
            raise ValueError("focal_length_mm and sensor_mm belong together")
        return self

    def _checked_direction(self) -> Self:
        if self.look_at_mm is not None and (self.pan_deg is not None or self.tilt_deg is not None):
            raise ValueError("give look_at_mm or pan_deg and tilt_deg, not both")
        if self.look_at_mm is not None and np.allclose(self.look_at_mm, self.position_mm or np.inf, atol=1e-6):
            raise ValueError("look_at_mm is the camera's own position")
        return self

    def build(self) -> PinholeCamera:
        """Build the numeric camera; for a camera that looks into a mirror, the virtual camera behind it.

        Raises:
            InputError: the camera lies in the plane of its mirror, or its calibration file cannot be read.
        """
        table = None if self.relative_illumination is None else frozen(self.relative_illumination)
        camera = replace(self.unmirrored(), eyes=self.eyes, relative_illumination=table)
        camera = camera if self.mirror is None else camera.seen_in(self.mirror)
        return camera if self.flip is None else camera.flipped()

    def timing(self, exposure_s: float, pulses_s: Floats) -> FrameTimes:
        """Return the times of its frames; `pulses_s` (m, 2) are the start and end of each light's pulse in a frame."""
        rolling = self.shutter.rolling.row_us * 1e-6 if isinstance(self.shutter, Rolling) else 0.0
        rate = self.frame_rate_hz or DEFAULT_RATE_HZ
        return FrameTimes(
            rate_hz=rate,
            period_s=1.0 / (rate * (1.0 + (self.clock_ppm or 0.0) * 1e-6)),
            phase_s=(self.phase_ms or 0.0) * 1e-3,
            exposure_s=exposure_s,
            row_s=rolling,
            rows=self.resolution_px[1],
            pulses_s=pulses_s,
            field_delay_s=self.shutter.interlaced.delay_ms * 1e-3 if isinstance(self.shutter, Interlaced) else 0.0,
        )

    def unmirrored(self) -> PinholeCamera:
        """Build the numeric camera at its real position, without the mirror."""
        if isinstance(self.calibration, CalibrationFile):
            return self.resolved().unmirrored()
        if self.calibration is not None:
            c = self.calibration
            camera = PinholeCamera.of(c.K, c.R, c.t_mm, self.resolution_px, c.distortion, self.name)
            return replace(camera, reach=c.valid_radius or np.inf)
        width, height = self.resolution_px
        if self.focal_length_px is not None:
            fx = fy = self.focal_length_px
        else:
            assert self.focal_length_mm is not None
            assert self.sensor_mm is not None
            fx = self.focal_length_mm * width / self.sensor_mm[0]
            fy = self.focal_length_mm * height / self.sensor_mm[1]
        cx, cy = self.principal_point_px or ((width - 1) / 2, (height - 1) / 2)
        position = np.array(self.position_mm, dtype=float)
        if self.look_at_mm is not None:
            axes = facing(np.array(self.look_at_mm, dtype=float) - position)
        else:
            axes = _turned(np.radians(self.pan_deg or 0.0), np.radians(self.tilt_deg or 0.0))
        roll = np.radians(self.roll_deg)
        turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]])
        R = (axes @ turn).T
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return PinholeCamera.of(K, R, -rotated(R, position), self.resolution_px, self.distortion, self.name)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PinholeCamera(ArrayValue):
    """A camera with one centre of projection: a pinhole with lens distortion, or a fisheye.

    Attributes:
        K: (3, 3) camera matrix, px.
        R: (3, 3) rotation, world to camera.
        t: (3,) translation, world to camera, mm.
        distortion: coefficients (5,), (6,) or (8,) of a model of `distortion.py`.
        resolution_px: (w, h).
        name: name of the camera.
        mirrored: whether it is the virtual camera behind a plane mirror: u is flipped about the principal point.
        eyes: eyes that it sees; None: both.
        flip: whether the stored picture is turned left to right. K, distortion and `mirrored` are then those of the
            stored picture; `unflipped` is the camera before the flip.
        relative_illumination: (n, 2) angles from the axis (deg) and shares, in place of the projection's fall-off.
        reach: radius of the coordinates of `plane` up to which the lens was measured; beyond it there is no picture.
        mirror: the mirror behind which it is, in its own frame.
    """

    K: Floats
    R: Floats
    t: Floats
    distortion: Floats
    resolution_px: tuple[int, int]
    name: str
    mirrored: bool = False
    eyes: tuple[Side, ...] | None = None
    flip: bool = False
    relative_illumination: Floats | None = None
    reach: float = np.inf
    mirror: MirrorPlate | None = None

    @classmethod
    def of(
        cls,
        K: ArrayLike,
        R: ArrayLike,
        t: ArrayLike,
        resolution_px: tuple[int, int],
        distortion: Any = (0, 0, 0, 0, 0),
        name: str = "camera",
    ) -> PinholeCamera:
        """Create a camera from array-like values; the distortion may have the form of scenes and JSON."""
        K, R, t, k = frozen(K), frozen(R), frozen(t), coefficients_of(distortion)
        return cls(K=K, R=R, t=t, distortion=k, resolution_px=resolution_px, name=name)

    @classmethod
    def from_labels(cls, data: Mapping[str, Any]) -> PinholeCamera:
        """Create the camera of an image from `labels.camera`."""
        width, height = data.get("resolution_px") or (1, 1)
        camera = cls.of(data["K"], data["R"], data["t_mm"], (width, height), data.get("distortion") or (0, 0, 0, 0, 0))
        camera = replace(camera, mirrored=data.get("mirrored") is True)
        return camera.flipped() if data.get("flip") else camera

    def to_mapping(self, translation: str = "t") -> dict[str, Any]:
        """Return the numbers of a camera in JSON, those before a flip; `translation` is the key of t."""
        own = self.unflipped
        return {
            "K": own.K.tolist(),
            "R": own.R.tolist(),
            translation: own.t.tolist(),
            "distortion": distortion_data(own.distortion),
            "resolution_px": list(own.resolution_px),
            "mirrored": own.mirrored or None,
            "flip": "horizontal" if self.flip else None,
        }

    def flipped(self) -> PinholeCamera:
        """Return the camera whose pictures are those of this one turned left to right: u -> W - 1 - u."""
        K, k = self.K.copy(), self.distortion.copy()
        K[0, 2] = self.resolution_px[0] - 1 - K[0, 2]
        p2 = 5 if self.is_fisheye else 3
        k[p2] = 0.0 - k[p2]
        return replace(self, K=frozen(K), distortion=frozen(k), mirrored=not self.mirrored, flip=not self.flip)

    def turned(self, window: Window) -> Window:
        """Return a window of the picture turned left to right, which shows the same."""
        x0, y0, width, height = window
        return self.resolution_px[0] - x0 - width, y0, width, height

    @property
    def unflipped(self) -> PinholeCamera:
        """The camera before its picture is turned left to right."""
        return self.flipped() if self.flip else self

    @property
    def is_fisheye(self) -> bool:
        """Whether the lens is a fisheye, which images directions up to 110 degrees from its axis."""
        return is_fisheye(self.distortion)

    def seen_in(self, mirror: Mirror) -> PinholeCamera:
        """Return the virtual camera behind a mirror, whose images equal those of this camera through the mirror.

        Raises:
            InputError: the camera lies in the plane.
        """
        normal, offset = mirror.plane
        if abs(float(normal @ self.nodal_point_mm) - offset) < 1e-6:
            raise InputError("lies in the plane of its mirror", path=f"camera {self.name!r}")
        reflect = np.eye(3) - 2.0 * np.outer(normal, normal)
        flip = np.array([-1.0, 1.0, 1.0])
        t = flip * (rotated(self.R, 2.0 * offset * normal) + self.t)
        R = flip[:, None] * (self.R @ reflect)
        return replace(self, R=frozen(R), t=frozen(t), mirrored=not self.mirrored, mirror=mirror.plate(R, t))

    def sees(self, side: str) -> bool:
        """Return whether the camera sees an eye, right or left."""
        return serves(self.eyes, side)

    @property
    def across(self) -> float:
        """Sign of x on the sensor: -1 if a mirror turns the image left to right, else 1."""
        return -1.0 if self.mirrored else 1.0

    @property
    def sensor_axes(self) -> Floats:
        """Right, down and forward axes of the image in the world, rows (3, 3): R, or left-handed behind a mirror."""
        return np.asarray(self.R * np.array([[self.across], [1.0], [1.0]])) if self.mirrored else self.R

    @property
    def sensor_offset(self) -> Floats:
        """Offset o (3,) mm of the image's frame, x = sensor_axes x_world + o: t, or with the other sign of x."""
        return np.asarray(self.t * np.array([self.across, 1.0, 1.0])) if self.mirrored else self.t

    @property
    def nodal_point_mm(self) -> Floats:
        """Centre of projection in the world, (3,) mm: -R^T t."""
        return np.asarray(-rotated(self.R.T, self.t))

    @property
    def axis(self) -> Floats:
        """Optical axis, a unit vector (3,) in the world."""
        return np.array(self.R[2], dtype=np.float64)

    def project(self, points_mm: ArrayLike) -> tuple[Floats, Bools]:
        """Project world points into the image.

        Args:
            points_mm: (..., 3) mm, world.

        Returns:
            Pixels (..., 2), NaN where there is no image, and whether the point is in front of the camera (...): z > 0,
            or less than 110 degrees from the axis of a fisheye.
        """
        x, y, front = self.plane(np.asarray(points_mm, dtype=float) @ self.R.T + self.t)
        return self.pixels_of(x, y), front

    def plane(self, points: Floats) -> tuple[Floats, Floats, Bools]:
        """Compute the coordinates that the distortion maps, from points or directions (..., 3) in the camera's frame.

        Returns:
            x and y (...): X/Z and Y/Z, or for a fisheye the angle from the axis times the unit vector along (X, Y); NaN
            where the lens has no image; and whether it has one (...).
        """
        x, y, z = (points[..., k] for k in range(3))
        if not self.is_fisheye:
            front = z > 0
            z = np.where(front, z, np.nan)
            return x / z, y / z, front
        across = np.hypot(x, y)
        angle = np.arctan2(across, z)
        front = angle <= FARTHEST_RAD
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(front, np.where(across > 0, angle / across, 1 / z), np.nan)
        return scale * x, scale * y, front

    def pixels_of(self, x: Floats, y: Floats) -> Floats:
        """Compute pixels (..., 2) from the coordinates of `plane`."""
        x = self.across * x
        if is_distorted(self.distortion):
            x, y = distort(x, y, self.distortion)
        return np.stack([self.K[0, 0] * x + self.K[0, 2], self.K[1, 1] * y + self.K[1, 2]], axis=-1)

    def scale_at(self, point_mm: ArrayLike) -> float:
        """Compute the image scale at a world point (3,) mm, across the line of sight, in pixels per mm."""
        distance = float(np.linalg.norm(np.asarray(point_mm, dtype=float) - self.nodal_point_mm))
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1])) / distance

    def undistorted(self, pixels: ArrayLike) -> tuple[Floats, Floats]:
        """Compute the coordinates of `plane` (with the image's sign of x) from pixels (..., 2); NaN without a ray."""
        p = np.asarray(pixels, dtype=float)
        x = (p[..., 0] - self.K[0, 2]) / self.K[0, 0]
        y = (p[..., 1] - self.K[1, 2]) / self.K[1, 1]
        return undistort(x, y, self.distortion) if is_distorted(self.distortion) else (x, y)

    def rays(self, pixels: ArrayLike) -> Floats:
        """Compute unit directions (..., 3) in the world, out of the camera, through pixels (..., 2)."""
        x, y = self.undistorted(pixels)
        if self.is_fisheye:
            angle = np.hypot(x, y)
            share = np.sinc(angle / np.pi)
            return np.asarray(np.stack([share * x, share * y, np.cos(angle)], axis=-1) @ self.sensor_axes)
        d = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.sensor_axes
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def flattened(self, pixel: ArrayLike) -> PinholeCamera:
        """Return a camera without distortion, whose pixels `ideal` gives; a fisheye's looks along a pixel's ray."""
        flat = replace(self, distortion=frozen(np.zeros(5)), mirror=None)
        if not self.is_fisheye:
            return flat
        R = facing(self.rays(pixel)).T
        return replace(flat, R=frozen(R), t=frozen(-rotated(R, self.nodal_point_mm)), mirrored=False)

    def ideal(self, pixels: ArrayLike, flat: PinholeCamera | None = None) -> Floats:
        """Remove the lens distortion from pixels (..., 2); for a fisheye, return those of the camera `flat`."""
        if not is_distorted(self.distortion):
            return np.asarray(pixels, dtype=float)
        if flat is not None and self.is_fisheye:
            return flat.project(self.nodal_point_mm + self.rays(pixels))[0]
        x, y = self.undistorted(pixels)
        return np.stack([self.K[0, 0] * x + self.K[0, 2], self.K[1, 1] * y + self.K[1, 2]], axis=-1)

    def depth(self, points_mm: ArrayLike) -> Floats:
        """Compute the depth (...) of world points (..., 3): mm along the axis, for a fisheye mm from the camera."""
        points = np.asarray(points_mm, dtype=float)
        if self.is_fisheye:
            return np.asarray(np.linalg.norm(points - self.nodal_point_mm, axis=-1))
        return np.asarray(points @ self.R[2] + self.t[2])

    def stretch(self, cosine: Floats) -> Floats:
        """Compute the area in `plane` per solid angle from cosines to the axis: 1 / cos^3, or theta / sin theta."""
        return np.asarray(1 / np.sinc(np.arccos(np.clip(cosine, -1, 1)) / np.pi) if self.is_fisheye else 1 / cosine**3)

    def glint_falloff(self, pixels: Floats) -> Floats:
        """Compute the share of a point's light at pixels (n, 2), per light that `stretch` spreads there.

        The aperture appears by the cosine narrower, so it is cos^4, or cos(theta) sin(theta) / theta of a fisheye. With
        `relative_illumination`, which multiplies the whole picture, it is the distortion's area D.
        """
        if self.relative_illumination is not None:
            return np.asarray(distorted_area(*self.undistorted(pixels), self.distortion))
        cosine = self.rays(pixels) @ self.axis
        return np.asarray(np.maximum(cosine, 0) / self.stretch(cosine) if self.is_fisheye else cosine**4)

    def illumination(self, window: Window) -> Floats:
        """Compute the relative illumination (h, w) of a window's pixels by `relative_illumination`."""
        assert self.relative_illumination is not None
        x0, y0, width, height = window
        v, u = np.mgrid[y0 : y0 + height, x0 : x0 + width]
        angle = np.degrees(np.arccos(np.clip(self.rays(np.stack([u, v], axis=-1)) @ self.axis, -1, 1)))
        return np.asarray(np.nan_to_num(np.interp(angle, *self.relative_illumination.T)))

    def light_shares(self, point_mm: ArrayLike) -> tuple[float, float]:
        """Return the light of a surface and of a point at a world point (3,) mm, relative to the lens' axis.

        They are those of a fisheye, or of a lens with `relative_illumination`; 1 for others, which are aimed at eyes.
        A mirror reduces them.
        """
        mirrored = 1.0 if self.mirror is None else self.mirror.reflectance
        if not self.is_fisheye and self.relative_illumination is None:
            return mirrored, mirrored
        way = rotated(self.R, np.asarray(point_mm, dtype=float) - self.nodal_point_mm)
        cosine = float(way[2] / np.linalg.norm(way))
        x, y, _ = self.plane(way)
        area = float(self.stretch(np.array(cosine)) * distorted_area(self.across * x, y, self.distortion))
        share = mirrored * max(cosine, 0.0) / area
        if self.relative_illumination is not None:
            share = mirrored * float(
                np.interp(np.degrees(np.arccos(np.clip(cosine, -1, 1))), *self.relative_illumination.T)
            )
        return share, share * area

    def corners(self, window: Window, depth_mm: float) -> Floats:
        """Compute the corners (5, 3) in the world of a window at a depth (see `depth`), closed.

        Corners without a ray are moved towards the principal point.
        """
        x0, y0, w, h = window
        left, top, right, bottom = x0 - 0.5, y0 - 0.5, x0 + w - 0.5, y0 + h - 0.5
        off = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]) - self.K[:2, 2]
        size = np.hypot(*(off / np.diag(self.K)[:2]).T)
        off *= np.minimum(0.99 * self.fold[1] / np.maximum(size, 1e-9), 1.0)[:, None] if self.fold[1] < np.inf else 1.0
        rays = self.rays(off + self.K[:2, 2])
        along = np.ones(5) if self.is_fisheye else rays @ self.axis
        return np.asarray(self.nodal_point_mm + depth_mm * rays / along[:, None])

    def is_imaged(self, x: Floats, y: Floats) -> Bools:
        """Return whether the distortion is invertible at coordinates of `plane` (not folded back)."""
        return np.asarray(is_imaged(self.across * x, y, self.distortion))

    @property
    def fold(self) -> tuple[float, float]:
        """Radius beyond which a radial distortion images nothing, without and with it; inf if it images everything."""
        return fold_radius(tuple(self.distortion.tolist()), self.reach)

    def without_rays(self, window: Window) -> Bools | None:
        """Return which pixels (h, w) of a window lie beyond the fold of the lens; None if none does."""
        reach, (x0, y0, width, height) = self.fold[1], window
        x = (np.arange(x0, x0 + width) - self.K[0, 2]) / self.K[0, 0]
        y = (np.arange(y0, y0 + height) - self.K[1, 2]) / self.K[1, 1]
        if np.hypot(np.abs(x).max(), np.abs(y).max()) <= reach:
            return None
        return np.asarray(np.hypot(x[None, :], y[:, None]) > reach)

    def beside_mirror(self, pixels: Floats) -> Bools | None:
        """Return which pixels (..., 2) have rays that miss the outline of the mirror; None without an outline."""
        if self.mirror is None or self.mirror.corners_mm is None:
            return None
        return ~self.mirror.holds(self.rays(pixels) @ self.R.T)

    def dark(self, window: Window) -> Bools | None:
        """Return which pixels (h, w) of a window get no light: without a ray, or past the mirror; None if all do."""
        beyond, (x0, y0, width, height) = self.without_rays(window), window
        if self.mirror is None or self.mirror.corners_mm is None:
            return beyond
        v, u = np.mgrid[y0 : y0 + height, x0 : x0 + width]
        beside = ~self.mirror.holds(self.rays(np.stack([u, v], axis=-1)) @ self.R.T)
        return beside if beyond is None else np.asarray(beyond | beside)

    def in_image(self, pixels: ArrayLike) -> Bools:
        """Return whether pixels (..., 2) lie on the sensor, which ends half a pixel beyond its outer pixel centres."""
        return in_window((0, 0, *self.resolution_px), pixels)


def in_window(window: Window, pixels: ArrayLike) -> Bools:
    """Return whether pixels (..., 2) lie in a window (x0, y0, width, height), including half a pixel of border."""
    p = np.asarray(pixels, dtype=float)
    x, y, (x0, y0, w, h) = p[..., 0], p[..., 1], window
    return np.asarray((x >= x0 - 0.5) & (x <= x0 + w - 0.5) & (y >= y0 - 0.5) & (y <= y0 + h - 0.5))


def beyond_window(window: Window, pixels: Floats) -> float:
    """Return how far (px) the farthest of pixels (n, 2) lies outside a window along an axis; 0 if none does."""
    low = np.array(window[:2]) - 0.5
    return float(np.maximum(low - pixels, pixels - (low + window[2:])).max(initial=0.0))


def _turned(pan: float, tilt: float) -> Floats:
    """Return camera axes as columns: tilted about the right axis, then panned about the world's vertical."""
    ct, st, cp, sp = np.cos(tilt), np.sin(tilt), np.cos(pan), np.sin(pan)
    about_right = np.array([[1.0, 0, 0], [0, ct, -st], [0, st, ct]])
    # The rest direction is -x, so a pan to the subject's left (+y) is a negative turn about +z.
    about_up = np.array([[cp, sp, 0], [-sp, cp, 0], [0, 0, 1.0]])
    return np.asarray(about_up @ _REST @ about_right)


def facing(direction: Floats) -> Floats:
    """Return camera axes as columns, looking along `direction` with the world's z up (its y when looking along z)."""
    forward = direction / np.linalg.norm(direction)
    up = np.array([0.0, 0, 1.0]) if abs(forward[2]) < 1 - 1e-9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return np.stack([right, down, forward], axis=1)
