"""Labels: labels/SHARD.parquet with one row per image, for pictures that stay in the shards of the dataset.

The columns are those of the layout csv, in pixels of the image. `__key__` is the name of the image in the shard's tar,
and the rows have the order of the tar, so that both can be read side by side, as with `webdataset` and `datasets`.
"""

from __future__ import annotations

from functools import partial
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ...base.errors import InputError
from ...folders.imagefolder import ImageFolder
from ...folders.packed import PackedLines
from .item import Item, Items
from .parquet import labels_of, libraries, schema_of, type_of

_ENCODING = ("encoding", "gain", "source_bit_depth")  # of exported pictures


def check_packed(folder: ImageFolder) -> None:
    """Check that a dataset has packed shards; InputError if it has not."""
    if not isinstance(folder.entries.lines, PackedLines):
        raise InputError("is not of the layout webdataset; use csv or parquet", source=str(folder.path))


def write(items: Items, out: Path) -> None:
    """Write one file of labels for each shard of a dataset with packed shards.

    Raises:
        InputError: pyarrow is not installed.
    """
    pa, parquet = libraries("labels")
    (out / "labels").mkdir()
    items.order = np.arange(len(items))
    types = {name: type_of(name) for name in _row(next(iter(items.sample(1))), items.lights)[1]}
    schema = schema_of(pa, types)
    made = items.map(partial(_row, lights=items.lights))
    for shard, rows in groupby(made, key=lambda found: found[0]):
        table = pa.Table.from_pylist([row for _, row in rows], schema=schema)
        parquet.write_table(table, out / "labels" / f"{shard}.parquet", compression="zstd")


def _row(item: Item, lights: int) -> tuple[str, dict[str, Any]]:
    """Return the name of an image's shard, and its labels."""
    row = {"__key__": item.name, **labels_of(item, lights)}
    return PurePosixPath(item.entry.name).parent.name, {key: row[key] for key in row if key not in _ENCODING}
