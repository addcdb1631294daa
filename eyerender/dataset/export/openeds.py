"""OpenEDS (semantic segmentation, 2019): SPLIT/images/000000.png (8 bits) and SPLIT/labels/000000.npy.

Labels are uint8: 0 background, 1 sclera, 2 iris, 3 pupil. Garbin et al. (2019), "OpenEDS: Open Eye Dataset".

Where the dataset has masks as people draw them, lids cut the eye and lashes do not, as there; else lashes are
background. Labels of people are ellipses and polygons through some points; these are exact outlines: pupils are no
ellipses, and the caruncle is background.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ...base.arrays import Bytes
from ...base.storage.files import write_bytes
from ...folders.imagefile import png_bytes
from .item import Item, Items


def write(items: Items, out: Path) -> None:
    """Write images and labels of every split; files.csv maps images to their files."""
    counts: dict[str, int] = {}
    for split in items.splits:
        (out / split / "images").mkdir(parents=True)
        (out / split / "labels").mkdir()
    with open(out / "files.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["file", "from", "subject"])
        for split, picture, mask, source, subject in items.map(_files):
            # The names have digits only, because readers strip letters of '.png' off both ends of a name.
            name = f"{counts.get(split, 0):06d}"
            counts[split] = counts.get(split, 0) + 1
            write_bytes(out / split / "images" / f"{name}.png", picture, sync=False)
            np.save(out / split / "labels" / f"{name}.npy", mask)
            table.writerow([f"{split}/images/{name}.png", source, subject])


def _files(item: Item) -> tuple[str, bytes, Bytes, str, int]:
    """Return the split of an image, its file, its mask, its name in the dataset and its subject."""
    return item.split, png_bytes(item.encoded), item.drawn_mask, item.entry.name, item.line["subject"]
