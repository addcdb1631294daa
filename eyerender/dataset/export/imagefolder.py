"""Image folder: images/*.png, masks/*.png and metadata.jsonl, for loaders of image folders.

Every line of metadata has the same keys, and the first lines fill every column. Datasets of files already have this
layout; packed ones are unpacked. `datasets.load_dataset("imagefolder", data_dir="OUT")` reads it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from ...base.storage.files import write_bytes
from ...folders.imagefolder import KINDS, METADATA
from ..assemble import type_first
from ..done import picture_file
from .item import Item, Items


def write(items: Items, out: Path) -> None:
    """Write the images and metadata.jsonl."""
    unsorted = out / f"{METADATA}.unsorted"
    with open(unsorted, "w", encoding="utf-8") as file:
        for text, files in items.map(_files):
            for name, data in files.items():
                (out / name).parent.mkdir(exist_ok=True)
                write_bytes(out / name, data, sync=False)
            file.write(text)

    def lines() -> Iterator[str]:
        with open(unsorted, encoding="utf-8") as file:
            yield from file

    with open(out / METADATA, "w", encoding="utf-8") as file:
        file.writelines(type_first(lines, lambda _line: None))
    unsorted.unlink()


def _files(item: Item) -> tuple[str, dict[str, bytes]]:
    """Return the line of an image and its files by name."""
    line, files = item.exported_line(), {}
    for kind, key in KINDS.items():
        data = item.encode(key)
        if data is not None:
            line[key] = f"{kind}/{picture_file(kind, item.name)}"
            files[line[key]] = data
    return json.dumps(line) + "\n", files
