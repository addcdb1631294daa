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
from ..folders.imagefolder import DONE, LINES, SHARDS, shard_name
from ..folders.packed import LINES_GZ, MEMBERS, TAR, pack_lines, read_line
from .done import KINDS, PACKED_SHARD_SCHEMA, SHARD_SCHEMA, sum_of
from .interleaving import scrambled

ENDINGS = {
    "images": "", "masks": ".mask", "amodal_masks": ".amodal", "noiseless": ".noiseless", "highlights": ".highlights",
    "depth": ".depth", "normals": ".normals", "iris_coordinates": ".iris_coordinates", "instances": ".instances",
}  # fmt: skip
_SHARD = "shard"  # folder of the lines of a partial shard


def pack(stage: Path, done: dict[str, Any], seed: int) -> dict[str, Any]:
    """Pack a complete partial shard; return the new content of its done.json.

    The old files are removed last, so that an interrupted packing can be repeated.

    Raises:
        OSError: the disk is full or not writable.
        EyerenderError: the same.
    """
    lines = [parse_json(raw) for raw in read_bytes(stage / _SHARD / LINES).splitlines()]
    samples = np.array([line["sample"] for line in lines], dtype=np.int64)
    lines = [lines[k] for k in np.lexsort((np.arange(len(lines)), scrambled(samples, seed)))]
    with written(stage / _SHARD / TAR) as file:
        _write_tar(stage, lines, file)
    text, blocks = pack_lines(lines)
    write_bytes(stage / _SHARD / LINES_GZ, text)
    name, splits = shard_name(done["shard"]), sorted({line["split"] for line in lines})
    packed = {
        **done,
        "schema": PACKED_SHARD_SCHEMA,
        "files": {f"{SHARDS}/{name}/{own}": sum_of(stage / _SHARD / own) for own in (TAR, LINES_GZ)},
        "splits": splits,
        "columns": {
            "sample": [line["sample"] for line in lines],
            "subject": [line["subject"] for line in lines],
            "split": [splits.index(line["split"]) for line in lines],
            "block": blocks,
        },
        "counts": _counts(lines),
    }
    write_json(stage / DONE, packed)
    remove_file(stage / _SHARD / LINES)
    for kind in KINDS:
        shutil.rmtree(stage / kind, ignore_errors=True)
    sync_folder(stage)
    return packed


def unpack(stage: Path, done: dict[str, Any]) -> dict[str, Any]:
    """Turn a packed shard in a stage back into a partial one; return the content of its checkpoint.

    The packed files are removed last, so that an interrupted unpacking can be repeated.

    Raises:
        InputError: the shard is damaged.
        ValueError: the same.
        OSError: the disk is full or not writable.
    """
    name = shard_name(done["shard"])
    for own in (TAR, LINES_GZ):
        if sum_of(stage / _SHARD / own) != done["files"][f"{SHARDS}/{name}/{own}"]:
            raise ValueError(f"{own}: its checksum differs")
    files = {}
    with open(stage / _SHARD / TAR, "rb") as tar:
        lines = list(_lines(stage, done))
        for line in lines:
            for key, (first, size) in line.pop(MEMBERS).items():
                kind = next(kind for kind, own in KINDS.items() if own == key)
                tar.seek(first)
                data, own = tar.read(size), PurePosixPath(line[key]).name
                make_folder(stage / kind)
                write_bytes(stage / kind / own, data, sync=False)
                files[f"{kind}/{name}/{own}"] = {"bytes": size, "sha256": hashlib.sha256(data).hexdigest()}
    text = "".join(json.dumps(line) + "\n" for line in sorted(lines, key=lambda line: int(line["sample"]))).encode()
    write_bytes(stage / _SHARD / LINES, text)
    files[f"{SHARDS}/{name}/{LINES}"] = {"bytes": len(text), "sha256": hashlib.sha256(text).hexdigest()}
    kept = {key: value for key, value in done.items() if key not in ("splits", "columns", "counts")}
    partial = {**kept, "schema": SHARD_SCHEMA, "files": files}
    sync_tree(stage)
    write_json(stage / DONE, partial)
    for own in (TAR, LINES_GZ):
        remove_file(stage / _SHARD / own)
    return partial


def _lines(stage: Path, done: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for row, block in enumerate(done["columns"]["block"]):
        yield read_line(stage / _SHARD / LINES_GZ, row, block)


def _write_tar(stage: Path, lines: list[dict[str, Any]], file: Any) -> None:
    """Write the images of all lines, and record their offsets in each line."""
    with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for line in lines:
            own = line[MEMBERS] = {}
            for kind, key in KINDS.items():
                if line.get(key) is None:
                    continue
                path = PurePosixPath(line[key])
                data = read_bytes(stage / kind / path.name)
                member = tarfile.TarInfo(f"{path.stem}{ENDINGS[kind]}{path.suffix}")  # no times or owners
                member.size = len(data)
                own[key] = [tar.offset + tarfile.BLOCKSIZE, len(data)]  # behind the header
                tar.addfile(member, io.BytesIO(data))
                tar.members.clear()  # type: ignore[attr-defined]  # the library keeps them for reading


def _counts(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Count what the statistics of the dataset need from the shard's metadata."""
    pupils = [line["labels"]["pupil"] for line in lines]
    sizes = [pupil["amodal"]["semi_axes_px"][0] for pupil in pupils if pupil["amodal"]["semi_axes_px"] is not None]
    return {
        "pupils_visible": sum(pupil["visible"]["pixels"] > 0 for pupil in pupils),
        "glints_visible": sum(glint["visible"] for line in lines for glint in line["labels"]["glints"]),
        "pupil_semi_axis_px": [float(f"{size:.6g}") for size in sizes],
    }
