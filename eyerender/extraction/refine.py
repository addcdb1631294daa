"""Maximum-likelihood refinement: the pixel model of the rim fitted to the pixels around it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipse import Ellipse
from .covariance import SECTORS, SHAPE, distance_slopes, gram, project, sector_excess, sector_of, to_axes
from .orderstatistics import median
from .preprocess import Image
from .rimmodel import Place, Profile, RimModel, harmonics

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fourier orders of the outer level that are tried. The first is always there: lamps beside the camera light one side of
# the iris more, by a few hundredths of the step, which noise hides from any test but not from the centre.
ORDERS = (1, 2, 4, 6, 8)
# No pixel farther outside counts, px, however wide the blur: light falls off across the iris, faster than linearly.
OUTWARD_PX = 8.0
TURNS = 4  # fits, each without what the one before could not explain
STILL_PX = 1e-3  # a step smaller than that is the last one of a fit
OUTLIER = 5.0  # pixels beyond this many standard deviations do not count
# Parameters without the harmonics: shape, sigma, inner level, slope, kurtosis, lean (two), mean outer level.
FIXED = SHAPE + 7
# Standard deviations of what is about 0 beforehand: the harmonics of the outer level, in steps (nothing else holds them
# under a lid); its change over a semi-axis b, in steps (lamps beside the camera bring it about); the blur's kurtosis;
# how the inner level leans, in steps: scattered light only, so that noise does not find a lean where there is none.
HARMONIC_SD, SLOPE_SD, KURTOSIS_SD, LEAN_SD = 0.15, 0.15, 1.0, 0.003
KURTOSIS_LIMITS = (-1.5, 3.0)  # beyond them the edge would not be monotonic


@dataclass(frozen=True, slots=True, eq=False)
class PixelFit:
    """model; covariance (5, 5) of (cx, cy, a, b, angle); reduced_chi2 against the image's noise; residual_dn; pixels
    used; sectors: (SECTORS,) which parts of the outline count."""

    model: RimModel
    covariance: Array
    reduced_chi2: float
    residual_dn: float
    pixels: int
    sectors: Mask


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    x: Array
    y: Array
    level: Array

    def taken(self, which: Mask) -> _Pixels:
        return _Pixels(self.x[which], self.y[which], self.level[which])


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """model; residual (n,); jacobian (p, n); place (n,): all but a last tiny step's share of the latter two."""

    model: RimModel
    residual: Array
    jacobian: Array
    place: Place


def refine(
    linear: Image, start: RimModel, sectors: Mask, masked: Mask, noise_dn: float, counted: Mask | None = None
) -> PixelFit | str:
    """The most likely rim, or why the refinement failed.

    linear: image. start: from the edges. sectors: (SECTORS,) parts of the outline that the edges saw. masked: image of
    pixels that glints touch or the sensor clipped. counted: (SECTORS,) parts that an earlier fit found to count.
    Gauss-Newton with Levenberg's damping; the Fourier order of the outer level is the one of least BIC, by the drop of
    chi^2 that one linear step with its columns promises. Pixels and sectors that the model cannot explain (lids,
    lashes, reflections) are put aside, and the rest is fitted again.
    """
    order_settled = start.outer.size > 1  # a second pass keeps what the first one chose
    model = start if order_settled else replace(start, outer=_padded(start.outer, ORDERS[0]))
    prior = _prior(start, noise_dn)
    pixels = _band(linear, model, masked)
    place = _place(model, pixels)
    use = np.ones(pixels.x.size, dtype=bool)
    # The order of the outer level must not be learnt from a lid.
    seen = _clear_of_lids(sectors, start) if counted is None else counted
    for turn in range(TURNS):
        bins = sector_of(place)
        use_now = use & seen[bins]
        if np.count_nonzero(use_now) < 60:
            return "too few pixels on the rim are free of glints and lids"
        chosen = pixels.taken(use_now)
        found = _gauss_newton(chosen, model, place.taken(use_now), prior, steps=6 if turn == 0 else 4)
        if not order_settled:
            order = _best_order(chosen, found, noise_dn)
            if order > ORDERS[0]:
                model = replace(found.model, outer=_padded(found.model.outer, order))
                found = _gauss_newton(chosen, model, _place(model, chosen), prior, steps=4)
            order_settled = True
        model = found.model
        if not _sane(model, start):
            return "the pixel model's fit ran away from the edges"
        place = _place(model, pixels)
        residual = pixels.level - model.level_at(place)
        scale = max(1.4826 * median(np.abs(residual[use_now])), noise_dn, 1e-3)
        new_use = np.abs(residual) < OUTLIER * scale
        new_seen = _clear_of_lids(_explained(residual, new_use, bins, seen, sectors, scale), model)
        same = bool((new_use == use).all() and (new_seen == seen).all())
        use, seen = new_use, new_seen
        if same:
            break
        if seen.sum() < 0.15 * SECTORS:
            return "too little of the rim fits the pixel model"
    return _report(found, prior, noise_dn, seen)


