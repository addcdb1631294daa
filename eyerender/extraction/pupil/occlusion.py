"""Occlusion: which pixels and sectors of the boundary fit the pixel model, and how uneven the boundary is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...arrays import Bools, Floats, Indices
from ...jit import compiled, inlined
from ..products import largest_size, selected
from ..statistics import quantile_of
from .consensus import UNEVEN
from .edge_model import BY_DISTANCE, RAMP, RAMP_BY_DISTANCE, EdgeModel, local_levels, profiles
from .least_squares import Band
from .places import BLOCK, COS_U, CURVATURE, SECTORS, SIN_U, places, sector_at

OUTLIER = 5.0  # pixels with a larger residual, in standard deviations, are left out
LINEAR = 0.1  # a displacement below this share of the blur changes the levels linearly
FARTHEST = 3.5  # largest displacement of a sector, in standard deviations of what unevenness and noise make likely


@dataclass(frozen=True, slots=True, eq=False)
class Visible:
    """The part of a boundary that fits the model.

    Attributes:
        use: (n,) which pixels are not outliers.
        explained: (SECTORS,) which sectors the model explains.
        uneven_px: standard deviation of the sectors' displacements from the ellipse.
        displaced: (SECTORS,) most likely displacements, px inward.
        bins: (n,) sector of each pixel.
    """

    use: Bools
    explained: Bools
    uneven_px: float
    displaced: Floats
    bins: Indices


def visible_part(
    model: EdgeModel, displaced: Floats, band: Band, use: Bools, seen: Bools, sectors: Bools, noise_dn: float
) -> Visible:
    """Decide which pixels and sectors of the boundary the model explains.

    A pupil boundary is not exactly an ellipse. `uneven_px` is the scatter of its sectors around the ellipse, from their
    median. A sector is explained if it is displaced no farther than unevenness and noise make likely, if its mean
    squared residual is at most a multiple of a typical sector's, and if few of its pixels are outliers. The limits are
    generous where edge points were found, because iris texture is not a lid, and strict elsewhere.

    Args:
        model: the fitted model.
        displaced: (SECTORS,) fitted displacements, px inward.
        band: n pixels.
        use: (n,) pixels that the fit used.
        seen: (SECTORS,) sectors that the fit used.
        sectors: (SECTORS,) sectors with edge points.
        noise_dn: standard deviation of a pixel's noise.
    """
    numbers = model.numbers()
    bins, look = _look(band.x, band.y, numbers)
    found = _displacements(bins, look, band.level, use, numbers, displaced)
    uneven_px = UNEVEN * math.sqrt(numbers[2] * numbers[3])
    return Visible(*_visible(bins, found, use, seen, sectors, noise_dn, uneven_px), bins)


@compiled("f8[::1], f8[::1], f8[::1]")
def _look(x: Floats, y: Floats, numbers: Floats) -> tuple[Indices, Floats]:
    """Compute the sector (n,) of each pixel, and its distance, curvature and `local_levels` (6, n)."""
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    bins, out = np.empty(x.size, dtype=np.int64), np.empty((6, x.size))
    place, basis, local = np.empty(8 * BLOCK), np.empty(2 * BLOCK), np.empty(4 * BLOCK)
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        places(ellipse, x, y, start, count, place)
        local_levels(place, count, numbers, basis, local)
        for i in range(count):
            bins[start + i] = sector_at(place[COS_U + i], place[SIN_U + i])
            out[0, start + i], out[1, start + i] = place[i], place[CURVATURE + i]
            for k in range(4):
                out[2 + k, start + i] = local[k * BLOCK + i]
    return bins, out


@compiled("i8[::1], f8[:,::1], f8[::1], b1[::1], f8[::1], f8[::1]")
def _displacements(
    bins: Indices, look: Floats, level: Floats, use: Bools, numbers: Floats, displaced: Floats
) -> tuple[Floats, Floats, Floats]:
    """Estimate the displacement of every sector from its pixels, given the result of `_look`.

    Returns:
        The residual of each pixel (n,), the displacements (SECTORS,) and their weights (SECTORS,).
    """
    sigma, n = numbers[5], bins.size
    place, edge, residual, steep = np.empty(8 * BLOCK), np.empty(7 * BLOCK), np.empty(n), np.empty(n)
    whole, weight, further = displaced.copy(), np.empty(SECTORS), np.empty(SECTORS)
    for _ in range(2):  # the levels are not linear in a displacement as large as the blur
        weight.fill(0.0)
        further.fill(0.0)
        for start in range(0, n, BLOCK):
            count = min(BLOCK, n - start)
            for i in range(count):
                place[i], place[CURVATURE + i] = look[0, start + i] + whole[bins[start + i]], look[1, start + i]
            profiles(place, count, sigma, numbers[8], edge)
            for i in range(count):
                inner, step, within, bend = look[2:, start + i]
                steep[start + i] = step * edge[BY_DISTANCE + i] + within + bend * edge[RAMP_BY_DISTANCE + i]
                expected = inner + step * edge[i] + within * place[i] + bend * edge[RAMP + i]
                residual[start + i] = level[start + i] - expected
        for i in range(n):
            if use[i]:
                weight[bins[i]] += steep[i] ** 2
                further[bins[i]] += steep[i] * residual[i]
        largest = 0.0
        for k in range(SECTORS):
            further[k] = min(max(further[k] / weight[k], -sigma), sigma) if weight[k] > 1e-9 else 0.0
            whole[k] += further[k]
            largest = max(largest, abs(further[k]))
        if largest < LINEAR * sigma:
            break
    for i in range(n):
        residual[i] -= steep[i] * further[bins[i]]
    return residual, whole, weight


@inlined
def _uneven2(seen: Bools, whole: Floats, weight: Floats, by_noise: Floats) -> float:
    """Compute the variance, beyond noise, of the displacements of visible sectors that their pixels determine."""
    least, n = 0.1 * largest_size(weight), 0
    size, noise = np.empty(SECTORS), np.empty(SECTORS)
    for k in range(SECTORS):
        if seen[k] and weight[k] > least:
            size[n], noise[n] = abs(whole[k]), by_noise[k]
            n += 1
    if n == 0:
        return 0.0
    return max((1.4826 * quantile_of(size[:n], 0.5)) ** 2 - 1.3 * quantile_of(noise[:n], 0.5), 0.0)


@compiled("i8[::1], UniTuple(f8[::1], 3), b1[::1], b1[::1], b1[::1], f8, f8")
def _visible(
    bins: Indices, found: tuple[Floats, ...], use: Bools, seen: Bools, sectors: Bools, noise_dn: float, uneven_px: float
) -> tuple[Bools, Bools, float, Floats]:
    """Compute the parts of `Visible`, except the sectors of the pixels, from the result of `_displacements`."""
    residual, whole, weight = found
    by_noise = np.empty(SECTORS)
    for k in range(SECTORS):
        by_noise[k] = noise_dn * noise_dn / max(weight[k], 1e-9)
    uneven2 = _uneven2(seen, whole, weight, by_noise)
    some, n = np.empty(bins.size), 0
    for i in range(bins.size):
        if use[i] and seen[bins[i]]:
            some[n] = abs(residual[i])
            n += 1
    scale = max(1.4826 * quantile_of(some[:n], 0.5), noise_dn, 1e-3)
    new_use, total = np.empty(bins.size, dtype=np.bool_), np.zeros(SECTORS)
    square, outliers = np.zeros(SECTORS), np.zeros(SECTORS)
    for i in range(bins.size):
        k = bins[i]
        new_use[i] = abs(residual[i]) < OUTLIER * scale
        total[k] += 1.0
        square[k] += min((residual[i] / scale) ** 2, OUTLIER**2)
        outliers[k] += not new_use[i]
    for k in range(SECTORS):
        square[k] /= max(total[k], 1.0)
        outliers[k] /= max(total[k], 1.0)
    usual = max(quantile_of(selected(square, seen), 0.5), 1.0)
    explained, likely = np.empty(SECTORS, dtype=np.bool_), np.zeros(SECTORS)
    for k in range(SECTORS):
        often, rarely, far2 = (5.0, 0.25, max(uneven2, uneven_px * uneven_px)) if sectors[k] else (2.5, 0.1, uneven2)
        explained[k] = square[k] < often * usual and outliers[k] < rarely
        explained[k] = explained[k] and abs(whole[k]) < FARTHEST * math.sqrt(far2 + by_noise[k])
        if explained[k]:
            likely[k] = whole[k] * uneven2 / (uneven2 + by_noise[k])
    return new_use, explained, math.sqrt(uneven2), likely


def clear_of_lids(seen: Bools, model: EdgeModel) -> Bools:
    """Exclude the sectors beside each gap of two or more, as far as the blur of a lid margin extends."""
    if seen.all():
        return seen
    gap = ~seen & (~np.roll(seen, 1) | ~np.roll(seen, -1))
    length = math.pi * float(model.ellipse.semi_axes_px.sum()) / SECTORS
    for _ in range(min(math.ceil(2.0 * model.sigma_px / length), 3)):
        gap = gap | np.roll(gap, 1) | np.roll(gap, -1)
    return np.asarray(seen & ~gap)
