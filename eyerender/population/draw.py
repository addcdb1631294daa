"""Draw people as pure functions of (population, seed, subject).

The latent numbers of subject k at attempt a are the outputs k w, k w + 1, ... of the counter-based generator Philox
(Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3", SC11) whose key is (seed, a). Matrix products are
sums in one order for each person, which those of BLAS are not. So a subject depends neither on the number of people nor
on the pieces in which they are drawn.

Conditions. An exact value of a predictor or of another quantity with a marginal of its own fixes its latent number, and
the others follow by Gaussian conditioning. An exact value of a regression's quantity fixes a latent number that depends
on the predictors: these are drawn first, and accepted with the probability

    exp(-(c - m)^T V^-1 (c - m) / 2),

c the latent numbers that the values require, m and V their conditional mean and covariance given the latent numbers of
the predictors; then the others follow as above. A range of a subject's quantity with a marginal truncates its latent
number z to z', and the numbers that are correlated with it follow by cov (z' - z), unless an exact value fixes one of
them. Any other range is met by drawing again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from ..base.arrays import Bools, Floats, Indices
from ..base.errors import InputError
from .marginals import Share, Uniform, truncated
from .model import Model
from .table import ROOTS, Distribution, QuantityRegression

Condition = float | tuple[float, float]
ATTEMPTS = 2000
"""Number of draws of a subject until it meets the conditions."""
_FEW = 32
_TAG = 0x9E0


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Conditions on a population, sorted by how they are met."""

    exact: Mapping[str, float]  # quantities with a regression -> value
    ranges: Mapping[str, tuple[float, float]]  # quantity -> low and high
    # latent column -> ends of the truncated latent number, and how the others follow it (width,)
    cut: Mapping[int, tuple[float, float, Floats]]
    fixed: Floats  # (f,) required values of fixed latent numbers
    columns: list[int]  # (f,) columns of the fixed latent numbers
    carry: Floats  # (f, w) change of all latent numbers per change of the fixed ones
    mean: Floats  # (r, e) coefficients of the conditional mean of `exact`'s latent numbers, given those of `given`
    given: list[int]  # (r,) columns of the predictors and of fixed numbers
    fitted: list[int]  # (e,) columns of `exact`
    precision: Floats  # (e, e) inverse V^-1
    follow: Floats  # (e, w) change of all latent numbers per change of those of `exact`

    @classmethod
    def of(cls, model: Model, where: Mapping[str, Condition]) -> Conditions:
        """Sort conditions by how they are met.

        Raises:
            InputError: there is no such quantity, or it cannot have that value.
        """
        fixed: dict[int, float] = {}
        exact: dict[str, float] = {}
        ranges: dict[str, tuple[float, float]] = {}
        cut: dict[str, tuple[float, float]] = {}
        for name, wanted in where.items():
            found, places = model.distributions[name], model.places(name)
            if isinstance(found, QuantityRegression):
                if isinstance(wanted, int | float):
                    exact[name] = float(wanted)
                else:
                    ranges[name] = _range(name, wanted)
                continue
            if isinstance(found, Share) or not isinstance(wanted, int | float):
                cut[name] = _ends(name, found, wanted)
            else:
                z = float(found.latent(np.array(float(wanted))))
                if not np.isfinite(z) or abs(float(found.at(np.array(z))) - wanted) > 1e-6 * (1 + abs(wanted)):
                    raise InputError(f"nobody in this population has the value {wanted:g}", path=name)
                fixed |= dict.fromkeys(places, z)
        cov = model.reference.latent
        columns = list(fixed)
        truncated_at: dict[int, tuple[float, float, Floats]] = {}
        for name, ends in cut.items():
            places = model.places(name)
            if len(places) == 1 and not cov[places[0], columns].any():
                truncated_at[places[0]] = (*ends, cov[places[0]])
            else:
                ranges[name] = _range(name, where[name])
        given = sorted({p for root in ROOTS for p in model.places(root)} | set(columns))
        fitted = [p for name in exact for p in model.places(name)]
        weight = np.linalg.solve(cov[np.ix_(given, given)], cov[given])
        rest = cov - cov[:, given] @ weight
        precision = np.linalg.inv(rest[np.ix_(fitted, fitted)])
        return cls(
            exact=exact,
            ranges=ranges,
            cut=truncated_at,
            fixed=np.array([fixed[c] for c in columns]),
            columns=columns,
            carry=np.asarray(np.linalg.solve(cov[np.ix_(columns, columns)], cov[columns]), dtype=np.float64),
            mean=np.asarray(weight[:, fitted], dtype=np.float64),
            given=given,
            fitted=fitted,
            precision=np.asarray(precision, dtype=np.float64),
            follow=precision @ rest[fitted],
        )


