"""Maximum-likelihood refinement: the pixel model of the rim fitted to the pixels around it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.ellipse import Ellipse
from .covariance import SECTORS, SHAPE, distance_slopes, gram, project, sector_excess, sector_of, to_axes
from .preprocess import Image
from .rimmodel import Place, Profile, RimModel, harmonics

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fourier orders of the outer level that are tried. The first is always there: lamps beside the camera light one side of
# the iris more, by a few hundredths of the step, which noise hides from any test but not from the centre.
ORDERS = (1, 2, 4, 6, 8)
# No pixel farther outside counts, px, however wide the blur: light falls off across the iris, faster than linearly.
OUTWARD_PX = 8.0
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


def refine(linear: Image, start: RimModel, sectors: Mask, masked: Mask, noise_dn: float) -> PixelFit | str:
    """The most likely rim, or why the refinement failed.

    linear: image. start: from the edges. sectors: (SECTORS,) parts of the outline that the edges saw. masked: image of
    pixels that glints touch or the sensor clipped. Gauss-Newton with Levenberg's damping; the Fourier order of the
    outer level is the one of least BIC, by the drop of chi^2 that one linear step with its columns promises. Pixels and
    sectors that the model cannot explain (lids, lashes, reflections) are put aside, and the rest is fitted again.
    """
    order_settled = start.outer.size > 1  # a second pass keeps what the first one chose
    model = start if order_settled else replace(start, outer=_padded(start.outer, ORDERS[0]))
    prior = _prior(start, noise_dn)
    pixels = _band(linear, model, masked)
    use = np.ones(pixels.x.size, dtype=bool)
    result: tuple[RimModel, Array, Array, Place] | None = None
    # The order of the outer level must not be learnt from a lid.
    seen = _clear_of_lids(sectors, start)
    for turn in range(4):
        place = Place.of(model.ellipse, pixels.x, pixels.y)
        bins = sector_of(place)
        use_now = use & seen[bins]
        if use_now.sum() < 60:
            return "too few pixels on the rim are free of glints and lids"
        chosen = _Pixels(pixels.x[use_now], pixels.y[use_now], pixels.level[use_now])
        result = _gauss_newton(chosen, model, prior, steps=6 if turn == 0 else 4)
        model = result[0]
        if not order_settled:
            order = _best_order(chosen, model, noise_dn)
            if order > ORDERS[0]:
                model = replace(model, outer=_padded(model.outer, order))
                result = _gauss_newton(chosen, model, prior, steps=4)
                model = result[0]
            order_settled = True
        if not _sane(model, start):
            return "the pixel model's fit ran away from the edges"
        residual = pixels.level - _predict(model, pixels)
        scale = max(1.4826 * float(np.median(np.abs(residual[use_now]))), 1e-3)
        new_use = np.abs(residual) < OUTLIER * max(scale, noise_dn)
        new_seen = _explained(residual, new_use, bins, seen, sectors, max(scale, noise_dn))
        new_seen = _clear_of_lids(new_seen, model)
        same = bool((new_use == use).all() and (new_seen == seen).all())
        use, seen = new_use, new_seen
        if same:
            break
        if seen.sum() < 0.15 * SECTORS:
            return "too little of the rim fits the pixel model"
    if result is None:
        return "nothing was fitted"
    return _report(result, prior, noise_dn, seen)


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


def _predict(model: RimModel, pixels: _Pixels) -> Array:
    return model.level(pixels.x, pixels.y)


def _jacobian(model: RimModel, place: Place) -> tuple[Array, Array]:
    """Model levels (n,) and their derivatives (n, FIXED + 2 K) by the parameters in the order of FIXED."""
    profile = Profile.of(place.distance, place.curvature, model.sigma_px, model.kurtosis)
    basis = harmonics(place.cos_t, place.sin_t, (model.outer.size - 1) // 2)
    inner = model.inner(place)
    step = np.einsum("nk,k->n", basis, model.outer) - inner
    by_distance = step * profile.edge_by_distance + model.slope * profile.ramp_by_distance
    out = np.empty((place.distance.size, FIXED - 1 + basis.shape[1]))
    out[:, :SHAPE] = by_distance[:, None] * distance_slopes(model.ellipse, place)
    out[:, 5] = step * profile.edge_by_sigma + model.slope * profile.ramp_by_sigma
    out[:, 6] = 1.0 - profile.edge
    out[:, 7] = profile.ramp
    out[:, 8] = step * profile.edge_by_kurtosis
    out[:, 9] = out[:, 6] * place.cos_t
    out[:, 10] = out[:, 6] * place.sin_t
    out[:, 11:] = basis * profile.edge[:, None]
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
    a, b = model.ellipse.semi_axes_px
    shape = np.array([[a + step[2], step[4]], [step[4], b + step[3]]])
    values, vectors = np.linalg.eigh(shape)
    angle = model.ellipse.angle_rad + math.atan2(vectors[1, 1], vectors[0, 1])
    axes = np.maximum(values[::-1], 0.5)
    sigma = float(np.clip(model.sigma_px + step[5], 0.5 * model.sigma_px, 2.0 * model.sigma_px))
    ellipse = Ellipse(model.ellipse.centre_px + step[:2], axes, angle)
    inner, slope = model.inner_dn + float(step[6]), model.slope + float(step[7])
    kurtosis = float(np.clip(model.kurtosis + step[8], *KURTOSIS_LIMITS))
    lean = (model.lean[0] + float(step[9]), model.lean[1] + float(step[10]))
    return RimModel(ellipse, inner, model.outer + step[11:], max(sigma, 0.3), slope, kurtosis, lean)


def _gauss_newton(pixels: _Pixels, model: RimModel, prior: Array, steps: int) -> tuple[RimModel, Array, Array, Place]:
    """(model, residual, Jacobian, place) after at most `steps` steps; cost = sum r^2 + what the prior adds."""
    place = Place.of(model.ellipse, pixels.x, pixels.y)
    value, jacobian = _jacobian(model, place)
    residual = pixels.level - value
    held = _held(prior, jacobian.shape[1])
    cost = float(np.sum(residual * residual) + held @ _values(model) ** 2)
    damping = 1e-4
    for _ in range(steps):
        matrix = gram(jacobian) + np.diag(held)
        vector = project(jacobian, residual) - held * _values(model)
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
        system = matrix / np.outer(scale, scale) + damping * np.eye(scale.size)
        step = np.linalg.solve(system, vector / scale) / scale
        largest = float(np.abs(step[:SHAPE]).max())
        if largest > 3.0:
            step *= 3.0 / largest
        trial = _moved(model, step)
        trial_place = Place.of(trial.ellipse, pixels.x, pixels.y)
        trial_value, trial_jacobian = _jacobian(trial, trial_place)
        trial_residual = pixels.level - trial_value
        trial_cost = float(np.sum(trial_residual * trial_residual) + held @ _values(trial) ** 2)
        if trial_cost <= cost:
            model, place, jacobian, residual = trial, trial_place, trial_jacobian, trial_residual
            gained, cost = cost - trial_cost, trial_cost
            damping *= 0.1
            if largest < 1e-4 or gained < 1e-7 * cost:
                break
        else:
            damping = min(max(damping * 30.0, 1e-3), 1e6)
    return model, residual, jacobian, place


def _padded(outer: Array, order: int) -> Array:
    out = np.zeros(1 + 2 * order)
    kept = min(out.size, outer.size)
    out[:kept] = outer[:kept]
    return out


def _best_order(pixels: _Pixels, model: RimModel, noise_dn: float) -> int:
    """Fourier order of the outer level by BIC, from one linear step with the largest order's columns."""
    full = replace(model, outer=_padded(model.outer, ORDERS[-1]))
    value, jacobian = _jacobian(full, Place.of(full.ellipse, pixels.x, pixels.y))
    residual = pixels.level - value
    matrix, vector = gram(jacobian), project(jacobian, residual)
    count = residual.size
    best, best_bic = ORDERS[0], math.inf
    for order in ORDERS:
        size = FIXED + 2 * order
        part = matrix[:size, :size] + 1e-9 * np.diag(np.diag(matrix)[:size] + 1e-9)
        drop = float(vector[:size] @ np.linalg.solve(part, vector[:size]))
        chi2 = max(float(np.sum(residual * residual)) - drop, 1e-9)
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
    typical = float(np.median(mean_square[seen])) if seen.any() else 1.0
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


def _report(result: tuple[RimModel, Array, Array, Place], prior: Array, noise_dn: float, seen: Mask) -> PixelFit:
    model, residual, jacobian, place = result
    free = max(residual.size - jacobian.shape[1], 1)
    variance = float(np.sum(residual * residual)) / free
    matrix = gram(jacobian) + np.diag(_held(prior, jacobian.shape[1]))
    inverse = np.asarray(np.linalg.inv(matrix + 1e-12 * np.diag(np.diag(matrix))), dtype=np.float64)
    plain = inverse[:SHAPE, :SHAPE] * variance
    # Texture leaves residuals that agree within a sector; their excess over white noise scales the covariance.
    excess = sector_excess(plain, inverse[:SHAPE], jacobian * residual[:, None], sector_of(place))
    covariance = plain * (excess if excess > 1.25 else 1.0)
    return PixelFit(
        model, to_axes(covariance, model.ellipse), variance / noise_dn**2, math.sqrt(variance), residual.size, seen
    )
