"""Occlusion: which pixels and sectors of the boundary fit the pixel model, and how uneven the boundary is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ..statistics import median
from .consensus import UNEVEN
from .edge_model import EdgeModel, boundary_terms, levels_and_slopes
from .least_squares import Band
from .places import SECTORS

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
    bins, terms = boundary_terms(band.x, band.y, numbers)
    found = _displacements(bins, terms, band.level, use, numbers, displaced)
    uneven_px = UNEVEN * math.sqrt(numbers[2] * numbers[3])
    return Visible(*_visible(bins, found, use, seen, sectors, noise_dn, uneven_px), bins)


def _displacements(
    bins: Indices, terms: Floats, level: Floats, use: Bools, numbers: Floats, displaced: Floats
) -> tuple[Floats, Floats, Floats]:
    """Estimate the displacement of every sector from its pixels, given the result of `boundary_terms`.

    Returns:
        The residual of each pixel (n,), the displacements (SECTORS,) and their weights (SECTORS,).
    """
    sigma, whole = float(numbers[5]), displaced
    for _ in range(2):  # the levels are not linear in a displacement as large as the blur
        expected, slope = levels_and_slopes(terms, whole[bins], numbers)
        residual, counted = level - expected, slope * use
        weight = np.bincount(bins, weights=counted * slope, minlength=SECTORS)
        further = np.bincount(bins, weights=counted * residual, minlength=SECTORS) / np.maximum(weight, 1e-9)
        further = np.where(weight > 1e-9, np.maximum(np.minimum(further, sigma), -sigma), 0.0)
        whole = whole + further
        if float(np.abs(further).max()) < LINEAR * sigma:
            break
    return residual - slope * further[bins], whole, np.asarray(weight, dtype=np.float64)


def _visible(
    bins: Indices, found: tuple[Floats, ...], use: Bools, seen: Bools, sectors: Bools, noise_dn: float, uneven_px: float
) -> tuple[Bools, Bools, float, Floats]:
    """Compute the parts of `Visible`, except the sectors of the pixels, from the result of `_displacements`."""
    residual, whole, weight = found
    by_noise = noise_dn * noise_dn / np.maximum(weight, 1e-9)
    uneven2 = 0.0  # variance, beyond noise, of the displacements of visible sectors that their pixels determine
    determined = seen & (weight > 0.1 * float(weight.max()))
    if determined.any():
        typical = 1.4826 * median(np.abs(whole[determined]))
        uneven2 = max(typical**2 - 1.3 * median(by_noise[determined]), 0.0)
    scale = max(1.4826 * median(np.abs(residual[use & seen[bins]])), noise_dn, 1e-3)
    new_use = np.abs(residual) < OUTLIER * scale
    total = np.maximum(np.bincount(bins, minlength=SECTORS), 1)
    capped = np.minimum((residual / scale) ** 2, OUTLIER**2)
    square = np.bincount(bins, weights=capped, minlength=SECTORS) / total
    outliers = np.bincount(bins, weights=~new_use, minlength=SECTORS) / total
    usual = max(median(square[seen]), 1.0)
    explained = (square < np.where(sectors, 5.0, 2.5) * usual) & (outliers < np.where(sectors, 0.25, 0.1))
    far2 = np.where(sectors, max(uneven2, uneven_px * uneven_px), uneven2)
    explained &= np.abs(whole) < FARTHEST * np.sqrt(far2 + by_noise)
    likely = np.where(explained, whole * uneven2 / (uneven2 + by_noise), 0.0)
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
