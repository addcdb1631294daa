"""Files with one JSON object per line; only the offset of each line is kept in memory."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..arrays import Ints
from ..errors import InputError
from .files import opened, parse_json, read_slice

# A line of metadata takes about 10 KB; one with a long list of targets takes more.
MAX_LINE_BYTES = 4 * 2**20
MAX_BYTES = 2**50  # only one line is in memory at a time
_CHUNK = 2**20


@dataclass(frozen=True, slots=True, eq=False)
class JsonLines:
    """A file of JSON lines; `starts` (n + 1,) are the byte offsets of its n lines and its end."""

    path: Path
    starts: Ints
    state: tuple[int, int, int]

    @classmethod
    def index(cls, path: Path, *, limit: int = MAX_LINE_BYTES) -> JsonLines:
        """Index the lines of a file in one pass, with 8 bytes of memory per line.

        `path`: a regular file, not a link; `limit`: longest accepted line, in bytes. Raises InputError if the file
        cannot be read, or one of its lines is too long or blank.
        """
        parts = [np.zeros(1, dtype=np.int64)]
        count = start = offset = 0  # number of complete lines, start of the current one, bytes read
        with opened(path, limit=MAX_BYTES, follow=False) as file:
            state = _state(file)
            while chunk := file.read(_CHUNK):
                ends = np.flatnonzero(np.frombuffer(chunk, dtype=np.uint8) == ord("\n")) + (offset + 1)
                offset += len(chunk)
                lengths = np.diff(ends, prepend=start, append=offset)
                for wrong, reason in (
                    (lengths > limit + 1, f"is too long (at most {limit} bytes are read)"),
                    (lengths[:-1] < len("{}\n"), "must be a JSON object"),
                ):
                    if wrong.any():
                        raise InputError(reason, source=str(path), path=f"line {count + int(wrong.argmax()) + 1}")
                if len(ends):
                    parts.append(ends)
                    count, start = count + len(ends), int(ends[-1])
        if offset > start:  # the last line has no line end
            parts.append(np.array([offset], dtype=np.int64))
        starts = np.concatenate(parts)
        starts.setflags(write=False)
        return cls(path, starts, state)

    def __len__(self) -> int:
        return len(self.starts) - 1

    def read(self, rows: range, *, before: str = "") -> Iterator[dict[str, Any]]:
        """Read the objects of some lines, counted from 0.

        Args:
            rows: the lines.
            before: read only the keys in front of this one, where `json.dumps` wrote the line; "": all keys.

        Raises:
            InputError: a line is not a JSON object, or the file has changed since it was indexed.
        """
        source = str(self.path)
        for row, text in zip(rows, self._texts(rows), strict=False):
            where = f"line {row + 1}"
            head, found, _ = text.partition(b', "' + before.encode() + b'": ')
            value = parse_json(head + b"}" if before and found else text, source=source, path=where)
            if not isinstance(value, dict):
                raise InputError("must be a JSON object", source=source, path=where)
            yield value

    def _texts(self, rows: range) -> Iterator[bytes]:
        """Read the texts of some lines."""
        if len(rows) == 1:
            start, end = (int(at) for at in self.starts[rows[0] : rows[0] + 2])
            text, state = read_slice(self.path, start, end - start)
            self._check((state.st_ino, state.st_size, state.st_mtime_ns))
            yield text
        elif len(rows):
            with opened(self.path, limit=MAX_BYTES, follow=False) as file:
                self._check(_state(file))
                for row in rows:
                    start, end = int(self.starts[row]), int(self.starts[row + 1])
                    if file.tell() != start:
                        file.seek(start)
                    yield file.read(end - start)

    def _check(self, state: tuple[int, int, int]) -> None:
        if state != self.state:
            raise InputError("has changed while it was read", source=str(self.path))


@dataclass(frozen=True, slots=True, eq=False)
class LineFiles:
    """Several files of JSON lines, read as one; `ends` (n,) is the number of lines up to the end of each file."""

    files: tuple[JsonLines, ...]
    ends: Ints

    @classmethod
    def of(cls, files: Iterable[JsonLines]) -> LineFiles:
        """Join files in their order."""
        parts = tuple(files)
        return cls(parts, np.cumsum([len(part) for part in parts], dtype=np.int64))

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    def read(self, rows: range, *, before: str = "") -> Iterator[tuple[Path, int, dict[str, Any]]]:
        """Read some lines, counted from 0 over all files: the file, the line's number in it, the object.

        `rows` may have any step; lines in increasing order are read fastest. Line numbers count from 1. `before` is as
        for `JsonLines.read`. Raises InputError as `JsonLines.read`.
        """
        at = 0
        while at < len(rows):
            file = int(np.searchsorted(self.ends, rows[at], side="right"))
            first = int(self.ends[file - 1]) if file else 0
            stop = at + 1
            while stop < len(rows) and first <= rows[stop] < int(self.ends[file]):
                stop += 1
            own = range(rows[at] - first, rows[stop - 1] - first + (1 if rows.step > 0 else -1), rows.step)
            for row, value in zip(own, self.files[file].read(own, before=before), strict=True):
                yield self.files[file].path, row + 1, value
            at = stop


def _state(file: BinaryIO) -> tuple[int, int, int]:
    state = os.fstat(file.fileno())
    return state.st_ino, state.st_size, state.st_mtime_ns