def _place(model: RimModel, pixels: _Pixels) -> Place:
    """Two of Newton's steps: the band is within a few tenths of b, and the rim's own pixels far nearer."""
    return Place.of(model.ellipse, pixels.x, pixels.y, steps=2)


def _band(linear: Image, model: RimModel, masked: Mask) -> _Pixels:
    """The pixels whose distance to the rim matters: 4 sigma and a pixel inside, 3 sigma and a pixel outside,
    where that is not beyond OUTWARD_PX.

    Farther out the outer level would be told better, but it changes with the distance: 2 px more make the error on a
    textured iris half as large again.
    """
    ellipse, sigma = model.ellipse, model.sigma_px
    a, b = ellipse.semi_axes_px
    inward, outward = min(4.0 * sigma + 1.0, 0.8 * b), min(3.0 * sigma + 1.0, OUTWARD_PX)
    reach = float(a) + outward + 2.0
    cx, cy = ellipse.centre_px
    x0, x1 = max(0, math.floor(cx - reach)), min(linear.shape[1], math.ceil(cx + reach) + 1)
    y0, y1 = max(0, math.floor(cy - reach)), min(linear.shape[0], math.ceil(cy + reach) + 1)
    conic_x = np.arange(x0, x1)[None, :] - cx
    conic_y = np.arange(y0, y1)[:, None] - cy
    cos, sin = math.cos(ellipse.angle_rad), math.sin(ellipse.angle_rad)
    p, q = conic_x * cos + conic_y * sin, conic_y * cos - conic_x * sin
    # Inside the larger concentric ellipse and outside the smaller one: a cheap cover of the band.
    outer = (p / (a + outward)) ** 2 + (q / (b + outward)) ** 2 < 1.0
    inner = (p / max(a - inward, 0.5)) ** 2 + (q / max(b - inward, 0.5)) ** 2 > 1.0
    row, column = np.nonzero(outer & inner & ~masked[y0:y1, x0:x1])
    level = linear[row + y0, column + x0].astype(np.float64)
    return _Pixels((column + x0).astype(np.float64), (row + y0).astype(np.float64), level)


