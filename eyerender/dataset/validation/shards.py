"""Comparison of metadata.jsonl with the lines of the shards."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import InputError
from ...base.storage.files import opened, parse_json, shown
from ...base.storage.jsonlines import MAX_BYTES, MAX_LINE_BYTES
from ...folders.imagefolder import DATASET_SCHEMA, LINES, METADATA, SHARDS, ImageFolder, finished, shard_name
from .problems import SHOWN, FolderProblems, differences

_EXACT_INTEGER = 2**53


def compare_lines(images: ImageFolder, problems: FolderProblems) -> None:
    """Compare metadata.jsonl with the shards' lines as values; the order of lines and of keys does not matter.

    A folder of packed shards, or of an unfinished run, has no metadata.jsonl.

    Lines whose text differs are parsed and compared by image name. Whole numbers are equal to their floating-point
    form. This takes some ten bytes of memory per line, and some hundred for one whose text differs.
    """
    folder = images.path
    if images.unfinished or images.dataset["schema"] != DATASET_SCHEMA:
        return
    mine = [folder / METADATA]
    theirs = [folder / SHARDS / shard_name(shard) / LINES for shard in sorted(finished(folder))]
    own, other = (np.fromiter(map(hashed, _lines(files)), dtype=np.uint64) for files in (mine, theirs))
    same = frozenset(np.intersect1d(own, other).tolist())
    found, expected = ({name: (at, value) for at, name, value, _ in _others(files, same)} for files in (mine, theirs))
    changed = sorted(found[name] for name in found.keys() & expected.keys() if found[name][1] != expected[name][1])
    numbers = {number for number, _ in changed[:SHOWN]}
    wrong = {name: (number, line) for number, name, _, line in _others(mine, same) if number in numbers}
    for _, name, _, line in _others(theirs, same):
        if name in wrong:
            number, changed_line = wrong.pop(name)
            said = next(differences(line, changed_line, 0.0), "it has other keys")
            problems.add(f"{METADATA} line {number + 1}: {name} differs from its shard: {said}")
    problems.count += max(len(changed) - SHOWN, 0)
    for here, there, where, words in (
        (found, expected, METADATA, "this line is in no shard"),
        (expected, found, f"{SHARDS}/*/{LINES}", f"not in {METADATA}"),
    ):
        alone = sorted((number, name) for name, (number, _) in here.items() if name not in there)
        problems.extend(f"{where} line {number + 1}: {shown(name)}: {words}" for number, name in alone)


def _others(files: Sequence[Path], same: Set[int]) -> Iterator[tuple[int, str, int, dict[str, Any]]]:
    """Yield each object whose text is not among `same`: its number, its image's name, the hash of its values, itself.

    Other checks report the lines that hold no object.
    """
    for number, raw in enumerate(_lines(files)):
        if hashed(raw) not in same:
            with suppress(InputError, RecursionError):  # too deeply nested for metadata
                line = parse_json(raw)
                if isinstance(line, dict):
                    values = json.dumps(_plain(line), sort_keys=True)
                    yield number, str(line.get("file_name")), hashed(values.encode()), line


def _lines(files: Sequence[Path]) -> Iterator[bytes]:
    """Yield the lines of several files; an unreadable file has none."""
    for path in files:
        with suppress(InputError, OSError), opened(path, limit=MAX_BYTES, follow=False) as file:
            while raw := file.readline(MAX_LINE_BYTES):
                yield raw.strip()


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
