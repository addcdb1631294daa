"""Build the stop of an eye file."""

from __future__ import annotations

import numpy as np

from ..optics.transforms import rotation_x, tilt_rotation
from .model import Stop
from .parts import EyeParts


def stop_of(spec: EyeParts, diameter_mm: float) -> Stop:
    """Build the stop of the right eye at a diameter (mm)."""
    stop = spec.stop
    change = diameter_mm - stop.diameter_mm
    rotation = tilt_rotation(np.radians(stop.tilt_deg)) @ rotation_x(np.radians(stop.axis_deg))
    # The pupil moves within the plane of the iris, which is fixed. Otherwise it would sink into a lens that is tilted
    # with it.
    depth = -float(rotation[1:, 0] @ stop.shift_mm_per_mm) / float(rotation[0, 0])
    centre = np.array(stop.position_mm) + np.array([depth, *stop.shift_mm_per_mm]) * change
    ratio = np.sqrt(1.0 - stop.ellipticity)
    semi_axes = 0.5 * diameter_mm * np.array([1.0 / ratio, ratio])
    if stop.contour is None:
        return Stop(centre, rotation, semi_axes, np.array(1.0))
    rows = (stop.contour.cosines, stop.contour.sines)
    contour = np.zeros((2, max(map(len, rows))))
    for row, values in zip(contour, rows, strict=True):
        row[: len(values)] = values
    return Stop(centre, rotation, semi_axes, np.array(1.0), contour)


def stop_reach_mm(stop: Stop) -> float:
    """Compute the largest distance of the margin from the stop's centre, within 0.1 %."""
    return float(np.max(np.linalg.norm(stop.boundary(360) - stop.centre_mm, axis=-1)))
