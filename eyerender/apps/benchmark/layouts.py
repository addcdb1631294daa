"""Read public layouts, written by other programs or `export-dataset`.

    SPLIT/images/NAME.png, SPLIT/labels/NAME.npy       OpenEDS 2019: 0 background, 1 sclera, 2 iris, 3 pupil
    annotations/*.json with images and annotations     COCO: the category `pupil`, an instance per image
    VIDEOS/NAME.mp4, ANNOTATIONS/NAME.mp4pupil_eli.txt TEyeD: FRAME;ANGLE;CENTER X;CENTER Y;WIDTH;HEIGHT;
    SUBJECT/N.avi, SUBJECT/N.txt                       LPW: a line `x y` per frame, the pupil's centre
    NAME.txt, NAME/IMAGE.png                           ExCuSe and ElSe: a heading, then `index image x y`, where `image`
                                                       is the number in the file's name, and the centre is at twice the
                                                       image's size and with y upward from its lower edge

The ellipse of a COCO instance is its `ellipse` (centre x, y, semi-axes a, b, angle in rad) if it has one, as in exports
of this package; otherwise it is fitted to the mask, as for OpenEDS. Frames of a video are unpacked into the cache. A
centre outside of the frame means that nobody labelled it, so it is left out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ...base.arrays import Bools
from ...base.errors import WRONG, InputError
from ...base.storage.arrays import mapped_array
from ...base.storage.files import inside, is_plain, read_json, read_table, read_text
from ...folders.exported import EXPORT, exported_gamma
from ...folders.video import unpacked
from ...optics.ellipse import Ellipse
from .glintlabels import TrueGlint
from .labelled import BenchImage
from .own import FEWEST_PIXELS, MAX_IMAGES, SUFFIXES, ellipse_of_mask

PUPIL = 3
_ANNOTATIONS_BYTES = 2**30
_MOST_PIXELS = 2**26
_EXCUSE_SCALE = 2.0  # the labels were made on images of twice the size
Reader = Callable[[Path], Iterator[BenchImage]]


def reader_of(folder: Path) -> Reader | None:
    """Return the reader of the layout that a folder has; None for any other.

    The reader yields every labelled image. It raises `InputError` if a label cannot be used, or names a missing image.
    """
    if (folder / "VIDEOS").is_dir() and (folder / "ANNOTATIONS").is_dir():
        return _teyed
    if any((folder / "annotations").glob("*.json")):
        return _coco
    if _openeds_labels(folder):
        return _openeds
    if _lpw_videos(folder):
        return _lpw
    return _excuse if _excuse_tables(folder) else None


def stated_gamma(folder: Path) -> float | None:
    """Return the encoding gamma that an export of this package states; None for other folders.

    Raises:
        InputError: an export states none.
    """
    gamma = exported_gamma(folder)
    if gamma is None and (folder / EXPORT).is_file():
        raise InputError("states no encoding", source=str(folder / EXPORT))
    return gamma


def _openeds_labels(folder: Path) -> list[Path]:
    return sorted([*folder.glob("labels/*.npy"), *folder.glob("*/labels/*.npy")])


def _openeds(folder: Path) -> Iterator[BenchImage]:
    subjects = _subjects(folder / "files.csv", "file")
    for label in _openeds_labels(folder)[:MAX_IMAGES]:
        home = label.parent.parent
        name = next((f"{label.stem}{s}" for s in SUFFIXES if (home / "images" / f"{label.stem}{s}").is_file()), None)
        if name is None:
            raise InputError("there is no image of this name in images", source=str(label))
        path = inside(home / "images", name, source=str(label))
        classes = mapped_array(inside(folder, label.relative_to(folder).as_posix(), source=str(label)))
        if classes.ndim != 2 or classes.size > _MOST_PIXELS or classes.dtype.kind not in "ui":
            raise InputError("must be an image of whole numbers", source=str(label))
        relative = path.relative_to(folder).as_posix()
        mask = np.asarray(classes) == PUPIL
        # Between closed lids, a few pixels of the pupil may be visible: too few for an outline, and to be found.
        pupil = ellipse_of_mask(mask, str(label)) if np.count_nonzero(mask) >= FEWEST_PIXELS else None
        yield BenchImage.read(relative, path, pupil, subject=subjects.get(relative, ""))


def _subjects(table: Path, key: str) -> dict[str, str]:
    """Read the subject of every file from a table of an export; empty without the table."""
    if not table.is_file():
        return {}
    return {str(row.get(key)): row.get("subject", "") for row in read_table(table, follow=False)}


def _coco(folder: Path) -> Iterator[BenchImage]:
    files = sorted((folder / "annotations").glob("*.json"))
    # Files of keypoints or captions stand beside those of instances, as in the public COCO data.
    for file in [file for file in files if file.name.startswith("instances")] or files:
        data, source = read_json(file, limit=_ANNOTATIONS_BYTES, follow=False), str(file)
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
                yield BenchImage.read(name, path, pupil, glints=glints, subject=subject)
        except WRONG as error:
            raise InputError(f"is not COCO's ({type(error).__name__}: {error})", source=source) from None


def _coco_image(folder: Path, file: Path, name: str) -> Path:
    """Return the file of an image: beside the annotations' folder, or in a folder named as the split or `images`."""
    split = file.stem.removeprefix("instances_")
    for home in (folder / split, folder / "images", folder):
        if is_plain(name) and os.path.isfile(home / name):
            return inside(home, name, source=str(file))
    raise InputError(f"there is no image {name}", source=str(file))


