"""Detection of bright spots near the pupil, which may be glints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from ...arrays import Bools, Floats, Indices, Singles
from ...geometry.ellipse import Ellipse
from ..compiled import twin
from ..preprocessing import Image, Prepared, as_image
from ..settings import ExtractionSettings
from .prescreening import bell_shaped

SMOOTH_PX = 0.7  # standard deviation of the Gaussian that smooths the image first
MAX_SIGMA_PX = 8.0  # widest spot
# The mean of the 2 x 2 pixels around a sharp peak reaches at least this share of its height.
LEAST_OF_BLOCK = 0.5
# A glint's height above its brightest surroundings is at least this share of its height above the darkest ones.
RING_SHARE = 0.4
MOST_PEAKS = 80  # maxima that are examined, brightest first

_COS, _SIN = np.cos(np.arange(12) * (np.pi / 6.0)), np.sin(np.arange(12) * (np.pi / 6.0))
# Sample points of a ring: three circles, each turned against the previous one.
_RING_STEPS = np.repeat((0.1, 0.5, 0.9), 24)
_RING_ANGLE = (np.arange(72) % 24 + np.repeat((0.0, 1.0 / 3.0, 2.0 / 3.0), 24)) * (np.pi / 12.0)
_RING_COS, _RING_SIN = np.cos(_RING_ANGLE), np.sin(_RING_ANGLE)


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """Detected spots.

    Attributes:
        xy_px: (n, 2) peak pixels.
        width_px: (n,) standard deviation, estimated from the area above half the height.
        height_dn: (n,) height above the surroundings.
        patches_px: (k, 2) peaks of bright patches that are not spots.
        clutter: xy, width and height of spots that are not bell-shaped. They are not fitted, and the pixel model of the
            pupil boundary leaves their pixels out.
    """

    xy_px: Floats
    width_px: Floats
    height_dn: Floats
    patches_px: Floats
    clutter: tuple[Floats, Floats, Floats]


def detect_spots(
    prepared: Prepared, ellipse: Ellipse, step_dn: float, blur_px: float, settings: ExtractionSettings
) -> Spots:
    """Find local maxima that stand out from their surroundings (white top-hat).

    Args:
        prepared: the image.
        ellipse: the pupil, around which spots are searched.
        step_dn: step from pupil to iris, DN.
        blur_px: blur of the pupil's edge.
        settings: settings; `glint_reach` limits the search.
    """
    linear = prepared.linear
    reach = float(ellipse.semi_axes_px[0]) * settings.glint_reach + 8.0
    cx, cy = ellipse.centre_px
    x0, x1 = max(0, math.floor(cx - reach)), min(linear.shape[1], math.ceil(cx + reach) + 1)
    y0, y1 = max(0, math.floor(cy - reach)), min(linear.shape[0], math.ceil(cy + reach) + 1)
    x1, y1 = x1 - (x1 - x0) % 2, y1 - (y1 - y0) % 2  # whole blocks of the opening
    crop = linear[y0:y1, x0:x1]
    if crop.shape[0] < 6 or crop.shape[1] < 6:
        return _no_spots()
    smooth = as_image(cv2.GaussianBlur(crop, (5, 5), SMOOTH_PX))
    size = 2 * math.ceil(3.0 * max(blur_px, 1.0) + 3.0) + 1
    # The top-hat of pure noise is about 3 standard deviations of the smoothed noise everywhere.
    noise = prepared.noise_dn / (2.0 * math.sqrt(math.pi) * SMOOTH_PX)
    threshold = max(9.0 * noise, 0.6 * step_dn)
    blocks = (smooth.shape[1] // 2, smooth.shape[0] // 2)
    half = as_image(cv2.resize(smooth, blocks, interpolation=cv2.INTER_AREA))
    opened = _opening(half, size)
    flat, stands = _maxima(smooth, half, opened, threshold)
    row, column = np.divmod(flat, smooth.shape[1])
    around = (column + x0 - cx) ** 2 + (row + y0 - cy) ** 2 < reach**2  # the corners of the crop are beyond
    flat, stands = flat[around], stands[around]
    if flat.size == 0:
        return _no_spots()
    order = np.argsort(-stands, kind="stable")[:MOST_PEAKS]
    row, column = np.divmod(flat[order], smooth.shape[1])
    xy, height = np.stack([column, row], axis=-1).astype(np.float64), stands[order].astype(np.float64)
    width = _widths(smooth, opened, xy, height, size)
    spot = _compact(smooth, xy, width, height) & (width < widest(blur_px))
    patches = xy[~spot & (height > 1.5 * threshold)][: settings.max_glints]
    xy, width, height = xy[spot], width[spot], height[spot]
    keep = _parted(smooth, xy, size, 4.0 * noise)[: settings.max_glints + 8]
    xy, width, height = xy[keep], width[keep], height[keep]
    alone = _above_ring(smooth, xy, width) > RING_SHARE * height
    bell = alone.copy()
    corner = np.array([x0, y0])
    bell[alone] = bell_shaped(linear, xy + corner, width, height, prepared.noise_dn, prepared.clip_dn, alone)
    patches = np.concatenate([patches, xy[~bell]])[: settings.max_glints]
    clutter = alone & ~bell
    return Spots(
        xy[bell] + corner, width[bell], height[bell], patches + corner,
        (xy[clutter] + corner, width[clutter], height[clutter]),
    )  # fmt: skip


def _sampled(smooth: Image, xy: Floats, x: Floats, y: Floats) -> Singles:
    """Levels (n, k) of the pixels nearest to the peaks xy (n, 2) plus the offsets x and y, (n, k) each."""
    height, width = smooth.shape
    column = np.rint(np.minimum(np.maximum(xy[:, :1] + x, 0.0), width - 1.0)).astype(np.intp)
    row = np.rint(np.minimum(np.maximum(xy[:, 1:] + y, 0.0), height - 1.0)).astype(np.intp)
    return np.asarray(np.take(smooth, row * width + column), dtype=np.float32)


@twin
def _above_ring(smooth: Image, xy: Floats, width: Floats) -> Floats:
    """Height (n,) of each peak above the brightest tenth of a ring around it. Pixels of other spots are left out.

    Skin, lashes and the gaps between lashes have many peaks, with equally bright ones beside them.
    """
    inner, outer, disc = 2.2 * width + 1.0, 3.5 * width + 2.0, 2.5 * width + 1.0
    radius = inner[:, None] + (outer - inner)[:, None] * _RING_STEPS
    x, y = radius * _RING_COS, radius * _RING_SIN
    at_x, at_y = xy[:, :1] + x, xy[:, 1:] + y
    free = (at_x > -0.5) & (at_y > -0.5) & (at_x < smooth.shape[1] - 0.5) & (at_y < smooth.shape[0] - 0.5)
    ring = free.sum(axis=1)
    apart2 = ((xy[:, None] - xy) ** 2).sum(axis=-1)
    to, by = np.nonzero((apart2 < (outer[:, None] + disc) ** 2) & (apart2 > 0.0))
    if to.size:
        clear = (at_x[to] - xy[by, :1]) ** 2 + (at_y[to] - xy[by, 1:]) ** 2 > (disc[by] ** 2)[:, None]
        first = np.flatnonzero(np.diff(to, prepend=-1))
        free[to[first]] &= np.logical_and.reduceat(clear, first, axis=0)
    count = free.sum(axis=1)
    level = np.sort(np.where(free, _sampled(smooth, xy, x, y), np.float32(np.inf)), axis=1)
    told = np.flatnonzero(count > 0.25 * ring)
    out = np.full(width.size, np.inf)
    brightest = level[told, np.rint(0.9 * (count[told] - 1)).astype(np.intp)]
    out[told] = smooth[xy[told, 1].astype(np.intp), xy[told, 0].astype(np.intp)] - brightest
    return out


def widest(blur_px: float) -> float:
    """Largest standard deviation of a glint, px: a few pixels for the LED's image, plus the blur of the optics."""
    return min(2.5 * optics_sigma(blur_px) + 2.0, MAX_SIGMA_PX)


