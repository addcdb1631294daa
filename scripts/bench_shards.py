#!/usr/bin/env python3
"""Bench of large packed datasets: 20,000 fabricated shards of 250 images, whose tars are empty; nothing is rendered.

    bench_shards.py [--quick] [--json F]

Measured are the processor's seconds of finishing a run, opening a split for training, starting a job of which shards
are missing, and `status`. --quick makes 500 shards, and its bars are scaled. The exit code is 1 if a `must` is missed.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from _bench import Report, options_of, row, single_threaded

single_threaded()

import numpy as np

from eyerender.dataset.assemble import assemble
from eyerender.dataset.done import cpu_family, described, run_versions
from eyerender.dataset.plan import Plan
from eyerender.dataset.run import generate
from eyerender.dataset.runfile import begin
from eyerender.dataset.spec import DatasetSpec, find_dataset
from eyerender.dataset.status import status
from eyerender.folders.imagefolder import ImageFolder
from eyerender.folders.packed import LINES_GZ, MEMBERS, TAR, pack_lines

IMAGES = 250
LINED = 100  # shards that have lines, which are those of the first
BARS = {"finish": 60.0, "open a split": 2.0, "start of a job": 3.0, "status": 2.0}


class Begun(Exception):
    """A run has come to the point at which it would render."""


def plan_of(shards: int) -> Plan:
    """The quick dataset with many subjects."""
    data = DatasetSpec.load(find_dataset("dataset_quick")).to_mapping()
    data |= {"count": shards * IMAGES, "shard_size": IMAGES, "subjects": shards * 5, "layout": "webdataset"}
    return Plan.of(DatasetSpec.from_mapping(data))


def line_of(sample: int, subject: int, split: str) -> dict[str, Any]:
    """A line with little in it."""
    parameters = {"scene_json": "{}", "eye_json": "{}"}
    name = f"images/00000/{sample:08d}-right.png"
    own = {"sample": sample, "subject": subject, "split": split, "records": [{"eye": "right"}]}
    window = {"x0": 0, "y0": 0, "width": 16, "height": 16}
    return {
        "schema": "eyerender/image/5",
        "file_name": name,
        "window_px": window,
        **own,
        MEMBERS: {},
        "parameters": parameters,
    }


def fabricate(folder: Path, plan: Plan) -> None:
    """Write done.json of every shard, and the lines of the first; the others have the same."""
    begin(folder, plan, print)
    selection, text = plan.spec.selection, b""
    blocks: list[int] = []
    splits, split_of = sorted(plan.spec.splits), cache(plan.split_of)
    made_by = {
        "digest": plan.digest,
        "versions": run_versions(),
        "backend": {"name": "llvm", "device": "fabricated"},
        "cpu": cpu_family(),
    }
    for shard in plan.spec.shards:
        samples = plan.spec.shard_samples(shard)
        subjects = [selection.subject_of(sample) for sample in samples]
        names = [split_of(subject) for subject in subjects]
        if not text:
            lines = [line_of(*who) for who in zip(samples, subjects, names, strict=True)]
            text, blocks = pack_lines(lines)
        place = folder / "shards" / f"{shard:05d}"
        place.mkdir(parents=True)
        if shard < LINED:
            (place / LINES_GZ).write_bytes(text)
            (place / TAR).write_bytes(b"")
        span, chosen = described(samples)
        done = {
            "schema": "eyerender/shard/2",
            "shard": shard,
            "samples": span,
            "chosen": chosen,
            "images": len(samples),
            "images_saturated": 0,
            **made_by,
            "rejections": [],
            "given_up": [],
            "saturated": [],
            "seconds": 1.0,
            "files": {f"shards/{shard:05d}/{name}": {"bytes": 0, "sha256": "0" * 64} for name in (TAR, LINES_GZ)},
            "splits": splits,
            "columns": {
                "sample": list(samples),
                "subject": subjects,
                "split": [splits.index(name) for name in names],
                "block": blocks,
            },
            "counts": {"pupils_visible": 1, "glints_visible": 2, "pupil_semi_axis_px": [12.3456] * len(samples)},
        }
        (place / "done.json").write_text(json.dumps(done))


def start(plan: Plan, folder: Path) -> None:
    """Start a job whose last shard is missing, up to its first sample."""

    def stop(*_: object) -> None:
        raise Begun

    done = folder / "shards" / f"{len(plan.spec.shards) - 1:05d}" / "done.json"
    kept = done.read_bytes()
    done.unlink()
    try:
        generate(plan, folder, progress=stop)
    except Begun:
        done.parent.mkdir(exist_ok=True)
        done.write_bytes(kept)


def open_split(folder: Path) -> None:
    """Open the images of a split, as `FolderDataset` does."""
    images = ImageFolder.load(folder)
    rows, _ = images.rows_of("train")
    _ = images.entries[int(rows[0])]


def seconds(work: Callable[[], object]) -> float:
    """Processor time of a call."""
    before = time.process_time()
    work()
    return time.process_time() - before


def main() -> int:
    """Fabricate, measure and report."""
    options = options_of(__doc__, "500 shards").parse_args()
    shards = 500 if options.quick else 20_000
    report = Report()
    with tempfile.TemporaryDirectory() as place:
        folder, plan = Path(place), plan_of(shards)
        fabricate(folder, plan)
        for name, work in (
            ("finish", lambda: assemble(plan, folder)),
            ("open a split", lambda: open_split(folder)),
            ("status", lambda: status(folder)),
            ("start of a job", lambda: start(plan, folder)),
        ):
            bar = BARS[name] * (max(shards / 20_000, 0.25) if options.quick else 1)
            report.add(row(f"{name}, {shards} shards of {IMAGES} images", seconds(work), "s", bar))
        size = np.load(folder / "index.npy", mmap_mode="r").nbytes
        report.add(row("index, bytes per image", size / (shards * IMAGES), "bytes"))
    return report.finish(options.json, ("numpy",))


if __name__ == "__main__":
    sys.exit(main())
