"""Assembly of the finished dataset from its shards.

This writes metadata.jsonl, failures.jsonl, the data card and, last, dataset.json.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..base.errors import EyerenderError, InputError
from ..base.storage.files import MAX_FILE_BYTES, read_json, remove_parts, write_json, write_text, written
from ..folders.imagefolder import (
    CONVENTIONS,
    DATASET,
    DATASET_SCHEMA,
    DONE,
    LINES,
    METADATA,
    PACKED_SCHEMA,
    SHARDS,
    finished,
    packed_index,
    shard_name,
)
from ..folders.packed import INDEX
from .card import data_card
from .columns import type_first
from .croissant import CROISSANT, croissant
from .done import checksum, compare_sums, is_sums, read_done, run_versions, sum_of
from .plan import Plan
from .shard import verify
from .spec import MAX_COUNT, DatasetSpec

FAILURES, CARD = "failures.jsonl", "README.md"


def assemble(plan: Plan, folder: Path) -> dict[str, Any]:
    """Assemble the dataset from verified shards and return its statistics.

    The same shards give the same bytes.

    Raises:
        EyerenderError: no sample could be made, or the disk is full or not writable.
        InputError: a shard's metadata differs from what this version writes.
    """
    for name in (FAILURES, METADATA, INDEX, CROISSANT, CARD, DATASET):
        remove_parts(folder / name)
    if plan.spec.is_packed:
        return _assemble_packed(plan, folder)
    statistics = Statistics()
    with written(folder / FAILURES) as file:
        for _, done in _finished(plan, folder, file):
            statistics.take_shard(done)
    with written(folder / METADATA) as file:
        for line in _lines(folder, plan.spec.shards, statistics.take_line):
            file.write(line)
        found = statistics.to_mapping()
        if found["images"] == 0:
            raise EyerenderError(f"{folder}: no sample of this spec can be made; see {FAILURES} for the reasons")
    sums = {name: sum_of(folder / name) for name in (METADATA, FAILURES)}
    write_json(folder / CROISSANT, croissant(plan, sums[METADATA]["sha256"]))
    return _described(plan, folder, DATASET_SCHEMA, {}, statistics, sums)


def _assemble_packed(plan: Plan, folder: Path) -> dict[str, Any]:
    """Merge the summaries of packed shards: image index, failures and statistics. No metadata is read."""
    statistics, splits, parts = Statistics(), sorted(plan.spec.splits), []
    with written(folder / FAILURES) as file:
        for shard, done in _finished(plan, folder, file):
            statistics.take_packed(done)
            parts.append(packed_index(done, shard, splits, str(folder / SHARDS / shard_name(shard) / DONE)))
    rows = np.concatenate(parts)
    if not len(rows):
        raise EyerenderError(f"{folder}: no sample of this spec can be made; see {FAILURES} for the reasons")
    statistics.take_index(rows, splits)
    with written(folder / INDEX) as file:
        np.save(file, rows, allow_pickle=False)
    sums = {name: sum_of(folder / name) for name in (INDEX, FAILURES)}
    return _described(plan, folder, PACKED_SCHEMA, {"splits": splits}, statistics, sums)


def _finished(plan: Plan, folder: Path, failures: BinaryIO) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield every shard with its summary, and write its rejections to the file of failures."""
    for shard in plan.spec.shards:
        done = read_done(folder, shard)
        yield shard, done
        failures.writelines((json.dumps(rejection) + "\n").encode() for rejection in done["rejections"])


def _described(
    plan: Plan, folder: Path, schema: str, more: dict[str, Any], statistics: Statistics, sums: dict[str, Any]
) -> dict[str, Any]:
    """Write the card and dataset.json of a complete dataset; return its statistics."""
    found = statistics.to_mapping()
    write_text(folder / CARD, data_card(plan, found))
    dataset = {
        "schema": schema,
        "kind": "dataset",
        "digest": plan.digest,
        **plan.to_mapping(),
        **more,
        "versions": run_versions(),
        "backends": sorted(statistics.backends),
        "conventions": CONVENTIONS,
        "statistics": found,
        "checksums": sums,
    }
    write_json(folder / DATASET, dataset)
    return found


def damage(folder: Path, digest: str | None = None, *, quick: bool = False) -> Iterator[str]:
    """Describe each damaged file among dataset.json and the assembled files whose checksums it contains.

    If dataset.json is from an older version without checksums, metadata.jsonl is compared with the shards.

    Args:
        folder: the dataset.
        digest: digest of the plan that the dataset must have; None: any plan.
        quick: compare sizes only.
    """
    try:
        dataset = read_json(folder / DATASET, limit=MAX_FILE_BYTES, follow=False)
    except InputError as error:
        yield f"{DATASET}: {error.reason}"
        return
    packed = dataset.get("schema") == PACKED_SCHEMA
    if not (packed or dataset.get("schema") == DATASET_SCHEMA) or digest not in (None, dataset.get("digest")):
        yield f"{DATASET}: is of another spec"
        return
    sums = dataset.get("checksums")
    if sums is None and not quick and not packed:
        yield from _differs_from_shards(folder)
    elif (packed or sums is not None) and not (is_sums(sums) and (INDEX if packed else METADATA) in (sums or {})):
        yield f"{DATASET}: checksums: do not have the format of this version"
    else:
        yield from compare_sums(folder, sums or {}, quick=quick)


def verify_finished(folder: Path, digest: str | None) -> Iterator[str]:
    """Describe each damaged file of the finished shards of an unfinished run."""
    for shard in sorted(finished(folder)):
        yield from verify(folder, shard, digest)