def optics_sigma(blur_px: float) -> float:
    """Standard deviation of the optical blur, px: the edge's blur without the variance of a pixel, 1/12 px^2."""
    return math.sqrt(max(blur_px**2 - 1.0 / 12.0, 0.0))


@twin
def _compact(smooth: Image, xy: Floats, width: Floats, height: Floats) -> Bools:
    """Whether the level falls by at least a third of the height in 9 of 12 directions, 2.5 sigma from the peak.

    This rejects strips of sclera and the corners between lid and iris. A glint beside another one or on an edge passes.
    """
    reach = (2.5 * width + 1.5)[:, None]
    top = np.take(smooth, (xy[:, 1] * smooth.shape[1] + xy[:, 0]).astype(np.intp))
    fallen = top[:, None] - _sampled(smooth, xy, reach * _COS, reach * _SIN) > 0.33 * height[:, None]
    return np.asarray(fallen.sum(axis=1) >= 9)


@twin
def _parted(smooth: Image, xy: Floats, size: int, dip: float) -> Indices:
    """Indices of the maxima xy (n, 2) that are spots of their own, in the given order.

    Two maxima count as one spot unless the level between them falls by `dip` below the lower one, or they are farther
    apart than `size`. The flat tops of clipped spots have several maxima, and so have wide spots with noise.
    """
    gap = xy[:, None] - xy
    one, other = np.nonzero(np.tril((gap**2).sum(axis=-1) <= size**2, -1))
    rival: dict[int, list[int]] = {}
    if one.size:
        t = np.linspace(0.0, 1.0, 2 * size)
        way = xy[other] - xy[one]
        between = _sampled(smooth, xy[one], way[:, :1] * t, way[:, 1:] * t)
        same = between.min(axis=1) >= np.minimum(between[:, 0], between[:, -1]) - dip
        for i, k in zip(one[same].tolist(), other[same].tolist(), strict=True):
            rival.setdefault(i, []).append(k)
    kept: dict[int, None] = {}
    for i in range(xy.shape[0]):
        if not any(k in kept for k in rival.get(i, ())):
            kept[i] = None
    return np.array(list(kept), dtype=np.intp)


