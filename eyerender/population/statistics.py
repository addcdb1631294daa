"""Statistics of drawn people against their table, and of eyes that are physically impossible."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats, Ints
from ..base.errors import InputError
from ..base.progress import Progress, notify
from ..base.spec import EYES
from .model import Model
from .people import PopulationSpec

CHUNK = 4096
BINS = 48
_REACH = 4.0  # range of histograms on either side of the mean, in standard deviations


@dataclass(frozen=True, slots=True, kw_only=True)
class Moments:
    """Mean and standard deviation of a drawn quantity, with standard errors, and the expected values."""

    name: str  # the quantity; for an eye's quantity, that of right eyes
    n: int  # number of people
    mean: float  # mean
    mean_error: float  # its standard error
    sd: float  # standard deviation
    sd_error: float  # its standard error, from the kurtosis
    expected_mean: float  # mean of the joint distribution; NaN for a quantity that follows from others
    expected_sd: float  # its standard deviation
    edges: Floats  # (b + 1,) edges of the histogram
    counts: Ints  # (b,) people in it

    @property
    def errors(self) -> tuple[float, float]:
        """By how many standard errors mean and standard deviation are off; 0 if nothing is expected or varies."""
        if not np.isfinite(self.expected_mean) or self.expected_sd == 0:
            return 0.0, 0.0
        return (self.mean - self.expected_mean) / self.mean_error, (self.sd - self.expected_sd) / self.sd_error


@dataclass(frozen=True, slots=True)
class PopulationStatistics:
    """Statistics of n people."""

    n: int
    moments: tuple[Moments, ...]


@dataclass(frozen=True, slots=True)
class Refusals:
    """Physically impossible eyes among n people."""

    n: int  # number of people
    people: int  # number of people with an impossible eye
    reasons: Mapping[str, int]  # reason -> number of eyes
    shifts: Mapping[str, float]  # quantity -> mean of the remaining people minus that of all, in standard deviations


def pieces(population: PopulationSpec, n: int, seed: int) -> Iterator[dict[str, Floats]]:
    """Yield the numbers of n people in pieces, name -> (k,) or (k, 2)."""
    for start in range(0, n, CHUNK):
        yield population.numbers(min(CHUNK, n - start), seed, first=start)


def survey(population: PopulationSpec, n: int, seed: int = 0) -> PopulationStatistics:
    """Compare n people with the joint distribution; memory does not grow with n.

    Raises:
        InputError: hardly anybody meets the population's conditions.
    """
    model = population.model
    first = population.numbers(min(n, CHUNK), seed)
    names = tuple(name for name, column in first.items() if _right(column).std() > 0)
    centre = np.array([_right(first[name]).mean() for name in names])
    spread = np.array([_right(first[name]).std() for name in names])
    edges = centre[:, None] + spread[:, None] * np.linspace(-_REACH, _REACH, BINS + 1)
    powers = np.zeros((4, len(names)))
    counts = np.zeros((len(names), BINS), dtype=np.int64)
    for piece in pieces(population, n, seed):
        x = np.column_stack([_right(piece[name]) for name in names])
        t = (x - centre) / spread
        powers += [np.sum(t**k, axis=0) for k in (1, 2, 3, 4)]
        for k in range(len(names)):
            counts[k] += np.histogram(x[:, k], edges[k])[0]
    m1, m2, m3, m4 = powers / n
    variance = m2 - m1**2
    fourth = m4 - 4 * m1 * m3 + 6 * m1**2 * m2 - 3 * m1**4
    sd_error = np.sqrt(np.maximum(fourth - variance**2, 1e-12) / (4 * n * variance))
    plain = not population.where
    moments = tuple(
        Moments(
            name=name, n=n, mean=float(centre[k] + spread[k] * m1[k]),
            mean_error=float(spread[k] * np.sqrt(variance[k] / n)), sd=float(spread[k] * np.sqrt(variance[k])),
            sd_error=float(spread[k] * sd_error[k]), edges=edges[k], counts=counts[k],
            **dict(zip(("expected_mean", "expected_sd"), _expected(model, name, plain), strict=True)),
        )
        for k, name in enumerate(names)
    )  # fmt: skip
    return PopulationStatistics(n, moments)


def refusals(population: PopulationSpec, n: int, seed: int = 0, *, progress: Progress | None = None) -> Refusals:
    """Build both eyes of n people, and compare the people whose eyes are possible with all.

    Raises:
        InputError: hardly anybody meets the population's conditions.
    """
    values: dict[str, list[Floats]] = {}
    stays, reasons = np.ones(n, dtype=bool), Counter[str]()
    for piece in pieces(population, n, seed):
        for name, column in piece.items():
            values.setdefault(name, []).append(_right(column))
    for subject in range(n):
        person = population.person(subject, seed)
        for side in EYES:
            try:
                person.eye(side).build()
            except InputError as error:
                stays[subject] = False
                reasons[f"{error.path}: {error.reason}" if error.path else error.reason] += 1
        notify(progress, subject + 1, n, "eyes built")
    shifts = {}
    for name, parts in values.items():
        x = np.concatenate(parts)
        if x.std() > 0 and stays.any():
            shifts[name] = float((x[stays].mean() - x.mean()) / x.std())
    return Refusals(n, int(np.count_nonzero(~stays)), dict(reasons), shifts)


def _right(column: Floats) -> Floats:
    return column if column.ndim == 1 else column[:, 0]


def _expected(model: Model, name: str, plain: bool) -> tuple[float, float]:
    if not plain or name not in model.distributions:
        return np.nan, np.nan
    return model.expected(name)