def verify_dataset(folder: Path, *, quick: bool = False) -> Iterator[str]:
    """Describe each damaged file of a finished dataset: the results of `damage`, and of `verify` for its shards.

    Args:
        folder: the dataset.
        quick: compare sizes only.
    """
    problems = list(damage(folder, quick=quick))
    yield from problems
    if any(problem.startswith(f"{DATASET}: ") for problem in problems):
        return
    dataset = read_json(folder / DATASET, limit=MAX_FILE_BYTES, follow=False)
    shards = shards_of(dataset)
    if shards is None:
        yield f"{DATASET}: spec: has no count and shard_size"
        return
    for shard in shards:
        yield from verify(folder, shard, dataset.get("digest"), quick=quick)


def shards_of(dataset: Mapping[str, Any]) -> Sequence[int] | None:
    """Return the shard numbers of the spec in a dataset.json; None if it contains none."""
    spec = dataset.get("spec")
    if isinstance(spec, dict) and (spec.get("choice") == "spread" or spec.get("layout") is not None):
        with suppress(InputError):
            return DatasetSpec.from_mapping(spec).shards
        return None
    count, size = (spec.get(key) if isinstance(spec, dict) else None for key in ("count", "shard_size"))
    if isinstance(count, int) and isinstance(size, int) and 0 < count <= MAX_COUNT and size > 0:
        return range(-(-count // size))
    return None


def _lines(folder: Path, shards: Iterable[int], take: Callable[[dict[str, Any]], None]) -> Iterator[bytes]:
    """Yield the lines of metadata.jsonl; call `take` with each line, parsed."""

    def lines() -> Iterator[str]:
        for shard in shards:
            with open(folder / SHARDS / shard_name(shard) / LINES, encoding="utf-8") as file:
                yield from file

    try:
        for line in type_first(lines, take):
            yield line.encode()
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(
            f"the lines of a shard do not have the format of this version ({reason})", source=str(folder)
        ) from None


def _differs_from_shards(folder: Path) -> Iterator[str]:
    digest = hashlib.sha256()
    for line in _lines(folder, sorted(finished(folder)), lambda _line: None):
        digest.update(line)
    if checksum(folder / METADATA) != digest.hexdigest():
        yield f"{METADATA}: differs from the shards"


class Statistics:
    """Counts over a dataset."""

    def __init__(self) -> None:
        self.backends: set[str] = set()
        self.images = self.saturated = self.rejected = self.given_up = self.samples = self.bytes = 0
        self.splits: Counter[str] = Counter()
        self.subjects: dict[str, set[int]] = {}
        self.pupil_px: list[float] = []
        self.visible = 0
        self.glints = 0

    def take_packed(self, done: Mapping[str, Any]) -> None:
        """Count a packed shard from its done.json, except for what `take_index` counts.

        Raises:
            InputError: done.json has another format than this version's.
        """
        self.take_shard(dict(done))
        try:
            counts = done["counts"]
            self.visible += int(counts["pupils_visible"])
            self.glints += int(counts["glints_visible"])
            self.pupil_px += map(float, counts["pupil_semi_axis_px"])
        except (KeyError, TypeError, ValueError) as error:
            name = f"{SHARDS}/{shard_name(done['shard'])}/{DONE}"
            raise InputError(f"is not in the format of this version ({error})", source=name, path="counts") from None

    def take_index(self, rows: NDArray[Any], splits: Sequence[str]) -> None:
        """Count the images and subjects of each split in an index."""
        self.images = len(rows)
        for k, name in enumerate(splits):
            own = rows["subject"][rows["split"] == k]
            if len(own):
                self.splits[name], self.subjects[name] = len(own), set(np.unique(own).tolist())

    def take_shard(self, done: dict[str, Any]) -> None:
        """Count a shard from its done.json."""
        backend = done["backend"]
        self.backends.add(f"{backend['name']} ({backend['device']}; {done['cpu']})")
        chosen = done.get("chosen")
        self.samples += done["samples"][1] - done["samples"][0] if chosen is None else len(chosen)
        self.saturated += done.get("images_saturated") or 0
        self.rejected += len(done["rejections"])
        self.given_up += len(done["given_up"])
        self.bytes += sum(entry["bytes"] for entry in done["files"].values())

    def take_line(self, line: dict[str, Any]) -> None:
        """Count one image from its metadata."""
        self.images += 1
        self.splits[line["split"]] += 1
        self.subjects.setdefault(line["split"], set()).add(line["subject"])
        labels = line["labels"]
        axes = labels["pupil"]["amodal"]["semi_axes_px"]
        if axes is not None:
            self.pupil_px.append(axes[0])
        self.visible += labels["pupil"]["visible"]["pixels"] > 0
        self.glints += sum(g["visible"] for g in labels["glints"])

    def to_mapping(self) -> dict[str, Any]:
        """Convert to a mapping for JSON."""
        sizes = sorted(self.pupil_px)
        return {
            "samples": self.samples,
            "images": self.images,
            "images_saturated": self.saturated,
            "images_by_split": dict(sorted(self.splits.items())),
            "subjects_by_split": {k: len(v) for k, v in sorted(self.subjects.items())},
            "bytes_per_image": round(self.bytes / self.images) if self.images else 0,
            "pupils_visible": self.visible,
            "glints_visible": self.glints,
            "pupil_semi_axis_px": [sizes[0], sizes[len(sizes) // 2], sizes[-1]] if sizes else None,
            "attempts_rejected": self.rejected,
            "samples_given_up": self.given_up,
        }
