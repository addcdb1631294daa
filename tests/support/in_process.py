"""Runs of one worker in the tests' own process.

A worker process takes seconds to start, to import the renderer and to trace its kernels. Datasets do not depend on it:
`tests/dataset/test_run.py` compares one made here with one made by two worker processes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from eyerender.dataset import maker
from eyerender.dataset import run as dataset_run
from eyerender.dataset.pool import Events, LocalPool
from eyerender.dataset.shard import write_shard
from eyerender.dataset.worker import FAILURES, Job, failure
from eyerender.imaging.capture import make_renderer


class InThisProcess:
    """The engine of a run whose shards are written here instead of by a worker."""

    def __init__(self, job: Job) -> None:
        self.job = job

    def run(self, shards: Iterable[int], events: Events) -> dict[int, str]:
        """Make shards; errors are those of `LocalPool.run`, and defects are raised as they are."""
        own, folder, name = self.job.maker(), Path(self.job.folder), str(os.getpid())
        events.ready(own.backend, name)
        for shard in shards:

            def alive(samples: int, images: int, shard: int = shard) -> None:
                events.sample(shard, samples, images)

            try:
                staged = write_shard(own, folder, shard, alive)
            except OSError as error:
                kind, reason = failure(error, folder)
                raise FAILURES[kind](reason) from None
            events.staged(staged, name)
        return {}


def engine(job: Job, workers: int, **options: Any) -> InThisProcess | LocalPool:
    """This process for one worker, processes for several."""
    return InThisProcess(job) if workers == 1 else LocalPool(job, workers, **options)


@contextmanager
def single_workers_in_process() -> Iterator[None]:
    """Inside the block, runs of one worker start no process, and share one renderer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset_run, "LocalPool", engine)
        patch.setattr(maker, "make_renderer", cache(make_renderer))
        yield
