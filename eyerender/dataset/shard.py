"""Shards, which are written to a temporary folder and renamed when complete.

    images/00003/*.png   masks/00003/*.png   shards/00003/lines.jsonl (`lines.py`), done.json

`done.json` is put in place last, after all other files are in place and synced. A shard with this file is therefore
complete, even after a power cut, and its checksums show later damage. Checkpoints of partial shards also remain when a
run ends.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..base.errors import InputError
from ..base.storage.files import PART, exchange_folders, link_or_copy, make_folder, remove_file, sync_folder
from ..folders.imagefolder import DATASET, DONE, KINDS, LINES, METADATA, SHARDS, shard_name
from .done import FILES, PACKED, compare_sums, described, read_done, read_done_file
from .maker import Maker
from .partial import PartialShard, places, remove_stages, samples_in, set_aside, take_back


class Stopped(Exception):
    """A shard was left unfinished, with a checkpoint, because its worker has to end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Staged:
    """A shard that is written but not yet in place: its folder, and a summary for the log."""

    shard: int
    stage: str
    images: int
    rejected: int
    given_up: int
    seconds: float
    bytes: int  # size on disk


def write_shard(
    maker: Maker,
    folder: Path,
    shard: int,
    on_sample: Callable[[int, int], None],
    stop: Callable[[], bool] = lambda: False,
) -> Staged:
    """Make the samples of a shard in a temporary folder, continuing where an earlier worker stopped.

    `on_sample` is called with the number of finished samples and of images of the last one. If `stop`, called before
    each sample, returns true, samples in progress are finished and no new one is begun. Raises Stopped if `stop`
    returned true; OSError or EyerenderError if the disk is full or not writable; InputError if a file that the scenes
    name cannot be used, or has changed since the plan was made.
    """
    maker.plan.check_files()
    samples = maker.plan.spec.shard_samples(shard)
    with PartialShard(maker.plan, maker.backend, folder, shard) as partial:
        if partial.made:
            on_sample(len(partial.made), 0)
        todo = [sample for sample in samples if sample not in partial.made]
        for made in maker.make_all(_until(stop, todo)):
            partial.add(made)
            on_sample(len(partial.made), len(made.images))
        if len(partial.made) < len(samples):
            partial.checkpoint()
            raise Stopped
        return staged(partial)


def staged(partial: PartialShard) -> Staged:
    """Finish a shard whose samples are all made; it may then be put in place."""
    done = partial.finish()
    return Staged(
        shard=partial.shard,
        stage=str(partial.stage),
        images=done["images"],
        rejected=len(done["rejections"]),
        given_up=len(done["given_up"]),
        seconds=partial.seconds,
        bytes=sum(entry["bytes"] for entry in done["files"].values()) + len(json.dumps(done)),
    )


def _until(stop: Callable[[], bool], samples: Iterable[int]) -> Iterator[int]:
    for sample in samples:
        if stop():
            return
        yield sample


def commit(folder: Path, staged: Staged) -> None:
    """Put a staged shard in place, done.json last.

    If the dataset grows, the finished shard, which holds some of its samples, stays readable. If it shrinks, the
    finished shard is set aside. Raises OSError if a file cannot be moved.
    """
    stage = Path(staged.stage)
    if is_finished(folder, staged.shard):
        with suppress(InputError):  # a done.json that another program wrote names no samples
            if samples_in(read_done(folder, staged.shard)) <= samples_in(read_done_file(stage / DONE)):
                _replace(folder, stage, staged.shard)
                return
        set_aside(folder, staged.shard)
    moves = [(place, own) for place, own in places(folder, stage, staged.shard) if own.is_dir()]
    for place, own in moves:
        shutil.rmtree(place, ignore_errors=True)  # remains of a run that ended between these renames
        make_folder(place.parent)
        os.rename(own, place)
    for place, _ in moves:
        sync_folder(place.parent)
    lines = moves[-1][0]
    os.rename(stage / DONE, lines / DONE)
    sync_folder(lines)
    shutil.rmtree(stage, ignore_errors=True)


