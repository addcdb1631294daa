"""What a run would take: a few samples made in memory, and what that says of all of them."""

from __future__ import annotations

import io
import json
import time
from typing import Any

import numpy as np

from ..imagefile import encode_png
from .maker import Maker
from .plan import Plan
from .realise import frames_of
from .run import Options, worker_count

_SUBJECTS = 3


def estimate(plan: Plan, options: Options) -> dict[str, Any]:
    """Time and disk of a run (schema eyerender/estimate/1), from two samples each of a few subjects.

    A subject's first sample also pays for its eye and its textures: seconds = samples t + subjects (t_first - t).
    """
    spec = plan.spec
    workers, threads = worker_count(options, spec.shard_count)
    maker = Maker(plan, frames_of(plan), backend=options.backend, threads=threads)
    subjects = plan.subject_of(spec.count - 1)[0] + 1
    starts = [plan.first_of(s) for s in sorted({int(s) for s in np.linspace(0, subjects - 1, _SUBJECTS)})]
    maker.make(starts[0])  # kernels are compiled once a worker
    first: list[float] = []
    again: list[float] = []
    sizes: list[int] = []
    images: list[int] = []
    for start in starts:
        second = start + 1 if start + 1 < spec.count and plan.subject_of(start + 1)[1] == 1 else None
        for sample, times in ((start, first), (second, again)):
            if sample is None:
                continue
            began = time.perf_counter()
            made = maker.make(sample)
            pictures = [picture for image in made.images for picture in image.pictures.values()]
            size = sum(map(_bytes, pictures)) + sum(len(json.dumps(image.line)) for image in made.images)
            times.append(time.perf_counter() - began)
            sizes.append(size)
            images.append(len(made.images))
    usual = float(np.median(again or first))
    extra = max(float(np.median(first)) - usual, 0.0) if again else 0.0
    seconds = (spec.count * usual + subjects * extra) / min(workers, spec.shard_count)
    return {
        "schema": "eyerender/estimate/1",
        "samples": spec.count,
        "images": round(spec.count * float(np.mean(images))),
        "shards": spec.shard_count,
        "workers": workers,
        "threads_per_worker": threads,
        "seconds": round(seconds, 1),
        # Metadata stands in the shards and in the whole.
        "bytes": round(spec.count * float(np.mean(sizes))),
        "backend": maker.backend,
    }


def _bytes(image: Any) -> int:
    buffer = io.BytesIO()
    encode_png(buffer, image)
    return buffer.tell()
