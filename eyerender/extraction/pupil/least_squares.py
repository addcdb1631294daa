"""Least squares of the boundary's pixel model: derivatives, normal equations, Gauss-Newton steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...base.arrays import Bools, Floats, Indices
from ...base.jit import compiled, inlined, summing
from ..products import add_products, largest_size, solve
from .covariance import SHAPE
from .edge_model import (
    LEVELS,
    PROFILES,
    EdgeModel,
    levels_in,
    local_levels,
    profile_at,
    profile_in,
    put_profile,
    turn_harmonics,
)
from .places import BLOCK, PLACES, distance_slopes_at, find_places, place_in

# Parameters without the harmonics: shape, sigma, inner level, slope, kurtosis, lean (two), mean outer level.
FIXED = SHAPE + 7
# Standard deviations of parameters that are expected to be near 0: the harmonics of the outer level, in steps (under a
# lid nothing else constrains them); its change over a semi-axis b, in steps (caused by lamps beside the camera); the
# kurtosis of the blur; the lean of the inner level, in steps (scattered light, and shading of a pupil that is not
# black: with 0.003 the centres of drawn pupils in light from one side were off by 0.03 px, with 0.006 by 0.015 px).
HARMONIC_SD, SLOPE_SD, KURTOSIS_SD, LEAN_SD = 0.15, 0.15, 1.0, 0.006
KURTOSIS_LIMITS = (-1.5, 3.0)  # outside these limits the edge would not be monotonic
STILL_PX = 1.5e-2  # a fit ends with a step smaller than this


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Pixels near the boundary: positions x (n,) and y (n,), px, levels (n,), DN, and sectors (n,)."""

    x: Floats
    y: Floats
    level: Floats
    sector: Indices


@dataclass(frozen=True, slots=True, eq=False)
class BoundaryPixels:
    """Pixels near the boundary, sorted by sector: place (n,), level (n,) and place (n,) of their sector in `sector`.

    `sector` (k,) are the numbers of the sectors that have pixels.
    """

    x: Floats
    y: Floats
    level: Floats
    index: Indices
    sector: Indices

    @staticmethod
    def of(band: Band, use: Bools, seen: Bools) -> BoundaryPixels:
        """Select the pixels (n,) in `use` whose sector is one of those `seen` (SECTORS,)."""
        chosen = np.flatnonzero(use & seen[band.sector])
        chosen = chosen[np.argsort(band.sector[chosen], kind="stable")]
        sector, index = np.unique(band.sector[chosen], return_inverse=True)
        return BoundaryPixels(band.x[chosen], band.y[chosen], band.level[chosen], index, sector)


