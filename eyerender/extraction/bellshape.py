"""Whether a bright place can be a glint at all: one linear look at it, before the costly fits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .preprocess import DN, Image

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Glints of the development images, rendered and ideal: at most 0.20 and 0.63, at least 0.85.
MISFIT_OF_HEIGHT = 0.23
MISFIT_OF_SCATTER = 0.70
LEAST_PEAK = 0.75
MOST_CLIPPED = 1
NARROWEST_PX = 0.9
EXPLAINED = 2.0  # misfits below this many noises object to nothing


def bell_shaped(linear: Image, xy: Array, width: Array, height: Array, noise_dn: float, clip_dn: float) -> Mask:
    """(n,) bool: False where no bell explains the pixels about a spot, as with skin, lashes and the gaps between them.

    Linear least squares of the level about the peak, within 2.2 sigma + 1 px and nearer to it than to any other spot:

        c + p dx + q dy + g (h + u dx + v dy + w r^2 / sigma^2),  g = exp(-r^2 / (2 sigma^2)),

    a Gaussian on a plane to first order in its place and width. A glint leaves little of the height, explains most of
    the pixels' scatter, and stands as high as it was detected. Spots that the sensor clipped are not judged.
    xy (n, 2) peak pixels, width (n,) sigma, height (n,) DN.
    """
    out = np.ones(width.size, dtype=bool)
    for i, ((x, y), sigma, tall) in enumerate(zip(xy.tolist(), width.tolist(), height.tolist(), strict=True)):
        sigma = max(sigma, NARROWEST_PX)  # a narrower one is mostly its pixel
        reach = 2.2 * sigma + 1.0
        x0, x1 = max(0, math.ceil(x - reach)), min(linear.shape[1], math.floor(x + reach) + 1)
        y0, y1 = max(0, math.ceil(y - reach)), min(linear.shape[0], math.floor(y + reach) + 1)
        patch = linear[y0:y1, x0:x1]
        dx, dy = np.arange(x0, x1)[None, :] - x, np.arange(y0, y1)[:, None] - y
        away = dx * dx + dy * dy
        use = away <= reach * reach
        if np.count_nonzero(use & (patch >= clip_dn)) > MOST_CLIPPED:
            continue  # what is left of it are the flanks, which tell no height
        use &= patch < clip_dn
        for k in np.nonzero(np.hypot(*(xy - xy[i]).T) < 2.0 * reach)[0]:
            if k != i:
                use &= (dx + (x - xy[k, 0])) ** 2 + (dy + (y - xy[k, 1])) ** 2 >= away
        if np.count_nonzero(use) < 12:
            continue
        u, v = np.broadcast_arrays(dx, dy)
        u, v, level = u[use] / sigma, v[use] / sigma, patch[use].astype(np.float64)
        r2 = u * u + v * v
        g = np.exp(-0.5 * r2)
        terms = np.stack([g, g * u, g * v, g * r2, np.ones_like(u), u, v])
        level -= level.mean()
        # The ridge keeps patches whose other half is another spot's from being singular.
        matrix = terms @ terms.T + 1e-6 * np.eye(7)
        found = np.linalg.solve(matrix, terms @ level)
        misfit = math.sqrt(float(np.mean((found @ terms - level) ** 2)))
        scatter = math.sqrt(float(np.mean(level**2)))
        if misfit > EXPLAINED * noise_dn:
            out[i] = (
                misfit < MISFIT_OF_HEIGHT * min(tall, DN)
                and misfit < MISFIT_OF_SCATTER * scatter
                and float(found[0]) > LEAST_PEAK * tall
            )
    return out
