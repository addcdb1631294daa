"""Generated datasets in the layouts that existing training code reads.

Places are in pixels of the image (the window), pixel centres at integers. Where a layout wants 8 bits, the linear
values are scaled by 255 / full scale and rounded; no gamma is applied.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...imagefolder import DATASET, ImageFolder, staged
from . import coco, ellseg, openeds, table, teyed, webdataset
from .item import Item, Items

Progress = Callable[[int, int, str], None]
Writer = Callable[[Items, Path], None]

FORMATS: dict[str, Writer] = {
    "webdataset": webdataset.write,
    "coco": coco.write,
    "csv": table.write,
    "openeds": openeds.write,
    "ellseg": ellseg.write,
    "teyed": teyed.write,
}


def export(
    path: str | Path, out: str | Path, format: str, *, overwrite: bool = False, progress: Progress | None = None
) -> dict[str, Any]:
    """Write a generated dataset in another layout; complete or not at all.

    Raises:
        InputError: no such layout, no generated dataset, or OUT is taken.
        EyerenderError: OUT cannot be written.
    """
    if format not in FORMATS:
        raise InputError(f"must be one of {', '.join(FORMATS)}, not {format!r}", source="--format")
    folder = ImageFolder.load(path)
    if folder.dataset.get("kind") != "dataset":
        raise InputError("is no generated dataset (no kind: dataset)", source=str(Path(path) / DATASET))
    total = len(folder.entries)
    with staged(out, overwrite=overwrite) as stage:

        def step(done: int) -> None:
            if progress is not None:
                progress(done, total, "")

        FORMATS[format](Items(folder, step), stage)
    return {"schema": "eyerender/export/1", "format": format, "path": str(out), "images": total}


__all__ = ["FORMATS", "Item", "Items", "export"]
