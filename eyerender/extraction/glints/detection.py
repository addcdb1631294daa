"""Detection of bright spots near the pupil, which may be glints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from ...base.arrays import Bools, Floats, Indices, Singles
from ...base.jit import compiled, inlined
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, Prepared, as_image
from ..pupil.edges import nearest
from ..pupil.glare import around
from ..settings import ExtractionSettings
from ..statistics import select

SMOOTH_PX = 0.7  # standard deviation of the Gaussian that smooths the image first
MAX_SIGMA_PX = 8.0  # widest spot
# The mean of the 2 x 2 pixels around a sharp peak reaches at least this share of its height.
LEAST_OF_BLOCK = 0.5
# A glint's height above its brightest surroundings is at least this share of its height above the darkest ones.
RING_SHARE = 0.4
MOST_PEAKS = 80  # maxima that are examined, brightest first
# Directions of the sample points of a ring: three circles, each turned against the previous one.
_RING_ANGLE = (np.arange(72) % 24 + np.repeat((0.0, 1.0 / 3.0, 2.0 / 3.0), 24)) * (np.pi / 12.0)
_RING_COS, _RING_SIN = np.cos(_RING_ANGLE), np.sin(_RING_ANGLE)
_COMPASS_COS, _COMPASS_SIN = np.cos(np.arange(12) * (np.pi / 6.0)), np.sin(np.arange(12) * (np.pi / 6.0))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Spots:
    """Detected spots: peaks (n, 2), standard deviations (n,) by the area above half the height, and heights (n,).

    `patches_px` (k, 2) are peaks of bright patches that are not spots.
    """

    xy_px: Floats
    width_px: Floats
    height_dn: Floats
    patches_px: Floats


def detect_spots(
    prepared: Prepared, ellipse: Ellipse, step_dn: float, blur_px: float, settings: ExtractionSettings
) -> Spots:
    """Detect local maxima within `glint_reach` of the pupil that stand out from their surroundings (white top-hat).

    The step from pupil to iris is in DN, the blur of the pupil's edge in px.
    """
    linear = prepared.linear
    reach = search_reach(ellipse, settings)
    (cx, cy), (columns, rows) = ellipse.centre_px, around(ellipse.centre_px, reach, linear.shape)
    x0, y0, crop = columns.start, rows.start, linear[rows, columns]
    crop = crop[: crop.shape[0] // 2 * 2, : crop.shape[1] // 2 * 2]  # whole blocks of the opening
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
    near = (column + x0 - cx) ** 2 + (row + y0 - cy) ** 2 < reach**2  # the crop's corners are too far away
    flat, stands = flat[near], stands[near]
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
    corner = np.array([x0, y0])
    return Spots(
        xy_px=xy[alone] + corner,
        width_px=width[alone],
        height_dn=height[alone],
        patches_px=np.concatenate([patches, xy[~alone]])[: settings.max_glints] + corner,
    )


def search_reach(ellipse: Ellipse, settings: ExtractionSettings) -> float:
    """Compute the distance (px) from the pupil's centre within which glints are searched."""
    return float(ellipse.semi_axes_px[0]) * settings.glint_reach + 8.0


@inlined
def _is_free(xy: Floats, disc: Floats, outer: float, k: int, x: float, y: float) -> bool:
    """Return whether a point on the ring of spot k lies in no other spot's disc."""
    for m in range(disc.size):
        apart2 = (xy[m, 0] - xy[k, 0]) ** 2 + (xy[m, 1] - xy[k, 1]) ** 2
        if 0.0 < apart2 < (outer + disc[m]) ** 2 and (x - xy[m, 0]) ** 2 + (y - xy[m, 1]) ** 2 <= disc[m] ** 2:
            return False
    return True


