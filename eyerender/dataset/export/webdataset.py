"""WebDataset: tar files of at most 1000 images per split; NAME.png, NAME.mask.png and NAME.json form a sample.

Where the dataset has them, there are NAME.amodal.png, NAME.highlights.png, NAME.noiseless.png, NAME.instances.png,
NAME.depth.npy, NAME.normals.npy and NAME.iris_coordinates.npy, too.
"""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

from .item import Item, Items

SAMPLES = 1000
_AS_THEY_ARE = {
    ".mask.png": "mask_file_name",
    ".amodal.png": "amodal_mask_file_name",
    ".highlights.png": "highlight_mask_file_name",
    ".instances.png": "instance_mask_file_name",
    ".depth.npy": "depth_file_name",
    ".normals.npy": "normals_file_name",
    ".iris_coordinates.npy": "iris_coordinates_file_name",
}


def write(items: Items, out: Path) -> None:
    """Write SPLIT-000000.tar and so on; the metadata in NAME.json states the encoding of its image."""
    counts: dict[str, int] = {}
    tars: dict[str, tarfile.TarFile] = {}
    try:
        for split, files in items.map(_files):
            k = counts.get(split, 0)
            if k % SAMPLES == 0:
                if split in tars:
                    tars[split].close()
                tars[split] = _open(out / f"{split}-{k // SAMPLES:06d}.tar")
            counts[split] = k + 1
            for name, data in files.items():
                _add(tars[split], name, data)
    finally:
        for tar in tars.values():
            tar.close()


def _files(item: Item) -> tuple[str, dict[str, bytes]]:
    """Return the split of an image and its files by name."""
    files = {".png": item.encode()}
    files |= {ending: item.entry.data(key) for ending, key in _AS_THEY_ARE.items()}
    files[".noiseless.png"] = item.encode("noiseless_file_name")
    files[".json"] = json.dumps(item.exported_line()).encode()
    return item.split, {f"{item.name}{ending}": data for ending, data in files.items() if data is not None}


def _open(path: Path) -> tarfile.TarFile:
    return tarfile.open(path, "w", format=tarfile.USTAR_FORMAT)


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)  # no times or owners: the same dataset gives the same bytes
    member.size = len(data)
    tar.addfile(member, io.BytesIO(data))
    tar.members.clear()  # type: ignore[attr-defined]  # the library keeps them for reading