def latent_numbers(model: Model, conditions: Conditions, seed: int, first: int, count: int) -> Floats:
    """Draw latent numbers (count, width) of subjects from `first` on that meet the conditions.

    Raises:
        InputError: hardly anybody meets them.
    """
    out = np.empty((count, model.width))
    left: Indices = np.arange(count)
    for attempt in range(ATTEMPTS):
        stream = (_TAG << 32) + attempt
        if len(left) > _FEW:
            u = uniform_numbers(seed, stream, first, count, model.width + 1)[left]
        else:
            u = np.concatenate([uniform_numbers(seed, stream, first + int(k), 1, model.width + 1) for k in left])
        z, good = _conditioned(model, conditions, _times(ndtri(u[:, :-1]), model.factor.T), u[:, -1])
        out[left[good]] = z[good]
        left = left[~good]
        if not len(left):
            return out
    raise InputError(f"less than one person in {ATTEMPTS} meets the conditions", path="where")


def uniform_numbers(seed: int, stream: int, first: int, count: int, width: int) -> Floats:
    """Compute uniform numbers in (0, 1), (count, width), of items from `first` on; pure in (seed, stream, item)."""
    padded = -(-width // 4) * 4
    generator = np.random.Philox(key=np.array([seed, stream], dtype=np.uint64))
    generator.advance(first * (padded // 4))
    raw = generator.random_raw(count * padded).reshape(count, padded)[:, :width]
    return np.asarray(((raw >> np.uint64(11)) + 0.5) * 2.0**-53)


def _conditioned(model: Model, conditions: Conditions, z: Floats, u: Floats) -> tuple[Floats, Bools]:
    """Apply the exact conditions to latent numbers; also return whether each subject is accepted."""
    good = np.ones(len(z), dtype=bool)
    for column, (low, high, follow) in conditions.cut.items():
        z = z + (truncated(z[:, column], low, high) - z[:, column])[:, None] * follow
    if conditions.columns:
        z = z + _times(conditions.fixed - z[:, conditions.columns], conditions.carry)
    if conditions.exact:
        required = np.column_stack([model.required(name, value, z) for name, value in conditions.exact.items()])
        gap = required - _times(z[:, conditions.given], conditions.mean)
        good &= u < np.exp(-0.5 * np.sum(gap * _times(gap, conditions.precision), axis=1))
        z = z + _times(required - z[:, conditions.fitted], conditions.follow)
    for name, (low, high) in conditions.ranges.items():
        value = model.value(name, z).reshape(len(z), -1)
        good &= ((value >= low) & (value <= high)).all(axis=1)
    return z, good


def _times(rows: Floats, matrix: Floats) -> Floats:
    """Multiply matrices with sums in a fixed order, independent of the number of rows."""
    return np.asarray(np.einsum("ij,jk->ik", rows, np.ascontiguousarray(matrix)))


def _range(name: str, wanted: tuple[float, float] | float) -> tuple[float, float]:
    assert not isinstance(wanted, int | float)
    low, high = wanted
    if not low < high:
        raise InputError("the first number must be below the second", path=name)
    return low, high


def _ends(name: str, found: Distribution, wanted: Condition) -> tuple[float, float]:
    """Convert the limits of a quantity with a marginal to limits of its latent number."""
    assert not isinstance(found, QuantityRegression)
    if isinstance(found, Share):
        number = float(found.latent(np.array(wanted))) if isinstance(wanted, int | float) else np.nan
        if not np.isfinite(number):
            raise InputError("must be 0 or 1, and somebody must have it", path=name)
        edge = float(ndtri(1.0 - found.share))
        return (edge, np.inf) if wanted == 1 else (-np.inf, edge)
    span = _range(name, wanted)
    low, high = (float(v) for v in found.latent(np.array(span)))
    if isinstance(found, Uniform):
        low, high = -np.inf if span[0] <= found.low else low, np.inf if span[1] >= found.high else high
    if not low < high:
        raise InputError("nobody in this population lies in the range", path=name)
    return low, high
