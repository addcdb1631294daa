"""Checks of the finished dataset against its shards.

Files are compared with their checksums, and metadata.jsonl with the shards' lines.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Ints
from ...base.errors import InputError
from ...base.progress import Progress
from ...base.storage.files import opened, parse_json, shown
from ...base.storage.jsonlines import MAX_BYTES, MAX_LINE_BYTES
from ...folders.imagefolder import LINES, METADATA, PACKED_SCHEMA, SHARDS, ImageFolder, finished, shard_name
from ..assemble import damage, shards_of
from ..shard import verify
from .problems import SHOWN, Problems, differences

_EXACT_INTEGER = 2**53


def check_run(images: ImageFolder, quick: bool, problems: Problems, step: Progress) -> None:
    """Check every shard that dataset.json lists, and the files assembled from the shards if the run is finished.

    A shard must exist, unless the run is unfinished, and belong to the plan. Its files must have the stated sizes and,
    unless `quick`, checksums.
    """
    folder, dataset = images.path, images.dataset
    if not images.unfinished:
        problems.extend(damage(folder, quick=quick))
        if dataset.get("schema") != PACKED_SCHEMA:
            compare_lines(folder, problems)
    there = sorted(finished(folder))
    digest = dataset.get("digest")
    for k, shard in enumerate(there):
        problems.extend(verify(folder, shard, digest if isinstance(digest, str) else None, quick=quick))
        step(k + 1, len(there), "shards")
    asked = shards_of(dataset)
    if asked is None:
        return  # then the plan cannot be read either
    known = frozenset(there)
    asked_for = asked if isinstance(asked, range) else frozenset(asked)
    if not images.unfinished:
        missing = len(asked) - sum(shard in asked_for for shard in there)
        absent = (s for s in asked if s not in known)
        problems.extend(f"{SHARDS}/{shard_name(s)}: missing" for s in islice(absent, SHOWN))
        problems.count += max(missing - SHOWN, 0)
    problems.extend(f"{SHARDS}/{shard_name(s)}: dataset.json has no such shard" for s in there if s not in asked_for)


def compare_lines(folder: Path, problems: Problems) -> None:
    """Compare metadata.jsonl with the shards' lines as values; the order of lines and of keys does not matter.

    Lines whose text differs are parsed and compared by image name. Whole numbers are equal to their floating-point
    form. This takes some ten bytes of memory per line.
    """
    mine = [folder / METADATA]
    theirs = [folder / SHARDS / shard_name(shard) / LINES for shard in sorted(finished(folder))]
    hashes = [np.fromiter((hashed(raw) for _, raw in _lines(files)), dtype=np.uint64) for files in (mine, theirs)]
    a = _values(mine, np.flatnonzero(~np.isin(hashes[0], hashes[1])))
    b = _values(theirs, np.flatnonzero(~np.isin(hashes[1], hashes[0])))
    _, at, to = np.intersect1d(a["name"], b["name"], return_indices=True)
    changed = a["value"][at] != b["value"][to]
    pairs = np.stack([a["number"][at[changed]], b["number"][to[changed]]], axis=1)
    pairs = pairs[np.argsort(pairs[:, 0])]
    first = [dict(_objects(files, np.sort(pairs[:SHOWN, k]))) for k, files in enumerate((mine, theirs))]
    for number, other in pairs[:SHOWN].tolist():
        line = first[0].get(number, {})
        said = next(differences(first[1].get(other, {}), line, 0.0), "it has other keys")
        problems.add(f"{METADATA} line {number + 1}: {line.get('file_name')} differs from its shard: {said}")
    problems.count += max(len(pairs) - SHOWN, 0)
    for files, found, others, words in ((mine, a, b, "this line is in no shard"), (theirs, b, a, f"not in {METADATA}")):
        alone = np.sort(found["number"][~np.isin(found["name"], others["name"])])
        where = METADATA if files is mine else f"{SHARDS}/*/{LINES}"
        for number, line in _objects(files, alone[:SHOWN]):
            problems.add(f"{where} line {number + 1}: {shown(line.get('file_name'))}: {words}")
        problems.count += max(len(alone) - SHOWN, 0)


def _values(files: Sequence[Path], numbers: Ints) -> NDArray[np.void]:
    """Read lines with given numbers: their numbers, and hashes of their images' names and of their values."""

    def rows() -> Iterator[tuple[int, int, int]]:
        for number, line in _objects(files, numbers):
            with suppress(RecursionError):  # too deeply nested for metadata; another check reports it
                values = json.dumps(_plain(line), sort_keys=True)
                yield number, hashed(str(line.get("file_name")).encode()), hashed(values.encode())

    return np.fromiter(rows(), dtype=[("number", np.int64), ("name", np.uint64), ("value", np.uint64)])


def _objects(files: Sequence[Path], numbers: Ints) -> Iterator[tuple[int, dict[str, Any]]]:
    """Read the lines with given numbers, in order, that are objects; other checks report the rest."""
    if not len(numbers):
        return
    wanted = iter(numbers.tolist())
    next_ = next(wanted)
    for number, raw in _lines(files):
        if number == next_:
            with suppress(InputError):
                value = parse_json(raw)
                if isinstance(value, dict):
                    yield number, value
            next_ = next(wanted, -1)
            if next_ < 0:
                return


def _lines(files: Sequence[Path]) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of several files, numbered from 0; an unreadable file has none."""
    number = 0
    for path in files:
        with suppress(InputError, OSError), opened(path, limit=MAX_BYTES, follow=False) as file:
            while raw := file.readline(MAX_LINE_BYTES):
                yield number, raw.strip()
                number += 1


def _plain(node: Any) -> Any:
    """Convert whole numbers of a JSON value to floating point where that is exact."""
    if isinstance(node, dict):
        return {key: _plain(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_plain(value) for value in node]
    whole = isinstance(node, int) and not isinstance(node, bool) and abs(node) < _EXACT_INTEGER
    return float(node) if whole else node


def hashed(data: bytes) -> int:
    """Return a 64-bit hash."""
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "big")
