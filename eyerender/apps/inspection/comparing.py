"""How the distributions of two datasets differ: the Kolmogorov-Smirnov distance of each number.

The distance is the largest difference of the two cumulative distributions, 0 to 1. Two random samples of one
distribution differ by more than c(5 %) sqrt((n + m) / (n m)) in one case of twenty, c = 1.36. Numbers that are the same
in all images of a subject count once for each subject.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import ks_2samp

from ...base.arrays import Floats
from .reading import Contents

_CRITICAL = 1.36
_LEAST = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Shift:
    """Difference of one number in two datasets.

    Attributes:
        column: its name.
        distance: of Kolmogorov and Smirnov.
        chance: distance that samples of one distribution exceed in 5 % of cases.
        medians: of both datasets.
        counts: images, or subjects, that have the number in both.
    """

    column: str
    distance: float
    chance: float
    medians: tuple[float, float]
    counts: tuple[int, int]


def shifts(first: Contents, second: Contents) -> list[Shift]:
    """Compare all numbers that both datasets have; the largest differences beyond chance come first."""
    found = []
    for name in first.columns:
        if name not in second.columns:
            continue
        a, b = sample_of(first, name), sample_of(second, name)
        if min(len(a), len(b)) < _LEAST:
            continue
        distance = float(ks_2samp(a, b, method="asymp").statistic)
        chance = _CRITICAL * math.sqrt((len(a) + len(b)) / (len(a) * len(b)))
        medians = float(np.median(a)), float(np.median(b))
        found.append(
            Shift(column=name, distance=distance, chance=min(chance, 1.0), medians=medians, counts=(len(a), len(b)))
        )
    return sorted(found, key=lambda shift: (shift.distance <= shift.chance, -shift.distance, shift.column))


def only_in(first: Contents, second: Contents) -> list[str]:
    """Names of the numbers that only the first dataset has."""
    return sorted(set(first.columns) - set(second.columns))


def sample_of(contents: Contents, name: str) -> Floats:
    """Numbers of a column; one for each subject where all images of each subject have the same."""
    values: Floats = contents.columns[name].astype(float)
    there = np.isfinite(values)
    values, subjects = values[there], contents.subjects[there]
    order = np.argsort(subjects, kind="stable")
    values, subjects = values[order], subjects[order]
    starts = np.flatnonzero(np.diff(subjects, prepend=-2) != 0)
    if len(starts) < 2 or len(values) == len(starts) or -1 in subjects:
        return values
    same = np.maximum.reduceat(values, starts) == np.minimum.reduceat(values, starts)
    return values[starts] if same.all() else values


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
