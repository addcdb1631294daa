"""Output folders of commands: who writes, what may be replaced, and how a result is published.

A folder is staged and moved into place when complete, so an interrupted run, or one that runs out of disk space, leaves
nothing that looks like a result.

`--overwrite` replaces what this package made and nothing else. A folder is recognised by dataset.json, run.json,
study.json, sweep.json or results.json with our schema, or by the marker file, which lists what was written. Files that
neither have a known name nor are listed belong to somebody else; then nothing is replaced.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Set
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..base.errors import EyerenderError, InputError
from ..base.storage.files import (
    is_plain,
    make_folder,
    read_json,
    remove_file,
    shown,
    sync_folder,
    sync_tree,
    write_json,
)
from ..base.storage.lock import LOCK, writer_lock
from .imagefolder import DATASET, KINDS, RUN, STAGE

FOLDER_SCHEMA = "eyerender/folder/1"
MARKER = ".eyerender.json"
# Files that identify a folder, and how their schemas begin; a finished shard's done.json identifies it too.
_SIGNS = {
    MARKER: FOLDER_SCHEMA,
    DATASET: "eyerender/dataset/",
    RUN: "eyerender/run/",
    "study.json": "eyerender/study/",
    "sweep.json": "eyerender/sweep/",
    "results.json": "eyerender/bench-",
}
_SIGN_BYTES = 2**30
_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp", ".exr", ".hdr")
_KINDS = "|".join(KINDS)
_FOLDERS = re.compile(rf"(images/)?(({_KINDS}|shards)(/[0-9]+)?)|images|layouts")
_FILES = re.compile(
    r"(images/)?("  # a study's images are a dataset in their own folder
    r"(dataset|run|croissant)\.json|(metadata|failures|log)\.jsonl|README\.md|report\.html|"
    rf"({_KINDS})/([0-9]+/)?[^/]+\.(png|exr|npz)|"
    r"shards/[0-9]+/(lines\.jsonl|lines\.jsonl\.gz|images\.tar|done\.json)|index\.npy)"
    r"|(study|summary|findings|results|times)\.json|(summary|findings|waterfall|leds|who|results)\.csv|\.eyerender\.json"
)
# Names of files that are being written, with their final names.
_PARTS = re.compile(r"(?P<folder>(?:.*/)?)(?:\.(?P<hidden>[^/]+)\.[0-9a-f]{8}|(?P<plain>[^/]+))\.part")
_STAGES = re.compile(rf"{re.escape(STAGE)}([0-9]+|[0-9]+-[0-9a-f]+)")


def refuse_non_empty(path: str | Path, overwrite: bool) -> None:
    """Check that an output folder may be used.

    With `overwrite`, a folder is refused if this package did not make it or if it contains anything else. Raises
    InputError if the folder holds something that must not be replaced.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise InputError("exists and is not a folder", source=str(path))
    try:
        busy = folder.is_dir() and any(not p.name.startswith((STAGE, LOCK)) for p in folder.iterdir())
        if not busy:
            return
        if not overwrite:
            raise InputError("is not empty; choose another folder or give --overwrite", source=str(path))
        known = _listed(folder)
        if known is None:
            raise InputError("was not made by this package, so it is not overwritten", source=str(path))
        _refuse_others(folder, known)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", source=str(path)) from None


def has_own_name(folder: Path, file: Path) -> bool:
    """Return whether a file below a folder has a name of this package, is listed as made by it, or is a picture."""
    return file.suffix.lower() in _PICTURES or _is_ours(
        file.relative_to(folder).as_posix(), False, _listed(folder) or set()
    )


def clear(folder: Path, *, known: bool = False) -> None:
    """Remove everything that this package made in a folder, and remains of killed runs; locks stay.

    dataset.json is removed first, so that a partial dataset does not look complete. The marker is removed last, so that
    an interrupted removal can be repeated. Nothing is removed if something else is found. `known` says that the folder
    belongs to a run, even if its identifying files are damaged. Raises InputError as `refuse_non_empty` with
    `overwrite`; OSError if something cannot be removed.
    """
    if known:
        _refuse_others(folder, _listed(folder) or set())
    else:
        refuse_non_empty(folder, True)
    listed = _listed(folder) or set()
    mark(folder, listed)
    _empty(folder, listed)
    (folder / MARKER).unlink()