def _no_spots() -> Spots:
    none = (np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    return Spots(*none, np.zeros((0, 2)), none)


def _opening(half: Image, size: int) -> Image:
    """Level around spots: a square morphological opening of `size` px. Half resolution is enough for it."""
    side = 2 * (size // 4) + 1
    return as_image(cv2.morphologyEx(half, cv2.MORPH_OPEN, np.ones((side, side), np.uint8)))


@twin
def _maxima(smooth: Image, half: Image, opened: Image, threshold: float) -> tuple[Indices, Singles]:
    """Find local maxima that exceed the opened level by the threshold: flat indices (n,), and heights above it (n,)."""
    blocks = np.flatnonzero(half - opened > LEAST_OF_BLOCK * threshold)
    width, columns = smooth.shape[1], half.shape[1]
    row, column = np.divmod(blocks, columns)
    first = 2 * (row * width + column)
    level = np.take(opened, blocks)
    flat, height = np.empty((4, blocks.size), dtype=np.intp), np.empty((4, blocks.size), np.float32)
    top = cv2.dilate(smooth, np.ones((3, 3), np.uint8))
    for i, shift in enumerate((0, 1, width, width + 1)):
        np.add(first, shift, out=flat[i])
        height[i] = np.take(smooth, flat[i])
    high = (height - level > threshold) & (height >= np.take(top, flat))
    return flat[high], (height - level)[high]


@twin
def _widths(smooth: Image, opened: Image, xy: Floats, height: Floats, size: int) -> Floats:
    """Estimate sigma = sqrt(area above half height / (2 pi ln 2)) in a window of the opening's size."""
    step, (rows, columns) = np.arange(-(size // 2), size // 2 + 1), smooth.shape
    x, y = xy.astype(np.intp).T[:, :, None] + step
    column, row = np.minimum(np.maximum(x, 0), columns - 1), np.minimum(np.maximum(y, 0), rows - 1)
    inside = (column == x)[:, None, :] & (row == y)[:, :, None]
    flat = (row * smooth.shape[1])[:, :, None] + column[:, None, :]
    flat_half = ((row >> 1) * opened.shape[1])[:, :, None] + (column >> 1)[:, None, :]
    hat = np.take(smooth, flat) - np.take(opened, flat_half)
    high = hat > (0.5 * height).astype(np.float32)[:, None, None]
    area = (high & inside).reshape(height.size, -1).sum(axis=1)
    out = np.sqrt(np.maximum(area, 1) / (2.0 * math.pi * math.log(2.0)))
    sharp: Floats = np.sqrt(np.maximum(out**2 - SMOOTH_PX**2, 0.3))
    return np.clip(sharp, 0.5, MAX_SIGMA_PX)
