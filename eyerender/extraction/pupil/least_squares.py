"""Least squares of the boundary's pixel model: derivatives, normal equations, Gauss-Newton steps.

A pupil boundary is not exactly an ellipse: every sector may be displaced, with a given standard deviation. To first
order, a displacement is a linear parameter that affects only its sector's pixels, so all displacements are eliminated
from the normal equations (Schur complement).
"""

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
    """Pixels near the boundary, sorted by sector.

    Attributes:
        x: (n,) position, px.
        y: (n,) position, px.
        level: (n,) level, DN.
        index: (n,) index of each pixel's sector among the k sectors with pixels.
        sector: (k,) numbers of these sectors.
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


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Weights of the priors, relative to the weight of a pixel's residual.

    These are the weights of the squares of slope, kurtosis, a lean and a harmonic (4,), then the standard deviation of
    a sector's displacement and the weight of its square (infinite if no displacement is allowed).
    """

    weights: Floats
    uneven_px: float
    displacement: float

    @staticmethod
    def of(start: EdgeModel, noise_dn: float, uneven_px: float) -> Prior:
        """Compute the priors of a fit that starts from a model."""
        displacement = (noise_dn / uneven_px) ** 2 if uneven_px > 0.0 else math.inf
        step = max(start.step_dn, noise_dn)
        slope = SLOPE_SD * step / float(start.ellipse.semi_axes_px[1])
        weights = (noise_dn / np.array([slope, KURTOSIS_SD, LEAN_SD * step, HARMONIC_SD * step])) ** 2
        return Prior(weights, uneven_px, displacement)

    def of_all(self, size: int) -> Floats:
        """Return the weight (size,) of every parameter except the displacements."""
        out = np.zeros(size)
        out[7], out[8], out[9:11], out[FIXED:] = self.weights
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Sums of products of the linearised model over the pixels; p parameters, k sectors with pixels.

    "Slopes" are derivatives of a pixel's level with respect to the parameters, "steepness" the derivative with respect
    to the distance.

    Attributes:
        matrix: (p, p) products of slopes.
        cost: squared residuals.
        pull: (p, k) slopes times residual, per sector.
        across: (p, k) slopes times steepness, per sector.
        along: (k,) steepness times residual, per sector.
        square: (k,) squared steepness, per sector.
    """

    matrix: Floats
    cost: float
    pull: Floats
    across: Floats
    along: Floats
    square: Floats

    @staticmethod
    def of(pixels: BoundaryPixels, model: EdgeModel, displaced: Floats) -> Sums:
        """Compute the sums with sectors `displaced` (k,) px into the ellipse."""
        return Sums(*_pixel_sums(pixels.x, pixels.y, pixels.level, pixels.index, model.numbers(), displaced))


@inlined
def _rows(
    places: Floats, profiles: Floats, level: Floats, start: int, count: int, numbers: Floats, out: tuple[Floats, ...]
) -> None:  # fmt: skip
    """Write a block's derivatives of the level by the parameters, residuals, and derivatives by the distance.

    Args:
        places: (PLACES,) the places.
        profiles: (PROFILES,) the profiles there.
        level: (n,) levels of all pixels.
        start: first pixel of the block.
        count: number of pixels in it.
        numbers: (p,) the model (see `EdgeModel.numbers`).
        out: receives the derivatives (p BLOCK,), parameter after parameter in the order of `numbers`, the residuals
            (BLOCK,) and the derivatives by the distance (BLOCK,). It ends with scratch memory (2 BLOCK, and LEVELS).
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
def _add_weighted(
    rows: Floats, begin: int, end: int, residual: Floats, steep: Floats, k: int, pull: Floats, across: Floats
) -> None:
    """Add the sums of rows (p, n), weighted by two values, over columns `begin` to `end`, to columns k of (p, q)."""
    for j in range(rows.shape[0]):
        first = second = 0.0
        for i in range(begin, end):
            first += rows[j, i] * residual[i]
            second += rows[j, i] * steep[i]
        pull[j, k] += first
        across[j, k] += second


