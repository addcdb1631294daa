"""Glints around a candidate, which are removed before its boundary is looked for.

Eight glints of a ring light fill a small pupil: their flanks are the steepest edges there, and the levels inside the
pupil are theirs. A morphological opening gives the level around them.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from ...arrays import Bools
from ...geometry.ellipse import Ellipse
from ..preprocessing import Image, as_image

# A glint is brighter than the iris by this share of the step and stands out of its surroundings by that share of it.
# The texture of an iris reaches a third of the step.
ABOVE_IRIS, STANDS_OUT = 0.25, 0.75
NOISE = 6.0  # in standard deviations: what noise alone does not reach in any pixel
# Flank of a glint below these limits, px. A glint of sigma 2 and four steps falls from one step to a tenth of one in
# 1.1 sigma.
FLANK_PX = 3


def without_glare(
    linear: Image, ellipse: Ellipse, inside_dn: float, step_dn: float, noise_dn: float
) -> tuple[Image, Bools | None]:
    """Replace glints near an ellipse by the level around them.

    Args:
        linear: the image, DN.
        ellipse: the candidate.
        inside_dn: level inside.
        step_dn: step from inside to outside.
        noise_dn: standard deviation of a pixel's noise.

    Returns:
        The image (h, w) and the mask (h, w) of the pixels that were replaced. Without glints: the image and None.
    """
    a, b = ellipse.semi_axes_px.tolist()
    reach = 1.4 * a + 8.0
    (cx, cy), (height, width) = ellipse.centre_px.tolist(), linear.shape
    x0, x1 = max(0, math.floor(cx - reach)), min(width, math.ceil(cx + reach) + 1)
    y0, y1 = max(0, math.floor(cy - reach)), min(height, math.ceil(cy + reach) + 1)
    crop = linear[y0:y1, x0:x1]
    bright = inside_dn + (1.0 + ABOVE_IRIS) * step_dn + NOISE * noise_dn
    if crop.shape[0] < 4 or crop.shape[1] < 4 or not crop.max() > bright:
        return linear, None
    # Half resolution is enough for the level around glints.
    half = as_image(cv2.resize(crop, (crop.shape[1] // 2, crop.shape[0] // 2), interpolation=cv2.INTER_AREA))
    side = 2 * math.ceil(max(11.0, b) / 4.0) + 1
    opened = cv2.morphologyEx(half, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    around = as_image(cv2.resize(opened, (crop.shape[1], crop.shape[0]), interpolation=cv2.INTER_LINEAR))
    glint = (crop > bright) & (crop - around > STANDS_OUT * step_dn + NOISE * noise_dn)
    if not glint.any():
        return linear, None
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * FLANK_PX + 1, 2 * FLANK_PX + 1))
    wide = cv2.dilate(glint.astype(np.uint8), disc).astype(bool)
    cleared, mask = linear.copy(), np.zeros(linear.shape, dtype=bool)
    cleared[y0:y1, x0:x1][wide] = around[wide]
    mask[y0:y1, x0:x1] = wide
    return cleared, mask
