"""Generated datasets in the layouts that existing training code reads.

Places are in pixels of the image (the window), pixel centres at integers. The images have 8 bits and a gamma of 2.2
with one exposure gain for the whole export, unless asked otherwise (`encoding`); `export.json` and `README.md` say so.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ...errors import InputError
from ...files import write_json, write_text
from ...imagefolder import DATASET, METADATA, ImageFolder
from ...outfolder import staged
from ..assemble import verify_dataset
from ..validation.problems import WRONG
from . import coco, ellseg, openeds, table, teyed, webdataset
from .card import export_card
from .encoding import SAMPLED, Curve, Encoding, check, measured_gain
from .item import Item, Items

Progress = Callable[[int, int, str], None]
Writer = Callable[[Items, Path], None]

SCHEMA = "eyerender/export/2"
EXPORT, CARD = "export.json", "README.md"
FORMATS: dict[str, Writer] = {
    "webdataset": webdataset.write,
    "coco": coco.write,
    "csv": table.write,
    "openeds": openeds.write,
    "ellseg": ellseg.write,
    "teyed": teyed.write,
}
# The others hold 8 bits by definition.
_SIXTEEN_BITS = ("webdataset", "coco", "csv")


def export(
    path: str | Path,
    out: str | Path,
    format: str,
    *,
    bits: int = 8,
    encoding: Curve | None = None,
    gain: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write a generated dataset in another layout; complete or not at all.

    Args:
        path: the dataset's folder.
        out: the folder to write.
        format: one of `FORMATS`.
        bits: of the images, 8 or 16 (webdataset, coco and csv).
        encoding: `linear` or `gamma`; by default gamma for 8 bits, linear for 16.
        gain: multiplies all values; by default it is measured on a sample of the images, but 1 for 16 bits, linear.
        overwrite: replace what `out` holds.
        progress: called with images done, images in all and "".

    Raises:
        InputError: no such layout or encoding, no generated dataset, a file that its checksum does not fit, labels of
            another shape than this version writes, or OUT is taken.
        EyerenderError: OUT cannot be written.
    """
    if format not in FORMATS:
        raise InputError(f"must be one of {', '.join(FORMATS)}, not {format!r}", source="--format")
    check(bits, encoding, gain)
    if bits == 16 and format not in _SIXTEEN_BITS:
        raise InputError(f"the layout {format} holds 8 bits; {', '.join(_SIXTEEN_BITS)} can hold 16", source="--bits")
    folder = ImageFolder.load(path)
    if folder.dataset.get("kind") != "dataset":
        raise InputError("is no generated dataset (no kind: dataset)", source=str(Path(path) / DATASET))
    for problem in verify_dataset(folder.path):
        raise InputError(f"{problem}; start generate again on the folder to repair it", source=str(path))
    total, made = len(folder.entries), 0
    with staged(out, overwrite=overwrite) as stage, _blamed(folder, lambda: made + 1):

        def step(done: int) -> None:
            nonlocal made
            made = done
            if progress is not None:
                progress(done, total, "")

        chosen = _encoding(folder, bits, encoding or ("gamma" if bits == 8 else "linear"), gain)
        items = Items(folder, step, chosen)
        FORMATS[format](items, stage)
        done = {
            "schema": SCHEMA,
            "format": format,
            "dataset": items.name,
            "images": total,
            "images_by_split": items.images_by_split,
            "source_bit_depths": items.bit_depths,
            "image": chosen.to_mapping(),
        }
        layout = sys.modules[FORMATS[format].__module__].__doc__ or ""
        write_text(stage / CARD, export_card(items.name, done, layout, chosen), sync=False)
        write_json(stage / EXPORT, done, sync=False)
    return {**done, "path": str(out)}


@contextmanager
def _blamed(folder: ImageFolder, number: Callable[[], int]) -> Iterator[None]:
    """Labels of another shape than this package writes make a writer fail: say so, and at which image."""
    try:
        yield
    except WRONG as error:
        raise InputError(
            f"image {number()}, in the order of samples, has not the labels it should have "
            f"({type(error).__name__}: {error})",
            source=str(folder.path / METADATA),
        ) from None


def _encoding(folder: ImageFolder, bits: int, curve: Curve, gain: float | None) -> Encoding:
    if gain is not None:
        return Encoding(bits, curve, float(gain), "given")
    raw = Encoding(bits, curve, 1.0, "none")
    if curve == "linear" and bits == 16:
        return raw

    def sample() -> Iterator[tuple[NDArray[Any], int]]:
        total = len(folder.entries)
        for k in range(min(SAMPLED, total)):
            item = Item(folder.entries[k * total // min(SAMPLED, total)], raw)
            yield item.image, item.bit_depth

    return Encoding(bits, curve, measured_gain(sample()), "measured")


__all__ = ["FORMATS", "Encoding", "Item", "Items", "export"]
