"""Pinhole cameras in OpenCV's convention, with lens distortion.

    x_cam = R x_world + t,   x' = x/z, y' = y/z,   (x'', y'') = distorted (x', y'),   u = fx x'' + cx, v = fy y'' + cy

z forward, x right, y down; pixel centres at integers. At rest (no pan, tilt, roll) a camera looks along -x, towards the
subject, with +z up in the image.

A camera that looks at a plane mirror (the hot mirror of a headset) takes the picture of its mirror image behind the
plane, turned left to right. The mirror image of a point is X' = S X + s with S = 1 - 2 n n^T and s = 2 (n . p) n, so
the camera R, t sees S X + s at R S X + (R s + t). R S has the determinant -1. With F = diag(-1, 1, 1), the virtual
camera F R S, F (R s + t) is a proper one, and its x' is that of the sensor with the other sign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, model_validator

from ..base.arrays import ArrayValue, Bools, Floats, frozen
from ..base.errors import InputError
from ..base.spec import Number, Positive, Side, Spec, Vec2, Vec3
from ..base.storage.files import shown
from ..optics.transforms import rotated
from .opencv import read_opencv

Matrix3 = tuple[Vec3, Vec3, Vec3]


def _five(value: object) -> object:
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 5:
        raise ValueError(f"must be the five numbers [k1, k2, p1, p2, k3], not {shown(value)}")
    return tuple(value)


Distortion = Annotated[tuple[Number, Number, Number, Number, Number], BeforeValidator(_five)]
Pixels = Annotated[int, Field(gt=0, le=65536)]
Window = tuple[int, int, int, int]
"""A part of a sensor: its first column and row, its width and its height (px)."""


def _distinct(eyes: tuple[Side, ...]) -> tuple[Side, ...]:
    if len(set(eyes)) != len(eyes):
        raise ValueError("name each eye only once")
    return eyes


EyeNames = Annotated[tuple[Side, ...], Field(min_length=1, max_length=2), AfterValidator(_distinct)]


def serves(eyes: Sequence[str] | None, side: str) -> bool:
    """Return whether a camera or an LED with these `eyes` (None: both) serves an eye, right or left."""
    return eyes is None or side in eyes


_PLACE = {"position_mm", "look_at_mm", "pan_deg", "tilt_deg"}
_LENS = {"focal_length_px", "focal_length_mm", "sensor_mm", "principal_point_px"}
# The columns are the camera's right, down and forward axes at rest, in the world (x to the screen, y left, z up).
_REST = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class CameraCalibration(Spec):
    """Calibration of a camera in OpenCV's form: x_cam = R x_world + t."""

    K: Matrix3 = Field(description="camera matrix, px")
    R: Matrix3 = Field(description="rotation, world to camera")
    t_mm: Vec3 = Field(description="translation, world to camera")
    distortion: Distortion = Field(default=(0, 0, 0, 0, 0), description="k1, k2, p1, p2, k3")

    @model_validator(mode="after")
    def _check(self) -> Self:
        R = np.array(self.R)
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise ValueError("R must be a rotation matrix")
        K = np.array(self.K)
        if K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0 or K[2, 2] != 1 or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError("K must be upper triangular with positive focal lengths and K[2][2] = 1")
        if K[0, 1] != 0:
            raise ValueError("K has a skew term, which OpenCV's camera model does not support")
        return self


class CalibrationFile(Spec):
    """Path of a calibration file of OpenCV (`cv2.FileStorage`: YAML, XML or JSON) or of ROS (`camera_info`)."""

    file: Annotated[str, Field(min_length=1)] = Field(description="path, relative to the scene")
    unit_mm: Positive = Field(default=1.0, description="length of the file's unit of translation")


def _calibration_tag(value: Any) -> str:
    named = isinstance(value, CalibrationFile) or (isinstance(value, Mapping) and "file" in value)
    return "[file]" if named else "[numbers]"


AnyCalibration = Annotated[
    Annotated[CameraCalibration, Tag("[numbers]")] | Annotated[CalibrationFile, Tag("[file]")],
    Discriminator(_calibration_tag),
]


