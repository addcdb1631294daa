"""Maximum-likelihood refinement: fit the pixel model to the pixels around the boundary."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.jit import compiled
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, ImagePart
from ..statistics import median
from .consensus import UNEVEN
from .covariance import SHAPE, hidden_part, sector_excess, to_axes, towards_round
from .edge_model import EdgeModel, boundary_terms, levels_and_slopes
from .least_squares import FIXED, Band, BoundaryPixels, Sums, fitted, prior_weights
from .places import SECTORS, sectors_at

OUTLIER = 5.0  # pixels with a larger residual, in standard deviations, are left out
FARTHEST = 3.5  # largest displacement of a sector, in standard deviations of what unevenness and noise make likely


def visible_part(
    model: EdgeModel, band: Band, use: Bools, seen: Bools, sectors: Bools, noise_dn: float
) -> tuple[Bools, Bools]:
    """Decide which of n pixels of the boundary are not outliers (n,), and which sectors (SECTORS,) the model explains.

    A pupil boundary is not exactly an ellipse. A sector is explained if it is displaced no farther than unevenness and
    noise make likely, if its mean squared residual is at most a multiple of a typical sector's, and if few of its
    pixels are outliers. The limits are generous where edge points were found (`sectors`), because iris texture is not a
    lid, and strict elsewhere. The fit used the pixels `use` (n,) and the sectors `seen`.
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


# Fourier orders of the outer level that are tried. The first order is always fitted: LEDs beside the camera light one
# side of the iris more, by a few hundredths of the step. Noise hides that from a test, but it shifts the centre.
ORDERS = (1, 2, 4, 6, 8)
# Reach of the band beyond the boundary, in widths of the blur, and its largest, px: the light varies across the iris,
# and not linearly.
WIDE, OUTWARD_PX = 3.0, 8.0
TURNS = 4  # largest number of fits; each leaves out what the previous one could not explain


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PixelFit:
    """The result of a refinement."""

    model: EdgeModel  # the fitted pixel model
    ellipse: Ellipse  # its ellipse, rounder where nothing is seen
    covariance: Floats  # (5, 5) of (cx, cy, a, b, angle)
    reduced_chi2: float  # reduced chi^2 relative to the image's noise
    sectors: Bools  # (SECTORS,) which sectors of the outline were used


def refine(
    part: ImagePart, start: EdgeModel, sectors: Bools, masked: Bools, noise_dn: float, scatter_px: float
) -> PixelFit | str:
    """Fit the pixel model, or return the reason for failure.

    The Fourier order of the outer level is the one with the least BIC, predicted by one linear step. Pixels and sectors
    that the model cannot explain (lids, lashes, reflections) are left out and the rest is fitted again.

    Args:
        part: the part of the image about the boundary.
        start: model from the edges.
        sectors: (SECTORS,) which sectors of the outline have edge points.
        masked: (h, w) which pixels glints affect or the sensor clipped.
        noise_dn: standard deviation of a pixel's noise.
        scatter_px: rms distance of the edge points from their ellipse.
    """
    model = replace(start, outer=_padded(start.outer, ORDERS[0]))
    band = _near_boundary(part, model, masked)
    use = np.ones(band.x.size, dtype=bool)
    # A lid must not decide the order of the outer level.
    seen = clear_of_lids(sectors, start)
    for turn in range(TURNS):
        pixels = BoundaryPixels.of(band, use, seen)
        if pixels.x.size < 60:
            return "too few pixels on the boundary are free of glints and lids"
        held = prior_weights(start, noise_dn, model.numbers().size)
        model, sums = fitted(pixels, model, held, steps=6 if turn == 0 else 4)
        if not _sane(model, start):
            return "the pixel model's fit ran away from the edges"
        new_use, explained = visible_part(model, band, use, seen, sectors, noise_dn)
        new_seen = clear_of_lids(explained, model)
        if new_seen.sum() < 0.15 * SECTORS:
            return "too little of the boundary fits the pixel model"
        order = _best_order(pixels, model) if turn == 0 else ORDERS[0]
        if ((new_use == use).all() and (new_seen == seen).all() and order == ORDERS[0]) or turn + 1 == TURNS:
            break
        model = replace(model, outer=_padded(model.outer, order)) if turn == 0 else model
        use, seen = new_use, new_seen
    return _report(model, sums, held, pixels.x.size, new_seen, noise_dn, scatter_px)


def _near_boundary(part: ImagePart, model: EdgeModel, masked: Bools) -> Band:
    """Collect the pixels near the boundary.

    The band reaches 4 sigma + 1 px inside the boundary and WIDE sigma + 1 px outside it, but not beyond
    OUTWARD_PX.
    """
    ellipse, sigma = model.ellipse, model.sigma_px
    a, b = ellipse.semi_axes_px.tolist()
    inward, outward = min(4.0 * sigma + 1.0, 0.8 * b), min(WIDE * sigma + 1.0, OUTWARD_PX)
    # Inside the larger concentric ellipse and outside the smaller one: a cheap cover of the band.
    outer, inner = (a + outward, b + outward), (max(a - inward, 0.5), max(b - inward, 0.5))
    x, y, level = _band(part.linear, masked, part.corner, ellipse.numbers(), outer, inner)
    return Band(x, y, level, sectors_at(ellipse.numbers(), x, y))


