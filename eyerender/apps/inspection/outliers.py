"""Images whose numbers are unusual, alone or together, and the pictures that are worst by simple figures.

Alone: how far a number x lies beyond the middle 98 % of its column, in units of half that range,

    (x - q99) / (q99 - q50)   or   (q01 - x) / (q50 - q01)

which is at most .05 for uniform numbers, about 1 for the largest of a hundred thousand normal ones, and hardly depends
on how wrong the outliers themselves are.

Together: how far a number is from what the other numbers of the image let one expect. Each column is turned into normal
scores by its ranks, y = Phi^-1((rank - 1/2) / n). With the precision matrix P of all scores, the residual of column j
given all others is r_j = (P y)_j / sqrt(P_jj), which is judged as a number alone is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata

from ...base.arrays import Floats, Reals
from .figures import PICTURE, PUPIL_VISIBLE, SATURATED
from .reading import Contents

SHOWN = 32
LEAST = 1.0  # distance at which a number counts as unusual
_REASONS = 3
_CAP = 50.0
_RIDGE = 0.01
_ROWS_PER_COLUMN = 10  # fewer rows tell too little about how columns depend on each other
_RARE = 0.005  # where nearly all numbers of a column are equal, the share of others that is unusual


@dataclass(frozen=True, slots=True)
class Reason:
    """Why an image is unusual: a column, its value, what is usual, and the distance from that."""

    column: str
    value: float
    usual: str
    distance: float


@dataclass(frozen=True, slots=True)
class Outlier:
    """An image, by its place, and why it is unusual; the strongest reason comes first."""

    at: int
    reasons: tuple[Reason, ...]

    @property
    def distance(self) -> float:
        """Distance of the strongest reason."""
        return self.reasons[0].distance


def outliers(values: Reals, names: Sequence[str], count: int = SHOWN) -> list[Outlier]:
    """Find the most unusual images.

    Args:
        values: (n, m) numbers; nan where there is none.
        names: (m,) of the columns.
        count: the largest number of images.
    """
    if len(values) < 10 or not len(names):
        return []
    alone = tails(values)
    together, expected = surprises(values)
    score = np.maximum(alone, together).max(axis=1)
    order = np.lexsort((np.arange(len(score)), -score))[:count]
    ranges = np.nanquantile(values, (0.01, 0.99), axis=0)
    found = []
    for at in order[score[order] >= LEAST]:
        reasons = _reasons(alone[at], together[at], values[at], expected[at], ranges, names)
        found.append(Outlier(int(at), reasons))
    return found


def tails(values: Reals) -> Reals:
    """Compute how far each number lies beyond the middle of its column, (n, m); 0 within it or without a number."""
    low, middle, high = np.nanquantile(values, (0.01, 0.5, 0.99), axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        above = (values - high) / (high - middle)
        below = (low - values) / (middle - low)
        found = np.fmax(above, below)
    # Where 98 % of the numbers are equal on a side, any other number is rare or not.
    for column in np.flatnonzero((high == middle) | (low == middle)):
        own, number = values[:, column], middle[column]
        for side, flat in ((own > high[column], high[column] == number), (own < low[column], low[column] == number)):
            if flat:
                found[side, column] = 2.0 if np.count_nonzero(side) <= _RARE * len(own) else 0.0
    return np.asarray(np.clip(np.nan_to_num(found, nan=0.0, posinf=_CAP, neginf=0.0), 0.0, _CAP))


def surprises(values: Reals) -> tuple[Reals, Reals]:
    """Compute how far each number is from its prediction by the rest of its row, and that prediction; both (n, m)."""
    ranked = np.stack([scores(column).astype(values.dtype) for column in values.T], axis=1)
    n = len(ranked)
    nothing = np.zeros_like(values), np.full_like(values, np.nan)
    use = np.flatnonzero(ranked.std(axis=0) > 0)
    if len(use) < 2 or n < _ROWS_PER_COLUMN * len(use):
        return nothing
    y = ranked[:, use]
    precision = np.linalg.inv(np.corrcoef(y, rowvar=False) + _RIDGE * np.eye(len(use))).astype(values.dtype)
    weighted = y @ precision
    residual = weighted / np.sqrt(np.diag(precision))
    residual[np.isnan(values[:, use])] = 0.0
    found, expected = nothing
    found[:, use] = tails(residual)
    guess = y - weighted / np.diag(precision)
    for k, column in enumerate(use):
        own = np.isfinite(values[:, column])
        expected[:, column] = np.interp(guess[:, k], np.sort(ranked[own, column]), np.sort(values[own, column]))
    return found, expected


def scores(column: Reals) -> Floats:
    """Normal scores of the ranks of a column, (n,); 0 where there is no number, or where all are equal."""
    there = np.isfinite(column)
    out = np.zeros(len(column))
    count = int(there.sum())
    if count and np.ptp(column[there]) > 0:
        out[there] = ndtri((rankdata(column[there]) - 0.5) / count)
    return out


def _reasons(
    alone: Reals, together: Reals, values: Reals, expected: Reals, ranges: Reals, names: Sequence[str]
) -> tuple[Reason, ...]:
    best = np.argsort(-np.maximum(alone, together), kind="stable")[:_REASONS]
    found: list[Reason] = []
    for k in best:
        distance = float(max(alone[k], together[k]))
        if distance < LEAST and found:
            break
        if alone[k] >= together[k]:
            usual = f"usually {ranges[0, k]:.4g} to {ranges[1, k]:.4g}"
        else:
            usual = f"its other numbers suggest {expected[k]:.4g}"
        found.append(Reason(names[k], float(values[k]), usual, distance))
    return tuple(found)


_EACH = 5
# Figure -> its column, and +1 if high numbers are bad, else -1. Pupils all in or out of sight have no figure.
_FIGURES = {
    "most saturated": (SATURATED, 1),
    "darkest": (f"{PICTURE}mean level", -1),
    "least contrast of iris and pupil": (f"{PICTURE}iris - pupil : mean", -1),
    "pupil most hidden": (PUPIL_VISIBLE, -1),
}


class WorstPicture(NamedTuple):
    """A picture, by its place, and the figure by which it is among the worst."""

    at: int
    figure: str
    value: float


def worst_pictures(contents: Contents) -> list[WorstPicture]:
    """List up to five pictures for each of four figures, the worst first; each picture once."""
    found: dict[int, WorstPicture] = {}
    for figure, (column, sign) in _FIGURES.items():
        values = contents.columns.get(column, np.zeros(0)).astype(float)
        if column in (SATURATED, PUPIL_VISIBLE):
            values = np.where((values > 0) & (values < 1), values, np.nan)
        order = [at for at in np.argsort(-sign * values, kind="stable").tolist() if np.isfinite(values[at])]
        for at in [at for at in order if at not in found][:_EACH]:
            found[at] = WorstPicture(at, figure, float(values[at]))
    return list(found.values())