def prior_weights(start: EdgeModel, noise_dn: float, size: int) -> Floats:
    """Return the weight (size,) of the square of every parameter of a fit that starts from a model.

    They are relative to the weight of a pixel's residual: those of the slope, the kurtosis, the lean and the harmonics.
    """
    step, out = max(start.step_dn, noise_dn), np.zeros(size)
    out[7], out[8] = SLOPE_SD * step / float(start.ellipse.semi_axes_px[1]), KURTOSIS_SD
    out[9:11], out[FIXED:] = LEAN_SD * step, HARMONIC_SD * step
    return np.asarray(np.where(out > 0.0, noise_dn / np.where(out > 0.0, out, 1.0), 0.0) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Sums of products of the linearised model over the pixels; p parameters, k sectors with pixels.

    With slopes, the derivatives of a pixel's level by the parameters: their products (p, p), the squared residuals, and
    slopes times residual per sector (p, k).
    """

    matrix: Floats
    cost: float
    pull: Floats

    @staticmethod
    def of(pixels: BoundaryPixels, model: EdgeModel) -> Sums:
        """Compute the sums."""
        about = (pixels.x, pixels.y, pixels.level, pixels.index)
        return Sums(*_pixel_sums(*about, pixels.sector.size, model.numbers()))


@inlined
def _rows(
    places: Floats, profiles: Floats, level: Floats, start: int, count: int, numbers: Floats, out: tuple[Floats, ...]
) -> None:  # fmt: skip
    """Write a block's derivatives of the level by the parameters (see `EdgeModel.numbers`), and residuals.

    Places and profiles are those of the block, whose first pixel is `start`; levels (n,) are those of all pixels. `out`
    receives the derivatives (p BLOCK,), parameter after parameter, and the residuals (BLOCK,). It ends with scratch
    memory (BLOCK, 2 BLOCK, and LEVELS).
    """
    rows, residual, steep, basis, levels = out
    cos, sin, plane = math.cos(numbers[4]), math.sin(numbers[4]), 1.0 / math.sqrt(numbers[2] * numbers[3])
    local_levels(places, count, numbers, basis, levels)
    for i in range(count):
        place, profile, at = place_in(places, i), profile_in(profiles, i), levels_in(levels, i)
        steep[i] = at.step * profile.by_distance + at.within + at.bend * profile.ramp_by_distance
        expected = at.inner + at.step * profile.edge + at.within * place.distance + at.bend * profile.ramp
        residual[i] = level[start + i] - expected
        rows[5 * BLOCK + i] = at.step * profile.by_sigma + at.bend * profile.ramp_by_sigma
        rows[6 * BLOCK + i], rows[7 * BLOCK + i] = 1.0 - profile.edge, profile.ramp
        rows[8 * BLOCK + i] = at.step * profile.by_kurtosis
        sloping = 1.0 - profile.edge + (place.distance - profile.ramp) * plane
        rows[9 * BLOCK + i], rows[10 * BLOCK + i] = sloping * place.cos_u, sloping * place.sin_u
        rows[11 * BLOCK + i], basis[i], basis[BLOCK + i] = profile.edge, 1.0, 0.0
    for j in range(1, numbers.size - 11, 2):
        turn_harmonics(places, count, basis)
        first, sloping = (11 + j) * BLOCK, plane if j == 1 else 0.0
        for i in range(count):
            profile = profile_in(profiles, i)
            value = profile.edge + sloping * profile.ramp
            rows[first + i], rows[first + BLOCK + i] = basis[i] * value, basis[BLOCK + i] * value
    for i in range(count):
        by_x, by_y, by_aa, by_bb, by_ab = distance_slopes_at(place_in(places, i), cos, sin)
        rows[i], rows[BLOCK + i], rows[2 * BLOCK + i] = by_x * steep[i], by_y * steep[i], by_aa * steep[i]
        rows[3 * BLOCK + i], rows[4 * BLOCK + i] = by_bb * steep[i], by_ab * steep[i]


@summing
def _add_weighted(rows: Floats, begin: int, end: int, residual: Floats, k: int, pull: Floats) -> None:
    """Add the sums of rows (p, n), weighted by the residuals, over columns `begin` to `end`, to column k of (p, q)."""
    for j in range(rows.shape[0]):
        total = 0.0
        for i in range(begin, end):
            total += rows[j, i] * residual[i]
        pull[j, k] += total


@compiled("f8[::1], f8[::1], f8[::1], i8[::1], i8, f8[::1]")
def _pixel_sums(
    x: Floats, y: Floats, level: Floats, index: Indices, sectors: int, numbers: Floats
) -> tuple[Floats, float, Floats]:
    """Compute the parts of `Sums` for the model with these parameters (see `EdgeModel.numbers`)."""
    ellipse, size = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]), numbers.size
    matrix, basis, places, profiles = np.zeros((size, size)), np.empty(2 * BLOCK), np.empty(PLACES), np.empty(PROFILES)
    flat, residual, steep, levels = np.empty(size * BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(LEVELS)
    rows, pull, cost = flat.reshape(size, BLOCK), np.zeros((size, sectors)), 0.0
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        find_places(ellipse, x, y, start, count, places)
        for i in range(count):
            place = place_in(places, i)
            put_profile(profiles, i, profile_at(place.distance, place.curvature, numbers[5], numbers[8]))
        _rows(places, profiles, level, start, count, numbers, (flat, residual, steep, basis, levels))
        add_products(rows, 0, count, matrix)
        begin = 0
        while begin < count:  # the pixels of a sector are contiguous
            k, end = index[start + begin], begin
            while end < count and index[start + end] == k:
                cost += residual[end] * residual[end]
                end += 1
            _add_weighted(rows, begin, end, residual, k, pull)
            begin = end
    for j in range(size):
        for m in range(j):
            matrix[m, j] = matrix[j, m]
    return matrix, cost, pull


def fitted(pixels: BoundaryPixels, model: EdgeModel, held: Floats, steps: int) -> tuple[EdgeModel, Sums]:
    """Fit the model with at most `steps` damped Gauss-Newton steps (Levenberg).

    The cost is sum r^2 plus the parameters' squares times the weights `held` (p,). Returns the model, and the sums
    there, up to a last tiny step.
    """
    sums, damping = Sums.of(pixels, model), 1e-4
    cost = sums.cost + float(held @ model.numbers() ** 2)
    for _ in range(steps):
        numbers, largest, widened = _trial(sums.matrix, sums.pull.sum(axis=1), held, model.numbers(), damping)
        trial = EdgeModel.of(numbers)
        if largest < STILL_PX and widened < 10.0 * STILL_PX and damping < 1e-3:
            # Another step would be several times smaller, and a step this small hardly changes the sums.
            return trial, sums
        trial_sums = Sums.of(pixels, trial)
        trial_cost = trial_sums.cost + float(held @ numbers**2)
        if trial_cost <= cost:
            gained, cost = cost - trial_cost, trial_cost
            model, sums = trial, trial_sums
            damping *= 0.1
            if gained < 1e-7 * cost:
                break
        else:
            damping = min(max(damping * 30.0, 1e-3), 1e6)
    return model, sums


@inlined
def _step(matrix: Floats, vector: Floats, held: Floats, numbers: Floats, damping: float) -> Floats:
    """Solve the damped normal equations, including the priors, with all parameters scaled alike."""
    size = vector.size
    scaled, scale, right = matrix.copy(), np.empty(size), np.empty(size)
    for j in range(size):
        scaled[j, j] += held[j]
        scale[j] = math.sqrt(max(scaled[j, j], 1e-12))
        right[j] = (vector[j] - held[j] * numbers[j]) / scale[j]
    for j in range(size):
        for m in range(size):
            scaled[j, m] /= scale[j] * scale[m]
        scaled[j, j] += damping
    solve(scaled, right)
    for j in range(size):
        right[j] /= scale[j]
    return right


@inlined
def _moved(numbers: Floats, step: Floats) -> Floats:
    """Add a step to the parameters of a model; the shape matrix's eigenvectors give the new axes."""
    out = numbers.copy()
    for j in range(out.size):
        out[j] += step[j]
    a, b, mixed = out[2], out[3], step[4]
    mean, apart = 0.5 * (a + b), math.sqrt(0.25 * (a - b) ** 2 + mixed * mixed)
    out[2], out[3] = max(mean + apart, 0.5), max(mean - apart, 0.5)
    out[4] = (numbers[4] + 0.5 * math.atan2(2.0 * mixed, a - b)) % math.pi
    out[5] = min(max(out[5], 0.5 * numbers[5], 0.3), max(2.0 * numbers[5], 0.3))
    out[8] = min(max(out[8], KURTOSIS_LIMITS[0]), KURTOSIS_LIMITS[1])
    return out


@compiled("f8[:,::1], f8[::1], f8[::1], f8[::1], f8")
def _trial(
    matrix: Floats, vector: Floats, held: Floats, numbers: Floats, damping: float
) -> tuple[Floats, float, float]:
    """Take one damped step of at most 3 px from `numbers` (p,), with priors of the weights `held` (p,).

    The normal equations have the matrix (p, p) and vector (p,); damping is added to the diagonal of the scaled matrix.
    Returns the new parameters, and the step's largest change of the shape and of sigma, px.
    """
    step = _step(matrix, vector, held, numbers, damping)
    largest = largest_size(step[:SHAPE])
    if largest > 3.0:
        for j in range(step.size):
            step[j] *= 3.0 / largest
    return _moved(numbers, step), largest, abs(step[SHAPE])
