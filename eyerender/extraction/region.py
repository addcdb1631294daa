"""The part of an image that is searched: a rectangle or a mask."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools
from ..base.errors import InputError
from .result import Extraction, PupilResult

# (x, y, width, height) in pixels, or an array (h, w) that is not 0 where the image is searched.
SearchRegion = tuple[int, int, int, int] | NDArray[Any]


def cut_region(image: NDArray[Any], region: SearchRegion) -> tuple[NDArray[Any], tuple[int, int], Bools]:
    """Cut a region out of an image (h, w, ...); pixels outside a mask get the level of the nearest one inside.

    Returns the part, its first column and row, and which of its pixels (h, w) belong to the region. Raises InputError
    if the region is empty, is not inside the image, or has another size.
    """
    (height, width), given = image.shape[:2], np.asarray(region)
    if given.ndim == 2:
        if given.shape != (height, width):
            raise InputError(f"has the shape {given.shape}, the image {(height, width)}", path="roi")
        inside = np.asarray(given != 0)
        if not inside.any():
            raise InputError("is empty", path="roi")
        columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
        x, y, x1, y1 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
        inside = inside[y:y1, x:x1]
    else:
        if given.shape != (4,) or given.dtype.kind not in "iu":
            raise InputError("must be (x, y, width, height) in whole pixels, or a mask (h, w)", path="roi")
        x, y, wide, high = (int(value) for value in given)
        x1, y1 = x + wide, y + high
        if not (0 <= x < x1 <= width and 0 <= y < y1 <= height):
            raise InputError(f"{tuple(given.tolist())} is not inside the image of {width} x {height} px", path="roi")
        inside = np.ones((y1 - y, x1 - x), dtype=bool)
    part = image[y:y1, x:x1]
    if not inside.all():
        outside = (~inside).astype(np.uint8)
        _, label = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        levels = np.zeros((int(label.max()) + 1, *part.shape[2:]), dtype=part.dtype)
        levels[label[inside]] = part[inside]
        part = levels[label]
    return part, (x, y), inside


def placed(found: Extraction, corner: tuple[int, int], inside: Bools, shape: tuple[int, int]) -> Extraction:
    """Convert the result for a region to the whole image of `shape` (h, w), without what lies outside the region."""

    def is_inside(place: NDArray[Any]) -> bool:
        column, row = np.rint(place).astype(int).tolist()
        return 0 <= column < inside.shape[1] and 0 <= row < inside.shape[0] and bool(inside[row, column])

    glints, rejected = (tuple(g for g in one if is_inside(g.xy_px)) for one in (found.glints, found.rejected))
    pupil = found.pupil
    if pupil.ellipse is not None and not is_inside(pupil.ellipse.centre_px):
        pupil, glints, rejected = PupilResult.missing("coarse search", "its centre is outside the region"), (), ()
    return Extraction(pupil=pupil, glints=glints, rejected=rejected, noise=found.noise, shape=shape).moved(corner)
