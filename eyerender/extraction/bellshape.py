"""Whether a bright place can be a glint at all: one linear look at it, before the costly fits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .preprocess import DN, Image

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


def about(xy: Array, reach: Array, shape: tuple[int, ...]) -> tuple[Index, Index, Array, Mask]:
    """(column, row, squared distance, whether it is in the image and within reach), each (n, k), of pixels about n
    peak pixels xy (n, 2), reach (n,) px; places beyond the image have their nearest pixel's column and row."""
    half = math.floor(float(reach.max(initial=0.0)))
    dy, dx = (part.ravel() for part in np.mgrid[-half : half + 1, -half : half + 1])
    away2 = dx * dx + dy * dy
    order = np.nonzero(away2 <= float(reach.max(initial=0.0)) ** 2)[0]
    dx, dy, away2 = dx[order], dy[order], away2[order]
    x, y = xy[:, :1].astype(np.intp) + dx, xy[:, 1:].astype(np.intp) + dy
    column, row = np.minimum(np.maximum(x, 0), shape[1] - 1), np.minimum(np.maximum(y, 0), shape[0] - 1)
    within = (column == x) & (row == y) & (away2 <= (reach**2)[:, None])
    return column, row, np.broadcast_to(away2.astype(np.float64), column.shape), within


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
    index = np.arange(width.size) if which is None else np.nonzero(which)[0]
    sigma, tall = np.maximum(width[index], NARROWEST_PX), height[index]  # a narrower one is mostly its pixel
    reach = 2.2 * sigma + 1.0
    column, row, away2, use = about(xy[index], reach, linear.shape)
    patch = linear[row, column]
    clipped = patch >= clip_dn
    judged = (use & clipped).sum(axis=1) <= MOST_CLIPPED  # what is left of others are the flanks, which tell no height
    use &= ~clipped
    dx, dy = column - xy[index, :1], row - xy[index, 1:]
    apart = np.hypot(*np.moveaxis(xy[index, None] - xy[None], -1, 0))
    for i, k in zip(*np.nonzero((apart < 2.0 * reach[:, None]) & (apart > 0.0)), strict=True):
        gx, gy = xy[index[i]] - xy[k]
        use[i] &= (dx[i] + gx) ** 2 + (dy[i] + gy) ** 2 >= away2[i]
    count = use.sum(axis=1)
    judged &= count >= 12
    out = np.ones(index.size, dtype=bool)
    if not judged.any():
        return out
    dx, dy, use, patch = dx[judged], dy[judged], use[judged].astype(np.float64), patch[judged]
    sigma, tall, count = sigma[judged], tall[judged], count[judged]
    u, v = dx / sigma[:, None], dy / sigma[:, None]
    r2 = u * u + v * v
    g = np.exp(-0.5 * r2)
    terms = np.stack([g, g * u, g * v, g * r2, np.ones_like(u), u, v], axis=1) * use[:, None, :]
    level = patch.astype(np.float64)
    level = (level - ((level * use).sum(axis=1) / count)[:, None]) * use
    # The ridge keeps patches whose other half is another spot's from being singular.
    matrix = terms @ terms.transpose(0, 2, 1) + 1e-6 * np.eye(7)
    found = np.linalg.solve(matrix, terms @ level[:, :, None])
    misfit = np.sqrt((((found.transpose(0, 2, 1) @ terms)[:, 0] - level) ** 2).sum(axis=1) / count)
    scatter = np.sqrt((level**2).sum(axis=1) / count)
    good = (misfit < MISFIT_OF_HEIGHT * np.minimum(tall, DN)) & (misfit < MISFIT_OF_SCATTER * scatter)
    good &= found[:, 0, 0] > LEAST_PEAK * tall
    out[judged] = good | (misfit <= EXPLAINED * noise_dn)
    return out
