"""Occlusion: which pixels and sectors of the boundary the pixel model explains, and how uneven the boundary is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Bools, Floats, Indices
from ..compiled import twin
from ..statistics import median
from .consensus import UNEVEN
from .edge_model import NEAR, SECTORS, EdgeModel, Place, sector_of

OUTLIER = 5.0  # pixels with a larger residual, in standard deviations, are left out
LINEAR = 0.1  # a displacement below this share of the blur changes the levels linearly
FARTHEST = 3.5  # largest displacement of a sector, in standard deviations of what unevenness and noise make likely


@dataclass(frozen=True, slots=True, eq=False)
class Visible:
    """The part of a boundary that the model explains.

    Attributes:
        use: (n,) pixels that are not outliers.
        explained: (SECTORS,) sectors that the model explains.
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
    model: EdgeModel,
    displaced: Floats,
    x: Floats,
    y: Floats,
    level: Floats,
    use: Bools,
    seen: Bools,
    sectors: Bools,
    noise_dn: float,
) -> Visible:
    """Decide which pixels and sectors of the boundary the model explains.

    A pupil boundary is not exactly an ellipse. `uneven_px` is the scatter of its sectors around the ellipse, from their
    median. A sector is explained if it is displaced no farther than unevenness and noise make likely, if its mean
    squared residual is at most a multiple of a typical sector's, and if few of its pixels are outliers. The limits are
    generous where edge points were found, because iris texture is not a lid, and strict elsewhere.

    Args:
        model: the fitted model.
        displaced: (SECTORS,) displacements that the fit found, px inward.
        x: (n,) px.
        y: (n,) px.
        level: (n,) grey levels.
        use: (n,) pixels that the fit used.
        seen: (SECTORS,) sectors that the fit used.
        sectors: (SECTORS,) sectors with edge points.
        noise_dn: standard deviation of a pixel's noise.
    """
    return Visible(*_visible(x, y, level, use, seen, sectors, model.numbers(), displaced, noise_dn))


@twin
def _visible(
    x: Floats, y: Floats, level: Floats, use: Bools, seen: Bools, sectors: Bools, numbers: Floats, displaced: Floats,
    noise_dn: float,
) -> tuple[Bools, Bools, float, Floats, Indices]:  # fmt: skip
    """Compute the parts of `Visible`."""
    bins, residual, whole, weight = _displacements(x, y, level, use, numbers, displaced)
    told = seen & (weight > 0.1 * float(weight.max(initial=0.0)))
    by_noise = noise_dn**2 / np.maximum(weight, 1e-9)
    uneven2 = 0.0
    if told.any():
        uneven2 = max((1.4826 * median(np.abs(whole[told]))) ** 2 - 1.3 * median(by_noise[told]), 0.0)
    scale = max(1.4826 * median(np.abs(residual[use & seen[bins]])), noise_dn, 1e-3)
    new_use = np.abs(residual) < OUTLIER * scale
    total = np.maximum(np.bincount(bins, minlength=SECTORS), 1)
    capped = np.minimum((residual / scale) ** 2, OUTLIER**2)
    mean_square = np.bincount(bins, weights=capped, minlength=SECTORS) / total
    outliers = np.bincount(bins, weights=~new_use, minlength=SECTORS) / total
    usual = max(median(mean_square[seen]), 1.0)
    explained = (mean_square < np.where(sectors, 5.0, 2.5) * usual) & (outliers < np.where(sectors, 0.25, 0.1))
    radius = math.sqrt(numbers[2] * numbers[3])
    likely2 = np.where(sectors, max(uneven2, (UNEVEN * radius) ** 2), uneven2) + by_noise
    explained &= np.abs(whole) < FARTHEST * np.sqrt(likely2)
    likely = np.where(explained, whole * uneven2 / (uneven2 + by_noise), 0.0)
    return new_use, explained, math.sqrt(uneven2), likely, bins


def _displacements(
    x: Floats, y: Floats, level: Floats, use: Bools, numbers: Floats, displaced: Floats
) -> tuple[Indices, Floats, Floats, Floats]:
    """Find the displacement of every sector that its pixels show.

    Returns:
        The sector of each pixel (n,), its residual (n,), the displacements (SECTORS,) and their weights (SECTORS,).
    """
    model = EdgeModel.of(numbers)
    place = Place.of(model.ellipse, x, y, steps=NEAR)
    bins, whole = sector_of(place), displaced
    for _ in range(2):  # the levels are not linear in a displacement as large as the blur
        expected, slope = model.level_and_slope(replace(place, distance=place.distance + whole[bins]))
        residual = level - expected
        counted = slope * use
        weight = np.bincount(bins, weights=counted * slope, minlength=SECTORS).astype(np.float64)
        further = np.bincount(bins, weights=counted * residual, minlength=SECTORS) / np.maximum(weight, 1e-9)
        further = np.where(weight > 1e-9, np.minimum(np.maximum(further, -model.sigma_px), model.sigma_px), 0.0)
        whole = whole + further
        if float(np.abs(further).max()) < LINEAR * model.sigma_px:
            break
    return bins, residual - slope * further[bins], whole, weight


def clear_of_lids(seen: Bools, model: EdgeModel) -> Bools:
    """Leave out the sectors beside each gap of two or more, as far as the blur of a lid margin reaches into them."""
    if seen.all():
        return seen
    gap = ~seen & (~np.roll(seen, 1) | ~np.roll(seen, -1))
    length = math.pi * float(model.ellipse.semi_axes_px.sum()) / SECTORS
    for _ in range(min(math.ceil(2.0 * model.sigma_px / length), 3)):
        gap = gap | np.roll(gap, 1) | np.roll(gap, -1)
    return np.asarray(seen & ~gap)
