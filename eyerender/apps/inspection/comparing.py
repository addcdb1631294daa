"""How the distributions of two datasets differ: the Kolmogorov-Smirnov distance of each number.

The distance is the largest difference of the two cumulative distributions, 0 to 1. Images of one subject resemble each
other, so whole subjects are compared; where a dataset has none or a single one, images are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import ks_2samp

from ...base.arrays import Floats, Ints
from .reading import Contents

_CRITICAL = 1.36
_LEAST = 5
_LEVELS = np.linspace(0.0, 1.0, 257)
_DEALS = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class Shift:
    """Difference of one number in two datasets."""

    column: str  # its name
    distance: float  # of Kolmogorov and Smirnov
    chance: float  # distance that chance exceeds in 5 % of cases
    medians: tuple[float, float]  # of both datasets
    counts: tuple[int, int]  # subjects that have the number in both; images where a dataset has less than two subjects


def shifts(first: Contents, second: Contents) -> list[Shift]:
    """Compare all numbers that both datasets have; the largest differences beyond chance come first."""
    found, by_subject = [], has_subjects(first) and has_subjects(second)
    for name in first.columns:
        if name not in second.columns:
            continue
        a, b = (sample_of(contents, name, by_subject=by_subject) for contents in (first, second))
        counts = len(np.unique(a[1])), len(np.unique(b[1]))
        if min(counts) < _LEAST:
            continue
        distance, chance = distance_and_chance(a, b)
        medians = float(np.median(a[0])), float(np.median(b[0]))
        found.append(Shift(column=name, distance=distance, chance=chance, medians=medians, counts=counts))
    return sorted(found, key=lambda shift: (shift.distance <= shift.chance, -shift.distance, shift.column))


def only_in(first: Contents, second: Contents) -> list[str]:
    """Names of the numbers that only the first dataset has."""
    return sorted(set(first.columns) - set(second.columns))


def sample_of(contents: Contents, name: str, *, by_subject: bool) -> tuple[Floats, Ints]:
    """Return the numbers of a column (n,), and the unit that each belongs to (n,): its subject or its image."""
    values: Floats = contents.columns[name].astype(float)
    units = contents.subjects if by_subject else np.arange(len(values))
    there = np.isfinite(values)
    return values[there], np.unique(units[there], return_inverse=True)[1]


def has_subjects(contents: Contents) -> bool:
    """Return whether all images with a readable line name their subject, and there are several subjects."""
    subjects = contents.subjects[[bool(name) for name in contents.names]]
    return bool((subjects >= 0).all()) and len(np.unique(subjects)) > 1


def distance_and_chance(first: tuple[Floats, Ints], second: tuple[Floats, Ints]) -> tuple[float, float]:
    """Compute the Kolmogorov-Smirnov distance of two samples, and the distance that chance exceeds in 5 % of cases.

    With independent numbers, chance is 1.36 sqrt((n + m) / (n m)). Where units have several numbers, the units are also
    dealt to the two datasets at random, and chance is the 95th percentile of the distances if that is larger. It is
    smaller where draws of a dataset are spread evenly (Sobol, grids). `first`: numbers (n,), and the unit of each (n,),
    counted from 0; `second`: those of the other dataset.
    """
    sizes = [int(units.max()) + 1 for _, units in (first, second)]
    counts = len(first[0]), len(second[0])
    chance = min(_CRITICAL * math.sqrt(sum(counts) / math.prod(counts)), 1.0)
    if sum(sizes) == sum(counts):
        return float(ks_2samp(first[0], second[0], method="asymp").statistic), chance
    levels = np.unique(np.quantile(np.concatenate([first[0], second[0]]), _LEVELS, method="inverted_cdf"))
    below = np.zeros((sum(sizes), len(levels)), np.float32)  # numbers of each unit up to each level
    for start, (values, units) in zip((0, sizes[0]), (first, second), strict=True):
        np.add.at(below, (start + units, np.searchsorted(levels, values)), 1)
    np.cumsum(below, axis=1, out=below)
    dealt = np.zeros((_DEALS + 1, sum(sizes)), np.float32)  # the first one is as the datasets are
    dealt[:, : sizes[0]] = 1
    np.random.default_rng(0).permuted(dealt[1:], axis=1, out=dealt[1:])
    mine = dealt @ below
    other = below.sum(axis=0) - mine
    distances = np.abs(mine / mine[:, -1:] - other / other[:, -1:]).max(axis=1)
    return float(distances[0]), max(chance, float(np.quantile(distances[1:], 0.95, method="higher")))


def shares(first: Contents, second: Contents) -> list[tuple[str, float, Sequence[tuple[str, float, float]]]]:
    """Compare groups such as splits and cameras: name, total variation distance, and the shares of each value."""
    found = []
    for name in first.groups.keys() & second.groups.keys():
        one, other = (_share(c, name) for c in (first, second))
        rows = [(value, one.get(value, 0.0), other.get(value, 0.0)) for value in sorted({*one, *other})]
        found.append((name, sum(abs(a - b) for _, a, b in rows) / 2, rows))
    return sorted(found, key=lambda row: (-row[1], row[0]))


def _share(contents: Contents, name: str) -> dict[str, float]:
    values = [str(v) for v in contents.groups[name] if v is not None]
    kinds, counts = np.unique(np.array(values, dtype=str), return_counts=True)
    return {str(kind): float(count) / len(values) for kind, count in zip(kinds, counts, strict=True)}
