"""The least-squares system of the boundary's pixel model: slopes, normal equations, Gauss-Newton steps.

A pupil boundary is not exactly an ellipse: every sector of it may be displaced, by amounts whose standard deviation is
given. To first order a sector's displacement is one more linear parameter that affects only that sector's pixels. A
step of the other parameters therefore eliminates all displacements (Schur's complement).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Bools, Floats, Indices
from ..compiled import twin
from .covariance import SHAPE, distance_slopes, gram, reshaped
from .edge_model import NEAR, EdgeModel, Place, Profile, harmonics

# Parameters without the harmonics: shape, sigma, inner level, slope, kurtosis, lean (two), mean outer level.
FIXED = SHAPE + 7
# Standard deviations of parameters that are expected to be near 0: the harmonics of the outer level, in steps (under a
# lid nothing else constrains them); its change over a semi-axis b, in steps (caused by lamps beside the camera); the
# kurtosis of the blur; the lean of the inner level, in steps (scattered light only, so that noise does not produce a
# lean).
HARMONIC_SD, SLOPE_SD, KURTOSIS_SD, LEAN_SD = 0.15, 0.15, 1.0, 0.003
KURTOSIS_LIMITS = (-1.5, 3.0)  # beyond them the edge would not be monotonic
STILL_PX = 1.5e-2  # a fit ends with a step smaller than this


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """Pixels near the boundary, in the order of their sectors.

    Attributes:
        x: (n,) px.
        y: (n,) px.
        level: (n,) DN.
        index: (n,) which of the k sectors that have pixels each pixel is in.
        sector: (k,) which of all sectors it is.
    """

    x: Floats
    y: Floats
    level: Floats
    index: Indices
    sector: Indices

    @staticmethod
    def of(x: Floats, y: Floats, level: Floats, sector: Indices, use: Bools, seen: Bools) -> Pixels:
        """Choose the pixels (n,) in `use` whose sector is one of those `seen` (SECTORS,)."""
        return Pixels(*_grouped(x, y, level, sector, use, seen))


@twin
def _grouped(
    x: Floats, y: Floats, level: Floats, sector: Indices, use: Bools, seen: Bools
) -> tuple[Floats, Floats, Floats, Indices, Indices]:
    """Compute the parts of `Pixels`."""
    chosen = np.nonzero(use & seen[sector])[0]
    chosen = chosen[np.argsort(sector[chosen].astype(np.uint8), kind="stable")]  # a radix sort
    sector = sector[chosen]
    new = np.diff(sector, prepend=-1) > 0
    return x[chosen], y[chosen], level[chosen], np.cumsum(new) - 1, sector[new]


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Weights of the priors, beside the weight of a pixel's residual.

    They are those of the squares of slope, kurtosis, a lean and a harmonic (4,), then the standard deviation of a
    sector's displacement and the weight of its square (infinite where no displacement is allowed).
    """

    weights: Floats
    uneven_px: float
    displacement: float

    @staticmethod
    def of(start: EdgeModel, noise_dn: float, uneven_px: float) -> Prior:
        """Make the priors of a fit that starts from a model."""
        displacement = (noise_dn / uneven_px) ** 2 if uneven_px > 0.0 else math.inf
        step = max(start.step_dn, noise_dn)
        slope = SLOPE_SD * step / float(start.ellipse.semi_axes_px[1])
        weights = (noise_dn / np.array([slope, KURTOSIS_SD, LEAN_SD * step, HARMONIC_SD * step])) ** 2
        return Prior(weights, uneven_px, displacement)

    def of_all(self, size: int) -> Floats:
        """Weight (size,) of every parameter except the displacements."""
        out = np.zeros(size)
        out[7], out[8], out[9:11], out[FIXED:] = self.weights
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Sums over the pixels of the linearised model's products; p parameters, k sectors that have pixels.

    "Slopes" are the derivatives of a pixel's level by the parameters, "steepness" is that by the distance.

    Attributes:
        matrix: (p, p) of the slopes' products.
        cost: of the squared residuals.
        pull: (p, k) of the slopes times the residual, in each sector.
        across: (p, k) of the slopes times the steepness.
        along: (k,) of the steepness times the residual.
        square: (k,) of the squared steepness.
    """

    matrix: Floats
    cost: float
    pull: Floats
    across: Floats
    along: Floats
    square: Floats

    @staticmethod
    def of(pixels: Pixels, model: EdgeModel, displaced: Floats) -> Sums:
        """Sum with sectors that lie `displaced` (k,) px inside the ellipse."""
        return Sums(*_pixel_sums(pixels.x, pixels.y, pixels.level, pixels.index, model.numbers(), displaced))


@twin
def _pixel_sums(
    x: Floats, y: Floats, level: Floats, index: Indices, numbers: Floats, displaced: Floats
) -> tuple[Floats, float, Floats, Floats, Floats, Floats]:
    """Compute the parts of `Sums` for the model of these numbers (see `EdgeModel.numbers`)."""
    model = EdgeModel.of(numbers)
    place = Place.of(model.ellipse, x, y, steps=NEAR)
    expected, slopes, steepness = jacobian(model, replace(place, distance=place.distance + displaced[index]))
    residual = level - expected
    first = np.searchsorted(index, np.arange(displaced.size))

    def sums(values: Floats) -> Floats:
        return np.asarray(np.add.reduceat(values, first, axis=-1), dtype=np.float64)

    return (
        gram(slopes),
        float(residual @ residual),
        sums(slopes * residual),
        sums(slopes * steepness),
        sums(steepness * residual),
        sums(steepness * steepness),
    )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Normal:
    """Normal equations with the sectors' displacements eliminated.

    Attributes:
        matrix: (p, p) sum of the slopes' products.
        vector: (p,) sum of the slopes times the residual.
        cost: sum of squares.
        across: (p, k) products of each sector's displacement with the slopes, priors included.
        along: (k,) its products with the residual, priors included.
        inverse: (k,) inverse of its product with itself, prior included.
    """

    matrix: Floats
    vector: Floats
    cost: float
    across: Floats
    along: Floats
    inverse: Floats

    def displaced_by(self, step: Floats) -> Floats:
        """Change (k,) of the displacements with a step of the parameters."""
        return np.asarray((self.along - step @ self.across) * self.inverse)

    @staticmethod
    def of(sums: Sums, displaced: Floats, prior: Prior) -> Normal:
        """Eliminate the displacements (k,) from the sums."""
        matrix, vector, cost = sums.matrix, sums.pull.sum(axis=1), sums.cost
        if math.isinf(prior.displacement):
            none = np.zeros(displaced.size)
            across = np.zeros(sums.across.shape)
            return Normal(matrix=matrix, vector=vector, cost=cost, across=across, along=none, inverse=none)
        along = sums.along - prior.displacement * displaced
        inverse = 1.0 / (sums.square + prior.displacement)
        taken = sums.across * inverse
        return Normal(
            matrix=matrix - taken @ sums.across.T,
            vector=vector - taken @ along,
            cost=cost + prior.displacement * float(displaced @ displaced),
            across=sums.across,
            along=along,
            inverse=inverse,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Result of the fit: the model, the displacements (k,) px, and the sums at it, up to a last tiny step."""

    model: EdgeModel
    displaced: Floats
    sums: Sums


