"""A baseline pupil detector: threshold, contour, ellipse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

RotatedRect = tuple[tuple[float, float], tuple[float, float], float]

_RADIUS_PX = (7.0, 160.0)
LEVELS, FILLED = 10, 0.85


def contour_pupil(
    image: NDArray[np.generic], *, bit_depth: int, radius_px: Sequence[float] | None = None
) -> RotatedRect | str:
    """Detect the pupil as OpenCV's rotated rectangle (centre, full axes, degrees), or return the reason for failure.

    The image (h, w) is smoothed with a 5 x 5 Gaussian after glints are closed by a morphological opening. It is cut at
    `LEVELS` thresholds below Otsu's (1979). Dark regions are kept if their semi-axes lie within `radius_px` (2,), do
    not touch the frame and fill at least `FILLED` of their hull; `cv2.fitEllipse` is applied to the hull. The region
    with the steepest outline relative to its level is the pupil, because lids and shadows are softer. The contour runs
    through the centres of the outermost dark pixels, so half a pixel is added to the semi-axes.
    """
    full = float(2**bit_depth - 1) if image.dtype.kind in "ui" else float(image.max())
    if full <= 0.0:
        return "the image is all black"
    grey = np.clip(np.rint(image.astype(np.float32) * np.float32(255.0 / full)), 0, 255).astype(np.uint8)
    if min(grey.shape) < 16:
        return f"the image is {grey.shape[1]} x {grey.shape[0]}"
    opened = cv2.morphologyEx(grey, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9)))
    smooth = np.asarray(cv2.GaussianBlur(opened, (5, 5), 0.0), dtype=np.uint8)
    low, high = radius_px or _RADIUS_PX
    slope = cv2.magnitude(*(cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx) for dx in (1, 0)))
    otsu = float(cv2.threshold(smooth, 0, 255, cv2.THRESH_OTSU)[0])
    best, steepest = None, 0.0
    for level in np.linspace(float(np.percentile(smooth, 0.5)), otsu, LEVELS + 1)[1:]:
        contours, _ = cv2.findContours((smooth <= level).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            if not _likely(contour, grey.shape, low, high):
                continue
            # Divided by the level: an iris may have a steeper outline than its pupil, but is brighter.
            steepness = float(np.median(slope[contour[:, 0, 1], contour[:, 0, 0]])) / (1.0 + float(level))
            if steepness > steepest:
                best, steepest = cv2.convexHull(contour), steepness
    if best is None or len(best) < 5:
        return "no dark region of a likely size"
    (cx, cy), (first, second), degrees = cv2.fitEllipse(best)
    if not (min(first, second) > 0.0 and math.isfinite(cx + cy + first + second + degrees)):
        return "no ellipse fits the contour"
    return (float(cx), float(cy)), (float(first) + 1.0, float(second) + 1.0), float(degrees)


def _likely(contour: NDArray[Any], shape: tuple[int, ...], low: float, high: float) -> bool:
    """Return whether a contour has the size and shape of a pupil and does not touch the frame."""
    x, y, w, h = cv2.boundingRect(contour)
    cut = x == 0 or y == 0 or x + w == shape[1] or y + h == shape[0]
    area = cv2.contourArea(contour)
    if cut or len(contour) < 8 or not 0.5 * low**2 < area / math.pi < high**2:
        return False
    return area > FILLED * cv2.contourArea(cv2.convexHull(contour))
