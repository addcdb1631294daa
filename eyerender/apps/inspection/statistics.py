"""Distributions of the numbers of a dataset, and how they depend on each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import rankdata

from ...base.arrays import Floats, Ints, Reals

BINS = 30
_ENDS = (0.002, 0.998)  # numbers beyond these quantiles are counted in the first and the last bin
_QUANTILES = (0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0)
_NAMES = ("min", "q01", "q25", "median", "q75", "q99", "max")


@dataclass(frozen=True, slots=True, kw_only=True)
class Distribution:
    """Distribution of a column."""

    column: str  # its name
    count: int  # images that have the number
    quantiles: tuple[float, ...]  # minimum, 1, 25, 50, 75 and 99 % quantiles, and maximum
    edges: Floats  # (BINS + 1,) of the bins; empty where all numbers are equal
    counts: Ints  # (BINS,) in each bin; the first and the last one hold all beyond

    def to_mapping(self) -> dict[str, Any]:
        """Return what the JSON holds."""
        values = dict(zip(_NAMES, self.quantiles, strict=True))
        return {"n": self.count, **values, "edges": self.edges.tolist(), "counts": self.counts.tolist()}


def distribution(name: str, column: Reals) -> Distribution:
    """Summarise a column (n,); nan is no number."""
    values = column[np.isfinite(column)].astype(float)
    quantiles = tuple(float(v) for v in np.quantile(values, _QUANTILES))
    edges, counts = np.zeros(0), np.zeros(0, dtype=np.int64)
    if quantiles[0] < quantiles[-1]:
        low, high = np.quantile(values, _ENDS)
        if low == high:
            low, high = quantiles[0], quantiles[-1]
        edges = np.linspace(low, high, BINS + 1)
        counts = binned(values, edges)
    return Distribution(column=name, count=len(values), quantiles=quantiles, edges=edges, counts=counts)


def binned(values: Floats, edges: Floats) -> Ints:
    """Count numbers in bins; the first and the last bin hold all beyond."""
    at = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return np.bincount(at, minlength=len(edges) - 1).astype(np.int64)


def rank_correlations(values: Reals) -> Floats:
    """Spearman's correlations of columns (n, m), as (m, m); a missing number counts in no pair.

    Ranks are those among all numbers of a column. A column without two different numbers has nan.
    """
    there = np.isfinite(values)
    ranks = np.zeros(values.shape)
    for k, own in enumerate(there.T):
        if own.any():
            found = rankdata(values[own, k])
            ranks[own, k] = found - found.mean()
    squares = (ranks**2).T @ there.astype(float)  # of a column, over the rows that another one has
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.clip((ranks.T @ ranks) / np.sqrt(squares * squares.T), -1.0, 1.0))
