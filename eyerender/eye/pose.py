"""Pose: the orientation of an eye, and how its points move with it.

M = Rz(azimuth) Ry(-elevation) Rx(torsion), right-handed; azimuth > 0 turns to the subject's left for both eyes,
elevation > 0 up. Listing's law sets the torsion:

    tau = -asin(sin az sin el / (1 + cos az cos el)),

which makes M the torsion-free rotation from +x to the gaze. Azimuth and elevation have separate centres:
x' = A(E(T(x))), each turning about its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.arrays import ArrayValue, Floats, frozen
from ..optics.surfaces import Xyz
from .model import EyeModel
from .pose_kernels import move_all


@dataclass(frozen=True, slots=True, eq=False)
class Poses(ArrayValue):
    """A batch of poses: three angles (n,) in radians."""

    azimuth_rad: Floats
    elevation_rad: Floats
    torsion_rad: Floats

    def __post_init__(self) -> None:
        for name in ("azimuth_rad", "elevation_rad", "torsion_rad"):
            object.__setattr__(self, name, frozen(np.atleast_1d(getattr(self, name))))

    @classmethod
    def listing(cls, azimuth_rad: npt.ArrayLike, elevation_rad: npt.ArrayLike) -> Poses:
        """Create poses whose torsion follows Listing's law."""
        azimuth = np.asarray(azimuth_rad, dtype=np.float64)
        elevation = np.asarray(elevation_rad, dtype=np.float64)
        return cls(azimuth, elevation, listing_torsion(azimuth, elevation))

    @classmethod
    def from_degrees(cls, azimuth_deg: npt.ArrayLike, elevation_deg: npt.ArrayLike) -> Poses:
        """Create poses by Listing's law from angles in degrees."""
        return cls.listing(np.radians(azimuth_deg), np.radians(elevation_deg))

    def __len__(self) -> int:
        return len(self.azimuth_rad)


def listing_torsion(azimuth_rad: npt.ArrayLike, elevation_rad: npt.ArrayLike) -> Floats:
    """Compute the torsion tau = -asin(sin az sin el / (1 + cos az cos el))."""
    azimuth, elevation = np.asarray(azimuth_rad), np.asarray(elevation_rad)
    return np.asarray(-np.arcsin(np.sin(azimuth) * np.sin(elevation) / (1.0 + np.cos(azimuth) * np.cos(elevation))))


def rigid_motion(poses: Poses, eye: EyeModel) -> tuple[Floats, Floats]:
    """Compute the rigid motion M (n, 3, 3), t (n, 3) of n poses: x_turned = M x + t in the eye frame.

    The point in the world is x_turned + the eye's position + the head's position. `eye` is one, or a batch of n.
    """
    angles = np.stack([poses.azimuth_rad, poses.elevation_rad, poses.torsion_rad], axis=-1).reshape(-1, 3)
    turn, shift = np.empty((len(angles), 3, 3)), np.empty((len(angles), 3))
    move_all(np.array(angles, dtype=np.float64), centres_of(eye), turn, shift)
    return turn, shift


def centres_of(eye: EyeModel) -> Floats:
    """Return the centres of azimuth, elevation and torsion, (1, 9) mm, or (n, 9) for a batch."""
    r = eye.rotation
    centres = np.concatenate([r.azimuth_centre_mm, r.elevation_centre_mm, r.torsion_centre_mm], axis=-1)
    return np.array(np.atleast_2d(centres))


class Turning(NamedTuple):
    """Sines and cosines of poses, one array per angle, for fast transforms into the turned eye."""

    azimuth: tuple[Floats, Floats]
    elevation: tuple[Floats, Floats]
    torsion: tuple[Floats, Floats]

    @classmethod
    def of(cls, poses: Poses) -> Turning:
        """Compute the sines and cosines of poses."""
        return cls(
            (np.cos(poses.azimuth_rad), np.sin(poses.azimuth_rad)),
            (np.cos(poses.elevation_rad), np.sin(poses.elevation_rad)),
            (np.cos(poses.torsion_rad), np.sin(poses.torsion_rad)),
        )


def into_eye(turning: Turning, eye: EyeModel, point: Xyz) -> Xyz:
    """Transform points (n,) around the eye into the frame of the turned eye: the inverse of the rigid motion."""
    r = eye.rotation
    ca, ce, ct = (split(c) for c in (r.azimuth_centre_mm, r.elevation_centre_mm, r.torsion_centre_mm))
    (cos_a, sin_a), (cos_e, sin_e), (cos_t, sin_t) = turning
    x, y, z = point[0] - ca[0], point[1] - ca[1], point[2] - ca[2]
    x, y = cos_a * x + sin_a * y, cos_a * y - sin_a * x
    x, y, z = x + (ca[0] - ce[0]), y + (ca[1] - ce[1]), z + (ca[2] - ce[2])
    x, z = cos_e * x + sin_e * z, cos_e * z - sin_e * x
    x, y, z = x + (ce[0] - ct[0]), y + (ce[1] - ct[1]), z + (ce[2] - ct[2])
    y, z = cos_t * y + sin_t * z, cos_t * z - sin_t * y
    return x + ct[0], y + ct[1], z + ct[2]


def split(vector: Floats) -> Xyz:
    """Return the components of vectors (..., 3), as views."""
    return vector[..., 0], vector[..., 1], vector[..., 2]
