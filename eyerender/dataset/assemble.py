"""The finished dataset out of its shards: metadata.jsonl, failures.jsonl, the data card and, last, dataset.json."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import EyerenderError
from ..files import write_json
from ..imagefolder import CONVENTIONS, DATASET, DATASET_SCHEMA, METADATA
from .card import data_card
from .columns import type_first
from .croissant import CROISSANT, croissant
from .plan import Plan
from .shard import LINES, SHARDS, checksum, read_done, run_versions, shard_name

FAILURES, CARD = "failures.jsonl", "README.md"
_PART = ".part"


def assemble(plan: Plan, folder: Path) -> dict[str, Any]:
    """Put the dataset together; the same shards give the same bytes. Returns its statistics."""
    statistics = Statistics()
    shards = range(plan.spec.shard_count)
    with open(folder / (FAILURES + _PART), "w", encoding="utf-8") as failures:
        for shard in shards:
            done = read_done(folder, shard)
            statistics.take_shard(done)
            for rejection in done["rejections"]:
                failures.write(json.dumps(rejection) + "\n")

    def lines() -> Iterator[str]:
        for shard in shards:
            with open(folder / SHARDS / shard_name(shard) / LINES, encoding="utf-8") as file:
                yield from file

    with open(folder / (METADATA + _PART), "w", encoding="utf-8") as metadata:
        metadata.writelines(type_first(lines, statistics.take_line))
    found = statistics.to_mapping()
    if found["images"] == 0:
        raise EyerenderError(f"{folder}: no sample of this spec can be made; {FAILURES}{_PART} says why")
    os.replace(folder / (METADATA + _PART), folder / METADATA)
    os.replace(folder / (FAILURES + _PART), folder / FAILURES)
    write_json(folder / CROISSANT, croissant(plan, checksum(folder / METADATA)))
    card = folder / (CARD + _PART)
    card.write_text(data_card(plan, found), encoding="utf-8")
    os.replace(card, folder / CARD)
    dataset = {
        "schema": DATASET_SCHEMA,
        "kind": "dataset",
        "digest": plan.digest,
        **plan.to_mapping(),
        "versions": run_versions(),
        "backends": sorted(statistics.backends),
        "conventions": CONVENTIONS,
        "statistics": found,
    }
    write_json(folder / DATASET, dataset)
    return found


class Statistics:
    """Counts over a dataset."""

    def __init__(self) -> None:
        self.backends: set[str] = set()
        self.images = self.rejected = self.given_up = self.samples = self.bytes = 0
        self.splits: Counter[str] = Counter()
        self.subjects: dict[str, set[int]] = {}
        self.pupil_px: list[float] = []
        self.visible = 0
        self.glints = 0

    def take_shard(self, done: dict[str, Any]) -> None:
        """A shard's done.json."""
        backend = done["backend"]
        self.backends.add(f"{backend['name']} ({backend['device']}; {done['cpu']})")
        self.samples += done["samples"][1] - done["samples"][0]
        self.rejected += len(done["rejections"])
        self.given_up += len(done["given_up"])
        self.bytes += sum(entry["bytes"] for entry in done["files"].values())

    def take_line(self, line: dict[str, Any]) -> None:
        """An image's line of metadata."""
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
        """As JSON has it."""
        sizes = sorted(self.pupil_px)
        return {
            "samples": self.samples,
            "images": self.images,
            "images_by_split": dict(sorted(self.splits.items())),
            "subjects_by_split": {k: len(v) for k, v in sorted(self.subjects.items())},
            "bytes_per_image": round(self.bytes / self.images) if self.images else 0,
            "pupils_visible": self.visible,
            "glints_visible": self.glints,
            "pupil_semi_axis_px": [sizes[0], sizes[len(sizes) // 2], sizes[-1]] if sizes else None,
            "attempts_rejected": self.rejected,
            "samples_given_up": self.given_up,
        }
