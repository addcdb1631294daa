"""Shards: written to a folder of a temporary name, renamed when complete.

    images/00003/*.png   masks/00003/*.png   shards/00003/lines.jsonl, done.json

`shards/00003` is renamed last, so a shard that has one is complete; whatever else a killed run left is removed.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from ..errors import EyerenderError, InputError
from ..imagefile import write_png
from ..imagefolder import IMAGE_SCHEMA, STAGE
from .maker import MadeImage, Maker

SHARD_SCHEMA = "eyerender/shard/1"
DONE, SHARDS = "done.json", "shards"
# Not called metadata.jsonl: loaders of image folders would read it besides the dataset's own.
LINES = "lines.jsonl"
# Kind of picture -> what a line of metadata calls its file.
KINDS = {
    "images": "file_name",
    "masks": "mask_file_name",
    "amodal_masks": "amodal_mask_file_name",
    "noiseless": "noiseless_file_name",
}
# The rooms and modules that a sample's bytes come from.
SHAPING = {
    "analytic", "arrays", "capture", "dataset", "eye", "geometry", "imagefile", "imagefolder", "observation", "optics",
    "backends", "region", "rendering", "rig", "scene", "spec",
}  # fmt: skip


def shard_name(shard: int) -> str:
    """The name of a shard's folders."""
    return f"{shard:05d}"


@dataclass(frozen=True, slots=True)
class Staged:
    """A shard that is written but not in place: its folder, and a summary for the log."""

    shard: int
    stage: str
    images: int
    rejected: int
    given_up: int
    seconds: float


def write_shard(maker: Maker, folder: Path, shard: int, on_sample: Callable[[int, int], None]) -> Staged:
    """Make a shard's samples into a new folder of a temporary name; `on_sample` gets counts of samples and images.

    Raises:
        OSError, EyerenderError: the disk is full or not writable.
        InputError: a file that the scenes name cannot be used, or is not what it was when the plan was made.
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
        count, rejections, given_up = 0, [], []
        with open(stage / "shard" / LINES, "w", encoding="utf-8") as lines:
            for k, index in enumerate(samples):
                made = maker.make(index)
                rejections += [asdict(r) for r in made.rejections]
                if not made.images:
                    given_up.append(index)
                for image in made.images:
                    names = _write_image(stage, shard, image)
                    lines.write(json.dumps({"schema": IMAGE_SCHEMA, **names, **image.line}, allow_nan=False) + "\n")
                count += len(made.images)
                on_sample(k + 1, len(made.images))
        maker.plan.check_files()  # a shard is of one state of them
        seconds = time.monotonic() - start
        done = {
            "schema": SHARD_SCHEMA,
            "shard": shard,
            "samples": [samples.start, samples.stop],
            "images": count,
            "digest": maker.plan.digest,
            "versions": run_versions(),
            "backend": maker.backend,
            "cpu": cpu_family(),
            "rejections": rejections,
            "given_up": given_up,
            "seconds": round(seconds, 3),
            "files": _checksums(stage, shard, kinds),
        }
        with open(stage / "shard" / DONE, "w", encoding="utf-8") as file_:
            file_.write(json.dumps(done, indent=1, allow_nan=False) + "\n")
            file_.flush()
            os.fsync(file_.fileno())
    except BaseException:
        shutil.rmtree(stage, ignore_errors=True)
        raise
    return Staged(shard, str(stage), count, len(rejections), len(given_up), seconds)


def _write_image(stage: Path, shard: int, image: MadeImage) -> dict[str, str]:
    """Write an image's pictures; returns their names in the dataset."""
    file = f"{image.name}.png"
    for kind, picture in image.pictures.items():
        write_png(stage / kind / file, picture)
    return {KINDS[kind]: _place(kind, shard, file) for kind in image.pictures}


def commit(folder: Path, staged: Staged) -> None:
    """Put a staged shard in place."""
    stage, name = Path(staged.stage), shard_name(staged.shard)
    for kind in KINDS:
        if (stage / kind).is_dir():
            place = folder / kind / name
            shutil.rmtree(place, ignore_errors=True)  # of a run killed between these renames
            place.parent.mkdir(exist_ok=True)
            os.rename(stage / kind, place)
    (folder / SHARDS).mkdir(exist_ok=True)
    os.rename(stage / "shard", folder / SHARDS / name)
    stage.rmdir()


def finished(folder: Path) -> set[int]:
    """The shards that are complete."""
    place = folder / SHARDS
    if not place.is_dir():
        return set()
    return {int(p.name) for p in place.iterdir() if p.name.isdigit() and (p / DONE).is_file()}


def read_done(folder: Path, shard: int) -> dict[str, Any]:
    """A finished shard's done.json; raises `InputError` for what is none."""
    path = folder / SHARDS / shard_name(shard) / DONE
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError("is not valid JSON", source=str(path)) from None
    if not isinstance(data, dict) or data.get("schema") != SHARD_SCHEMA:
        raise InputError(f"must have the schema {SHARD_SCHEMA!r}", source=str(path))
    return data


def check_finished(folder: Path, shard: int) -> None:
    """Raise where a finished shard's files are not all there with their sizes; it is never rendered again by itself."""
    for name, entry in read_done(folder, shard)["files"].items():
        path = folder / name
        if not path.is_file() or path.stat().st_size != entry["bytes"]:
            raise EyerenderError(
                f"{path}: missing or cut short in a finished shard; remove "
                f"{folder / SHARDS / shard_name(shard)} to have the shard made again"
            )


def remove_leftovers(folder: Path, mine: set[int], done: set[int]) -> None:
    """Remove what killed runs left of shards that this run is to make."""
    for stage in folder.glob(f"{STAGE}*"):
        number = stage.name.removeprefix(STAGE).split("-")[0]
        if number.isdigit() and int(number) in mine:
            shutil.rmtree(stage, ignore_errors=True)
    for kind in KINDS:
        if (folder / kind).is_dir():
            for place in (folder / kind).iterdir():
                if place.name.isdigit() and int(place.name) in mine - done:
                    shutil.rmtree(place, ignore_errors=True)


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def run_versions() -> dict[str, str]:
    """The versions that a dataset's bytes depend on."""
    from importlib.metadata import PackageNotFoundError, version

    from ..imagefolder import versions

    found = versions()
    found.pop("opencv-python-headless", None)  # nothing here uses it
    found["eyerender_source"] = source_digest()
    try:
        found["pillow"] = version("pillow")
    except PackageNotFoundError:
        found["pillow"] = "unknown"
    return found


@cache
def source_digest() -> str:
    """A short digest of the package's code that shapes a dataset's bytes; it tells versions of a checkout apart."""
    package = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        place = path.relative_to(package)
        if place.parts[0].removesuffix(".py") in SHAPING:
            digest.update(str(place).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def cpu_family() -> str:
    """The processor's name, or its architecture."""
    from ..backends.probe import cpu_name

    return cpu_name()


def _place(kind: str, shard: int, file: str) -> str:
    return f"{kind}/{shard_name(shard)}/{file}"


def _checksums(stage: Path, shard: int, kinds: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Final name -> size and SHA-256 of every file of a staged shard."""
    out = {}
    for kind in kinds:
        for path in sorted((stage / kind).iterdir()):
            out[_place(kind, shard, path.name)] = {"bytes": path.stat().st_size, "sha256": checksum(path)}
    path = stage / "shard" / LINES
    out[_place(SHARDS, shard, LINES)] = {"bytes": path.stat().st_size, "sha256": checksum(path)}
    return out
