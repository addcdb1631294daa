"""Select the samples of a plan to make: all, the first ones, or the first ones of each subject in turn.

A plan of N samples and S subjects is continued in blocks: samples b N to (b + 1) N - 1 belong to the subjects b S to (b
+ 1) S - 1, divided as in the first block. So a dataset can grow beyond its plan, and no sample changes its subject.

If a block is not made as a whole, `spread` takes its samples in rounds: the first one of each subject, then the second
ones, and so on. A larger selection therefore includes every smaller one, and each subject's sequence starts at its
beginning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import numpy as np

from ..base.arrays import Bools, Ints
from .interleaving import MIXED, Interleaving

_CHUNK = 2**20


@dataclass(frozen=True, slots=True, eq=False)
class Joined(Sequence[int]):
    """A sequence of integers: a range from 0, followed by larger numbers."""

    head: range
    tail: Ints

    def __len__(self) -> int:
        return len(self.head) + len(self.tail)

    @overload
    def __getitem__(self, at: int) -> int: ...
    @overload
    def __getitem__(self, at: slice) -> list[int]: ...
    def __getitem__(self, at: int | slice) -> int | list[int]:
        if isinstance(at, slice):
            return [self[k] for k in range(*at.indices(len(self)))]
        k = range(len(self))[at]
        return self.head[k] if k < len(self.head) else int(self.tail[k - len(self.head)])


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The `count` samples to make of a plan with `planned` samples and `subjects` subjects, in shards of a given size.

    With a seed to `interleave`, every shard mixes subjects (`Interleaving`); each block of the plan has its own shards.
    """

    count: int
    planned: int
    subjects: int
    shard_size: int
    spread: bool
    interleave: int | None = None

    @property
    def _block_shards(self) -> int:
        """Number of shards per interleaved block."""
        return -(-self.planned // self.shard_size)

    @cached_property
    def _mixed(self) -> Interleaving:
        run = max(1, self.shard_size // MIXED)
        assert self.interleave is not None
        return Interleaving(planned=self.planned, subjects=self.subjects, run=run, seed=self.interleave)

    def shard_of(self, sample: int) -> int:
        """Return the shard of a sample."""
        if self.interleave is None:
            return sample // self.shard_size
        block, k = divmod(sample, self.planned)
        at = int(self._mixed.positions_of(np.array([k]))[0])
        return block * self._block_shards + at // self.shard_size

    def subject_of(self, sample: int) -> int:
        """Return the subject of a sample."""
        block, k = divmod(sample, self.planned)
        return block * self.subjects + k * self.subjects // self.planned

    def first_of(self, subject: int) -> int:
        """Return the first sample of a subject."""
        block, k = divmod(subject, self.subjects)
        return block * self.planned - (-k * self.planned // self.subjects)

    @property
    def subject_count(self) -> int:
        """Number of subjects with at least one sample; they are the first ones of the plan."""
        blocks, left = divmod(self.count, self.planned)
        if self.spread:
            return blocks * self.subjects + min(left, self.subjects)
        return self.subject_of(self.count - 1) + 1

    @property
    def end(self) -> int:
        """Upper bound of the sample numbers, exclusive."""
        return -(-self.count // self.planned) * self.planned if self.spread else self.count

    def are_made(self, samples: Ints) -> Bools:
        """Return whether samples are selected, (n,)."""
        if not self.spread:
            return np.asarray(samples < self.count)
        block, k = np.divmod(samples, self.planned)
        whole, left = divmod(self.count, self.planned)
        rounds, rest = divmod(left, self.subjects)
        shortest = self.planned // self.subjects  # some subjects have one more
        if rounds >= shortest:
            rounds, rest = shortest, left - shortest * self.subjects
        subject = k * self.subjects // self.planned
        first = -(-subject * self.planned // self.subjects)
        # Rank of a subject among those that have a sample in the last round.
        rank = first - subject * shortest if rounds == shortest else subject
        sequence = k - first
        chosen = (sequence < rounds) | ((sequence == rounds) & (rank < rest))
        return np.asarray((block < whole) | ((block == whole) & chosen))

    @cached_property
    def shards(self) -> Sequence[int]:
        """Numbers of the shards that hold a sample, in order."""
        size = self.shard_size
        if self.interleave is not None:
            return self._interleaved_shards()
        if not self.spread:
            return range(-(-self.count // size))
        head = self._whole // size
        parts = [np.unique(chunk // size) for chunk in self._chunks(head * size)]
        return Joined(range(head), np.unique(np.concatenate(parts)))

    def shard_samples(self, shard: int) -> Sequence[int]:
        """Return the samples of a shard, in order; as a range if they are consecutive."""
        if self.interleave is not None:
            block, k = divmod(shard, self._block_shards)
            end = min((k + 1) * self.shard_size, self.planned)
            mixed = np.sort(self._mixed.samples_at(np.arange(k * self.shard_size, end, dtype=np.int64)))
            mixed += block * self.planned
            return list(map(int, mixed[self.are_made(mixed)]))
        samples = range(shard * self.shard_size, min((shard + 1) * self.shard_size, self.end))
        made = self.are_made(np.arange(samples.start, samples.stop, dtype=np.int64))
        if made.all():
            return samples
        return (np.flatnonzero(made) + samples.start).tolist()

    @cached_property
    def samples(self) -> Sequence[int]:
        """All selected samples, in order; takes 8 bytes per sample of the last block."""
        if not self.spread:
            return range(self.count)
        return Joined(range(self._whole), np.concatenate(list(self._chunks(self._whole))))

    def _interleaved_shards(self) -> Sequence[int]:
        """Return the shards of complete blocks, and those of the last block that hold a sample."""
        blocks, left = divmod(self.count, self.planned)
        head = range(blocks * self._block_shards)
        if not left:
            return head
        found = [np.zeros(0, dtype=np.int64)]
        for start in range(0, self.planned, _CHUNK):
            positions = np.arange(start, min(start + _CHUNK, self.planned), dtype=np.int64)
            made = self.are_made(self._mixed.samples_at(positions) + blocks * self.planned)
            found.append(np.unique(positions[made] // self.shard_size))
        return Joined(head, np.unique(np.concatenate(found)) + len(head))

    @property
    def _whole(self) -> int:
        """Number of samples in complete blocks."""
        return self.count // self.planned * self.planned

    def _chunks(self, first: int) -> Iterator[Ints]:
        for start in range(first, self.end, _CHUNK):
            samples = np.arange(start, min(start + _CHUNK, self.end), dtype=np.int64)
            yield samples[self.are_made(samples)]


def in_spread_order(items: Sequence[int]) -> list[int]:
    """Order sorted items so that those at the front lie far apart: by the reversed bits of their indices."""
    bits = max(len(items) - 1, 1).bit_length()
    return [items[k] for k in sorted(range(len(items)), key=lambda k: int(f"{k:0{bits}b}"[::-1], 2))]
