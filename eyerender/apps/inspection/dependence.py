"""Which drawn variables and labels depend on each other, so that a network may learn one from the other.

The unit is the subject. The means of subjects are compared by Spearman's correlation, or by Fisher's exact test if both
have two values. Two numbers that vary within subjects are also compared by their differences from the subject's mean
rank. That p is the larger one of two: of the sum of products over its exact variance if a subject's images were
shuffled, and of a t test of the subjects' sums, which needs no such assumption. All p are multiplied by the number of
tests (Bonferroni), so one dataset in a hundred without any dependence is said to have one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import hypergeom, norm, rankdata
from scipy.stats import t as student

from ...base.arrays import Bools, Floats, Ints
from .statistics import rank_correlations

ERROR = 0.01
SUBJECTS = 60
"""Fewest subjects with which dependences are tested."""
_UNITS = 20  # subjects that have both numbers of a pair, or in which both vary
_TOGETHER = 5  # subjects that chance gives both of two rare values


class Dependence(NamedTuple):
    """Names of two numbers that depend on each other; p of chance alone giving one such pair on the whole page."""

    a: str
    b: str
    rank_correlation: float
    p: float
    declared: bool


def dependences(
    numbers: Mapping[str, Floats], subjects: Ints, declared: Callable[[str, str], bool]
) -> list[Dependence] | None:
    """Test all pairs of numbers.

    Args:
        numbers: name -> (n,), nan where an image has no such number.
        subjects: (n,) subject of each image; below 0: the image counts as a subject of its own.
        declared: whether two names may depend on each other.

    Returns:
        The pairs with p <= 1 %, the undeclared and the strongest first; None if there are fewer than 60 subjects.
    """
    subjects = np.where(subjects >= 0, subjects, -1 - np.arange(len(subjects)))
    found, unit = np.unique(subjects, return_inverse=True)
    if len(found) < SUBJECTS:
        return None
    names = [name for name, values in numbers.items() if len(np.unique(values[np.isfinite(values)])) > 1]
    if not names:
        return []
    values = np.stack([numbers[name] for name in names], axis=1)
    both = [_within(values, unit), _between(values, unit)]
    count = sum(int(np.triu(tested, 1).sum()) for _, _, tested in both)
    (rho, p), (rho_means, p_means) = ((rho, np.where(tested, p, 1.0)) for rho, p, tested in both)
    rho, p = np.where(p <= p_means, rho, rho_means), np.minimum(np.minimum(p, p_means) * count, 1.0)
    pairs = [
        Dependence(names[i], names[j], float(rho[i, j]), float(p[i, j]), declared(names[i], names[j]))
        for i, j in np.argwhere(np.triu(p <= ERROR, 1)).tolist()
    ]
    return sorted(pairs, key=lambda one: (one.declared, -abs(one.rank_correlation)))


def _sums(values: Floats, unit: Ints) -> Floats:
    """Sum rows (n, m) of each unit, (units, m)."""
    order = np.argsort(unit, kind="stable")
    starts = np.searchsorted(unit[order], np.arange(unit.max() + 1))
    return np.asarray(np.add.reduceat(values[order], starts, axis=0))


def _within(values: Floats, unit: Ints) -> tuple[Floats, Floats, Bools]:
    """Correlate numbers (n, m) within units: (m, m) correlations, p, and whether both vary in enough units."""
    there = np.isfinite(values)
    ranks = np.where(there, rankdata(values, axis=0, nan_policy="omit"), 0.0)
    means = _sums(ranks, unit) / np.maximum(_sums(there.astype(float), unit), 1)
    apart = np.where(there, ranks - means[unit], 0.0)
    apart[np.abs(apart) < 1e-6] = 0.0
    squares = _sums(apart**2, unit)
    shared = (squares > 0).T.astype(float) @ (squares > 0)
    total, spread = np.zeros(shared.shape), np.zeros(shared.shape)
    for k, column in enumerate(apart.T):
        sums = _sums(column[:, None] * apart, unit)
        total[k], spread[k] = sums.sum(axis=0), (sums**2).sum(axis=0)
    variance = (squares / np.maximum(np.bincount(unit)[:, None] - 1, 1)).T @ squares
    whole = squares.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        rho, z, q = (total / np.sqrt(square) for square in (np.outer(whole, whole), variance, spread))
        t = q * np.sqrt((shared - 1) / np.maximum(shared - q**2, 1e-12))
    p = np.maximum(2 * norm.sf(np.abs(z)), 2 * student.sf(np.abs(t), np.maximum(shared - 1, 1)))
    return rho, p, shared >= _UNITS


def _between(values: Floats, unit: Ints) -> tuple[Floats, Floats, Bools]:
    """Correlate the means of units of numbers (n, m): (m, m) correlations, p, and whether enough units have both."""
    there = np.isfinite(values)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = _sums(np.where(there, values, 0.0), unit) / _sums(there.astype(float), unit)
    means = means.astype(np.float32)  # equal numbers have equal means
    own = np.isfinite(means)
    counts = [np.unique(column[has], return_counts=True)[1] for column, has in zip(means.T, own.T, strict=True)]
    rare = np.array([1 - c.max() / c.sum() for c in counts])
    rho, n = rank_correlations(means), own.T.astype(float) @ own
    with np.errstate(invalid="ignore", divide="ignore"):
        t = rho * np.sqrt(np.maximum(n - 2, 0) / np.maximum(1 - rho**2, 1e-300))
    p = 2 * student.sf(np.abs(t), np.maximum(n - 2, 1))
    # Two values each: the exact probability of the number of units that have the larger one of both.
    ones = (own & (means == np.max(np.where(own, means, -np.inf), axis=0))).astype(float)
    common, first = ones.T @ ones, ones.T @ own
    chance = hypergeom(n, first, first.T)
    exact = np.minimum(2 * np.minimum(chance.sf(common - 1), chance.cdf(common)), 1.0)
    has_two = np.array([len(c) == 2 for c in counts])
    two = np.outer(has_two, has_two)
    enough = two | (n * np.outer(rare, rare) >= _TOGETHER)
    return rho, np.where(two, exact, p), np.isfinite(rho) & (n >= _UNITS) & enough
