"""Maximum-likelihood refinement: fit the pixel model to the pixels around the boundary."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...base.arrays import Bools, Floats
from ...base.jit import compiled
from ...optics.ellipse import Ellipse
from ..preprocessing import Image, ImagePart
from .algebraic import direct_fits
from .covariance import SHAPE, hidden_part, outline_slopes, sector_excess, to_axes, towards_round
from .edge_model import EdgeModel, longest_gap
from .least_squares import FIXED, Band, BoundaryPixels, NormalEquations, Prior, Solution, Sums, fitted
from .occlusion import clear_of_lids, visible_part
from .places import SECTORS, middles, sectors_at

# Fourier orders of the outer level that are tried. The first order is always fitted: LEDs beside the camera light one
# side of the iris more, by a few hundredths of the step. Noise hides that from a test, but it shifts the centre.
ORDERS = (1, 2, 4, 6, 8)
# Reach of the band beyond the boundary, in widths of the blur. Pixels farther out determine the outer level better, but
# texture changes it with distance. If the wide band shows texture, the narrow one reduces the error of the centre by a
# third (rendered development images with textured irises).
WIDE, NARROW = 3.0, 1.0
# Share of the outline in a gap between edge points that only a lid makes. The model then explains no sector without
# edge points: the shadow of a lid looks like a shaded iris, which its outer level follows.
LID = 0.3
# Signs of texture: a larger reduced chi^2, or a boundary more uneven than this share of its radius. Nine in ten
# rendered pupils are, and one in twenty drawn ellipses in a textured iris.
UNEXPLAINED, ROUGH = 1.5, 0.003
# Largest distance outside the boundary, px, whatever the blur: the light varies across the iris, and not linearly.
OUTWARD_PX = 8.0
# Largest number of fits; each leaves out what the previous one could not explain. The second number is for the narrower
# band, the third for a boundary that was fitted before in the same band. A wide band whose fit number PATIENCE still
# leaves more than noise is given up.
TURNS, PATIENCE = (4, 2, 1), 2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Ended:
    """The end of a fit: its pixels, solution and prior, the explained sectors, and the reach of its band."""

    pixels: BoundaryPixels
    found: Solution
    prior: Prior
    seen: Bools
    outward: float

    @property
    def model(self) -> EdgeModel:
        """The model, with the displacements of its sectors if it is uneven."""
        if self.prior.uneven_px == 0.0:
            return self.found.model
        displaced = np.zeros(SECTORS)
        displaced[self.pixels.sector] = self.found.displaced
        return replace(self.found.model, displaced=displaced)

    @property
    def variance(self) -> float:
        """Mean squared residual."""
        sums = self.found.sums
        freedom = max(self.pixels.level.size - sums.matrix.shape[0], 1)
        return float(sums.cost / freedom)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PixelFit:
    """The result of a refinement.

    Attributes:
        model: the fitted pixel model.
        ellipse: the ellipse that fits the uneven boundary best.
        covariance: (5, 5) of (cx, cy, a, b, angle).
        reduced_chi2: reduced chi^2 relative to the image's noise.
        residual_dn: root mean square residual.
        pixels: number of pixels used.
        sectors: (SECTORS,) which sectors of the outline were used.
        uneven_px: standard deviation of the sectors' displacements.
        outward: how far the band of pixels reached beyond the boundary, in widths of the blur.
    """

    model: EdgeModel
    ellipse: Ellipse
    covariance: Floats
    reduced_chi2: float
    residual_dn: float
    pixels: int
    sectors: Bools
    uneven_px: float
    outward: float


def refine(
    part: ImagePart,
    start: EdgeModel,
    sectors: Bools,
    masked: Bools,
    noise_dn: float,
    scatter_px: float,
    before: PixelFit | None = None,
) -> PixelFit | str:
    """Fit the pixel model, in a narrower band if the wide one shows texture; or return the reason for failure.

    The arguments are those of `_fitted`, and `scatter_px`, the rms distance of the edge points from their ellipse.
    """
    if before is not None:
        start_at = (before.model, before.uneven_px, before.sectors)
        ended = _fitted(part, start, sectors, masked, noise_dn, start_at, before.outward, TURNS[2])
        return ended if isinstance(ended, str) else _report(ended, noise_dn, scatter_px)
    wide = _fitted(part, start, sectors, masked, noise_dn, None, WIDE, TURNS[0])
    if isinstance(wide, str):
        return wide
    if wide.variance < UNEXPLAINED * noise_dn**2 and not _rough(wide.model, wide.prior.uneven_px):
        return _report(wide, noise_dn, scatter_px)
    start_at = (wide.model, wide.prior.uneven_px, wide.seen)
    narrow = _fitted(part, start, sectors, masked, noise_dn, start_at, NARROW, TURNS[1])
    return _report(wide if isinstance(narrow, str) else narrow, noise_dn, scatter_px)


def _fitted(
    part: ImagePart,
    start: EdgeModel,
    sectors: Bools,
    masked: Bools,
    noise_dn: float,
    before: tuple[EdgeModel, float, Bools] | None,
    outward: float,
    turns: int,
) -> _Ended | str:
    """Fit the pixel model, or return the reason for failure.

    The Fourier order of the outer level is the one with the least BIC, predicted by one linear step. Pixels and sectors
    that the model cannot explain (lids, lashes, reflections) are left out and the rest is fitted again. If the boundary
    is uneven, displacements of its sectors are fitted too.

    Args:
        part: the part of the image about the boundary.
        start: model from the edges.
        sectors: (SECTORS,) which sectors of the outline have edge points.
        masked: (h, w) which pixels glints affect or the sensor clipped.
        noise_dn: standard deviation of a pixel's noise.
        before: model, unevenness and sectors of an earlier fit of the same boundary, as a start.
        outward: how far the band of pixels reaches beyond the boundary, in widths of the blur.
        turns: largest number of fits.
    """
    model = replace(start, outer=_padded(start.outer, ORDERS[0])) if before is None else before[0]
    prior = Prior.of(start, noise_dn, 0.0 if before is None else before[1])
    band = _near_boundary(part, model, masked, outward)
    use = np.ones(band.x.size, dtype=bool)
    # A lid must not decide the order of the outer level.
    seen = clear_of_lids(sectors, start) if before is None else before[2]
    allowed = sectors | (longest_gap(sectors) < LID)
    displaced = np.zeros(SECTORS) if model.displaced is None else model.displaced.copy()
    for turn in range(turns):
        pixels = BoundaryPixels.of(band, use, seen)
        if pixels.x.size < 60:
            return "too few pixels on the boundary are free of glints and lids"
        begun = displaced[pixels.sector]
        found = fitted(pixels, model, begun, prior, steps=6 if turn == 0 else 4)
        model = found.model
        if not _sane(model, start):
            return "the pixel model's fit ran away from the edges"
        displaced[pixels.sector] = found.displaced
        visible = visible_part(model, displaced, band, use, seen, sectors, noise_dn)
        new_seen = clear_of_lids(visible.explained & allowed, model)
        same = bool((visible.use == use).all() and (new_seen == seen).all())
        same &= abs(visible.uneven_px - prior.uneven_px) < max(0.2 * prior.uneven_px, 0.01)
        if not same:
            prior = Prior.of(start, noise_dn, visible.uneven_px)
        if turn == 0 and before is None:
            # An uneven boundary must not be mistaken for an uneven iris.
            order = _best_order(pixels, found, prior)
            model = replace(model, outer=_padded(model.outer, order))
            same &= order == ORDERS[0]
        texture = found.sums.cost > UNEXPLAINED * noise_dn**2 * pixels.x.size or _rough(model, visible.uneven_px)
        if same or turn + 1 == turns or (outward == WIDE and before is None and turn + 1 >= PATIENCE and texture):
            break
        use, seen, displaced, band = visible.use, new_seen, visible.displaced, replace(band, sector=visible.bins)
        if seen.sum() < 0.15 * SECTORS:
            return "too little of the boundary fits the pixel model"
    return _Ended(pixels=pixels, found=found, prior=prior, seen=new_seen, outward=outward)


def _rough(model: EdgeModel, uneven_px: float) -> bool:
    """Return whether a boundary is as uneven as those of real pupils in textured irises."""
    return uneven_px > ROUGH * math.sqrt(float(model.ellipse.semi_axes_px.prod()))


def _near_boundary(part: ImagePart, model: EdgeModel, masked: Bools, reach_out: float) -> Band:
    """Collect the pixels near the boundary.

    The band reaches 4 sigma + 1 px inside the boundary and `reach_out` sigma + 1 px outside it, but not beyond
    OUTWARD_PX.
    """
    ellipse, sigma = model.ellipse, model.sigma_px
    a, b = ellipse.semi_axes_px.tolist()
    inward, outward = min(4.0 * sigma + 1.0, 0.8 * b), min(reach_out * sigma + 1.0, OUTWARD_PX)
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


def _best_order(pixels: BoundaryPixels, found: Solution, prior: Prior) -> int:
    """Compute the Fourier order of the outer level by BIC, from one linear step with the largest order's columns."""
    full = replace(found.model, outer=_padded(found.model.outer, ORDERS[-1]))
    normal = NormalEquations.of(Sums.of(pixels, full, found.displaced), found.displaced, prior)
    matrix, vector, total = normal.matrix, normal.vector, normal.cost - float(normal.along**2 @ normal.inverse)
    count = pixels.level.size
    scale = 1.0 / np.sqrt(np.diag(matrix) + 1e-9)
    # The first columns of a Cholesky factor are the factor of the first columns: one serves all orders.
    lower = np.linalg.cholesky(matrix * (scale[:, None] * scale) + 1e-9 * np.eye(scale.size))
    drops = np.cumsum(np.linalg.solve(lower, vector * scale) ** 2)
    best, best_bic = ORDERS[0], math.inf
    for order in ORDERS:
        size = FIXED + 2 * order
        chi2 = max(total - float(drops[size - 1]), 1e-9)
        bic = count * math.log(chi2 / count) + size * math.log(count)
        if bic < best_bic:
            best, best_bic = order, bic
    return best


