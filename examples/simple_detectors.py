"""
Three simple pupil detectors
============================

Otsu's threshold, the Hough transform of circles, and a starburst, to compare other detectors with::

    cd examples
    eyerender bench-extractors ../out/images -o ../out/bench --extractor simple_detectors:otsu \
        --extractor simple_detectors:hough --extractor simple_detectors:starburst

They use only the image. They follow the published ideas, not anybody's code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

OPENCV = {"axes": "full", "angle_unit": "deg", "angle_of": "first"}
RAYS, MOST_TURNS = 72, 10
MISSING = {"pupil": {"status": "missing", "reason": "nothing looks like a pupil"}}


def otsu(image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """Fit an ellipse to the roundest dark blob below Otsu's threshold of the darker half of the image."""
    grey = cv2.medianBlur(_eight_bits(image, request), 5)
    half, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    dark = grey[grey <= half].reshape(1, -1)
    level, _ = cv2.threshold(np.ascontiguousarray(dark), 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    blobs = cv2.morphologyEx((grey <= level).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
    contours, _ = cv2.findContours(blobs, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    best, most = None, 0.0
    for contour in contours:
        hull = cv2.convexHull(contour)
        area, around = cv2.contourArea(hull), cv2.arcLength(hull, True)
        if len(hull) < 6 or not 150.0 < area < 0.2 * grey.size:
            continue
        merit = 4.0 * math.pi * area / around**2 * cv2.contourArea(contour) / area * math.sqrt(area)
        if merit > most:
            best, most = hull, merit
    return MISSING if best is None else _found(cv2.fitEllipse(best))


def hough(image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """Take the darkest of the ten strongest circles of the Hough transform."""
    grey = cv2.medianBlur(_eight_bits(image, request), 7)
    shortest = min(grey.shape)
    found = cv2.HoughCircles(
        grey, cv2.HOUGH_GRADIENT, 2, shortest / 10, param1=60, param2=30, minRadius=8, maxRadius=shortest // 4
    )
    if found is None:
        return MISSING
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]]
    circles = [(float(u), float(v), float(r)) for u, v, r in found[0][:10]]
    levels = [float(grey[(x - u) ** 2 + (y - v) ** 2 < (0.8 * r) ** 2].mean()) for u, v, r in circles]
    u, v, r = circles[int(np.argmin(levels))]
    return _found(((u, v), (2.0 * r, 2.0 * r), 0.0))


def starburst(image: NDArray[Any], request: Mapping[str, Any]) -> dict[str, Any]:
    """Walk from the darkest place along rays to the first strong edge; go on from the centre of those edges."""
    grey = cv2.GaussianBlur(_eight_bits(image, request).astype(np.float32), (0, 0), 2.0)
    coarse = cv2.blur(grey, (15, 15))
    centre = np.array(np.unravel_index(int(np.argmin(coarse)), grey.shape)[::-1], dtype=np.float64)
    angles = np.linspace(0.0, 2.0 * math.pi, RAYS, endpoint=False)
    steps = np.arange(3.0, 0.4 * min(grey.shape))
    toward = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    least = max(6.0, 0.2 * float(np.ptp(np.percentile(grey, (5, 95)))))
    points = np.zeros((0, 2))
    for _ in range(MOST_TURNS):
        places = centre + steps[None, :, None] * toward[:, None]
        levels = cv2.remap(grey, *np.moveaxis(places.astype(np.float32), -1, 0), cv2.INTER_LINEAR)
        rise = levels[:, 4:] - levels[:, :-4]
        strong = rise > least
        hit = strong.any(axis=1)
        # The steepest place of the edge, not where it begins.
        first = np.argmax(strong, axis=1)
        near = (np.arange(rise.shape[1]) >= first[:, None]) & (np.arange(rise.shape[1]) < first[:, None] + 6)
        steepest = np.argmax(np.where(near, rise, -1.0), axis=1) + 2
        points = places[np.arange(RAYS), steepest][hit]
        if len(points) < RAYS // 3:
            return MISSING
        moved = np.median(points, axis=0) - centre
        centre = centre + moved
        if float(np.hypot(*moved)) < 0.5:
            break
    away = np.hypot(*(points - centre).T)
    away /= np.median(away)
    for share in (0.4, 0.2, 0.1):  # what lies off the ellipse belongs to other edges
        kept = points[np.abs(away - 1.0) < share]
        if len(kept) < 12:
            return MISSING
        rectangle = cv2.fitEllipse(kept.astype(np.float32))
        away = _relative_radius(rectangle, points)
    return _found(rectangle)


def _relative_radius(rectangle: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of points from the centre of an ellipse, relative to its radius in their direction."""
    centre, axes, degrees = rectangle
    turn = math.radians(degrees)
    x, y = (points - centre).T
    along, across = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
    return np.asarray(np.hypot(2.0 * along / max(axes[0], 1e-6), 2.0 * across / max(axes[1], 1e-6)))


def _found(rectangle: Any) -> dict[str, Any]:
    """Record of one of OpenCV's rotated rectangles."""
    (x, y), axes, degrees = rectangle
    if not (min(axes) > 0.0 and np.isfinite([x, y, *axes]).all()):
        return MISSING
    return {"pupil": {"status": "ok", "centre_px": [x, y], "axes_px": list(axes), "angle": degrees}}


def _eight_bits(image: NDArray[Any], request: Mapping[str, Any]) -> NDArray[np.uint8]:
    scale = 1.0 if image.dtype == np.uint8 else 255.0 / (2.0 ** request["bit_depth"] - 1.0)
    return np.clip(np.rint(image * scale), 0, 255).astype(np.uint8)


for _detector in (otsu, hough, starburst):
    _detector.conventions, _detector.reports = OPENCV, ("pupil",)  # type: ignore[attr-defined]
