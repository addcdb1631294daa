"""The simplest common pupil finder, as a baseline: threshold, contour, ellipse."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..arrays import Bytes

RotatedRect = tuple[tuple[float, float], tuple[float, float], float]

_RADIUS_PX = (7.0, 160.0)


def contour_pupil(
    image: NDArray[np.generic], *, bit_depth: int, radius_px: Sequence[float] | None = None
) -> RotatedRect | str:
    """Find the pupil as OpenCV's rotated rectangle (centre, full axes, degrees); a string gives the reason for failure.

    The image is smoothed with a 5 x 5 Gaussian. Otsu's threshold is applied, and again to the part below it, which
    separates the pupil from the iris. Dark regions of a likely size are kept if they do not touch the frame and fill at
    least 0.7 of their hull. `cv2.fitEllipse` is applied to the contour of the largest one. The contour runs through the
    centres of the outermost dark pixels, so the axes are about half a pixel too short. This error belongs to the
    baseline and is not corrected.

    Source of the threshold: Otsu (1979).

    Args:
        image: (h, w) image.
        bit_depth: bits of the image.
        radius_px: (2,) smallest and largest semi-axis to look for.
    """
    full = float(2**bit_depth - 1) if image.dtype.kind in "ui" else float(image.max())
    if full <= 0.0:
        return "the image is all black"
    grey = np.clip(np.rint(image.astype(np.float32) * np.float32(255.0 / full)), 0, 255).astype(np.uint8)
    if min(grey.shape) < 16:
        return f"the image is {grey.shape[1]} x {grey.shape[0]}"
    smooth = np.asarray(cv2.GaussianBlur(grey, (5, 5), 0.0), dtype=np.uint8)
    low, high = radius_px or _RADIUS_PX
    height, width = grey.shape
    best, most = None, 0.0
    for level in _levels(smooth):
        contours, _ = cv2.findContours((smooth <= level).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            area = cv2.contourArea(contour)
            x, y, w, h = cv2.boundingRect(contour)
            cut = x == 0 or y == 0 or x + w == width or y + h == height
            if cut or len(contour) < 8 or area <= most or not 0.5 * low**2 < area / math.pi < high**2:
                continue
            if area > 0.7 * cv2.contourArea(cv2.convexHull(contour)):
                best, most = contour, area
        if best is not None:
            break
    if best is None:
        return "no dark region of a likely size"
    (cx, cy), (first, second), degrees = cv2.fitEllipse(best)
    if not (min(first, second) > 0.0 and math.isfinite(cx + cy + first + second + degrees)):
        return "no ellipse fits the contour"
    return (float(cx), float(cy)), (float(first), float(second)), float(degrees)


def _levels(smooth: Bytes) -> list[float]:
    """Otsu's threshold of everything below Otsu's threshold, then the first threshold."""
    first = float(cv2.threshold(smooth, 0, 255, cv2.THRESH_OTSU)[0])
    dark = smooth[smooth <= first]
    if dark.size < 16 or dark.min() == dark.max():
        return [first]
    return [float(cv2.threshold(dark.reshape(-1, 1), 0, 255, cv2.THRESH_OTSU)[0]), first]
