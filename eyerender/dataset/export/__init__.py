"""Exports of generated datasets in the layouts that existing training code reads.

Positions are in pixels of the image (the window), with pixel centres at integers. Images of 8 bits keep the codes that
the camera stored; others get 8 bits and a gamma of 2.2 with one exposure gain for the whole export, unless requested
otherwise (`encoding`). `export.json` and `README.md` state this.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...base.errors import WRONG, InputError, Warn
from ...base.progress import Progress, notify
from ...base.storage.files import write_json, write_text
from ...folders.exported import EXPORT
from ...folders.imagefolder import ImageFolder
from ...folders.outfolder import staged
from ...imaging.gazeseries import SCREEN_PX, check_screen
from ..assemble import verify_dataset
from . import bids, coco, ellseg, film, imagefolder, labels, openeds, parquet, table, teyed, webdataset, yolo
from .card import export_card
from .encoding import SAMPLED, STORED, Curve, Encoding, check, measured_gain
from .item import Item, Items, wrong_labels

# Returns the head of README.md, or None.
Writer = Callable[[Items, Path], str | None]

SCHEMA = "eyerender/export/2"
CARD = "README.md"
FORMATS: dict[str, Writer] = {
    "webdataset": webdataset.write,
    "imagefolder": imagefolder.write,
    "coco": coco.write,
    "yolo-seg": yolo.write_segments,
    "yolo-pose": yolo.write_poses,
    "csv": table.write,
    "parquet": parquet.write,
    "labels": labels.write,
    "openeds": openeds.write,
    "ellseg": ellseg.write,
    "teyed": teyed.write,
    "video": film.write,
    "bids": bids.write,
}
# The other layouts have 8 bits by definition.
_SIXTEEN_BITS = ("webdataset", "imagefolder", "coco", "csv", "parquet", "video")
_ORDERED = {
    **{format: f"the frames of {format} have an order" for format in ("teyed", "video", "bids")},
    "labels": "the rows of labels have the order of the shards",
}
_PICTURELESS = ("labels", "bids")
OF_SEQUENCES = ("video", "bids")  # layouts that need frames of a sequence


def export(
    path: str | Path,
    format: str,
    out: str | Path,
    *,
    bits: int = 8,
    encoding: Curve | None = None,
    gain: float | None = None,
    workers: int = 1,
    shuffle: int | None = None,
    speed: float = 1.0,
    screen_px: tuple[int, int] = SCREEN_PX,
    overwrite: bool = False,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> dict[str, Any]:
    """Write a folder of labelled images in another layout; on an error, nothing is left behind.

    Images of a rendered folder count as those of one subject in the split `train`.

    >>> er.export("out", "coco", "out_coco")  # doctest: +SKIP

    Args:
        path: the folder, written by `render`, `quickstart` or `generate`.
        format: one of `FORMATS`.
        out: the folder to write.
        bits: bits of the images, 8 or 16 (webdataset, imagefolder, coco, csv, parquet and video).
        encoding: `stored` (the codes of the camera), `linear` or `gamma`; by default stored for images of 8 bits
            without a `gain`, else gamma for 8 bits and linear for 16.
        gain: factor for all values of `linear` and `gamma`; by default 1 for 16 bits linear, otherwise measured on a
            sample of the images.
        workers: number of processes that read and encode the images; the bytes do not depend on it.
        shuffle: seed of a random order of the images; by default they are in the order of the samples. It is refused
            for `teyed`, `video`, `bids` and `labels`, which have an order of their own.
        speed: how fast the videos to look at of `video` run, 0.001 to 100; 1 is the speed of the recording.
        screen_px: width and height of the picture on the scene's screen, on which `bids` states the gaze.
        overwrite: replace the contents of `out`.
        progress: called with images done, images in all and "images".
        warn: receives a warning if the pixels of the screen are not square.

    Raises:
        InputError: the layout or encoding is unknown, the folder is of another kind, a checksum is wrong,
            labels differ from what this version writes, or `out` is not empty.
        EyerenderError: `out` cannot be written.
    """
    _check_options(format, bits, encoding, gain, shuffle)
    if workers < 1:
        raise InputError(f"must be >= 1, not {workers}", source="--workers")
    if not 1e-3 <= speed <= 100:
        raise InputError(f"must be 0.001 to 100, not {speed:g}", source="--speed")
    check_screen(screen_px)
    folder = ImageFolder.load(path)
    if format == "labels":
        labels.check_packed(folder)
    for problem in verify_dataset(folder.path) if folder.dataset.get("kind") == "dataset" else ():
        raise InputError(f"{problem}; start generate again on the folder to repair it", source=str(path))
    total = len(folder.entries)

    def step(done: int) -> None:
        notify(progress, done, total, "images")

    step(0)
    items = Items(folder, step, workers=workers, shuffle=shuffle)
    items.speed, items.screen_px, items.warn = speed, screen_px, warn or items.warn
    with staged(out, overwrite=overwrite) as stage, _labels_as_made(items):
        items.survey()
        if format not in _PICTURELESS:
            items.encoding = _encoding(items, bits, encoding, gain)
        head = FORMATS[format](items, stage) or ""
        done = {
            "schema": SCHEMA,
            "format": format,
            "dataset": items.name,
            "images": total,
            "unfinished": bool(folder.unfinished),
            "images_by_split": items.images_by_split,
            "source_bit_depths": sorted(items.bit_depths),
            "image": None if format in _PICTURELESS else items.encoding.to_mapping(items.gammas),
        }
        layout = sys.modules[FORMATS[format].__module__].__doc__ or ""
        write_text(stage / CARD, head + export_card(items.name, done, layout, items.licence), sync=False)
        write_json(stage / EXPORT, done, sync=False)
    return {**done, "path": str(out)}


def _check_options(format: str, bits: int, encoding: Curve | None, gain: float | None, shuffle: int | None) -> None:
    """Check that a layout exists and can be written so; InputError if it cannot."""
    if format not in FORMATS:
        raise InputError(f"must be one of {', '.join(FORMATS)}, not {format!r}", source="--format")
    check(bits, encoding, gain)
    if format in _PICTURELESS:
        for option, given in (("bits", bits != 8), ("encoding", encoding is not None), ("gain", gain is not None)):
            if given:
                raise InputError(f"the layout {format} has no images", source=f"--{option}")
    if bits == 16 and format not in _SIXTEEN_BITS:
        raise InputError(f"the layout {format} holds 8 bits; {', '.join(_SIXTEEN_BITS)} can hold 16", source="--bits")
    if shuffle is not None and format in _ORDERED:
        raise InputError(_ORDERED[format], source="--shuffle")


def _encoding(items: Items, bits: int, asked: Curve | None, gain: float | None) -> Encoding:
    usual: Curve = "stored" if gain is None and max(items.bit_depths) <= 8 else "gamma"
    curve: Curve = asked or ("linear" if bits == 16 else usual)
    if curve == "stored":
        return replace(STORED, bits=bits)
    if gain is not None:
        return Encoding(bits, curve, float(gain), "given")
    if curve == "linear" and bits == 16:
        return replace(STORED, curve="linear")
    measured = measured_gain((item.image, item.bit_depth, item.entry.gamma) for item in items.sample(SAMPLED))
    return Encoding(bits, curve, measured, "measured")


@contextmanager
def _labels_as_made(items: Items) -> Iterator[None]:
    """Turn errors from malformed labels into input errors: somebody changed the metadata."""
    try:
        yield
    except WRONG as error:
        raise wrong_labels(error, items.place) from error


__all__ = ["FORMATS", "Encoding", "Item", "Items", "export"]
