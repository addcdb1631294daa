"""The joint distribution of a population: a Gaussian copula with regressions.

Every quantity q of a person has a latent standard normal number z_q. A marginal makes the value F^-1(Phi(z_q)), a
regression m_q(age, sex, refraction) + s_q z_q. The latent numbers have one correlation matrix, of the subject's
quantities and of those of both eyes. For eye quantities i and j with correlation C_ij within an eye and correlations
r_i, r_j between the eyes, that between i of one eye and j of the other is sqrt(r_i r_j) C_ij.

The table gives total means, spreads and correlations of its reference population. The part explained by the predictors
is subtracted: s_i^2 = sd_i^2 - var(m_i), and the residuals' correlation is (r_ij sd_i sd_j - cov(m_i, m_j)) / (s_i
s_j). Pairs that the table does not name are independent given the others (Dempster 1972). If the result is not a
correlation matrix, the nearest one (Higham 2002) replaces it.

The predictors are independent except for age and refraction, whose latent numbers have a correlation r. The covariance
of two monotone functions F, G of such numbers is the sum over k >= 1 of r^k E[F He_k] E[G He_k] / k! (Mehler's
formula).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.polynomial.hermite_e import hermegauss, hermevander

from ..base.arrays import Floats
from ..base.errors import InputError
from .table import ROOTS, CorrelatedPair, Distribution, PopulationTable, Quantity, QuantityRegression, default_table

SMALLEST = 1e-6
"""Smallest eigenvalue of the matrices used, which must be invertible for conditions."""


def nearest_correlation(matrix: Floats, *, smallest: float = SMALLEST, steps: int = 2000) -> Floats:
    """Compute the nearest matrix (Frobenius norm) with a unit diagonal and no eigenvalue below `smallest`.

    Projections on the two convex sets alternate, with Dykstra's correction for the cone (Higham 2002, "Computing the
    nearest correlation matrix", IMA J. Numer. Anal. 22, 329-343, algorithm 3.3). Raises InputError if the matrix is not
    symmetric, or the iteration does not converge.
    """
    if matrix.ndim != 2 or not np.allclose(matrix, matrix.T, atol=1e-12):
        raise InputError("must be a symmetric matrix", path="correlations")
    current, correction = np.array(matrix), np.zeros_like(matrix)
    for _ in range(steps):
        values, vectors = np.linalg.eigh(current - correction)
        cone = (vectors * np.maximum(values, smallest)) @ vectors.T
        correction = cone - (current - correction)
        moved = (cone + cone.T) / 2
        np.fill_diagonal(moved, 1.0)
        done = np.max(np.abs(moved - current)) < 1e-12 and np.linalg.eigvalsh(moved)[0] > 0.5 * smallest
        current = moved
        if done:
            return np.asarray(current)
    raise InputError("no correlation matrix was found near these", path="correlations")


def completed(matrix: Floats, pairs: list[tuple[int, int]], *, sweeps: int = 500) -> Floats:
    """Compute the correlation matrix (m, m) with the given entries at `pairs` and the largest determinant.

    All other pairs are independent given the rest: their entries of the inverse are 0 (Dempster 1972, "Covariance
    selection", Biometrics 28, 157-175). The pairs are fitted in turn; if no matrix satisfies them all, that of the last
    sweep is returned.
    """
    current = np.eye(len(matrix))
    for _ in range(sweeps):
        worst = 0.0
        for i, j in pairs:
            at = np.ix_((i, j), (i, j))
            wanted = np.array([[1.0, matrix[i, j]], [matrix[i, j], 1.0]])
            worst = max(worst, float(np.max(np.abs(current[at] - wanted))))
            # The 2 x 2 block gets the required value; the regressions of all others on the pair stay.
            gain = current[:, (i, j)] @ np.linalg.inv(current[at])
            current = current + gain @ (wanted - current[at]) @ gain.T
        if worst < 1e-13:
            break
    scale = 1.0 / np.sqrt(np.diag(current))
    return np.asarray(current * scale[:, None] * scale)


_NODES, _ORDERS = 200, 16  # r^16 is below 1e-11 for the correlations of refraction and age


@dataclass(frozen=True, kw_only=True)
class Reference:
    """The table's reference population: moments of its predictors, its regressions, the latent correlations."""

    table: PopulationTable  # the table
    distributions: Mapping[str, Distribution]  # distribution of each quantity
    correlation: Floats  # (e, e) latent correlations that the table gives within an eye; 0 where it gives none
    latent: Floats  # (s + 2 e, s + 2 e) correlation matrix of subject, right eye and left eye
    # Frobenius distance between `latent` and the completed matrix, to which it is the nearest correlation matrix
    distance: float

    @classmethod
    def of(cls, table: PopulationTable) -> Reference:
        """Solve the residuals of a table.

        Raises:
            InputError: its predictors explain more of a quantity than its whole spread.
        """
        about = {root: _moments(_marginal(table.quantities[root]))[0] for root in ROOTS}
        found = {name: _resolved(name, q, table, about) for name, q in table.quantities.items()}
        eye = [name for name, q in table.quantities.items() if q.of == "eye"]
        asked = np.eye(len(eye))
        pairs = []
        for pair in table.correlations:
            i, j = (eye.index(name) for name in pair.pair)
            asked[i, j] = asked[j, i] = _latent(pair, table, found)
            pairs.append((i, j))
        inside = completed(asked, pairs)
        subjects = sum(q.of == "subject" for q in table.quantities.values())
        root = np.sqrt([max(table.quantities[name].eyes, 0.0) for name in eye])
        between = root[:, None] * inside * root
        np.fill_diagonal(between, [table.quantities[name].eyes for name in eye])
        whole = np.eye(subjects + 2 * len(eye))
        whole[subjects:, subjects:] = np.block([[inside, between], [between.T, inside]])
        _join_age(whole, table)
        nearest = nearest_correlation(whole)
        distance = float(np.linalg.norm(nearest - whole))
        return cls(table=table, distributions=found, correlation=asked, latent=nearest, distance=distance)

    def with_age_r(self, r: float) -> Reference:
        """Replace the latent correlation of age and refraction; residuals and their correlations stay."""
        refraction = self.table.quantities["refraction_d"].model_copy(update={"age_r": r})
        table = self.table.model_copy(update={"quantities": {**self.table.quantities, "refraction_d": refraction}})
        latent = np.array(self.latent)
        _join_age(latent, table)
        return replace(self, table=table, latent=nearest_correlation(latent))


@dataclass(frozen=True)
class Model:
    """The joint distribution of one population."""

    reference: Reference  # source of the residuals
    distributions: Mapping[str, Distribution]  # distribution of each quantity, replaced ones included

    @cached_property
    def subject_names(self) -> tuple[str, ...]:
        """Quantities of a subject."""
        return tuple(n for n, q in self.reference.table.quantities.items() if q.of == "subject")

    @cached_property
    def eye_names(self) -> tuple[str, ...]:
        """Quantities of an eye."""
        return tuple(n for n, q in self.reference.table.quantities.items() if q.of == "eye")

    @property
    def width(self) -> int:
        """Number of latent numbers of a person."""
        return len(self.subject_names) + 2 * len(self.eye_names)

    @cached_property
    def factor(self) -> Floats:
        """Lower triangular factor of the latent correlation matrix."""
        return np.asarray(np.linalg.cholesky(self.reference.latent))

    def places(self, name: str) -> tuple[int, ...]:
        """Return the columns of a quantity's latent numbers: one, or right and left.

        Raises:
            InputError: there is no such quantity.
        """
        if name in self.subject_names:
            return (self.subject_names.index(name),)
        if name in self.eye_names:
            k = len(self.subject_names) + self.eye_names.index(name)
            return k, k + len(self.eye_names)
        raise InputError(f"no such quantity; there are {', '.join(self.distributions)}", path=name)

    def value(self, name: str, latent: Floats, known: Mapping[str, Floats] | None = None) -> Floats:
        """Compute a quantity, (n,) or (n, 2) for right and left, from latent numbers (n, width).

        `known` holds values of predictors that are already computed.
        """
        places, found = self.places(name), self.distributions[name]
        z = latent[:, places[0]] if len(places) == 1 else latent[:, places]
        if isinstance(found, QuantityRegression):
            return np.asarray(self.mean(name, latent, known) + found.residual_sd * z)
        return found.at(z)

    def mean(self, name: str, latent: Floats, known: Mapping[str, Floats] | None = None) -> Floats:
        """Compute the mean (n,) or (n, 2) of a regression, for the predictors of latent numbers (n, width).

        A regression of a subject's quantity on the refraction uses the mean of both eyes.
        """
        found, places = self.distributions[name], self.places(name)
        assert isinstance(found, QuantityRegression)
        shape = (len(latent),) if len(places) == 1 else (len(latent), 2)
        mean: Floats = np.asarray(found.mean)
        for root, slope in found.slopes.items():
            value = self.value(root, latent) if known is None else known[root]
            if value.ndim > len(shape):
                value = value.mean(axis=1)
            elif value.ndim < len(shape):
                value = value[:, None]
            mean = mean + slope * (value - found.about[root])
        return np.broadcast_to(mean, shape)

    def values(self, latent: Floats) -> dict[str, Floats]:
        """Compute every quantity, (n,) or (n, 2), from latent numbers (n, width)."""
        roots = {root: self.value(root, latent) for root in ROOTS}
        return {name: roots[name] if name in roots else self.value(name, latent, roots) for name in self.distributions}

    def required(self, name: str, value: float, latent: Floats) -> Floats:
        """Compute the latent numbers (n,) or (n, 2) that give a quantity one value."""
        found, places = self.distributions[name], self.places(name)
        shape = (len(latent),) if len(places) == 1 else (len(latent), 2)
        if isinstance(found, QuantityRegression):
            return np.asarray((value - self.mean(name, latent)) / found.residual_sd)
        return np.broadcast_to(found.latent(np.array(value)), shape)

    def expected(self, name: str) -> tuple[float, float]:
        """Compute the mean and standard deviation of a quantity, exactly."""
        found = self.distributions[name]
        if not isinstance(found, QuantityRegression):
            return found.moments
        variance = found.residual_sd**2 + _explained(found, found, self.distributions, self.reference.table)
        return _mean(found, self.distributions), float(np.sqrt(variance))

    def expected_correlation(self, first: str, second: str) -> float:
        """Compute the correlation of two quantities of one eye: exactly for regressions, else of latent numbers."""
        a, b = self.distributions[first], self.distributions[second]
        i, j = self.places(first)[0], self.places(second)[0]
        latent = float(self.reference.latent[i, j])
        if not (isinstance(a, QuantityRegression) and isinstance(b, QuantityRegression)):
            return latent
        explained = _explained(a, b, self.distributions, self.reference.table)
        shared = latent * a.residual_sd * b.residual_sd + explained
        return shared / (self.expected(first)[1] * self.expected(second)[1])


@cache
def default_reference() -> Reference:
    """Return the reference population of the package's table; solved once."""
    return Reference.of(default_table())


@cache
def reference_of(preset: str) -> Reference:
    """Return the reference population with the preset's own correlation of age and refraction."""
    reference = default_reference()
    own = reference.table.presets[preset].age_r
    return reference if own is None else reference.with_age_r(own)


def _join_age(latent: Floats, table: PopulationTable) -> None:
    """Write the correlation of age with the refraction of both eyes into latent correlations, in place."""
    subject, eye = ([name for name, q in table.quantities.items() if q.of == of] for of in ("subject", "eye"))
    age, first = subject.index("age_years"), len(subject) + eye.index("refraction_d")
    for column in (first, first + len(eye)):
        latent[age, column] = latent[column, age] = table.age_r


def _marginal(quantity: Quantity) -> Distribution:
    assert quantity.marginal is not None
    return quantity.marginal


def _resolved(name: str, quantity: Quantity, table: PopulationTable, about: Mapping[str, float]) -> Distribution:
    if quantity.marginal is not None:
        return quantity.marginal
    assert quantity.mean is not None
    bare = QuantityRegression(
        mean=quantity.mean,
        residual_sd=1.0 if quantity.residual_sd is None else quantity.residual_sd,
        slopes=quantity.slopes,
        about={root: about[root] for root in quantity.slopes},
    )
    if quantity.residual_sd is not None:
        return bare
    assert quantity.sd is not None
    roots = {root: _marginal(table.quantities[root]) for root in ROOTS}
    rest = quantity.sd**2 - _explained(bare, bare, roots, table)
    if not rest > 0:
        raise InputError("is smaller than what the predictors explain", path=f"quantities.{name}.sd")
    return bare.model_copy(update={"residual_sd": float(np.sqrt(rest))})


def _latent(pair: CorrelatedPair, table: PopulationTable, found: Mapping[str, Distribution]) -> float:
    """Compute the correlation of the latent numbers of a pair."""
    a, b = (found[name] for name in pair.pair)
    if pair.of == "residuals" or not (isinstance(a, QuantityRegression) and isinstance(b, QuantityRegression)):
        return pair.r
    roots = {root: found[root] for root in ROOTS}
    spreads = [np.sqrt(q.residual_sd**2 + _explained(q, q, roots, table)) for q in (a, b)]
    rest = pair.r * spreads[0] * spreads[1] - _explained(a, b, roots, table)
    return float(np.clip(rest / (a.residual_sd * b.residual_sd), -0.999, 0.999))


def _explained(
    a: QuantityRegression, b: QuantityRegression, roots: Mapping[str, Distribution], table: PopulationTable
) -> float:
    """Compute the covariance of the means of two regressions in one eye."""
    pairs = [(p, q) for p in sorted(a.slopes) for q in sorted(b.slopes)]
    return sum(a.slopes[p] * b.slopes[q] * _covariance(p, q, roots, table) for p, q in pairs)


def _covariance(first: str, second: str, roots: Mapping[str, Distribution], table: PopulationTable) -> float:
    """Compute the covariance of two predictors."""
    if first == second:
        return _moments(roots[first])[1] ** 2
    if {first, second} != {"age_years", "refraction_d"} or not table.age_r:
        return 0.0
    k = np.arange(1, _ORDERS)
    series = table.age_r**k * _hermite(roots[first]) * _hermite(roots[second])
    return float(np.sum(series / np.cumprod(k.astype(float))))


def _hermite(found: Distribution) -> Floats:
    """Compute E[F(z) He_k(z)] for k >= 1 of the map F of a marginal."""
    assert not isinstance(found, QuantityRegression)
    z, weighted = _quadrature()
    return np.asarray(found.at(z) @ weighted)


@cache
def _quadrature() -> tuple[Floats, Floats]:
    """Return nodes z (n,) of Gauss and Hermite, and He_k(z) for k >= 1, times the nodes' weights (n, k)."""
    z, weight = hermegauss(_NODES)
    return z, hermevander(z, _ORDERS - 1)[:, 1:] * (weight / weight.sum())[:, None]


def _mean(found: QuantityRegression, roots: Mapping[str, Distribution]) -> float:
    shifts = (slope * (_moments(roots[root])[0] - found.about[root]) for root, slope in found.slopes.items())
    return found.mean + sum(shifts)


def _moments(found: Distribution) -> tuple[float, float]:
    assert not isinstance(found, QuantityRegression)
    return found.moments
