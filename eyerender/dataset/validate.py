"""Validation of a folder of images.

Files are compared with checksums, metadata with shards and plan, values with those recomputed from pose and parameters,
and masks with the apparent outlines.

Memory grows by only some tens of bytes per image.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..backends.choose import BackendChoice
from ..base.errors import WRONG, InputError
from ..base.progress import Progress
from ..folders.imagefolder import FILE_KEYS, Entries, ImageEntry, ImageFolder
from .assemble import verify_dataset
from .validation.images import Tally, check_images
from .validation.lines import Lines, check_records, compare_lines
from .validation.problems import FolderProblems
from .validation.rendering import render_again
from .validation.truth import Again, DatasetTruth, NoTruth, SceneTruth, truth_of

SAMPLE = 64
"""Number of lines that are recomputed by default; smaller folders are checked completely."""
_BATCH = 256


def validate(
    path: str | Path,
    *,
    quick: bool = False,
    deep: bool = False,
    render: int = 0,
    backend: BackendChoice = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Validate a folder and return a report (schema eyerender/validation/1).

    >>> er.validate("out")["ok"]  # doctest: +SKIP

    Args:
        path: the folder.
        quick: do not open or hash images; changed bytes and wrong masks are then not found.
        deep: recompute all lines of metadata, not only `SAMPLE` of them (see `sampled`).
        render: number of images of a dataset to render again and compare pixel by pixel.
        backend: the render backend for these images.
        threads: processor threads for rendering; None: all.
        progress: called with the amount done, the total, and the kind.

    Raises:
        BackendError: no backend can render.
        InputError: the path is not a folder of images, or `render` is negative.
    """
    if render < 0:
        raise InputError(f"must be >= 0, not {render}", path="render")
    path = Path(path)
    folder = ImageFolder.load(path)
    step = progress or (lambda *_: None)
    problems, tally, notes = FolderProblems(), Tally(), [folder.unfinished] if folder.unfinished else []
    truth = _truth(folder, problems, notes)
    if folder.dataset.get("kind") == "dataset":
        problems.extend(verify_dataset(path, quick=quick, progress=step))
        compare_lines(folder, problems)
    total = len(folder.entries)
    able = truth is not None and truth.stale is None
    rows = range(total) if deep else frozenset(sampled(total, str(folder.dataset.get("digest")), SAMPLE))
    read = recomputed = 0
    lines = Lines(folder, truth)
    for start, batch in _batches(folder.entries, problems):
        records = check_records([entry.line for entry in batch])
        for k, (entry, wrong) in enumerate(zip(batch, records, strict=True), start):
            where = f"{entry.source.relative_to(path).as_posix()} line {entry.number}"
            named = str(entry.line["file_name"])
            used = truth if able and k in rows else None
            read, recomputed = read + 1, recomputed + (used is not None)
            try:
                problems.extend(f"{where}: {text}" for text in lines.take(k, entry))
                problems.extend(f"{named}: {text}" for text in _check(entry, wrong, used, tally, quick=quick))
            except WRONG as error:
                problems.add(f"{where}: lacks expected labels ({type(error).__name__}: {error})")
            except InputError as error:
                problems.add(str(error))
            step(k + 1, total, "images")
    lines.finish(problems)
    if render and able and isinstance(truth, DatasetTruth):
        images = sampled(total, str(folder.dataset.get("digest")), render)
        notes += render_again(folder, truth, images, step, problems, backend=backend, threads=threads)
    elif render:
        notes.append("no image is rendered again")
    statistics = folder.dataset.get("statistics")
    return {
        "schema": "eyerender/validation/1",
        "path": str(path),
        "ok": not problems.count,
        "images": read,
        "recomputed": recomputed,
        "notes": notes,
        "problem_count": problems.count,
        "problems": problems.shown,
        "problems_left_out": problems.count - len(problems.shown),
        "statistics": {**(statistics if isinstance(statistics, dict) else {}), **tally.to_mapping()},
    }


def _truth(folder: ImageFolder, problems: FolderProblems, notes: list[str]) -> DatasetTruth | SceneTruth | None:
    """Return the reference for the metadata of a folder; if there is none, add the reason to the notes."""
    try:
        found = truth_of(folder, problems)
    except NoTruth as reason:
        notes.append(f"nothing is computed again: {reason}")
        return None
    if found is not None and found.stale is not None:
        notes.append(f"records and labels are not computed again: {found.stale}")
    return found


def _check(
    entry: ImageEntry, wrong: list[str], truth: DatasetTruth | SceneTruth | None, tally: Tally, *, quick: bool
) -> Iterator[str]:
    """Describe what is wrong with an image and its metadata; with `truth` None, nothing is recomputed.

    If its records are `wrong`, no more is compared with them.
    """
    again = Again(()) if truth is None or wrong else truth.again(entry.line)
    yield from (*wrong, *again.problems)
    if quick:
        _find_files(entry)
    elif not wrong:
        yield from check_images(entry, again.limbus_px, tally)


def _find_files(entry: ImageEntry) -> None:
    """Check that the files named in the metadata exist inside the folder; InputError naming the first missing file."""
    for key in FILE_KEYS:
        entry.check(key)


def sampled(total: int, digest: str, count: int = SAMPLE) -> list[int]:
    """Return the lines that are recomputed by default: a hashed one from each of `count` equal parts of the file.

    The choice depends only on the folder's digest, so two validations of a folder use the same lines.
    """
    if total <= count:
        return list(range(total))
    rows = []
    for k in range(count):
        start, end = total * k // count, total * (k + 1) // count
        number = int.from_bytes(hashlib.sha256(f"{digest}/{k}".encode()).digest()[:8], "big")
        rows.append(start + number % (end - start))
    return rows


def _batches(entries: Entries, problems: FolderProblems) -> Iterator[tuple[int, list[ImageEntry]]]:
    """Yield the metadata of a folder in batches, with the number of the first line; unreadable lines are skipped."""
    row = 0
    while row < len(entries):
        batch: list[ImageEntry] = []
        failed = 0
        try:
            # Lines are read one by one, so that those before a damaged line count.
            for entry in entries[row : row + _BATCH]:
                batch.append(entry)
        except InputError as error:
            problems.add(str(error))
            failed = 1
        if batch:
            yield row, batch
        row += len(batch) + failed
