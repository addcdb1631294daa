"""COCO: SPLIT/*.png and annotations/instances_SPLIT.json, annotations/keypoints_SPLIT.json.

Instances are run-length masks of pupil, iris and sclera. Keypoints are the pupil's centre, the glints and nine
landmarks of each lid from the temple to the nose, of one eye per image: x, y, v with v 2 visible, 1 hidden, 0 none.

`cut` of a pupil or an iris tells whether its visible part touches the edge of the image. Boxes begin at the left and
upper edge of a pixel, and `x` and `y` of keypoints are centres of pixels. `info.sigmas` are for pycocotools, which
knows only those of people by itself:

    evaluation = COCOeval(truth, found, "keypoints")
    evaluation.params.kpt_oks_sigmas = np.array(truth.dataset["info"]["sigmas"])

Each image has its gaze (`line_of_sight`, `optic_axis`, ...), the diameters of its pupil, and `camera`, `camera_name`.
Among the instances, glints are instances of their own with one keypoint each: [x, y, v], v 2 visible, 1 hidden.
"""

from __future__ import annotations

import json
import shutil
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from ...base.arrays import Bools
from ...base.storage.files import write_bytes
from ...folders.imagefile import png_bytes
from ...optics.ellipse import Ellipse
from .gaze import DIRECTIONS, gaze_of, pupil_of
from .item import Item, Items
from .keypoints import SIGMA, box, keypoints, names, sigmas

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
        eye = {"id": 1, "name": "eye", "supercategory": "eye", "keypoints": names(items.lights), "skeleton": []}
        files: dict[str, _Annotations] = {}
        points: dict[str, _Annotations] = {}
        for split in items.splits:
            (out / split).mkdir()
            files[split] = stack.enter_context(_Annotations(items, out, f"instances_{split}", CATEGORIES, [SIGMA]))
            own = _Annotations(items, out, f"keypoints_{split}", [eye], sigmas(items.lights))
            points[split] = stack.enter_context(own)
        terms = {} if items.licence is None else {"license": 1}
        for number, made in enumerate(items.map(partial(_annotated, lights=items.lights)), start=1):
            write_bytes(out / made.split / made.image["file_name"], made.picture, sync=False)
            for annotations in (files, points):
                annotations[made.split].add_image({"id": number, **terms, **made.image})
            for mark in made.marks:
                files[made.split].add_mark(number, mark)
            if made.eye is not None:
                points[made.split].add_mark(number, made.eye)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Annotated:
    """An image with its annotations."""

    split: str  # its split
    picture: bytes  # its file
    image: dict[str, Any]  # its keys without `id`
    marks: list[dict[str, Any]]  # its instances
    eye: dict[str, Any] | None  # its keypoints, if it shows an eye


def _annotated(item: Item, lights: int) -> _Annotated:
    """Encode and annotate an image of a dataset with up to `lights` glints."""
    mask, line = item.mask, item.line
    h, w = mask.shape
    size = {"width": w, "height": h}
    values = item.encoding.of_image(item.bit_depth, item.entry.gamma)
    about = {"subject": line["subject"], **item.camera, **values, **_gaze(line)}
    marks = []
    for value, part in ((1, "sclera"), (2, "iris"), (3, "pupil")):
        inside = mask == value
        if inside.any():
            marks.append(_instance(value, inside, item.ellipse(part) if part != "sclera" else None))
            if part != "sclera":
                marks[-1]["cut"] = line["labels"][part]["visible"]["cut"]
    marks += [_glint(*glint) for glint in item.glints()]
    image = {"file_name": f"{item.name}.png", **size, **about}
    eye = _eye(item, lights)
    return _Annotated(split=item.split, picture=png_bytes(item.encoded), image=image, marks=marks, eye=eye)


def _gaze(line: dict[str, Any]) -> dict[str, Any]:
    """Return an image's gaze keys: unit vectors in the camera's frame, their angles, and the pupil diameters."""
    space = line["labels"]["space"]["camera"]
    return {**{name: space[name] for name in DIRECTIONS}, **gaze_of(line), **pupil_of(line)}


class _Annotations:
    """Writer of annotations/NAME.json: images at once, annotations to a second file until the end."""

    def __init__(
        self, items: Items, out: Path, name: str, categories: list[dict[str, Any]], falloffs: list[float]
    ) -> None:
        self._path = out / "annotations" / f"{name}.json"
        self._beside = self._path.with_suffix(".annotations")
        self._images: IO[str] = open(self._path, "w", encoding="utf-8")  # noqa: SIM115  (closed by __exit__)
        self._marks: IO[str] = open(self._beside, "w+", encoding="utf-8")  # noqa: SIM115
        self._image_count = self._mark_count = 0
        about = {"description": items.name, "version": "1", "sigmas": falloffs}
        head = {
            "info": {**about, "image": items.encoding.to_mapping()},
            "licenses": [] if items.licence is None else [{"id": 1, "name": items.licence}],
            "categories": categories,
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


def _eye(item: Item, lights: int) -> dict[str, Any] | None:
    """Annotation of the eye's keypoints; None where nothing of the eye is in the image."""
    places = keypoints(item, lights)
    found = box(places, item)
    if found is None:
        return None
    return {
        "category_id": 1,
        "keypoints": [value for place in places for value in place],
        "num_keypoints": sum(v > 0 for _, _, v in places),
        "bbox": [found[0] + 0.5, found[1] + 0.5, *found[2:]],  # a pixel's left and upper edge, as of masks
        "area": found[2] * found[3],
        "iscrowd": 0,
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
