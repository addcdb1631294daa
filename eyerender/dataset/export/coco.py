"""COCO: SPLIT/*.png (8 bits) and annotations/instances_SPLIT.json; pupil, iris and sclera as run-length masks.

Glints are instances of their own with one keypoint each: [x, y, v], v 2 visible, 1 hidden.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...files import write_json
from ...geometry.ellipse import Ellipse
from ...imagefile import write_png
from .item import Items

# A category's id is the part's value in the mask, but for the glints.
CATEGORIES: list[dict[str, Any]] = [
    {"id": 1, "name": "sclera", "supercategory": "eye"},
    {"id": 2, "name": "iris", "supercategory": "eye"},
    {"id": 3, "name": "pupil", "supercategory": "eye"},
    {"id": 4, "name": "glint", "supercategory": "eye", "keypoints": ["glint"], "skeleton": []},
]


def write(items: Items, out: Path) -> None:
    """Images and annotations of every split."""
    (out / "annotations").mkdir()
    images: dict[str, list[dict[str, Any]]] = {split: [] for split in items.splits}
    marks: dict[str, list[dict[str, Any]]] = {split: [] for split in items.splits}
    for split in items.splits:
        (out / split).mkdir()
    for number, item in enumerate(items, start=1):
        mask, line = item.mask, item.line
        write_png(out / item.split / f"{item.name}.png", item.encoded)
        h, w = mask.shape
        images[item.split].append(
            {"id": number, "file_name": f"{item.name}.png", "width": w, "height": h, "subject": line["subject"]}
        )
        found = marks[item.split]
        for value, part in ((1, "sclera"), (2, "iris"), (3, "pupil")):
            inside = mask == value
            if inside.any():
                ellipse = item.ellipse(part) if part != "sclera" else None
                found.append(_instance(len(found) + 1, number, value, inside, ellipse))
        for light, x, y, visible in item.glints():
            found.append(
                {
                    "id": len(found) + 1,
                    "image_id": number,
                    "category_id": 4,
                    "keypoints": [x, y, 2 if visible else 1],
                    "num_keypoints": 1,
                    "bbox": [x - 1, y - 1, 3.0, 3.0],
                    "area": 9.0,
                    "iscrowd": 0,
                    "segmentation": [[x - 1, y - 1, x + 2, y - 1, x + 2, y + 2, x - 1, y + 2]],
                    "light": light,
                }
            )
    for split in items.splits:
        write_json(
            out / "annotations" / f"instances_{split}.json",
            {
                "info": {"description": items.name, "version": "1"},
                "licenses": [],
                "categories": CATEGORIES,
                "images": images[split],
                "annotations": marks[split],
            },
        )


def run_lengths(inside: NDArray[np.bool_]) -> list[int]:
    """COCO's uncompressed run lengths: down the columns, starting with zeros."""
    flat = inside.ravel(order="F")
    edges = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    return [0, *runs] if flat[0] else runs


def _instance(
    number: int, image: int, category: int, inside: NDArray[np.bool_], ellipse: Ellipse | None
) -> dict[str, Any]:
    v, u = np.nonzero(inside)
    box = [int(u.min()), int(v.min()), int(u.max() - u.min() + 1), int(v.max() - v.min() + 1)]
    return {
        "id": number,
        "image_id": image,
        "category_id": category,
        "segmentation": {"size": list(inside.shape), "counts": run_lengths(inside)},
        "area": len(u),
        "bbox": box,
        "iscrowd": 0,
        "ellipse": None if ellipse is None else _ellipse(ellipse),
    }


def _ellipse(ellipse: Ellipse) -> list[float]:
    """Centre, semi-axes and angle of the amodal outline."""
    return [*ellipse.centre_px.tolist(), *ellipse.semi_axes_px.tolist(), ellipse.angle_rad]
