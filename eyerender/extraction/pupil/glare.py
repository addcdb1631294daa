"""Removal of glints around a candidate, before its boundary is searched.

Eight glints of a ring light fill a small pupil: their flanks are the steepest edges, and they determine the levels
inside the pupil. A morphological opening gives the level around them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from ...base.arrays import Bools, Floats
from ...base.jit import compiled
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, as_image
from ..statistics import quantile
from .places import SECTORS

# A glint is brighter than the iris by this share of the step and stands out of its surroundings by that share of it.
# The texture of an iris reaches a third of the step.
ABOVE_IRIS, STANDS_OUT = 0.25, 0.75
# A sharpened iris has as bright pixels. A glint lies above the levels beside the boundary as outliers do: by this many
# interquartile ranges above the upper quartile. Source: Tukey (1977).
FENCE, BESIDE_PX = 1.5, 3.0
NO_PATCH = np.zeros((0, 0), dtype=np.float32)
NOISE = 6.0  # standard deviations that noise alone does not reach in any pixel
# Flank of a glint below these limits, px. A glint of sigma 2 and four steps falls from one step to a tenth of one in
# 1.1 sigma.
FLANK_PX = 3
_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * FLANK_PX + 1, 2 * FLANK_PX + 1))


@dataclass(frozen=True, slots=True, eq=False)
class Inpainted:
    """An image in which glints near a candidate are replaced by the level around them."""

    linear: Image  # (h, w) the image as it is, DN
    corner: tuple[int, int] = (0, 0)  # column and row of the part that differs
    patch: Image | None = None  # (k, l) that part, DN
    mask: Bools | None = None  # (k, l) which of its pixels are replaced

    def cut(self, columns: slice, rows: slice) -> tuple[Image, Bools]:
        """Cut out a part: its levels, and which of its pixels are replaced."""
        crop = self.linear[rows, columns]
        hidden = np.zeros(crop.shape, dtype=bool)
        if self.patch is None or self.mask is None:
            return np.ascontiguousarray(crop), hidden
        crop, (x, y), (height, width) = crop.copy(), self.corner, self.patch.shape
        x0, x1 = max(columns.start, x), min(columns.stop, x + width)
        y0, y1 = max(rows.start, y), min(rows.stop, y + height)
        if x0 < x1 and y0 < y1:
            to = (slice(y0 - rows.start, y1 - rows.start), slice(x0 - columns.start, x1 - columns.start))
            part = (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))
            crop[to], hidden[to] = self.patch[part], self.mask[part]
        return crop, hidden


@compiled("UniTuple(f8, 5), f8, f4[:,::1], UniTuple(i8, 2), f4[:,::1]")
def levels_beside(
    ellipse: tuple[float, ...], away_px: float, linear: Image, corner: tuple[int, int], patch: Image
) -> Image:
    """Return levels (SECTORS,) at pixels `away_px` outside an ellipse (cx, cy, a, b, angle), mid-sector.

    Outside the frame its border is repeated. The part of the image from `corner` on is replaced by `patch`, unless that
    is empty.
    """
    cx, cy, a, b, angle = ellipse
    cos, sin, out = math.cos(angle), math.sin(angle), np.empty(SECTORS, dtype=np.float32)
    for k in range(SECTORS):
        t = 2.0 * math.pi * ((k + 0.5) / SECTORS - 0.5) - angle
        c, s = math.cos(t), math.sin(t)
        nx, ny = b * c, a * s
        height = math.sqrt(nx * nx + ny * ny)
        p, q = a * c + away_px * nx / height, b * s + away_px * ny / height
        column = min(max(int(np.rint(cx + p * cos - q * sin)), 0), linear.shape[1] - 1)
        row = min(max(int(np.rint(cy + p * sin + q * cos)), 0), linear.shape[0] - 1)
        i, j = row - corner[1], column - corner[0]
        replaced = 0 <= i < patch.shape[0] and 0 <= j < patch.shape[1]
        out[k] = patch[i, j] if replaced else linear[row, column]
    return out


def around(centre: Floats, reach: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return slices of columns and rows of an image (h, w) up to `reach` px from a point (2,)."""
    (cx, cy), (height, width) = centre.tolist(), shape
    x0, x1 = max(0, math.floor(cx - reach)), min(width, math.ceil(cx + reach) + 1)
    y0, y1 = max(0, math.floor(cy - reach)), min(height, math.ceil(cy + reach) + 1)
    return slice(x0, max(x0, x1)), slice(y0, max(y0, y1))


def inpaint_glints(linear: Image, ellipse: Ellipse, inside_dn: float, step_dn: float, noise_dn: float) -> Inpainted:
    """Replace glints near an ellipse by the level around them, given the level inside, the step and the noise."""
    a, b = ellipse.semi_axes_px.tolist()
    columns, rows = around(ellipse.centre_px, 1.4 * a + 8.0, linear.shape)
    crop = np.ascontiguousarray(linear[rows, columns])
    beside = levels_beside(ellipse.numbers(), BESIDE_PX, linear, (0, 0), NO_PATCH)
    upper = quantile(beside, 0.75)
    textured = upper + FENCE * (upper - quantile(beside, 0.25))
    bright = max(inside_dn + (1.0 + ABOVE_IRIS) * step_dn + NOISE * noise_dn, textured)
    if crop.shape[0] < 4 or crop.shape[1] < 4 or not crop.max() > bright:
        return Inpainted(linear)
    # Half resolution is enough for the level around glints.
    half = as_image(cv2.resize(crop, (crop.shape[1] // 2, crop.shape[0] // 2), interpolation=cv2.INTER_AREA))
    side = 2 * math.ceil(max(11.0, b) / 4.0) + 1
    opened = cv2.morphologyEx(half, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    level = as_image(cv2.resize(opened, (crop.shape[1], crop.shape[0]), interpolation=cv2.INTER_LINEAR))
    by = STANDS_OUT * step_dn + NOISE * noise_dn
    glint = ((crop > bright) & (crop - level > by)).astype(np.uint8)
    if not np.count_nonzero(glint):
        return Inpainted(linear)
    wide = cv2.dilate(glint, _DISC).view(bool)
    return Inpainted(linear, (columns.start, rows.start), np.where(wide, level, crop), wide)