@contextmanager
def staged(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary folder inside `path`; its content is moved into place only if the block succeeds.

    `dataset.json` moves last, so a folder that has one is complete, even after a power cut: everything is synced before
    it moves. A folder that no other file identifies gets the marker. Remains of an earlier, killed run are removed.
    Raises InputError if the folder is not empty, or another writer uses it; EyerenderError if the disk is full or not
    writable; nothing is left behind.
    """
    final = Path(path)
    refuse_non_empty(final, overwrite)
    stage = final / f"{STAGE}{os.getpid()}"
    created = False
    try:
        created = make_folder(final)
        with writer_lock(final):
            try:
                refuse_non_empty(final, overwrite)  # again, now that nobody else writes
                _remove_stages(final)
                stage.mkdir()
                yield stage
                _publish(stage, final)
            finally:
                shutil.rmtree(stage, ignore_errors=True)
    except InputError:
        raise
    except EyerenderError as error:  # the user knows the folder, but not the temporary one inside
        raise type(error)(str(error).replace(str(stage), str(final))) from None
    except OSError as error:
        raise EyerenderError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        if created:
            with suppress(OSError):
                final.rmdir()  # only where it is empty


def _publish(stage: Path, final: Path) -> None:
    """Replace the content of a folder by that of a staged folder.

    If that fails, files that were already moved are removed again, so that nothing looks like a result. The old content
    stays as long as none of it has been removed.
    """
    sync_tree(stage)
    new = _names(stage)
    old = _listed(final) or set()
    is_whole = any(True for _ in _made_here(final, old, strict=False))  # the old content, if there is any
    try:
        # From here on the folder is identifiable at every moment.
        mark(final, old | new)
        is_whole = False
        _empty(final, old, keep=stage.name)
        for entry in sorted(stage.iterdir(), key=lambda p: p.name == DATASET):
            if entry.name == DATASET:
                sync_folder(final)
            os.rename(entry, final / entry.name)
        sync_folder(final)
        if not new.isdisjoint(_SIGNS):  # its own files identify it
            (final / MARKER).unlink()
        else:
            mark(final, new)
    except BaseException:
        if not is_whole:
            with suppress(OSError):
                _empty(final, old | new)
                (final / MARKER).unlink(missing_ok=True)
        raise


def mark(folder: Path, names: Set[str]) -> None:
    """Write the marker of a folder, which lists what this package makes there."""
    write_json(folder / MARKER, {"schema": FOLDER_SCHEMA, "files": sorted(names)})


def _listed(folder: Path) -> set[str] | None:
    """Read a folder's marker: empty if another file identifies the folder as made here, None if nothing does.

    Names of folders end with a slash.
    """
    marked = _read_sign(folder / MARKER, FOLDER_SCHEMA)
    if marked is not None:
        names = marked.get("files")
        good = names if isinstance(names, list) else []
        return {n for n in good if isinstance(n, str) and is_plain(n.removesuffix("/"))}
    signs = [(folder / name, schema) for name, schema in _SIGNS.items()]
    signs += [(path, "eyerender/shard/") for path in (folder / "shards").glob("[0-9]*/done.json")]
    return set() if any(_read_sign(path, schema) is not None for path, schema in signs) else None


def _read_sign(path: Path, schema: str) -> dict[str, Any] | None:
    try:
        found = read_json(path, limit=_SIGN_BYTES, follow=False)
    except InputError:
        return None
    return found if str(found.get("schema")).startswith(schema) else None


def _made_here(folder: Path, listed: Set[str], *, strict: bool) -> Iterator[tuple[str, bool]]:
    """Yield each file and folder that this package made, by name; a folder comes after its content.

    With `strict`, anything else raises `InputError`; otherwise it is skipped.
    """

    def walk(prefix: str) -> Iterator[tuple[str, bool]]:
        with os.scandir(folder / prefix) as found:
            entries = list(found)  # they may be removed on the way
        for entry in entries:
            name = prefix + entry.name
            is_folder = entry.is_dir(follow_symlinks=False)
            plain = is_folder or entry.is_file(follow_symlinks=False)
            if entry.name.startswith(LOCK) and not is_folder and plain:
                if prefix:
                    yield name, False
            elif is_folder and _STAGES.fullmatch(entry.name):
                continue
            elif plain and _is_ours(name, is_folder, listed):
                if is_folder:
                    yield from walk(f"{name}/")
                yield name, is_folder
            elif strict:
                raise InputError(
                    f"holds {shown(name)}, which this package did not make, so it is not overwritten",
                    source=str(folder),
                )

    return walk("")


def _is_ours(name: str, is_folder: bool, listed: Set[str]) -> bool:
    """Return whether a file or folder has a name that this package gives, or is listed as made by it."""
    if is_folder:
        return f"{name}/" in listed or _FOLDERS.fullmatch(name) is not None
    part = _PARTS.fullmatch(name)
    if part:
        name = part["folder"] + (part["hidden"] or part["plain"])
    return name in listed or _FILES.fullmatch(name) is not None


def _refuse_others(folder: Path, listed: Set[str]) -> None:
    for _ in _made_here(folder, listed, strict=True):
        pass


def _empty(folder: Path, listed: Set[str], keep: str = "") -> None:
    """Remove what this package made, except the marker, and temporary folders, except `keep`."""
    remove_file(folder / DATASET)
    for name, is_folder in _made_here(folder, listed, strict=False):
        if is_folder:
            _remove_stages(folder / name)
            with suppress(OSError):
                (folder / name).rmdir()  # something else may have been put in it by now
        elif name != MARKER:
            (folder / name).unlink(missing_ok=True)
    _remove_stages(folder, keep)


def _remove_stages(folder: Path, keep: str = "") -> None:
    for place in list(folder.iterdir()):
        if _STAGES.fullmatch(place.name) and place.name != keep and not place.is_symlink():
            shutil.rmtree(place, ignore_errors=True)


def _names(folder: Path) -> set[str]:
    """Yield everything in a folder, relative to it; names of folders end with a slash."""
    out = set()
    for place, folders, files in os.walk(folder):
        prefix = "" if Path(place) == folder else f"{Path(place).relative_to(folder).as_posix()}/"
        out |= {f"{prefix}{name}/" for name in folders} | {prefix + name for name in files}
    return out
