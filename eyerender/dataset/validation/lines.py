"""Checks of every line of metadata: names, keys, records, labels that repeat records, subjects and splits.

Only a few bytes are kept of each line.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...base.arrays import Ints
from ...base.errors import WRONG, InputError
from ...base.status import Status
from ...base.storage.files import shown
from ...folders.imagefolder import (
    DATASET,
    DATASET_SCHEMA,
    LINES,
    METADATA,
    SHARDS,
    ImageEntry,
    ImageFolder,
    finished,
    shard_name,
)
from ...rig.plausibility import EXPOSURE_REMEDY
from ...scene.observation import Observations
from ..done import read_done
from ..lines import ShardLines
from .problems import FolderProblems
from .truth import DatasetTruth, SceneTruth

# Labels that every image of a dataset has, whatever is visible.
_ALWAYS = (
    "labels.pupil.amodal",
    "labels.pupil.visible",
    "labels.iris.amodal",
    "labels.iris.visible",
    "labels.space.world",
    "labels.space.camera",
    "labels.pose",
    "labels.camera",
    "parameters.draws",
)


class Lines:
    """Checker of the metadata, line by line, and finally of properties that concern several lines."""

    def __init__(self, folder: ImageFolder, truth: DatasetTruth | SceneTruth | None) -> None:
        self._folder = folder
        self._truth = truth
        count = len(folder.entries)
        self._names = np.zeros(count, dtype=np.uint64)
        self._subjects = np.full(count, -1, dtype=np.int64)
        self._splits = np.zeros(count, dtype=np.uint64)
        self._first: tuple[set[str], set[str]] | None = None  # keys of the first line

    def take(self, number: int, entry: ImageEntry) -> Iterator[str]:
        """Describe what is wrong with line `number`, counted from 0.

        A line that cannot be read raises one of `WRONG`.
        """
        line = entry.line
        self._names[number] = hashed(str(line["file_name"]).encode())
        if self._truth is not None:
            for key, value in self._truth.whose(line).items():
                if line.get(key) != value:
                    yield f"{key} is {shown(line.get(key))}, not {value!r}"
        if line["sample"] is None:
            return
        self._subjects[number], self._splits[number] = line["subject"], hashed(str(line["split"]).encode())
        keys = _keys(line)
        self._first = self._first or keys
        yield from _other_keys(keys, self._first)
        for path in _ALWAYS:
            node: Any = line
            for key in path.split("."):
                node = node.get(key) if isinstance(node, dict) else None
            if not isinstance(node, dict) or (not node and path != "parameters.draws"):
                yield f"{path} is empty"
        yield from _agree(line)

    def finish(self, problems: FolderProblems) -> None:
        """Check properties of all lines: their number, duplicate names, subjects in two splits."""
        entries = self._folder.entries
        statistics = self._folder.dataset.get("statistics")
        expected = statistics.get("images") if isinstance(statistics, dict) else None
        if expected is not None and expected != len(entries):
            problems.add(f"{METADATA}: has {len(entries)} lines, {DATASET} says {expected}")
        white = statistics.get("images_saturated") if isinstance(statistics, dict) else None
        if isinstance(white, int) and white > len(entries) / 2:
            problems.add(f"{DATASET}: {white} of {len(entries)} images are saturated; {EXPOSURE_REMEDY}")
        order = np.argsort(self._names, kind="stable")
        again = order[1:][self._names[order[1:]] == self._names[order[:-1]]]
        for k in np.sort(again):
            problems.add(f"{METADATA} line {k + 1}: its file name appears twice")
        for k in self._moved():
            problems.add(f"{METADATA} line {k + 1}: subject {self._subjects[k]} is in two splits")

    def _moved(self) -> Ints:
        """Describe lines whose subject was in another split before."""
        order = np.argsort(self._subjects, kind="stable")
        subject, split = self._subjects[order], self._splits[order]
        first = np.concatenate([[True], subject[1:] != subject[:-1]])
        reference = split[np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))]
        return np.asarray(np.sort(order[(subject >= 0) & (split != reference)]))


def check_records(batch: list[dict[str, Any]]) -> list[list[str]]:
    """Describe what is wrong with the records of each line of a batch."""
    problems: list[list[str]] = [[] for _ in batch]
    try:
        rows = [k for k, line in enumerate(batch) for _ in line["records"]]
        found = Observations.from_records([r for line in batch for r in line["records"]], complete=True)
    except (InputError, *WRONG):
        # One of them is wrong, and other checks show which.
        if len(batch) > 1:
            return [check_records([line])[0] for line in batch]
        try:
            Observations.from_records(batch[0]["records"], complete=True)
        except InputError as error:
            return [[str(one) for one in (error, *error.others)]]
        except WRONG as error:
            return [[f"records cannot be read ({type(error).__name__}: {error})"]]
        return problems
    pupil = found.pupil
    ok = pupil.ok
    with np.errstate(invalid="ignore"):
        a, b = pupil.semi_axes_px.T
        ellipse = np.isfinite(pupil.centre_px).all(axis=1) & (a >= b) & (b > 0)
        ellipse &= (pupil.angle_rad >= 0) & (pupil.angle_rad < np.pi)
    for i in np.flatnonzero(ok & ~ellipse):
        problems[rows[i]].append("its pupil is not an ellipse in the record's convention")
    for i in np.flatnonzero(~ok):
        if not pupil.reason[i]:
            problems[rows[i]].append(f"its pupil is {Status(pupil.status[i]).label} without a reason")
    placed = np.isfinite(found.glints.xy_px).all(axis=2)
    for i in np.flatnonzero((found.glints.ok & ~placed).any(axis=1)):
        problems[rows[i]].append("a glint has no position")
    return problems


def _agree(line: dict[str, Any]) -> Iterator[str]:
    """Compare labels with the numbers of the record that they repeat."""
    (record,) = line["records"]
    labels = line["labels"]
    own, pupil = labels["pupil"]["amodal"], record["pupil"]
    keys = ("status", "centre_px", "semi_axes_px", "angle_rad") if own["status"] == "ok" else ("status",)
    # These labels need the whole outline, so they are missing for a partial pupil.
    record_pupil = {**pupil, "status": "missing" if pupil["status"] == "partial" else pupil["status"]}
    if any(own[key] != record_pupil[key] for key in keys):
        yield "the pupil of its labels differs from that of its record"
    places = {glint["light"]: glint["xy_px"] for glint in record["glints"] if glint["status"] == "ok"}
    for glint in labels["glints"]:
        if glint["xy_px"] != places.get(glint["light"]):
            yield f"the glint of light {glint['light']} of its labels differs from that of its record"


def _other_keys(own: tuple[set[str], set[str]], first: tuple[set[str], set[str]]) -> Iterator[str]:
    """Return keys that only one of two lines has; below a null any keys are allowed."""
    nulls = own[1] | first[1]
    other = sorted(key for key in own[0] ^ first[0] if not any(key.startswith(null) for null in nulls))
    if other:
        yield f"has other keys than line 1 ({', '.join(key[1:] for key in other[:3])})"


def _keys(line: dict[str, Any]) -> tuple[set[str], set[str]]:
    """Return the paths of the keys of a line, and the prefixes of paths below its nulls and empty lists."""
    found, nulls = set[str](), set[str]()

    def collect(node: Any, path: str) -> None:
        found.add(path)
        if isinstance(node, dict):
            for key, value in node.items():
                collect(value, f"{path}.{key}")
        elif isinstance(node, list):
            if node and isinstance(node[0], dict):
                for value in node:
                    collect(value, f"{path}[]")
            elif not node:
                nulls.add(f"{path}[")
        elif node is None:
            nulls.update((f"{path}.", f"{path}["))

    collect(line, "")
    return found, nulls


def hashed(data: bytes) -> int:
    """Return a 64-bit hash."""
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "big")


def compare_lines(images: ImageFolder, problems: FolderProblems) -> None:
    """Compare the lines of each shard in metadata.jsonl with those that were made, whatever the order of shards.

    A folder of packed shards, or of an unfinished run, has no metadata.jsonl. One line is in memory at a time.
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
            found = hashlib.sha256()
            for text in lines.of(shard):
                found.update(text)
            if found.hexdigest() != sums.get("sha256"):
                said = "differ from what was made" if count == done["images"] else f"are {count}, not {done['images']}"
                problems.add(f"{METADATA}: the lines of shard {shard} {said}")
        except InputError:
            continue  # other checks report the file