def jacobian(model: EdgeModel, place: Place) -> tuple[Floats, Floats, Floats]:
    """Model levels and their derivatives.

    Returns:
        The levels (n,), their derivatives (FIXED + 2 K, n) by the parameters in the order of FIXED, and their
        derivative by the distance (n,).
    """
    profile = Profile.of(place.distance, place.curvature, model.sigma_px, model.kurtosis)
    basis = harmonics(place.cos_u, place.sin_u, (model.outer.size - 1) // 2)
    inner = model.inner(place)
    step = model.outer @ basis - inner
    out = np.empty((FIXED - 1 + basis.shape[0], place.distance.size))
    by_distance = step * profile.edge_by_distance + model.slope * profile.ramp_by_distance
    np.multiply(distance_slopes(model.ellipse, place), by_distance, out=out[:SHAPE])
    out[5] = step * profile.edge_by_sigma + model.slope * profile.ramp_by_sigma
    out[6] = 1.0 - profile.edge
    out[7] = profile.ramp
    out[8] = step * profile.edge_by_kurtosis
    np.multiply(out[6], place.cos_u, out=out[9])
    np.multiply(out[6], place.sin_u, out=out[10])
    np.multiply(basis, profile.edge, out=out[11:])
    return inner + step * profile.edge + model.slope * profile.ramp, out, by_distance


def _values(model: EdgeModel) -> Floats:
    """Parameters that have a prior, at their places; the others are 0."""
    return np.concatenate([np.zeros(7), [model.slope, model.kurtosis, *model.lean, 0.0], model.outer[1:]])


def moved(model: EdgeModel, step: Floats) -> EdgeModel:
    """Apply a step of the parameters to a model."""
    sigma, inner, slope, kurtosis, lean_x, lean_y = step[SHAPE:11].tolist()
    blur = min(max(model.sigma_px + sigma, 0.5 * model.sigma_px, 0.3), max(2.0 * model.sigma_px, 0.3))
    tails = min(max(model.kurtosis + kurtosis, KURTOSIS_LIMITS[0]), KURTOSIS_LIMITS[1])
    lean = (model.lean[0] + lean_x, model.lean[1] + lean_y)
    return EdgeModel(
        ellipse=reshaped(model.ellipse, step),
        inner_dn=model.inner_dn + inner,
        outer=model.outer + step[11:],
        sigma_px=blur,
        slope=model.slope + slope,
        kurtosis=tails,
        lean=lean,
    )


def fitted(pixels: Pixels, model: EdgeModel, displaced: Floats, prior: Prior, steps: int) -> Solution:
    """Fit the model with at most `steps` Gauss-Newton steps; displaced (k,) is the start of the displacements."""
    about = (pixels.x, pixels.y, pixels.level, pixels.index)
    numbers, displaced, sums = _gauss_newton(
        *about, model.numbers(), displaced, prior.weights, prior.displacement, steps
    )
    return Solution(EdgeModel.of(numbers), displaced, Sums(*sums))


@twin
def _gauss_newton(
    x: Floats, y: Floats, level: Floats, index: Indices, numbers: Floats, displaced: Floats,
    weights: Floats, displacement: float, steps: int,
) -> tuple[Floats, Floats, tuple[Floats, float, Floats, Floats, Floats, Floats]]:  # fmt: skip
    """Take Gauss-Newton steps with Levenberg's damping; the cost is sum r^2 plus the priors' part.

    Args:
        x: (n,) px, like the next three one of `Pixels`.
        y: (n,) px.
        level: (n,) DN.
        index: (n,) sectors.
        numbers: the start of the model (see `EdgeModel.numbers`).
        displaced: (k,) the start of the sectors' displacements.
        weights: (4,) of `Prior`.
        displacement: of `Prior`.
        steps: how many at most.

    Returns:
        The numbers, the displacements, and the parts of `Sums`.
    """
    pixels, model = Pixels(x, y, level, index, index[:0]), EdgeModel.of(numbers)
    prior = Prior(weights, 0.0, displacement)
    found = _descended(pixels, model, displaced, prior, steps)
    sums = found.sums
    parts = (sums.matrix, sums.cost, sums.pull, sums.across, sums.along, sums.square)
    return found.model.numbers(), found.displaced, parts


def _descended(pixels: Pixels, model: EdgeModel, displaced: Floats, prior: Prior, steps: int) -> Solution:
    sums = Sums.of(pixels, model, displaced)
    held = prior.of_all(sums.matrix.shape[0])
    diagonal = np.arange(held.size)
    normal = Normal.of(sums, displaced, prior)
    cost = normal.cost + float(held @ _values(model) ** 2)
    damping = 1e-4
    for _ in range(steps):
        matrix, vector = normal.matrix.copy(), normal.vector - held * _values(model)
        matrix[diagonal, diagonal] += held
        scale = np.sqrt(np.maximum(matrix[diagonal, diagonal], 1e-12))
        matrix /= scale[:, None] * scale
        matrix[diagonal, diagonal] += damping
        step = np.linalg.solve(matrix, vector / scale) / scale
        largest = float(np.abs(step[:SHAPE]).max())
        if largest > 3.0:
            step *= 3.0 / largest
        further = normal.displaced_by(step)
        trial, trial_displaced = moved(model, step), displaced + further
        if largest < STILL_PX and abs(float(step[SHAPE])) < 10.0 * STILL_PX and damping < 1e-3:
            # Another step would be several times smaller, and so small a step hardly changes a sum.
            return Solution(trial, trial_displaced, sums)
        trial_sums = Sums.of(pixels, trial, trial_displaced)
        trial_normal = Normal.of(trial_sums, trial_displaced, prior)
        trial_cost = trial_normal.cost + float(held @ _values(trial) ** 2)
        if trial_cost <= cost:
            model, displaced, sums, normal = trial, trial_displaced, trial_sums, trial_normal
            gained, cost = cost - trial_cost, trial_cost
            damping *= 0.1
            if gained < 1e-7 * cost:
                break
        else:
            damping = min(max(damping * 30.0, 1e-3), 1e6)
    return Solution(model, displaced, sums)
