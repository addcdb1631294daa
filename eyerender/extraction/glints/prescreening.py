"""Linear fit of a bell to each spot, which rejects most spots that are not glints before the expensive fits."""

from __future__ import annotations

import math

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined
from ..preprocessing import DN, Image
from ..products import add_products, solve

# Largest misfit as a share of the height and of the scatter; smallest fitted peak as a share of the detected height.
# Glints of the development images (rendered and ideal) reach 0.20 and 0.63, and 0.85.
MISFIT_OF_HEIGHT = 0.23
MISFIT_OF_SCATTER = 0.70
LEAST_PEAK = 0.75
MOST_CLIPPED = 1  # clipped pixels; a spot with more is not judged
NARROWEST_PX = 0.9  # a narrower spot is mostly a single pixel
EXPLAINED = 2.0  # a misfit below this many standard deviations of the noise is accepted
PIXEL = 1.0 / 12.0  # variance of a pixel, px^2; without it a spot of one row of pixels would be a line
LONGEST = 2.5  # largest elongation of the bright patch; glints, and two that touch, reach 2.0


@inlined
def _owns(xy: Floats, k: int, reach: float, dx: float, dy: float) -> bool:
    """Return whether a pixel near spot k is nearer to it than to any other spot."""
    for m in range(xy.shape[0]):
        gx, gy = xy[m, 0] - xy[k, 0], xy[m, 1] - xy[k, 1]
        apart2 = gx * gx + gy * gy
        if 0.0 < apart2 < 4.0 * reach * reach and gx * dx + gy * dy > 0.5 * apart2:
            return False
    return True


@inlined
def _patch(linear: Image, xy: Floats, k: int, reach: float, clip_dn: float, out: Floats) -> int:
    """Write the offsets and levels of a spot's own pixels; return their number, -1 for a clipped spot."""
    half, count, clipped = math.ceil(reach), 0, 0
    x, y = int(xy[k, 0]), int(xy[k, 1])
    for dy in range(-half, half + 1):
        for dx in range(-half, half + 1):
            i, j = x + dx, y + dy
            if dx * dx + dy * dy > reach * reach or not (0 <= i < linear.shape[1] and 0 <= j < linear.shape[0]):
                continue
            if linear[j, i] >= clip_dn:
                clipped += 1
            elif _owns(xy, k, reach, dx, dy):
                out[count, 0], out[count, 1], out[count, 2] = dx, dy, linear[j, i]
                count += 1
    return -1 if clipped > MOST_CLIPPED else count


@inlined
def _elongation(pixels: Floats, tall: float) -> float:
    """Compute the ratio of the standard deviations along and across a patch (n, 3) of offsets and levels.

    Only the part above a third of the height counts.
    """
    top, total, x, y, xx, xy, yy = -math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(pixels.shape[0]):
        top = max(top, pixels[i, 2] - 0.65 * tall)
    for i in range(pixels.shape[0]):
        dx, dy, weight = pixels[i, 0], pixels[i, 1], max(pixels[i, 2] - top, 0.0)
        total, x, y = total + weight, x + weight * dx, y + weight * dy
        xx, xy, yy = xx + weight * dx * dx, xy + weight * dx * dy, yy + weight * dy * dy
    x, y = x / total, y / total
    xx, xy, yy = xx / total - x * x, xy / total - x * y, yy / total - y * y
    mean, gap = 0.5 * (xx + yy) + PIXEL, math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return math.sqrt((mean + gap) / max(mean - gap, 1e-3))


@inlined
def _is_bell(pixels: Floats, sigma: float, tall: float, noise_dn: float) -> bool:
    """Return whether the levels of a patch (n, 3) of offsets and levels form a bell."""
    n, mean = pixels.shape[0], 0.0
    terms, gram = np.empty((8, n)), np.zeros((8, 8))
    for i in range(n):
        mean += pixels[i, 2] / n
    for i in range(n):
        u, v = pixels[i, 0] / sigma, pixels[i, 1] / sigma
        g = math.exp(-0.5 * (u * u + v * v))
        terms[0, i], terms[1, i], terms[2, i], terms[3, i] = g, g * u, g * v, g * (u * u + v * v)
        terms[4, i], terms[5, i], terms[6, i], terms[7, i] = 1.0, u, v, pixels[i, 2] - mean
    add_products(terms, 0, n, gram)
    matrix = np.empty((7, 7))
    for j in range(7):
        for m in range(j + 1):
            matrix[j, m] = matrix[m, j] = gram[j, m]
        matrix[j, j] += 1e-6  # keeps the matrix regular if half of the pixels belong to another spot
    found = np.empty(7)
    for j in range(7):
        found[j] = gram[7, j]
    solve(matrix, found)
    cost = 0.0
    for i in range(n):
        left = -terms[7, i]
        for j in range(7):
            left += found[j] * terms[j, i]
        cost += left * left
    misfit, scatter = math.sqrt(cost / n), math.sqrt(gram[7, 7] / n)
    good = misfit < MISFIT_OF_HEIGHT * min(tall, DN) and misfit < MISFIT_OF_SCATTER * scatter
    good = (good and found[0] > LEAST_PEAK * tall) or misfit <= EXPLAINED * noise_dn
    return good and _elongation(pixels, tall) <= LONGEST


@compiled("f4[:,::1], f8[:,::1], f8[::1], f8[::1], f8, f8, i8[::1]")
def gaussian_like(
    linear: Image, xy: Floats, width: Floats, height: Floats, noise_dn: float, clip_dn: float, index: Indices
) -> Bools:
    """Return whether the pixels around spots form a bell (m,); those of skin, lashes and gaps do not.

    The level within 2.2 sigma + 1 px of the peak is fitted by linear least squares. Pixels nearer to another spot are
    left out. The model is

        c + p dx + q dy + g (h + u dx + v dy + w r^2 / sigma^2),  g = exp(-r^2 / (2 sigma^2)),

    a Gaussian on a plane, to first order in its position and width. For a glint the misfit is a small share of the
    height and of the pixels' scatter, and the fitted peak is as high as the detected one. Clipped spots are accepted.

    Args:
        linear: the image, DN.
        xy: (n, 2) peak pixels.
        width: (n,) standard deviations, px.
        height: (n,) DN.
        noise_dn: standard deviation of a pixel's noise.
        clip_dn: level at which the sensor clips.
        index: (m,) spots to judge; the others only occupy their pixels.
    """
    out = np.empty(index.size, dtype=np.bool_)
    for m in range(index.size):
        k = index[m]
        sigma = max(width[k], NARROWEST_PX)
        reach = 2.2 * sigma + 1.0
        pixels = np.empty(((2 * math.ceil(reach) + 1) ** 2, 3))
        count = _patch(linear, xy, k, reach, clip_dn, pixels)
        out[m] = count < 12 or _is_bell(pixels[:count], sigma, height[k], noise_dn)
    return out
