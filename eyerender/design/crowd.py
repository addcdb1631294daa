"""Figures of many people, computed on all processors, and the usual summary numbers of the industry."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import repeat

import numpy as np

from ..base.arrays import Bools, Floats, finite_or_none
from ..base.processes import mapper
from ..base.progress import Progress, notify
from .noise import FeatureNoise
from .people import Figures, RigPopulation, figures_of

OUTLINE = 0.6
"""Share of the outline that counts as enough (chosen)."""
_PIECE = 20


def figures_of_people(
    survey: RigPopulation,  # rig and population
    noise: FeatureNoise,  # noise of the features
    people: int,  # number of people
    *,
    workers: int | None = None,  # processes; None: one for each processor
    progress: Progress | None = None,  # called with (people done, people in all, what)
) -> Figures:
    """Compute the figures of the first people, in pieces that do not depend on the number of processes."""
    firsts = range(0, people, _PIECE)
    counts = [min(_PIECE, people - first) for first in firsts]
    workers = min(workers or os.cpu_count() or 1, len(firsts))
    with mapper(workers) as mapped:
        results = mapped(figures_of, repeat(survey), repeat(noise), firsts, counts)
        return Figures.joined(list(_reported(results, counts, progress)))


SHIFTS_MM = (-3.0, -1.5, 0.0, 1.5, 3.0)
"""Shifts of a map of slippage along each axis."""


def figures_of_shifts(
    survey: RigPopulation, noise: FeatureNoise, people: int, *, workers: int | None = None
) -> tuple[Floats, list[Figures]]:
    """Compute the figures of a few people at shifted positions: 5 x 5 to the left and up, and 5 in distance.

    Returns:
        Shifts (30, 3) in mm, those in the plane by rows from top to bottom, and the figures of each.
    """
    plane = [(0.0, left, up) for up in SHIFTS_MM[::-1] for left in SHIFTS_MM]
    shifts = [*plane, *((x, 0.0, 0.0) for x in SHIFTS_MM)]
    surveys = [replace(survey, slippage_mm=0.0, relief_mm=0.0, shift_mm=shift) for shift in shifts]
    with mapper(workers or os.cpu_count() or 1) as mapped:
        return np.array(shifts), list(mapped(figures_of, surveys, repeat(noise), repeat(0), repeat(people)))


def _reported(results: Iterator[Figures], counts: Sequence[int], progress: Progress | None) -> Iterator[Figures]:
    done = 0
    for part, count in zip(results, counts, strict=True):
        done += count
        notify(progress, done, sum(counts), "people")
        yield part


def users_of(values: Floats) -> dict[str, float | None]:
    """Compute the median (U50E95) and 95th-percentile (U95E95) user's 95th-percentile error.

    Values (people, directions) that are NaN, where there is none, are not counted; their share is the dropout.
    """
    there = [row[~np.isnan(row)] for row in values]
    each = [float(np.quantile(row, 0.95, method="higher")) for row in there if len(row)]
    dropout = finite_or_none(np.isnan(values).mean()) if values.size else None
    if not each:
        return {"U50E95": None, "U95E95": None, "dropout": dropout}
    users = {f"U{u}E95": finite_or_none(np.quantile(each, u / 100, method="higher")) for u in (50, 95)}
    return {**users, "dropout": dropout}


def covered(found: Figures, glints: int = 2) -> Bools:
    """Return which people and directions (p, 81) have so many glints and at least `OUTLINE` of the outline."""
    return np.asarray((found.outline >= OUTLINE) & (found.glints >= glints))


def gaze_of(values: Floats, seen: Bools) -> dict[str, float | None]:
    """Summarise errors (p, 81) deg where they are `seen`: median over all, and `users_of`."""
    there = np.where(seen, values, np.nan)
    return {"median": finite_or_none(np.nanmedian(there)) if seen.any() else None, **users_of(there)}


def coverage_of(found: Figures) -> dict[str, float]:
    """Compute the share of people times directions with each number of glints and at least `OUTLINE` of the outline."""
    return {
        "outline": float(covered(found, 0).mean()),
        **{f"outline_and_{k}_glints": float(covered(found, k).mean()) for k in (1, 2, 3)},
    }
