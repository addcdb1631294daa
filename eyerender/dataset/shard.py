"""Shards, which are written to a temporary folder and renamed when complete.

    images/00003/*.png   masks/00003/*.png   shards/00003/lines.jsonl, done.json

`done.json` is put in place last, after everything else is in its place and synced. A shard that has one is therefore
complete, even after a power cut, and its checksums show whether it still is. All other remains of an ended run are
removed.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..folders.imagefile import Writer
from ..folders.imagefolder import DONE, IMAGE_SCHEMA, LINES, SHARDS, STAGE, shard_name, versions
from ..storage.files import (
    MAX_FILE_BYTES,
    inside,
    make_folder,
    read_json,
    remove_file,
    sync_folder,
    sync_tree,
    write_json,
)
from ..versions import package_version
from .maker import MadeImage, Maker

SHARD_SCHEMA = "eyerender/shard/1"
# Kind of image -> key of its file in a line of metadata.
KINDS = {
    "images": "file_name",
    "masks": "mask_file_name",
    "amodal_masks": "amodal_mask_file_name",
    "noiseless": "noiseless_file_name",
    "highlights": "highlight_mask_file_name",
}


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _are(value: object, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(map(fits, value))


def is_sums(value: object) -> bool:
    """Whether a value from a file maps names to sizes and SHA-256, as `compare_sums` requires."""
    return isinstance(value, Mapping) and all(
        isinstance(entry, Mapping) and _is_count(entry.get("bytes")) and isinstance(entry.get("sha256"), str)
        for entry in value.values()
    )


# Test for the value of each key of done.json.
_DONE_KEYS: dict[str, Callable[[Any], bool]] = {
    "shard": _is_count,
    "samples": lambda v: _are(v, _is_count) and len(v) == 2,
    "images": _is_count,
    "images_saturated": lambda v: v is None or _is_count(v),  # older versions did not count saturated images
    "digest": lambda v: isinstance(v, str),
    "versions": lambda v: isinstance(v, Mapping),
    "backend": lambda v: isinstance(v, Mapping) and all(isinstance(v.get(key), str) for key in ("name", "device")),
    "cpu": lambda v: isinstance(v, str),
    "rejections": lambda v: _are(v, lambda entry: isinstance(entry, Mapping)),
    "given_up": lambda v: _are(v, _is_count),
    "files": is_sums,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Staged:
    """A shard that is written but not in place: its folder, and a summary for the log."""

    shard: int
    stage: str
    images: int
    rejected: int
    given_up: int
    seconds: float
    bytes: int  # final size on disk; metadata is stored in the shard and in the assembled file


def write_shard(maker: Maker, folder: Path, shard: int, on_sample: Callable[[int, int], None]) -> Staged:
    """Make a shard's samples in a new temporary folder; `on_sample` is called with counts of samples and images.

    Raises:
        OSError: the disk is full or not writable.
        EyerenderError: the same.
        InputError: a file that the scenes name cannot be used, or has changed since the plan was made.
    """
    start = time.monotonic()
    stage = folder / f"{STAGE}{shard_name(shard)}-{uuid.uuid4().hex[:12]}"
    try:
        maker.plan.check_files()
        samples = maker.plan.spec.shard_samples(shard)
        kinds = maker.plan.spec.labels.pictures
        for kind in kinds:
            (stage / kind).mkdir(parents=True)
        (stage / "shard").mkdir()
        count, saturated, rejections, given_up = 0, 0, [], []
        with open(stage / "shard" / LINES, "w", encoding="utf-8") as lines, Writer() as writer:
            for k, made in enumerate(maker.make_all(samples)):
                rejections += [asdict(r) for r in made.rejections]
                if not made.images:
                    given_up.append(made.index)
                for image in made.images:
                    names = _write_image(writer, stage, shard, image)
                    lines.write(json.dumps({"schema": IMAGE_SCHEMA, **names, **image.line}, allow_nan=False) + "\n")
                count += len(made.images)
                saturated += sum(image.saturated for image in made.images)
                on_sample(k + 1, len(made.images))
        maker.plan.check_files()  # all samples of a shard must use the same files
        seconds = time.monotonic() - start
        files = _checksums(stage, shard, kinds)
        done = {
            "schema": SHARD_SCHEMA,
            "shard": shard,
            "samples": [samples.start, samples.stop],
            "images": count,
            "images_saturated": saturated,
            "digest": maker.plan.digest,
            "versions": run_versions(),
            "backend": maker.backend,
            "cpu": cpu_family(),
            "rejections": rejections,
            "given_up": given_up,
            "seconds": round(seconds, 3),
            "files": files,
        }
        size = sum(entry["bytes"] for entry in files.values()) + files[_place(SHARDS, shard, LINES)]["bytes"]
        write_json(stage / DONE, done, sync=False)
        sync_tree(stage)
    except BaseException:
        shutil.rmtree(stage, ignore_errors=True)
        raise
    return Staged(
        shard=shard,
        stage=str(stage),
        images=count,
        rejected=len(rejections),
        given_up=len(given_up),
        seconds=seconds,
        bytes=size,
    )


def _write_image(writer: Writer, stage: Path, shard: int, image: MadeImage) -> dict[str, str]:
    """Write an image's files and return their names in the dataset."""
    file = f"{image.name}.png"
    for kind, picture in image.pictures.items():
        writer.png(stage / kind / file, picture)
    return {KINDS[kind]: _place(kind, shard, file) for kind in image.pictures}


