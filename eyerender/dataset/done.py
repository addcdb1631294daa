"""The record of a shard, done.json: its samples, the checksums of its files, and the versions that made them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from ..base.errors import InputError
from ..base.storage.files import inside, opened, read_json
from ..base.storage.jsonlines import MAX_BYTES
from ..base.versions import package_version
from ..folders.imagefolder import (
    ARRAY_KEYS,
    DATASET_SCHEMA,
    DONE,
    KINDS,
    LINES,
    MAX_DONE_BYTES,
    METADATA,
    PACKED_RUN_SCHEMA,
    PACKED_SCHEMA,
    RUN_SCHEMA,
    SHARDS,
    shard_name,
    versions,
)
from ..folders.packed import INDEX, LINES_GZ


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderLayout:
    """Names in a dataset's folder: each picture a file, or packed shards."""

    run: str  # schema of run.json
    dataset: str  # schema of dataset.json
    shard: str  # schema of a shard's done.json
    table: str  # assembled file of all images
    lines: str  # file of a shard's metadata
    kinds: tuple[str, ...]  # kinds of pictures whose folders hold files of a shard


FILES = FolderLayout(
    run=RUN_SCHEMA, dataset=DATASET_SCHEMA, shard="eyerender/shard/1", table=METADATA, lines=LINES, kinds=tuple(KINDS)
)
PACKED = FolderLayout(
    run=PACKED_RUN_SCHEMA, dataset=PACKED_SCHEMA, shard="eyerender/shard/2", table=INDEX, lines=LINES_GZ, kinds=()
)


def layout_of(schema: object) -> FolderLayout | None:
    """Return the layout in which a file of a schema stands; None if it is a file of another version."""
    return next((one for one in (FILES, PACKED) if schema in (one.run, one.dataset, one.shard)), None)


def picture_file(kind: str, name: str) -> str:
    """Name of the file of a picture of an image: arrays of real numbers are .npz, others .png."""
    return f"{name}{'.npz' if KINDS[kind] in ARRAY_KEYS else '.png'}"


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _are(value: object, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(map(fits, value))


def described(samples: Sequence[int]) -> tuple[list[int], list[int] | None]:
    """Describe the samples of a shard: first and end, plus the list of samples if some in between are missing."""
    whole = isinstance(samples, range)
    return [samples[0], samples[-1] + 1], None if whole else list(samples)


def is_sums(value: object) -> TypeGuard[Mapping[str, Mapping[str, Any]]]:
    """Return whether a value maps file names to sizes and SHA-256, as `compare_sums` requires."""
    return isinstance(value, Mapping) and all(
        isinstance(entry, Mapping) and _is_count(entry.get("bytes")) and isinstance(entry.get("sha256"), str)
        for entry in value.values()
    )


# Test for the value of each key of done.json.
_DONE_KEYS: dict[str, Callable[[Any], bool]] = {
    "shard": _is_count,
    "samples": lambda v: _are(v, _is_count) and len(v) == 2,
    "chosen": lambda v: v is None or _are(v, _is_count),  # the samples where some between are left out
    "images": _is_count,
    "images_saturated": _is_count,
    "digest": lambda v: isinstance(v, str),
    "versions": lambda v: isinstance(v, Mapping),
    "backend": lambda v: isinstance(v, Mapping) and all(isinstance(v.get(key), str) for key in ("name", "device")),
    "cpu": lambda v: isinstance(v, str),
    "rounding": lambda v: v is None or isinstance(v, str),  # earlier versions did not write it
    "rejections": lambda v: _are(v, lambda entry: isinstance(entry, Mapping)),
    "given_up": lambda v: _are(v, _is_count),
    "files": is_sums,
}


def read_done(folder: Path, shard: int) -> dict[str, Any]:
    """Read a finished shard's done.json and check the type of every key; InputError if the file is not valid."""
    return read_done_file(folder / SHARDS / shard_name(shard) / DONE)


def read_done_file(path: Path) -> dict[str, Any]:
    """Read a done.json or the checkpoint of a partial shard, checked as in `read_done`."""
    data = read_json(path, limit=MAX_DONE_BYTES, follow=False)
    if data.get("schema") not in (FILES.shard, PACKED.shard):
        raise InputError(f"must have the schema {FILES.shard!r} or {PACKED.shard!r}", source=str(path))
    for key, fits in _DONE_KEYS.items():
        if not fits(data.get(key)):
            raise InputError("is missing, or not in the format of this version", source=str(path), path=key)
    return data


def compare_sums(folder: Path, sums: Mapping[str, Mapping[str, Any]], *, quick: bool = False) -> Iterator[str]:
    """Describe each file of a folder whose size or SHA-256 differs from `sums`; `quick` compares sizes only."""
    for name, entry in sums.items():
        try:
            path = inside(folder, name)
            size = path.stat().st_size
            if size != entry["bytes"]:
                yield f"{name}: has {size} bytes, not {entry['bytes']}"
            elif not quick and checksum(path) != entry["sha256"]:
                yield f"{name}: its checksum differs"
        except InputError as error:
            yield error.reason
        except OSError as error:
            yield f"{name}: cannot be read ({error.strerror or error})"


def checksum(path: Path) -> str:
    """Return the SHA-256 of a regular file; raises `InputError` for any other."""
    with opened(path, limit=MAX_BYTES, follow=False) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sum_of(path: Path) -> dict[str, Any]:
    """Return the size and SHA-256 of a file."""
    return {"bytes": path.stat().st_size, "sha256": checksum(path)}


def run_versions() -> dict[str, str]:
    """Return the versions that affect a dataset's bytes."""
    found = versions()
    del found["opencv-python-headless"]  # nothing here uses it
    return {**found, "pillow": package_version("pillow")}


def cpu_family() -> str:
    """Return the name of the processor, or its architecture."""
    from ..backends.probe import cpu_name

    return cpu_name()
