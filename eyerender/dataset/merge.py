"""Join parts of one run that were made in separate folders, without a shared file system."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import WRONG, EyerenderError, InputError
from ..base.progress import Progress
from ..base.storage.files import inside, make_folder, opened, sync_folder, sync_tree, write_json
from ..base.storage.lock import final_lock, run_lock
from ..folders.imagefolder import DATASET, DONE, RUN, SHARDS, finished, read_run
from .assemble import assemble
from .done import checksum, read_done
from .lines import ShardLines, lines_file, restore_lines
from .packing import SHARD
from .partial import new_stage
from .plan import Plan
from .runfile import begin, check_work, refuse_taken
from .shard import Staged, commit, verify

SCHEMA = "eyerender/merge/1"
_REPAIR = "start generate again on the folder to repair it"


def merge(parts: Sequence[str | Path], out: str | Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Put the finished shards of several folders of one run into one folder; assemble the dataset if none is missing.

    Only regular files that a shard's done.json lists are copied, and what is copied is compared with the checksums
    there. A shard that several folders hold is taken from the first. Merging again adds what is missing. `parts`:
    folders that `generate --shard K/N` has filled, of the same spec, options and versions; `out`: the folder to write,
    new or of the same run; `progress`: called with shards done, shards in all, and "shards". Returns a summary (schema
    eyerender/merge/1). Raises InputError if a folder holds no run, or one of another spec or version; if a shard is
    damaged; if `out` holds something else; EyerenderError if the disk is full or not writable.
    """
    if not parts:
        raise InputError("give the folders of the parts", source="merge")
    folder, places = Path(out), [Path(part) for part in parts]
    runs = [read_run(place) for place in places]
    for place, run in zip(places, runs, strict=True):
        if place.resolve() == folder.resolve():
            raise InputError("is the folder to write", source=str(place))
        if {key: run.get(key) for key in _SAME} != {key: runs[0].get(key) for key in _SAME}:
            raise InputError(f"holds another run than {parts[0]}, or another number of samples", source=str(place))
    try:
        plan = Plan.from_mapping(runs[0], places[0])
    except WRONG as error:
        raise InputError(f"holds no plan ({error})", source=str(places[0] / RUN)) from None
    check_work(plan.spec, places[0])
    refuse_taken(folder)
    step = progress or (lambda *_: None)
    try:
        make_folder(folder)
        with run_lock(folder, (1, 1), lambda _: None), final_lock(folder, lambda _: None):
            begin(folder, plan, lambda _: None)
            restore_lines(folder)
            _take(folder, places, plan, step)
            missing = set(plan.spec.shards) - finished(folder)
            statistics = None if missing else assemble(plan, folder)
    except OSError as error:
        raise EyerenderError(f"{out}: cannot be written ({error.strerror or error})") from None
    found = {"schema": SCHEMA, "path": str(folder), "complete": not missing, "shards_missing": len(missing)}
    return found if statistics is None else {**found, "statistics": statistics}


_SAME = ("schema", "digest", "spec", "versions")


def _take(folder: Path, places: Sequence[Path], plan: Plan, step: Progress) -> None:
    """Copy every shard that the folder lacks from the first part that has it."""
    wanted, there = set(plan.spec.shards), finished(folder)
    sources = {shard: place for place in reversed(places) for shard in finished(place) & wanted - there}
    lines = {place: ShardLines.index(place) for place in set(sources.values()) if (place / DATASET).is_file()}
    for k, (shard, place) in enumerate(sorted(sources.items())):
        problem = next(verify(place, shard, plan.digest, quick=True), None)
        if problem is not None:
            raise InputError(f"{problem}; {_REPAIR}", source=str(place))
        commit(folder, _staged(folder, place, shard, lines.get(place)))
        step(k + 1, len(sources), "shards")


def _staged(folder: Path, place: Path, shard: int, lines: ShardLines | None) -> Staged:
    """Copy a verified shard into a temporary folder, for `commit` to put in place; `lines` are a finished dataset's."""
    stage, done = new_stage(folder, shard), read_done(place, shard)
    for name in done["files"]:
        if name.count("/") != 2:
            raise InputError("does not lie in a folder of the shard", source=str(place / name))
    for name, entry in done["files"].items():
        kind, _, file = name.split("/", 2)
        source, own = place / name, stage / (SHARD if kind == SHARDS else kind) / file
        make_folder(own.parent)
        with open(own, "xb") as write:
            if source == lines_file(place, shard) and lines is not None and not source.exists():
                write.writelines(lines.of(shard))
            else:
                with opened(inside(place, name), follow=False) as read:
                    shutil.copyfileobj(read, write)
        if checksum(own) != entry["sha256"]:
            raise InputError(f"differs from its checksum in {DONE}; {_REPAIR}", source=str(source))
    write_json(stage / DONE, done)
    sync_tree(stage)
    sync_folder(folder)
    return Staged(shard=shard, stage=str(stage), images=done["images"], rejected=0, given_up=0, seconds=0.0, bytes=0)
