"""The identity of a run in its folder: run.json, and the refusal of another run with a list of differences."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..base.errors import InputError
from ..base.progress import Say
from ..base.storage.files import PART, read_json, remove_file, remove_parts, write_json
from ..base.storage.lock import LOCK
from ..folders.imagefolder import DATASET, KINDS, LOG, METADATA, RUN, SHARDS, STAGE, finished
from ..folders.outfolder import MARKER, clear
from ..folders.packed import INDEX
from .assemble import CARD, FAILURES
from .croissant import CROISSANT
from .done import FILES, PACKED, read_done, run_versions
from .environment import environment, rounding
from .lines import restore_lines
from .plan import Plan
from .spec import DatasetSpec

MAX_SHARDS, MAX_CHOICES = 1_000_000, 100_000_000

_OWN = {RUN, LOG, SHARDS, *KINDS, METADATA, INDEX, FAILURES, CARD, CROISSANT, DATASET}
_ELSE = "choose another folder or give --overwrite"
_SHOWN = 4


def refuse_taken(folder: Path) -> None:
    """Check that a folder holds nothing but a run, before anything is written into it.

    Symbolic links among a run's files are refused too: making or removing shards would change their targets. Raises
    InputError if the folder holds something else.
    """
    try:
        link = next(_links(folder), None)
        taken = folder.is_dir() and link is None and _is_taken(folder)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", source=str(folder)) from None
    if link is not None:
        raise InputError(f"{link}: is a symbolic link; {_ELSE}", source=str(folder))
    if taken:
        raise InputError("is not empty; choose another folder or give --overwrite", source=str(folder))


def check_work(spec: DatasetSpec, folder: Path) -> None:
    """Check that the shards of a run that somebody else made can be listed quickly.

    Raises:
        InputError: there are too many, or too many samples to choose from.
    """
    shards, choices = (
        -(-max(spec.planned_count, spec.count) // spec.shard_size),
        spec.count if spec.selection.spread else 0,
    )
    if shards > MAX_SHARDS or choices > MAX_CHOICES:
        reason = f"is too large: at most {MAX_SHARDS} shards, or {MAX_CHOICES} samples of subjects in turn, are listed"
        raise InputError(reason, source=str(folder / RUN), path="spec.count")


def begin(folder: Path, plan: Plan, repaired: Say) -> bool:
    """Claim a folder for a plan; return True if it was claimed for the same plan before.

    If run.json is damaged or missing, the finished shards identify the plan, because each names it. If nothing
    identifies it and the folder holds only files of a run, the run starts over. `repaired` is called in both cases. The
    caller must hold the folder's final lock, so that two parts of a run do not repair it at the same time. Raises
    InputError if the folder holds something else, or a run of another spec or other versions; OSError if the disk is
    full or not writable.
    """
    path, mine = folder / RUN, _content(plan)
    found, reason = _read(path)
    if found is not None:
        _refuse_another(folder, found, mine, plan.files)
        if _count_of(found) != _count_of(mine):
            restore_lines(folder)  # without dataset.json they are read from there
            remove_file(folder / DATASET)  # it belongs to another number of samples
            # Shards that were made for another number of samples are looked for until the dataset is assembled.
            write_json(path, {**mine, "resized": True})
        return True
    refuse_taken(folder)
    remove_parts(path)
    shards = list(_readable(folder))
    same = [done for done in shards if done["digest"] == plan.digest]
    if shards and not same:
        raise InputError(f"holds a run of another spec, whose {RUN} is damaged; {_ELSE}", source=str(folder))
    if same:
        # The other shards belong to another plan; resuming detects that and makes them again.
        _refuse_another(folder, {**mine, "versions": same[0]["versions"]}, mine, plan.files)
        write_json(path, mine)
        repaired(f"{RUN} is rewritten: {reason}")
        return True
    names = {p.name for p in folder.iterdir() if not p.name.startswith(LOCK)}
    clear(folder, known=True)
    write_json(path, mine)
    if names & _OWN:
        repaired(f"the run starts over: {RUN}: {reason}, and no shard is finished")
    return False


def refuse_another_count(folder: Path, plan: Plan) -> None:
    """Check that no other run has changed the folder's number of samples in the meantime.

    Raises:
        InputError: another run has changed it.
    """
    found, _ = _read(folder / RUN)
    if found is not None and _count_of(found) != _count_of(plan.to_mapping()):
        raise InputError("another run has changed the number of samples", source=str(folder))


def _content(plan: Plan) -> dict[str, Any]:
    """Return the content of run.json."""
    made_with = {"versions": run_versions(), "environment": environment(), "rounding": rounding()}
    layout = PACKED if plan.spec.is_packed else FILES
    return {"schema": layout.run, "digest": plan.digest, **plan.to_mapping(), **made_with}


def settle(folder: Path, plan: Plan) -> None:
    """Record that all shards match the plan's number of samples; the caller holds the folder's final lock."""
    if was_resized(folder):
        write_json(folder / RUN, _content(plan))


def was_resized(folder: Path) -> bool:
    """Return whether a run had another number of samples, from which finished shards may remain."""
    found, _ = _read(folder / RUN)
    return found is None or bool(found.get("resized"))


def _count_of(run: Mapping[str, Any]) -> tuple[Any, ...]:
    spec = run.get("spec")
    return tuple(spec.get(key) for key in ("count", "planned", "choice")) if isinstance(spec, Mapping) else ()


def _of_any_count(run: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the content of run.json without the number of samples and without entries that affect no byte."""
    run = {key: value for key, value in run.items() if key not in ("resized", "environment", "rounding")}
    spec = run.get("spec")
    if not isinstance(spec, Mapping):
        return run
    kept = {key: value for key, value in spec.items() if key not in ("count", "choice")}
    return {**run, "spec": {**kept, "planned": spec.get("planned") or spec.get("count")}}


