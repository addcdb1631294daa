"""Unfinished shards: samples are appended one by one, and checkpoints preserve them when the worker is stopped.

    .partial-00003-<id>/images/*.png   masks/*.png   shard/lines.jsonl   done.json

`done.json` in this folder is the last checkpoint: it has the keys of a finished shard's `done.json` and lists the files
of the samples that are finished. It is written after these files are synced; later samples are made again.

The next worker takes the folder over by renaming it, and writes metadata to a new file. So a worker that hangs and
wakes up after its shard was given to another one does no harm. Where a worker needs only some of the samples of a
folder, or continues a finished shard, it links their files into a folder of its own, and the old one stays.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO, Self

from ..base.errors import WRONG, InputError
from ..base.storage.files import (
    PART,
    inside,
    link_or_copy,
    make_folder,
    opened,
    parse_json,
    remove_file,
    sync_files,
    sync_folder,
    write_json,
)
from ..base.storage.jsonlines import MAX_BYTES
from ..folders.imagefile import Writer
from ..folders.imagefolder import DONE, KINDS, LINES, SHARDS, STAGE, shard_name
from .done import FILES, PACKED, cpu_family, described, picture_file, read_done, read_done_file, run_versions, sum_of
from .environment import rounding
from .maker import MadeSample
from .packing import SHARD, pack, unpack
from .plan import Plan

CHECKPOINT_S = 10.0
"""Time between checkpoints: the most work lost when a worker is killed."""


class PartialShard:
    """A shard in the making; a context manager that resumes the finished samples of an earlier worker."""

    def __init__(self, plan: Plan, backend: dict[str, Any], folder: Path, shard: int) -> None:
        self.plan, self.shard, self.folder = plan, shard, folder
        self.made: set[int] = set()  # numbers of the finished samples, including those that were given up
        self.images = 0  # number of their images
        self._start = self._checkpoint = self._last = time.monotonic()  # of worker, checkpoint and sample
        self._before = 0.0  # seconds of earlier workers
        self._made_by = {"digest": plan.digest, "versions": run_versions(), "backend": backend, "cpu": cpu_family()}
        self._made_by["rounding"] = rounding()
        self._rejections: list[dict[str, Any]] = []
        self._given_up: list[int] = []
        self._saturated: list[int] = []  # the sample of each saturated image
        self._files: dict[str, dict[str, Any]] = {}
        self._new: list[str] = []  # pictures since the last checkpoint
        self._places: list[tuple[int, int, int]] = []  # sample, first byte and length of each line
        self._hash = hashlib.sha256()
        self._size = 0
        self._writer = Writer()
        self.stage = new_stage(folder, shard)
        found = _claimed(folder, shard, self.stage, set(plan.spec.shard_samples(shard)))
        for part in self.stage.rglob(f".*{PART}"):  # a worker was killed while it wrote this file
            remove_file(part)
        if found is not None and found["schema"] == PACKED.shard:
            found = _unpacked(self.stage, found)
        for kind in (*plan.spec.labels.pictures, SHARD):
            make_folder(self.stage / kind)
        self._lines = self._new_lines()
        if found is not None:
            self._resume(found)
        self._publish_lines()
        if found is not None and found["images"] != self.images:
            self.checkpoint()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        """Keep the checkpoint; without one, remove everything."""
        self._writer.__exit__(kind, *rest)
        self._lines.close()
        if kind is not None and not (self.stage / DONE).is_file():
            shutil.rmtree(self.stage, ignore_errors=True)

    def add(self, sample: MadeSample) -> None:
        """Write a sample's images and metadata; make a checkpoint if one is due.

        Raises OSError or EyerenderError if the disk is full or not writable; InputError if a file that the scenes name
        has changed since the plan was made.
        """
        self._rejections += [asdict(r) for r in sample.rejections]
        if not sample.images:
            self._given_up.append(sample.index)
        for image in sample.images:
            files = {kind: picture_file(kind, image.name) for kind in image.pictures}
            for kind, picture in image.pictures.items():
                file = files[kind]
                self._writer.put(self.stage / kind / file, picture)
                self._new.append(f"{kind}/{file}")
            names = {KINDS[kind]: self._place(kind, file) for kind, file in files.items()}
            line = {**image.line, **names}
            self._add_line(sample.index, (json.dumps(line, allow_nan=False) + "\n").encode())
            self._saturated += [sample.index] * image.saturated
        self.made.add(sample.index)
        # The next sample would take about as long as this one and be lost too.
        now, before = time.monotonic(), self._last
        self._last = now
        if now - self._checkpoint + (now - before) > CHECKPOINT_S:
            self.checkpoint()

    def checkpoint(self) -> dict[str, Any]:
        """Make finished samples durable; return the content of done.json. Raises as `add`."""
        self.plan.check_files()  # all samples of a shard must use the same files
        self._writer.flush()
        self._lines.flush()
        sync_files([self.stage / name for name in self._new])
        os.fsync(self._lines.fileno())
        for name in self._new:
            kind, file = name.split("/")
            self._files[self._place(kind, file)] = sum_of(self.stage / name)
        self._new = []
        for kind in (*self.plan.spec.labels.pictures, SHARD, "."):
            sync_folder(self.stage / kind)
        sync_folder(self.folder)
        own = {"bytes": self._size, "sha256": self._hash.hexdigest()}
        samples, chosen = described(self.plan.spec.shard_samples(self.shard))
        done = {
            "schema": FILES.shard,
            "shard": self.shard,
            "samples": samples,
            **({} if chosen is None else {"chosen": chosen}),
            "images": self.images,
            "images_saturated": len(self._saturated),
            **self._made_by,
            "rejections": sorted(self._rejections, key=lambda r: int(r["sample"])),
            "given_up": sorted(self._given_up),
            "saturated": sorted(self._saturated),
            "seconds": round(self.seconds, 3),
            "files": dict(sorted(self._files.items())) | {self._place(SHARDS, LINES): own},
        }
        write_json(self.stage / DONE, done)
        self._checkpoint = time.monotonic()
        return done

    def finish(self) -> dict[str, Any]:
        """Sort the metadata by sample and make a last checkpoint; the shard is then ready to be put in place.

        A packed shard is also packed into its tar; the checkpoint stays until that is complete.
        """
        if self._places != sorted(self._places):
            self._sort_lines()
        done = self.checkpoint()
        return pack(self.stage, done, self.plan.spec.seed) if self.plan.spec.is_packed else done

    @property
    def seconds(self) -> float:
        """Time that all workers spent on the samples, in seconds."""
        return self._before + time.monotonic() - self._start

    def _place(self, kind: str, file: str) -> str:
        return f"{kind}/{shard_name(self.shard)}/{file}"

    def _add_line(self, sample: int, line: bytes) -> None:
        self._lines.write(line)
        self._hash.update(line)
        self._places.append((sample, self._size, len(line)))
        self._size += len(line)
        self.images += 1

    def _new_lines(self) -> BinaryIO:
        """Open a new metadata file, which replaces the old one at the next checkpoint."""
        path = self.stage / SHARD / f"{LINES}.new"
        path.unlink(missing_ok=True)
        return open(path, "xb")

    def _publish_lines(self) -> None:
        self._lines.flush()
        os.fsync(self._lines.fileno())
        os.replace(self.stage / SHARD / f"{LINES}.new", self.stage / SHARD / LINES)

    def _sort_lines(self) -> None:
        self._lines.close()
        places = sorted(self._places)
        self._places, self._hash, self._size, self.images = [], hashlib.sha256(), 0, 0
        with opened(self.stage / SHARD / LINES, limit=MAX_BYTES, follow=False) as file:
            self._lines = self._new_lines()
            for sample, first, length in places:
                file.seek(first)
                self._add_line(sample, file.read(length))
        self._publish_lines()

    def _resume(self, done: dict[str, Any]) -> None:
        """Take over an earlier worker's finished samples if they are intact, of this plan, and of this version."""
        try:
            if any(_comparable(done[key]) != _comparable(value) for key, value in self._made_by.items()):
                raise InputError("was made by another plan, version or processor")
            lines = list(self._intact_lines(done))
            wanted = set(self.plan.spec.shard_samples(self.shard))
            kept = [(line, raw) for line, raw in lines if line["sample"] in wanted]
            names = {str(line[key]) for line, _ in kept for key in KINDS.values() if line[key] is not None}
            self._files = {name: done["files"][name] for name in names}
        except (InputError, OSError, *WRONG):
            kept, done = [], {"rejections": [], "given_up": [], "saturated": [], "seconds": 0.0}
            remove_file(self.stage / DONE)
            wanted = set()
        for line, raw in kept:
            self._add_line(line["sample"], raw)
        self._rejections = [r for r in done["rejections"] if r["sample"] in wanted]
        self._given_up = [k for k in done["given_up"] if k in wanted]
        self._saturated = [k for k in done["saturated"] if k in wanted]
        self._before = float(done["seconds"])
        self.made = {line["sample"] for line, _ in kept} | set(self._given_up)
        for kind in self.plan.spec.labels.pictures:
            for path in (self.stage / kind).iterdir():
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                elif self._place(kind, path.name) not in self._files:
                    path.unlink()

    def _intact_lines(self, done: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], bytes]]:
        """Read the metadata of a checkpoint after comparing its files with their checksums.

        Raises:
            InputError: a file differs.
        """
        own = self._place(SHARDS, LINES)
        for name, entry in done["files"].items():
            kind, _, file = name.split("/")
            if name != own and sum_of(inside(self.stage, f"{kind}/{file}")) != entry:
                raise InputError(f"{name}: its checksum differs")
        with opened(self.stage / SHARD / LINES, follow=False) as file:
            data = file.read(min(done["files"][own]["bytes"], os.fstat(file.fileno()).st_size))
        if hashlib.sha256(data).hexdigest() != done["files"][own]["sha256"]:
            raise InputError("its lines differ")
        for raw in data.splitlines(keepends=True):
            line = parse_json(raw)
            if not isinstance(line["sample"], int):
                raise InputError("has no sample")
            yield line, raw


