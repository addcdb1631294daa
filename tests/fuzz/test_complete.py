"""The fuzzers' list is complete: every function of the package that reads a file runs in one of its readers."""

from __future__ import annotations

import pytest

from eyerender.eye import biometry
from tests.fuzz.readers import READERS
from tests.support.fuzzing import proper
from tests.support.readings import called, readers

# Functions that interpret nothing of what they read, or read only what this process has just written.
EXCEPTIONS = {
    "apps.benchmark.answers._digest": "hashes bytes",
    "apps.benchmark.answers.image_key": "hashes bytes",
    "cli.benchmark.bench_extractors": "the result of this run",
    "dataset.packing.pack": "the shard of this run",
    "dataset.packing._write_tar": "the pictures of this run",
    "dataset.partial.PartialShard._sort_lines": "the lines of this run",
    "dataset.assemble.LineTable._lines": "shards that were just verified",
    "dataset.lines.ShardLines.of": "lines whose places were just found by `index`; their checksum is compared",
    "dataset.run.Run._assembled": "a dataset that was just verified",
    "OwnEstimator.load": "imports a class that the caller names",
}


@pytest.mark.render
def test_every_function_that_reads_a_file_is_fuzzed(tmp_path):
    run: set[str] = set()
    biometry._adult.cache_clear()  # which another test may have filled
    for reader in READERS.values():
        for data in reader.seeds():
            run |= called(lambda r=reader, d=data: proper(lambda: r.case(d, tmp_path / "case")))  # type: ignore[misc]
    assert len(readers()) > 60  # the search does find
    assert readers() - run == EXCEPTIONS.keys()