def _sane(model: EdgeModel, start: EdgeModel) -> bool:
    b = start.ellipse.semi_axes_px[1]
    moved = float(np.hypot(*(model.ellipse.centre_px - start.ellipse.centre_px)))
    ratio = model.ellipse.semi_axes_px / start.ellipse.semi_axes_px
    return moved < 0.25 * float(b) + 1.0 and bool((ratio > 0.7).all() and (ratio < 1.4).all()) and model.step_dn > 0.0


def _report(ended: _Ended, noise_dn: float, scatter_px: float) -> PixelFit:
    pixels, found, prior, seen, model = ended.pixels, ended.found, ended.prior, ended.seen, ended.model
    of_pixels, count, variance = found.sums, pixels.level.size, ended.variance
    normal = NormalEquations.of(of_pixels, found.displaced, prior)
    matrix = normal.matrix + np.diag(prior.of_all(of_pixels.matrix.shape[0]))
    inverse = np.asarray(np.linalg.inv(matrix + 1e-12 * np.diag(np.diag(matrix))), dtype=np.float64)
    influence, own = inverse[:SHAPE], np.zeros((SHAPE, SHAPE))
    ellipse = model.ellipse
    if model.displaced is not None:
        ellipse, by_displaced = _through(model.ellipse, model.displaced)
        # The displacements follow the parameters, and have errors of their own; where nothing is seen, the prior's.
        follow = by_displaced[:, pixels.sector]
        influence = influence - (follow * normal.inverse) @ (normal.across.T @ inverse)
        errors = np.full(SECTORS, prior.uneven_px**2)
        errors[pixels.sector] = variance * normal.inverse
        own = (by_displaced * errors) @ by_displaced.T
    plain = variance * influence @ matrix @ influence.T
    # Texture leaves residuals that agree within a sector; their excess over white noise scales the covariance.
    sums = of_pixels.pull - normal.across * (normal.inverse * of_pixels.along)
    excess = sector_excess(plain, influence, sums)
    covariance = plain * (excess if excess > 1.25 else 1.0) + own
    if not seen.all():
        ellipse, covariance = towards_round(ellipse, covariance + hidden_part(ellipse, seen, scatter_px))
    return PixelFit(
        model=model,
        ellipse=ellipse,
        covariance=to_axes(covariance, ellipse),
        reduced_chi2=variance / noise_dn**2,
        residual_dn=math.sqrt(variance),
        pixels=count,
        sectors=seen,
        uneven_px=prior.uneven_px,
        outward=ended.outward,
    )


def _through(start: Ellipse, displaced: Floats) -> tuple[Ellipse, Floats]:
    """Compute the ellipse that fits an uneven boundary best, as a direct fit to the traced boundary would.

    Also returns the derivatives (5, SECTORS) of its centre and shape by the sectors' displacements from `start`.
    """
    place, slopes = middles(start), outline_slopes(start)
    outline = start.points_at(place.cos_t, place.sin_t)
    normals = -slopes[:2].T
    fit = direct_fits((outline - displaced[:, None] * normals)[None])[0]
    by_displaced = np.asarray(np.linalg.solve(slopes @ slopes.T, slopes), dtype=np.float64)
    return Ellipse.of(fit), by_displaced
