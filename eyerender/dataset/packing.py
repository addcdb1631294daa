"""Pack a finished shard: its images into one tar, its metadata into compressed members (`folders.packed`).

The images of a shard are in a seeded order, so that any part of a tar mixes the shard's subjects. In the tar, the files
of one image share a name with different suffixes, as WebDataset requires: NAME.png, NAME.mask.png, ...
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..base.storage.files import (
    make_folder,
    parse_json,
    read_bytes,
    remove_file,
    sync_folder,
    sync_tree,
    write_bytes,
    write_json,
    written,
)
from ..folders.imagefolder import DONE, KINDS, LINES, SHARDS, shard_name
from ..folders.packed import LINES_GZ, MEMBERS, TAR, pack_lines, read_line, read_member
from .done import FILES, PACKED, sum_of
from .selection import scrambled

ENDINGS = {
    "images": "", "masks": ".mask", "amodal_masks": ".amodal", "noiseless": ".noiseless", "highlights": ".highlights",
    "lens_reflections": ".lens_reflections", "as_annotated": ".as_annotated",
    "depth": ".depth", "normals": ".normals", "iris_coordinates": ".iris_coordinates", "instances": ".instances",
}  # fmt: skip
SHARD = "shard"  # folder of the lines of a partial shard


def pack(stage: Path, done: dict[str, Any], seed: int) -> dict[str, Any]:
    """Pack a complete partial shard; return the new content of its done.json.

    The old files are removed last, so that an interrupted packing can be repeated. Raises OSError or EyerenderError if
    the disk is full or not writable.
    """
    lines = [parse_json(raw) for raw in read_bytes(stage / SHARD / LINES, follow=False).splitlines()]
    samples = np.array([line["sample"] for line in lines], dtype=np.int64)
    lines = [lines[k] for k in np.lexsort((np.arange(len(lines)), scrambled(samples, seed)))]
    with written(stage / SHARD / TAR) as file:
        _write_tar(stage, lines, file)
    text, blocks = pack_lines(lines)
    write_bytes(stage / SHARD / LINES_GZ, text)
    name, splits, counts = shard_name(done["shard"]), sorted({line["split"] for line in lines}), counts_of(lines)
    counts["pupil_semi_axis_px"] = [float(f"{size:.6g}") for size in counts["pupil_semi_axis_px"]]
    packed = {
        **done,
        "schema": PACKED.shard,
        "files": {f"{SHARDS}/{name}/{own}": sum_of(stage / SHARD / own) for own in (TAR, LINES_GZ)},
        "splits": splits,
        "columns": {
            "sample": [line["sample"] for line in lines],
            "subject": [line["subject"] for line in lines],
            "split": [splits.index(line["split"]) for line in lines],
            "block": blocks,
        },
        "counts": counts,
    }
    write_json(stage / DONE, packed)
    remove_file(stage / SHARD / LINES)
    for kind in KINDS:
        shutil.rmtree(stage / kind, ignore_errors=True)
    sync_folder(stage)
    return packed


def unpack(stage: Path, done: dict[str, Any]) -> dict[str, Any]:
    """Turn a packed shard in a stage back into a partial one; return the content of its checkpoint.

    The packed files are removed last, so that an interrupted unpacking can be repeated. Raises InputError or ValueError
    if the shard is damaged; OSError if the disk is full or not writable.
    """
    name = shard_name(done["shard"])
    for own in (TAR, LINES_GZ):
        if sum_of(stage / SHARD / own) != done["files"][f"{SHARDS}/{name}/{own}"]:
            raise ValueError(f"{own}: its checksum differs")
    files, kinds = {}, {key: kind for kind, key in KINDS.items()}
    lines = list(_lines(stage, done))
    for line in lines:
        for key, place in line.pop(MEMBERS).items():
            data = read_member(stage, SHARD, place, source=str(stage), path=key)
            kind, own = kinds[key], PurePosixPath(line[key]).name
            make_folder(stage / kind)
            write_bytes(stage / kind / own, data, sync=False)
            files[f"{kind}/{name}/{own}"] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    text = "".join(json.dumps(line) + "\n" for line in sorted(lines, key=lambda line: int(line["sample"]))).encode()
    write_bytes(stage / SHARD / LINES, text)
    files[f"{SHARDS}/{name}/{LINES}"] = {"bytes": len(text), "sha256": hashlib.sha256(text).hexdigest()}
    kept = {key: value for key, value in done.items() if key not in ("splits", "columns", "counts")}
    partial = {**kept, "schema": FILES.shard, "files": files}
    sync_tree(stage)
    write_json(stage / DONE, partial)
    for own in (TAR, LINES_GZ):
        remove_file(stage / SHARD / own)
    return partial


def _lines(stage: Path, done: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for row, block in enumerate(done["columns"]["block"]):
        yield read_line(stage / SHARD / LINES_GZ, row, block)


def _write_tar(stage: Path, lines: list[dict[str, Any]], file: Any) -> None:
    """Write the images of all lines, and record their offsets in each line."""
    with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for line in lines:
            own = line[MEMBERS] = {}
            for kind, key in KINDS.items():
                if line.get(key) is not None:
                    path = PurePosixPath(line[key])
                    data = read_bytes(stage / kind / path.name, follow=False)
                    own[key] = [tar.offset + tarfile.BLOCKSIZE, len(data)]  # behind the header
                    add_member(tar, f"{path.stem}{ENDINGS[kind]}{path.suffix}", data)


def add_member(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """Write a file into a tar, without times and owners, so that the same files give the same bytes."""
    member = tarfile.TarInfo(name)
    member.size = len(data)
    tar.addfile(member, io.BytesIO(data))
    tar.members.clear()  # type: ignore[attr-defined]  # the library keeps them for reading


def counts_of(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Count what the statistics of a dataset need from lines of metadata."""
    pupils = [line["labels"]["pupil"] for line in lines]
    sizes = [pupil["amodal"]["semi_axes_px"] for pupil in pupils]
    return {
        "pupils_visible": sum(pupil["visible"]["pixels"] > 0 for pupil in pupils),
        "glints_visible": sum(glint["visible"] for line in lines for glint in line["labels"]["glints"]),
        "pupil_semi_axis_px": [axes[0] for axes in sizes if axes is not None],
    }