class Mirror(Spec):
    """A plane mirror through which a camera sees the eyes. It has no edges and shows no LEDs."""

    point_mm: Vec3 = Field(description="a point of the plane, in the world")
    normal: Vec3 = Field(description="vector across the plane, of any length and either sign")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not np.linalg.norm(self.normal) > 1e-9:
            raise ValueError("normal must not be zero")
        return self

    @property
    def plane(self) -> tuple[Floats, float]:
        """Return the plane n . x = d as its unit normal n (3,) and its offset d in mm."""
        normal = np.array(self.normal, dtype=float)
        normal /= np.linalg.norm(normal)
        return normal, float(normal @ np.array(self.point_mm, dtype=float))

    def image_of(self, points_mm: ArrayLike) -> Floats:
        """Reflect world points (..., 3) in the mirror's plane."""
        points, (normal, offset) = np.asarray(points_mm, dtype=float), self.plane
        return np.asarray(points - 2.0 * (points @ normal - offset)[..., None] * normal)


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
    distortion: Distortion = Field(default=(0, 0, 0, 0, 0), description="k1, k2, p1, p2, k3 (OpenCV)")
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

    @classmethod
    def from_opencv(
        cls, path: str | Path, *, size_px: tuple[int, int] | None = None, unit_mm: float = 1.0, **fields: Any
    ) -> Self:
        """Read a camera from a calibration file of OpenCV (`cv2.FileStorage`), ROS (`camera_info`) or a script.

        The file holds a camera matrix, distortion coefficients and, optionally, the image size and the pose (R and T,
        or rvec and tvec) in the world of this package: x_cam = R x_world + t.

        Args:
            path: the file.
            size_px: width and height of the image, if the file does not state them.
            unit_mm: the file's unit of length in mm.
            fields: `name`; instead of the file's pose, `position_mm`, `look_at_mm`, `pan_deg`, `tilt_deg`, `roll_deg`.

        Raises:
            InputError: the file cannot be read, lacks a value, uses an unsupported distortion model, or has a key that
                may describe the lens and is not read.
        """
        size = size_px or read_opencv(path).size_px
        if size is None:
            raise InputError("does not say the size of the image; give size_px", source=str(path))
        calibration = {"file": str(path), "unit_mm": unit_mm}
        return cls.from_mapping({"resolution_px": size, "calibration": calibration, **fields}).resolved()

    def resolved(self, base: Path | None = None) -> Self:
        """Return the camera with its calibration file read in; the path is relative to `base` or the current folder.

        Raises:
            InputError: the file cannot be read, or does not fit the camera.
        """
        if not isinstance(self.calibration, CalibrationFile):
            return self
        path = (base or Path()) / self.calibration.file
        found = read_opencv(path)
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
        numbers = {"K": found.K, "R": R, "t_mm": t, "distortion": found.distortion}
        kept = {"name": self.name, "resolution_px": self.resolution_px, "mirror": self.mirror, "eyes": self.eyes}
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
            if wrong or any(self.distortion):
                raise ValueError(f"the calibration file gives the lens; remove {', '.join(wrong) or 'distortion'}")
            if self.position_mm is None and (placed or self.roll_deg != 0):
                raise ValueError("give position_mm with the direction, or neither")
            return self._checked_direction()
        if self.calibration is not None:
            if placed or self.roll_deg != 0 or any(self.distortion):
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
        camera = replace(self.unmirrored(), eyes=self.eyes)
        return camera if self.mirror is None else camera.seen_in(self.mirror)

    def unmirrored(self) -> PinholeCamera:
        """Build the numeric camera at its real position, without the mirror."""
        if isinstance(self.calibration, CalibrationFile):
            return self.resolved().unmirrored()
        if self.calibration is not None:
            c = self.calibration
            return PinholeCamera.of(c.K, c.R, c.t_mm, self.resolution_px, c.distortion, self.name)
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
            axes = _facing(np.array(self.look_at_mm, dtype=float) - position)
        else:
            axes = _turned(np.radians(self.pan_deg or 0.0), np.radians(self.tilt_deg or 0.0))
        roll = np.radians(self.roll_deg)
        turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]])
        R = (axes @ turn).T
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return PinholeCamera.of(K, R, -rotated(R, position), self.resolution_px, self.distortion, self.name)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PinholeCamera(ArrayValue):
    """A pinhole camera with lens distortion.

    Attributes:
        K: (3, 3) camera matrix, px.
        R: (3, 3) rotation, world to camera.
        t: (3,) translation, world to camera, mm.
        distortion: (k1, k2, p1, p2, k3).
        resolution_px: (w, h).
        name: name of the camera.
        mirrored: whether it is the virtual camera behind a plane mirror: u is flipped about the principal point.
        eyes: eyes that it sees; None: both.
    """

    K: Floats
    R: Floats
    t: Floats
    distortion: Floats
    resolution_px: tuple[int, int]
    name: str
    mirrored: bool = False
    eyes: tuple[Side, ...] | None = None

    @classmethod
    def of(
        cls,
        K: ArrayLike,
        R: ArrayLike,
        t: ArrayLike,
        resolution_px: tuple[int, int],
        distortion: ArrayLike = (0, 0, 0, 0, 0),
        name: str = "camera",
    ) -> PinholeCamera:
        """Create a camera from array-like values."""
        return cls(
            K=frozen(K), R=frozen(R), t=frozen(t), distortion=frozen(distortion), resolution_px=resolution_px, name=name
        )

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
        t = rotated(self.R, 2.0 * offset * normal) + self.t
        return replace(
            self, R=frozen(flip[:, None] * (self.R @ reflect)), t=frozen(flip * t), mirrored=not self.mirrored
        )

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
            Pixels (..., 2), NaN behind the camera, and whether the point is in front of it (...).
        """
        cam = np.asarray(points_mm, dtype=float) @ self.R.T + self.t
        front = cam[..., 2] > 0
        z = np.where(front, cam[..., 2], np.nan)
        return self.pixels_of(cam[..., 0] / z, cam[..., 1] / z), front

    def pixels_of(self, x: Floats, y: Floats) -> Floats:
        """Compute pixels (..., 2) from undistorted normalised coordinates x = X/Z, y = Y/Z."""
        x = self.across * x
        if np.any(self.distortion):
            x, y = distort(x, y, self.distortion)
        return np.stack([self.K[0, 0] * x + self.K[0, 2], self.K[1, 1] * y + self.K[1, 2]], axis=-1)

    def scale_at(self, point_mm: ArrayLike) -> float:
        """Compute the image scale at a world point (3,) mm, across the line of sight, in pixels per mm."""
        distance = float(np.linalg.norm(np.asarray(point_mm, dtype=float) - self.nodal_point_mm))
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1])) / distance

    def rays(self, pixels: ArrayLike) -> Floats:
        """Compute unit directions (..., 3) in the world, out of the camera, through pixels (..., 2)."""
        p = np.asarray(pixels, dtype=float)
        x = (p[..., 0] - self.K[0, 2]) / self.K[0, 0]
        y = (p[..., 1] - self.K[1, 2]) / self.K[1, 1]
        if np.any(self.distortion):
            x, y = undistort(x, y, self.distortion)
        d = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.sensor_axes
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def ideal(self, pixels: ArrayLike) -> Floats:
        """Remove the lens distortion from pixels (..., 2)."""
        p = np.asarray(pixels, dtype=float)
        if not np.any(self.distortion):
            return p
        (cx, cy), (fx, fy) = self.K[:2, 2], (self.K[0, 0], self.K[1, 1])
        x, y = undistort((p[..., 0] - cx) / fx, (p[..., 1] - cy) / fy, self.distortion)
        return np.stack([fx * x + cx, fy * y + cy], axis=-1)

    def is_imaged(self, x: Floats, y: Floats) -> Bools:
        """Return whether the distortion is invertible at normalised coordinates x = X/Z, y = Y/Z (not folded back)."""
        return np.asarray(is_imaged(self.across * x, y, self.distortion))

    @property
    def fold(self) -> tuple[float, float]:
        """Radius at which a radial distortion folds the image back, without and with it; inf if it does not fold."""
        k1, k2, _, _, k3 = self.distortion
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        r2 = float(roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].min(initial=np.inf))
        return (r2**0.5, r2**0.5 * (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))) if r2 < np.inf else (np.inf, np.inf)

    def without_rays(self, window: Window) -> Bools | None:
        """Return which pixels (h, w) of a window lie beyond the fold of the lens; None if none does."""
        reach, (x0, y0, width, height) = self.fold[1], window
        x = (np.arange(x0, x0 + width) - self.K[0, 2]) / self.K[0, 0]
        y = (np.arange(y0, y0 + height) - self.K[1, 2]) / self.K[1, 1]
        if np.hypot(np.abs(x).max(), np.abs(y).max()) <= reach:
            return None
        return np.asarray(np.hypot(x[None, :], y[:, None]) > reach)

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


def distort(x: Any, y: Any, k: Sequence[Any] | Floats) -> tuple[Any, Any]:
    """Apply the Brown-Conrady distortion as OpenCV defines it; works on arrays of NumPy and of Dr.Jit.

    x'' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and alike for y
    """
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


def distortion_jacobian(x: Any, y: Any, k: Sequence[Any] | Floats) -> tuple[Any, Any, Any]:
    """Compute the Jacobian of `distort` at undistorted coordinates: dx''/dx, dx''/dy = dy''/dx, dy''/dy.

    Like `newton_step`, it takes arrays of NumPy and of Dr.Jit.
    """
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)
    a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    d = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return a, b, d


def distorted_area(x: Any, y: Any, k: Sequence[Any] | Floats) -> Any:
    """Compute the determinant D of `distortion_jacobian`: area on the sensor per area without distortion."""
    a, b, d = distortion_jacobian(x, y, k)
    return a * d - b * b


def is_imaged(x: Any, y: Any, k: Sequence[Any] | Floats) -> Any:
    """Return whether the distortion has not folded the image back: its Jacobian is positive definite."""
    a, b, d = distortion_jacobian(x, y, k)
    return (a > 0) & (a * d - b * b > 0)


def newton_step(x: Any, y: Any, xd: Any, yd: Any, k: Sequence[Any] | Floats) -> tuple[Any, Any]:
    """Compute the Newton step of `undistort` from (x, y) towards the distorted (xd, yd); subtract it from (x, y)."""
    fx, fy = distort(x, y, k)
    ex, ey = fx - xd, fy - yd
    a, b, d = distortion_jacobian(x, y, k)
    det = a * d - b * b
    return (d * ex - b * ey) / det, (a * ey - b * ex) / det


def undistort(xd: Floats, yd: Floats, k: Floats, iterations: int = 50) -> tuple[Floats, Floats]:
    """Invert `distort` by Newton's method on its exact Jacobian; NaN where it does not converge."""
    x, y = xd.copy(), yd.copy()
    for _ in range(iterations):
        dx, dy = newton_step(x, y, xd, yd, k)
        x, y = x - dx, y - dy
        if np.nanmax(np.hypot(dx, dy), initial=0.0) < 1e-15:
            break
    fx, fy = distort(x, y, k)
    bad = ~(np.hypot(fx - xd, fy - yd) < 1e-12)
    return np.where(bad, np.nan, x), np.where(bad, np.nan, y)


def _turned(pan: float, tilt: float) -> Floats:
    """Return camera axes as columns: tilted about the right axis, then panned about the world's vertical."""
    ct, st, cp, sp = np.cos(tilt), np.sin(tilt), np.cos(pan), np.sin(pan)
    about_right = np.array([[1.0, 0, 0], [0, ct, -st], [0, st, ct]])
    # The rest direction is -x, so a pan to the subject's left (+y) is a negative turn about +z.
    about_up = np.array([[cp, sp, 0], [-sp, cp, 0], [0, 0, 1.0]])
    return np.asarray(about_up @ _REST @ about_right)


def _facing(direction: Floats) -> Floats:
    """Return camera axes as columns, looking along `direction` with the world's z up (its y when looking along z)."""
    forward = direction / np.linalg.norm(direction)
    up = np.array([0.0, 0, 1.0]) if abs(forward[2]) < 1 - 1e-9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return np.stack([right, down, forward], axis=1)
