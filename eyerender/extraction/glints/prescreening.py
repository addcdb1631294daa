"""A linear fit of a bell to each spot, which rejects most spots that are not glints before the expensive fits."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ...arrays import Bools, Floats, Indices, Singles
from ..compiled import twin
from ..preprocessing import DN, Image

# Largest misfit as a share of the height and of the scatter; smallest fitted peak as a share of the detected height.
# Glints of the development images (rendered and ideal) reach 0.20 and 0.63, and 0.85.
MISFIT_OF_HEIGHT = 0.23
MISFIT_OF_SCATTER = 0.70
LEAST_PEAK = 0.75
MOST_CLIPPED = 1  # clipped pixels; a spot with more is not judged
NARROWEST_PX = 0.9  # a narrower spot is mostly a single pixel
EXPLAINED = 2.0  # a misfit below this many standard deviations of the noise is accepted
LONGEST = 2.5  # largest elongation of the bright patch; glints, and two that touch, reach 2.0


def about(xy: Floats, reach: Floats, shape: tuple[int, ...]) -> tuple[Indices, Singles, Bools]:
    """Find the pixels around n peak pixels xy (n, 2) up to `reach` (n,) px.

    Returns:
        Flat index (n, k), offset (2, k), and whether the pixel lies in the image and within reach (n, k). A pixel
        outside the image has the index of the nearest one inside.
    """
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
def _disc(radius: int) -> tuple[Indices, Indices, Indices, Singles]:
    """Offsets dx and dy, squared distance (k,) of the pixels within a radius, and dx and dy as (2, k)."""
    step = np.arange(-radius, radius + 1)
    away2 = (step * step)[:, None] + step * step
    row, column = np.nonzero(away2 <= radius**2)
    dx, dy = step[column], step[row]
    return dx, dy, away2[row, column], np.stack([dx, dy]).astype(np.float32)


def bell_shaped(
    linear: Image,
    xy: Floats,
    width: Floats,
    height: Floats,
    noise_dn: float,
    clip_dn: float,
    which: Bools | None = None,
) -> Bools:
    """Whether the pixels around each spot form a bell (m,). Skin, lashes and the gaps between lashes do not.

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
        which: (n,) spots to judge; None for all. The others only occupy their pixels.
    """
    index = np.arange(width.size) if which is None else np.flatnonzero(which)
    return _bells(linear, xy, width, height, noise_dn, clip_dn, index)


@twin
def _bells(
    linear: Image, xy: Floats, width: Floats, height: Floats, noise_dn: float, clip_dn: float, index: Indices
) -> Bools:
    """Judge the spots with these indices (m,) (see `bell_shaped`)."""
    out = np.ones(index.size, dtype=bool)
    sigma, tall = np.maximum(width[index], NARROWEST_PX), height[index]  # a narrower one is mostly its pixel
    reach = 2.2 * sigma + 1.0
    at, offset, use = about(xy[index], reach, linear.shape)
    patch = np.take(linear, at)
    clipped = patch >= clip_dn
    judged = np.ones(index.size, dtype=bool)
    if clipped.any():
        # Of other spots only the flanks remain, which do not show the height.
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
    # The ridge keeps the matrix regular where half of the pixels belong to another spot.
    matrix = (terms @ terms.transpose(0, 2, 1)).astype(np.float64) + 1e-6 * np.eye(7)
    found = np.linalg.solve(matrix, (terms @ level[:, :, None]).astype(np.float64))
    rest = (found.transpose(0, 2, 1).astype(np.float32) @ terms)[:, 0] - level
    misfit, scatter = (np.sqrt(np.einsum("nk,nk->n", part, part) / count) for part in (rest, level))
    good = (misfit < MISFIT_OF_HEIGHT * np.minimum(tall, DN)) & (misfit < MISFIT_OF_SCATTER * scatter)
    good &= found[:, 0, 0] > LEAST_PEAK * tall
    good |= misfit <= EXPLAINED * noise_dn
    out[judged] = good & (_elongation(np.where(use, patch, -np.inf), tall, offset) <= LONGEST)
    return out


def _elongation(patch: Singles, tall: Floats, offset: Singles) -> Floats:
    """Ratio (m,) of the standard deviations along and across each patch (m, k).

    Only the part above a third of the height counts.
    """
    weight = np.maximum(patch - (patch.max(axis=1) - 0.65 * tall).astype(np.float32)[:, None], np.float32(0.0))
    dx, dy = offset
    terms = np.stack([np.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy], axis=1)
    total, x, y, xx, xy, yy = (weight @ terms).astype(np.float64).T
    x, y = x / total, y / total
    xx, xy, yy = xx / total - x * x, xy / total - x * y, yy / total - y * y
    mean = 0.5 * (xx + yy) + 1.0 / 12.0  # with a pixel's own
    gap = np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return np.asarray(np.sqrt((mean + gap) / np.maximum(mean - gap, 1e-3)))


def _nearest(use: Bools, offset: Singles, own: Floats, xy: Floats, reach: Floats) -> None:
    """Clear in `use` (m, k) the pixels that lie nearer to another of the spots `xy` than to the patch's own."""
    gx, gy = (xy[None] - own[:, None]).transpose(2, 0, 1)
    apart2 = gx * gx + gy * gy
    near, other = np.nonzero((apart2 < (4.0 * reach**2)[:, None]) & (apart2 > 0.0))
    if near.size:
        toward = np.stack([gx[near, other], gy[near, other]], axis=-1).astype(np.float32)
        nearer = toward @ offset <= 0.5 * apart2[near, other].astype(np.float32)[:, None]
        first = np.flatnonzero(np.diff(near, prepend=-1))
        use[near[first]] &= np.logical_and.reduceat(nearer, first, axis=0)
