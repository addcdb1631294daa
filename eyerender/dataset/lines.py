"""Lines of the shards of a finished dataset, which stand in metadata.jsonl alone.

A shard in the making has its own file of lines. The assembled metadata.jsonl holds the lines of all shards, so their
files are then removed (`assemble`), and before a run changes the dataset they are written again (`restore_lines`).
done.json keeps the checksum of a shard's file, which tells whether metadata.jsonl still holds what was made.
"""

from __future__ import annotations

import os
from array import array
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..base.arrays import Ints
from ..base.errors import WRONG, InputError
from ..base.storage.files import opened, parse_json, written
from ..base.storage.jsonlines import MAX_BYTES, MAX_LINE_BYTES
from ..folders.imagefolder import LINES, METADATA, SHARDS, finished, shard_name


@dataclass(frozen=True, slots=True)
class ShardLines:
    """Places of lines in a metadata.jsonl: shard -> (n, 3) sample, first byte, length, in the shard's order."""

    path: Path
    places: dict[int, Ints]

    @classmethod
    def index(cls, folder: Path) -> ShardLines:
        """Index the lines of a dataset that name an image of a shard; of an unreadable file, there are none."""
        found = cls(folder / METADATA, {})
        places: dict[int, array[int]] = defaultdict(lambda: array("q"))
        with suppress(InputError, OSError), opened(found.path, limit=MAX_BYTES, follow=False) as file:
            start = 0
            while text := file.readline(MAX_LINE_BYTES):
                with suppress(InputError, *WRONG):
                    line = parse_json(text)
                    shard = int(line["file_name"].split("/")[1])
                    places[shard].extend((int(line["sample"]), start, len(text)))
                start += len(text)
        for shard, numbers in places.items():
            rows = np.array(numbers, dtype=np.int64).reshape(-1, 3)
            found.places[shard] = rows[np.lexsort(rows.T[::-1])]
        return found

    def of(self, shard: int) -> Iterator[bytes]:
        """Yield the lines of a shard, as its own file holds them; InputError if metadata.jsonl cannot be read."""
        if shard in self.places:
            with opened(self.path, limit=MAX_BYTES, follow=False) as file:
                for _, start, length in self.places[shard].tolist():
                    file.seek(start)
                    yield file.read(length)


def lines_file(folder: Path, shard: int) -> Path:
    """Return the path of a shard's own file of lines."""
    return folder / SHARDS / shard_name(shard) / LINES


def restore_lines(folder: Path) -> None:
    """Write the files of lines that finished shards lack from metadata.jsonl; the caller has the final lock.

    Raises OSError or EyerenderError if the disk is full or not writable.
    """
    lacking = [shard for shard in sorted(finished(folder)) if not os.path.lexists(lines_file(folder, shard))]
    if lacking and (folder / METADATA).is_file():
        found = ShardLines.index(folder)
        for shard in lacking:
            with written(lines_file(folder, shard)) as file:
                file.writelines(found.of(shard))
