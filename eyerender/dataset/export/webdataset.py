"""WebDataset: tar files of at most 1000 images per split; NAME.png, NAME.mask.png and NAME.json form a sample.

Where the dataset has them, there are NAME.amodal.png, NAME.as_annotated.png, NAME.highlights.png,
NAME.lens_reflections.png, NAME.noiseless.png, NAME.instances.png, NAME.depth.npz, NAME.normals.npz and
NAME.iris_coordinates.npz, too.
"""

from __future__ import annotations

import json
import tarfile
from contextlib import ExitStack
from pathlib import Path

from ...folders.imagefolder import KINDS
from ..done import picture_file
from ..packing import ENDINGS, add_member
from .item import Item, Items

SAMPLES = 1000
# The order of an image's files.
_KINDS = (
    *("images", "masks", "amodal_masks", "as_annotated", "highlights", "lens_reflections", "instances"),
    *("depth", "normals", "iris_coordinates", "noiseless"),
)


def write(items: Items, out: Path) -> None:
    """Write SPLIT-000000.tar and so on; the metadata in NAME.json states the encoding of its image."""
    counts: dict[str, int] = {}
    tars: dict[str, tarfile.TarFile] = {}
    with ExitStack() as stack:
        for split, files in items.map(_files):
            k = counts.get(split, 0)
            if k % SAMPLES == 0:
                if split in tars:
                    tars[split].close()
                path = out / f"{split}-{k // SAMPLES:06d}.tar"
                tars[split] = stack.enter_context(tarfile.open(path, "w", format=tarfile.USTAR_FORMAT))
            counts[split] = k + 1
            for name, data in files.items():
                add_member(tars[split], name, data)


def _files(item: Item) -> tuple[str, dict[str, bytes]]:
    """Return the split of an image and its files by name."""
    files = {picture_file(kind, f"{item.name}{ENDINGS[kind]}"): item.encode(KINDS[kind]) for kind in _KINDS}
    files[f"{item.name}.json"] = json.dumps(item.exported_line()).encode()
    return item.split, {name: data for name, data in files.items() if data is not None}
