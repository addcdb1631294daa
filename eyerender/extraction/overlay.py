"""Overlays of results: the pupil's outline and centre, and the glints, drawn over the image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bytes, Floats
from .result import Extraction

_SHIFT = 4  # bits after the binary point of OpenCV's coordinates
# Blue, green, red.
_SURE, _UNSURE, _GLINT, _REJECTED = (80, 220, 60), (40, 170, 255), (255, 190, 40), (130, 130, 130)


def overlay(image: NDArray[Any], found: Sequence[Extraction], full_scale: float) -> Bytes:
    """Draw results over an image (h, w), white at `full_scale`; return (h, w, 3) blue, green, red, as OpenCV takes it.

    The outline is green, or orange below a confidence of 0.9. Glints are blue crosses, rejected reflections grey ones.
    """
    grey = np.clip(np.asarray(image, dtype=np.float32) * (255.0 / full_scale), 0.0, 255.0).astype(np.uint8)
    out = np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2))
    for one in found:
        _draw(out, one)
    return out


def _draw(out: Bytes, found: Extraction) -> None:
    thick = max(1, round(min(out.shape[:2]) / 400))
    ellipse = found.pupil.ellipse
    if ellipse is not None:
        colour = _SURE if found.pupil.confidence >= 0.9 else _UNSURE
        cv2.polylines(out, [_fixed(ellipse.points(180))], True, colour, thick, cv2.LINE_AA, _SHIFT)
        _cross(out, ellipse.centre_px, 3 * thick, colour, thick)
    for glint in (*found.rejected, *found.glints):
        _cross(out, glint.xy_px, 4 * thick, _GLINT if glint.ok else _REJECTED, thick)


def _cross(out: Bytes, centre: Floats, size: float, colour: tuple[int, int, int], thick: int) -> None:
    for arm in ((size, 0.0), (0.0, size)):
        ends = _fixed(np.array([centre - np.array(arm), centre + np.array(arm)]))
        cv2.line(out, ends[0].tolist(), ends[1].tolist(), colour, thick, cv2.LINE_AA, _SHIFT)


def _fixed(points: Floats) -> NDArray[np.int32]:
    """Convert points to OpenCV's fixed-point coordinates."""
    return np.rint(np.clip(points, -1e4, 1e5) * (1 << _SHIFT)).astype(np.int32)
