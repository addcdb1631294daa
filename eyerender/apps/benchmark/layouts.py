"""Read public layouts: OpenEDS (segmentation), COCO and TEyeD, written by other programs or `export-dataset`.

LPW and ExCuSe, which label only centres, are in `centrelabels`.

    SPLIT/images/NAME.png, SPLIT/labels/NAME.npy       OpenEDS 2019: 0 background, 1 sclera, 2 iris, 3 pupil
    annotations/*.json with images and annotations     COCO: the category `pupil`, an instance per image
    VIDEOS/NAME.mp4, ANNOTATIONS/NAME.mp4pupil_eli.txt TEyeD: FRAME;ANGLE;CENTER X;CENTER Y;WIDTH;HEIGHT;

The ellipse of a COCO instance is its `ellipse` (centre x, y, semi-axes a, b, angle in rad) if it has one, as in exports
of this package; otherwise it is fitted to the mask, as for OpenEDS. Frames of a video are unpacked into the cache.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ...base.arrays import Bools
from ...base.errors import InputError
from ...base.storage.files import inside, read_json, read_text
from ...folders.exported import EXPORT, exported_gamma
from ...folders.video import unpacked
from ...optics.ellipse import Ellipse
from .centrelabels import is_excuse, is_lpw, read_excuse, read_lpw
from .glintlabels import TrueGlint
from .own import FEWEST_PIXELS, MAX_IMAGES, SUFFIXES, Labelled, ellipse_of_mask

PUPIL = 3
_ANNOTATIONS_BYTES = 2**30
_MOST_PIXELS = 2**26


def layout_of(folder: Path) -> str | None:
    """Name of the layout that a folder has: openeds, coco, teyed, lpw or excuse, None for any other."""
    if (folder / "VIDEOS").is_dir() and (folder / "ANNOTATIONS").is_dir():
        return "teyed"
    if any((folder / "annotations").glob("*.json")):
        return "coco"
    if any(folder.glob("labels/*.npy")) or any(folder.glob("*/labels/*.npy")):
        return "openeds"
    if is_lpw(folder):
        return "lpw"
    return "excuse" if is_excuse(folder) else None


def read_layout(folder: Path, layout: str) -> Iterator[Labelled]:
    """Yield every labelled image of a folder.

    Raises:
        InputError: a label cannot be used, or names a missing image.
    """
    readers = {"openeds": _openeds, "coco": _coco, "teyed": _teyed, "lpw": read_lpw, "excuse": read_excuse}
    return readers[layout](folder)


def stated_gamma(folder: Path) -> float | None:
    """Return the encoding gamma that an export of this package states; None for other folders.

    Raises:
        InputError: an export states none.
    """
    gamma = exported_gamma(folder)
    if gamma is None and (folder / EXPORT).is_file():
        raise InputError("states no encoding", source=str(folder / EXPORT))
    return gamma


def _openeds(folder: Path) -> Iterator[Labelled]:
    subjects = {}
    if (folder / "files.csv").is_file():
        rows = csv.DictReader(read_text(folder / "files.csv").splitlines())
        subjects = {str(row.get("file")): str(row.get("subject") or "") for row in rows}
    labels = sorted([*folder.glob("labels/*.npy"), *folder.glob("*/labels/*.npy")])
    for label in labels[:MAX_IMAGES]:
        home = label.parent.parent
        name = next((f"{label.stem}{s}" for s in SUFFIXES if (home / "images" / f"{label.stem}{s}").is_file()), None)
        if name is None:
            raise InputError("there is no image of this name in images", source=str(label))
        path = inside(home / "images", name, source=str(label))
        try:
            classes = np.load(label, allow_pickle=False, mmap_mode="r")
        except (OSError, ValueError, EOFError):
            raise InputError("is not an array of NumPy", source=str(label)) from None
        if classes.ndim != 2 or classes.size > _MOST_PIXELS or classes.dtype.kind not in "ui":
            raise InputError("must be an image of whole numbers", source=str(label))
        relative = path.relative_to(folder).as_posix()
        mask = np.asarray(classes) == PUPIL
        # Between closed lids, a few pixels of the pupil may be visible: too few for an outline, and to be found.
        pupil = ellipse_of_mask(mask, str(label)) if np.count_nonzero(mask) >= FEWEST_PIXELS else None
        yield Labelled(name=relative, path=path, pupil=pupil, subject=subjects.get(relative, ""))


def _coco(folder: Path) -> Iterator[Labelled]:
    files = sorted((folder / "annotations").glob("*.json"))
    # Files of keypoints or captions stand beside those of instances, as in the public COCO data.
    for file in [file for file in files if file.name.startswith("instances")] or files:
        data, source = read_json(file, limit=_ANNOTATIONS_BYTES), str(file)
        try:
            categories = {str(c["name"]).lower(): c["id"] for c in data["categories"]}
            marks: dict[Any, list[Mapping[str, Any]]] = {}
            for mark in data["annotations"]:
                marks.setdefault(mark["image_id"], []).append(mark)
            if "pupil" not in categories:
                raise InputError("has no category pupil", source=source)
            for image in data["images"][:MAX_IMAGES]:
                path = _coco_image(folder, file, str(image["file_name"]))
                mine = marks.get(image["id"], [])
                shape = int(image["height"]), int(image["width"])
                found = [m for m in mine if m["category_id"] == categories["pupil"]]
                pupil = _coco_pupil(found, shape, f"{source}: {image['file_name']}")
                glints = tuple(
                    TrueGlint(int(m.get("light", -1)), (float(m["keypoints"][0]), float(m["keypoints"][1])))
                    for m in mine
                    if m["category_id"] == categories.get("glint") and m["keypoints"][2] == 2
                )
                name = path.relative_to(folder).as_posix()
                subject = str(image.get("subject", ""))
                yield Labelled(name=name, path=path, pupil=pupil, glints=glints, subject=subject)
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise InputError(f"is not COCO's ({type(error).__name__}: {error})", source=source) from None


def _coco_image(folder: Path, file: Path, name: str) -> Path:
    """Return the file of an image: beside the annotations' folder, or in a folder named as the split or `images`."""
    split = file.stem.removeprefix("instances_")
    for home in (folder / split, folder / "images", folder):
        if (home / name).is_file():
            return inside(home, name, source=str(file))
    raise InputError(f"there is no image {name}", source=str(file))