def _read(path: Path) -> tuple[dict[str, Any] | None, str]:
    """Read run.json; if it cannot be used, return None and the reason.

    Raises:
        InputError: a run of another version wrote it.
    """
    try:
        found = read_json(path, follow=False)
    except InputError as error:
        return None, error.reason
    if found.get("schema") not in (FILES.run, PACKED.run):
        raise InputError("does not describe a run of this version", source=str(path))
    return found, ""


def _refuse_another(folder: Path, found: Mapping[str, Any], mine: Mapping[str, Any], files: Mapping[str, str]) -> None:
    """Raise an error that lists the differences if a folder belongs to another spec or other versions."""
    # Python's own version affects no byte and may differ between machines.
    skip = ("versions.python:", "digest:", "files.", "files:")
    old_plan, plan = _of_any_count(found), _of_any_count(json.loads(json.dumps(mine)))
    changes = [c for c in differences(old_plan, plan) if not c.startswith(skip)]
    old = found.get("files")
    old = old if isinstance(old, Mapping) else {}
    changes = [f"{name}: other content" for name, content in files.items() if old.get(name) != content] + changes
    if changes:
        more = f"; and {len(changes) - _SHOWN} more" if len(changes) > _SHOWN else ""
        raise InputError(
            f"holds a run of another spec or version; {_ELSE} ({'; '.join(changes[:_SHOWN])}{more})", source=str(folder)
        )


def _readable(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the content of every readable done.json."""
    for shard in sorted(finished(folder)):
        with suppress(InputError):
            yield read_done(folder, shard)


def _is_taken(folder: Path) -> bool:
    """Return whether a folder holds anything foreign, or only files that do not identify a run."""
    if _read(folder / RUN)[0] is not None or any(_readable(folder)):
        return False
    names = {p.name for p in folder.iterdir() if not _is_passing(p.name)}
    if names - _OWN:
        return True
    for kind in {*KINDS, SHARDS} & names:
        place = folder / kind
        if place.is_symlink() or not all(p.name.isdigit() for p in place.iterdir()):
            return True
    if names <= {RUN}:
        return False
    # A run has a log and shards from its start, and assembles the dataset when all shards are finished.
    return not names & {LOG, SHARDS} or (RUN not in names and bool(names & {METADATA, DATASET}))


def _links(folder: Path) -> Iterator[str]:
    """Return the symbolic links among a run's files."""
    for name in sorted(_OWN):
        place = folder / name
        if place.is_symlink():
            yield name
        elif name in {*KINDS, SHARDS} and place.is_dir():
            with os.scandir(place) as entries:
                yield from (f"{name}/{entry.name}" for entry in entries if entry.is_symlink())


def _is_passing(name: str) -> bool:
    """Return whether a name is that of a temporary file.

    Temporary files are locks, staged shards, unfinished files of this package, and the marker of a folder that is being
    cleared.
    """
    if name == MARKER or name.startswith((LOCK, STAGE)):
        return True
    return name.endswith(PART) and any(name.startswith(f".{own}.") for own in (*_OWN, MARKER))


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """Describe the differences of two JSON values as `path: old -> new`."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in [*old, *(k for k in new if k not in old)]:
            yield from differences(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from differences(a, b, f"{path}.{k}")
    elif old != new:
        yield f"{path}: {_short(old)} -> {_short(new)}"


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
