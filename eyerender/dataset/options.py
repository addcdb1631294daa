"""Options of dataset runs and plans, shared by Python, the command line and the engines."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from ..backends.choose import BackendChoice
from ..base.errors import InputError
from ..base.processes import usable_cpus

if TYPE_CHECKING:
    from .spec import DatasetSpec

MEMORY_A_WORKER = 1.0e9  # bytes, resident size after fourteen subjects, with head-room


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of a dataset run; none of them changes a byte of the result.

    >>> er.dataset.RunOptions(workers=2, timeout_s=60).workers
    2

    Attributes:
        workers: Number of worker processes (default: one per processor, as far as memory allows).
        engine: Processes on this machine (local), or actors on a Ray cluster (ray).
        address: Address of the Ray cluster (default: start one on this machine).
        backend: The render backend.
        threads: Total number of CPU threads (default: all).
        timeout_s: Seconds without a sign of life after which a worker is ended and its shard is retried.
        overwrite: Replace the contents of the folder.
        same_bytes: Refuse shards that processes with another rounding made (docs/dataset_runs.md); default: warn.
        repair: Compare finished shards with their checksums first, and make damaged ones again. Shards of pictures in
            files are always compared.
    """

    workers: int | None = None
    engine: Literal["local", "ray"] = "local"
    address: str | None = None
    backend: BackendChoice = "auto"
    threads: int | None = None
    timeout_s: float = 600.0
    overwrite: bool = False
    repair: bool = False
    same_bytes: bool = False

    def __post_init__(self) -> None:
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"must be >= 1, not {value}", path=name)
        if not self.timeout_s > 0:
            raise InputError(f"must be > 0, not {self.timeout_s:g}", path="timeout_s")

    def processes(self, shards: int) -> tuple[int, int]:
        """Return the number of workers and of threads of each; by default a worker per processor, as memory allows."""
        cpus = self.threads or usable_cpus()
        workers = self.workers
        if workers is None:
            memory = MEMORY_A_WORKER
            with suppress(OSError, ValueError, AttributeError):
                memory = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
            workers = max(1, min(cpus, int(memory / MEMORY_A_WORKER), shards))
        return workers, max(1, cpus // workers)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions:
    """Subjects, splits, image size and storage that replace those of the spec.

    Attributes:
        clips: Make so many clips, of a dataset of sequences; --count counts their frames.
        subjects: Replace the number of subjects of the dataset.
        splits: Replace the splits, as NAME=SHARE,NAME=SHARE: the shares of the subjects.
        size: Replace the size of the pictures, as WIDTHxHEIGHT in pixels; the cameras are scaled so that they see the
            same.
        layout: Replace the layout of the folder: each picture a file (files), or each shard one tar that mixes subjects
            (webdataset).
        shard_size: Replace the number of samples in a shard.
        spp: Replace the number of samples per pixel.
        bit_depth: Replace the bits of the pictures, with the gain and the black level scaled along (default with layout
            webdataset: 8, because loaders of such tars clip 16-bit codes at 255, which makes them white).
    """

    clips: int | None = None
    subjects: int | None = None
    splits: str | None = None
    size: str | None = None
    layout: Literal["files", "webdataset"] | None = None
    shard_size: int | None = None
    spp: int | None = None
    bit_depth: Literal[8, 16] | None = None

    def frames(self, spec: DatasetSpec, count: int | None) -> int | None:
        """Return how many samples to make, from the number of clips if it is given.

        Raises:
            InputError: both numbers are given, or clips of a dataset without sequences.
        """
        if self.clips is None:
            return count
        if count is not None:
            raise InputError("cannot be combined with --count, the number of their frames", source="--clips")
        if spec.clip_frames == 1:
            raise InputError("needs a dataset of sequences", source="--clips")
        if self.clips < 1:
            raise InputError(f"must be >= 1, not {self.clips}", source="--clips")
        return self.clips * spec.clip_frames

    def apply(self, spec: DatasetSpec, count: int | None = None) -> DatasetSpec:
        """Return the spec with these changes; `count` is the number of samples to make, by default that of the spec.

        Where subjects are replaced, the plan is not continued by new ones: a larger `count` is a larger plan. Raises
        InputError if a value cannot be parsed, or does not fit.
        """
        from .picturesize import scaled

        samples = count or spec.count
        if self.subjects is not None:
            spec = _of_subjects(spec, self.subjects, samples)
        if self.splits is not None:
            spec = spec.replaced("--splits", {"splits": _splits(self.splits)})
        if self.size is not None:
            spec = spec.replaced("--size", {"scene": scaled(spec.scene, _size(self.size))})
        if self.layout is not None:
            spec = spec.replaced("--layout", _of_layout(spec, self.layout, samples))
        if self.shard_size is not None:
            spec = spec.replaced("--shard-size", {"shard_size": self.shard_size})
        return self._of_scene(spec)

    def _of_scene(self, spec: DatasetSpec) -> DatasetSpec:
        """Return the spec with other samples per pixel and bits."""
        from .draws import is_draw
        from .picturesize import with_bits

        if self.spp is not None:
            image = spec.scene.get("image") or {}
            if self.spp < 1:
                raise InputError(f"must be >= 1, not {self.spp}", source="--spp")
            if is_draw(image):
                raise InputError("the spec draws the whole image", source="--spp")
            spec = spec.replaced("--spp", {"scene": {**spec.scene, "image": {**image, "spp": self.spp}}})
        sensor = spec.scene.get("sensor") or {}
        is_drawn = is_draw(sensor) or is_draw(sensor.get("bit_depth"))
        bits = self.bit_depth or (8 if self.layout == "webdataset" and not is_drawn else None)
        if bits is not None:
            spec = spec.replaced("--bit-depth", {"scene": with_bits(spec.scene, bits)})
        return spec


def _of_subjects(spec: DatasetSpec, subjects: int, samples: int) -> DatasetSpec:
    if subjects > samples:
        raise InputError(f"must be at most {samples}, the number of samples, not {subjects}", source="--subjects")
    planned = max(samples, spec.planned_count)
    return spec.replaced("--subjects", {"subjects": subjects, "planned": None if planned == spec.count else planned})


def _of_layout(spec: DatasetSpec, layout: str, samples: int) -> dict[str, Any]:
    """Convert the values of a spec to another layout; too small packed shards get their default size."""
    if layout == "files":
        return {"layout": None}
    from .spec import LEAST_SHARDS, PACKED_SHARD

    planned = spec.planned_count if samples < LEAST_SHARDS * PACKED_SHARD else samples
    return {"layout": layout, "shard_size": max(spec.shard_size, min(PACKED_SHARD, -(-planned // LEAST_SHARDS)))}


def _splits(text: str) -> dict[str, Any]:
    out = {}
    for part in text.split(","):
        name, _, share = part.partition("=")
        try:
            out[name.strip()] = float(share)
        except ValueError:
            raise InputError(f"must be NAME=SHARE,NAME=SHARE, not {text!r}", source="--splits") from None
    return out


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise InputError(f"must be WIDTHxHEIGHT in pixels, not {text!r}", source="--size")
    return int(width), int(height)
