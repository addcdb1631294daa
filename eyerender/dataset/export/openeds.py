"""OpenEDS (semantic segmentation, 2019): SPLIT/images/000000.png (8 bits) and SPLIT/labels/000000.npy.

Labels are uint8: 0 background, 1 sclera, 2 iris, 3 pupil. Garbin et al. (2019), "OpenEDS: Open Eye Dataset".
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ...folders.imagefile import write_png
from .item import Items


def write(items: Items, out: Path) -> None:
    """Write images and labels of every split; files.csv maps images to their files."""
    counts: dict[str, int] = {}
    for split in items.splits:
        (out / split / "images").mkdir(parents=True)
        (out / split / "labels").mkdir()
    with open(out / "files.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["file", "from", "subject"])
        for item in items:
            # The names consist of digits only, because some readers strip the letters of '.png' from both ends of a
            # name.
            name = f"{counts.get(item.split, 0):06d}"
            counts[item.split] = counts.get(item.split, 0) + 1
            write_png(out / item.split / "images" / f"{name}.png", item.encoded)
            np.save(out / item.split / "labels" / f"{name}.npy", item.mask)
            table.writerow([f"{item.split}/images/{name}.png", item.entry.name, item.line["subject"]])
