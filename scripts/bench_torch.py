#!/usr/bin/env python3
"""Bench of eyerender.torch: images a second that streams give with two workers, against those that `generate` makes.

    bench_torch.py [--quick] [--json F] [--backend llvm|cuda]

It needs PyTorch: .venv-torch/bin/python scripts/bench_torch.py, after scripts/test-torch has made that environment.
Images are 640 x 480 px at 4 samples per pixel, without lids. All sides have two workers of one thread each and are
measured in turn, three times each; the medians count. Rates are measured after every worker has made its first samples,
or its first window of mixed images, so they exclude starting and compiling. Random changes are measured in processor
time, with pictures that are rendered already. --quick makes fewer images, once. The exit
code is 1 if a `must` is missed.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from _bench import Report, Row, options_of, row, single_threaded

single_threaded()

from bench_generate import Clock, plan
from eyerender.dataset.pool import LocalPool
from eyerender.dataset.realise import frames_of
from eyerender.dataset.worker import Job

WORKERS, BATCH, SHARD, MIXED = 2, 8, 48, 4


def generated(count: int, backend: str) -> float:
    """Images a second of a run of `generate`."""
    made = plan(count, SHARD)
    with tempfile.TemporaryDirectory() as folder:
        clock = Clock(WORKERS)
        job = Job.of(made, frames_of(made), Path(folder), backend, 1)
        lost = LocalPool(job, WORKERS).run(made.spec.shards, clock)
        if lost:
            raise RuntimeError(str(lost))
    return clock.rate


def streamed(count: int, backend: str, shuffle: int) -> float:
    """Images a second of a stream, after the first batches that each worker renders together."""
    from eyerender.torch import StreamDataset

    stream = StreamDataset(plan(count, SHARD), batch_size=BATCH, shuffle=shuffle, backend=backend, threads=1)  # type: ignore[arg-type]
    start, images, first = 0.0, 0, WORKERS * max(shuffle, 1)
    for number, batch in enumerate(stream.loader(WORKERS)):
        if number >= first:
            images += len(batch["image"])
        elif number == first - 1:
            start = time.perf_counter()
    return images / (time.perf_counter() - start)


def changed(backend: str) -> float:
    """Pictures of 128 x 128 px with labels that a stream changes and collates per processor second."""
    from eyerender.torch import Augment, StreamDataset

    parts = ("image", "mask", "pupil", "gaze", "glints", "visible_fraction")
    how: dict[str, Any] = {"parts": parts, "size": (128, 128), "augment": Augment(), "reuse": 60, "backend": backend}
    stream = StreamDataset(plan(BATCH, SHARD), batch_size=BATCH, **how)
    batches = iter(stream)
    next(batches)  # which renders
    start = time.process_time()
    images = sum(len(batch["image"]) for batch in batches)
    return images / (time.process_time() - start)


def rows(backend: str, quick: bool) -> Iterable[Row]:
    """All rows, as they are measured."""
    count = 128 if quick else 256
    found = [
        (generated(count, backend), streamed(count, backend, 0), streamed(count, backend, MIXED))
        for _ in range(1 if quick else 3)
    ]
    runs, streams, mixed = (statistics.median(side) for side in zip(*found, strict=True))
    yield row("generate, two workers of one thread each", runs, "images/s")
    yield row("stream, two workers of one thread each", streams, "images/s")
    yield row(f"the same, mixing {MIXED} batches of each worker", mixed, "images/s")
    yield row("stream against generate", streams / runs, "ratio", must=0.9, at_least=True)
    yield row("changed by Augment to 128 x 128 px", changed(backend), "images/CPU s", must=200, at_least=True)
    yield row("mixed stream against stream", mixed / streams, "ratio", must=0.9, at_least=True)


def main() -> int:
    """Measure, print, write."""
    parser = options_of(__doc__, "fewer images, once")
    parser.add_argument("--backend", choices=["auto", "llvm", "cuda"], default="auto")
    options = parser.parse_args()
    report = Report()
    report.extend(rows(options.backend, options.quick))
    return report.finish(options.json, ("eyerender", "torch", "mitsuba", "drjit", "numpy"))


if __name__ == "__main__":
    sys.exit(main())