def checkpoints(folder: Path) -> dict[int, int]:
    """Return the number of finished images of each partial shard of a run."""
    found: dict[int, int] = {}
    for shard, stage in stages(folder):
        with suppress(InputError):
            found[shard] = max(found.get(shard, 0), int(read_done_file(stage / DONE)["images"]))
    return found


def stages(folder: Path) -> Iterator[tuple[int, Path]]:
    """Return the unfinished shards in a folder, with their temporary folders."""
    for stage in sorted(folder.glob(f"{STAGE}*-*")):
        number = stage.name.removeprefix(STAGE).split("-")[0]
        own = (stage, *(stage / name for name in (*KINDS, SHARD, DONE)))
        if number.isdecimal() and stage.is_dir() and not any(map(os.path.islink, own)):
            yield int(number), stage


def new_stage(folder: Path, shard: int) -> Path:
    """Return a new name for the temporary folder of a shard."""
    return folder / f"{STAGE}{shard_name(shard)}-{uuid.uuid4().hex[:12]}"


def places(folder: Path, stage: Path, shard: int) -> list[tuple[Path, Path]]:
    """Return the folders of a shard, each with its place in a temporary folder; that of the lines comes last."""
    name = shard_name(shard)
    return [*((folder / kind / name, stage / kind) for kind in KINDS), (folder / SHARDS / name, stage / SHARD)]


