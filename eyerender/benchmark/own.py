"""Folders of your own images with labels in a table (labels.csv) or as masks (masks/).

    images/a.png, images/b.png, ...      or the images beside labels.csv
    labels.csv                           image,centre_x_px,centre_y_px,semi_axis_a_px,semi_axis_b_px,angle_deg
    masks/a.png, masks/b.png, ...        pixels above 0 are the pupil (its visible part, or all of it)
    hints.json                           what the extractors may know (`hints`); optional

A line without numbers, and an empty mask, say that the image shows no pupil.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..arrays import Bools
from ..errors import InputError
from ..folders.imagefile import read_any_image
from ..folders.imagefolder import DATASET
from ..geometry.ellipse import Ellipse
from ..storage.files import inside, read_text

LABELS, MASKS, IMAGES = "labels.csv", "masks", "images"
COLUMNS = ("centre_x_px", "centre_y_px", "semi_axis_a_px", "semi_axis_b_px", "angle_deg")
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
MAX_IMAGES = 100_000


def is_own(folder: Path) -> bool:
    """Whether a folder holds a person's own images with labels."""
    return not (folder / DATASET).exists() and ((folder / LABELS).is_file() or (folder / MASKS).is_dir())


def own_labels(folder: Path) -> Iterator[tuple[str, Path, Ellipse | None]]:
    """Yield (name, file, pupil or None) of every labelled image.

    Raises:
        InputError: a table or mask cannot be used, or names an image that is not there.
    """
    return _of_table(folder) if (folder / LABELS).is_file() else _of_masks(folder)


def _of_table(folder: Path) -> Iterator[tuple[str, Path, Ellipse | None]]:
    source = str(folder / LABELS)
    lines = csv.DictReader(io.StringIO(read_text(folder / LABELS)))
    missing = sorted({"image", *COLUMNS} - set(lines.fieldnames or ()))
    if missing:
        raise InputError(f"has no column {missing[0]}", source=source)
    for k, line in enumerate(lines):
        where = f"line {k + 2}"
        if k >= MAX_IMAGES:
            raise InputError(f"has more than {MAX_IMAGES} lines", source=source)
        name = line["image"]
        home = folder / IMAGES if (folder / IMAGES).is_dir() and not (name or "").startswith(f"{IMAGES}/") else folder
        path = inside(home, name, source=source, path=where)
        cells = [line[column] for column in COLUMNS]
        yield str(name), path, _ellipse(cells, source, where) if any(cells) else None


def _ellipse(cells: list[str | None], source: str, where: str) -> Ellipse:
    try:
        x, y, a, b, degrees = (float(cell or "") for cell in cells)
    except ValueError:
        raise InputError("needs five numbers, or none", source=source, path=where) from None
    if not (math.isfinite(x + y + a + b + degrees) and 0.0 < b <= a and max(abs(x), abs(y), a) < 1e5):
        raise InputError("is no ellipse; 0 < semi_axis_b_px <= semi_axis_a_px", source=source, path=where)
    return Ellipse(np.array([x, y]), np.array([a, b]), math.radians(degrees))


def _of_masks(folder: Path) -> Iterator[tuple[str, Path, Ellipse | None]]:
    home = folder / IMAGES if (folder / IMAGES).is_dir() else folder
    images = {p.stem: p for p in sorted(home.iterdir()) if p.suffix.lower() in SUFFIXES}
    masks = [p for p in sorted((folder / MASKS).iterdir()) if p.suffix.lower() in SUFFIXES]
    if len(masks) > MAX_IMAGES:
        raise InputError(f"holds more than {MAX_IMAGES} masks", source=str(folder / MASKS))
    for mask in masks:
        if mask.stem not in images:
            raise InputError(f"there is no image {mask.stem} in {home.name}", source=str(mask))
        path = inside(home, images[mask.stem].name, source=str(mask))
        level, _, _ = read_any_image(inside(folder / MASKS, mask.name, source=str(mask)))
        yield path.name, path, _of_mask(level > 0, str(mask))


def _of_mask(mask: Bools, source: str) -> Ellipse | None:
    """Ellipse with the second moments of a mask; each pixel is a square."""
    y, x = np.nonzero(mask)
    if x.size == 0:
        return None
    if x.size < 20:
        raise InputError(f"marks only {x.size} pixels", source=source)
    moments = np.cov(np.stack([x, y])) + np.eye(2) / 12.0
    values, vectors = np.linalg.eigh(moments)
    angle = math.atan2(vectors[1, 1], vectors[0, 1])
    return Ellipse(np.array([x.mean(), y.mean()]), 2.0 * np.sqrt(values[::-1]), angle)
