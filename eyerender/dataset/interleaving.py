"""Order of a plan's samples in which every shard mixes subjects: short runs, one subject after another.

The samples of a subject are cut into runs of `run` samples. The order takes the first run of each subject, with
subjects in a seeded order, then the second runs, and so on; remaining samples come last. So consecutive samples share
the preparation of their subject, and a shard of `MIXED` runs has as many subjects if the plan has.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..base.arrays import Ints

MIXED = 64  # runs per shard
_MULTIPLIERS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


def scrambled(numbers: Ints, seed: int) -> Ints:
    """Permute 64-bit integers by a hash (the finalizer of splitmix64, Steele, Lea, Flood 2014); sort by it to shuffle.

    Unlike NumPy's generators, it never changes between versions.
    """
    step, first, second = (np.uint64(m) for m in _MULTIPLIERS)
    with np.errstate(over="ignore"):
        z = numbers.astype(np.uint64) * step + np.uint64(seed & 0xFFFFFFFFFFFFFFFF)
        z = (z ^ (z >> np.uint64(30))) * first
        z = (z ^ (z >> np.uint64(27))) * second
        return np.asarray(z ^ (z >> np.uint64(31)))


@dataclass(frozen=True, kw_only=True)
class Interleaving:
    """Order of the `planned` samples of `subjects` subjects; some have one sample more than others."""

    planned: int
    subjects: int
    run: int
    seed: int

    @cached_property
    def _order(self) -> Ints:
        """Subjects in their seeded order, (S,)."""
        return np.argsort(scrambled(np.arange(self.subjects), self.seed), kind="stable")

    @cached_property
    def _rank(self) -> Ints:
        rank = np.empty(self.subjects, dtype=np.int64)
        rank[self._order] = np.arange(self.subjects)
        return rank

    @cached_property
    def _first(self) -> Ints:
        """First sample of each subject, and the number of samples, (S + 1,)."""
        k = np.arange(self.subjects + 1, dtype=np.int64)
        return -(-k * self.planned // self.subjects)

    @property
    def _rounds(self) -> int:
        """Number of full runs of every subject."""
        return self.planned // self.subjects // self.run

    @cached_property
    def _tails(self) -> Ints:
        """Position where the remaining samples of each subject begin, in their seeded order, (S + 1,)."""
        left = np.diff(self._first)[self._order] - self._rounds * self.run
        return np.concatenate([[0], np.cumsum(left)]) + self._rounds * self.run * self.subjects

    def samples_at(self, positions: Ints) -> Ints:
        """Return the samples at positions of the order."""
        whole, (k, within) = self.run * self.subjects, np.divmod(positions % (self.run * self.subjects), self.run)
        sequence = positions // whole * self.run + within
        tail = positions >= self._rounds * whole
        if tail.any():
            at = np.searchsorted(self._tails, positions[tail], side="right") - 1
            k[tail], sequence[tail] = at, positions[tail] - self._tails[at] + self._rounds * self.run
        return np.asarray(self._first[self._order[k]] + sequence)

    def positions_of(self, samples: Ints) -> Ints:
        """Return the positions of samples in the order."""
        subject = samples * self.subjects // self.planned
        sequence = samples - self._first[subject]
        rank = self._rank[subject]
        turn, within = np.divmod(sequence, self.run)
        at = (turn * self.subjects + rank) * self.run + within
        tail = turn >= self._rounds
        at[tail] = self._tails[rank[tail]] + sequence[tail] - self._rounds * self.run
        return np.asarray(at)
