"""Read the images of a dataset, in several processes, into columns of numbers.

At most a given number of images is read, spread evenly over the dataset. Of each image some hundred bytes are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...base.arrays import Bytes, Ints, Objects, Singles
from ...base.errors import WRONG, InputError
from ...base.processes import ordered
from ...base.progress import Progress, notify
from ...folders.imagefolder import Entries, ImageEntry, ImageFolder, opened_entries
from ...folders.packed import PackedLines
from .faults import Fault, contradictions
from .figures import groups_of, numbers_of
from .pictures import SIDE, mask_contradictions, measure

_LARGEST = 1e30  # of a number in a column
_CHUNK = 128  # images of a task; packed lines are read in blocks of 32


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    """Result of reading one image in a worker process."""

    row: int
    name: str = ""
    frame: int = -1
    subject: int = -1
    groups: dict[str, str] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)
    digest: bytes = b""
    thumbnail: Bytes | None = None
    has_mask: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """Data read from a dataset; arrays have one value per image."""

    folder: ImageFolder  # the dataset
    rows: Ints  # (n,) rows of the folder's entries
    names: list[str]  # (n,) files of the images, empty where the line cannot be read
    frames: Ints  # (n,) numbers of the frames, -1 where there are none
    subjects: Ints  # (n,) numbers of the subjects, -1 where there are none
    groups: dict[str, Objects]  # (n,) name of a group -> value, by kind of group
    columns: dict[str, Singles]  # name -> (n,), nan where an image has no such number
    thumbnails: Bytes  # (n, SIDE, SIDE) mean levels
    digests: list[bytes]  # (n,) digests of the pixels, empty where there is no picture
    faults: dict[int, list[Fault]]  # place among the rows -> what is wrong

    def __len__(self) -> int:
        return len(self.rows)

    def entry(self, at: int) -> ImageEntry:
        """Read the line of an image again."""
        return self.folder.entries[int(self.rows[at])]

    def add(self, at: int, fault: Fault) -> None:
        """Note a fault."""
        self.faults.setdefault(at, []).append(fault)


def read(path: str | Path, *, limit: int, workers: int, progress: Progress | None = None) -> Contents:
    """Read the images of a dataset.

    Args:
        path: its folder.
        limit: the largest number of images that are read.
        workers: processes that read them.
        progress: called with (images read, images to read, "images").

    Raises:
        InputError: it is not a folder of images.
    """
    folder = ImageFolder.load(path)
    rows = spread(len(folder.entries), limit)
    store = _Store(len(rows))
    tasks = [rows[k : k + _CHUNK].tolist() for k in range(0, len(rows), _CHUNK)]
    # This process has opened the folder; others open it once each.
    job = partial(_read_rows, folder.entries) if workers <= 1 else partial(_read_in_process, str(folder.path))
    done = 0
    for part in ordered(job, tasks, workers):
        for row in part:
            store.take(done, row)
            done += 1
        notify(progress, done, len(rows), "images")
    return store.contents(folder, rows)


def spread(count: int, limit: int) -> Ints:
    """Choose `limit` of `count` rows, evenly."""
    chosen = min(count, limit)
    return np.arange(chosen, dtype=np.int64) * count // max(chosen, 1)


def split_of_subjects(contents: Contents) -> dict[str, tuple[int, set[int]]]:
    """Number of images and subjects of each split, of all images if there is an index, else of those that were read."""
    lines, found = contents.folder.entries.lines, {}
    if isinstance(lines, PackedLines):
        subjects = np.asarray(lines.rows["subject"])
        for name in lines.splits:
            own = lines.of_split(name)
            found[name] = (len(own), set(np.unique(subjects[own]).tolist()))
        return found
    splits = contents.groups.get("split", np.zeros(0, dtype=object))
    for name in sorted({str(v) for v in splits if v is not None}):
        own = np.flatnonzero(splits == name)
        found[name] = (len(own), set(np.unique(contents.subjects[own]).tolist()) - {-1})
    return found


class _Store:
    """Arrays that grow by columns, never by rows."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._names = [""] * count
        self._frames, self._subjects = (np.full(count, -1, dtype=np.int64) for _ in range(2))
        self._groups: dict[str, Objects] = {}
        self._columns: dict[str, Singles] = {}
        self._thumbnails = np.zeros((count, SIDE, SIDE), dtype=np.uint8)
        self._digests = [b""] * count
        self._faults: dict[int, list[Fault]] = {}
        self._bare: list[int] = []

    def take(self, at: int, row: _Row) -> None:
        self._names[at], self._frames[at], self._subjects[at] = row.name, row.frame, row.subject
        for name, value in row.groups.items():
            if name not in self._groups:
                self._groups[name] = np.full(self._count, None, dtype=object)
            self._groups[name][at] = value
        for name, number in row.numbers.items():
            if name not in self._columns:
                self._columns[name] = np.full(self._count, np.nan, dtype=np.float32)
            self._columns[name][at] = number
        self._digests[at] = row.digest
        if row.thumbnail is not None:
            self._thumbnails[at] = row.thumbnail
        if row.faults:
            self._faults[at] = row.faults
        if row.name and not row.has_mask:
            self._bare.append(at)

    def contents(self, folder: ImageFolder, rows: Ints) -> Contents:
        if len(self._bare) < self._count / 2:
            for at in self._bare:
                self._faults.setdefault(at, []).append(Fault("mask", "its line names none, as most others do"))
        return Contents(
            folder=folder,
            rows=rows,
            names=self._names,
            frames=self._frames,
            subjects=self._subjects,
            groups=self._groups,
            columns=self._columns,
            thumbnails=self._thumbnails,
            digests=self._digests,
            faults=self._faults,
        )