def samples_in(done: Mapping[str, Any]) -> set[int]:
    """Return the numbers of the samples that a done.json or a checkpoint holds, with those that were given up.

    Raises:
        InputError: its files have other names than those that this package gives.
    """
    try:
        packed = done.get("columns")
        names = (name.rpartition("/")[2] for name in done["files"] if name.startswith("images/"))
        own = packed["sample"] if packed else (int(name.partition("-")[0]) for name in names)
        return {*own, *done["given_up"]}
    except WRONG as error:
        raise InputError(f"does not name its samples ({type(error).__name__}: {error})", source=DONE) from None


def set_aside(folder: Path, shard: int) -> None:
    """Turn a finished shard back into a partial one, which `PartialShard` can continue with more or fewer samples.

    If the process is killed between the moves, `take_back` completes them. Raises OSError if a file cannot be moved.
    """
    stage = new_stage(folder, shard)
    stage.mkdir()
    os.rename(folder / SHARDS / shard_name(shard) / DONE, stage / DONE)
    for place, own in places(folder, stage, shard):
        if place.is_dir():  # packed shards have no folders of pictures
            os.rename(place, own)
            sync_folder(place.parent)
    sync_folder(stage)
    sync_folder(folder)


def take_back(folder: Path, shards: Iterable[int]) -> None:
    """Move files of shards whose run was killed while putting them in place back into the partial shard.

    Raises:
        OSError: a file cannot be moved.
    """
    wanted = set(shards)
    for shard, stage in stages(folder):
        if shard in wanted and (stage / DONE).is_file():
            for place, own in places(folder, stage, shard):
                if place.is_dir() and not own.exists():
                    os.rename(place, own)


