"""Gaze in the camera's frame, for appearance-based training: unit vectors, yaw and pitch.

    yaw = atan2(-x, -z),   pitch = asin(-y)       x right, y down, z away from the camera

Both are 0 for gaze towards the camera; yaw is positive to the image's left, pitch is positive up. This is the
convention of MPIIGaze and ETH-XGaze.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..training.item import LEAST_SHOWN

DIRECTIONS = ("line_of_sight", "optic_axis")
CARD = """
## Gaze
`line_of_sight` is the direction from the eye to what it fixates; `optic_axis` is the axis of the eye's optics, about 5
degrees temporal of it. Both are unit vectors in the camera's frame (x right, y down, z away from the camera), from the
eye outwards.{columns}
`*_yaw_deg` = atan2(-x, -z) and `*_pitch_deg` = asin(-y), in degrees: both are 0 for gaze parallel to the camera's axis,
towards the camera; yaw is positive to the image's left, and pitch is positive up (as in MPIIGaze and ETH-XGaze). Lens
distortion, the position of the eye and the roll of the head are not removed.

`gaze_valid` is 0 while under a tenth of the pupil shows, as of a shut eye: gaze and pupil are then known, but not seen.

`pupil_entrance_diameter_mm` is the entrance pupil, as seen through the cornea on the optic axis;
`pupil_stop_diameter_mm` is the anatomical pupil (also in `pupil_diameter_mm`).
"""


def yaw_pitch_deg(direction: Sequence[float]) -> tuple[float, float]:
    """Compute yaw and pitch in degrees of a unit vector in the camera's frame."""
    x, y, z = direction
    return float(np.degrees(np.arctan2(-x, -z))), float(np.degrees(np.arcsin(np.clip(-y, -1.0, 1.0))))


def gaze_of(line: dict[str, Any]) -> dict[str, float]:
    """Return yaw and pitch in degrees of the line of sight and the optic axis, and whether the eye shows them."""
    space, shown = line["labels"]["space"]["camera"], line["labels"]["pupil"]["visible_fraction"]
    angles = {
        f"{name}_{angle}_deg": value
        for name in DIRECTIONS
        for angle, value in zip(("yaw", "pitch"), yaw_pitch_deg(space[name]), strict=True)
    }
    return {**angles, "gaze_valid": int((shown or 0.0) >= LEAST_SHOWN)}


def pupil_of(line: dict[str, Any]) -> dict[str, float]:
    """Return the pupil diameters by column name."""
    pupil = line["labels"]["pupil"]
    return {f"pupil_{name}": pupil[name] for name in ("entrance_diameter_mm", "stop_diameter_mm")}