def _replace(folder: Path, stage: Path, shard: int) -> None:
    """Put a staged shard in the place of a finished one that holds some of its samples.

    Whenever the process is killed, one of the two is in place, and the stage can be put in place again.
    """
    *pictures, (lines, own) = places(folder, stage, shard)
    for place, new in pictures:
        if new.is_dir():
            make_folder(place)
            for file in new.iterdir():
                _put(file, place / file.name)
            sync_folder(place)
    if (own / LINES).exists():
        _put(own / LINES, lines / LINES)
        _put(stage / DONE, lines / DONE)
    else:  # a packed shard's files belong together
        os.rename(stage / DONE, own / DONE)
        exchange_folders(own, lines)
    sync_folder(lines)
    shutil.rmtree(stage, ignore_errors=True)


def _put(file: Path, place: Path) -> None:
    """Give a staged file its place, where another version of it may be."""
    if not (place.exists() and place.samefile(file)):
        new = place.with_name(f".{place.name}{PART}")
        new.unlink(missing_ok=True)
        link_or_copy(file, new)
        os.replace(new, place)


def is_finished(folder: Path, shard: int) -> bool:
    """Return whether a shard has a done.json."""
    return (folder / SHARDS / shard_name(shard) / DONE).is_file()


def fits(folder: Path, shard: int, samples: Sequence[int]) -> bool:
    """Return whether a shard is finished with exactly these samples."""
    try:
        done = read_done(folder, shard)
    except InputError:
        return False
    return (done["samples"], done.get("chosen")) == described(samples)


def verify(folder: Path, shard: int, digest: str | None = None, *, quick: bool = False) -> Iterator[str]:
    """Describe each damage of a finished shard: its done.json, and the sizes and SHA-256 of its files.

    The shard must be of the plan of this digest, if given; `quick` compares sizes only.
    """
    name = shard_name(shard)
    try:
        done = read_done(folder, shard)
    except InputError as error:
        yield f"{SHARDS}/{name}/{DONE}: {error.path}{': ' if error.path else ''}{error.reason}"
        return
    if done["shard"] != shard or digest not in (None, done["digest"]):
        yield f"{SHARDS}/{name}/{DONE}: is of another {'spec' if done['shard'] == shard else 'shard'}"
        return
    layout = PACKED if done["schema"] == PACKED.shard else FILES
    own = tuple(f"{kind}/{name}/" for kind in (*layout.kinds, SHARDS))
    lines = f"{SHARDS}/{name}/{layout.lines}"
    if lines not in done["files"] or not all(n.startswith(own) for n in done["files"]):
        yield f"{SHARDS}/{name}/{DONE}: files: do not belong to this shard"
        return
    # In a finished dataset, metadata.jsonl holds the lines of shards of files, with its own checksum.
    is_whole = (folder / DATASET).is_file() and (folder / METADATA).is_file()
    is_dropped = is_whole and layout is FILES and not os.path.lexists(folder / lines)
    yield from compare_sums(
        folder, {n: e for n, e in done["files"].items() if n != lines or not is_dropped}, quick=quick
    )


def withdraw_damaged(folder: Path, shards: Iterable[int], digest: str) -> dict[int, str]:
    """Verify finished shards, and remove the done.json of damaged ones and those of another plan.

    A run makes these shards again. Returns the withdrawn shards, with the first problem of each. Raises OSError if a
    done.json cannot be removed.
    """
    damaged = {}
    for shard in shards:
        problem = next(verify(folder, shard, digest), None)
        if problem is not None:
            damaged[shard] = problem
            remove_file(folder / SHARDS / shard_name(shard) / DONE)
    return damaged


def remove_leftovers(folder: Path, mine: set[int], done: set[int]) -> None:
    """Remove remains of earlier runs in shards that this run makes, except checkpoints of unfinished shards."""
    missing = mine - done
    take_back(folder, missing)
    remove_stages(folder, mine, done)
    for kind in (*KINDS, SHARDS):
        if (folder / kind).is_dir():
            for place in (folder / kind).iterdir():
                if place.name.isdecimal() and int(place.name) in missing:
                    shutil.rmtree(place, ignore_errors=True)
