"""Estimated cost of a run, from the last measured rate or from a few samples made in memory."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import Warn
from ..folders.imagefile import png_bytes
from .maker import Maker
from .options import RunOptions
from .plan import Plan
from .rates import Rate, keep_rate, last_rate, now
from .realise import frames_of, realise
from .run import worker_count
from .spec import DatasetSpec

_SUBJECTS = 3


def estimate(
    spec: str | Path | DatasetSpec | Plan,
    options: RunOptions = RunOptions(),
    *,
    eye: str | None = None,
    seed: int | None = None,
    count: int | None = None,
    measure: bool = False,
    warn: Warn | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Return the time and disk that `generate` would need: seconds = (samples t + subjects t_subject) / workers.

    The rate is the last one of this spec on this machine, for any seed and number of samples.

    Args:
        spec: as for `generate`.
        options: as for `generate`.
        eye: as for `generate`.
        seed: as for `generate`.
        count: as for `generate`.
        measure: make two samples of each of a few subjects to measure the rate.
        warn: called with warnings about the spec; it may raise.
        changes: as for `generate`.

    Returns:
        Schema eyerender/estimate/2; `seconds` and `bytes` are None where no rate is known.

    Raises:
        InputError: the first sample cannot be made at all.
        BackendError: with `measure`; there is nothing to render with.
    """
    options = replace(options, **changes)
    plan = Plan.load(spec, eye=eye, seed=seed, count=count)
    if warn is not None:
        warn(plan.warnings())
    samples, shards = plan.spec.count, len(plan.spec.shards)
    processes, each = worker_count(options, shards)
    frames = frames_of(plan)
    if measure:
        rate: Rate | None = measured_rate(plan, Maker(plan, frames, backend=options.backend, threads=each))
    else:
        rate = last_rate(plan, options.backend)
    seconds = None
    if rate is not None:
        subjects = plan.spec.selection.subject_count
        seconds = (samples * rate.seconds + subjects * rate.subject_seconds) / min(processes, shards)
        images = rate.images
    else:
        first = realise(plan, 0, frames).observations
        images = 0 if first is None else len(first)
    return {
        "schema": "eyerender/estimate/2",
        "samples": samples,
        "images": round(samples * images),
        "shards": shards,
        "workers": processes,
        "threads_per_worker": each,
        "seconds": None if seconds is None else round(seconds, 1),
        "bytes": None if rate is None else round(samples * rate.bytes),
        "rate": None if rate is None else rate.to_mapping(),
    }


def measured_rate(plan: Plan, maker: Maker) -> Rate:
    """Measure the rate of one worker from two samples of each of a few subjects, and store it.

    A subject's first sample includes the time for its eye and its textures.
    """
    spec = plan.spec
    subjects = spec.selection.subject_count
    starts = [plan.first_of(s) for s in sorted({int(s) for s in np.linspace(0, subjects - 1, _SUBJECTS)})]
    maker.make(starts[0])  # kernels are compiled once per worker
    first: list[float] = []
    again: list[float] = []
    sizes: list[int] = []
    images: list[int] = []
    for start in starts:
        second = start + 1 if start + 1 < spec.selection.end and plan.subject_of(start + 1)[1] == 1 else None
        for sample, times in ((start, first), (second, again)):
            if sample is None:
                continue
            began = time.perf_counter()
            made = maker.make(sample)
            size = sum(len(png_bytes(picture)) for image in made.images for picture in image.pictures.values())
            # Metadata is stored in the shards and in the assembled file.
            size += 2 * sum(len(json.dumps(image.line)) for image in made.images)
            times.append(time.perf_counter() - began)
            sizes.append(size)
            images.append(len(made.images))
    usual = float(np.median(again or first))
    rate = Rate(
        how="measured",
        time=now(),
        backend=str(maker.backend["name"]),
        samples=len(sizes),
        seconds=usual,
        subject_seconds=max(float(np.median(first)) - usual, 0.0) if again else 0.0,
        images=float(np.mean(images)),
        bytes=float(np.mean(sizes)),
    )
    keep_rate(plan, rate)
    return rate
