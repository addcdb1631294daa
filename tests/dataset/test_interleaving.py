"""The order of interleaved shards: a permutation that mixes subjects, whatever the sizes are."""

from __future__ import annotations

import numpy as np
import pytest

from eyerender.dataset.selection import Selection, scrambled


@pytest.mark.parametrize(
    ("planned", "subjects", "size", "count"),
    [
        pytest.param(1000, 70, 100, 1000, id="even"),
        pytest.param(1003, 70, 97, 1003, id="uneven"),
        pytest.param(1003, 70, 97, 2300, id="grown"),
        pytest.param(1003, 70, 97, 333, id="spread"),
        pytest.param(50, 3, 64, 50, id="one-shard"),
        pytest.param(24, 24, 3, 30, id="a-subject-per-sample"),
    ],
)
def test_every_sample_is_in_one_shard(planned, subjects, size, count):
    spread = count % planned > 0
    own = {"planned": planned, "subjects": subjects, "shard_size": size}
    selection = Selection(count=count, spread=spread, interleave=5, **own)
    by_shard = {shard: selection.shard_samples(shard) for shard in selection.shards}
    assert sorted(k for samples in by_shard.values() for k in samples) == sorted(selection.samples)
    assert all(len(samples) <= size for samples in by_shard.values())
    assert all(selection.shard_of(k) == shard for shard, samples in by_shard.items() for k in samples)
    # A sample stays in its shard when the dataset grows.
    more = Selection(count=3 * planned, spread=False, interleave=5, **own)
    assert all(more.shard_of(k) == shard for shard, samples in by_shard.items() for k in samples)


def test_a_shard_of_a_thousand_has_fifty_subjects_and_runs_of_neighbours():
    selection = Selection(count=500_000, planned=500_000, subjects=1000, shard_size=1000, spread=False, interleave=1)
    for shard in (0, 17, 499):
        samples = np.array(selection.shard_samples(shard))
        assert len({selection.subject_of(int(k)) for k in samples}) >= 50
        assert np.count_nonzero(np.diff(samples) == 1) >= 800  # the last shards hold what is left of each subject


def test_hashes_are_those_of_splitmix64():
    """Published values of the reference implementation for the seed 1234567 (Vigna)."""
    published = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert scrambled(np.arange(1, 4), 1234567).tolist() == published


def test_shards_have_their_size_across_the_blocks_of_a_plan():
    selection = Selection(count=12_160, planned=3_040, subjects=152, shard_size=1000, spread=False, interleave=1)
    sizes = [len(selection.shard_samples(shard)) for shard in selection.shards]
    assert sizes == [1000] * 12 + [160]
    assert sizes == [selection.shard_count(shard) for shard in selection.shards]