@compiled("f4[:,::1], f8[:,::1], f8[::1]")
def _above_ring(smooth: Image, xy: Floats, width: Floats) -> Floats:
    """Compute the height (n,) of each peak above the brightest tenth of a ring around it, excluding other spots.

    Peaks on skin, lashes and gaps between lashes have equally bright ones beside them.
    """
    out, level, disc = np.empty(width.size), np.empty(72), np.empty(width.size)
    for k in range(width.size):
        disc[k] = 2.5 * width[k] + 1.0
    for k in range(width.size):
        inner, outer, ring, count = 2.2 * width[k] + 1.0, 3.5 * width[k] + 2.0, 0, 0
        for i in range(72):
            radius = inner + (outer - inner) * (0.1 + 0.4 * (i // 24))
            x, y = xy[k, 0] + radius * _RING_COS[i], xy[k, 1] + radius * _RING_SIN[i]
            if -0.5 < x < smooth.shape[1] - 0.5 and -0.5 < y < smooth.shape[0] - 0.5:
                ring += 1
                if _is_free(xy, disc, outer, k, x, y):
                    level[count] = nearest(smooth, x, y)
                    count += 1
        out[k] = math.inf
        if count > 0.25 * ring:
            brightest = select(level[:count], int(np.rint(0.9 * (count - 1))))
            out[k] = smooth[int(xy[k, 1]), int(xy[k, 0])] - brightest
    return out


def widest(blur_px: float) -> float:
    """Compute the largest standard deviation of a glint, px: a few pixels for the LED's image plus the optical blur."""
    return min(2.5 * optics_sigma(blur_px) + 2.0, MAX_SIGMA_PX)


def optics_sigma(blur_px: float) -> float:
    """Compute the standard deviation of the optical blur, px: that of the edge without the pixel's 1/12 px^2."""
    return math.sqrt(max(blur_px**2 - 1.0 / 12.0, 0.0))


def _compact(smooth: Image, xy: Floats, width: Floats, height: Floats) -> Bools:
    """Return whether the level falls by at least a third of the height in 9 of 12 directions, 2.5 sigma from the peak.

    This rejects strips of sclera and the corners between lid and iris. A glint beside another one or on an edge passes.
    """
    reach = (2.5 * width + 1.5)[:, None]
    column = np.rint(np.clip(xy[:, :1] + reach * _COMPASS_COS, 0.0, smooth.shape[1] - 1.0)).astype(np.intp)
    row = np.rint(np.clip(xy[:, 1:] + reach * _COMPASS_SIN, 0.0, smooth.shape[0] - 1.0)).astype(np.intp)
    top = smooth[xy[:, 1].astype(np.intp), xy[:, 0].astype(np.intp)]
    fallen = top[:, None] - smooth[row, column] > 0.33 * height[:, None]
    return np.asarray(fallen.sum(axis=1) >= 9)


@compiled("f4[:,::1], f8[:,::1], i8, f8")
def _parted(smooth: Image, xy: Floats, size: int, dip: float) -> Indices:
    """Select which of the maxima xy (n, 2), in the given order, are separate spots.

    Two maxima count as one spot unless the level between them falls by `dip` below the lower one, or they are farther
    apart than `size`. The flat tops of clipped spots have several maxima, and so have wide spots with noise.
    """
    kept, count = np.empty(xy.shape[0], dtype=np.int64), 0
    for i in range(xy.shape[0]):
        alone = True
        for m in range(count):
            k = kept[m]
            if (xy[i, 0] - xy[k, 0]) ** 2 + (xy[i, 1] - xy[k, 1]) ** 2 > size**2:
                continue
            least, first, last = np.inf, 0.0, 0.0
            for j in range(2 * size):
                t = j / (2 * size - 1.0)
                last = nearest(smooth, xy[i, 0] + t * (xy[k, 0] - xy[i, 0]), xy[i, 1] + t * (xy[k, 1] - xy[i, 1]))
                first = last if j == 0 else first
                least = min(least, last)
            if least >= min(first, last) - dip:
                alone = False
                break
        if alone:
            kept[count] = i
            count += 1
    return kept[:count].copy()


def _no_spots() -> Spots:
    places, none = np.zeros((0, 2)), np.zeros(0)
    return Spots(xy_px=places, width_px=none, height_dn=none, patches_px=places)


def _opening(half: Image, size: int) -> Image:
    """Compute the level around spots: a square morphological opening of `size` px, at half resolution."""
    side = 2 * (size // 4) + 1
    return as_image(cv2.morphologyEx(half, cv2.MORPH_OPEN, np.ones((side, side), np.uint8)))


@inlined
def _highest(image: Image, y: int, x: int) -> bool:
    """Return whether no neighbour of a pixel is brighter."""
    for j in range(max(y - 1, 0), min(y + 2, image.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, image.shape[1])):
            if image[j, i] > image[y, x]:
                return False
    return True


@compiled("f4[:,::1], f4[:,::1], f4[:,::1], f8")
def _maxima(smooth: Image, half: Image, opened: Image, threshold: float) -> tuple[Indices, Singles]:
    """Detect local maxima above the opened level by the threshold: flat indices (n,), and heights above it (n,)."""
    columns, size, n = half.shape[1], smooth.shape[1], 0
    blocks = np.empty(half.size, dtype=np.int64)
    for y in range(half.shape[0]):
        for x in range(columns):
            if half[y, x] - opened[y, x] > LEAST_OF_BLOCK * threshold:
                blocks[n] = y * columns + x
                n += 1
    flat, height, found = np.empty(4 * n, dtype=np.int64), np.empty(4 * n, dtype=np.float32), 0
    for shift in range(4):
        for k in range(n):
            row, column = blocks[k] // columns, blocks[k] % columns
            y, x = 2 * row + shift // 2, 2 * column + shift % 2
            above = smooth[y, x] - opened[row, column]
            if above > threshold and _highest(smooth, y, x):
                flat[found], height[found] = y * size + x, above
                found += 1
    return flat[:found].copy(), height[:found].copy()


@compiled("f4[:,::1], f4[:,::1], f8[:,::1], f8[::1], i8")
def _widths(smooth: Image, opened: Image, xy: Floats, height: Floats, size: int) -> Floats:
    """Estimate sigma = sqrt(area above half height / (2 pi ln 2)) in a window of the opening's size."""
    out = np.empty(height.size)
    for k in range(height.size):
        x, y, area, limit = int(xy[k, 0]), int(xy[k, 1]), 0, np.float32(0.5 * height[k])
        for j in range(max(y - size // 2, 0), min(y + size // 2 + 1, smooth.shape[0])):
            for i in range(max(x - size // 2, 0), min(x + size // 2 + 1, smooth.shape[1])):
                area += smooth[j, i] - opened[j >> 1, i >> 1] > limit
        square = max(area, 1) / (2.0 * math.pi * math.log(2.0)) - SMOOTH_PX**2
        out[k] = min(max(math.sqrt(max(square, 0.3)), 0.5), MAX_SIGMA_PX)
    return out
