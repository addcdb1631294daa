"""Estimate the cost of a run, from the last measured rate or from a few samples made in memory."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import Warn
from ..folders.imagefile import picture_bytes
from .maker import Maker
from .options import RunOptions
from .plan import Plan
from .rates import Rate, keep_rate, last_rate, now
from .realise import frames_of, realise
from .run import worker_count
from .spec import DatasetSpec

_WARM, _MORE = 8, 4  # samples until the kernels of both eyes of a person are recorded, and some more
_SUBJECTS = 3  # that are measured after these


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
    """Estimate the time and disk space of `generate`: seconds = t_start + (samples t + subjects t_subject) / workers.

    The rate is the last one of this spec on this machine, for any seed and number of samples.

    >>> er.estimate("dataset_quick")["images"]  # doctest: +SKIP

    Args:
        spec: as for `generate`.
        options: as for `generate`.
        eye: as for `generate`.
        seed: as for `generate`.
        count: as for `generate`.
        measure: make some samples of a few subjects to measure the rate.
        warn: called with warnings about the spec; it may raise.
        changes: as for `generate`.

    Returns:
        A mapping (schema eyerender/estimate/2); `seconds` and `bytes` are None if no rate is known.

    Raises:
        InputError: the first sample cannot be made at all.
        BackendError: with `measure`, if no backend can render.
    """
    options = replace(options, **changes)
    plan = Plan.load(spec, eye=eye, seed=seed, count=count)
    if warn is not None:
        warn(plan.warnings())
    samples, shards = plan.spec.count, len(plan.spec.shards)
    processes, each = worker_count(options, shards)
    frames = frames_of(plan)
    if measure:
        began = time.perf_counter()
        maker = Maker(plan, frames, backend=options.backend, threads=each)
        rate: Rate | None = measured_rate(plan, maker, loading_s=time.perf_counter() - began)
    else:
        rate = last_rate(plan, options.backend)
    seconds = None
    if rate is not None:
        subjects = plan.spec.selection.subject_count
        work = samples * rate.seconds + subjects * rate.subject_seconds
        seconds = rate.start_seconds + work / min(processes, shards)
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


def measured_rate(plan: Plan, maker: Maker, *, loading_s: float = 0.0) -> Rate:
    """Measure the rate of one worker, and store it.

    The first samples of a worker record kernels; the extra time they take counts as the worker's start, with the
    `loading_s` of its maker. Then come the first samples of a few subjects, which include the time for eyes and
    textures. If the run itself makes no more samples per subject than this, their whole time counts as the time per
    sample.
    """
    samples, subjects = plan.spec.count, plan.spec.selection.subject_count
    warm = _timed(maker, range(min(_WARM + _MORE, samples)))
    each = min(_MORE, -(-samples // subjects))
    chosen = sorted({int(s) for s in np.linspace(1, subjects - 1, _SUBJECTS)}) if subjects > 1 else []
    groups = [_timed(maker, range(plan.first_of(s), plan.first_of(s) + each)) for s in chosen]
    usual = float(np.median([one.seconds for group in groups or [warm[-_MORE:]] for one in group[1:] or group]))
    extra = 0.0
    if groups:
        whole = float(np.mean([sum(one.seconds for one in group) for group in groups]))
        usual = whole / each if each < _MORE else usual
        extra = max(whole - each * usual, 0.0)
    made = [one for group in groups or [warm] for one in group]
    rate = Rate(
        how="measured",
        time=now(),
        backend=str(maker.backend["name"]),
        samples=len(made),
        start_seconds=loading_s + max(sum(one.seconds for one in warm) - len(warm) * usual, 0.0),
        seconds=usual,
        subject_seconds=extra,
        images=float(np.mean([one.images for one in made])),
        bytes=float(np.mean([one.bytes for one in made])),
    )
    keep_rate(plan, rate)
    return rate


@dataclass(frozen=True, slots=True)
class _Timed:
    """Duration of a sample, and its size on disk."""

    seconds: float
    images: int
    bytes: int


def _timed(maker: Maker, samples: Iterable[int]) -> list[_Timed]:
    """Make samples in memory like a worker, which traces one sample while it finishes the previous one."""
    found, began = [], time.perf_counter()
    for made in maker.make_all(samples):
        size = sum(len(picture_bytes(picture)) for image in made.images for picture in image.pictures.values())
        # Metadata is stored in the shards and in the assembled file.
        size += 2 * sum(len(json.dumps(image.line)) for image in made.images)
        began, last = time.perf_counter(), began
        found.append(_Timed(began - last, len(made.images), size))
    return found