def commit(folder: Path, staged: Staged) -> None:
    """Put a staged shard in place, done.json last.

    Raises:
        OSError: a file cannot be moved.
    """
    stage, name = Path(staged.stage), shard_name(staged.shard)
    moves = [(stage / kind, folder / kind / name) for kind in KINDS if (stage / kind).is_dir()]
    moves.append((stage / "shard", folder / SHARDS / name))
    for source, place in moves:
        shutil.rmtree(place, ignore_errors=True)  # remains of a run that ended between these renames
        make_folder(place.parent)
        os.rename(source, place)
    for _, place in moves:
        sync_folder(place.parent)
    os.rename(stage / DONE, folder / SHARDS / name / DONE)
    sync_folder(folder / SHARDS / name)
    stage.rmdir()


def is_finished(folder: Path, shard: int) -> bool:
    """Whether a shard has a done.json."""
    return (folder / SHARDS / shard_name(shard) / DONE).is_file()


def read_done(folder: Path, shard: int) -> dict[str, Any]:
    """Read a finished shard's done.json and check the type of every key.

    Raises:
        InputError: it is not valid.
    """
    path = folder / SHARDS / shard_name(shard) / DONE
    data = read_json(path, limit=MAX_FILE_BYTES, follow=False)
    if data.get("schema") != SHARD_SCHEMA:
        raise InputError(f"must have the schema {SHARD_SCHEMA!r}", source=str(path))
    for key, fits in _DONE_KEYS.items():
        if not fits(data.get(key)):
            raise InputError("is missing, or not in the format of this version", source=str(path), path=key)
    return data


def verify(folder: Path, shard: int, digest: str | None = None, *, quick: bool = False) -> Iterator[str]:
    """List what is wrong with a finished shard: its done.json, and the sizes and SHA-256 of its files.

    Args:
        folder: the dataset.
        shard: a finished shard.
        digest: digest of the plan by which the shard must be made; None: any plan.
        quick: compare sizes only.
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
    places = tuple(f"{kind}/{name}/" for kind in (*KINDS, SHARDS))
    if f"{SHARDS}/{name}/{LINES}" not in done["files"] or not all(n.startswith(places) for n in done["files"]):
        yield f"{SHARDS}/{name}/{DONE}: files: do not belong to this shard"
        return
    yield from compare_sums(folder, done["files"], quick=quick)


def compare_sums(folder: Path, sums: Mapping[str, Mapping[str, Any]], *, quick: bool = False) -> Iterator[str]:
    """List files of a folder whose sizes or SHA-256 differ from those given by name; `quick` compares sizes only."""
    for name, entry in sums.items():
        try:
            path = inside(folder, name)
            size = path.stat().st_size
            if size != entry["bytes"]:
                yield f"{name}: has {size} bytes, not {entry['bytes']}"
            elif not quick and checksum(path) != entry["sha256"]:
                yield f"{name}: its checksum differs"
        except InputError as error:
            yield error.reason
        except OSError as error:
            yield f"{name}: cannot be read ({error.strerror or error})"


def withdraw_damaged(folder: Path, shards: Iterable[int], digest: str) -> dict[int, str]:
    """Verify finished shards, and remove the done.json of those that are damaged or of another plan.

    They are then made again.

    Returns:
        The withdrawn shards, with the first problem of each.

    Raises:
        OSError: a done.json cannot be removed.
    """
    damaged = {}
    for shard in shards:
        problem = next(verify(folder, shard, digest), None)
        if problem is not None:
            damaged[shard] = problem
            remove_file(folder / SHARDS / shard_name(shard) / DONE)
    return damaged


def remove_leftovers(folder: Path, mine: set[int], done: set[int]) -> None:
    """Remove what earlier runs left of shards that this run makes."""
    for stage in folder.glob(f"{STAGE}*"):
        number = stage.name.removeprefix(STAGE).split("-")[0]
        if number.isdigit() and int(number) in mine:
            shutil.rmtree(stage, ignore_errors=True)
    for kind in (*KINDS, SHARDS):
        if (folder / kind).is_dir():
            for place in (folder / kind).iterdir():
                if place.name.isdigit() and int(place.name) in mine - done:
                    shutil.rmtree(place, ignore_errors=True)


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sum_of(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    return {"bytes": path.stat().st_size, "sha256": checksum(path)}


def run_versions() -> dict[str, str]:
    """Versions that affect a dataset's bytes."""
    found = versions()
    del found["opencv-python-headless"]  # nothing here uses it
    return {**found, "pillow": package_version("pillow")}


def cpu_family() -> str:
    """Name of the processor, or its architecture."""
    from ..backends.probe import cpu_name

    return cpu_name()


def _place(kind: str, shard: int, file: str) -> str:
    return f"{kind}/{shard_name(shard)}/{file}"


def _checksums(stage: Path, shard: int, kinds: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Map the final name of every file of a staged shard to its size and SHA-256."""
    out = {}
    for kind in kinds:
        for path in sorted((stage / kind).iterdir()):
            out[_place(kind, shard, path.name)] = sum_of(path)
    path = stage / "shard" / LINES
    out[_place(SHARDS, shard, LINES)] = sum_of(path)
    return out