def remove_stages(folder: Path, shards: Iterable[int], finished: set[int]) -> None:
    """Remove temporary folders of some shards, except checkpoints that later workers can continue.

    Of a finished shard those stay that hold further samples: the dataset was larger before.
    """
    own = set(shards)
    for shard, stage in stages(folder):
        if shard in own and not _is_needed(stage, folder, shard if shard in finished else None):
            shutil.rmtree(stage, ignore_errors=True)


def _is_needed(stage: Path, folder: Path, shard: int | None) -> bool:
    """Return whether a checkpoint holds samples that the finished shard lacks."""
    try:
        own = samples_in(read_done_file(stage / DONE))
        return shard is None or not own <= samples_in(read_done(folder, shard))
    except InputError:
        return shard is None and (stage / DONE).is_file()


def _claimed(folder: Path, shard: int, stage: Path, wanted: set[int]) -> dict[str, Any] | None:
    """Take over the checkpoint or the finished shard with the most wanted samples; None if there is none.

    A checkpoint of wanted samples alone is renamed to `stage`. The files of others are linked into it.
    """
    found = []
    finished = folder / SHARDS / shard_name(shard)
    for file in (*(place / DONE for number, place in stages(folder) if number == shard), finished / DONE):
        with suppress(InputError):
            done = read_done_file(file)
            found.append((len(samples_in(done) & wanted), done, file.parent))
    for _, done, place in sorted(found, key=lambda one: -one[0]):
        with suppress(OSError):
            if place != finished and samples_in(done) <= wanted:
                os.rename(place, stage)
                return done
            for own, new in places(folder, stage, shard):
                source = own if place == finished else place / new.name
                if source.is_dir():
                    make_folder(new)
                    for file in source.iterdir():
                        if file.name != DONE:
                            link_or_copy(file, new / file.name)
            link_or_copy(place / DONE, stage / DONE)
            return done
    return None


def _unpacked(stage: Path, done: dict[str, Any]) -> dict[str, Any] | None:
    """Unpack a packed shard to continue it; remove it if it is damaged, but keep it if only the disk is full."""
    try:
        return unpack(stage, done)
    except (InputError, FileNotFoundError, *WRONG):
        shutil.rmtree(stage, ignore_errors=True)
        return None


def _comparable(value: Any) -> Any:
    """Return the content of done.json without entries that affect no byte."""
    ignored = ("threads", "python")
    return {k: v for k, v in value.items() if k not in ignored} if isinstance(value, Mapping) else value
