"""Assembly of the finished dataset from its shards.

This writes metadata.jsonl, failures.jsonl, the data card and, last, dataset.json.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import WRONG, EyerenderError, InputError
from ..base.progress import Progress, notify
from ..base.storage.files import (
    MAX_FILE_BYTES,
    opened,
    read_json,
    remove_file,
    remove_parts,
    write_json,
    write_text,
    written,
)
from ..base.storage.jsonlines import MAX_BYTES
from ..folders.imagefolder import (
    CONVENTIONS,
    DATASET,
    DONE,
    LINES,
    METADATA,
    RUN,
    SHARDS,
    finished,
    packed_index,
    shard_name,
)
from ..folders.packed import INDEX, TAR
from .card import data_card
from .croissant import CROISSANT, croissant
from .done import FILES, PACKED, checksum, compare_sums, is_sums, layout_of, read_done, run_versions, sum_of
from .lines import lines_file
from .packing import counts_of
from .plan import Plan
from .shard import verify
from .spec import DatasetSpec

FAILURES, CARD = "failures.jsonl", "README.md"
_SHOWN = 50  # missing shards that are named


def assemble(plan: Plan, folder: Path) -> dict[str, Any]:
    """Assemble the dataset from verified shards and return its statistics.

    The same shards give the same bytes. Shards of files then lose their own files of lines, which metadata.jsonl holds.
    Raises EyerenderError if no sample could be made, or the disk is full or not writable; InputError if a shard's
    metadata differs from what this version writes.
    """
    for name in (FAILURES, METADATA, INDEX, CROISSANT, CARD, DATASET):
        remove_parts(folder / name)
    statistics = Statistics()
    table = PackedTable(plan, folder, statistics) if plan.spec.is_packed else LineTable(plan, folder, statistics)
    with written(folder / FAILURES) as file:
        for shard in plan.spec.shards:
            done = read_done(folder, shard)
            statistics.take_shard(done)
            statistics.lost |= {plan.spec.selection.subject_of(sample) for sample in done["given_up"]}
            table.take(shard, done)
            file.writelines((json.dumps(rejection) + "\n").encode() for rejection in done["rejections"])
    if not statistics.images:
        raise EyerenderError(f"{folder}: no sample of this spec can be made; see {FAILURES} for the reasons")
    more = table.write()
    sums = {table.layout.table: checksum(folder / table.layout.table), **statistics.tars}
    write_json(folder / CROISSANT, croissant(plan, sums))
    card = data_card(plan, statistics.to_mapping())
    write_text(folder / CARD, card)
    statistics.bytes += sum((folder / name).stat().st_size for name in (table.layout.table, FAILURES, CROISSANT, CARD))
    statistics.bytes += 2 * len(json.dumps(plan.to_mapping(), indent=1))  # of run.json and dataset.json
    found = statistics.to_mapping()
    dataset = {
        "schema": table.layout.dataset,
        "kind": "dataset",
        "digest": plan.digest,
        **plan.to_mapping(),
        **more,
        "versions": run_versions(),
        "backends": sorted(statistics.backends),
        "rounding": sorted(statistics.rounding),
        "conventions": CONVENTIONS,
        "statistics": found,
        "checksums": {name: sum_of(folder / name) for name in (table.layout.table, FAILURES)},
    }
    write_json(folder / DATASET, dataset)
    for shard in () if plan.spec.is_packed else plan.spec.shards:
        remove_file(lines_file(folder, shard))
    return found


class LineTable:
    """Table of the images of a dataset: metadata.jsonl, with the lines of all shards."""

    layout = FILES

    def __init__(self, plan: Plan, folder: Path, statistics: Statistics) -> None:
        self._plan, self._folder, self._statistics = plan, folder, statistics

    def take(self, shard: int, done: Mapping[str, Any]) -> None:
        """Take the record of the next shard, which holds nothing that its lines do not."""

    def write(self) -> dict[str, Any]:
        """Write the table, count its images, and return further keys of dataset.json."""
        try:
            with written(self._folder / METADATA) as file:
                file.writelines(line.encode() for line in type_first(self._lines, self._statistics.take_line))
        except WRONG as error:
            raise InputError(
                f"the lines of a shard do not have the format of this version ({type(error).__name__}: {error})",
                source=str(self._folder),
            ) from None
        return {}

    def _lines(self) -> Iterator[str]:
        for shard in self._plan.spec.shards:
            with opened(self._folder / SHARDS / shard_name(shard) / LINES, limit=MAX_BYTES, follow=False) as file:
                yield from map(bytes.decode, file)


class PackedTable:
    """Table of the images of a dataset with packed shards: index.npy, from their records; no metadata is read."""

    layout = PACKED

    def __init__(self, plan: Plan, folder: Path, statistics: Statistics) -> None:
        self._folder, self._statistics = folder, statistics
        self._splits, self._parts = sorted(plan.spec.splits), list[NDArray[Any]]()

    def take(self, shard: int, done: Mapping[str, Any]) -> None:
        """Take the record of the next shard; like `LineTable`.

        Raises:
            InputError: it has another format than this version's.
        """
        source = str(self._folder / SHARDS / shard_name(shard) / DONE)
        self._parts.append(packed_index(done, shard, self._splits, source))
        try:
            self._statistics.take_counts(done["counts"])
        except WRONG as error:
            reason = f"is not in the format of this version ({error})"
            raise InputError(reason, source=source, path="counts") from None

    def write(self) -> dict[str, Any]:
        """Write the table; like `LineTable`."""
        rows, statistics = np.concatenate(self._parts), self._statistics
        for k, name in enumerate(self._splits):
            own = rows["subject"][rows["split"] == k]
            if len(own):
                statistics.splits[name], statistics.subjects[name] = len(own), set(np.unique(own).tolist())
        with written(self._folder / INDEX) as file:
            np.save(file, rows, allow_pickle=False)
        return {"splits": self._splits}


def damage(folder: Path, digest: str | None = None, *, quick: bool = False) -> Iterator[str]:
    """Describe each damaged file among dataset.json and the assembled files whose checksums it contains.

    The dataset must have the plan of this digest, if given; `quick` compares sizes only.
    """
    try:
        dataset = read_json(folder / DATASET, limit=MAX_FILE_BYTES, follow=False)
    except InputError as error:
        yield f"{DATASET}: {error.reason}"
        return
    layout, sums = layout_of(dataset.get("schema")), dataset.get("checksums")
    if layout is None or dataset["schema"] != layout.dataset or digest not in (None, dataset.get("digest")):
        yield f"{DATASET}: is of another spec"
    elif not is_sums(sums) or layout.table not in sums:
        yield f"{DATASET}: checksums: do not have the format of this version"
    else:
        yield from compare_sums(folder, sums, quick=quick)


def verify_dataset(folder: Path, *, quick: bool = False, progress: Progress | None = None) -> Iterator[str]:
    """Describe each damaged file of a dataset: the results of `damage`, of `verify` for its shards, and missing shards.

    Of an unfinished run, only the finished shards are verified. `quick` compares sizes only.
    """
    is_whole, there = (folder / DATASET).is_file(), sorted(finished(folder))
    if is_whole:
        yield from damage(folder, quick=quick)
    try:
        dataset = read_json(folder / (DATASET if is_whole else RUN), limit=MAX_FILE_BYTES, follow=False)
    except InputError as error:
        if not is_whole:
            yield f"{RUN}: {error.reason}"
        return
    digest, spec = dataset.get("digest"), dataset.get("spec")
    for k, shard in enumerate(there):
        yield from verify(folder, shard, digest if isinstance(digest, str) else None, quick=quick)
        notify(progress, k + 1, len(there), "shards")
    try:
        asked = DatasetSpec.from_mapping(spec if isinstance(spec, dict) else {}).shards
    except InputError as error:
        yield f"{DATASET if is_whole else RUN}: spec: {error}"
        return
    known, wanted = frozenset(there), asked if isinstance(asked, range) else frozenset(asked)
    if is_whole:
        absent = (shard for shard in asked if shard not in known)
        yield from (f"{SHARDS}/{shard_name(shard)}: missing" for shard in islice(absent, _SHOWN))
        if (more := len(asked) - sum(shard in wanted for shard in there) - _SHOWN) > 0:
            yield f"{SHARDS}: {more} more are missing"
    yield from (f"{SHARDS}/{shard_name(s)}: dataset.json has no such shard" for s in there if s not in wanted)


def type_first(lines: Callable[[], Iterable[str]], take: Callable[[dict[str, Any]], None]) -> Iterator[str]:
    """Order lines of JSON so that the first lines fill every column.

    Loaders determine a column's type from the first lines of the file (Hugging Face from its first 10 MB). A column
    that is null there gets no type, and loading fails at the first value, such as a reason that occurs once in ten
    thousand images. So the first line that fills a column comes to the front, with all lines of its sample; others
    keep their order.

    `lines` is called twice; `take` is called once with each parsed line.
    """
    seen: set[str] = set()
    first: dict[int, str] = {}
    read = ((number, text, json.loads(text)) for number, text in enumerate(lines()))
    for _, group in groupby(read, key=lambda one: one[2]["sample"]):
        own = list(group)
        for _, _, line in own:
            take(line)
        filled = {path for _, _, line in own for path in _filled(line, "")}
        if not filled <= seen:
            seen |= filled
            first |= {number: text for number, text, _ in own}
    yield from first.values()
    for number, text in enumerate(lines()):
        if number not in first:
            yield text


def _filled(node: Any, path: str) -> Iterator[str]:
    """Return the paths of all values that are neither null nor an empty list."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _filled(value, f"{path}.{key}")
    elif isinstance(node, list):
        for value in node:
            yield from _filled(value, f"{path}[]")
    elif node is not None:
        yield path


