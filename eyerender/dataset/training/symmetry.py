"""Lamps of a rig that change places in a mirror image, so that glints keep meaningful names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...base.arrays import Floats, Ints
from ...base.storage.files import parse_json
from ...optics.transforms import rotated
from ...rig.camera import PinholeCamera
from ...rig.mount import Mount

_NEAR_MM = 1.0  # farther than tolerances of assembly
_NEAR = 0.25  # of the distance between neighbouring lamps


def rig_pose(line: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return the pose R (3, 3), t (3,) mm of a picture's rig in the world, x_world = R x_rig + t."""
    pose = line.get("rig_pose")
    if pose is not None:  # includes the mount
        return Rotation.from_rotvec(pose["rotation_rad"]).as_matrix(), np.array(pose["translation_mm"], dtype=float)
    text = line["parameters"]["scene_json"]
    mount = parse_json(text, path="scene_json")["rig"].get("mount") if '"mount"' in text else None
    return (np.eye(3), np.zeros(3)) if mount is None else Mount.from_mapping(mount).motion()


def mirrored_lamps(line: Mapping[str, Any]) -> Ints | None:
    """Return the number (n,) that each lamp of a rig has in the mirrored picture, or None without such a symmetry.

    A rig for both eyes is symmetric about the median plane of the head: a lamp of the left eye becomes the one of the
    right eye. A rig for one eye is symmetric about the plane of the camera's axis and its vertical.
    """
    lights = np.array(line["labels"]["lights_mm"], dtype=float)
    R, t = rig_pose(line)
    camera = PinholeCamera.from_labels(line["labels"]["camera"])
    found = partners((lights - t) @ R, 1)
    return partners(rotated(camera.sensor_axes, lights) + camera.sensor_offset, 0) if found is None else found


def partners(points: Floats, axis: int) -> Ints | None:
    """Return which of the points (n, 3) mm is the mirror image of each at the plane across an axis; None without one.

    A lamp may be off by 1 mm, and by a quarter of the smallest distance between two lamps.
    """
    between = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(between, np.inf)
    limit = min(_NEAR_MM, _NEAR * float(between.min(initial=np.inf)))
    away = np.linalg.norm(points[:, None] * np.where(np.arange(3) == axis, -1.0, 1.0) - points, axis=-1)
    nearest = away.argmin(axis=1) if len(points) else np.zeros(0, dtype=int)
    own = np.arange(len(points))
    return nearest if np.all(away[own, nearest] <= limit) and np.array_equal(nearest[nearest], own) else None
