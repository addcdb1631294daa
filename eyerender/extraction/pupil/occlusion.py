"""Which pixels and sectors of a boundary its model explains, and how uneven the margin is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..statistics import median
from .consensus import UNEVEN
from .edge_model import SECTORS, EdgeModel, Place, sector_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OUTLIER = 5.0  # pixels beyond this many standard deviations do not count
LINEAR = 0.1  # of the blur: so small a displacement is
FARTHEST = 3.5  # a sector's displacement, in what margins and the noise make likely


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """use: pixels that are no outliers. explained: (SECTORS,) where the model explains them. uneven_px: standard
    deviation of the sectors' displacements from the ellipse; displaced: (SECTORS,) what they are likely to be, px
    inward."""

    use: Mask
    explained: Mask
    uneven_px: float
    displaced: Array


def judge(
    model: EdgeModel,
    displaced: Array,
    level: Array,
    place: Place,
    use: Mask,
    seen: Mask,
    sectors: Mask,
    noise_dn: float,
) -> Judged:
    """What of the boundary the model explains: pixels (n,) that did count, `use`, and sectors, `seen`, as displaced.

    A margin is not quite an ellipse; by how much its sectors scatter about one, by their median, is uneven_px. A
    sector counts when it is displaced no more than margins are, its pixels' mean square there is at most a multiple of
    the typical sector's, and few are outliers. Where the edges saw the boundary the limits are generous: iris texture
    is no lid. Elsewhere the pixels must show by themselves that the boundary is there.
    """
    bins = sector_of(place)
    whole = displaced
    for _ in range(2):  # a displacement of about the blur is not linear in the levels
        expected, slope = model.level_and_slope(replace(place, distance=place.distance + whole[bins]))
        residual = level - expected
        counted = slope * use
        weight = np.bincount(bins, weights=counted * slope, minlength=SECTORS)
        further = np.bincount(bins, weights=counted * residual, minlength=SECTORS) / np.maximum(weight, 1e-9)
        further = np.where(weight > 1e-9, np.minimum(np.maximum(further, -model.sigma_px), model.sigma_px), 0.0)
        whole = whole + further
        if float(np.abs(further).max()) < LINEAR * model.sigma_px:
            break
    residual = residual - slope * further[bins]
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
    radius = math.sqrt(float(model.ellipse.semi_axes_px.prod()))
    likely2 = np.where(sectors, max(uneven2, (UNEVEN * radius) ** 2), uneven2) + by_noise
    explained &= np.abs(whole) < FARTHEST * np.sqrt(likely2)
    return Judged(
        new_use, explained, math.sqrt(uneven2), np.where(explained, whole * uneven2 / (uneven2 + by_noise), 0.0)
    )


def clear_of_lids(seen: Mask, model: EdgeModel) -> Mask:
    """Leave out the neighbours of every gap of two sectors or more, as far as a lid's margin is blurred into them."""
    if seen.all():
        return seen
    gap = ~seen & (~np.roll(seen, 1) | ~np.roll(seen, -1))
    length = math.pi * float(model.ellipse.semi_axes_px.sum()) / SECTORS
    for _ in range(min(math.ceil(2.0 * model.sigma_px / length), 3)):
        gap = gap | np.roll(gap, 1) | np.roll(gap, -1)
    return np.asarray(seen & ~gap)