@compiled("f4[:,::1], b1[:,::1], UniTuple(i8, 2), UniTuple(f8, 5), UniTuple(f8, 2), UniTuple(f8, 2)")
def _band(
    linear: Image, masked: Bools, corner: tuple[int, int], ellipse: tuple[float, ...],
    outer: tuple[float, float], inner: tuple[float, float],
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Select the pixels (x, y, level) between two ellipses around `ellipse`, given by their semi-axes.

    `corner` is the first pixel of `linear` in the whole image.
    """
    cx, cy, _, _, angle = ellipse
    cos, sin, reach = math.cos(angle), math.sin(angle), outer[0] + 2.0
    left, top = corner
    x0, x1 = max(left, math.floor(cx - reach)), min(left + linear.shape[1], math.ceil(cx + reach) + 1)
    y0, y1 = max(top, math.floor(cy - reach)), min(top + linear.shape[0], math.ceil(cy + reach) + 1)
    size, n = max(x1 - x0, 0) * max(y1 - y0, 0), 0
    x, y, level = np.empty(size), np.empty(size), np.empty(size)
    for row in range(y0, y1):
        for column in range(x0, x1):
            dx, dy = column - cx, row - cy
            p, q = dx * cos + dy * sin, dy * cos - dx * sin
            if (p / outer[0]) ** 2 + (q / outer[1]) ** 2 >= 1.0 or masked[row - top, column - left]:
                continue
            if (p / inner[0]) ** 2 + (q / inner[1]) ** 2 > 1.0:
                x[n], y[n], level[n] = column, row, linear[row - top, column - left]
                n += 1
    return x[:n].copy(), y[:n].copy(), level[:n].copy()


def _padded(outer: Floats, order: int) -> Floats:
    out = np.zeros(1 + 2 * order)
    kept = min(out.size, outer.size)
    out[:kept] = outer[:kept]
    return out


def _best_order(pixels: BoundaryPixels, model: EdgeModel) -> int:
    """Compute the Fourier order of the outer level by BIC, from one linear step with the largest order's columns."""
    sums = Sums.of(pixels, replace(model, outer=_padded(model.outer, ORDERS[-1])))
    matrix, count = sums.matrix, pixels.level.size
    scale = 1.0 / np.sqrt(np.diag(matrix) + 1e-9)
    # The first columns of a Cholesky factor are the factor of the first columns: one serves all orders.
    lower = np.linalg.cholesky(matrix * (scale[:, None] * scale) + 1e-9 * np.eye(scale.size))
    drops = np.cumsum(np.linalg.solve(lower, sums.pull.sum(axis=1) * scale) ** 2)
    best, best_bic = ORDERS[0], math.inf
    for order in ORDERS:
        size = FIXED + 2 * order
        chi2 = max(sums.cost - float(drops[size - 1]), 1e-9)
        bic = count * math.log(chi2 / count) + size * math.log(count)
        if bic < best_bic:
            best, best_bic = order, bic
    return best


def _sane(model: EdgeModel, start: EdgeModel) -> bool:
    b = start.ellipse.semi_axes_px[1]
    moved = float(np.hypot(*(model.ellipse.centre_px - start.ellipse.centre_px)))
    ratio = model.ellipse.semi_axes_px / start.ellipse.semi_axes_px
    return moved < 0.25 * float(b) + 1.0 and bool((ratio > 0.7).all() and (ratio < 1.4).all()) and model.step_dn > 0.0


def _report(
    model: EdgeModel, sums: Sums, held: Floats, count: int, seen: Bools, noise_dn: float, scatter_px: float
) -> PixelFit:
    variance = sums.cost / max(count - held.size, 1)
    matrix = sums.matrix + np.diag(held)
    influence = np.asarray(np.linalg.inv(matrix + 1e-12 * np.diag(np.diag(matrix))), dtype=np.float64)[:SHAPE]
    plain = variance * influence @ matrix @ influence.T
    # Texture leaves residuals that agree within a sector; their excess over white noise scales the covariance.
    excess = sector_excess(plain, influence, sums.pull)
    ellipse, covariance = model.ellipse, plain * (excess if excess > 1.25 else 1.0)
    if not seen.all():
        ellipse, covariance = towards_round(ellipse, covariance + hidden_part(ellipse, seen, scatter_px))
    return PixelFit(
        model=model,
        ellipse=ellipse,
        covariance=to_axes(covariance, ellipse),
        reduced_chi2=variance / noise_dn**2,
        sectors=seen,
    )