@compiled("f8[::1], f8[::1], f8[::1], i8[::1], f8[::1], f8[::1]")
def _pixel_sums(
    x: Floats, y: Floats, level: Floats, index: Indices, numbers: Floats, displaced: Floats
) -> tuple[Floats, float, Floats, Floats, Floats, Floats]:
    """Compute the parts of `Sums` for the model with these parameters (see `EdgeModel.numbers`)."""
    ellipse = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
    sectors, size = displaced.size, numbers.size
    matrix, basis, places, profiles = np.zeros((size, size)), np.empty(2 * BLOCK), np.empty(PLACES), np.empty(PROFILES)
    flat, residual, steep, levels = np.empty(size * BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(LEVELS)
    rows, pull, across = flat.reshape(size, BLOCK), np.zeros((size, sectors)), np.zeros((size, sectors))
    along, square, cost = np.zeros(sectors), np.zeros(sectors), 0.0
    for start in range(0, x.size, BLOCK):
        count = min(BLOCK, x.size - start)
        find_places(ellipse, x, y, start, count, places)
        for i in range(count):
            places[i] += displaced[index[start + i]]  # the distance is the first field
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
                along[k] += steep[end] * residual[end]
                square[k] += steep[end] * steep[end]
                end += 1
            _add_weighted(rows, begin, end, residual, steep, k, pull, across)
            begin = end
    for j in range(size):
        for m in range(j):
            matrix[m, j] = matrix[j, m]
    return matrix, cost, pull, across, along, square


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class NormalEquations:
    """Normal equations with the sectors' displacements eliminated.

    Attributes:
        matrix: (p, p) sum of products of slopes.
        vector: (p,) sum of slopes times residual.
        cost: sum of squares.
        across: (p, k) products of each sector's displacement with the slopes, priors included.
        along: (k,) products of each displacement with the residual, priors included.
        inverse: (k,) inverse of each displacement's product with itself, prior included.
    """

    matrix: Floats
    vector: Floats
    cost: float
    across: Floats
    along: Floats
    inverse: Floats

    @staticmethod
    def of(sums: Sums, displaced: Floats, prior: Prior) -> NormalEquations:
        """Eliminate the displacements (k,) from the sums."""
        cost, rest, inverse = sums.cost, np.zeros(displaced.size), np.zeros(displaced.size)
        if not math.isinf(prior.displacement):
            inverse = 1.0 / (sums.square + prior.displacement)
            rest = sums.along - prior.displacement * displaced
            cost += prior.displacement * float(displaced @ displaced)
        root = sums.across * np.sqrt(inverse)
        return NormalEquations(
            matrix=sums.matrix - root @ root.T,
            vector=sums.pull.sum(axis=1) - sums.across @ (inverse * rest),
            cost=cost,
            across=sums.across,
            along=rest,
            inverse=inverse,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Result of the fit: the model, the displacements (k,) px, and the sums there, up to a last tiny step."""

    model: EdgeModel
    displaced: Floats
    sums: Sums


def fitted(pixels: BoundaryPixels, model: EdgeModel, displaced: Floats, prior: Prior, steps: int) -> Solution:
    """Fit the model with at most `steps` damped Gauss-Newton steps (Levenberg).

    The cost is sum r^2 plus the priors. `displaced` (k,) is the start of the displacements.
    """
    numbers = model.numbers()
    held, damping = prior.of_all(numbers.size), 1e-4
    about = (pixels.x, pixels.y, pixels.level, pixels.index)
    sums = Sums(*_pixel_sums(*about, numbers, displaced))
    normal = NormalEquations.of(sums, displaced, prior)
    cost = normal.cost + float(held @ numbers**2)
    for _ in range(steps):
        parts = (normal.matrix, normal.vector, normal.across, normal.along, normal.inverse)
        trial, trial_displaced, largest, widened = _trial(parts, held, numbers, displaced, damping)
        if largest < STILL_PX and widened < 10.0 * STILL_PX and damping < 1e-3:
            # Another step would be several times smaller, and a step this small hardly changes the sums.
            numbers, displaced = trial, trial_displaced
            break
        trial_sums = Sums(*_pixel_sums(*about, trial, trial_displaced))
        trial_normal = NormalEquations.of(trial_sums, trial_displaced, prior)
        trial_cost = trial_normal.cost + float(held @ trial**2)
        if trial_cost <= cost:
            gained, cost = cost - trial_cost, trial_cost
            numbers, displaced, sums, normal = trial, trial_displaced, trial_sums, trial_normal
            damping *= 0.1
            if gained < 1e-7 * cost:
                break
        else:
            damping = min(max(damping * 30.0, 1e-3), 1e6)
    return Solution(EdgeModel.of(numbers), displaced, sums)


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


@compiled("Tuple((f8[:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1])), f8[::1], f8[::1], f8[::1], f8")
def _trial(
    normal: tuple[Floats, ...], held: Floats, numbers: Floats, displaced: Floats, damping: float
) -> tuple[Floats, Floats, float, float]:
    """Take one damped step of at most 3 px.

    Args:
        normal: matrix, vector, across, along and inverse of `Normal`.
        held: (p,) weights of the priors.
        numbers: (p,) the model (see `EdgeModel.numbers`).
        displaced: (k,) displacements of the sectors.
        damping: added to the diagonal of the scaled normal matrix.

    Returns:
        The new parameters and displacements, and the step's largest change of the shape and of sigma, px.
    """
    matrix, vector, across, along, inverse = normal
    step = _step(matrix, vector, held, numbers, damping)
    largest = largest_size(step[:SHAPE])
    if largest > 3.0:
        for j in range(step.size):
            step[j] *= 3.0 / largest
    moved = displaced.copy()
    for k in range(along.size):
        further = along[k]
        for j in range(step.size):
            further -= step[j] * across[j, k]
        moved[k] += further * inverse[k]
    return _moved(numbers, step), moved, largest, abs(step[SHAPE])
