"""Estimate the cost of a run, from the last measured rate or from a few samples made in memory.

The last rate of a spec on this machine is a file in the user's cache folder. If it is missing or damaged, the rate is
unknown.
"""

from __future__ import annotations

import hashlib
import json
import platform
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ..base.errors import EyerenderError, Warn
from ..base.spec import Positive, Spec
from ..base.storage.cachefolder import cache_folder
from ..base.storage.files import read_json, write_json
from ..folders.imagefile import picture_bytes
from ..folders.packed import pack_lines
from .done import cpu_family
from .maker import Maker
from .options import RunOptions
from .plan import Plan
from .realise import frames_of, realise
from .shard import Staged
from .spec import DatasetSpec

_WARM, _MORE = 8, 4  # samples until the kernels of both eyes of a person are recorded, and some more
_SUBJECTS = 3  # that are measured after these
ENOUGH_SAMPLES = 200  # more samples do not make a rate more representative
_BYTES = 2**16
_ENTRY, _MEMBER = 170, 768  # bytes of a picture's entry in done.json; of its header in a tar, and of what fills a block
_SHARD_BYTES = {False: 1500, True: 7000}  # of done.json, and of the end of a tar in packed shards
_Count = Annotated[float, Field(ge=0, le=1e15)]


class Rate(Spec):
    """Time and size of the samples of a spec."""

    format: Literal["eyerender/rate/2"] = "eyerender/rate/2"
    how: Literal["run", "measured"] = Field(
        description="whether a run measured it, or a few samples made for this purpose"
    )
    time: Annotated[str, Field(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z$")]
    backend: Annotated[str, Field(max_length=20)]
    samples: Annotated[int, Field(ge=1, le=10**9)] = Field(description="number of measured samples")
    start_seconds: _Count = Field(
        description="additional time of a worker until its kernels are loaded and recorded; 0: included in `seconds`"
    )
    seconds: Positive = Field(description="time of one worker for a sample")
    subject_seconds: _Count = Field(
        description="additional time for the first sample of a subject; 0: included in `seconds`"
    )
    images: _Count = Field(description="images per sample")
    bytes: _Count = Field(description="bytes per sample, including metadata")


def now() -> str:
    """Return the current time in the format of a rate."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


@dataclass(slots=True, kw_only=True)
class Speed:
    """Times of the workers of a run, from which the rate of its spec follows."""

    loading_s: float = 0.0  # until the first worker could render
    firsts: dict[str, tuple[int, float]] = field(default_factory=dict)  # samples and seconds of a worker's first shard
    samples: int = 0  # samples of the other shards that this run has finished
    seconds: float = 0.0  # and the time that they took
    images: int = 0
    bytes: int = 0
    backends: set[str] = field(default_factory=set)

    def ready(self, backend: str, seconds: float) -> None:
        """Take the time at which a worker could render."""
        self.loading_s = self.loading_s or seconds
        self.backends.add(backend)

    def take(self, staged: Staged, samples: int, worker: str) -> None:
        """Take the times of a finished shard."""
        if worker in self.firsts:
            self.samples += samples
            self.seconds += staged.seconds
        else:
            self.firsts[worker] = samples, staged.seconds
        self.images += staged.images
        self.bytes += staged.bytes

    def rate(self) -> Rate | None:
        """Return the rate; None if no shard was finished, or several backends made them."""
        if not self.firsts or len(self.backends) != 1:
            return None
        begun, spent = (sum(column) for column in zip(*self.firsts.values(), strict=True))
        # The first shard of a worker includes its start; a short run has no others.
        usual = self.seconds / self.samples if self.samples else spent / begun
        samples = self.samples + int(begun)
        return Rate(
            how="run",
            time=now(),
            backend=next(iter(self.backends)),
            samples=max(self.samples, 1),  # those of a worker's start say little
            start_seconds=self.loading_s + max(spent - begun * usual, 0.0) / len(self.firsts),
            seconds=usual,
            subject_seconds=0.0,
            images=self.images / samples,
            bytes=self.bytes / samples,
        )


def keep_rate(plan: Plan, rate: Rate) -> None:
    """Store a rate, unless the stored one of the same backend comes from more than twice as many samples.

    If the cache cannot be written, the rate is discarded.
    """
    path = _path(plan)
    old = last_rate(plan, rate.backend)
    if path is not None and (old is None or rate.samples >= min(old.samples, ENOUGH_SAMPLES) / 2):
        with suppress(OSError, EyerenderError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, rate.to_mapping(), sync=False)


def last_rate(plan: Plan, backend: str = "auto") -> Rate | None:
    """Return the rate last measured on this machine with a backend; None if there is none."""
    path = _path(plan)
    if path is None:
        return None
    try:
        rate = Rate.from_mapping(read_json(path, limit=_BYTES, follow=False))
    except EyerenderError:
        return None
    return rate if backend in ("auto", rate.backend) else None


def _path(plan: Plan) -> Path | None:
    """Return the path of a plan's rate on this machine; it does not depend on seed and number of samples."""
    folder = cache_folder()
    if folder is None:
        return None
    data = plan.to_mapping()
    data["spec"] = {k: v for k, v in data["spec"].items() if k not in ("count", "planned", "choice", "seed")}
    key = json.dumps([data, platform.node(), cpu_family()], sort_keys=True)
    return folder / "rates" / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.json"


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
    processes, each = options.processes(shards)
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
        bytes=float(np.mean([one.bytes for one in made]))
        + _SHARD_BYTES[plan.spec.is_packed] * len(plan.spec.shards) / samples,
    )
    keep_rate(plan, rate)
    return rate


@dataclass(frozen=True, slots=True)
class _Timed:
    """Duration of a sample, and its size on disk."""

    seconds: float
    images: int
    bytes: float


def _timed(maker: Maker, samples: Iterable[int]) -> list[_Timed]:
    """Make samples in memory like a worker, which traces one sample while it finishes the previous one."""
    found, lines, began = list[_Timed](), list[dict[str, Any]](), time.perf_counter()
    is_packed = maker.plan.spec.is_packed
    for made in maker.make_all(samples):
        pictures = [picture for image in made.images for picture in image.pictures.values()]
        size = sum(len(picture_bytes(picture)) + (_MEMBER if is_packed else _ENTRY) for picture in pictures)
        lines += (image.line for image in made.images)
        size += 0 if is_packed else sum(len(json.dumps(image.line)) for image in made.images)
        began, last = time.perf_counter(), began
        found.append(_Timed(began - last, len(made.images), size))
    more = len(pack_lines(lines)[0]) / len(found) if is_packed and lines else 0.0
    return [replace(one, bytes=one.bytes + more) for one in found]