def _coco_pupil(marks: list[Mapping[str, Any]], shape: tuple[int, int], source: str) -> Ellipse | None:
    if not marks:
        return None
    if len(marks) > 1:
        raise InputError("has several pupils; the benchmark needs images of one eye", source=source)
    numbers, drawn = marks[0].get("ellipse"), marks[0]["segmentation"]
    if numbers is not None:
        x, y, a, b, angle = (float(v) for v in _ellipse_numbers(numbers))
        return _checked(x, y, a, b, angle, source)
    if shape[0] * shape[1] > _MOST_PIXELS or min(shape) < 1:
        raise InputError("has an impossible size", source=source)
    if isinstance(drawn, dict):
        return ellipse_of_mask(_decoded(drawn["counts"], shape, source), source)
    picture = Image.new("1", shape[::-1])
    for points in drawn:
        ImageDraw.Draw(picture).polygon([float(v) for v in points], fill=1)
    return ellipse_of_mask(np.array(picture, dtype=bool), source)


def _ellipse_numbers(numbers: Any) -> list[float]:
    if isinstance(numbers, Mapping):
        return [*numbers["centre_px"], *numbers["semi_axes_px"], numbers["angle_rad"]]
    return list(numbers)


def _decoded(counts: Any, shape: tuple[int, int], source: str) -> Bools:
    """Decode uncompressed run lengths, column by column, to a mask."""
    if isinstance(counts, str):
        raise InputError("has compressed run lengths, which are not read", source=source)
    runs = np.asarray(counts, dtype=np.int64)
    if np.any(runs < 0) or int(runs.sum()) != shape[0] * shape[1]:
        raise InputError("has run lengths of another size", source=source)
    return np.asarray(np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(shape, order="F"))


def _checked(x: float, y: float, a: float, b: float, angle: float, source: str) -> Ellipse:
    if not (math.isfinite(x + y + a + b + angle) and min(a, b) > 0.0 and max(abs(x), abs(y), a, b) < 1e5):
        raise InputError("has no ellipse", source=source)
    return Ellipse(np.array([x, y]), np.array([a, b]), angle)


def _teyed(folder: Path) -> Iterator[Labelled]:
    subjects = {}
    if (folder / "splits.csv").is_file():
        rows = csv.DictReader(read_text(folder / "splits.csv").splitlines())
        subjects = {str(row.get("video")): str(row.get("subject") or "") for row in rows}
    for video in sorted((folder / "VIDEOS").glob("*.mp4")):
        source = folder / "ANNOTATIONS" / f"{video.name}pupil_eli.txt"
        rows_of_file = read_text(source).splitlines()[1:]
        frames = unpacked(inside(folder / "VIDEOS", video.name, source=str(folder)))
        for number, row in enumerate(rows_of_file[:MAX_IMAGES], start=2):
            try:
                frame, degrees, x, y, width, height = (float(cell) for cell in row.split(";")[:6])
            except ValueError:
                raise InputError("needs six numbers", source=str(source), path=f"line {number}") from None
            if not 1 <= frame <= len(frames):
                raise InputError("names a frame that the video lacks", source=str(source), path=f"line {number}")
            where = f"{source}: line {number}"
            shows = width > 0.0 and height > 0.0
            pupil = _checked(x, y, width / 2, height / 2, math.radians(degrees), where) if shows else None
            path = frames[int(frame) - 1]
            subject = subjects.get(video.name) or video.stem
            yield Labelled(name=f"{video.name}/{int(frame):06d}", path=path, pupil=pupil, subject=subject)
