"""Comparison of metadata.jsonl with the checksums of the lines of the shards."""

from __future__ import annotations

import hashlib

from ...base.errors import InputError
from ...folders.imagefolder import DATASET_SCHEMA, LINES, METADATA, SHARDS, ImageFolder, finished, shard_name
from ..done import read_done
from ..lines import ShardLines
from .problems import FolderProblems


def compare_lines(images: ImageFolder, problems: FolderProblems) -> None:
    """Compare the lines of each shard in metadata.jsonl with those that were made, whatever the order of shards.

    A folder of packed shards, or of an unfinished run, has no metadata.jsonl. The lines of one shard are in memory.
    """
    if images.unfinished or images.dataset["schema"] != DATASET_SCHEMA:
        return
    lines, shards = ShardLines.index(images.path), finished(images.path)
    for shard in sorted(lines.places.keys() | shards):
        count = len(lines.places.get(shard, ()))
        if shard not in shards:
            problems.add(f"{METADATA}: {count} lines are of shard {shard}, which is not there")
            continue
        try:
            done = read_done(images.path, shard)
            sums = done["files"].get(f"{SHARDS}/{shard_name(shard)}/{LINES}", {})
            if hashlib.sha256(b"".join(lines.of(shard))).hexdigest() != sums.get("sha256"):
                said = "differ from what was made" if count == done["images"] else f"are {count}, not {done['images']}"
                problems.add(f"{METADATA}: the lines of shard {shard} {said}")
        except InputError:
            continue  # other checks report the file