class Statistics:
    """Counts over a dataset."""

    def __init__(self) -> None:
        self.backends: set[str] = set()
        self.rounding: set[str] = set()  # fingerprints
        self.images = self.saturated = self.rejected = self.given_up = self.samples = self.bytes = 0
        self.tars: dict[str, str] = {}  # SHA-256 of packed shards, by name
        self.splits: Counter[str] = Counter()
        self.subjects: dict[str, set[int]] = {}
        self.lost: set[int] = set()  # subjects with samples that were given up
        self.pupil_px: list[float] = []
        self.visible = 0
        self.glints = 0

    def take_shard(self, done: dict[str, Any]) -> None:
        """Count a shard from its done.json."""
        backend = done["backend"]
        self.backends.add(f"{backend['name']} ({backend['device']}; {done['cpu']})")
        self.rounding.add(done.get("rounding") or "unknown")
        chosen = done.get("chosen")
        self.samples += done["samples"][1] - done["samples"][0] if chosen is None else len(chosen)
        self.images += done["images"]
        self.saturated += done["images_saturated"]
        self.rejected += len(done["rejections"])
        self.given_up += len(done["given_up"])
        # Of done.json, what grows with the images, which is the same on every machine, and about 1 kB more.
        record = 1000 + len(json.dumps([done["files"], done.get("columns"), done.get("chosen")]))
        # The lines of shards of files are in metadata.jsonl.
        self.bytes += record + sum(e["bytes"] for name, e in done["files"].items() if not name.endswith(f"/{LINES}"))
        self.tars |= {name: entry["sha256"] for name, entry in done["files"].items() if name.endswith(TAR)}

    def take_line(self, line: dict[str, Any]) -> None:
        """Count one image from its metadata."""
        self.splits[line["split"]] += 1
        self.subjects.setdefault(line["split"], set()).add(line["subject"])
        self.take_counts(counts_of([line]))

    def take_counts(self, counts: Mapping[str, Any]) -> None:
        """Add what `counts_of` returned of some images."""
        self.visible += int(counts["pupils_visible"])
        self.glints += int(counts["glints_visible"])
        self.pupil_px += map(float, counts["pupil_semi_axis_px"])

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
            "subjects_left_out": len(self.lost.difference(*self.subjects.values())),
        }