def _read_in_process(path: str, rows: Sequence[int]) -> list[_Row]:
    return _read_rows(opened_entries(path), rows)


def _read_rows(entries: Entries, rows: Sequence[int]) -> list[_Row]:
    found = []
    for row, entry in zip(rows, _each(entries, rows), strict=True):
        found.append(_Row(row=row, faults=[entry]) if isinstance(entry, Fault) else _read_image(row, entry))
    return found


def _each(entries: Entries, rows: Sequence[int]) -> Iterator[ImageEntry | Fault]:
    """Entries of some rows; where the line cannot be read, why."""
    for row in rows:
        try:
            yield entries[row]
        except InputError as error:
            yield Fault("line", error.reason)


def _read_image(row: int, entry: ImageEntry) -> _Row:
    line, faults = entry.line, list[Fault]()
    numbers: dict[str, float] = {}
    groups = {"split": str(line.get("split") or "")}
    try:
        faults += contradictions(entry)
        numbers, groups = numbers_of(entry), groups_of(entry)
        for name in [name for name, number in numbers.items() if abs(number) > _LARGEST]:
            faults.append(Fault("label", f"{name} is {numbers.pop(name):g}"))
    except (*WRONG, InputError) as error:
        faults.append(_wrong_line(error))
    picture = measure(entry)
    try:
        if picture.mask is not None:
            faults += mask_contradictions(entry, picture.mask)
    except (*WRONG, InputError) as error:
        if not any(fault.kind == "line" for fault in faults):
            faults.append(_wrong_line(error))
    return _Row(
        row=row,
        name=entry.name,
        frame=_count(entry.records[0].get("frame")) if entry.records else -1,
        subject=_count(line.get("subject")),
        groups=groups,
        numbers=numbers | picture.numbers,
        faults=faults + picture.faults,
        digest=picture.digest,
        thumbnail=picture.thumbnail,
        has_mask=line.get("mask_file_name") is not None,
    )


def _wrong_line(error: Exception) -> Fault:
    if isinstance(error, InputError):
        return Fault("line", f"{error.path.partition('.')[2]} {error.reason}".strip())
    return Fault("line", f"lacks expected labels ({type(error).__name__}: {error})")


def _count(value: Any) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63 else -1


def matrix(contents: Contents, names: Sequence[str]) -> Singles:
    """Columns side by side, (n, len(names))."""
    return np.stack([contents.columns[name] for name in names], axis=1)
