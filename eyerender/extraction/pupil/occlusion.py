"""Occlusion: which pixels and sectors of the boundary fit the pixel model."""

from __future__ import annotations

import math

import numpy as np

from ...base.arrays import Bools
from ..statistics import median
from .consensus import UNEVEN
from .edge_model import EdgeModel, boundary_terms, levels_and_slopes
from .least_squares import Band
from .places import SECTORS

OUTLIER = 5.0  # pixels with a larger residual, in standard deviations, are left out
FARTHEST = 3.5  # largest displacement of a sector, in standard deviations of what unevenness and noise make likely


def visible_part(
    model: EdgeModel, band: Band, use: Bools, seen: Bools, sectors: Bools, noise_dn: float
) -> tuple[Bools, Bools]:
    """Decide which pixels of the boundary are not outliers (n,), and which sectors (SECTORS,) the model explains.

    A pupil boundary is not exactly an ellipse. A sector is explained if it is displaced no farther than unevenness and
    noise make likely, if its mean squared residual is at most a multiple of a typical sector's, and if few of its
    pixels are outliers. The limits are generous where edge points were found, because iris texture is not a lid, and
    strict elsewhere.

    Args:
        model: the fitted model.
        band: n pixels.
        use: (n,) pixels that the fit used.
        seen: (SECTORS,) sectors that the fit used.
        sectors: (SECTORS,) sectors with edge points.
        noise_dn: standard deviation of a pixel's noise.
    """
    numbers, bins = model.numbers(), band.sector
    expected, slope = levels_and_slopes(boundary_terms(band.x, band.y, numbers)[1], numbers)
    residual, counted = band.level - expected, slope * use
    weight = np.bincount(bins, weights=counted * slope, minlength=SECTORS)
    displaced = np.bincount(bins, weights=counted * residual, minlength=SECTORS) / np.maximum(weight, 1e-9)
    displaced = np.clip(displaced, -model.sigma_px, model.sigma_px)
    residual = residual - slope * displaced[bins]
    scale = max(1.4826 * median(np.abs(residual[use & seen[bins]])), noise_dn, 1e-3)
    new_use = np.abs(residual) < OUTLIER * scale
    total = np.maximum(np.bincount(bins, minlength=SECTORS), 1)
    capped = np.minimum((residual / scale) ** 2, OUTLIER**2)
    square = np.bincount(bins, weights=capped, minlength=SECTORS) / total
    outliers = np.bincount(bins, weights=~new_use, minlength=SECTORS) / total
    usual = max(median(square[seen]), 1.0)
    explained = (square < np.where(sectors, 5.0, 2.5) * usual) & (outliers < np.where(sectors, 0.25, 0.1))
    uneven2 = np.where(sectors, UNEVEN**2 * numbers[2] * numbers[3], 0.0)
    explained &= np.abs(displaced) < FARTHEST * np.sqrt(uneven2 + noise_dn * noise_dn / np.maximum(weight, 1e-9))
    return new_use, explained


def clear_of_lids(seen: Bools, model: EdgeModel) -> Bools:
    """Exclude the sectors beside each gap of two or more, as far as the blur of a lid margin extends."""
    if seen.all():
        return seen
    gap = ~seen & (~np.roll(seen, 1) | ~np.roll(seen, -1))
    length = math.pi * float(model.ellipse.semi_axes_px.sum()) / SECTORS
    for _ in range(min(math.ceil(2.0 * model.sigma_px / length), 3)):
        gap = gap | np.roll(gap, 1) | np.roll(gap, -1)
    return np.asarray(seen & ~gap)
