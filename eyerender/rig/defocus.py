"""Defocus and vignetting, applied to the finished image, including the glints.

Defocus uses one kernel per window, for the depth z of the unrotated eye's apex. The thin lens' circle of confusion is

    c = (f / N) |z - s| / z * f / (s - f),

where f is the focal length, N the f-number and s the distance in focus (Born & Wolf, section 6.1). The kernel is a disc
integrated over the pixels. A symmetric kernel does not move centroids, so labels need no change. Vignetting multiplies
by 1 - v (r / r_corner)^2.
"""

from __future__ import annotations

import numpy as np
from scipy import signal

from ..arrays import Floats
from ..errors import InputError
from ..rig.camera import Window
from .camera import PinholeCamera
from .imaging import Lens
from .sensor import Sensor

_FINE = 9
# No eye can be recognised in an image with more blur, and the cost of the kernel grows with the square.
MAX_CONFUSION_PX = 400


def confusion_px(lens: Lens, camera: PinholeCamera, sensor: Sensor, depth_mm: float) -> float:
    """Diameter (px) of the circle of confusion of a point.

    Args:
        lens: the lens, which gives the distance in focus.
        camera: the camera.
        sensor: the sensor, which gives aperture and pixel pitch.
        depth_mm: depth of the point along the optical axis.

    Raises:
        InputError: the diameter exceeds 400 px.
    """
    if lens.focus_mm is None:
        return 0.0
    pitch_mm = sensor.pixel_pitch_um * 1e-3
    focal_mm = float(camera.K[0, 0]) * pitch_mm
    if lens.focus_mm <= focal_mm or depth_mm <= focal_mm:
        return 0.0
    blur = focal_mm / sensor.f_number * abs(depth_mm - lens.focus_mm) / depth_mm * focal_mm / (lens.focus_mm - focal_mm)
    if blur / pitch_mm > MAX_CONFUSION_PX:
        raise InputError(
            f"the picture would be blurred over {blur / pitch_mm:.3g} px; at most {MAX_CONFUSION_PX}",
            path="lens.focus_mm",
        )
    return float(blur / pitch_mm)


def disc(diameter_px: float) -> Floats:
    """Share of each pixel in the disc, odd and square, sum 1; a single 1 below a tenth of a pixel."""
    if diameter_px < 0.1:
        return np.ones((1, 1))
    reach = int(np.ceil(diameter_px / 2 - 0.5 + 1e-9))
    n = (2 * reach + 1) * _FINE
    at = (np.arange(n) + 0.5) / _FINE - (2 * reach + 1) / 2
    inside = np.hypot(at[:, None], at[None, :]) <= diameter_px / 2
    share = inside.reshape(2 * reach + 1, _FINE, 2 * reach + 1, _FINE).sum(axis=(1, 3)).astype(float)
    return np.asarray(share / share.sum())


def defocused(picture: Floats, kernel: Floats) -> Floats:
    """Convolve the image with an odd kernel; the result is smaller by the kernel's reach on every side."""
    if kernel.shape == (1, 1):
        return picture
    return np.asarray(np.maximum(signal.fftconvolve(picture, kernel, mode="valid"), 0.0))


def vignette(lens: Lens, camera: PinholeCamera, window: Window) -> Floats | float:
    """Factor by which vignetting reduces the light at each pixel of a window."""
    if lens.vignetting == 0:
        return 1.0
    x0, y0, width, height = window
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    w, h = camera.resolution_px
    corner = max(np.hypot(x - cx, y - cy) for x in (0, w - 1) for y in (0, h - 1))
    x, y = np.arange(x0, x0 + width) - cx, np.arange(y0, y0 + height) - cy
    return np.asarray(np.maximum(1 - lens.vignetting * (x[None, :] ** 2 + y[:, None] ** 2) / corner**2, 0.0))
