"""Whether a bright place can be a glint at all: one linear look at it, before the costly fits."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..preprocessing import DN, Image

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

# Glints of the development images, rendered and ideal: at most 0.20 and 0.63, at least 0.85.
MISFIT_OF_HEIGHT = 0.23
MISFIT_OF_SCATTER = 0.70
LEAST_PEAK = 0.75
MOST_CLIPPED = 1
NARROWEST_PX = 0.9
EXPLAINED = 2.0  # misfits below this many noises object to nothing
LONGEST = 2.5  # deviations of the bright patch along and across; of glints, and two that run into one, at most 2.0


def about(xy: Array, reach: Array, shape: tuple[int, ...]) -> tuple[Index, NDArray[np.float32], Mask]:
    """(flat index (n, k), offset (2, k), whether it is in the image and within reach (n, k)) of pixels about n peak
    pixels xy (n, 2), reach (n,) px; places beyond the image have their nearest pixel's index."""
    dx, dy, away2, offset = _disc(math.ceil(float(reach.max(initial=0.0))))
    x, y = xy.astype(np.intp).T[:, :, None]
    within = away2 <= (reach**2)[:, None]
    half, (width, height) = int(dx.max()), (shape[1], shape[0])
    if (
        x.min(initial=half) < half
        or y.min(initial=half) < half
        or (x.max(initial=0) + half >= width)
        or (y.max(initial=0) + half >= height)
    ):
        column, row = np.minimum(np.maximum(x + dx, 0), width - 1), np.minimum(np.maximum(y + dy, 0), height - 1)
        within &= (column == x + dx) & (row == y + dy)
        return row * width + column, offset, within
    return y * width + x + (dy * width + dx), offset, within


@lru_cache(maxsize=32)
def _disc(radius: int) -> tuple[Index, Index, Index, NDArray[np.float32]]:
    """dx, dy, squared distance (k,) of the pixels within a radius, and (2, k) dx and dy."""
    step = np.arange(-radius, radius + 1)
    away2 = (step * step)[:, None] + step * step
    row, column = np.nonzero(away2 <= radius**2)
    dx, dy = step[column], step[row]
    return dx, dy, away2[row, column], np.stack([dx, dy]).astype(np.float32)


def bell_shaped(
    linear: Image, xy: Array, width: Array, height: Array, noise_dn: float, clip_dn: float, which: Mask | None = None
) -> Mask:
    """(m,) bool, for each of `which` (all): False where no bell explains the pixels about a spot, as with skin,
    lashes and the gaps between them.

    Linear least squares of the level about the peak, within 2.2 sigma + 1 px and nearer to it than to any other spot:

        c + p dx + q dy + g (h + u dx + v dy + w r^2 / sigma^2),  g = exp(-r^2 / (2 sigma^2)),

    a Gaussian on a plane to first order in its place and width. A glint leaves little of the height, explains most of
    the pixels' scatter, and stands as high as it was detected. Spots that the sensor clipped are not judged.
    xy (n, 2) peak pixels, width (n,) sigma, height (n,) DN.
    """
    index = np.arange(width.size) if which is None else np.flatnonzero(which)
    out = np.ones(index.size, dtype=bool)
    sigma, tall = np.maximum(width[index], NARROWEST_PX), height[index]  # a narrower one is mostly its pixel
    reach = 2.2 * sigma + 1.0
    at, offset, use = about(xy[index], reach, linear.shape)
    patch = np.take(linear, at)
    clipped = patch >= clip_dn
    judged = np.ones(index.size, dtype=bool)
    if clipped.any():
        # What is left of others are the flanks, which tell no height.
        judged = (use & clipped).sum(axis=1) <= MOST_CLIPPED
        use &= ~clipped
    _nearest(use, offset, xy[index], xy, reach)
    count = use.sum(axis=1)
    judged &= count >= 12
    if not judged.any():
        return out
    if not judged.all():
        use, patch, sigma, tall, count = use[judged], patch[judged], sigma[judged], tall[judged], count[judged]
    weight = use.astype(np.float32)
    u, v = (part * (1.0 / sigma).astype(np.float32)[:, None] for part in offset)
    r2 = u * u + v * v
    g = np.exp(np.float32(-0.5) * r2) * weight
    terms = np.empty((g.shape[0], 7, g.shape[1]), np.float32)
    terms[:, 0], terms[:, 1], terms[:, 2], terms[:, 3] = g, g * u, g * v, g * r2
    terms[:, 4], terms[:, 5], terms[:, 6] = weight, u * weight, v * weight
    level = patch * weight
    level -= (level.sum(axis=1) / count).astype(np.float32)[:, None] * weight
    # The ridge keeps patches whose other half is another spot's from being singular.
    matrix = (terms @ terms.transpose(0, 2, 1)).astype(np.float64) + 1e-6 * np.eye(7)
    found = np.linalg.solve(matrix, (terms @ level[:, :, None]).astype(np.float64))
    rest = (found.transpose(0, 2, 1).astype(np.float32) @ terms)[:, 0] - level
    misfit, scatter = (np.sqrt(np.einsum("nk,nk->n", part, part) / count) for part in (rest, level))
    good = (misfit < MISFIT_OF_HEIGHT * np.minimum(tall, DN)) & (misfit < MISFIT_OF_SCATTER * scatter)
    good &= found[:, 0, 0] > LEAST_PEAK * tall
    good |= misfit <= EXPLAINED * noise_dn
    out[judged] = good & (_elongation(np.where(use, patch, -np.inf), tall, offset) <= LONGEST)
    return out


def _elongation(patch: NDArray[np.float32], tall: Array, offset: NDArray[np.float32]) -> Array:
    """(m,) deviation along over that across, of what stands above a third of the height in patches (m, k)."""
    weight = np.maximum(patch - (patch.max(axis=1) - 0.65 * tall).astype(np.float32)[:, None], np.float32(0.0))
    dx, dy = offset
    terms = np.stack([np.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy], axis=1)
    total, x, y, xx, xy, yy = (weight @ terms).astype(np.float64).T
    x, y = x / total, y / total
    xx, xy, yy = xx / total - x * x, xy / total - x * y, yy / total - y * y
    mean = 0.5 * (xx + yy) + 1.0 / 12.0  # with a pixel's own
    gap = np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return np.asarray(np.sqrt((mean + gap) / np.maximum(mean - gap, 1e-3)))


def _nearest(use: Mask, offset: NDArray[np.float32], own: Array, xy: Array, reach: Array) -> None:
    """Leaves in `use` (m, k) the pixels that are no nearer to any of the spots xy than to the own one."""
    gx, gy = (xy[None] - own[:, None]).transpose(2, 0, 1)
    apart2 = gx * gx + gy * gy
    near, other = np.nonzero((apart2 < (4.0 * reach**2)[:, None]) & (apart2 > 0.0))
    if near.size:
        toward = np.stack([gx[near, other], gy[near, other]], axis=-1).astype(np.float32)
        nearer = toward @ offset <= 0.5 * apart2[near, other].astype(np.float32)[:, None]
        first = np.flatnonzero(np.diff(near, prepend=-1))
        use[near[first]] &= np.logical_and.reduceat(nearer, first, axis=0)
