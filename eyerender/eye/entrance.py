"""The entrance pupil: the image of the stop through the cornea, for a distant observer on the optic axis.

Rays from the margin's points leave the cornea parallel to the axis. Their positions (y, z) outline the entrance pupil,
whose diameter is that of the circle of equal area. With the outline's Fourier series y + i z = sum_m c_m exp(i m f) in
the margin's parameter f, its area is pi |sum_m m |c_m|^2|, which is exact for an ellipse and converges with the number
of points faster than any power.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..base.arrays import Floats, frozen, remembered
from ..base.errors import InputError
from ..base.status import Status
from ..optics.solve import apparent_points
from ..optics.surfaces import Surface
from .model import EyeModel, Stop

FAR_MM = 1e6
"""Distance of the observer. From there, the entrance pupil is 3e-6 of its size larger than from infinity."""
POINTS = 32
_STEPS = 12
_SETTLED_MM = 1e-10


def entrance_pupil_mm(eye: EyeModel, *, points: int = POINTS, distance_mm: float = FAR_MM) -> float:
    """Compute the diameter (mm) of the entrance pupil of a single eye: that of the circle of equal area.

    `points` of the margin are seen from the distance `distance_mm`. Raises InputError if a ray from the margin does not
    leave the eye.
    """
    return _diameter(eye.front, tuple(float(n) for n in eye.front_indices), eye.stop, points, distance_mm)


@remembered
def entrance_pupil(eye: EyeModel) -> tuple[Floats, float]:
    """Compute the centre (3,) mm and lateral magnification of the paraxial image of the stop, seen from air.

    n / s - n' / s' = (n - n') / R at each surface, from the stop outwards; m = n s' / (n' s).
    """
    x, scale = float(eye.stop.centre_mm[0]), 1.0
    indices = [1.0, *(float(n) for n in eye.front_indices)]
    for k in range(len(eye.front) - 1, -1, -1):
        surface, n, n_out = eye.front[k], indices[k + 1], indices[k]
        apex = float(surface.origin_mm[0] + surface.rotation[0, 0] * surface.sag(0.0, 0.0))
        R = 1 / _curvature(surface)
        depth = apex - x
        out = n_out / (n / depth - (n - n_out) / R)
        scale *= n * out / (n_out * depth)
        x = apex - out
    return frozen([x, *(scale * eye.stop.centre_mm[1:])]), scale


def stop_for_entrance(
    front: tuple[Surface, ...],
    indices: tuple[float, ...],
    stop_of: Callable[[float], Stop],
    entrance_mm: float,
    *,
    points: int = POINTS,
) -> float:
    """Compute the diameter (mm) of the stop whose entrance pupil has the diameter `entrance_mm`.

    `front` are the refracting surfaces before the stop, outside in, with the index behind each. `stop_of` returns the
    stop of a diameter, on which its position and shape may depend. Raises InputError if the search does not converge,
    or a ray does not leave the eye.
    """

    def miss(diameter: float) -> float:
        return _diameter(front, indices, stop_of(diameter), points) - entrance_mm

    low = entrance_mm / 1.13
    f_low = miss(low)
    # The cornea magnifies stops of all diameters almost equally.
    high = low * entrance_mm / (entrance_mm + f_low)
    f_high = miss(high)
    for _ in range(_STEPS):
        if abs(f_high) < _SETTLED_MM:
            return high
        low, f_low, high = high, f_high, high - f_high * (high - low) / (f_high - f_low)
        f_high = miss(high)
    if abs(f_high) < 1e-8:
        return high
    raise InputError(f"no stop has an entrance pupil of {entrance_mm:g} mm", path="stop.diameter_mm")


def _diameter(
    front: tuple[Surface, ...], indices: tuple[float, ...], stop: Stop, points: int, distance_mm: float = FAR_MM
) -> float:
    found = apparent_points(front, indices, stop.boundary(points), np.array([distance_mm, 0.0, 0.0]))
    if (found.status != Status.OK).any():
        raise InputError("a ray from the margin does not leave the eye", path="stop.diameter_mm")
    exits = found.exit_points_mm
    series = np.fft.fft(exits[:, 1] + 1j * exits[:, 2]) / points
    order = np.fft.fftfreq(points, 1.0 / points)
    return float(2.0 * np.sqrt(abs(np.sum(order * np.abs(series) ** 2))))


def _curvature(surface: Surface) -> float:
    """Compute the mean curvature at the apex (1/mm), from the sag."""
    h = 0.05
    # A measured surface may lean at its apex, so both sides count.
    ends = sum(surface.sag(s * h, 0.0) + surface.sag(0.0, s * h) for s in (1, -1))
    return float((4 * surface.sag(0.0, 0.0) - ends) / (2 * h**2))
