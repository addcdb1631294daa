"""YOLO (Ultralytics): images/SPLIT/*.png, labels/SPLIT/*.txt and data.yaml; places are shares of the image's size.

yolo-seg: a line `class x1 y1 x2 y2 ...` for each class. Polygons have no holes, so the classes contain each other: 0
eye (all that is visible between the lids), 1 iris with the pupil, 2 pupil. Where lashes or lids part a class, bridges
without width join its parts of more than a few pixels, as Ultralytics' own converter of COCO does.
yolo-pose: one object per image, the eye: `0 x y w h` of its box, then x, y and visibility (2 visible, 1 hidden, 0 none)
of the pupil's centre, the glints and nine landmarks of each lid from the temple to the nose. `flip_idx` renames glints
by the mirrored places of their lamps; without such a symmetry of the rig it is missing, so trainers do not flip images.

Polygons are drawn in by 0.01 px, because Ultralytics cuts off the decimals of corners and fills the border as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy import ndimage
from scipy.spatial import cKDTree

from ...base.arrays import Bools, Floats
from ...base.storage.files import write_bytes
from ...folders.imagefile import png_bytes
from ...scene.parts import IRIS, PUPIL, SCLERA
from .item import Item, Items
from .keypoints import box, keypoints, mirrored_order, names

CLASSES = ("eye", "iris", "pupil")
_FROM = (SCLERA, IRIS, PUPIL)  # the first part of a mask that belongs to each class
_LEAST_PX = 20
_INSET_PX = 0.01
_EDGE = 1e-6  # of shares: their rounding does not lead out of the image
# What the splits are called in data.yaml.
_SPLITS = {"validation": "val", "valid": "val"}


def write_segments(items: Items, out: Path) -> None:
    """Write images and polygons of every split."""
    _write(items, out, _segments, {})


def write_poses(items: Items, out: Path) -> None:
    """Write images and keypoints of every split."""
    points = names(items.lights)
    more = {"kpt_shape": [len(points), 3], "kpt_names": {0: points}}
    if items.mirrored_lamps is not None:
        more["flip_idx"] = mirrored_order(items.mirrored_lamps)
    _write(items, out, partial(_pose, lights=items.lights), more)


def _write(items: Items, out: Path, lines: Callable[[Item], Iterator[str]], more: dict[str, Any]) -> None:
    for split in items.splits:
        (out / "images" / split).mkdir(parents=True)
        (out / "labels" / split).mkdir(parents=True)
    for split, name, picture, text in items.map(partial(_files, lines=lines)):
        write_bytes(out / "images" / split / f"{name}.png", picture, sync=False)
        (out / "labels" / split / f"{name}.txt").write_text(text, encoding="utf-8")
    classes = ("eye",) if more else CLASSES
    data = {**{_SPLITS.get(split, split): f"images/{split}" for split in items.splits}, **more}
    data["names"] = dict(enumerate(classes))
    (out / "data.yaml").write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")


def _files(item: Item, lines: Callable[[Item], Iterator[str]]) -> tuple[str, str, bytes, str]:
    """Return the split of an image, its name, its file and the text of its labels."""
    return item.split, item.name, png_bytes(item.encoded), "".join(f"{line}\n" for line in lines(item))


def _segments(item: Item) -> Iterator[str]:
    mask = item.mask
    for number, first in enumerate(_FROM):
        if parts := polygons(mask >= first):
            yield " ".join([str(number), *_shares(joined(parts), mask.shape)])


def _pose(item: Item, lights: int) -> Iterator[str]:
    places = keypoints(item, lights)
    found = box(places, item)
    if found is None:
        return
    h, w = item.mask.shape
    corner = np.array(found[:2]) + 0.5
    low, high = (np.clip(edge / [w, h], _EDGE, 1 - _EDGE) for edge in (corner, corner + found[2:]))
    text = [f"{n:.6f}" for n in (*(low + high) / 2, *(high - low))]
    for x, y, v in places:
        text += [*_shares(np.array([[x, y]]), (h, w)), str(v)] if v else ["0", "0", "0"]
    yield " ".join(["0", *text])


def _shares(points: Floats, shape: tuple[int, ...]) -> Iterator[str]:
    """Places (n, 2) in pixels, centres at integers, as shares of the image's width and height."""
    shares = np.clip((points + 0.5) / [shape[1], shape[0]], 0.0, 1.0)
    return (f"{number:.6f}" for number in shares.ravel().tolist())


def polygons(inside: Bools) -> list[Floats]:
    """Outline each connected part of a mask as a polygon (n, 2), x and y in pixels; holes are filled."""
    from skimage.measure import find_contours

    parts, _ = ndimage.label(inside)
    out = []
    for number, (rows, columns) in enumerate(ndimage.find_objects(parts), start=1):
        # Lashes leave many parts of a few pixels, so only the box of each is looked at.
        box = parts[rows, columns]
        if box.size <= _LEAST_PX or np.count_nonzero(part := ndimage.binary_fill_holes(box == number)) <= _LEAST_PX:
            continue
        outline = max(find_contours(np.pad(part, 1).astype(float), 0.5), key=len)[:-1] - 1.0  # type: ignore[no-untyped-call]
        y, x = outline.T
        # Points on a straight line between their neighbours are left out.
        turns = (x - np.roll(x, 1)) * (np.roll(y, -1) - y) != (y - np.roll(y, 1)) * (np.roll(x, -1) - x)
        out.append(_drawn_in(outline[turns], part)[:, ::-1] + (columns.start, rows.start))
    return out


def joined(parts: list[Floats]) -> Floats:
    """Join polygons (n, 2) to one that goes to each next part and back, where the two are nearest."""
    out, *left = sorted(parts, key=len, reverse=True)
    while left:
        trees = [cKDTree(part).query(out) for part in left]
        k = int(np.argmin([distance.min() for distance, _ in trees]))
        here = int(np.argmin(trees[k][0]))
        there = np.roll(left.pop(k), -int(trees[k][1][here]), axis=0)
        out = np.concatenate([out[: here + 1], there, there[:1], out[here:]])
    return out


def _drawn_in(polygon: Floats, part: Bools) -> Floats:
    """Move corners (n, 2), rows and columns halfway between two pixels, towards the one in the part."""
    low, high = np.floor(polygon).astype(int), np.ceil(polygon).astype(int)
    padded = np.pad(part, 1)
    inward = np.where(padded[low[:, 0] + 1, low[:, 1] + 1], -_INSET_PX, _INSET_PX)
    return np.asarray(polygon + inward[:, None] * (high - low))
