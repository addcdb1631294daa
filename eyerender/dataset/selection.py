"""Select the samples of a plan to make: all, the first ones, or the first ones of each subject in turn.

A plan of N samples and S subjects is continued in blocks: samples b N to (b + 1) N - 1 belong to the subjects b S to (b
+ 1) S - 1, divided as in the first block. So a dataset can grow beyond its plan, and no sample changes its subject.

If a block is not made as a whole, `spread` takes its samples in rounds: the first one of each subject, then the second
ones, and so on. A larger selection therefore includes every smaller one, and each subject's sequence starts at its
beginning.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import numpy as np

from ..base.arrays import Bools, Ints

_CHUNK = 2**20
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
    """Order of the `planned` samples of `subjects` subjects in which every shard mixes subjects.

    The samples of a subject are cut into runs of `run` samples. The order takes the first run of each subject, with
    subjects in a seeded order, then the second runs, and so on; remaining samples come last. So consecutive samples
    share the preparation of their subject, and a shard of `MIXED` runs has as many subjects if the plan has.
    """

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


class Numbers(Sequence[int], ABC):
    """A sequence of integers that are computed, of which slices are lists."""

    __slots__ = ()

    @abstractmethod
    def _at(self, place: int) -> int:
        """Return the one at a place, counted from 0."""

    @overload
    def __getitem__(self, at: int) -> int: ...
    @overload
    def __getitem__(self, at: slice) -> list[int]: ...
    def __getitem__(self, at: int | slice) -> int | list[int]:
        if isinstance(at, slice):
            return [self._at(k) for k in range(*at.indices(len(self)))]
        return self._at(range(len(self))[at])


@dataclass(frozen=True, slots=True, eq=False)
class Joined(Numbers):
    """A sequence of integers: a range from 0, followed by larger numbers."""

    head: range
    tail: Ints

    def __len__(self) -> int:
        return len(self.head) + len(self.tail)

    def _at(self, place: int) -> int:
        return self.head[place] if place < len(self.head) else int(self.tail[place - len(self.head)])


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The `count` samples to make of a plan with `planned` samples and `subjects` subjects, in shards of a given size.

    With a seed to `interleave`, every shard mixes subjects (`Interleaving`); blocks of the plan follow each other.
    """

    count: int
    planned: int
    subjects: int
    shard_size: int
    spread: bool
    interleave: int | None = None

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
        return (block * self.planned + at) // self.shard_size

    def subject_of(self, sample: int) -> int:
        """Return the subject of a sample."""
        block, k = divmod(sample, self.planned)
        return block * self.subjects + k * self.subjects // self.planned

    def place_of(self, sample: int) -> int:
        """Return the place of a sample where the first samples of all subjects come first, then their second ones."""
        subject = self.subject_of(sample)
        block, k = divmod(subject, self.subjects)
        rounds = -(-self.planned // self.subjects)
        return (block * rounds + sample - self.first_of(subject)) * self.subjects + k

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
        return self._blocks_end if self.spread else self.count

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
            mixed = np.sort(self._mixed_at(shard * self.shard_size, (shard + 1) * self.shard_size))
            return list(map(int, mixed[self.are_made(mixed)]))
        samples = range(shard * self.shard_size, min((shard + 1) * self.shard_size, self.end))
        if not self.spread:
            return samples
        made = self.are_made(np.arange(samples.start, samples.stop, dtype=np.int64))
        if made.all():
            return samples
        return (np.flatnonzero(made) + samples.start).tolist()

    def shard_count(self, shard: int) -> int:
        """Return the number of samples of a shard; fast where its block is made as a whole."""
        if self.interleave is not None:
            first, end = shard * self.shard_size, min((shard + 1) * self.shard_size, self._blocks_end)
            if end <= self._whole:
                return end - first
        return len(self.shard_samples(shard))

    @cached_property
    def samples(self) -> Sequence[int]:
        """All selected samples, in order; takes 8 bytes per sample of the last block."""
        if not self.spread:
            return range(self.count)
        return Joined(range(self._whole), np.concatenate(list(self._chunks(self._whole))))

    def _interleaved_shards(self) -> Sequence[int]:
        """Return the shards of complete blocks, and those after them that hold a sample."""
        head = range(self._whole // self.shard_size)
        found = [np.zeros(0, dtype=np.int64)]
        for start in range(len(head) * self.shard_size, self._blocks_end, _CHUNK):
            made = self.are_made(self._mixed_at(start, start + _CHUNK))
            found.append(np.unique((np.flatnonzero(made) + start) // self.shard_size))
        return Joined(head, np.unique(np.concatenate(found)))

    def _mixed_at(self, start: int, stop: int) -> Ints:
        """Return the samples at the positions from `start` to `stop` of the interleaved order of all blocks."""
        block, k = np.divmod(np.arange(start, min(stop, self._blocks_end), dtype=np.int64), self.planned)
        return np.asarray(self._mixed.samples_at(k) + block * self.planned)

    @property
    def _blocks_end(self) -> int:
        """Number of samples in all begun blocks."""
        return -(-self.count // self.planned) * self.planned

    @property
    def _whole(self) -> int:
        """Number of samples in complete blocks."""
        return self.count // self.planned * self.planned

    def _chunks(self, first: int) -> Iterator[Ints]:
        for start in range(first, self.end, _CHUNK):
            samples = np.arange(start, min(start + _CHUNK, self.end), dtype=np.int64)
            yield samples[self.are_made(samples)]


@dataclass(frozen=True, slots=True)
class ClipFrames(Numbers):
    """The frames of clips in a row: n consecutive samples for each number of `clips`."""

    clips: Sequence[int]
    n: int

    def __len__(self) -> int:
        return len(self.clips) * self.n

    def _at(self, place: int) -> int:
        clip, frame = divmod(place, self.n)
        return self.clips[clip] * self.n + frame


@dataclass(frozen=True, slots=True)
class ClipSelection:
    """A selection of clips with n frames each, in terms of their frames: sample i is frame i mod n of clip i div n."""

    clips: Selection
    n: int

    @property
    def count(self) -> int:
        """Number of selected samples."""
        return self.clips.count * self.n

    @property
    def spread(self) -> bool:
        """Whether the first clips of each subject are made in turn."""
        return self.clips.spread

    @property
    def subject_count(self) -> int:
        """Number of subjects with at least one clip."""
        return self.clips.subject_count

    @property
    def end(self) -> int:
        """Upper bound of the sample numbers, exclusive."""
        return self.clips.end * self.n

    @property
    def shards(self) -> Sequence[int]:
        """Numbers of the shards that hold a sample, in order."""
        return self.clips.shards

    @property
    def samples(self) -> Sequence[int]:
        """All selected samples, in order."""
        return ClipFrames(self.clips.samples, self.n)

    def shard_of(self, sample: int) -> int:
        """Return the shard of a sample."""
        return self.clips.shard_of(sample // self.n)

    def subject_of(self, sample: int) -> int:
        """Return the subject of a sample."""
        return self.clips.subject_of(sample // self.n)

    def place_of(self, sample: int) -> int:
        """Return the place of a sample's clip where the first clips of all subjects come first."""
        return self.clips.place_of(sample // self.n)

    def first_of(self, subject: int) -> int:
        """Return the first sample of a subject."""
        return self.clips.first_of(subject) * self.n

    def are_made(self, samples: Ints) -> Bools:
        """Return whether samples are selected, (n,)."""
        return self.clips.are_made(samples // self.n)

    def shard_samples(self, shard: int) -> Sequence[int]:
        """Return the samples of a shard, in order."""
        return ClipFrames(self.clips.shard_samples(shard), self.n)

    def shard_count(self, shard: int) -> int:
        """Return the number of samples of a shard."""
        return self.clips.shard_count(shard) * self.n


def in_spread_order(items: Sequence[int]) -> list[int]:
    """Order sorted items so that those at the front lie far apart: by the reversed bits of their indices."""
    bits = max(len(items) - 1, 1).bit_length()
    return [items[k] for k in sorted(range(len(items)), key=lambda k: int(f"{k:0{bits}b}"[::-1], 2))]