def _jacobian(model: RimModel, place: Place) -> tuple[Array, Array]:
    """Model levels (n,) and their derivatives (FIXED + 2 K, n) by the parameters in the order of FIXED."""
    profile = Profile.of(place.distance, place.curvature, model.sigma_px, model.kurtosis)
    basis = harmonics(place.cos_t, place.sin_t, (model.outer.size - 1) // 2)
    inner = model.inner(place)
    step = model.outer @ basis - inner
    out = np.empty((FIXED - 1 + basis.shape[0], place.distance.size))
    by_distance = step * profile.edge_by_distance + model.slope * profile.ramp_by_distance
    np.multiply(distance_slopes(model.ellipse, place), by_distance, out=out[:SHAPE])
    out[5] = step * profile.edge_by_sigma + model.slope * profile.ramp_by_sigma
    out[6] = 1.0 - profile.edge
    out[7] = profile.ramp
    out[8] = step * profile.edge_by_kurtosis
    np.multiply(out[6], place.cos_t, out=out[9])
    np.multiply(out[6], place.sin_t, out=out[10])
    np.multiply(basis, profile.edge, out=out[11:])
    return inner + step * profile.edge + model.slope * profile.ramp, out


def _prior(start: RimModel, noise_dn: float) -> Array:
    """(4,) weights of the squares of slope, kurtosis, a lean and a harmonic beside those of a pixel's residual."""
    step = max(start.step_dn, noise_dn)
    slope = SLOPE_SD * step / float(start.ellipse.semi_axes_px[1])
    return (noise_dn / np.array([slope, KURTOSIS_SD, LEAN_SD * step, HARMONIC_SD * step])) ** 2


def _held(prior: Array, size: int) -> Array:
    """(size,) the prior's weight of every parameter."""
    out = np.zeros(size)
    out[7], out[8], out[9:11], out[FIXED:] = prior
    return out


def _values(model: RimModel) -> Array:
    """The parameters that a prior may hold, at their places; the others are 0."""
    return np.concatenate([np.zeros(7), [model.slope, model.kurtosis, *model.lean, 0.0], model.outer[1:]])


def _moved(model: RimModel, step: Array) -> RimModel:
    """The model after a step of the parameters; the shape matrix's eigenvectors give the new axes."""
    x, y, aa, bb, ab, sigma, inner, slope, kurtosis, lean_x, lean_y = step[:11].tolist()
    cx, cy = model.ellipse.centre_px.tolist()
    a, b = model.ellipse.semi_axes_px.tolist()
    a, b = a + aa, b + bb
    mean, apart = 0.5 * (a + b), math.hypot(0.5 * (a - b), ab)
    angle = model.ellipse.angle_rad + 0.5 * math.atan2(2.0 * ab, a - b)
    axes = np.array([max(mean + apart, 0.5), max(mean - apart, 0.5)])
    ellipse = Ellipse(np.array([cx + x, cy + y]), axes, angle)
    blur = min(max(model.sigma_px + sigma, 0.5 * model.sigma_px, 0.3), max(2.0 * model.sigma_px, 0.3))
    tails = min(max(model.kurtosis + kurtosis, KURTOSIS_LIMITS[0]), KURTOSIS_LIMITS[1])
    lean = (model.lean[0] + lean_x, model.lean[1] + lean_y)
    return RimModel(ellipse, model.inner_dn + inner, model.outer + step[11:], blur, model.slope + slope, tails, lean)


def _gauss_newton(pixels: _Pixels, model: RimModel, place: Place, prior: Array, steps: int) -> _Solution:
    """The model after at most `steps` steps; cost = sum r^2 + what the prior adds."""
    value, jacobian = _jacobian(model, place)
    residual = pixels.level - value
    held = _held(prior, jacobian.shape[0])
    diagonal = np.arange(held.size)
    cost = float(np.sum(residual * residual) + held @ _values(model) ** 2)
    damping = 1e-4
    for _ in range(steps):
        matrix = gram(jacobian)
        matrix[diagonal, diagonal] += held
        vector = project(jacobian, residual) - held * _values(model)
        scale = np.sqrt(np.maximum(matrix[diagonal, diagonal], 1e-12))
        system = matrix / (scale[:, None] * scale)
        system[diagonal, diagonal] += damping
        step = np.linalg.solve(system, vector / scale) / scale
        largest = float(np.abs(step[:SHAPE]).max())
        if largest > 3.0:
            step *= 3.0 / largest
        trial = _moved(model, step)
        if largest < STILL_PX and abs(float(step[SHAPE])) < 10.0 * STILL_PX and damping < 1e-3:
            # So small a step does what the slopes say, and another would be smaller by a factor of several.
            return _Solution(trial, residual - project(jacobian.T, step), jacobian, place)
        trial_place = _place(trial, pixels)
        trial_value, trial_jacobian = _jacobian(trial, trial_place)
        trial_residual = pixels.level - trial_value
        trial_cost = float(np.sum(trial_residual * trial_residual) + held @ _values(trial) ** 2)
        if trial_cost <= cost:
            model, place, jacobian, residual = trial, trial_place, trial_jacobian, trial_residual
            gained, cost = cost - trial_cost, trial_cost
            damping *= 0.1
            if gained < 1e-7 * cost:
                break
        else:
            damping = min(max(damping * 30.0, 1e-3), 1e6)
    return _Solution(model, residual, jacobian, place)


def _padded(outer: Array, order: int) -> Array:
    out = np.zeros(1 + 2 * order)
    kept = min(out.size, outer.size)
    out[:kept] = outer[:kept]
    return out


def _best_order(pixels: _Pixels, found: _Solution, noise_dn: float) -> int:
    """Fourier order of the outer level by BIC, from one linear step with the largest order's columns."""
    full = replace(found.model, outer=_padded(found.model.outer, ORDERS[-1]))
    value, jacobian = _jacobian(full, found.place)
    residual = pixels.level - value
    matrix, vector = gram(jacobian), project(jacobian, residual)
    count = residual.size
    scale = 1.0 / np.sqrt(np.diag(matrix) + 1e-9)
    # The first columns of a Cholesky factor are the factor of the first columns: one serves all orders.
    lower = np.linalg.cholesky(matrix * (scale[:, None] * scale) + 1e-9 * np.eye(scale.size))
    drops = np.cumsum(np.linalg.solve(lower, vector * scale) ** 2)
    total = float(np.sum(residual * residual))
    best, best_bic = ORDERS[0], math.inf
    for order in ORDERS:
        size = FIXED + 2 * order
        chi2 = max(total - float(drops[size - 1]), 1e-9)
        bic = count * math.log(chi2 / count) + size * math.log(count)
        if bic < best_bic:
            best, best_bic = order, bic
    return best


def _explained(residual: Array, use: Mask, bins: NDArray[np.intp], seen: Mask, sectors: Mask, scale: float) -> Mask:
    """Sectors whose pixels fit: their mean square is at most a multiple of the typical sector's, and few are outliers.

    Where the edges saw the rim the multiple is generous, because iris texture is no lid; elsewhere the pixels must
    show by themselves that the rim is there.
    """
    total = np.maximum(np.bincount(bins, minlength=SECTORS), 1)
    capped = np.minimum((residual / scale) ** 2, OUTLIER**2)
    mean_square = np.bincount(bins, weights=capped, minlength=SECTORS) / total
    outliers = np.bincount(bins, weights=~use, minlength=SECTORS) / total
    typical = median(mean_square[seen]) if seen.any() else 1.0
    limit = np.where(sectors, 5.0, 2.5) * max(typical, 1.0)
    return np.asarray((mean_square < limit) & (outliers < np.where(sectors, 0.25, 0.1)))


def _clear_of_lids(seen: Mask, model: RimModel) -> Mask:
    """Leave out the neighbours of every gap of two sectors or more, as far as a lid's margin is blurred into them."""
    if seen.all():
        return seen
    gap = ~seen & (~np.roll(seen, 1) | ~np.roll(seen, -1))
    length = math.pi * float(model.ellipse.semi_axes_px.sum()) / SECTORS
    for _ in range(min(math.ceil(2.0 * model.sigma_px / length), 3)):
        gap = gap | np.roll(gap, 1) | np.roll(gap, -1)
    return np.asarray(seen & ~gap)


def _sane(model: RimModel, start: RimModel) -> bool:
    b = start.ellipse.semi_axes_px[1]
    moved = float(np.hypot(*(model.ellipse.centre_px - start.ellipse.centre_px)))
    ratio = model.ellipse.semi_axes_px / start.ellipse.semi_axes_px
    return moved < 0.25 * float(b) + 1.0 and bool((ratio > 0.7).all() and (ratio < 1.4).all()) and model.step_dn > 0.0


def _report(found: _Solution, prior: Array, noise_dn: float, seen: Mask) -> PixelFit:
    model, residual, jacobian = found.model, found.residual, found.jacobian
    free = max(residual.size - jacobian.shape[0], 1)
    variance = float(np.sum(residual * residual)) / free
    matrix = gram(jacobian) + np.diag(_held(prior, jacobian.shape[0]))
    inverse = np.asarray(np.linalg.inv(matrix + 1e-12 * np.diag(np.diag(matrix))), dtype=np.float64)
    plain = inverse[:SHAPE, :SHAPE] * variance
    # Texture leaves residuals that agree within a sector; their excess over white noise scales the covariance.
    excess = sector_excess(plain, inverse[:SHAPE], jacobian * residual, sector_of(found.place))
    covariance = plain * (excess if excess > 1.25 else 1.0)
    return PixelFit(
        model, to_axes(covariance, model.ellipse), variance / noise_dn**2, math.sqrt(variance), residual.size, seen
    )