def _coco_pupil(marks: list[Mapping[str, Any]], shape: tuple[int, int], source: str) -> Ellipse | None:
    if not marks:
        return None
    if len(marks) > 1:
        raise InputError("has several pupils; the benchmark needs images of one eye", source=source)
    numbers, drawn = marks[0].get("ellipse"), marks[0]["segmentation"]
    if numbers is not None:
        x, y, a, b, angle = (float(v) for v in _listed(numbers))
        return _ellipse(x, y, a, b, angle, source)
    if shape[0] * shape[1] > _MOST_PIXELS or min(shape) < 1:
        raise InputError("has an impossible size", source=source)
    if isinstance(drawn, dict):
        return ellipse_of_mask(_decoded(drawn["counts"], shape, source), source)
    picture = Image.new("1", shape[::-1])
    for points in drawn:
        ImageDraw.Draw(picture).polygon([float(v) for v in points], fill=1)
    return ellipse_of_mask(np.array(picture, dtype=bool), source)


def _listed(numbers: Any) -> list[float]:
    if isinstance(numbers, Mapping):
        return [*numbers["centre_px"], *numbers["semi_axes_px"], numbers["angle_rad"]]
    return list(numbers)


def _decoded(counts: Any, shape: tuple[int, int], source: str) -> Bools:
    """Decode uncompressed run lengths, column by column, to a mask."""
    if isinstance(counts, str):
        raise InputError("has compressed run lengths, which are not read", source=source)
    runs = np.asarray(counts, dtype=np.int64)
    if np.any((runs < 0) | (runs > _MOST_PIXELS)) or int(runs.sum()) != shape[0] * shape[1]:
        raise InputError("has run lengths of another size", source=source)
    return np.asarray(np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(shape, order="F"))


def _ellipse(x: float, y: float, a: float, b: float, angle: float, source: str) -> Ellipse:
    if not (math.isfinite(x + y + a + b + angle) and min(a, b) > 0.0 and max(abs(x), abs(y), a, b) < 1e5):
        raise InputError("has no ellipse", source=source)
    return Ellipse(np.array([x, y]), np.array([a, b]), angle)


def _teyed(folder: Path) -> Iterator[BenchImage]:
    subjects = _subjects(folder / "splits.csv", "video")
    for video in sorted((folder / "VIDEOS").glob("*.mp4")):
        table = folder / "ANNOTATIONS" / f"{video.name}pupil_eli.txt"
        frames = unpacked(inside(folder / "VIDEOS", video.name, source=str(folder)))
        for where, (frame, degrees, x, y, width, height) in _rows(table, 6, heading=True):
            if not 1 <= frame <= len(frames):
                raise InputError("names a frame that the video lacks", source=str(table), path=where)
            pupil = None
            if width > 0.0 and height > 0.0:
                pupil = _ellipse(x, y, width / 2, height / 2, math.radians(degrees), f"{table}: {where}")
            subject = subjects.get(video.name) or video.stem
            yield BenchImage.read(f"{video.name}/{int(frame):06d}", frames[int(frame) - 1], pupil, subject=subject)


def _lpw_videos(folder: Path) -> list[Path]:
    videos = [*folder.glob("*.avi"), *folder.glob("*/*.avi")]
    return sorted(v for v in videos if v.with_suffix(".txt").is_file())


def _lpw(folder: Path) -> Iterator[BenchImage]:
    for video in _lpw_videos(folder):
        table = video.with_suffix(".txt")
        frames = unpacked(inside(video.parent, video.name, source=str(folder)))
        rows = list(_rows(table, 2))
        if len(rows) > len(frames):
            raise InputError(f"labels {len(rows)} frames; the video has {len(frames)}", source=str(table))
        for k, (path, (_, (x, y))) in enumerate(zip(frames, rows, strict=False), start=1):
            name = f"{video.relative_to(folder).as_posix()}/{k:06d}"
            image = BenchImage.read(name, path, centre_px=(x, y), subject=video.parent.name)
            if image.contains(x, y):
                yield image


def _excuse_tables(folder: Path) -> list[Path]:
    return sorted(t for t in folder.glob("*.txt") if any(t.with_suffix("").glob("*.png")))


def _excuse(folder: Path) -> Iterator[BenchImage]:
    for table in _excuse_tables(folder):
        home = table.with_suffix("")
        images = {int(p.stem): p.name for p in sorted(home.glob("*.png")) if p.stem.isdecimal()}
        for where, (_, number, x, y) in _rows(table, 4, heading=True):
            if number not in images:
                raise InputError(f"there is no image {number:g} in {home.name}", source=str(table), path=where)
            path = inside(home, images[int(number)], source=str(table))
            image = BenchImage.read(f"{home.name}/{path.name}", path, subject=home.name)
            centre = x / _EXCUSE_SCALE, image.size[1] - y / _EXCUSE_SCALE
            if image.contains(*centre):
                yield replace(image, centre_px=centre)


def _rows(table: Path, count: int, *, heading: bool = False) -> Iterator[tuple[str, list[float]]]:
    """Yield the place (`line N`) and the first numbers of each line of a table, separated by spaces or semicolons."""
    for k, line in enumerate(read_text(table, follow=False).splitlines()[: MAX_IMAGES + heading], start=1):
        if not line.strip() or (heading and k == 1):
            continue
        try:
            values = [float(cell) for cell in line.replace(";", " ").split()[:count]]
        except ValueError:
            values = []
        if len(values) < count or not all(map(math.isfinite, values)):
            raise InputError(f"needs {count} numbers", source=str(table), path=f"line {k}")
        yield f"line {k}", values
