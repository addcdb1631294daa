"""COCO: SPLIT/*.png (8 bits) and annotations/instances_SPLIT.json; pupil, iris and sclera as run-length masks.

Each image has its gaze (`line_of_sight`, `optic_axis`, ...) and the diameters of its pupil.
Glints are instances of their own with one keypoint each: [x, y, v], v 2 visible, 1 hidden.
"""

from __future__ import annotations

import json
import shutil
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from ...arrays import Bools
from ...folders.imagefile import png_bytes
from ...geometry.ellipse import Ellipse
from ...storage.files import write_bytes
from .gaze import DIRECTIONS, gaze_of, pupil_of
from .item import Item, Items

# Except for the glints, a category's id is the part's value in the mask.
CATEGORIES: list[dict[str, Any]] = [
    {"id": 1, "name": "sclera", "supercategory": "eye"},
    {"id": 2, "name": "iris", "supercategory": "eye"},
    {"id": 3, "name": "pupil", "supercategory": "eye"},
    {"id": 4, "name": "glint", "supercategory": "eye", "keypoints": ["glint"], "skeleton": []},
]


def write(items: Items, out: Path) -> None:
    """Write images and annotations of every split."""
    (out / "annotations").mkdir()
    with ExitStack() as stack:
        files = {split: stack.enter_context(_Annotations(items, out, split)) for split in items.splits}
        for number, (split, picture, image, marks) in enumerate(items.map(_annotated), start=1):
            write_bytes(out / split / image["file_name"], picture, sync=False)
            files[split].add_image({"id": number, **image})
            for mark in marks:
                files[split].add_mark(number, mark)


def _annotated(item: Item) -> tuple[str, bytes, dict[str, Any], list[dict[str, Any]]]:
    """Return the split of an image, its file, its keys and its annotations."""
    mask, line = item.mask, item.line
    h, w = mask.shape
    size = {"width": w, "height": h}
    image = {"file_name": f"{item.name}.png", **size, "subject": line["subject"], **_gaze(line)}
    marks = []
    for value, part in ((1, "sclera"), (2, "iris"), (3, "pupil")):
        inside = mask == value
        if inside.any():
            marks.append(_instance(value, inside, item.ellipse(part) if part != "sclera" else None))
    marks += [_glint(*glint) for glint in item.glints()]
    return item.split, png_bytes(item.encoded), image, marks


def _gaze(line: dict[str, Any]) -> dict[str, Any]:
    """List keys of an image: unit vectors in the camera's frame, their angles, and the diameters of the pupil."""
    space = line["labels"]["space"]["camera"]
    return {**{name: space[name] for name in DIRECTIONS}, **gaze_of(line), **pupil_of(line)}


class _Annotations:
    """Writer of annotations/instances_SPLIT.json: images at once, annotations to a second file until the end."""

    def __init__(self, items: Items, out: Path, split: str) -> None:
        (out / split).mkdir()
        self._path = out / "annotations" / f"instances_{split}.json"
        self._beside = self._path.with_suffix(".annotations")
        self._images: IO[str] = open(self._path, "w", encoding="utf-8")  # noqa: SIM115  (closed by __exit__)
        self._marks: IO[str] = open(self._beside, "w+", encoding="utf-8")  # noqa: SIM115
        self._image_count = self._mark_count = 0
        head = {
            "info": {"description": items.name, "version": "1", "image": items.encoding.to_mapping()},
            "licenses": [] if items.licence is None else [{"id": 1, "name": items.licence}],
            "categories": CATEGORIES,
        }
        self._images.write(json.dumps(head)[:-1] + ', "images": [')

    def add_image(self, image: dict[str, Any]) -> None:
        """Add an image."""
        self._image_count = _append(self._images, self._image_count, image)

    def add_mark(self, image: int, mark: dict[str, Any]) -> None:
        """Add an annotation of an image."""
        mark = {"id": self._mark_count + 1, "image_id": image, **mark}
        self._mark_count = _append(self._marks, self._mark_count, mark)

    def __enter__(self) -> _Annotations:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._images, self._marks:
            if error is None:
                self._images.write('\n], "annotations": [')
                self._marks.seek(0)
                shutil.copyfileobj(self._marks, self._images)
                self._images.write("\n]}\n")
        self._beside.unlink()


def _append(file: IO[str], count: int, value: dict[str, Any]) -> int:
    file.write((",\n" if count else "\n") + json.dumps(value, allow_nan=False))
    return count + 1


def run_lengths(inside: Bools) -> list[int]:
    """Return COCO's uncompressed run lengths: down the columns, starting with zeros."""
    flat = inside.ravel(order="F")
    edges = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    return [0, *runs] if flat[0] else runs


def _instance(category: int, inside: Bools, ellipse: Ellipse | None) -> dict[str, Any]:
    v, u = np.nonzero(inside)
    box = [int(u.min()), int(v.min()), int(u.max() - u.min() + 1), int(v.max() - v.min() + 1)]
    return {
        "category_id": category,
        "segmentation": {"size": list(inside.shape), "counts": run_lengths(inside)},
        "area": len(u),
        "bbox": box,
        "iscrowd": 0,
        "ellipse": None if ellipse is None else ellipse.numbers(),
    }


def _glint(light: int, x: float, y: float, visible: bool) -> dict[str, Any]:
    return {
        "category_id": 4,
        "keypoints": [x, y, 2 if visible else 1],
        "num_keypoints": 1,
        "bbox": [x - 1, y - 1, 3.0, 3.0],
        "area": 9.0,
        "iscrowd": 0,
        "segmentation": [[x - 1, y - 1, x + 2, y - 1, x + 2, y + 2, x - 1, y + 2]],
        "light": light,
    }
