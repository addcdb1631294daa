"""Image folder: images/*.png, masks/*.png and metadata.jsonl, as loaders of image folders read them.

Every line has the same keys, and the lines that are the first to fill a column come first. Datasets of files are such a
folder already; packed ones become one. `datasets.load_dataset("imagefolder", data_dir="OUT")` reads it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from ...folders.imagefolder import METADATA
from ...storage.files import write_bytes
from ..columns import type_first
from ..done import KINDS
from .item import Item, Items


def write(items: Items, out: Path) -> None:
    """Write the pictures and metadata.jsonl."""
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
        data = item.entry.data(key) if "mask" in key else item.encode(key)
        if data is not None:
            line[key] = f"{kind}/{item.name}.png"
            files[line[key]] = data
    return json.dumps(line) + "\n", files
