"""Parquet: data/SPLIT-00000-of-00001.parquet with one row per image, as the Hugging Face Hub stores datasets.

The columns `image` and `mask` (and `amodal_mask`, `annotated_mask`, `noiseless`, `highlight_mask`,
`lens_reflection_mask` where the dataset has them) hold PNG files. The labels have the columns of the layout csv, in
pixels of the image. `line_json` is the whole line of metadata as JSON text. Load the folder with
`datasets.load_dataset("OUT")`, or upload it unchanged: the head of README.md names columns and splits for the Hub's
viewer.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

from ...base.errors import InputError
from .item import Item, Items
from .table import row_of

IMAGES_A_FILE = 2000
# Writer and readers hold a whole row group in memory.
IMAGES_A_GROUP, BYTES_A_GROUP = 100, 32 * 2**20
_PICTURES = {
    "image": "file_name",
    "mask": "mask_file_name",
    "amodal_mask": "amodal_mask_file_name",
    "annotated_mask": "annotated_mask_file_name",
    "noiseless": "noiseless_file_name",
    "highlight_mask": "highlight_mask_file_name",
    "lens_reflection_mask": "lens_reflection_mask_file_name",
}
_TEXTS = ("__key__", "split", "encoding", "eye", "eye_model", "camera_name", "line_json")
_WHOLE = (
    "sample",
    "subject",
    "sequence_index",
    "camera",
    "bit_depth",
    "source_bit_depth",
    "window_x0_px",
    "window_y0_px",
)
_SIZES = (
    (1e3, "n<1K"),
    (1e4, "1K<n<10K"),
    (1e5, "10K<n<100K"),
    (1e6, "100K<n<1M"),
    (1e7, "1M<n<10M"),
    (1e8, "10M<n<100M"),
)


def write(items: Items, out: Path) -> str:
    """Write data/, and return the head of README.md: YAML that names columns and splits."""
    pa, parquet = libraries("parquet")
    (out / "data").mkdir()
    first = next(iter(items.sample(1)))
    pictures = [name for name, key in _PICTURES.items() if first.line.get(key) is not None]
    types = dict.fromkeys(pictures, "image") | {name: type_of(name) for name in _row(first, items.lights)}
    schema = schema_of(pa, types)
    files: dict[str, _File] = {}
    with ExitStack() as stack:
        for row in items.map(partial(_whole_row, pictures=pictures, lights=items.lights)):
            split = row["split"]
            if split not in files:
                file = _File(parquet, pa, schema, out, split, items.images_by_split[split])
                files[split] = stack.enter_context(file)
            files[split].add(row)
    return _head(items, types, out, {split: file.nbytes for split, file in files.items()})


def libraries(layout: str) -> tuple[Any, Any]:
    """Import pyarrow and pyarrow.parquet; InputError if pyarrow is not installed."""
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        reason = "needs pyarrow (the extra 'parquet'); run: pip install pyarrow"
        raise InputError(reason, source=f"--format {layout}") from None


def _whole_row(item: Item, pictures: list[str], lights: int) -> dict[str, Any]:
    return {**{name: _picture(item, name) for name in pictures}, **_row(item, lights)}


def labels_of(item: Item, lights: int) -> dict[str, Any]:
    """Return the labels of an image as one flat row, without names of files."""
    row = row_of(item, lights)
    del row["file_name"], row["mask_file_name"]
    for k in range(lights):
        row[f"glint{k}_visible"] = bool(row[f"glint{k}_visible"])
    return row


def _row(item: Item, lights: int) -> dict[str, Any]:
    return {**labels_of(item, lights), "line_json": json.dumps(item.exported_line(), sort_keys=True)}


def _picture(item: Item, name: str) -> dict[str, Any] | None:
    data = item.encode(_PICTURES[name])
    return None if data is None else {"bytes": data, "path": f"{item.name}.png"}


def type_of(name: str) -> str:
    """Return the type of a label column in the notation of `datasets`."""
    if name in _TEXTS:
        return "string"
    if name in _WHOLE:
        return "int64"
    return "bool" if name.startswith("glint") and name.endswith("_visible") else "float64"


def schema_of(pa: Any, types: dict[str, str]) -> Any:
    """Return the schema of columns whose types are in the notation of `datasets`."""
    kinds = {
        "image": pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
        "string": pa.string(),
        "int64": pa.int64(),
        "bool": pa.bool_(),
        "float64": pa.float64(),
    }
    # `datasets` reads from this metadata which columns are images.
    features = {
        name: {"_type": "Image"} if kind == "image" else {"dtype": kind, "_type": "Value"}
        for name, kind in types.items()
    }
    metadata = {"huggingface": json.dumps({"info": {"features": features}})}
    return pa.schema([(name, kinds[kind]) for name, kind in types.items()], metadata=metadata)


class _File:
    """Writer of the consecutive files of a split."""

    def __init__(self, parquet: Any, pa: Any, schema: Any, out: Path, split: str, images: int) -> None:
        self._parquet, self._pa, self._schema = parquet, pa, schema
        self._out, self._split, self._files = out, split, -(-images // IMAGES_A_FILE)
        self._writer: Any = None
        self._rows: list[dict[str, Any]] = []
        self._done = self._bytes = 0
        self.nbytes = 0  # of all rows in memory, as `datasets` counts them

    def add(self, row: dict[str, Any]) -> None:
        """Add a row."""
        if self._done % IMAGES_A_FILE == 0:
            self._close()
            name = f"{self._split}-{self._done // IMAGES_A_FILE:05d}-of-{self._files:05d}.parquet"
            place = self._out / "data" / name
            self._writer = self._parquet.ParquetWriter(place, self._schema, compression="zstd", write_page_index=True)
        self._rows.append(row)
        self._done += 1
        self._bytes += sum(len(value["bytes"]) for value in row.values() if isinstance(value, dict))
        if len(self._rows) >= IMAGES_A_GROUP or self._bytes >= BYTES_A_GROUP:
            self._write()

    def _write(self) -> None:
        if self._rows:
            table = self._pa.Table.from_pylist(self._rows, schema=self._schema)
            self._writer.write_table(table)
            self.nbytes += table.nbytes
        self._rows, self._bytes = [], 0

    def _close(self) -> None:
        if self._writer is not None:
            self._write()
            self._writer.close()
            self._writer = None

    def __enter__(self) -> _File:
        return self

    def __exit__(self, kind: object, error: object, at: object) -> None:
        if kind is None:
            self._close()
        elif self._writer is not None:
            self._writer.close()


def _head(items: Items, types: dict[str, str], out: Path, nbytes: dict[str, int]) -> str:
    size = sum(path.stat().st_size for path in (out / "data").iterdir())
    total = len(items)
    data = {
        "pretty_name": items.name,
        **({} if items.licence is None else {"license": items.licence.lower()}),
        "task_categories": ["image-segmentation", "keypoint-detection"],
        "tags": ["eye-tracking", "gaze-estimation", "near-infrared", "synthetic"],
        "size_categories": [next((name for end, name in _SIZES if total < end), "100M<n<1B")],
        "configs": [
            {
                "config_name": "default",
                "data_files": [{"split": name, "path": f"data/{name}-*.parquet"} for name in items.splits],
            }
        ],
        "dataset_info": {
            "features": [{"name": name, "dtype": kind} for name, kind in types.items()],
            "splits": [
                {"name": name, "num_bytes": nbytes[name], "num_examples": count}
                for name, count in items.images_by_split.items()
            ],
            "download_size": size,
            "dataset_size": sum(nbytes.values()),
        },
    }
    return f"---\n{yaml.safe_dump(data, sort_keys=False)}---\n"
